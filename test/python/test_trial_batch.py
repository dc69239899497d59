"""Runs of many trials: what their folder keeps, how they go on, what stops them.

The trials here clear a table that exists in this file only; one test runs real ones.
"""

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from test_trial_statistics import pick, record

from iwgnet_grasp.cluster import ClusterError, connect
from iwgnet_grasp.files import sole_writer
from iwgnet_grasp.overrides import changed_config
from iwgnet_grasp.supervisor import CellError
from iwgnet_grasp.trials import batch
from iwgnet_grasp.trials.batch import BatchError, Run, read_records, read_run, run_trials
from iwgnet_grasp.trials.command import chosen_scenes
from iwgnet_grasp.trials.comparison import (
    compare,
    named_comparison,
    read_comparison,
    sweep,
)
from iwgnet_grasp.trials.pool import PoolError, run_with_ray
from iwgnet_grasp.trials.worker import PACKAGE, Conditions, InProcessWorker

RUN = Run(("five_scattered", "ten_stacked"), 2, 10)


class Table:
    """A worker whose trials succeed at even seeds."""

    ran: list = []
    fails_at: tuple | None = None
    error: BaseException | None = None

    def run(self, scene, seed):
        if (scene, seed) == self.fails_at:
            raise self.error
        self.ran.append((scene, seed))
        picks = [pick(seed % 2 == 0, "" if seed % 2 == 0 else "missed")]
        return record(picks, scene=scene, seed=seed, on_table=0)

    def close(self):
        pass


@pytest.fixture
def table(monkeypatch):
    table = Table()
    table.ran = []
    monkeypatch.setattr(batch, "make_worker", lambda conditions, log_dir: table)
    return table


def test_a_run_leaves_a_line_a_trial_and_a_summary(tmp_path, table):
    summary = run_trials(RUN, tmp_path / "run")
    assert table.ran == RUN.tasks()
    records = read_records(tmp_path / "run")
    assert [(r["scene"], r["seed"]) for r in records] == RUN.tasks()
    assert summary["scenes"]["ten_stacked"]["successes"] == 1
    assert summary == json.loads((tmp_path / "run" / "summary.json").read_text())
    assert read_run(tmp_path / "run") == RUN


@pytest.mark.parametrize("error", [KeyboardInterrupt(), PoolError("the worker died")])
def test_a_run_that_broke_off_goes_on_with_what_is_missing(tmp_path, table, error):
    table.fails_at, table.error = ("five_scattered", 11), error
    with pytest.raises(type(error)):
        run_trials(RUN, tmp_path)
    assert len(read_records(tmp_path)) == 2
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["all"]["trials"] == 2
    table.fails_at, table.ran = None, []
    assert run_trials(RUN, tmp_path)["all"]["trials"] == 4
    assert table.ran == [("five_scattered", 11), ("ten_stacked", 11)]


def test_a_line_that_was_cut_off_is_run_again(tmp_path, table):
    run_trials(RUN, tmp_path)
    path = tmp_path / "trials.jsonl"
    path.write_text(path.read_text()[:-20])
    table.ran = []
    assert run_trials(RUN, tmp_path)["all"]["trials"] == 4
    assert table.ran == RUN.tasks()[-1:]
    assert len(path.read_text().splitlines()) == 4


def test_a_finished_run_may_grow_but_not_shrink(tmp_path, table):
    run_trials(RUN, tmp_path)
    table.ran = []
    assert run_trials(replace(RUN, trials=3), tmp_path)["all"]["trials"] == 6
    assert table.ran == [("five_scattered", 12), ("ten_stacked", 12)]
    with pytest.raises(BatchError, match="give as many or more"):
        run_trials(RUN, tmp_path)


@pytest.mark.parametrize(
    "other, says",
    [
        (replace(RUN, first_seed=11), "first_seed is 10 there, 11 here"),
        (replace(RUN, scenes=("ten_stacked",)), "scenes"),
        (replace(RUN, conditions=Conditions("once")), "replan"),
        (replace(RUN, conditions=Conditions(overrides={"priority.alpha": 2.0})), "overrides"),
    ],
)
def test_the_folder_of_another_run_is_refused(tmp_path, table, other, says):
    run_trials(RUN, tmp_path)
    with pytest.raises(BatchError, match="holds another run") as caught:
        run_trials(other, tmp_path)
    assert says in str(caught.value) and "\n" not in str(caught.value)
    assert len(read_records(tmp_path)) == 4


def test_changed_weights_make_another_run(tmp_path, table):
    run_trials(RUN, tmp_path)
    path = tmp_path / "settings.json"
    settings = json.loads(path.read_text())
    settings["inputs"]["models/iwgnet.safetensors"] = "0" * 16
    path.write_text(json.dumps(settings))
    with pytest.raises(BatchError, match=r"models/iwgnet.safetensors changed since"):
        run_trials(RUN, tmp_path)


def test_a_folder_with_something_else_is_refused(tmp_path, table):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(BatchError, match="not empty"):
        run_trials(RUN, tmp_path)
    assert not table.ran


def test_two_runs_do_not_write_into_one_folder(tmp_path, table):
    run_trials(RUN, tmp_path)
    with sole_writer(tmp_path, BatchError), pytest.raises(BatchError, match="another run is writ"):
        run_trials(replace(RUN, trials=3), tmp_path)
    assert table.ran == RUN.tasks()
    assert read_run(tmp_path) == RUN


def test_a_run_of_no_trial_or_of_a_negative_seed_is_none():
    with pytest.raises(BatchError, match="--trials"):
        replace(RUN, trials=0)
    with pytest.raises(BatchError, match="--seed"):
        replace(RUN, first_seed=-1)


