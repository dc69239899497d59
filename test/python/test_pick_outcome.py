"""What becomes of a grasp: views of it, picks of real piles, and the network that foresees them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from iwgnet_grasp.data.errors import DataError
from iwgnet_grasp.data.pick_outcomes import (
    HEIGHT_STEP,
    PickedPile,
    encode_pile,
    height_image,
    make_picks,
    read_pile,
)
from iwgnet_grasp.data.pick_views import PickViewDataset, load_pick_views
from iwgnet_grasp.networks.pick_outcome import (
    OutcomeEstimator,
    PickOutcome,
    area_under_curve,
    outcome_loss,
)
from iwgnet_grasp.networks.weights import WeightsError
from iwgnet_grasp.perception.grasp_view import (
    CELL_PX,
    CHANNELS,
    HEIGHT_UNIT,
    VIEW_CELLS,
    grasp_view,
    without_gaps,
)
from iwgnet_grasp.perception.types import NOBODY, GraspRectangle
from iwgnet_grasp.training.outcome_training import OutcomeTrainingSettings, train_outcome_network

SHAPE = 300, 400
MIDDLE = (VIEW_CELLS - 1) / 2


def blank():
    return np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.uint8), np.full(SHAPE, NOBODY, np.int16)


# Views --------------------------------------------------------------------------------------------


@given(theta=st.floats(-1.57, 1.57), along=st.floats(-70, 70), across=st.floats(-70, 70))
def test_a_view_is_turned_with_the_jaws(theta, along, across):
    heights, grey, owners = blank()
    c, s = np.cos(theta), -np.sin(theta)  # image rows grow downwards
    x, y = 200 + along * c - across * s, 150 + along * s + across * c
    u, v = round(x), round(y)
    heights[v - 3 : v + 4, u - 3 : u + 4] = HEIGHT_UNIT
    view = grasp_view(heights, grey, owners, 0, GraspRectangle(200.0, 150.0, theta, 30.0, 1.0))
    rows, columns = np.nonzero(view[0] > 0.5)
    assert abs(columns.mean() - (MIDDLE + along / CELL_PX)) < 1
    assert abs(rows.mean() - (MIDDLE + across / CELL_PX)) < 1


def test_a_view_tells_own_pixels_from_others_and_shows_the_pads_beside_the_object():
    heights, grey, owners = blank()
    owners[140:160, 190:210] = 3
    owners[140:160, 230:250] = 1
    heights[100, 200] = np.nan
    view = grasp_view(heights, grey, owners, 3, GraspRectangle(199.5, 149.5, 0.0, 20.0, 1.0))
    assert view.shape == (CHANNELS, VIEW_CELLS, VIEW_CELLS) and view.dtype == np.float32
    _, measured, own, others, _, pads = view
    assert own.sum() == pytest.approx(100, abs=12) and others.sum() == pytest.approx(100, abs=12)
    assert not np.any(own * others) and not np.any(own * pads)
    assert np.count_nonzero(measured == 0) <= 1
    columns = np.nonzero(pads.any(0))[0]
    inner = np.abs(columns - MIDDLE).min() * CELL_PX
    assert 10 <= inner < 10 + CELL_PX  # half the width, to a cell
    np.testing.assert_array_equal(pads, pads[::-1, ::-1])


def test_only_lines_of_unmeasured_pixels_are_filled():
    heights = np.full((20, 20), 0.02, np.float32)
    heights[5] = np.nan
    heights[10:16, 10:16] = np.nan
    filled = without_gaps(heights)
    np.testing.assert_allclose(filled[5], 0.02, rtol=1e-5)
    assert np.isnan(filled[11:15, 11:15]).all() and np.isfinite(filled[:10]).all()


# Network ------------------------------------------------------------------------------------------


def test_the_network_gives_two_logits_for_each_view():
    assert PickOutcome().eval()(torch.zeros(3, CHANNELS, VIEW_CELLS, VIEW_CELLS)).shape == (3, 2)


def test_the_loss_is_least_for_the_truth():
    truth = torch.tensor([[1.0, 0.0], [1.0, 1.0]])
    assert outcome_loss(20 * (2 * truth - 1), truth) < 1e-4
    assert outcome_loss(torch.zeros(2, 2), truth) == pytest.approx(np.log(2))


def test_area_under_the_curve_is_the_share_of_pairs_in_the_right_order():
    rng = np.random.default_rng(0)
    scores, truth = torch.from_numpy(rng.random(40)), torch.from_numpy(rng.random(40) < 0.3)
    pairs = [(a > b).item() for a in scores[truth] for b in scores[~truth]]
    assert area_under_curve(scores, truth).item() == pytest.approx(np.mean(pairs))


# Picks and training -------------------------------------------------------------------------------


def write_piles(folder, count, seed=0):
    """Looks at bars; picks of a bar with a taller one beside it go wrong."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    (folder / "picks.json").write_text(json.dumps({"seed": seed, "piles": count}))
    for i in range(count):
        n = 8
        near = rng.random(n) < 0.5
        depth, owners = np.full((n, *SHAPE), 0.6, np.float32), np.full((n, *SHAPE), NOBODY, np.int8)
        depth[:, 100:200, 190:210] = 0.58
        owners[:, 100:200, 190:210] = 0
        depth[near, 120:180, 215:235] = 0.54
        pile = PickedPile(
            np.stack([height_image(d, np.full(SHAPE, 0.6, np.float32)) for d in depth]),
            rng.integers(90, 110, (n, *SHAPE)).astype(np.uint8),
            owners,
            np.arange(n),
            np.zeros(n, int),
            np.tile(np.float32([200, 150, 0, 20, 0.9]), (n, 1)),
            rng.random(n).astype(np.float32),
            ~near,
            np.zeros(n, int),
            np.zeros(n, int),
            np.where(near, 0.3, 0.0),
        )
        (folder / f"{i:06d}.npz").write_bytes(encode_pile(pile))
    return folder


