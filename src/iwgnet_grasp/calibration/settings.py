"""config/calibration.yaml, read and checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

PACKAGE = Path(__file__).resolve().parents[3]


class CalibrationError(ValueError):
    """What keeps a calibration from going on: one line with the reason and what to do."""


@dataclass(frozen=True)
class Settings:
    """Lengths in m, angles in rad; see config/calibration.yaml for each."""

    boards: dict[str, dict[str, Any]]
    print_size: np.ndarray  # (2,)
    white: float
    black: float
    plate_center: np.ndarray  # (3,)
    plate_size: np.ndarray  # (3,)
    T_tool_board: np.ndarray  # (4, 4), nominal
    start_joints: np.ndarray  # (6,)
    board_min: np.ndarray  # (3,), where its middle is shown
    board_max: np.ndarray  # (3,)
    tilt: tuple[float, float]
    margin_px: float
    max_velocity: float
    max_acceleration: float
    settle_speed: float
    settle_time: float
    settle_give_up: float
    max_motion: float
    min_corners: float
    max_rms_px: float
    noise: tuple[float, float]  # of poses from images: m, rad
    simulated_noise: tuple[float, float]


def load_settings(config_dir: Path = PACKAGE / "config") -> Settings:
    """Raises CalibrationError naming the file and what is wrong with it."""
    path = config_dir / "calibration.yaml"
    try:
        text = yaml.safe_load(path.read_text())
        board, plate, rig, poses = text["board"], text["plate"], text["rig"], text["poses"]
        settle, detection = text["settle"], text["detection"]
        simulated, noise = text["simulated_poses"], text["noise"]
        return Settings(
            boards={name: board[name] for name in ("charuco", "apriltag")},
            print_size=_vector(board["print"], 2),
            white=float(board["white"]),
            black=float(board["black"]),
            plate_center=_vector(plate["center"], 3),
            plate_size=_vector(plate["size"], 3),
            T_tool_board=matrix(rig["T_tool_board"]),
            start_joints=_vector(rig["start_joints"], 6),
            board_min=_vector(poses["min"], 3),
            board_max=_vector(poses["max"], 3),
            tilt=(float(poses["tilt"][0]), float(poses["tilt"][1])),
            margin_px=float(poses["margin_px"]),
            max_velocity=float(poses["max_velocity"]),
            max_acceleration=float(poses["max_acceleration"]),
            settle_speed=float(settle["speed"]),
            settle_time=float(settle["time"]),
            settle_give_up=float(settle["give_up"]),
            max_motion=float(settle["max_motion"]),
            min_corners=float(detection["min_corners"]),
            max_rms_px=float(detection["max_rms_px"]),
            noise=(float(noise["translation"]), float(noise["rotation"])),
            simulated_noise=(float(simulated["translation"]), float(simulated["rotation"])),
        )
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror}") from None
    except yaml.YAMLError as error:
        raise CalibrationError(f"{path}: not valid YAML ({error})".replace("\n", " ")) from None
    except KeyError as error:
        raise CalibrationError(f"{path}: key {error} is missing") from None
    except (TypeError, ValueError, IndexError) as error:
        raise CalibrationError(f"{path}: {error}") from None


def _vector(values: Any, size: int) -> np.ndarray:
    vector = np.asarray(values, float)
    if vector.shape != (size,):
        raise ValueError(f"expected {size} numbers, got {values}")
    return vector


def matrix(pose: dict[str, Any]) -> np.ndarray:
    """(4, 4) of {rotation: 3 rows of 3, translation: 3}. Raises ValueError unless it is rigid."""
    T = np.eye(4)
    T[:3, :3] = np.asarray(pose["rotation"], float).reshape(3, 3)
    T[:3, 3] = _vector(pose["translation"], 3)
    if not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-4) or np.linalg.det(T) < 0:
        raise ValueError("a rotation is not a rotation matrix")
    return T


def as_yaml(T: np.ndarray) -> dict[str, Any]:
    """The inverse of matrix()."""
    return {"rotation": T[:3, :3].tolist(), "translation": T[:3, 3].tolist()}


def core() -> Any:
    """The C++ core. Raises CalibrationError where it is not built."""
    try:
        from iwgnet_grasp import _core
    except ImportError as error:
        raise CalibrationError(
            f"the C++ extension cannot be loaded ({error}); run scripts/setup, then source "
            "scripts/env.sh"
        ) from None
    return _core


def inverse(T: np.ndarray) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = T[:3, :3].T
    result[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return result


def angle(R: np.ndarray) -> float:
    """rad; accurate for small angles, too."""
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(np.linalg.norm(axis), np.trace(R[:3, :3]) - 1.0))


def difference(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """How far two poses lie apart: m, rad."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), angle(a[:3, :3].T @ b[:3, :3])
