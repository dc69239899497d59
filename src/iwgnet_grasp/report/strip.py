"""A trial as a strip of images: for each pick what was chosen and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from iwgnet_grasp.perception.types import GraspRectangle
from iwgnet_grasp.report.film import Frame
from iwgnet_grasp.report.pictures import (
    PAPER,
    Label,
    View,
    beside,
    box_corners,
    color_of,
    draw_grasp,
    fitted,
    grasp_corners,
    outline,
    titled,
    with_labels,
)

if TYPE_CHECKING:
    from iwgnet_grasp.trials.in_process import Plan

TILE_PX = 300
WORKSPACE_PX = (366, 126, 548, 548)  # x, y, width, height of the workspace under the camera
LIFTED_S = 0.35  # after the grip: the part is clear of its neighbours


def trial_strip(
    record: dict, plans: Sequence[Plan], frames: Sequence[Frame] = (), columns: int = 5
) -> np.ndarray:
    """(H, W, 3) uint8 RGB: a tile a pick, in order. Above, the look with every object's place in
    the order and the grasp that is tried; below, where there are frames, the part just lifted."""
    by_look = {plan.scene_id: plan for plan in plans}
    tiles = [
        _tile(i, pick, by_look[pick["look"]], frames)
        for i, pick in enumerate(record["picks"])
        if pick["look"] in by_look
    ]
    if not tiles:
        return titled(np.full((TILE_PX, 2 * TILE_PX, 3), PAPER, np.uint8), "no pick")
    blank = np.full_like(tiles[0], PAPER)
    columns = min(columns, len(tiles))
    rows = []
    for i in range(0, len(tiles), columns):
        line = tiles[i : i + columns]
        rows.append(beside(line + [blank] * (columns - len(line))))
    return np.vstack(rows)


def _tile(index: int, pick: dict, plan: Plan, frames: Sequence[Frame]) -> np.ndarray:
    grasp = GraspRectangle(**pick["grasp"])
    title = f"{index + 1}: S* {pick['priority']:.2f}  Q {grasp.quality:.2f}  " + (
        f"slip {pick['slip_mm']:.1f} mm" if pick["success"] else pick["reason"].replace("_", " ")
    )
    parts = [titled(_look(pick, plan, grasp), title, 16)]
    if frames:
        wanted = (pick["grip_time_s"] or pick["end_time_s"]) + LIFTED_S
        nearest = min(frames, key=lambda frame: abs(frame.time_s - wanted))
        parts.append(fitted(nearest.image, TILE_PX))
    return np.vstack(parts)


def _look(pick: dict, plan: Plan, grasp: GraspRectangle) -> np.ndarray:
    """The workspace with boxes numbered by their order and the grasp that is tried."""
    look = plan.look
    view = View(*WORKSPACE_PX, TILE_PX / WORKSPACE_PX[2])
    image = view.image(look.color)
    labels = []
    for order, entry in enumerate(plan.ranking.objects, 1):
        o = entry.object
        corners = view.points(box_corners(o))
        outline(image, corners, color_of(o.object_id), 1)
        labels.append(Label(str(order), corners[0], color_of(o.object_id)))
    image = with_labels(image, labels, [], 11)
    draw_grasp(image, view.points(grasp_corners(grasp)), color_of(pick["object"]), 2)
    return image
