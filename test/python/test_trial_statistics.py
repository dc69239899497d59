"""Rates, intervals, causes of failure and the table of many trials."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwgnet_grasp.trials.statistics import causes, summarise, summary, wilson_interval
from iwgnet_grasp.trials.table import cause_rows, success_rows


def pick(success=True, reason="", **more):
    slip = {"slip_mm": 0.2, "slip_deg": 0.4, "placement_mm": 3.0}
    return {"success": success, "reason": reason, **slip, **more}


def record(picks, scene="ten_stacked", seed=0, objects=None, **more):
    good = sum(p["success"] for p in picks)
    objects = len(picks) if objects is None else objects
    record = {
        "scene": scene,
        "seed": seed,
        "transport": "in_process",
        "success": good == len(picks) == objects,
        "objects": objects,
        "in_tray": good,
        "on_table": objects - good,
        "lost": 0,
        "collisions": [],
        "picks": picks,
        "ended": "cleared",
        "error": "",
        "sim_time_s": 4.0 * len(picks),
        "computing_time_s": 0.5 * len(picks),
        "wall_time_s": 1.0 * len(picks),
    }
    return {**record, **more}


@given(st.integers(1, 200), st.data())
def test_wilson_bounds_are_where_the_score_test_just_rejects(trials, data):
    successes = data.draw(st.integers(0, trials))
    rate = successes / trials
    low, high = wilson_interval(successes, trials)
    assert 0 <= low <= rate + 1e-12 and rate - 1e-12 <= high <= 1
    for bound in (low, high):
        if 1e-9 < bound < 1 - 1e-9:  # |rate - p| = z sqrt(p (1 - p) / n) (Wilson 1927)
            spread = math.sqrt(bound * (1 - bound) / trials)
            assert abs(rate - bound) == pytest.approx(1.959964 * spread, rel=1e-6, abs=1e-9)


def test_wilson_of_the_papers_trials_and_of_none():
    # Agresti & Coull (1998): with no failure the lower bound is n / (n + z^2).
    assert wilson_interval(50, 50)[0] == pytest.approx(50 / (50 + 1.959964**2))
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_causes_are_named_in_order_of_time_and_only_for_failed_trials():
    assert causes(record([pick(), pick()])) == []
    failed = record([pick(False, "missed"), pick(False, "slipped"), pick()], on_table=0)
    assert causes(failed) == ["missed", "slipped"]
    assert causes(record([pick(False, "not_in_tray")], on_table=0, lost=0)) == ["dropped"]
    assert causes(record([pick(False, "no_plan")])) == ["no plan", "not detected"]


def test_parts_that_stay_are_not_detected_or_without_a_grasp():
    assert causes(record([pick()], objects=2)) == ["not detected"]
    assert causes(record([pick()], objects=2, ended="nothing_graspable")) == ["no grasp"]
    aside = [pick(False, "no_plan"), pick(False, "unreachable")]
    stuck = record([pick()], objects=2, ended="nothing_graspable", set_aside=aside)
    assert causes(stuck) == ["unreachable"]
    assert causes(record([pick()], objects=2, on_table=0, lost=1)) == ["knocked away"]


def test_a_collision_or_an_error_fails_a_trial_of_good_picks():
    collided = record([pick()], success=False, collisions=["forearm - camera at 3.0 s, 20 N"])
    assert causes(collided) == ["collided"]
    assert causes(record([pick()], success=False, error="node died")) == ["error"]


def test_a_summary_counts_trials_attempts_objects_and_hours():
    records = [
        record([pick()] * 10, seed=1),
        record([pick()] * 9 + [pick(False, "dropped"), pick()], seed=2, objects=10, on_table=0),
    ]
    s = summarise(records)
    assert (s["trials"], s["successes"]) == (2, 1)
    assert (s["attempts"], s["good_attempts"]) == (21, 20)
    assert s["gsr"] == pytest.approx(20 / 21)
    assert s["cleared"] == 1.0
    assert s["picks_per_hour"] == pytest.approx(20 / (21 * 4.5) * 3600)
    assert s["failed_trials_by_cause"] == {"dropped": 1}
    assert s["failed_seeds"] == {"2": ["dropped"]}
    assert s["slip_mm"] == {"median": 0.2, "p95": 0.2, "max": 0.2}


def test_computation_costs_picks_only_where_the_cells_clock_stood_still_meanwhile():
    # 2 picks in 8 s on the cell's clock and 1 s of computing.
    assert summarise([record([pick()] * 2)])["picks_per_hour"] == pytest.approx(2 * 3600 / 9)
    over_ros = summarise([record([pick()] * 2, transport="ros")])
    assert over_ros["picks_per_hour"] == pytest.approx(2 * 3600 / 8)


def test_the_average_is_over_scenes_as_in_the_paper():
    records = [
        record([pick()], scene="five_scattered"),
        record([pick()], scene="ten_stacked"),
        record([pick(False, "missed")], scene="ten_stacked", seed=1),
    ]
    result = summary(records, ["five_scattered", "ten_stacked"])
    assert result["average_success_rate"] == pytest.approx(0.75)
    head, rows = success_rows(result)
    assert [len(row) for row in rows] == [len(head)] * 3
    assert rows[1][1] == "1/2" and rows[1][4] == "43/50 (86.0 %)"
    head, rows = cause_rows(result)
    assert rows[1][head.index("missed")] == "1" and rows[1][head.index("seeds")] == "1"


def test_a_table_of_no_trial_claims_nothing():
    result = summary([], ["ten_stacked"])
    assert result["average_success_rate"] is None
    _, rows = success_rows(result)
    assert rows[0][1] == "0/0" and rows[0][2] == ""