def test_heights_are_kept_to_a_tenth_of_a_millimetre(tmp_path):
    folder = write_piles(tmp_path / "picks", 1)
    pile = read_pile(folder / "000000.npz")
    assert pile.heights.dtype == np.int16
    assert pile.heights[0, 150, 200] * HEIGHT_STEP == pytest.approx(0.02, abs=HEIGHT_STEP)
    holes = height_image(np.float32([[np.nan, 0.5]]), np.float32([[0.6, 0.6]]))
    assert holes[0, 0] == np.iinfo(np.int16).min and holes[0, 1] == 1000


def test_views_are_mirrored_but_keep_what_they_tell(tmp_path):
    folder = write_piles(tmp_path / "picks", 1)
    picks = load_pick_views([folder / "000000.npz"])
    assert len(picks) == 8
    sides = set()
    for i, seed in [(i, seed) for i in range(len(picks)) for seed in range(6)]:
        mirrored = PickViewDataset(picks, (seed,))
        view, outcome = mirrored[i]
        beside = view[0].numpy() > 0.8  # 40 mm
        assert beside.any() == (outcome[0] == 0) == (outcome[1] == 0)
        if beside.any():
            sides.add(np.nonzero(beside)[1].mean() > MIDDLE)
        assert torch.equal(mirrored[i][0], view)
    assert sides == {True, False}


def test_training_learns_what_lies_beside_goes_on_and_says_how_it_was_made(tmp_path):
    data = write_piles(tmp_path / "picks", 20)
    settings = OutcomeTrainingSettings(epochs=3, batch=16)
    logs = tmp_path / "logs"
    weights = train_outcome_network(settings, [data], tmp_path / "whole", logs)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["data"]["picks"] == 18 * 8 and card["data"]["validation_picks"] == 2 * 8
    assert card["validation"]["auc_good"] > 0.95
    assert card["data"]["training"][0]["piles"] == 20
    resumed = train_outcome_network(settings, [data], tmp_path / "again", logs, resume=True)
    assert resumed.read_bytes() == weights.read_bytes()  # it had ended: nothing is left to do
    with pytest.raises(DataError, match="epochs 3, not 4"):
        train_outcome_network(replace(settings, epochs=4), [data], tmp_path, logs, resume=True)
    picks = load_pick_views([data / "000019.npz"])
    good = OutcomeEstimator(weights).predict(picks.views.astype(np.float32))[:, 0]
    assert good.shape == (8,) and np.all((good >= 0) & (good <= 1))
    assert area_under_curve(torch.from_numpy(good), torch.from_numpy(picks.outcomes[:, 0])) > 0.9


def test_what_cannot_be_used_is_named(tmp_path, caplog):
    settings = OutcomeTrainingSettings(epochs=1)
    with pytest.raises(DataError, match="iwgnet picks"):
        train_outcome_network(settings, [tmp_path], tmp_path, tmp_path)
    one = write_piles(tmp_path / "one", 1)
    with pytest.raises(DataError, match="one pile is not enough"):
        train_outcome_network(settings, [one], tmp_path, tmp_path)
    whole = (one / "000000.npz").read_bytes()
    (one / "000001.npz").write_bytes(whole[: len(whole) // 2])
    assert len(load_pick_views(sorted(one.glob("*.npz")))) == 8
    assert "000001.npz: not a file of 'iwgnet picks'" in caplog.text
    with pytest.raises(WeightsError, match="iwgnet train outcome"):
        OutcomeEstimator(tmp_path / "no.safetensors")
    with pytest.raises(WeightsError, match="yolov5s"):
        OutcomeEstimator("yolov5s")


def test_picks_of_a_real_pile_are_a_function_of_the_seed(tmp_path):
    pytest.importorskip("iwgnet_grasp._core")
    assert make_picks(1, 3001, tmp_path / "a", workers=1, quiet=True) == 1
    (path,) = (tmp_path / "a").glob("*.npz")
    first = path.read_bytes()
    pile = read_pile(path)
    looks, rows, columns = pile.heights.shape
    assert looks >= 1 and len(pile.look) >= looks
    assert np.all((pile.grasps[:, 0] >= 0) & (pile.grasps[:, 0] < columns))
    assert np.all((pile.grasps[:, 1] >= 0) & (pile.grasps[:, 1] < rows))
    assert pile.good.any() and np.all(pile.part[pile.good] >= 0)
    path.unlink()
    assert make_picks(1, 3001, tmp_path / "a", workers=1, quiet=True) == 1
    assert path.read_bytes() == first
    with pytest.raises(DataError, match="another seed"):
        make_picks(1, 3002, tmp_path / "a", workers=1, quiet=True)
