"""A ROS graph for as long as a `with` block lasts: master where none runs, nodes by roslaunch, and
nothing left behind afterwards."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import signal
import socket
import subprocess
import time
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import urlparse
from xmlrpc.client import ServerProxy, Transport

from iwgnet_grasp.supervisor import CellError

_TAG = "IWGNET_SESSION"  # environment variable by which a session knows its processes
_PR_SET_PDEATHSIG = 1
_DIED = re.compile(r"\[([\w/]+)-\d+\] process has died \[pid \d+, exit code (-?\d+)")
_NODE_STARTED = re.compile(r"process\[(?!master|rosout)[\w/]+-\d+\]: started")
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class Session:
    """roslaunch of a file of this package, in a `with` block.

    arguments: NAME:=VALUE of the launch file. log_dir: for the logs of roslaunch and of the nodes.
    optional: nodes that may end without ending the session. Sets ROS_MASTER_URI where the
    environment lacks it. Raises CellError when no master can be had.
    """

    def __init__(
        self,
        launch_file: str,
        arguments: Sequence[str],
        log_dir: Path,
        optional: Sequence[str] = ("rviz",),
    ) -> None:
        self._launch_file = launch_file
        self._arguments = list(arguments)
        self._log_dir = log_dir.resolve()
        self._optional = set(optional)
        self._tag = uuid.uuid4().hex
        self._roslaunch: subprocess.Popen | None = None
        os.environ.setdefault("ROS_MASTER_URI", "http://127.0.0.1:11311")
        if not {"ROS_IP", "ROS_HOSTNAME"} & os.environ.keys():
            os.environ["ROS_IP"] = "127.0.0.1"

    @property
    def log(self) -> Path:
        """What roslaunch and the nodes' stderr say."""
        return self._log_dir / "roslaunch.log"

    def __enter__(self) -> Session:
        uri = os.environ["ROS_MASTER_URI"]
        options = []
        if master_runs(uri):
            _refuse_second_graph(uri)
        else:
            options = ["--port", str(_port_for_master(uri))]
        try:
            self._log_dir.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise CellError(f"{self._log_dir}: is a file; the logs need a folder there") from None
        environment = {
            **os.environ,
            _TAG: self._tag,
            "ROS_LOG_DIR": str(self._log_dir),
            "ROSCONSOLE_FORMAT": "[${severity}] ${node}: ${message}",
            "PYTHONUNBUFFERED": "1",  # the log is read while roslaunch writes it
        }
        with self.log.open("wb") as log:
            self._roslaunch = subprocess.Popen(
                ["roslaunch", *options, "--sigint-timeout=5", "--sigterm-timeout=2"]
                + ["iwgnet_grasp", self._launch_file, *self._arguments],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # ctrl-C comes to us alone, we stop it in good order
                preexec_fn=stop_with_parent,
            )
        try:
            self._wait_for_nodes()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _wait_for_nodes(self, seconds: float = 60.0) -> None:
        """Until roslaunch starts nodes: the master is up then, and the parameters are set, of
        which rospy reads /use_sim_time only once."""
        end = time.monotonic() + seconds
        while not _NODE_STARTED.search(self.log.read_text(errors="replace")):
            self.check()
            if time.monotonic() > end:
                raise CellError(f"no node was started within {seconds:.0f} s; see {self.log}")
            time.sleep(0.05)

    def check(self) -> None:
        """Raises CellError when a node has died or the launch has failed."""
        assert self._roslaunch is not None
        text = _COLOUR.sub("", self.log.read_text(errors="replace"))
        for name, code in _DIED.findall(text):
            if name not in self._optional:
                raise CellError(f"node {name} died ({_ending(int(code))}){_last_words(text, name)}")
        if self._roslaunch.poll() is not None:
            said = re.findall(r"^\w*(?:Exception|Error): (.*)$", text, re.MULTILINE)
            why = said[0] if said else f"status {self._roslaunch.returncode}"
            raise CellError(f"roslaunch ended: {why} (see {self.log})")

    def __exit__(self, *_: object) -> None:
        with _uninterrupted():
            if self._roslaunch is not None and self._roslaunch.poll() is None:
                self._roslaunch.send_signal(signal.SIGINT)
                try:
                    self._roslaunch.wait(15.0)
                except subprocess.TimeoutExpired:
                    self._roslaunch.kill()
                    self._roslaunch.wait()
            # Nodes have process groups of their own; what outlived roslaunch is found by its tag.
            for wanted in (signal.SIGTERM, signal.SIGKILL):
                end = time.monotonic() + 3.0
                while (left := _tagged(self._tag)) and time.monotonic() < end:
                    for pid in left:
                        with contextlib.suppress(ProcessLookupError):
                            os.kill(pid, wanted)
                    time.sleep(0.1)


