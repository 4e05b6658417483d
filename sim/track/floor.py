"""The floor as a picture: the chessboard with a track painted on it, fine for what is near and
coarse for what is far."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.sim.track.course import BOARD, SQUARE, Element, ElementKind, Square, Track, white

Picture = NDArray[np.uint8]

FINE: Final = 0.005
"""m, side of a cell of the fine picture: a tenth of the track's width; edges are smoothed over one
cell."""
COARSE: Final = 0.010
"""Side of a cell of the coarse picture (m), in which two by two cells are averaged."""
MARGIN: Final = 2
"""Squares around the board: what the camera sees of the hall while the rover is within 1 m of the
board."""
SLACK: Final = 0.4
"""How far the rover may move before a window is copied again (m)."""
_SIDE: Final = round(SQUARE / FINE)
_RATIO: Final = round(COARSE / FINE)
ORIGIN: Final = -MARGIN * SQUARE
"""x and y of the outer corners of the pictures' first cells (m)."""


class Floor:
    """Pictures of the floor, 0 (black paint) to 255 (white paint): row along y, column along x,
    both from `ORIGIN`."""

    def __init__(self) -> None:
        self.version = 0
        """Counts how often it was painted."""
        self.fine = _chessboard(_SIDE)
        self.coarse = _chessboard(_SIDE // _RATIO)
        self._painted: list[Square] = []

    def paint(self, track: Track) -> None:
        """Remove the last track and paint this one."""
        self.version += 1
        for square in self._painted:
            self._fill(square, np.uint8(255 * white(square)))
        self._painted = [element.square for element in track.elements if element.painted]
        last = len(track.elements) - 1
        for number, element in enumerate(track.elements):
            if element.painted:
                tile = _tile(element.kind, element.heading, number == last)
                self._fill(element.square, 255 - tile if white(element.square) else tile)

    def _fill(self, square: Square, tile: Picture | np.uint8) -> None:
        for picture, side in ((self.fine, _SIDE), (self.coarse, _SIDE // _RATIO)):
            left, bottom = (square[0] + MARGIN) * side, (square[1] + MARGIN) * side
            grey = tile if isinstance(tile, np.uint8) or side == _SIDE else _averaged(tile)
            picture[bottom : bottom + side, left : left + side] = grey


class FloorWindow:
    """The part of a picture that a rover sees, copied whenever the rover has moved so far that
    it could see beyond it. It is small enough for a processor's cache; the whole floor (23 MB)
    is not."""

    def __init__(self, cell: float, reach: float) -> None:
        """`cell`: side of the picture's cells, `reach`: how far from its own position the rover
        sees (m)."""
        self.cell = cell
        self.part = np.zeros((0, 0), np.uint8)
        self.x = self.y = math.nan
        """Outer corner of the part's first cell (m)."""
        self._half = math.ceil((reach + SLACK) / cell)
        self._middle = math.nan, math.nan
        self._version = -1

    def look(self, picture: Picture, version: int, x: float, y: float) -> None:
        """Make the part contain everything within reach of (x, y), m."""
        near = abs(x - self._middle[0]) < SLACK and abs(y - self._middle[1]) < SLACK
        if near and version == self._version:
            return
        self._middle, self._version = (x, y), version
        rows, columns = picture.shape
        left = min(
            max(math.floor((x - ORIGIN) / self.cell) - self._half, 0),
            max(columns - 2 * self._half, 0),
        )
        bottom = min(
            max(math.floor((y - ORIGIN) / self.cell) - self._half, 0), max(rows - 2 * self._half, 0)
        )
        self.part = picture[bottom : bottom + 2 * self._half, left : left + 2 * self._half].copy()
        self.x, self.y = ORIGIN + left * self.cell, ORIGIN + bottom * self.cell


def _squares() -> Iterator[Square]:
    for j in range(-MARGIN, BOARD + MARGIN):
        for i in range(-MARGIN, BOARD + MARGIN):
            yield i, j


def _chessboard(side: int) -> Picture:
    squares = BOARD + 2 * MARGIN
    colours = np.array([255 * white(square) for square in _squares()], np.uint8).reshape(
        squares, squares
    )
    return np.repeat(np.repeat(colours, side, axis=0), side, axis=1)


@lru_cache
def _tile(kind: ElementKind, heading: int, tee: bool) -> Picture:
    """Return a white track on a black square, which ends in a T or continues."""
    element = Element(kind, (0, 0), heading, 0.0)
    middles = (np.arange(_SIDE) + 0.5) * FINE
    x, y = np.meshgrid(middles, middles)
    depth = element.tee_depth(x, y) if tee else element.depth(x, y)
    return np.asarray(np.rint(255.0 * np.clip(0.5 + depth / FINE, 0.0, 1.0)), np.uint8)


def _averaged(tile: Picture) -> Picture:
    side = _SIDE // _RATIO
    return np.asarray(cv2.resize(tile, (side, side), interpolation=cv2.INTER_AREA), np.uint8)
