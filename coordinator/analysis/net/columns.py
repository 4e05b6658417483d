"""The firing rule for many markings side by side: places are rows of an array, markings its
columns.

Used where trials are played in parallel (`time/simulate.py`, `studies/forecast/play.py`).
"""

from __future__ import annotations

import numpy as np

from petrobot.coordinator.analysis.net.graph import Mask
from petrobot.coordinator.analysis.net.pack import Tokens
from petrobot.coordinator.task.compiled import CompiledNet


def concession(rule: CompiledNet, tokens: Tokens, t: int) -> Mask:
    """Return in which markings transition t has concession; `tokens` has shape (places, markings),
    the result (markings,)."""
    able = np.ones(tokens.shape[1], dtype=np.bool_)
    for p, w in rule.needs[t]:
        able &= tokens[p] >= w
    for p, k in rule.bars[t]:
        able &= tokens[p] < k
    return able
