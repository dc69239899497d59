"""The cell in pybullet: the same arm, table and ten rods with the same convex pieces."""

from pathlib import Path

import pybullet as p


def build(package: Path, timestep: float, iterations: int) -> tuple[int, list[int]]:
    """Connects and returns (arm, parts)."""
    p.connect(p.DIRECT)
    p.setGravity(0, 0, -9.81)
    p.setPhysicsEngineParameter(fixedTimeStep=timestep, numSolverIterations=iterations)
    table = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.75, 0.65, 0.02])
    p.createMultiBody(0, table, basePosition=[0.45, 0.15, -0.02])
    urdf = (package / "urdf" / "cell.urdf").read_text()
    resolved = package / ".build" / "cell_for_peers.urdf"
    resolved.write_text(urdf.replace("package://iwgnet_grasp/", f"{package}/"))
    arm = p.loadURDF(str(resolved), useFixedBase=True)
    rods = sorted((package / "assets" / "parts").glob("rod_*"))
    parts = []
    for i in range(10):
        rod = rods[i % len(rods)]
        pieces = [str(piece) for piece in sorted(rod.glob("piece_*.stl"))]
        shape = p.createCollisionShapeArray(
            shapeTypes=[p.GEOM_MESH] * len(pieces),
            fileNames=pieces,
        )
        visual = p.createVisualShape(p.GEOM_MESH, fileName=str(rod / "mesh.stl"))
        position = [0.45 + 0.1 * (i % 2), -0.1 + 0.05 * (i // 2), 0.05 + 0.03 * i]
        parts.append(p.createMultiBody(0.4, shape, visual, position))
    return arm, parts
