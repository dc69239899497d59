"""The rows of the benchmark: what is measured, its goal and its peer."""

from __future__ import annotations

import functools
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from iwgnet_grasp.benchmark.measure import (
    PACKAGE,
    BenchmarkError,
    command,
    core,
    last_line,
    median_seconds,
    peer,
)


@dataclass(frozen=True)
class Goal:
    limit: float
    at_least: bool = False  # else: at most

    def text(self, unit: str) -> str:
        return f"{'>=' if self.at_least else '<='} {self.limit:g} {unit}"

    def met(self, value: float) -> bool:
        return value >= self.limit if self.at_least else value <= self.limit


@dataclass(frozen=True)
class Result:
    name: str
    value: float
    unit: str
    detail: str
    goal: Goal | None = None
    peer: str = ""
    peer_value: float | None = None

    @property
    def met(self) -> bool | None:
        return self.goal.met(self.value) if self.goal else None

    def as_dict(self) -> dict:
        ratio = self.value / self.peer_value if self.peer_value else None
        return {**asdict(self), "met": self.met, "ratio": ratio}


@dataclass(frozen=True)
class Run:
    """What a row is told: whether peers are to be measured, and where to tell its progress."""

    peers: bool
    say: Callable[[str], None]


@dataclass(frozen=True)
class Row:
    name: str
    what: str
    measure: Callable[[Run], Result]


def _core_row(name: str, goal: Goal | None, peer_script: str = "", peer_name: str = "") -> Row:
    def measure(run: Run) -> Result:
        ours = core(name)[name]
        peer_value = peer(peer_script)["value"] if run.peers and peer_script else None
        value, unit, detail = ours["value"], ours["unit"], ours["detail"]
        return Result(name, value, unit, detail, goal, peer_name, peer_value)

    return Row(name, _WHAT[name], measure)


_WHAT = {
    "ik": "closed-form inverse kinematics, all solutions",
    "physics_awake": "physics with every part kept awake, one core",
    "depth_frame": "a depth image as the D455 measures it",
    "color_frame": "a colour image",
    "scene": "a pile of ten, dropped and settled",
    "planning": "a collision-free transfer",
    "hand_eye": "hand-eye refinement of 15 pairs",
}


def _ik_kdl(run: Run) -> Result:
    rows = core("ik", "ik_kdl")
    return Result(
        "ik_kdl",
        rows["ik_kdl"]["value"],
        "us",
        rows["ik_kdl"]["detail"],
        peer="closed form",
        peer_value=rows["ik"]["value"],
    )


def _iwgnet_row(name: str, what: str, backend: str, rival: str, goal: Goal | None = None) -> Row:
    """IWGNet's time on a window beside a rival's on the same backend, taken in turns."""

    def measure(run: Run) -> Result:
        from iwgnet_grasp.benchmark.networks import WINDOW_PX, one_window, usable

        if backend != "auto" and backend not in usable():
            raise BenchmarkError(f"backend {backend} is not installed here")
        taken, times = one_window(backend)
        ours = times["iwgnet"]
        detail = f"{WINDOW_PX}x{WINDOW_PX}, {taken}; best of {ours.runs} {ours.best:.2f} ms"
        return Result(name, ours.median, "ms", detail, goal, rival, times[rival].median)

    return Row(name, what, measure)


def _iwgnet_ten(run: Run) -> Result:
    from iwgnet_grasp.benchmark.networks import WINDOW_PX, ten_windows

    taken, time = ten_windows()
    detail = f"ten of {WINDOW_PX}x{WINDOW_PX}, {taken}; best of {time.runs} {time.best:.1f} ms"
    return Result("iwgnet_ten", time.median, "ms", detail)


def _detector(run: Run) -> Result:
    from iwgnet_grasp.benchmark.networks import DETECTOR_INPUT, detector

    taken, time = detector()
    rows, columns = DETECTOR_INPUT
    detail = f"{rows}x{columns}, {taken}; best of {time.runs} {time.best:.1f} ms"
    return Result("detector", time.median, "ms", detail, Goal(20))


