"""The one command: arguments, weights, a whole trial, and trials that break off."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import rosbag
from iwgnet_grasp.msg import Topics

from iwgnet_grasp.ros.session import free_master_uri

ROOT = Path(__file__).resolve().parents[2]
STARTED = re.compile(r"process\[([\w/]+)-\d+\]: started with pid \[(\d+)\]")


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("scene:=nowhere", "five_scattered"),
        ("seed:=-1", "whole number"),
        ("replan:=sometimes", "every"),
        ("real_time:=yes", "true"),
        ("driver:=ur5", "simulation"),
        ("calibration:=/no/such/file.yaml", "/no/such/file.yaml"),
        ("speed:=3", "known:"),
    ],
)
def test_a_bad_argument_ends_with_status_2_and_one_line(argument, said):
    done = subprocess.run(
        [ROOT / "scripts/start_grasping", argument], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert said in done.stderr and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("content", [None, b"no weights at all"])
def test_perception_without_usable_weights_ends_in_one_line(graph, tmp_path, content):
    weights = tmp_path / "detector.safetensors"
    if content is not None:
        weights.write_bytes(content)
    config = (ROOT / "config/perception.yaml").read_text()
    config = config.replace("models/yolov5s.safetensors", str(weights))
    (tmp_path / "perception.yaml").write_text(config)
    done = subprocess.run(
        [ROOT / "scripts/perception_node.py", "__name:=weightless"]
        + [f"_config:={tmp_path / 'perception.yaml'}"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if "cannot start" in line]
    assert len(lines) == 1 and str(tmp_path / "detector") in lines[0]
    assert "Traceback" not in done.stderr


class Trial:
    """The trial of start_grasping, on a master of its own, without its call of scripts/setup."""

    def __init__(self, out: Path, **changes: str):
        self.out = out
        values = {
            "scene": "five_scattered",
            "seed": "0",
            "replan": "every",
            "real-time": "false",
            "rviz": "false",
            "record": "false",
            "driver": "simulation",
            **changes,
        }
        command = [sys.executable, "-m", "iwgnet_grasp.ros.grasping", "--out", str(out)]
        for name, value in values.items():
            command += [f"--{name}", value]
        self.process = subprocess.Popen(
            command,
            # As scripts/env.sh has it: the lines are read as they come.
            env={**os.environ, "PYTHONUNBUFFERED": "1", "ROS_MASTER_URI": free_master_uri()},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            # As a terminal starts it: a test run in the background of a script ignores SIGINT, and
            # its children would inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def wait_for_line(self, pattern: str) -> str:
        for line in self.process.stdout:
            if re.search(pattern, line):
                return line
        pytest.fail(f"the trial ended without a line with '{pattern}'")

    def nodes(self) -> dict[str, int]:
        log = (self.out / "log/roslaunch.log").read_text()
        return {name: int(pid) for name, pid in STARTED.findall(log)}

    def finish(self) -> tuple[int, str, dict]:
        text, _ = self.process.communicate(timeout=240)
        return self.process.returncode, text, json.loads((self.out / "trial.json").read_text())


def assert_all_gone(nodes: dict[str, int]) -> None:
    time.sleep(0.5)
    assert [name for name, pid in nodes.items() if Path(f"/proc/{pid}").exists()] == []


def test_a_whole_trial_clears_the_table_and_leaves_its_results(tmp_path):
    trial = Trial(tmp_path, replan="once", record="true")
    trial.wait_for_line("^pick  1")
    nodes = trial.nodes()
    code, text, record = trial.finish()
    assert code == (0 if record["success"] else 1)
    assert record["transport"] == "ros" and record["objects"] == 5
    assert set(record["backends"]) == {"detector", "masks", "pieces", "grasps", "outcomes"}
    assert record["in_tray"] >= 3, text  # how many is what the trials of docs/ measure
    assert len(record["picks"]) >= 4 and record["error"] == ""
    assert {pick["look"] for pick in record["picks"]} == {1}
    assert record["sim_time_s"] > record["wall_time_s"] * 0.5
    for name in ("scene", "boxes", "merged_depth", "grasps"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    assert_all_gone(nodes)
    with rosbag.Bag(str(tmp_path / "trial.bag")) as bag:
        topics = bag.get_type_and_topic_info().topics
        scenes = [message.seen_in for _, message, _ in bag.read_messages([Topics.SCENE])]
    assert scenes[0] == 0 and set(scenes[1:]) == {1}  # one look, then what is left of it
    numbered = [Topics.SCENE, Topics.GRASPS, Topics.GRASP_POSE, Topics.GRIPPER_WIDTH]
    numbered += [f"{action}/goal" for action in (Topics.ARM_ACTION, Topics.GRIPPER_ACTION)]
    for topic in (*numbered, Topics.JOINT_STATES, "/tf", "/tf_static"):
        assert topic in topics and topics[topic].message_count >= 1, topic


def test_a_node_killed_in_mid_trial_ends_it_with_a_line_and_a_result(tmp_path):
    trial = Trial(tmp_path)
    trial.wait_for_line("^pick  1")
    nodes = trial.nodes()
    os.kill(nodes["motion_control"], signal.SIGKILL)
    code, text, record = trial.finish()
    assert code == 1
    assert "motion_control died" in record["error"] and record["ended"] == "error"
    assert len(record["picks"]) >= 1
    assert "motion_control died" in text and "Traceback" not in text
    assert_all_gone(nodes)


def test_ctrl_c_stops_everything_and_keeps_what_was_done(tmp_path):
    trial = Trial(tmp_path)
    trial.wait_for_line("^pick  1")
    nodes = trial.nodes()
    trial.process.send_signal(signal.SIGINT)
    code, text, record = trial.finish()
    assert code == 1 and "interrupted" in text and "Traceback" not in text
    assert record["error"] == "interrupted" and len(record["picks"]) >= 1
    assert_all_gone(nodes)
