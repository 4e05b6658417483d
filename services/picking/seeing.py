"""Primitive actions of the camera above the table: locate a part, and watch a tray being changed.

Error causes: `no_part`, `no_image`, `not_changed`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.services.action import Context, Result, error, provisional, success
from petrobot.services.picking.camera import TableCamera
from petrobot.services.picking.model import PartKind, PickingCell

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


# --- finding ---
# Find parts in an image: by their contours, or by templates of the kinds that are handled. Pure.
#
# Both return the parts in the search area, best first. The camera looks straight down; a part's top
# is nearer to it than the table, so a pixel is projected to the height of the top of its kind.

Grey = NDArray[np.uint8]


class Found(NamedTuple):
    """A part that was seen: its kind, the middle of its top (m) and the direction of its long side
    (rad, table's frame), and how sure it is (0 to 1)."""

    kind: str
    x: float
    y: float
    turn: float
    score: float

    def plain(self) -> dict[str, Any]:
        """As data of a task's variable."""
        return dict(self._asdict())


Finder = Callable[[Grey, PickingCell], list[Found]]

CONTRAST: Final = 26.0
"""Least difference from the table's grey level of a pixel that belongs to a part."""
_UNLIKE: Final = 0.35
"""Relative error of the area above which a contour is not of any kind."""
MATCH: Final = 0.62
"""Least correlation of a template with a part."""
SCALE: Final = 1250.0
"""Pixels per metre of the rectified image in which templates are compared."""
TURNS: Final = 12
"""Number of orientations of a box's template, over half a turn."""
_RIM: Final = 0.006
"""Margin of table around the part in a template (m)."""


def find_by_contours(image: Grey, cell: PickingCell) -> list[Found]:
    """Find what differs from the table's grey level, and take the smallest rectangle around it.

    Fast. A shadow that differs by CONTRAST is taken for a piece of a dark part; a part that differs
    by less is not seen.
    """
    (x0, x1), (y0, y1) = cell.area
    eye = cell.eye
    margin = 0.02
    u0, v0 = eye.pixel(x1 + margin, y1 + margin, 0.0)
    u1, v1 = eye.pixel(x0 - margin, y0 - margin, 0.0)
    top, left = max(0, round(v0)), max(0, round(u0))
    region = cv2.GaussianBlur(image[top : round(v1), left : round(u1)], (5, 5), 0)
    table = float(np.median(region))
    away = region.astype(np.float32) - table
    contours: list[Grey] = []
    for side in (away, -away):  # dark and bright separately: the shadow of a bright part is dark
        mask = (side > CONTRAST).astype(np.uint8)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))  # type: ignore[assignment]
        contours += cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]  # type: ignore[arg-type]
    found = []
    for contour in contours:
        area = cv2.contourArea(contour)
        if area < 40.0:
            continue
        (u, v), (wide, high), _ = rectangle = cv2.minAreaRect(contour)
        match = _kind_of(cell, area, max(wide, high), min(wide, high))
        if match is None:
            continue
        kind, unlike = match
        x, y = eye.point(u + left, v + top, kind.height)
        if not (x0 - 0.01 <= x <= x1 + 0.01 and y0 - 0.01 <= y <= y1 + 0.01):
            continue
        corners = cv2.boxPoints(rectangle)
        side = max((corners[1] - corners[0], corners[2] - corners[1]), key=lambda s: math.hypot(*s))
        # u runs along -y and v along -x.
        turn = math.atan2(-side[0], -side[1]) if not kind.round else 0.0
        found.append(Found(kind.name, x, y, turn % math.pi, 1.0 - unlike))
    return sorted(found, key=lambda f: -f.score)


def _kind_of(
    cell: PickingCell, area: float, long: float, short: float
) -> tuple[PartKind, float] | None:
    """Return the kind whose size is nearest to a contour's (px), and the difference."""
    best: tuple[float, PartKind] | None = None
    for kind in cell.kinds.values():
        scale = cell.eye.focal / (cell.eye.position[2] - kind.height)
        length, width = (side * scale for side in kind.size)
        full = length * width * (math.pi / 4 if kind.round else 1.0)
        fill = area / max(long * short, 1.0)
        shape = abs(fill - (math.pi / 4 if kind.round else 1.0))
        unlike = (
            abs(math.log(area / full)) / 2
            + abs(math.log(max(long, 1.0) / length)) / 2
            + abs(math.log(max(short, 1.0) / width)) / 2
            + shape
        )
        if best is None or unlike < best[0]:
            best = unlike, kind
    if best is None or best[0] > _UNLIKE:
        return None
    return best[1], best[0]


