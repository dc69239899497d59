"""Pictures of a trial's looks, drawn beside it."""

from __future__ import annotations

import concurrent.futures
import sys
from pathlib import Path

from iwgnet_grasp.report.pictures import write_pictures
from iwgnet_grasp.trials.in_process import Plan


class Pictures:
    """The paper's Figures 6-9: of the first look in the folder itself, of the later ones below
    looks/. Drawn beside the trial, which does not wait for them."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._thread = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="pictures")
        self._looks = 0

    def draw(self, plan: Plan) -> None:
        self._looks += 1
        folder, prefix = self._out, ""
        if self._looks > 1:
            folder, prefix = self._out / "looks", f"{self._looks:02d}_"
        chosen = {t.object_id: t.grasp for t in plan.targets if t.feasible}
        self._thread.submit(_draw, folder, plan, chosen, prefix)

    def finish(self) -> None:
        self._thread.shutdown()


def _draw(folder: Path, plan: Plan, chosen: dict, prefix: str) -> None:
    try:
        write_pictures(folder, plan.look, plan.ranking, chosen, prefix)
    except Exception as error:  # a picture less must not cost the trial
        print(f"pictures of look {plan.scene_id}: {error}", file=sys.stderr)
