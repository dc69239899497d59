"""pybullet with arm and ten rods at 240 Hz, 50 iterations: simulated over wall time."""

import json
import math
import sys
import time
from pathlib import Path

import pybullet as p
from cell import build

STEP = 1 / 240
arm, parts = build(Path(sys.argv[1]), STEP, 50)
for _ in range(480):
    p.stepSimulation()
busy = 0.0
steps = 960
for i in range(steps):
    if i % 48 == 0:
        for part in parts:
            position, turn = p.getBasePositionAndOrientation(part)
            lifted = (position[0], position[1], position[2] + 0.001)
            p.resetBasePositionAndOrientation(part, lifted, turn)
    target = 0.3 * (1 - math.cos(math.pi * i * STEP))
    p.setJointMotorControl2(arm, 1, p.POSITION_CONTROL, target)
    start = time.perf_counter()
    p.stepSimulation()
    busy += time.perf_counter() - start
print(json.dumps({"value": steps * STEP / busy}))
