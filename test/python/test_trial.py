"""The supervisor's cycle and trial.json, on a table that exists in this file only."""

import json
from pathlib import Path

import pytest

from iwgnet_grasp.perception.types import GraspRectangle
from iwgnet_grasp.supervisor import (
    CellError,
    Outcome,
    Target,
    clear_table,
    execution_order,
    load_settings,
)
from iwgnet_grasp.trials.record import run_trial, summary_line, write_json

CONFIG = Path(__file__).resolve().parents[2] / "config"
PICK_SECONDS = 8.0
PUSH_SECONDS = 3.0


class Table:
    """A Cell whose objects need a given number of tries; None: no grasp on it ever is feasible.
    Their grasps have a quality of 1, after each push that of the next of `qualities`."""

    def __init__(
        self, tries, fatal_pick=None, error=None, qualities=(1.0,), no_push="", no_way_to=()
    ):
        self.tries = dict(enumerate(tries))
        self.no_way_to = list(no_way_to)  # objects, once for each grasp on them that is refused
        self.clock = 0.0
        self.looks = 0
        self.executed = []
        self.failed_seen, self.taken_seen = [], []
        self.fatal_pick, self.error = fatal_pick, error
        self.picks = []  # the judge's
        self.qualities, self.no_push, self.pushed = list(qualities), no_push, []

    def look(self):
        self.looks += 1
        return self.looks

    def plan(self, scene_id, failed, taken=()):
        self.failed_seen.append(list(failed))
        self.taken_seen.append(list(taken))
        return [
            Target(
                scene_id,
                i,
                "connecting_rod",
                0.9,
                1.0 - 0.1 * i,
                GraspRectangle(10.0 * i, 5.0, 0.1, 20.0, 0.8, 0.58),
                feasible=tries is not None,
                reason="" if tries is not None else "fingers collide",
                quality=self.qualities[0],
            )
            for i, tries in self.tries.items()
        ]

    def execute(self, target, tray_slot):
        if self.fatal_pick is not None and len(self.executed) == self.fatal_pick:
            raise self.error
        if target.object_id in self.no_way_to:
            self.no_way_to.remove(target.object_id)
            return Outcome(False, "no_plan", "way to the tray: no path")
        self.executed.append((target.object_id, tray_slot))
        self.clock += PICK_SECONDS
        self.tries[target.object_id] -= 1
        success = self.tries[target.object_id] == 0
        if success:
            del self.tries[target.object_id]
        self.picks.append(
            {
                "part": target.object_id if success else -1,
                "success": success,
                "reason": "" if success else "missed",
                "slip_mm": 0.25,
                "slip_deg": 0.5,
                "grip_time": self.clock - 5.0,
            }
        )
        return Outcome(success, "" if success else "missed")

    def push(self, scene_id):
        self.pushed.append(scene_id)
        self.clock += PUSH_SECONDS
        if self.no_push != "unreachable" and len(self.qualities) > 1:
            self.qualities.pop(0)
        return Outcome(not self.no_push, self.no_push)

    def time(self):
        return self.clock

    def verdict(self):
        left = len(self.tries)
        return {
            "success": left == 0 and all(p["success"] for p in self.picks),
            "parts": left + sum(p["success"] for p in self.picks),
            "in_tray": sum(p["success"] for p in self.picks),
            "on_table": left,
            "lost": 0,
            "picks": self.picks,
            "collisions": [],
        }


def quiet(_line):
    pass


def test_every_replan_looks_again_after_each_pick_and_ends_when_nothing_is_seen():
    table = Table([1, 1, 1])
    cycle = clear_table(table, load_settings(CONFIG, replan="every"), quiet)
    assert cycle.ended == "cleared"
    assert table.executed == [(0, 0), (1, 1), (2, 2)]
    assert cycle.looks == 4  # the last one finds the table empty


def test_once_replan_takes_one_look_and_tries_each_object_once():
    table = Table([1, 2, 1])
    cycle = clear_table(table, load_settings(CONFIG, replan="once"), quiet)
    assert cycle.ended == "sequence_done"
    assert cycle.looks == 1
    assert [o for o, _ in table.executed] == [0, 1, 2]
    assert not cycle.attempts[1].outcome.success
    assert table.taken_seen == [[], [0], [0], [0, 2]]  # what failed still lies there


