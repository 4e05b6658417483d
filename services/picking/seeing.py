"""Primitive actions of the camera above the table: locate a part, and watch a tray being changed.

Error causes: `no_part`, `no_image`, `not_changed`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.services.action import Context, Result, error, provisional, success
from petrobot.services.picking.camera import TableCamera
from petrobot.services.picking.finding import FINDERS, Finder, Found
from petrobot.services.picking.model import PickingCell

SAME: Final = 0.006
"""Distance within which parts of two images are the same part (m)."""
ROOM: Final = 0.05
"""Distance from its neighbours at which a part is easy to grasp (m)."""
EMPTY: Final = 9.0
"""Largest standard deviation of grey levels within an empty tray."""


async def locate_contours(
    ctx: Context[TableCamera], *, images: int = 2, timeout: float = 1.0
) -> Result:
    """Locate a part by contours: fast; needs even light.

    SUCCESS, provisionally: `part` (kind, x, y, turn, score) is the one that is easiest to grasp,
    `found` the id of this run. The action that verifies the grasp gives the verdict. ERROR
    `no_part` if none is seen in most of the images.
    """
    return await _locate(ctx, FINDERS["contours"], images, timeout)


async def locate_templates(
    ctx: Context[TableCamera], *, images: int = 2, timeout: float = 1.0
) -> Result:
    """Locate a part by templates of the known kinds: slow; shadows and dim light hardly matter.
    Otherwise as `locate_contours`."""
    return await _locate(ctx, FINDERS["templates"], images, timeout)


async def _locate(ctx: Context[TableCamera], find: Finder, images: int, timeout: float) -> Result:
    cell = ctx.device.known
    taken = await ctx.device.take(ctx, images, timeout)
    if len(taken) < images:
        text = f"{len(taken)} of {images} images came"
        return error("no_image", ctx.device.missing(text))
    parts = confirmed([find(image.pixels, cell) for image in taken])
    if not parts:
        return error(
            "no_part", f"no part of {', '.join(cell.kinds)} is seen in the area of the parts"
        )
    part = easiest(parts)
    return provisional(success(part=part.plain(), found=ctx.run, seen=len(parts)))


def confirmed(looks: Sequence[Sequence[Found]]) -> list[Found]:
    """Return the parts that were seen in more than half of the images, as the last one shows
    them."""
    return [
        one
        for one in looks[-1]
        if 2 * sum(any(_same(one, other) for other in look) for look in looks) > len(looks)
    ]


def easiest(parts: Sequence[Found]) -> Found:
    """Return the part that was recognised with enough certainty and has most room around it for the
    fingers."""

    def ease(one: Found) -> float:
        room = min(
            (math.hypot(one.x - o.x, one.y - o.y) for o in parts if o is not one), default=ROOM
        )
        return one.score * min(room, ROOM)

    return max(parts, key=ease)


def _same(one: Found, other: Found) -> bool:
    return one.kind == other.kind and math.hypot(one.x - other.x, one.y - other.y) < SAME


async def await_tray(
    ctx: Context[TableCamera],
    *,
    tray: str,
    slots: Mapping[str, int] | None = None,
    timeout: float = 60.0,
) -> Result:
    """Watch a full tray until it has been replaced by an empty one.

    SUCCESS when three images in a row show it empty; `slots` then counts it as empty. ERROR
    `not_changed` after `timeout` s.
    """
    cell, empty, due = ctx.device.known, 0, ctx.now + timeout
    while ctx.now < due:
        taken = await ctx.device.take(ctx, 1, 1.0)
        if not taken:
            text = "the camera sends no images"
            return error("no_image", ctx.device.missing(text))
        empty = empty + 1 if is_empty(taken[0].pixels, cell, tray) else 0
        if empty == 3:
            return success(slots={**(slots or {}), tray: 0})
        await ctx.sleep(0.2)
    return error("not_changed", f"the tray {tray} is still full after {timeout:g} s")


def is_empty(image: NDArray[np.uint8], cell: PickingCell, tray: str) -> bool:
    """Return whether a tray is empty and nothing is above it."""
    there = cell.trays[tray]
    (x, y), (along, across) = there.position, (0.8 * size for size in there.size)
    u0, v0 = cell.eye.pixel(x + along / 2, y + across / 2, 0.0)
    u1, v1 = cell.eye.pixel(x - along / 2, y - across / 2, 0.0)
    inside = cv2.blur(image[round(v0) : round(v1), round(u0) : round(u1)], (5, 5))
    return bool(inside.std() < EMPTY)
