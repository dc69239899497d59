"""A goal to an action server, without the race of actionlib's SimpleActionClient: that one loses a
result which comes back before its send_goal() has returned."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from actionlib import ActionClient, CommState


class Goal:
    """A goal that was sent; `done` is set when its result has come.

    on_done is called then, from a thread of rospy. Keep the object: dropping it drops the goal.
    """

    def __init__(
        self, client: ActionClient, goal: Any, on_done: Callable[[], None] = lambda: None
    ) -> None:
        self.done = threading.Event()
        self._on_done = on_done
        self._last: Any = None
        self._handle = client.send_goal(goal, self._transition)

    def _transition(self, handle: Any) -> None:
        if handle.get_comm_state() == CommState.DONE:
            self._last = handle
            self.done.set()
            self._on_done()

    def cancel(self) -> None:
        self._handle.cancel()

    @property
    def status(self) -> int:
        """Constant of actionlib_msgs/GoalStatus, once done."""
        return self._last.get_goal_status()

    @property
    def result(self) -> Any:
        """The server's result once done; None when it gave none."""
        return self._last.get_result()
