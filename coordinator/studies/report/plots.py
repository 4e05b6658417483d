"""Pictures that a task declares itself: `plots` in its score says which columns to draw, and how.

    plots = { catch_map = { kind = "lines", title = "...", x = "table.column", y = "...", x2 =
    "...", y2 = "...",
                            x_label = "... (m)", y_label = "... (m)", colour = "table.column" } }

kind: `points` (x, y), `lines` (to x2, y2) or `histogram` (x; between `least` and `most`, if given:
values above `most` are counted in the legend). `pictures` in a score holds finished SVG texts by
title.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import Any

from petrobot.coordinator.studies.report import charts

PICTURES = "pictures"
TRUTH = ("yes", "no")
"""Groups of a column of truth values; they have the first two colours."""
MOST = 4000
"""Largest number of marks in one picture; of more, every k-th is drawn."""


def declared(plots: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return, by name, the SVG of every declared picture for which the rows have values; each row
    is the score of one trial."""
    out = {}
    for name, plot in plots.items():
        if not isinstance(plot, Mapping) or "x" not in plot:
            continue
        numbers = _numbers(plot, rows)
        make = _histogram if plot.get("kind") == "histogram" else _points
        made = make(plot, rows, numbers)
        if made is not None:
            out[str(name)] = made
    return out


def _numbers(plot: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Return the number of the colour of each group. It depends on the name, not on how many trials
    are in which group: the same word has the same colour in every picture and report. If two names
    of one picture come to the same colour, the later one in the alphabet takes the next free."""
    groups = {_group(plot, row) for row in rows}
    out = {name: number for number, name in enumerate(TRUTH) if name in groups}
    for name in sorted(groups - set(TRUTH)):
        number = blake2b(name.encode()).digest()[0] % len(charts.PALETTE)
        while number in out.values() and len(out) < len(charts.PALETTE):
            number = (number + 1) % len(charts.PALETTE)
        out[name] = number
    return out


def _points(
    plot: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], numbers: Mapping[str, int]
) -> str | None:
    names = [
        str(plot[key])
        for key in (("x", "y", "x2", "y2") if plot.get("kind") == "lines" else ("x", "y"))
    ]
    groups: dict[str, list[tuple[tuple[float, ...], str]]] = {}
    for i, row in enumerate(rows[:: max(1, -(-len(rows) // MOST))]):
        place = [_number(row.get(name)) for name in names]
        if not any(math.isnan(v) for v in place):
            tip = ", ".join(
                f"{name.rpartition('.')[2]} {v:.4g}" for name, v in zip(names, place, strict=True)
            )
            groups.setdefault(_group(plot, row), []).append(
                (tuple(place), f"{row.get('n', i + 1)}: {tip}")
            )
    if not groups:
        return None
    title = str(plot.get("title", ""))
    return charts.points(
        title,
        str(plot.get("x_label", names[0])),
        str(plot.get("y_label", names[1])),
        _sorted(groups),
        numbers,
    )


def _histogram(
    plot: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], numbers: Mapping[str, int]
) -> str | None:
    groups: dict[str, list[float]] = {}
    beyond: dict[str, int] = {}
    most = float(plot.get("most", math.inf))
    for row in rows:
        value, name = _number(row.get(str(plot["x"]))), _group(plot, row)
        if math.isnan(value):
            continue
        shown = groups.setdefault(name, [])
        if value <= most:
            shown.append(value)
        else:
            beyond[name] = beyond.get(name, 0) + 1
    if not groups:
        return None
    least = float(plot["least"]) if "least" in plot else None
    return charts.histogram(
        str(plot.get("title", "")),
        str(plot.get("x_label", plot["x"])),
        _sorted(groups),
        least=least,
        numbers=numbers,
        beyond={name: f" ({n} beyond {most:g})" for name, n in beyond.items()},
    )


def _group(plot: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    value = row.get(str(plot["colour"])) if "colour" in plot else None
    return (
        {None: "", True: "yes", False: "no"}.get(value, str(value))
        if isinstance(value, bool | None)
        else str(value)
    )


def _sorted(groups: Mapping[str, Any]) -> dict[str, Any]:
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def finished(result: Mapping[str, Any]) -> dict[str, str]:
    """Return the finished SVG texts in a score, by title."""
    given = result.get(PICTURES, {})
    if not isinstance(given, Mapping):
        return {}
    return {
        str(name): str(svg) for name, svg in given.items() if str(svg).lstrip().startswith("<svg")
    }
