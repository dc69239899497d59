"""Ray: workers on this machine or on a cluster. Needs the package `ray`, imported when used."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from typing import Any

ANSWER_SECONDS = 10.0  # that a cluster has to answer in


class ClusterError(RuntimeError):
    """A cluster that cannot be used; one line."""


def connect(address: str | None, workers: int) -> Any:
    """The module `ray`, connected; end with its shutdown(). Raises ClusterError.

    address: HOST:PORT, ray://HOST:PORT or "auto", of a running cluster with at least `workers`
    cores whose machines have the checkout at this path; None: a Ray of our own on this machine.
    """
    import ray

    quiet = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:
        # "local": not one that happens to run here. The dashboard would cost as much as a worker.
        ray.init(address="local", num_cpus=workers, include_dashboard=False, **quiet)
        return ray
    if address != "auto":
        _knock(address)
    names = ("PYTHONPATH", "LD_LIBRARY_PATH")
    passed = {name: os.environ[name] for name in names if name in os.environ}
    try:
        ray.init(address=address, runtime_env={"env_vars": passed}, **quiet)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        raise ClusterError(f"no Ray cluster at {address}: {first_line(error)}") from None
    cores = int(ray.cluster_resources().get("CPU", 0))
    if cores < workers:
        ray.shutdown()
        raise ClusterError(f"the Ray cluster at {address} has {cores} cores for {workers} workers")
    return ray


def first_line(error: BaseException | None) -> str:
    """What an error says, without the traceback that Ray appends."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _knock(address: str) -> None:
    """Raises ClusterError unless a Ray cluster answers; ray.init waits long and then aborts."""
    client = address.startswith("ray://")
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise ClusterError(f"--address {address}: is not HOST:PORT, ray://HOST:PORT or auto")
    nobody = f"nobody answers at {address}; start Ray there: ray start --head"
    try:
        socket.create_connection((host, int(port)), ANSWER_SECONDS).close()
    except OSError as error:
        raise ClusterError(f"{nobody} ({first_line(error)})") from None
    if client:
        return
    check = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        done = subprocess.run(check, capture_output=True, text=True, timeout=ANSWER_SECONDS)
    except subprocess.TimeoutExpired:
        raise ClusterError(nobody) from None
    if "AuthenticationError" in done.stderr:
        raise ClusterError(
            f"the Ray cluster at {address} asks for a token: set RAY_AUTH_MODE=token here, or "
            "start it with RAY_AUTH_MODE=disabled on a network of your own"
        )
    if done.returncode != 0:
        raise ClusterError(f"{nobody} (something listens that is no Ray)")
