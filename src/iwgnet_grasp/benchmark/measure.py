"""Running and timing what the benchmark compares."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[3]
PEER_PACKAGES = ("numpy<2", "pybullet==3.2.7", "pytracik==0.0.3")


class BenchmarkError(RuntimeError):
    """A row cannot be measured: one line that says why."""


def core(*names: str) -> dict[str, dict]:
    """Rows of the C++ benchmark by name: {"value", "unit", "detail"}."""
    program = PACKAGE / ".build" / "devel" / "lib" / "iwgnet_grasp" / "core_benchmark"
    if not program.exists():
        raise BenchmarkError(f"{program} is missing; run scripts/setup")
    run = subprocess.run([program, PACKAGE, *names], capture_output=True, text=True, check=False)
    if run.returncode != 0:
        raise BenchmarkError(last_line(run.stderr) or f"core_benchmark ended with {run.returncode}")
    rows = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    return {row["name"]: row for row in rows}


def peer(script: str, *arguments: str) -> dict:
    """The JSON object that peers/SCRIPT.py prints, run in a virtual environment of its own."""
    folder = PACKAGE / ".venv-peers"
    python = folder / "bin" / "python"
    stamp = folder / "packages"
    if not stamp.exists() or stamp.read_text() != repr(PEER_PACKAGES):
        for command in (
            ["/usr/bin/python3", "-m", "venv", str(folder)],
            [str(python), "-m", "pip", "install", "-q", *PEER_PACKAGES],
        ):
            run = subprocess.run(command, capture_output=True, text=True, check=False)
            if run.returncode != 0:
                raise BenchmarkError(f"peers: {last_line(run.stderr)}")
        stamp.write_text(repr(PEER_PACKAGES))
    path = Path(__file__).parent / "peers" / f"{script}.py"
    # The peer must not see this package's interpreter paths, whose NumPy it does not know.
    ours = ("PYTHONPATH", "LD_LIBRARY_PATH")
    environment = {k: v for k, v in os.environ.items() if k not in ours}
    run = subprocess.run(
        [python, path, PACKAGE, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    if run.returncode != 0:
        raise BenchmarkError(f"peer {script}: {last_line(run.stderr)}")
    return json.loads(run.stdout.splitlines()[-1])


def median_seconds(body: Callable[[], object], runs: int = 30, warm_up: int = 3) -> float:
    for _ in range(warm_up):
        body()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        body()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def command(words: list[str], timeout_s: float) -> subprocess.CompletedProcess:
    try:
        return subprocess.run(
            words, cwd=PACKAGE, capture_output=True, text=True, check=False, timeout=timeout_s
        )
    except subprocess.TimeoutExpired:
        raise BenchmarkError(f"{' '.join(words)}: no end after {timeout_s:.0f} s") from None


def last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1].strip() if lines else ""
