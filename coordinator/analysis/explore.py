"""What the exploration engines share: the state of a search that any of them can continue, and
their interface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.analysis.pack import Layout, TooManyTokens, Words
from petrobot.coordinator.net import Net

Numbers = NDArray[np.int32]
Labels = NDArray[Any]
"""Transition of each edge, int16, or int32 in a net of more than 32,767 transitions."""


@dataclass(frozen=True)
class Explored:
    """A breadth-first search so far: markings found, of which the first `len(row) - 1` are
    expanded."""

    net: Net
    layout: Layout
    keep_edges: bool
    words: Words
    """Packed markings in order of discovery, shape (states, layout.words)."""
    row: NDArray[np.int64]
    """Edges before each expanded marking, shape (expanded + 1,)."""
    target: Numbers
    label: Labels

    @classmethod
    def start(cls, net: Net, layout: Layout, keep_edges: bool) -> Explored:
        """Only the initial marking, not yet expanded."""
        words = layout.split_many([layout.pack(net.initial)])
        label = np.zeros(0, dtype=np.int16 if len(net.transitions) < 1 << 15 else np.int32)
        return cls(
            net, layout, keep_edges, words, np.zeros(1, np.int64), np.zeros(0, np.int32), label
        )

    def relaid(self, layout: Layout) -> Explored:
        """The same search in another layout."""
        words = self.layout.repack(self.words, layout)
        return Explored(self.net, layout, self.keep_edges, words, self.row, self.target, self.label)


class Engine(Protocol):
    """Expands markings in order. After an interruption at any point `explored()` still gives a
    consistent search."""

    @property
    def states(self) -> int:
        """Markings found."""

    @property
    def expanded(self) -> int:
        """Markings expanded."""

    @property
    def nbytes(self) -> int:
        """Bytes held, roughly."""

    def expand(self, cap: int | None) -> bool:
        """Expand some more markings; False when none is left.

        Stops right after the marking whose successors bring the number of states to `cap` or
        beyond.
        """

    def explored(self) -> Explored:
        """The search so far."""


def widened_layout(layout: Layout, places: list[int]) -> Layout:
    """The layout to go on with after these places overflowed. Raises TooManyTokens when words
    end."""
    wider = layout.widened(places)
    if wider == layout:
        raise TooManyTokens(
            "a place holds more tokens than a 64-bit word can count: the net is almost "
            "surely unbounded"
        )
    return wider