def test_good_grasps_go_by_priority_and_doubtful_ones_come_last_best_first():
    grasp = GraspRectangle(10.0, 5.0, 0.1, 20.0, 0.8, 0.58)
    qualities = {0: 0.1, 1: 0.5, 2: 0.2, 3: 0.9, 4: 0.9}
    targets = [
        Target(1, i, "connecting_rod", 0.9, 1.0 - 0.1 * i, grasp, i != 4, quality=q)
        for i, q in qualities.items()
    ]
    for least, order in ((0.3, [1, 3, 2, 0]), (0.0, [0, 1, 2, 3])):
        settings = load_settings(CONFIG, min_quality=least)
        assert [t.object_id for t in execution_order(targets, settings)] == order


def test_in_a_sequence_from_one_look_what_lies_under_another_object_waits_for_it():
    grasp = GraspRectangle(10.0, 5.0, 0.1, 20.0, 0.8, 0.58)
    targets = [
        Target(1, i, "connecting_rod", 0.9, 0.5, grasp, True, quality=q, covered_px=c)
        for i, (q, c) in enumerate([(0.9, 40), (0.9, 30), (0.1, 12), (0.9, 14)])
    ]
    for replan, order in (("once", [3, 2, 1, 0]), ("every", [0, 1, 3, 2])):
        settings = load_settings(CONFIG, replan=replan, min_quality=0.3, max_covered_px=15)
        assert [t.object_id for t in execution_order(targets, settings)] == order


def test_where_no_grasp_is_good_an_object_is_pushed_aside_and_it_looks_again():
    table = Table([1], qualities=[0.02, 0.05, 0.9])
    said = []
    settings = load_settings(CONFIG, replan="every", push_below=0.1, max_pushes=2)
    cycle = clear_table(table, settings, said.append)
    assert cycle.ended == "cleared" and cycle.pushes == 2
    assert table.pushed == [1, 2] and cycle.attempts[0].target.scene_id == 3
    assert len(said) == 3 and "Q 0.02" in said[0]


def test_pushes_in_a_row_are_bounded_and_one_that_cannot_be_done_ends_nothing():
    settings = load_settings(CONFIG, replan="every", push_below=0.1, max_pushes=2)
    table = Table([1, 1], qualities=[0.02])
    cycle = clear_table(table, settings, quiet)
    assert cycle.ended == "cleared" and cycle.pushes == 4  # two before each of two picks
    stuck = Table([1], qualities=[0.02], no_push="unreachable")
    cycle = clear_table(stuck, settings, quiet)
    assert cycle.ended == "cleared" and cycle.pushes == 0 and len(stuck.executed) == 1


def test_after_a_push_that_broke_off_it_looks_again():
    settings = load_settings(CONFIG, replan="every", push_below=0.1, max_pushes=2)
    table = Table([1], qualities=[0.02, 0.9], no_push="execution_failed")
    cycle = clear_table(table, settings, quiet)
    assert cycle.ended == "cleared" and cycle.pushes == 1 and table.pushed == [1]
    assert cycle.attempts[0].target.scene_id == 2


def test_one_look_has_no_pushes():
    table = Table([1], qualities=[0.02])
    cycle = clear_table(table, load_settings(CONFIG, replan="once", push_below=0.1), quiet)
    assert table.pushed == [] and len(cycle.attempts) == 1


def test_a_failed_grasp_is_told_to_the_next_plan_and_its_tray_slot_is_used_again():
    table = Table([2, 1])
    cycle = clear_table(table, load_settings(CONFIG, replan="every"), quiet)
    assert table.executed == [(0, 0), (0, 0), (1, 1)]
    assert table.failed_seen[0] == []
    assert table.failed_seen[1] == [cycle.attempts[0].target.grasp]


@pytest.mark.parametrize("replan", ["once", "every"])
def test_a_grasp_without_a_motion_is_set_aside_and_is_no_attempt(replan, tmp_path):
    table = Table([1, 1], no_way_to=[0, 0])
    trial = trial_of(table, tmp_path, replan)
    cycle = trial.cycle
    assert table.executed == [(0, 0), (1, 1)] and trial.success
    assert table.failed_seen[2] == [a.target.grasp for a in cycle.set_aside]
    assert cycle.attempts[0].target.scene_id == 1  # of the same look
    written = json.loads((tmp_path / "trial.json").read_text())
    assert [entry["reason"] for entry in written["set_aside"]] == ["no_plan", "no_plan"]
    assert len(written["picks"]) == 2


def test_grasps_that_are_set_aside_are_bounded_too():
    settings = load_settings(CONFIG, replan="every", max_attempts=5)
    cycle = clear_table(Table([1], no_way_to=[0] * 9), settings, quiet)
    assert cycle.ended == "attempts_used_up" and len(cycle.set_aside) == 5


