#!/usr/bin/env python3
"""Runs one trial on the graph that is up, and ends with its result: status 0 success, 1 failure.

Parameters: ~replan (every | once), ~scene and ~seed of a simulation ('' leaves the table as it is;
its empty state must have been captured), ~out (folder for trial.json, optional), ~config_dir.
"""

import os
import signal
import sys
from pathlib import Path

import rosgraph
import rospy
from iwgnet_grasp.msg import Topics

from iwgnet_grasp.progress import interrupt_on
from iwgnet_grasp.supervisor import CellError, load_settings
from iwgnet_grasp.trials.record import run_trial, summary_line
from iwgnet_grasp.trials.ros import RosCell

PACKAGE_CONFIG = Path(__file__).resolve().parents[1] / "config"


def simulator_runs() -> bool:
    try:
        rosgraph.Master(rospy.get_name()).lookupService(Topics.JUDGE)
        return True
    except rosgraph.MasterError:
        return False


def main() -> int:
    rospy.init_node("supervisor", disable_signals=True)
    interrupt_on(signal.SIGTERM)
    out = rospy.get_param("~out", "")
    scene = rospy.get_param("~scene", "")
    seed = rospy.get_param("~seed", 0)
    try:
        settings = load_settings(
            rospy.get_param("~config_dir", str(PACKAGE_CONFIG)),
            replan=rospy.get_param("~replan", "every"),
        )
        simulated = bool(scene) or simulator_runs()
        cell = RosCell(simulated)
        cell.wait_until_ready()
        if scene:
            cell.load(scene, seed)
        trial = run_trial(
            cell,
            settings,
            scene=scene or "as_found",
            seed=seed,
            transport="ros",
            out=Path(os.path.expanduser(out)) if out else None,
            judge=cell.judge if simulated else None,
            say=lambda line: print(line, flush=True),
        )
    except KeyboardInterrupt:
        rospy.logerr("interrupted")
        return 1
    except (CellError, ValueError, OSError) as error:
        rospy.logerr(str(error))
        return 1
    finally:
        rospy.signal_shutdown("the trial is over")
    print(summary_line(trial), flush=True)
    return 0 if trial.success else 1


if __name__ == "__main__":
    sys.exit(main())
