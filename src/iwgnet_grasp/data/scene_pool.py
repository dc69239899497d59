"""Workers that make scenes: processes of this machine, or Ray actors on many machines.

A worker is a `SceneWorker`; its results travel back as bytes, so that the machines of a cluster
need no common folder. Both pools have submit(), result() and close().
"""

from __future__ import annotations

import ctypes
import hashlib
import multiprocessing
import os
import signal
from collections.abc import Hashable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import yaml

from iwgnet_grasp.data.errors import DataError

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_DIED = "a worker died (out of memory?); run the same command again to go on"


@dataclass(frozen=True)
class SceneKind:
    """What the scenes of a data set have in common; decides their bits together with the seed."""

    families: tuple[str, ...]
    settings: dict  # config/dataset.yaml
    library: str  # library_digest() of the families' parts
    detector: bool = True  # with colour images


def library_digest(package_dir: Path, families: list[str] | tuple[str, ...]) -> str:
    """Digest of the parts of some families in assets/parts: name, mass, mesh and pieces."""
    digest = hashlib.sha256()
    for path in sorted((package_dir / "assets" / "parts").glob("*/part.yaml")):
        text = path.read_bytes()
        if yaml.safe_load(text)["family"] not in families:
            continue
        digest.update(text)
        for mesh in sorted(path.parent.glob("*.stl")):
            digest.update(mesh.read_bytes())
    return digest.hexdigest()[:16]


class SceneWorker:
    """Makes piles of one data set with a simulated cell of its own."""

    def __init__(self, kind: SceneKind, package_dir: Path) -> None:
        self.kind = kind
        self.package_dir = package_dir
        self._maker = None
        self._picker = None

    def scenes(self, seed: int, pile: int, wanted: list[int]) -> dict[int, dict[str, bytes]]:
        """Number -> files of the wanted scenes of a pile (generate.encode_scene)."""
        from iwgnet_grasp.data.generate import LOOKS, encode_scene

        made = {}
        for look, scene in enumerate(self.maker.pile(seed, pile)):
            number = pile * LOOKS + look
            if number in wanted:
                made[number] = encode_scene(scene, number, list(self.kind.families))
        return made

    def lifts(self, seed: int, pile: int, wanted: list[int], labels: int) -> dict[int, list[dict]]:
        """Number -> lifts of some labels of each wanted scene (lift_check.check_scene)."""
        from iwgnet_grasp.data.lift_check import check_pile

        return check_pile(self.maker, seed, pile, wanted, labels)

    def network_lifts(self, seed: int, pile: int, wanted: dict) -> list[tuple]:
        """Lifts of networks' grasps on a pile (trials.held_out_lifts.lift_pile)."""
        from iwgnet_grasp.trials.held_out_lifts import lift_pile

        return lift_pile(self.maker, seed, pile, wanted)

    def picks(self, seed: int, pile: int) -> bytes:
        """The file of a pile with picks (pick_outcomes.encode_pile)."""
        from iwgnet_grasp.data.pick_outcomes import Picker, encode_pile

        if self._picker is None:
            self._picker = Picker(self.maker)
        return encode_pile(self._picker.pile(seed, pile))

    @property
    def maker(self) -> Any:
        # Here and not in __init__: an actor's errors then reach the caller as they are.
        if self._maker is None:
            from iwgnet_grasp.data.generate import SceneMaker

            if library_digest(self.package_dir, self.kind.families) != self.kind.library:
                raise DataError(
                    f"{os.uname().nodename}: {self.package_dir}/assets/parts differs from the part "
                    "library of the machine that started the run; run scripts/setup there"
                )
            cv2.setNumThreads(1)
            self._maker = SceneMaker(
                list(self.kind.families), self.kind.settings, self.package_dir, self.kind.detector
            )
        return self._maker


class ProcessPool:
    """`size` processes of this machine."""

    def __init__(self, size: int, kind: SceneKind, package_dir: Path) -> None:
        self.size = size
        self._others = set(multiprocessing.active_children())
        self._pool = ProcessPoolExecutor(
            size,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_process,
            initargs=(kind, package_dir),
        )

    def submit(self, method: str, *arguments: Any) -> Future:
        """Calls a method of some SceneWorker."""
        try:
            return self._pool.submit(_call, method, *arguments)
        except BrokenProcessPool:
            raise DataError(_DIED) from None

    def result(self, future: Future) -> Any:
        """What the call gave; its error, or DataError when the worker died."""
        try:
            return future.result()
        except BrokenProcessPool:
            raise DataError(_DIED) from None

    def close(self) -> None:
        """What is under way is lost: a pile takes up to a minute, and who stops a run waits."""
        for process in set(multiprocessing.active_children()) - self._others:
            process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)


_worker: SceneWorker | None = None


def _start_process(kind: SceneKind, package_dir: Path) -> None:
    global _worker
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)  # no worker outlives the run
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the run
    _worker = SceneWorker(kind, package_dir)


def _call(method: str, *arguments: Any) -> Any:
    return getattr(_worker, method)(*arguments)


class RayPool:
    """`size` actors of one core each on a running Ray cluster; 0: one for each of its cores.

    Raises DataError when the cluster cannot be used.
    """

    def __init__(self, address: str, size: int, kind: SceneKind, package_dir: Path) -> None:
        from iwgnet_grasp.cluster import ClusterError, connect

        on_term = signal.getsignal(signal.SIGTERM)
        try:
            self._ray = connect(address, max(size, 1))
        except ClusterError as error:
            raise DataError(str(error)) from None
        signal.signal(signal.SIGTERM, on_term)  # Ray has set its own
        self.size = size or int(self._ray.cluster_resources()["CPU"])
        actor = self._ray.remote(num_cpus=1)(SceneWorker)
        self._actors = [actor.remote(kind, package_dir) for _ in range(self.size)]
        self._waiting = [0] * self.size

    def submit(self, method: str, *arguments: Any) -> Future:
        i = min(range(self.size), key=lambda k: self._waiting[k])
        self._waiting[i] += 1
        future = getattr(self._actors[i], method).remote(*arguments).future()
        future.actor = i
        return future

    def result(self, future: Future) -> Any:
        self._waiting[future.actor] -= 1
        try:
            return future.result()
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from None
        except self._ray.exceptions.RayError:
            raise DataError(_DIED) from None

    def close(self) -> None:
        self._ray.shutdown()


def open_pool(
    kind: SceneKind, workers: int, address: str | None, package_dir: Path
) -> ProcessPool | RayPool:
    """workers 0: one for each core. DataError when the cluster cannot be used."""
    if address:
        return RayPool(address, workers, kind, package_dir)
    return ProcessPool(workers or os.cpu_count() or 1, kind, package_dir)


def results(
    pool: ProcessPool | RayPool, calls: Iterable[tuple[Hashable, tuple]]
) -> Iterator[tuple[Hashable, Any]]:
    """(key, result) of each (key, arguments of submit()), as they are done; two calls a worker are
    under way, so that none waits."""
    left, running = iter(calls), {}
    while True:
        while len(running) < 2 * pool.size and (call := next(left, None)) is not None:
            key, arguments = call
            running[pool.submit(*arguments)] = key
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), pool.result(future)