def find_by_templates(image: Grey, cell: PickingCell) -> list[Found]:
    """Compare the image with every kind of part in every orientation.

    Slow. It compares shapes independently of brightness, so neither dim light nor a shadow at one
    side of a part matters much; two touching parts are still found as two.
    """
    found: list[Found] = []
    for kind in cell.kinds.values():
        seen = _rectified(image, cell, kind.height)
        best = np.zeros(seen.shape, np.float32)
        which = np.zeros(seen.shape, np.int16)
        templates = _templates(kind)
        for number, (_, template) in enumerate(templates):
            high, wide = template.shape
            scores = np.abs(cv2.matchTemplate(seen, template, cv2.TM_CCOEFF_NORMED))
            window = best[
                high // 2 : high // 2 + scores.shape[0], wide // 2 : wide // 2 + scores.shape[1]
            ]
            chosen = which[
                high // 2 : high // 2 + scores.shape[0], wide // 2 : wide // 2 + scores.shape[1]
            ]
            better = scores > window
            window[better] = scores[better]
            chosen[better] = number
        peaks = (best == cv2.dilate(best, np.ones((9, 9), np.uint8))) & (best > MATCH)
        for row, column in np.argwhere(peaks):
            x, y = _place(cell, float(row), float(column))
            turn = templates[int(which[row, column])][0]
            found.append(Found(kind.name, x, y, turn, min(1.0, float(best[row, column]))))
    return _distinct(found, cell)


def _distinct(found: Sequence[Found], cell: PickingCell) -> list[Found]:
    """Keep the best of overlapping parts."""
    kept: list[Found] = []
    (x0, x1), (y0, y1) = cell.area
    for one in sorted(found, key=lambda f: -f.score):
        inside = x0 - 0.01 <= one.x <= x1 + 0.01 and y0 - 0.01 <= one.y <= y1 + 0.01
        apart = all(
            math.hypot(one.x - k.x, one.y - k.y)
            > 0.4 * (min(cell.kinds[one.kind].size) + min(cell.kinds[k.kind].size))
            for k in kept
        )
        if inside and apart:
            kept.append(one)
    return kept


_BORDER: Final = 0.03
"""Margin of the rectified image around the search area (m)."""


def _rectified(image: Grey, cell: PickingCell, height: float) -> Grey:
    """Return the search area as seen at a height: rows along x, columns along y."""
    (x0, x1), (y0, y1) = cell.area
    rows = round((x1 - x0 + 2 * _BORDER) * SCALE)
    columns = round((y1 - y0 + 2 * _BORDER) * SCALE)
    u0, v0 = cell.eye.pixel(x0 - _BORDER, y0 - _BORDER, height)
    per = cell.eye.focal / (cell.eye.position[2] - height) / SCALE
    # column (y) leads along -u, row (x) along -v
    warp = np.array(((-per, 0.0, u0), (0.0, -per, v0)), np.float32)
    seen = cv2.warpAffine(
        image,
        warp,
        (columns, rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return cv2.GaussianBlur(seen, (3, 3), 0)  # type: ignore[return-value]


def _place(cell: PickingCell, row: float, column: float) -> tuple[float, float]:
    return cell.area[0][0] - _BORDER + row / SCALE, cell.area[1][0] - _BORDER + column / SCALE


@lru_cache(maxsize=32)
def _templates(kind: PartKind) -> tuple[tuple[float, Grey], ...]:
    """Return the template of a kind in each orientation (rad): bright top, dark table."""
    square = kind.size[0] == kind.size[1]
    half_turn = math.pi / 2 if square else math.pi
    count = 1 if kind.round else TURNS // 2 if square else TURNS
    size = 2 * math.ceil(
        (math.hypot(*kind.size) / 2 * (0.72 if kind.round else 1.0) + _RIM) * SCALE
    )
    made = []
    for k in range(count):
        turn = k * half_turn / count
        picture = np.full((size + 1, size + 1), 60, np.uint8)
        middle = size / 2
        if kind.round:
            radius = round(kind.size[0] / 2 * SCALE * 16)
            cv2.circle(
                picture, (round(middle * 16), round(middle * 16)), radius, 200, -1, cv2.LINE_AA, 4
            )
        else:
            a, b = (side / 2 * SCALE for side in kind.size)
            c, s = math.cos(turn), math.sin(turn)
            corners = [
                # row is x, column is y
                (middle + s * px + c * py, middle + c * px - s * py)
                for px, py in ((-a, -b), (a, -b), (a, b), (-a, b))
            ]
            points = np.rint(np.array(corners) * 16).astype(np.int32)
            cv2.fillConvexPoly(picture, points, 200, cv2.LINE_AA, 4)
        made.append((turn, cv2.GaussianBlur(picture, (3, 3), 0)))
    return tuple(made)  # type: ignore[arg-type]


FINDERS: Final[Mapping[str, Finder]] = {
    "contours": find_by_contours,
    "templates": find_by_templates,
}