def _look(run: Run) -> Result:
    from iwgnet_grasp import _core
    from iwgnet_grasp.perception import load_perception
    from iwgnet_grasp.perception.types import CameraIntrinsics
    from iwgnet_grasp.priority import PriorityConfig, rank

    cell = _core.SimulatedCell(str(PACKAGE), "")
    cell.load_scene("", 0)
    empty = cell.aligned_depth(cell.depth())
    cell.load_scene("ten_stacked", 0)
    color, depth = cell.color(), cell.aligned_depth(cell.depth())
    perception = load_perception()
    k = cell.camera.color
    intrinsics = CameraIntrinsics(k.fx, k.fy, k.cx, k.cy)
    priority = PriorityConfig.load(PACKAGE / "config" / "priority.yaml")
    objects: list = []

    def look() -> None:
        objects[:] = perception.look(color, depth, empty).objects
        rank(objects, intrinsics, priority, [])

    value = median_seconds(look, runs=10) * 1e3
    detail = f"image to order, {len(objects)} of ten objects seen"
    return Result("look", value, "ms", detail, Goal(150))


def _labels(run: Run) -> Result:
    from iwgnet_grasp.benchmark.labelling import measure_labelling

    depth, color = measure_labelling(False), measure_labelling(True)
    detail = (
        f"300x300 depths, mask and grasps of an object, {depth.samples} in {depth.scenes} settled "
        f"scenes; {color.per_second:.1f} with colour and the detector's image"
    )
    return Result("labels", depth.per_second, "/s and core", detail, Goal(20, at_least=True))


@functools.cache
def _noisy_pairs() -> dict:
    """Ours, ViSP (a program of its own) and OpenCV on the same 200 draws of 15 noisy pairs."""
    from iwgnet_grasp.calibration.measure import measure_pairs
    from iwgnet_grasp.calibration.settings import CalibrationError

    try:
        return measure_pairs(200)["methods"]
    except CalibrationError as error:
        raise BenchmarkError(str(error)) from None


def _hand_eye_error(run: Run) -> Result:
    ours, visp = (_noisy_pairs()[name] for name in ("ours, pairs", "ViSP"))
    detail = f"15 pairs, 0.5 mm and 0.1 deg noise, 200 draws; {ours['deg']:.3f} deg"
    return Result(
        "hand_eye_error", ours["mm"], "mm", detail, Goal(0.75 * visp["mm"]), "ViSP", visp["mm"]
    )


def _hand_eye_time(run: Run) -> Result:
    ours, visp = (_noisy_pairs()[name] for name in ("ours, pairs", "ViSP"))
    return Result(
        "hand_eye_time", ours["ms"], "ms", "the same pairs", Goal(visp["ms"]), "ViSP", visp["ms"]
    )


def _calibration(run: Run) -> Result:
    from iwgnet_grasp.calibration.measure import measure_images, summary
    from iwgnet_grasp.calibration.settings import CalibrationError

    try:
        s = summary(measure_images(range(20), "charuco"))
    except CalibrationError as error:
        raise BenchmarkError(str(error)) from None
    detail = (
        f"15 images, seeds 0-19; median {s['median_mm']:.3f} mm, {s['median_deg']:.4f} deg, worst "
        f"{s['worst_mm']:.3f} mm, {s['worst_deg']:.4f} deg"
    )
    return Result("calibration", s["median_mm"], "mm", detail, Goal(0.3))


def _trial(path: Path) -> dict:
    try:
        return json.loads((path / "trial.json").read_text())
    except (OSError, ValueError) as error:
        raise BenchmarkError(f"the trial left no readable result: {error}") from None


@functools.cache
def _ten_in_process() -> dict:
    """What five trials of ten_stacked in one process on one core came to."""
    from iwgnet_grasp.trials.batch import read_summary

    core = str(min(os.sched_getaffinity(0)))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        trials = ["-m", "iwgnet_grasp.trials", "--scene", "ten_stacked", "--trials", "5"]
        ran = command(
            ["taskset", "--cpu-list", core, sys.executable, *trials, "--out", str(out)],
            timeout_s=900,
        )
        if ran.returncode != 0:
            raise BenchmarkError(last_line(ran.stderr))
        return read_summary(out)["scenes"]["ten_stacked"]


def _physics(run: Run) -> Result:
    trials = _ten_in_process()
    factor = trials["sim_time_s"] / (trials["wall_time_s"] - trials["computing_time_s"])
    detail = "ten_stacked on one core, arm at work; looking and planning taken off"
    return Result("physics", factor, "x real time", detail, Goal(8, at_least=True))


