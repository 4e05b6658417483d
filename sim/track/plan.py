"""Floor plan of a run as SVG, still or animated: squares, track, reflectors, the path driven,
penalties. Needs only a score."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final
from xml.sax.saxutils import escape

from petrobot.sim.track.course import (
    BAR_LENGTH,
    BAR_WIDTH,
    BOARD,
    HALF_WIDTH,
    RADIUS,
    SQUARE,
    Element,
    ElementKind,
    Track,
    white,
)

WIDTH_PX: Final = 720
"""Width of the drawing at its natural size (px)."""
PATH_COLOURS: Final = ("#d9480f", "#1c7ed6", "#2b8a3e", "#862e9c", "#c2255c", "#0b7285")
"""One colour for each run drawn; dashes also distinguish them."""
_DASHES: Final = ("", "0.25 0.1", "0.1 0.08", "0.4 0.1 0.1 0.1", "0.02 0.08", "0.6 0.1")
_LIGHT, _DARK = "#f4f1ea", "#34322e"
_RIM: Final = 0.3
_LETTER: Final = 0.52
"""Width of a letter, as a share of the font's size."""
_ROVER: Final = ((0.18, 0.0), (0.06, 0.2), (-0.22, 0.2), (-0.22, -0.2), (0.06, -0.2))
"""Its outline in the body frame, m."""


def floor_plan(
    scores: Sequence[Mapping[str, Any]], names: Sequence[str] = (), *, seconds: float = 0.0
) -> str:
    """Return an SVG of one track and the paths that runs drove on it.

    `scores` are results of `TrackReferee.score`, all of one track. With `seconds` above 0 a rover
    drives along each path in so much time, repeatedly. Raises ValueError without a run.
    """
    if not scores:
        raise ValueError("no run to draw: give at least one score")
    track = Track.read(scores[0]["track"])
    left, bottom, right, top = _extent(track)
    high = top - bottom + 0.7 * len(scores)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{left:g} {-top:g} '
        f'{right - left:g} {high:g}" width="{WIDTH_PX}" '
        f'height="{WIDTH_PX * high / (right - left):.0f}" font-family="sans-serif" '
        'font-size="0.34" role="img">',
        f"<title>{escape(_title(scores[0]))}</title>",
        '<g transform="scale(1 -1)">',
        f'<clipPath id="floor"><rect x="{left:g}" y="{bottom:g}" width="{right - left:g}" '
        f'height="{top - bottom:g}"/></clipPath>',
        '<g clip-path="url(#floor)">',
        *_squares(left, bottom, right, top),
        "</g>",
        *_paint(track),
        *_reflectors(track, scores[0]),
    ]
    for number, score in enumerate(scores):
        parts += _path(score, number)
        if seconds > 0.0:
            parts.append(_driving(score, number, seconds))
    parts.append("</g>")
    for number, score in enumerate(scores):
        name = names[number] if number < len(names) else f"seed {score['seed']}"
        parts += _legend(score, number, name, (left + 0.2, -bottom + 0.7 * number), right - left)
    return "\n".join([*parts, "</svg>"])


def pictures(result: Mapping[str, Any]) -> dict[str, str]:
    """Return pictures for the report of a run, SVG by title, from its result (a score and what else
    the result contains); empty before there is a score."""
    if "track" not in result or not result.get("path"):
        return {}
    seconds = max(4.0, min(30.0, float(result["path"][-1][0]) / 4.0))
    return {
        "Floor plan": floor_plan([result]),
        "The run from above": floor_plan([result], seconds=seconds),
    }


def _title(score: Mapping[str, Any]) -> str:
    return f"Floor plan: track of seed {score['seed']}, {score['regime']}, {score['length_m']:g} m"


def _extent(track: Track) -> tuple[float, float, float, float]:
    """Return left, bottom, right and top of the drawing (m): the track's squares and one around
    them as far as the board reaches, plus a margin for a rover at the board's edge."""
    columns = [element.square[0] for element in track.elements]
    rows = [element.square[1] for element in track.elements]
    return (
        max(min(columns) - 1, 0) * SQUARE - _RIM,
        max(min(rows) - 1, 0) * SQUARE - _RIM,
        min(max(columns) + 2, BOARD) * SQUARE + _RIM,
        min(max(rows) + 2, BOARD) * SQUARE + _RIM,
    )


def _squares(left: float, bottom: float, right: float, top: float) -> list[str]:
    squares = []
    for i in range(math.floor(left / SQUARE), math.ceil(right / SQUARE)):
        for j in range(math.floor(bottom / SQUARE), math.ceil(top / SQUARE)):
            fill = _LIGHT if white((i, j)) else _DARK
            squares.append(
                f'<rect x="{i * SQUARE:g}" y="{j * SQUARE:g}" width="2" height="2" fill="{fill}"/>'
            )
    return squares


def _paint(track: Track) -> list[str]:
    lines = []
    for number, element in enumerate(track.elements):
        if not element.painted:
            continue
        colour = _DARK if white(element.square) else _LIGHT
        last = number == len(track.elements) - 1
        line = _line(element, track.length - element.start if last else element.kind.length)
        lines.append(
            f'<path d="{line}" fill="none" stroke="{colour}" stroke-width="{2 * HALF_WIDTH:g}"/>'
        )
        if last:
            x, y, heading = track.at(track.length - 0.5 * BAR_WIDTH)
            dx, dy = -0.5 * BAR_LENGTH * math.sin(heading), 0.5 * BAR_LENGTH * math.cos(heading)
            lines.append(
                f'<path d="M{x - dx:.4g} {y - dy:.4g}L{x + dx:.4g} {y + dy:.4g}" '
                f'stroke="{colour}" stroke-width="{BAR_WIDTH:g}"/>'
            )
    return lines


