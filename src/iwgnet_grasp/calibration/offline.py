"""`scripts/iwgnet calibrate`: a calibration solved again from its samples."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iwgnet_grasp.calibration import report
from iwgnet_grasp.calibration.samples import load, save
from iwgnet_grasp.calibration.solve import compare, solve


def calibrate(
    file: Annotated[Path, typer.Argument(help="Result of scripts/start_calibration.")],
    out: Annotated[Path | None, typer.Option(help="Also write the new result here.")] = None,
    leave_out: Annotated[
        list[int] | None,
        typer.Option(help="Number of a pair to leave out; give it again for more."),
    ] = None,
) -> None:
    """Solve a calibration again from the samples in its file and compare the methods.

    Example: iwgnet calibrate results/calibration/0.yaml --leave-out 3
    """
    samples = load(file)
    for number in sorted(set(leave_out or []), reverse=True):
        if not 1 <= number <= len(samples.samples):
            raise ValueError(f"--leave-out {number}: the file has {len(samples.samples)} pairs")
        samples = samples.without(number - 1)
    calibration = solve(samples)
    lines = [*report.text(calibration, samples), ""]
    lines += report.methods_table(compare(samples), samples, None)
    typer.echo("\n".join(lines))
    if out is not None:
        save(out, samples, report.as_dict(calibration))
        typer.echo(f"\nwrote {out}")
