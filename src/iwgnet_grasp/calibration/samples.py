"""The samples of a calibration and its result, as values and as a YAML file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from iwgnet_grasp.calibration.settings import CalibrationError, as_yaml, core, matrix
from iwgnet_grasp.files import write_whole


@dataclass(frozen=True)
class Sample:
    """One robot pose with the target in view, the arm at rest."""

    joints: np.ndarray  # (6,) rad
    T_base_tool: np.ndarray  # (4, 4)
    T_camera_target: np.ndarray  # (4, 4)
    corners: np.ndarray | None = None  # (n, 3) m, target frame; None: the pose is all there is
    pixels: np.ndarray | None = None  # (n, 2) px
    image: np.ndarray | None = field(default=None, compare=False)  # (H, W, 3) RGB, not stored


@dataclass(frozen=True)
class SampleSet:
    samples: list[Sample]
    intrinsics: tuple[int, int, float, float, float, float]  # width, height, fx, fy, cx, cy in px
    noise: tuple[float, float]  # of the target poses, per axis: m, rad
    origin: dict[str, Any]  # board, source, seed: how the samples came about

    @property
    def T_base_tool(self) -> list[np.ndarray]:
        return [sample.T_base_tool for sample in self.samples]

    @property
    def T_camera_target(self) -> list[np.ndarray]:
        return [sample.T_camera_target for sample in self.samples]

    @property
    def has_images(self) -> bool:
        return all(sample.corners is not None for sample in self.samples)

    @property
    def camera(self) -> Any:
        return core().PinholeIntrinsics(*self.intrinsics)

    @property
    def views(self) -> list[Any]:
        """_core.TargetViews of samples with corners."""
        return [core().TargetView(s.T_base_tool, s.corners, s.pixels) for s in self.samples]

    def without(self, index: int) -> SampleSet:
        rest = self.samples[:index] + self.samples[index + 1 :]
        return SampleSet(rest, self.intrinsics, self.noise, self.origin)


def save(path: Path, samples: SampleSet, result: dict[str, Any]) -> None:
    """Writes result (T_base_color first of all) and samples. Raises OSError."""
    entries = []
    for sample in samples.samples:
        entry = {
            "joints": sample.joints.tolist(),
            "T_base_tool": as_yaml(sample.T_base_tool),
            "T_camera_target": as_yaml(sample.T_camera_target),
        }
        if sample.corners is not None and sample.pixels is not None:
            entry["corners"] = np.round(sample.corners, 9).tolist()
            entry["pixels"] = np.round(sample.pixels, 6).tolist()
        entries.append(entry)
    text = {
        **result,
        "origin": samples.origin,
        "camera": dict(zip(_INTRINSICS, samples.intrinsics, strict=True)),
        "noise": {"translation": samples.noise[0], "rotation": samples.noise[1]},
        "samples": entries,
    }
    head = (
        "# Eye-to-hand calibration. T_base_color: colour optical frame -> base_link (m).\n"
        "# Solve it again from its samples: scripts/iwgnet calibrate THIS_FILE\n"
    )
    body = yaml.safe_dump(text, sort_keys=False, default_flow_style=None, width=100)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, (head + body).encode())


_INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")


def load(path: Path) -> SampleSet:
    """The samples of a result file. Raises CalibrationError saying what is wrong with it."""
    try:
        text = yaml.safe_load(path.read_text())
        entries, camera = text["samples"], text["camera"]
        samples = []
        for entry in entries:
            corners = entry.get("corners")
            samples.append(
                Sample(
                    np.asarray(entry["joints"], float),
                    matrix(entry["T_base_tool"]),
                    matrix(entry["T_camera_target"]),
                    None if corners is None else np.asarray(corners, float).reshape(-1, 3),
                    None if corners is None else np.asarray(entry["pixels"], float).reshape(-1, 2),
                )
            )
        return SampleSet(
            samples,
            tuple(camera[name] for name in _INTRINSICS),
            (float(text["noise"]["translation"]), float(text["noise"]["rotation"])),
            dict(text["origin"]),
        )
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not valid YAML ({error})".replace("\n", " ")) from None
    except KeyError as error:
        raise CalibrationError(f"{path}: key {error} is missing; is it a calibration?") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise CalibrationError(f"{path}: is no calibration ({error})") from None


def simulated(
    count: int, noise: tuple[float, float], random: np.random.Generator
) -> tuple[SampleSet, np.ndarray]:
    """Pairs of a camera 0.6 m above the table and a target held by the robot, from a known
    transform and with this noise of the target poses (per axis: m, rad). Returns them and the true
    T_base_camera.
    """

    def pose(move: np.ndarray, turn: np.ndarray) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(turn)[0]
        T[:3, 3] = move
        return T

    def uniform(*limits: float) -> np.ndarray:
        return random.uniform(-1.0, 1.0, 3) * limits

    T_base_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    T_base_camera[:3, 3] = 0.5, 0.0, 0.6
    T_base_camera = T_base_camera @ pose(uniform(0.01, 0.01, 0.01), uniform(0.03, 0.03, 0.03))
    T_tool_target = pose(uniform(0.02, 0.02, 0.02) + [0, 0, 0.25], uniform(0.5, 0.5, 0.5))
    samples = []
    for _ in range(count):
        # Seen from the camera: below it, tilted up to 30 deg, turned up to 1 rad.
        T_camera_tool = pose(uniform(0.15, 0.12, 0.08) + [0, 0, 0.3], uniform(0.5, 0.5, 1.0))
        T_camera_target = T_camera_tool @ T_tool_target
        error = pose(random.normal(0.0, noise[0], 3), random.normal(0.0, noise[1], 3))
        samples.append(Sample(np.zeros(6), T_base_camera @ T_camera_tool, T_camera_target @ error))
    intrinsics = (1280, 800, 640.0, 640.0, 639.5, 399.5)
    return SampleSet(samples, intrinsics, noise, {"source": "draw"}), T_base_camera
