"""How fast the networks run: windows of 300x300 px on each library, in turns."""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from iwgnet_grasp.networks import create_network
from iwgnet_grasp.networks.backends import BACKENDS, make_runner, missing
from iwgnet_grasp.networks.detector_model import detector_model
from iwgnet_grasp.networks.inference import grasp_model
from iwgnet_grasp.networks.yolov5s import YOLOv5s

WINDOW_PX = 300
DETECTOR_INPUT = (416, 640)
NETWORKS = ("iwgnet", "ggcnn", "grconvnet")


class Timing(NamedTuple):
    median: float  # ms, wall
    best: float
    runs: int


def in_turns(
    bodies: dict[str, Callable[[], object]], rounds: int = 30, seconds: float = 60.0
) -> dict[str, Timing]:
    """Times each body once a round, so that what else the machine does hits all alike; after one
    round to warm up at least three, and no new one after `seconds`."""
    times: dict[str, list[float]] = {name: [] for name in bodies}
    begin = time.perf_counter()
    for i in range(rounds + 1):
        if i > 3 and time.perf_counter() - begin > seconds:
            break
        for name, body in bodies.items():
            start = time.perf_counter()
            body()
            if i:
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: Timing(statistics.median(t), min(t), len(t)) for name, t in times.items()}


@functools.cache
def one_window(backend: str) -> tuple[str, dict[str, Timing]]:
    """The backend that IWGNet is given, and the networks on one window, each on that one."""
    taken, _ = make_runner(grasp_model(create_network("iwgnet"), WINDOW_PX), backend)
    bodies = {}
    for name in NETWORKS:
        model = grasp_model(create_network(name), WINDOW_PX)
        bodies[name] = functools.partial(make_runner(model, taken)[1], model.probe)
    return taken, in_turns(bodies)


def ten_windows() -> tuple[str, Timing]:
    """IWGNet on the ten windows of a look."""
    model = grasp_model(create_network("iwgnet"), WINDOW_PX)
    taken, run = make_runner(model)
    windows = np.repeat(model.probe, 10, axis=0)
    return taken, in_turns({"ten": lambda: run(windows)})["ten"]


def detector() -> tuple[str, Timing]:
    """YOLOv5s of one class on one image of DETECTOR_INPUT."""
    model = detector_model(YOLOv5s(1), DETECTOR_INPUT)
    taken, run = make_runner(model)
    return taken, in_turns({"detector": lambda: run(model.probe)})["detector"]


def usable() -> list[str]:
    return [name for name in BACKENDS if not missing(name)]
