"""One graph for all tests of this folder, on a ROS master of their own."""

from __future__ import annotations

import os

import pytest

from iwgnet_grasp.ros.session import Session, free_master_uri


@pytest.fixture(scope="session")
def graph(tmp_path_factory):
    """The graph without perception (tests publish topic 2 themselves); its Session."""
    os.environ.pop("PYTHONUNBUFFERED", None)  # as on most machines
    os.environ["ROS_MASTER_URI"] = free_master_uri()
    log_dir = tmp_path_factory.mktemp("ros_log")
    os.environ["ROS_LOG_DIR"] = str(log_dir)
    with Session("grasping.launch", ["perception:=false"], log_dir) as session:
        import rospy

        rospy.init_node("test", disable_signals=True)
        yield session
        rospy.signal_shutdown("tests are over")


@pytest.fixture(autouse=True)
def _graph_survives(graph):
    """No test may bring a node down."""
    yield
    graph.check()
