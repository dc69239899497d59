"""Many trials at once: in this process, or by Ray on this machine or a cluster."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from iwgnet_grasp.trials.statistics import Record
from iwgnet_grasp.trials.worker import Conditions, make_worker

Task = tuple[str, int]  # scene, seed
ANSWER_SECONDS = 10.0  # that a cluster has to answer in


class PoolError(RuntimeError):
    """Trials cannot go on; one line."""


def run_here(conditions: Conditions, tasks: Sequence[Task], log_dir: Path) -> Iterator[Record]:
    """Records of the tasks, in their order, from one worker in this process."""
    worker = make_worker(conditions, log_dir)
    try:
        for scene, seed in tasks:
            yield worker.run(scene, seed)
    finally:
        worker.close()


def run_with_ray(
    conditions: Conditions,
    tasks: Sequence[Task],
    log_dir: Path,
    workers: int,
    address: str | None,
) -> Iterator[Record]:
    """Records of the tasks as they end, from `workers` Ray actors of one core each.

    address: of a running cluster, whose machines have the checkout at this path; None: a Ray of
    our own on this machine. A trial whose worker died is tried once more on a new one. Raises
    PoolError when the cluster does not answer, lacks cores, or a trial kills its workers.
    """
    import ray

    _connect(ray, address, workers)
    try:
        yield from _from_actors(ray, conditions, tasks, log_dir, workers)
    finally:
        ray.shutdown()


def _from_actors(ray, conditions, tasks, log_dir, workers) -> Iterator[Record]:
    actor_class = ray.remote(num_cpus=1, max_restarts=0)(_Actor)

    def start():
        return actor_class.remote(conditions, str(log_dir))

    waiting = list(reversed(tasks))
    idle = [start() for _ in range(min(workers, len(tasks)))]
    running: dict = {}  # reference -> actor, task
    died: set[Task] = set()
    while waiting or running:
        while waiting and idle:
            actor, task = idle.pop(), waiting.pop()
            running[actor.run.remote(*task)] = actor, task
        (done,), _ = ray.wait(list(running), num_returns=1)
        actor, task = running.pop(done)
        try:
            record = ray.get(done)
        except ray.exceptions.RayActorError as error:
            scene, seed = task
            if task in died:
                raise PoolError(
                    f"the worker of {scene} seed {seed} died twice ({_first_line(error)}); "
                    f"run it alone: scripts/run_trials replay --scene {scene} --seed {seed}"
                ) from None
            died.add(task)
            waiting.append(task)
            idle.append(start())
            continue
        except ray.exceptions.RayTaskError as error:
            raise PoolError(_first_line(error.cause)) from None
        idle.append(actor)
        yield record


class _Actor:
    """A worker in a process of Ray's."""

    def __init__(self, conditions: Conditions, log_dir: str) -> None:
        self._made = conditions, Path(log_dir)
        self._worker = None

    def run(self, scene: str, seed: int) -> Record:
        if self._worker is None:  # here and not in __init__: its errors then name themselves
            self._worker = make_worker(*self._made)
        return self._worker.run(scene, seed)


def _connect(ray, address: str | None, workers: int) -> None:
    quiet = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        # The dashboard and its agents would cost more memory than a worker.
        ray.init(num_cpus=workers, include_dashboard=False, **quiet)
        return
    if address != "auto":
        _knock(address)
    passed = {name: os.environ[name] for name in ("PYTHONPATH", "LD_LIBRARY_PATH")}
    try:
        ray.init(address=address, runtime_env={"env_vars": passed}, **quiet)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        raise PoolError(f"no Ray cluster at {address}: {_first_line(error)}") from None
    cores = int(ray.cluster_resources().get("CPU", 0))
    if cores < workers:
        ray.shutdown()
        raise PoolError(f"the Ray cluster at {address} has {cores} cores for {workers} workers")


def _knock(address: str) -> None:
    """Raises PoolError unless a Ray cluster answers; ray.init itself waits long and then aborts."""
    client = address.startswith("ray://")
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise PoolError(f"--address {address}: is not HOST:PORT, ray://HOST:PORT or auto")
    nobody = f"nobody answers at {address}; start Ray there: ray start --head"
    try:
        socket.create_connection((host, int(port)), ANSWER_SECONDS).close()
    except OSError as error:
        raise PoolError(f"{nobody} ({_first_line(error)})") from None
    if client:
        return
    check = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        done = subprocess.run(
            check, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=ANSWER_SECONDS
        )
    except subprocess.TimeoutExpired:
        raise PoolError(nobody) from None
    if done.returncode != 0:
        raise PoolError(f"{nobody} (something listens that is no Ray)")


def _first_line(error: BaseException | None) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