def test_the_cycle_gives_up_when_nothing_is_graspable():
    table = Table([None, None])
    said = []
    settings = load_settings(CONFIG, replan="every", max_idle_looks=3, max_pushes=0)
    cycle = clear_table(table, settings, said.append)
    assert cycle.ended == "nothing_graspable"
    assert table.looks == 3
    assert len(said) == 2 and all("fingers collide" in line for line in said)


def test_attempts_are_bounded():
    cycle = clear_table(Table([1000]), load_settings(CONFIG, replan="every", max_attempts=7), quiet)
    assert cycle.ended == "attempts_used_up"
    assert len(cycle.attempts) == 7


def test_a_pick_prints_one_line():
    lines = []
    clear_table(Table([2]), load_settings(CONFIG, replan="every"), lines.append)
    assert len(lines) == 2
    assert "failed (missed)" in lines[0] and "picked" in lines[1]
    assert not any("\n" in line for line in lines)


def trial_of(table, out, replan="every"):
    return run_trial(
        table,
        load_settings(CONFIG, replan=replan),
        scene="five_scattered",
        seed=3,
        transport="in_process",
        backends={"grasps": "torch"},
        out=out,
        judge=table.verdict,
        say=quiet,
    )


def test_trial_json_holds_the_judges_word_for_each_pick(tmp_path):
    trial = trial_of(Table([1, 1]), tmp_path)
    written = json.loads((tmp_path / "trial.json").read_text())
    assert written == trial.to_json()
    assert trial.success and written["success"] is True
    assert (written["scene"], written["seed"], written["replan"]) == ("five_scattered", 3, "every")
    assert written["backends"] == {"grasps": "torch"}
    assert written["transport"] == "in_process"
    assert written["objects"] == 2
    assert written["sim_time_s"] == pytest.approx(2 * PICK_SECONDS)
    assert written["wall_time_s"] >= written["computing_time_s"] >= 0
    for i, pick in enumerate(written["picks"]):
        assert pick["object"] == i and pick["success"] is True and pick["reason"] == ""
        assert pick["slip_mm"] == 0.25 and pick["slip_deg"] == 0.5
    assert "SUCCESS" in summary_line(trial)


def test_the_judge_overrules_the_robot(tmp_path):
    table = Table([1])
    honest = table.verdict

    def verdict():
        v = honest()
        for pick in v["picks"]:
            pick.update(success=False, reason="slipped", slip_mm=7.5)
        v["success"] = False
        return v

    table.verdict = verdict
    trial = trial_of(table, tmp_path)
    pick = trial.to_json()["picks"][0]
    assert table.executed and not trial.success
    assert pick["success"] is False and pick["reason"] == "slipped" and pick["slip_mm"] == 7.5


def test_a_trial_that_breaks_off_leaves_its_picks_and_the_reason(tmp_path):
    error = CellError("/simulator/load_scene: no answer; start the simulator")
    trial = trial_of(Table([1, 1, 1], fatal_pick=2, error=error), tmp_path)
    written = json.loads((tmp_path / "trial.json").read_text())
    assert len(written["picks"]) == 2
    assert written["success"] is False and written["ended"] == "error"
    assert "start the simulator" in written["error"] and "start the simulator" in summary_line(
        trial
    )


def test_an_interrupted_trial_is_written_before_the_interrupt_goes_on(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        trial_of(Table([1, 1], fatal_pick=1, error=KeyboardInterrupt()), tmp_path)
    written = json.loads((tmp_path / "trial.json").read_text())
    assert len(written["picks"]) == 1 and written["error"] == "interrupted"
    assert written["success"] is False


def test_a_json_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "trial.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["trial.json"]


def test_bad_settings_are_named(tmp_path):
    with pytest.raises(ValueError, match="twice"):
        load_settings(CONFIG, replan="twice")
    with pytest.raises(ValueError, match="tray_slots"):
        load_settings(CONFIG, tray_slots=0)
    (tmp_path / "supervisor.yaml").write_text("max_atempts: 3\n")
    with pytest.raises(ValueError, match="max_atempts"):
        load_settings(tmp_path)
    (tmp_path / "supervisor.yaml").write_text("replan: every\n")
    with pytest.raises(ValueError, match="missing"):
        load_settings(tmp_path)
    with pytest.raises(ValueError, match="cannot be read"):
        load_settings(tmp_path / "nowhere")
