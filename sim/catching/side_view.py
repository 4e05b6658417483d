"""The catching laboratory seen from beside the table and a little from above, as SVG: table, arm,
cup and ball as they are now (x to the right, z up, y away from the eye; m in the base frame)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from petrobot.sim.catching.puma_model import Frame3

SCALE = 320.0
"""Pixels of a metre."""
LEFT, RIGHT, TOP, BOTTOM = -0.50, 2.40, 1.32, -0.12
"""What is seen (m): to the right from LEFT to RIGHT, up from BOTTOM to TOP."""
ASIDE, UP = 0.30, 0.22
"""How far to the right and up a metre away from the eye is drawn (an oblique projection)."""
_PAPER, _WOOD, _EDGE, _LEG, _FLOOR = "#ffffff", "#d9c19a", "#b9986b", "#c9b48e", "#eef0f3"
_ARM, _DARK, _CUP, _BALL = "#e9a13b", "#8a5a12", "#1b5fb4", "#e8590c"

Point3 = Sequence[float]


def side_view(
    cell: Mapping[str, Any], parts: tuple[Any, Any], cup: Frame3, balls: Sequence[Point3]
) -> str:
    """Return the picture. `parts`: end points (n, 2, 3) and radii (n,) of the arm's capsules;
    `cup`: its frame, the origin in the middle of the mouth, z out of it; `balls`: their middles."""
    radius = cell["ball"]["radius"]
    ends, radii = parts
    held = [_ball(b, radius) for b in balls if _inside(cell["cup"], cup, b)]
    free = [_ball(b, radius) for b in balls if not _inside(cell["cup"], cup, b)]
    # What is nearer to the eye is drawn later; a ball in the cup is behind its wall.
    body = [
        *_table(cell["table"]),
        _capsules(ends[:-1].tolist(), radii[:-1].tolist()),
        *held,
        _cup(cell["cup"], cup),
        *free,
    ]
    width, height = round((RIGHT - LEFT) * SCALE), round((TOP - BOTTOM) * SCALE)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}"><rect width="{width}" height="{height}" '
        f'fill="{_PAPER}"/>{"".join(body)}</svg>'
    )


def _at(p: Point3) -> tuple[float, float]:
    x, y, z = p
    return (x + ASIDE * y - LEFT) * SCALE, (TOP - z - UP * y) * SCALE


def _line(a: Point3, b: Point3, wide: float, colour: str, cap: str) -> str:
    (x1, y1), (x2, y2) = _at(a), _at(b)
    return (
        f'<path d="M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}" fill="none" stroke="{colour}" '
        f'stroke-width="{wide * SCALE:.1f}" stroke-linecap="{cap}"/>'
    )


def _area(points: Sequence[tuple[float, float]], style: str) -> str:
    flat = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polygon points="{flat}" stroke-linejoin="round" {style}/>'


def _table(table: Mapping[str, Any]) -> list[str]:
    """Return floor, legs, table top and its edge."""
    near, far = table["near_edge"], table["near_edge"] + table["length"]
    side, top, thick = table["width"] / 2.0, table["top"], 0.04
    floor = [(LEFT, -1.0, 0.0), (RIGHT + 1.0, -1.0, 0.0), (RIGHT, 1.0, 0.0), (LEFT - 1, 1.0, 0.0)]
    corners = [(x, y) for y in (side - 0.08, 0.08 - side) for x in (near + 0.08, far - 0.08)]
    board = [(near, -side), (far, -side), (far, side), (near, side)]
    front = [(near, -side, top), (far, -side, top), (far, -side, top - thick)]
    front.append((near, -side, top - thick))
    return [
        _area([_at(p) for p in floor], f'fill="{_FLOOR}"'),
        *(_line((x, y, 0.0), (x, y, top - thick), 0.05, _LEG, "butt") for x, y in corners),
        _area([_at((x, y, top)) for x, y in board], f'fill="{_WOOD}"'),
        _area([_at(p) for p in front], f'fill="{_EDGE}"'),
    ]


def _capsules(ends: Sequence[Any], radii: Sequence[float]) -> str:
    """Return the links, each with an outline, those farther away first; a dot on each joint."""
    out = []
    for (a, b), r in sorted(zip(ends, radii, strict=True), key=lambda one: -one[0][0][1]):
        cap = "butt" if a[2] == 0.0 else "round"
        out += [_line(a, b, 2 * r, _DARK, cap), _line(a, b, 2 * r - 0.014, _ARM, cap)]
    for a, _ in ends[1:]:
        x, y = _at(a)
        out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{_DARK}"/>')
    return "".join(out)


def _cup(cup: Mapping[str, Any], frame: Frame3) -> str:
    """Return the outline of the cup: the circles of its mouth and its bottom, from here."""
    points = [
        frame.point((cup["radius"] * math.cos(t), cup["radius"] * math.sin(t), -depth))
        for depth in (0.0, cup["depth"])
        for t in (2.0 * math.pi * i / 24 for i in range(24))
    ]
    style = f'fill="{_CUP}" fill-opacity="0.55" stroke="{_CUP}" stroke-width="2"'
    return _area(_hull([_at(p) for p in points]), style)


def _ball(at: Point3, radius: float) -> str:
    x, y = _at(at)
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius * SCALE:.1f}" fill="{_BALL}"/>'


def _inside(cup: Mapping[str, Any], frame: Frame3, at: Point3) -> bool:
    """Return whether the middle of a ball is in the cup."""
    x, y, z = frame.local((at[0], at[1], at[2]))
    return bool(-cup["depth"] < z < 0.0 and math.hypot(x, y) < cup["radius"])


def _hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the convex hull of points, in order around it (Andrew's monotone chain)."""
    ordered, hull = sorted(set(points)), list[tuple[float, float]]()
    for way in (ordered, ordered[::-1]):
        part = list[tuple[float, float]]()
        for p in way:
            while len(part) > 1 and _turn(part[-2], part[-1], p) <= 0:
                part.pop()
            part.append(p)
        hull += part[:-1]
    return hull


def _turn(o: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])