def _trial_in_process(run: Run) -> Result:
    trials = _ten_in_process()
    detail = f"ten_stacked on one core, {trials['sim_time_s']:.0f} s simulated, all included"
    goal = Goal(8, at_least=True)
    return Result("trial_in_process", trials["times_real"], "x real time", detail, goal)


def _ros_trial(scene: str, seed: int) -> tuple[dict, float]:
    with tempfile.TemporaryDirectory() as folder:
        start = time.monotonic()
        run = command(
            [
                str(PACKAGE / "scripts" / "start_grasping"),
                f"scene:={scene}",
                f"seed:={seed}",
                f"out:={folder}",
            ],
            timeout_s=900,
        )
        wall = time.monotonic() - start
        if run.returncode not in (0, 1):
            raise BenchmarkError(last_line(run.stderr) or last_line(run.stdout))
        return _trial(Path(folder)), wall


def _trial_ros(run: Run) -> Result:
    trial, wall = _ros_trial("five_scattered", 0)
    factor = trial["sim_time_s"] / trial["wall_time_s"]
    detail = f"five objects, start to end of scripts/start_grasping; {factor:.1f}x real time"
    return Result("trial_ros", wall, "s", detail, Goal(180))


def _trial_ros_speed(run: Run) -> Result:
    trial, _ = _ros_trial("five_scattered", 1)
    factor = trial["sim_time_s"] / trial["wall_time_s"]
    detail = f"five objects over ROS, {trial['sim_time_s']:.0f} s simulated"
    return Result("trial_ros_speed", factor, "x real time", detail, Goal(1, at_least=True))


def _success(run: Run) -> Result:
    wins = []
    for seed in range(10):
        trial, wall = _ros_trial("five_scattered", seed)
        wins.append(trial["success"])
        run.say(f"seed {seed}: {'success' if wins[-1] else 'FAILED'} after {wall:.0f} s")
    lost = [str(seed) for seed, won in enumerate(wins) if not won]
    detail = "five_scattered over ROS, seeds 0-9" + (f"; failed: {', '.join(lost)}" if lost else "")
    return Result("success", sum(wins), "of 10", detail, Goal(9, at_least=True))


ROWS = (
    _core_row("ik", Goal(3), "trac_ik", "TRAC-IK (one solution)"),
    Row("ik_kdl", "inverse kinematics by KDL", _ik_kdl),
    Row("physics", "physics of a ten-object trial against real time", _physics),
    _core_row("physics_awake", None, "pybullet_physics", "pybullet, 240 Hz"),
    _core_row("depth_frame", Goal(25), "pybullet_depth", "pybullet TinyRenderer, no noise"),
    _core_row("color_frame", None),
    _core_row("scene", None),
    _core_row("planning", None),
    _core_row("hand_eye", Goal(6)),
    Row("hand_eye_error", "hand-eye error on noisy pairs against ViSP", _hand_eye_error),
    Row("hand_eye_time", "hand-eye refinement against ViSP's time", _hand_eye_time),
    Row("calibration", "error of whole calibrations with images, seeds 0-19", _calibration),
    _iwgnet_row("iwgnet", "IWGNet on one window, fastest backend", "auto", "ggcnn", Goal(6)),
    _iwgnet_row("iwgnet_grconvnet", "the same beside GR-ConvNet", "auto", "grconvnet"),
    *(
        _iwgnet_row(f"iwgnet_{backend}", f"IWGNet on {backend}", backend, "ggcnn")
        for backend in ("openvino", "onnxruntime", "torch")
    ),
    Row("iwgnet_ten", "IWGNet on the ten windows of a look", _iwgnet_ten),
    Row("detector", "the detector on one image", _detector),
    Row("look", "detection, IWGNet and order of a pile of ten", _look),
    Row("labels", "labelled samples from settled scenes", _labels),
    Row("trial_in_process", "ten-object trials in one process on one core", _trial_in_process),
    Row("trial_ros", "the five-object trial in one command", _trial_ros),
    Row("trial_ros_speed", "the five-object trial against real time", _trial_ros_speed),
    Row("success", "five-object trials, seeds 0-9, by the judge", _success),
)
