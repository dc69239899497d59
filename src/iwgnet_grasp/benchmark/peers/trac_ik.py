"""TRAC-IK on the same arm: microseconds for one solution. Run in .venv-peers."""

import json
import sys
import time
from pathlib import Path

import numpy as np
from trac_ik import TracIK

package = Path(sys.argv[1])
solver = TracIK(
    base_link_name="base_link",
    tip_link_name="tool0",
    urdf_path=str(package / "urdf" / "cell.urdf"),
)
random = np.random.default_rng(0)
poses = [solver.fk(q) for q in random.uniform(-np.pi, np.pi, (500, 6))]
seeds = random.uniform(-np.pi, np.pi, (500, 6))
start = time.perf_counter()
solved = sum(
    solver.ik(position, rotation, seed_jnt_values=seed) is not None
    for (position, rotation), seed in zip(poses, seeds, strict=True)
)
elapsed = time.perf_counter() - start
print(json.dumps({"value": elapsed / 500 * 1e6, "solved": solved / 500}))
