"""Many trials at once: in this process, or by Ray on this machine or a cluster."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

from iwgnet_grasp.cluster import connect, first_line
from iwgnet_grasp.trials.statistics import Record

Task = tuple[str, int]  # scene, seed


class Worker(Protocol):
    def run(self, scene: str, seed: int) -> Record:
        """One trial. Raises CellError, ValueError or OSError when none can be run at all."""

    def close(self) -> None: ...


class PoolError(RuntimeError):
    """Trials cannot go on; one line."""


def run_here(make_worker: Callable[[], Worker], tasks: Sequence[Task]) -> Iterator[Record]:
    """Records of the tasks, in their order, from one worker in this process."""
    worker = make_worker()
    try:
        for scene, seed in tasks:
            yield worker.run(scene, seed)
    finally:
        worker.close()


def run_with_ray(
    make_worker: Callable[[], Worker],
    tasks: Sequence[Task],
    workers: int,
    address: str | None = None,
    say: Callable[[str], None] = print,
) -> Iterator[Record]:
    """Records of the tasks as they end, from `workers` Ray actors of one core each.

    address: see cluster.connect(). A trial whose worker died is tried once more, on a new one;
    `say` is told.
    Raises ClusterError when there is no such cluster, PoolError when a worker cannot work or a
    trial kills its workers; in the latter case after the trials that were running have ended.
    """
    handlers = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    ray = connect(address, workers)
    for number, handler in handlers.items():  # Ray's own print a stack
        signal.signal(number, handler)
    try:
        yield from _from_actors(ray, make_worker, tasks, workers, say)
    finally:
        ray.shutdown()


def _from_actors(ray, make_worker, tasks, workers, say) -> Iterator[Record]:
    actor_class = ray.remote(num_cpus=1, max_restarts=0)(_Actor)
    waiting = list(reversed(tasks))
    idle = [actor_class.remote(make_worker) for _ in range(min(workers, len(tasks)))]
    running: dict = {}  # reference -> actor, task
    died: set[Task] = set()
    fatal = ""
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
            if task in died or fatal:
                fatal = fatal or (
                    f"the worker of {scene} seed {seed} died twice ({first_line(error)}); alone: "
                    f"scripts/run_trials --scene {scene} --seed {seed} --trials 1"
                )
                waiting.clear()
                continue
            say(f"a worker died in {scene} seed {seed}; another tries that trial once more")
            died.add(task)
            waiting.append(task)
            idle.append(actor_class.remote(make_worker))
        except ray.exceptions.RayTaskError as error:
            raise PoolError(first_line(error.cause)) from None
        else:
            idle.append(actor)
            yield record
    if fatal:
        raise PoolError(fatal)


class _Actor:
    """A worker in a process of Ray's."""

    def __init__(self, make_worker: Callable[[], Worker]) -> None:
        self._make_worker = make_worker
        self._worker: Worker | None = None

    def run(self, scene: str, seed: int) -> Record:
        if self._worker is None:  # not in __init__, whose errors do not reach the caller
            self._worker = self._make_worker()
        return self._worker.run(scene, seed)
