"""pybullet's software renderer on the same view, 1280 x 720, depth without noise: ms a frame."""

import json
import statistics
import sys
import time
from pathlib import Path

import pybullet as p
from cell import build

build(Path(sys.argv[1]), 1 / 240, 50)
for _ in range(480):
    p.stepSimulation()
view = p.computeViewMatrix([0.5, 0, 0.6], [0.5, 0, 0], [0, 1, 0])
projection = p.computeProjectionMatrixFOV(58, 1280 / 720, 0.1, 3)
times = []
for _ in range(6):
    start = time.perf_counter()
    p.getCameraImage(1280, 720, view, projection, renderer=p.ER_TINY_RENDERER)
    times.append(time.perf_counter() - start)
print(json.dumps({"value": statistics.median(times[1:]) * 1e3}))
