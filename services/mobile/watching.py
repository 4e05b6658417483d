"""From image to image: goes on where the line was last, and believes an end only when several
images show the same.

Pure: images in, sights out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from petrobot.services.mobile.detection import Detector
from petrobot.services.mobile.floor import FloorView, ScanGrid
from petrobot.services.mobile.line_end import EndFinder
from petrobot.services.mobile.model import Rover
from petrobot.services.mobile.sight import UNSEEN, End, Line, Sight, TrackEnd

FOLLOW_FAR, FIND_FAR = 1.2, 1.5
"""m ahead up to which scan rows lie while the line is followed, and while it is looked for."""
NEAR = 0.6
"""m ahead within which a line must begin for the rows of following to suffice."""
FORGET = 3
"""Images without a sight after which the line may begin anywhere again."""
VOTES, NEEDED = 6, 3
"""Ends of the latest images that are counted, and how many must agree and outnumber the rest."""


@dataclass(frozen=True)
class FloorWatch:
    """What all watchers of one camera share: its geometry and scan rows."""

    view: FloorView
    ends: EndFinder
    near: ScanGrid
    """Rows for following."""
    wide: ScanGrid
    """Rows for finding."""
    width: float
    """m, of the track."""

    @staticmethod
    def of(rover: Rover) -> FloorWatch:
        """For the numbers of a rover."""
        view = FloorView(rover.camera)
        near, wide = ScanGrid.of(view, FOLLOW_FAR), ScanGrid.of(view, FIND_FAR)
        return FloorWatch(view, EndFinder(view, rover.track), near, wide, rover.track.width)


class LineWatcher:
    """One run's memory of the line."""

    def __init__(self, floor: FloorWatch, detector: Detector, *, find: bool = False) -> None:
        self._floor = floor
        self._detect = detector
        self._find = find
        self._expected: Line | None = None
        self._votes: deque[TrackEnd] = deque(maxlen=VOTES)
        self.images = 0
        self.seen = 0
        """Images in which the line was seen."""
        self.unseen = 0
        """Images in a row without it."""

    @property
    def share(self) -> float:
        """Share of the images that showed the line."""
        return self.seen / self.images if self.images else 0.0

    @property
    def end(self) -> TrackEnd:
        """What the latest images agree on."""
        for kind in (TrackEnd.T, TrackEnd.INTERRUPTION):
            count = sum(vote is kind for vote in self._votes)
            if count >= NEEDED and 2 * count > len(self._votes):
                return kind
        return TrackEnd.NONE

    def look(self, image: NDArray[np.uint8]) -> Sight:
        """What the image shows; its `end` is set only once it is believed."""
        self.images += 1
        grid = self._floor.near if self._is_near and not self._find else self._floor.wide
        sight = self._detect(grid, grid.sample(image), self._floor.width, self._expected)
        if not sight.seen:
            self.unseen += 1
            if self.unseen >= FORGET:
                self._expected = None
            return UNSEEN
        self.seen, self.unseen = self.seen + 1, 0
        self._expected = sight.line()
        return replace(sight, end=self._believed(image, sight))

    @property
    def _is_near(self) -> bool:
        """Whether the line begins where the image does: then rows far ahead tell nothing that
        matters yet."""
        return self._expected is not None and self._expected.near < NEAR

    def _believed(self, image: NDArray[np.uint8], sight: Sight) -> End | None:
        end = self._floor.ends.judge(image, sight)
        if end is not None:
            self._votes.append(end.kind)
        elif not sight.broke_off and self._votes:
            self._votes.popleft()  # a line that goes on speaks against an end
        return end if end is not None and end.kind is self.end else None