def _line(element: Element, way: float) -> str:
    (x0, y0, _), (x1, y1, _) = element.at(0.0), element.at(way)
    if element.kind is ElementKind.STRAIGHT:
        return f"M{x0:.5g} {y0:.5g}L{x1:.5g} {y1:.5g}"
    sweep = 1 if element.kind is ElementKind.LEFT else 0
    return f"M{x0:.5g} {y0:.5g}A{RADIUS:g} {RADIUS:g} 0 0 {sweep} {x1:.5g} {y1:.5g}"


def _reflectors(track: Track, score: Mapping[str, Any]) -> list[str]:
    """Draw a disc for each reflector that is present, a ring for each that has fallen."""
    parts = []
    for gap, crossing in zip(track.gaps, score["crossings"], strict=True):
        fill, what = ("#ffd43b", "hangs") if crossing["reflector"] else ("none", "has fallen")
        parts.append(
            f'<g><circle cx="{gap.x:.4g}" cy="{gap.y:.4g}" r="0.11" fill="{fill}" '
            'stroke="#e67700" stroke-width="0.04"/>'
            f"<title>the track resumes here; its retroreflector {what}</title></g>"
        )
    return parts


def _points(score: Mapping[str, Any]) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for _, x, y, _ in score["path"]]


def _way(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in points)


def _path(score: Mapping[str, Any], number: int) -> list[str]:
    points = _points(score)
    if not points:
        return []
    colour, dash = PATH_COLOURS[number % len(PATH_COLOURS)], _DASHES[number % len(_DASHES)]
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    parts = [
        f'<path d="{_way(points)}" fill="none" stroke="{colour}" stroke-width="0.035"{dashes}/>'
    ]
    x, y = points[-1]
    parts.append(
        f'<circle cx="{x:.3f}" cy="{y:.3f}" r="0.09" fill="{colour}"><title>end of the '
        "run</title></circle>"
    )
    for each in score["penalties"]:
        text = escape(f"{each['kind']} after {each['after']:g} s")
        x, y = each["x"], each["y"]
        parts.append(
            f'<path d="M{x - 0.15:.3f} {y - 0.15:.3f}l0.3 0.3m-0.3 0l0.3 -0.3" '
            'stroke="#e03131" stroke-width="0.06">'
            f"<title>{text}</title></path>"
        )
    return parts


def _driving(score: Mapping[str, Any], number: int, seconds: float) -> str:
    """Animate the rover along its path at its relative speed, in `seconds` in total."""
    rows = score["path"]
    if len(rows) < 2:
        return ""
    begin, end = float(rows[0][0]), float(rows[-1][0])
    times = ";".join(f"{(float(t) - begin) / (end - begin):.4f}" for t, _, _, _ in rows)
    places = ";".join(f"{x:.3f} {y:.3f}" for _, x, y, _ in rows)
    turns = ";".join(f"{math.degrees(float(heading)):.1f}" for _, _, _, heading in rows)
    colour = PATH_COLOURS[number % len(PATH_COLOURS)]
    outline = " ".join(f"{x:g},{y:g}" for x, y in _ROVER)
    clock = f'dur="{seconds:g}s" repeatCount="indefinite" keyTimes="{times}"'
    return (
        f'<g><animateTransform attributeName="transform" type="translate" values="{places}" '
        f"{clock}/>"
        f'<g><animateTransform attributeName="transform" type="rotate" values="{turns}" {clock}/>'
        f'<polygon points="{outline}" fill="{colour}" fill-opacity="0.8" stroke="white" '
        'stroke-width="0.03"/></g></g>'
    )


def _legend(
    score: Mapping[str, Any], number: int, name: str, at: tuple[float, float], width: float
) -> list[str]:
    """Return one line below the plan, in letters small enough to fit."""
    (x, y), text = at, f"{name}: {summary(score)}"
    colour, dash = PATH_COLOURS[number % len(PATH_COLOURS)], _DASHES[number % len(_DASHES)]
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    size = min(0.34, (width - 1.4) / (_LETTER * len(text)))
    return [
        f'<path d="M{x:g} {y + 0.35:g}h0.8" stroke="{colour}" stroke-width="0.06"{dashes}/>',
        f'<text x="{x + 1.0:g}" y="{y + 0.45:g}" font-size="{size:.3f}" '
        f'fill="#222">{escape(text)}</text>',
    ]


def summary(score: Mapping[str, Any]) -> str:
    """Return a run in one line."""
    what = (
        "stopped at the T"
        if score["stopped_at_T"]
        else "finished"
        if score["finished"]
        else "not finished"
    )
    off = (
        ""
        if score["rms_mm"] is None
        else f", {score['rms_mm']:.1f} mm rms, {score['max_mm']:.0f} mm at most"
    )
    count = len(score["penalties"])
    penalties = (
        "no penalty" if count == 0 else f"{count} {'penalty' if count == 1 else 'penalties'}"
    )
    recovered = (
        f", {score['recovered']} of {score['interruptions']} interruptions recovered"
        if score["interruptions"]
        else ""
    )
    return f"{what}, {score['time_s']:.1f} s, {penalties}{recovered}{off}"