class _ImpatientTransport(Transport):
    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = 5.0  # s; something that listens need not answer
        return connection


def _proxy(uri: str) -> ServerProxy:
    return ServerProxy(uri, transport=_ImpatientTransport())


def master_runs(uri: str) -> bool:
    """Whether a ROS master answers at `uri` within seconds."""
    parts = urlparse(uri)
    try:
        socket.create_connection((parts.hostname, parts.port or 80), 1.0).close()
        code, *_ = _proxy(uri).getPid("/iwgnet_grasp")
        return code == 1
    except Exception:  # whatever else answers there is no ROS master
        return False


def free_master_uri() -> str:
    """A ROS_MASTER_URI on this machine at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


def _port_for_master(uri: str) -> int:
    parts = urlparse(uri)
    if not parts.hostname or not parts.port:
        raise CellError(f"ROS_MASTER_URI '{uri}' is not of the form http://HOST:PORT")
    if parts.hostname not in ("localhost", "127.0.0.1", socket.gethostname()) and (
        parts.hostname not in (os.environ.get("ROS_IP"), os.environ.get("ROS_HOSTNAME"))
    ):
        raise CellError(f"no ROS master at {uri}; start roscore there or unset ROS_MASTER_URI")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", parts.port))
        except OSError:
            raise CellError(
                f"port {parts.port} is taken by something that is no ROS master; set "
                f"ROS_MASTER_URI to a free one, such as {free_master_uri()}"
            ) from None
    return parts.port


def _refuse_second_graph(uri: str) -> None:
    """Nodes of one name push each other out of a master."""
    _, _, (publishers, subscribers, services) = _proxy(uri).getSystemState("/iwgnet_grasp")
    nodes = {node for _, names in publishers + subscribers + services for node in names}
    running = sorted(nodes & {"/simulator", "/motion_control", "/visual_acquisition"})
    if running:
        raise CellError(
            f"a graph with {running[0]} runs already at {uri}; stop it first, or set "
            f"ROS_MASTER_URI to another port, such as {free_master_uri()}"
        )


def _ending(code: int) -> str:
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"


def _last_words(text: str, node: str) -> str:
    """The node's last fatal message, as ': MESSAGE'."""
    said = re.findall(rf"^\[FATAL\] /?{re.escape(node)}: (.*)$", text, re.MULTILINE)
    return f": {said[-1].removeprefix(node + ': ')}" if said else ""


def stop_with_parent() -> None:
    """In the child: SIGINT when the parent dies, by whatever cause."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)


def _tagged(tag: str) -> list[int]:
    """Processes of this machine with the session's tag in their environment."""
    wanted = f"{_TAG}={tag}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with contextlib.suppress(OSError):
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z" and wanted in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
    return found


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """A second ctrl-C must not leave processes behind."""
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        for wanted in before:
            signal.signal(wanted, signal.SIG_IGN)
    except ValueError:  # not the main thread: no handlers here
        before = {}
    try:
        yield
    finally:
        for wanted, handler in before.items():
            signal.signal(wanted, handler)
