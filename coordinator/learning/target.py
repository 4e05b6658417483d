"""Which actions meet a target reliability, for many learners at once: the lower confidence bound
decides, with hysteresis."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from petrobot.coordinator.learning.batch import Batch, Mask


def eligible(batch: Batch, target: float, before: Mask, level: float = 0.95) -> Mask:
    """Actions that meet the target now, shape (rows, n), given those that did `before`.

    An action comes in when Wilson's lower bound of its R reaches the target and goes out when R
    itself falls below.
    """
    z = float(ndtri(0.5 * (1 + level)))
    n = np.maximum(batch.runs, 1e-9)
    share = batch.successes / n
    half = z * np.sqrt(np.maximum(share * (1 - share), 0.0) / n + z * z / (4 * n * n))
    lower = (share + z * z / (2 * n) - half) / (1 + z * z / n)
    out: Mask = (batch.runs > 0) & np.where(before, share >= target, lower >= target)
    return out