def test_scenes_are_named_once_each_and_known():
    assert chosen_scenes("ten_stacked,five_scattered") == ("ten_stacked", "five_scattered")
    assert set(chosen_scenes("all")) >= {"five_scattered", "seven_stacked", "ten_stacked"}
    with pytest.raises(BatchError, match="'nine_stacked' is not one of"):
        chosen_scenes("nine_stacked")


def test_a_sweep_is_every_combination():
    runs = sweep(["priority.alpha=0,1", "priority.beta=0.5,2"]).runs(RUN)
    assert [run.conditions.overrides for run in runs.values()] == [
        {"priority.alpha": a, "priority.beta": b} for a in (0, 1) for b in (0.5, 2)
    ]


@pytest.mark.parametrize(
    "axis, says",
    [
        ("priority.bta=1", "did you mean 'beta'"),
        ("perception.grasps.weights=models/iwgnet.safetensors,models/no.safetensors", "models/no"),
        ("supervisor.replan=once", "is --replan"),
    ],
)
def test_a_comparison_that_cannot_end_does_not_begin(tmp_path, axis, says):
    with pytest.raises(ValueError, match=says):
        compare(sweep([axis]), RUN, tmp_path / "out", lambda *_: pytest.fail("a trial ran"))
    assert not (tmp_path / "out").exists()


def test_a_comparison_runs_every_variant_on_the_same_seeds(tmp_path, table):
    result = compare(
        named_comparison("priority"), RUN, tmp_path, lambda run, out, _: run_trials(run, out)
    )
    assert table.ran == RUN.tasks() * 4
    assert [v["name"] for v in result["variants"]][0] == "random order"
    assert all(v["summary"]["all"]["trials"] == 4 for v in result["variants"])
    assert read_comparison(tmp_path) == result


def test_every_comparison_of_the_package_sets_existing_keys():
    for name in ("priority", "replan", "networks"):
        runs = named_comparison(name).runs(RUN)
        for run in runs.values():
            with changed_config(PACKAGE / "config", run.conditions.overrides):
                pass
        assert len(set(map(repr, runs.values()))) == len(runs) >= 2  # and each differs
    assert named_comparison("replan").runs(RUN)["once (paper)"].conditions.replan == "once"
    with pytest.raises(BatchError, match="did you mean 'priority'"):
        named_comparison("prioritty")


class MortalTable(Table):
    """Dies in the midst of each seed that is named in a file, which it strikes out there."""

    def __init__(self, folder):
        self.folder = Path(folder)

    def run(self, scene, seed):
        doom = self.folder / str(seed)
        if doom.exists():
            lives = int(doom.read_text())
            doom.write_text(str(lives - 1))
            if lives > 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().run(scene, seed)


def test_ray_workers_share_the_trials_and_a_dead_one_is_replaced(tmp_path):
    from ray import cloudpickle

    for name in (__name__, pick.__module__):  # Ray's processes cannot import tests
        cloudpickle.register_pickle_by_value(sys.modules[name])
    tasks = [("ten_stacked", seed) for seed in range(6)]
    (tmp_path / "2").write_text("1")
    (tmp_path / "5").write_text("2")
    said, records = [], []
    with pytest.raises(PoolError, match="ten_stacked seed 5 died twice"):
        for done in run_with_ray(lambda: MortalTable(tmp_path), tasks, 2, say=said.append):
            records.append(done)
    assert sorted((r["scene"], r["seed"]) for r in records) == tasks[:5]
    assert sorted(line.split(";")[0] for line in said) == [
        "a worker died in ten_stacked seed 2",
        "a worker died in ten_stacked seed 5",
    ]


@pytest.mark.parametrize("address", ["127.0.0.1:9", "nowhere", "host:99999", "ray://127.0.0.1:9"])
def test_an_address_without_ray_is_one_line(address):
    with pytest.raises(ClusterError) as caught:
        connect(address, 1)
    assert address in str(caught.value) and "\n" not in str(caught.value)


def test_a_real_trial_is_replayed_to_the_bit_with_its_film(tmp_path):
    pytest.importorskip("iwgnet_grasp._core")
    from PIL import Image

    from iwgnet_grasp.trials.replay import differences, replay, write_replay

    conditions = Conditions(overrides={"scenes.five_scattered.count": 2})
    run_trials(Run(("five_scattered",), 1, 3, conditions), tmp_path / "run")
    (before,) = read_records(tmp_path / "run")
    assert before["objects"] == 2
    for good in (p for p in before["picks"] if p["success"]):
        assert good["placement_mm"] < 105  # in its slot or the next, not just somewhere in the tray

    result = replay(conditions, "five_scattered", 3)
    assert differences(before, json.loads(json.dumps(result.record))) == []
    times = [frame.time_s for frame in result.frames]
    assert len(times) == pytest.approx(before["sim_time_s"] / 0.25, abs=10)
    assert len(result.plans) == before["looks"]
    write_replay(result, tmp_path / "replay")
    film = Image.open(tmp_path / "replay" / "film.gif")
    assert film.n_frames > 0.8 * len(times)  # frames in which nothing moves may become one
    assert json.loads((tmp_path / "replay" / "trial.json").read_text()) == result.record


def test_a_setting_that_makes_no_sense_is_said_in_one_line():
    with pytest.raises(CellError, match="motion.yaml: key 'max_fall' must be positive") as caught:
        InProcessWorker(Conditions(overrides={"motion.max_fall": -1.0}))
    assert "\n" not in str(caught.value)
