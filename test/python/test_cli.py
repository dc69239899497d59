"""Command line: help that teaches, errors in one line."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from iwgnet_grasp.networks import GRASP_NETWORKS

SOURCE = Path(__file__).resolve().parents[2] / "src"


def iwgnet(*arguments, cwd):
    environment = os.environ | {
        "PYTHONPATH": f"{SOURCE}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
        "COLUMNS": "200",
        "NO_COLOR": "1",
    }
    return subprocess.run(
        [sys.executable, "-m", "iwgnet_grasp.cli", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--help"], ["train", "dataset", "evaluate"]),
        (["train", "--help"], ["--resume", "--seed", "detector", *GRASP_NETWORKS]),
    ],
)
def test_help(arguments, words, tmp_path):
    result = iwgnet(*arguments, cwd=tmp_path)
    assert result.returncode == 0
    assert all(word in result.stdout for word in words)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["train", "--data", "absent"], "error: absent: no such folder"),
        (["evaluate", "--weights", "absent/x"], "error: absent/x: no such weight file"),
        (["train", "--network", "resnet"], "resnet"),
    ],
)
def test_bad_requests_end_in_one_line_and_exit_code_2(arguments, message, tmp_path):
    result = iwgnet(*arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
