"""Is a predicted quality worth what it says? Reliability diagram and expected calibration error."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BINS = 10


@dataclass(frozen=True)
class Bin:
    """Predictions whose quality falls into one tenth of [0, 1]."""

    count: int
    predicted: float  # mean of the predictions
    observed: float  # mean of what came true


@dataclass(frozen=True)
class Reliability:
    """error: the expected calibration error, sum of |predicted - observed| over the bins weighted
    with their share of the predictions (Naeini et al. 2015); NaN without a prediction."""

    error: float
    bins: tuple[Bin, ...]  # those that hold a prediction, by rising quality


def reliability(predicted: Sequence[float], observed: Sequence[float]) -> Reliability:
    """predicted: qualities in [0, 1]; observed: what each was worth, in [0, 1] (or False, True)."""
    quality = np.asarray(predicted, np.float64)
    worth = np.asarray(observed, np.float64)
    if quality.shape != worth.shape or quality.ndim != 1:
        raise ValueError(f"{quality.shape} predictions for {worth.shape} observations")
    place = np.minimum((quality * BINS).astype(int), BINS - 1)
    bins = tuple(
        Bin(
            int((place == i).sum()),
            float(quality[place == i].mean()),
            float(worth[place == i].mean()),
        )
        for i in range(BINS)
        if (place == i).any()
    )
    if not bins:
        return Reliability(float("nan"), ())
    error = sum(b.count * abs(b.predicted - b.observed) for b in bins) / len(quality)
    return Reliability(float(error), bins)
