"""One trial on a graph of its own: what scripts/start_grasping runs.

Exit status: 0 success by the judge (on a real cell: by the robot's own word), 1 the trial failed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from iwgnet_grasp.progress import interrupt_on
from iwgnet_grasp.ros.session import Session
from iwgnet_grasp.supervisor import CellError, Settings, load_settings
from iwgnet_grasp.trials.pictures import Pictures
from iwgnet_grasp.trials.record import Trial, run_trial, summary_line, write_json

PACKAGE = Path(__file__).resolve().parents[3]
RECORDED = (  # topics of a bag: everything but the camera's raw images
    "/(clock|tf|tf_static|joint_states|visual_acquisition/.*|perception/.*|priority_planner/.*"
    "|spatial_transform/.*|supervisor/.*|motion_control/.*|gripper_control/.*|gripper/.*"
    "|scaled_pos_joint_traj_controller/.*|simulator/cell_markers)"
)


def run(options: argparse.Namespace, settings: Settings) -> Trial:
    """The trial; out/trial.json is written whatever happens after the graph's start."""
    simulated = options.driver == "simulation"
    scene = options.scene if simulated else "real"
    launch = [
        f"driver:={options.driver}",
        f"seed:={options.seed}",
        f"real_time:={options.real_time}",
        f"rviz:={options.rviz}",
        f"calibration:={options.calibration.resolve() if options.calibration else ''}",
        f"bag:={(options.out / 'trial.bag').resolve() if options.record else ''}",
        f"bag_topics:={RECORDED}",
        f"config_dir:={options.config_dir.resolve()}",
    ]
    if options.camera_offset >= 0:
        launch.append(f"camera_offset_seed:={options.camera_offset}")
    trial = Trial(scene, options.seed, settings.replan, "ros")
    try:
        with Session("grasping.launch", launch, options.out / "log") as session:
            trial = _on_graph(session, scene, simulated, options, settings)
    except CellError as error:
        trial.error = str(error)
        write_json(options.out / "trial.json", trial.to_json())
    except KeyboardInterrupt:
        if not (options.out / "trial.json").exists():
            trial.error = "interrupted"
            write_json(options.out / "trial.json", trial.to_json())
        raise
    return trial


def _on_graph(
    session: Session, scene: str, simulated: bool, options: argparse.Namespace, settings: Settings
) -> Trial:
    import rospy  # reads the session's environment

    from iwgnet_grasp.trials.ros import RosCell

    pictures = Pictures(options.out) if options.pictures else None
    os.environ["ROS_LOG_DIR"] = str(session.log.parent)
    # The supervisor is this process; its signals are main()'s.
    rospy.init_node("supervisor", disable_signals=True)
    try:
        cell = RosCell(simulated, session.check, on_plan=pictures and pictures.draw)
        cell.wait_until_ready()
        if simulated:
            cell.load(scene, options.seed)
        else:
            _ask("Clear the table, then press Enter to measure it empty. ")
            cell.measure_empty_table()
            _ask("Lay the parts on the table, then press Enter to start. ")
        return run_trial(
            cell,
            settings,
            scene=scene,
            seed=options.seed,
            transport="ros",
            backends=rospy.get_param("/perception/backends", {}),
            out=options.out,
            judge=cell.judge if simulated else None,
        )
    finally:
        rospy.signal_shutdown("the trial is over")
        if pictures:
            pictures.finish()


def _ask(prompt: str) -> None:
    try:
        input(prompt)
    except EOFError:
        raise CellError(
            "driver:=real asks for the table to be cleared and laid; run it in a terminal"
        ) from None


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="start_grasping")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--replan", required=True)
    parser.add_argument("--real-time", required=True)
    parser.add_argument("--rviz", required=True)
    parser.add_argument("--record", required=True)
    parser.add_argument("--driver", required=True)
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--camera-offset", type=int, default=-1)
    parser.add_argument("--config-dir", type=Path, default=PACKAGE / "config")
    parser.add_argument("--no-pictures", dest="pictures", action="store_false")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    options.record = options.record == "true"
    interrupt_on(signal.SIGTERM)
    try:
        settings = load_settings(options.config_dir, replan=options.replan)
        options.out.mkdir(parents=True, exist_ok=True)
        # Nothing of an older trial may pass for this one's.
        (options.out / "trial.json").unlink(missing_ok=True)
        for name in ("log", "looks"):
            shutil.rmtree(options.out / name, ignore_errors=True)
        trial = run(options, settings)
    except KeyboardInterrupt:
        print("start_grasping: interrupted; everything is stopped", file=sys.stderr)
        return 1
    except (OSError, ValueError) as error:
        print(f"start_grasping: {error}", file=sys.stderr)
        return 1
    print(summary_line(trial))
    print(f"results in {options.out}")
    return 0 if trial.success else 1


if __name__ == "__main__":
    sys.exit(main())
