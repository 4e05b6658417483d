"""Small charts as SVG: lines over trials, intervals by name, points, segments and histograms.

Their colours are CSS variables of the page, by day and by night
(coordinator/studies/report/page.py, whose `standalone` turns a chart into a file of its own). Each
series also has its own shape or dash, so no chart depends on colour alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import pairwise

from msgspec import Struct, field

from petrobot.coordinator.studies.report.page import SERIES

PALETTE = tuple(f"var(--{name})" for name in SERIES)
DASHES = ("", "7 3", "2 3", "9 3 2 3", "4 2", "1 2", "12 3", "6 2 2 2")
INK, SOFT, LINE, PAPER = "var(--ink)", "var(--soft)", "var(--line)", "var(--paper)"
TOP, BOTTOM, RIGHT = 40, 46, 18
FONT = 'font-family="system-ui,Segoe UI,Roboto,DejaVu Sans,sans-serif" font-size="12"'
LETTER = 6.6
"""Average width of a letter (px), for margins and legends."""


class Scale(Struct, frozen=True):
    """A linear axis: maps values `low` to `high` to pixels `begin` to `end`."""

    low: float
    high: float
    begin: float
    end: float

    def __call__(self, value: float) -> float:
        """Return the pixel of a value."""
        return self.begin + (value - self.low) / (self.high - self.low) * (self.end - self.begin)

    @property
    def ticks(self) -> list[float]:
        """About six round values."""
        step = _nice((self.high - self.low) / 5)
        first = math.ceil(self.low / step - 1e-9)
        return [i * step for i in range(first, math.floor(self.high / step + 1e-9) + 1)]


def _nice(step: float) -> float:
    power = 10.0 ** math.floor(math.log10(step)) if step > 0 else 1.0
    return next(power * m for m in (1, 2, 2.5, 5, 10) if power * m >= step * 0.999)


def limits(
    values: Sequence[float], *, zero: bool = False, room: float = 0.04
) -> tuple[float, float]:
    """Return the least and the largest finite value with a margin; with `zero`, the axis includes
    0."""
    known = [v for v in values if math.isfinite(v)]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    low = min(0.0, low) if zero else low
    span = high - low
    if span <= 1e-9 * max(abs(low), abs(high), 1e-9):  # all values equal: an axis around them
        span = abs(high) if abs(high) > 1e-9 else 1.0
        room = max(room, 0.04)
    return (low if zero and low == 0.0 else low - room * span), high + room * span


class Chart(Struct):
    """A chart under construction: axes first, then marks."""

    title: str
    x_label: str
    y_label: str
    x: tuple[float, float]
    y: tuple[float, float]
    width: int = 640
    height: int = 320
    left: int = 64
    marks: list[str] = field(default_factory=list)
    legend: list[tuple[str, str]] = field(default_factory=list)
    rows: Sequence[str] = ()
    """Names along the y axis instead of numbers; row i is at y = i."""

    @property
    def xs(self) -> Scale:
        """Scale of the x axis."""
        return Scale(*self.x, self.left, self.width - RIGHT)

    @property
    def ys(self) -> Scale:
        """Scale of the y axis, growing upwards (with rows: downwards)."""
        top, bottom = self._top, self.height - BOTTOM
        return Scale(*self.y, top, bottom) if self.rows else Scale(*self.y, bottom, top)

    @property
    def _top(self) -> int:
        return TOP + 18 * (len(self._placed()[1]) if self.legend else 0)

    def line(self, points: Sequence[tuple[float, float]], name: str, number: int) -> None:
        """Add a curve with its own colour and dash."""
        xs, ys = self.xs, self.ys
        known = [(x, y) for x, y in points if math.isfinite(y)]
        path = " ".join(f"{xs(x):.1f},{ys(y):.1f}" for x, y in known)
        colour, dash = PALETTE[number % len(PALETTE)], DASHES[number % len(DASHES)]
        self.marks.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2" '
            f'stroke-dasharray="{dash}" '
            f'stroke-linejoin="round"><title>{escape(name)}</title></polyline>'
        )

    def dot(self, x: float, y: float, number: int, tip: str) -> None:
        """Add a point whose shape and colour depend on its number."""
        self.marks.append(shape(self.xs(x), self.ys(y), number, tip))

    def segment(
        self, one: tuple[float, float], other: tuple[float, float], number: int, tip: str
    ) -> None:
        """Add a thin line between two points with a mark at its end."""
        (x1, y1), (x2, y2) = ((self.xs(x), self.ys(y)) for x, y in (one, other))
        colour = PALETTE[number % len(PALETTE)]
        self.marks.append(
            f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" '
            f'stroke="{colour}" stroke-opacity="0.3"/>' + shape(x2, y2, number, tip)
        )

    def interval(
        self, row: float, low: float, value: float, high: float, number: int, tip: str
    ) -> None:
        """Add an estimate with its interval in a row."""
        xs, y, colour = self.xs, self.ys(row), PALETTE[number % len(PALETTE)]
        ends = "".join(
            f'<line x1="{xs(v):.1f}" x2="{xs(v):.1f}" y1="{y - 4:.1f}" y2="{y + 4:.1f}" '
            f'stroke="{colour}"/>'
            for v in (low, high)
        )
        bar = (
            f'<line x1="{xs(low):.1f}" x2="{xs(high):.1f}" y1="{y:.1f}" y2="{y:.1f}" '
            f'stroke="{colour}" stroke-width="2"/>'
        )
        self.marks.append(bar + ends + shape(xs(value), y, number, tip))

    def bar(
        self, low: float, high: float, base: float, value: float, number: int, tip: str
    ) -> None:
        """Add a bar of a histogram from `base` to `value`."""
        x1, x2, y1, y2 = self.xs(low), self.xs(high), self.ys(value), self.ys(base)
        colour = PALETTE[number % len(PALETTE)]
        self.marks.append(
            f'<rect x="{x1 + 0.5:.1f}" y="{y1:.1f}" width="{max(0.5, x2 - x1 - 1):.1f}" '
            f'height="{max(0.0, y2 - y1):.1f}" '
            f'fill="{colour}" fill-opacity="0.85"><title>{escape(tip)}</title></rect>'
        )

    def names(self, names: Mapping[str, int] | Sequence[str], *, dashes: bool = False) -> None:
        """Add a legend: names with their numbers, or one for each number."""
        for name, number in (names if isinstance(names, Mapping) else _numbered(names)).items():
            colour = PALETTE[number % len(PALETTE)]
            mark = (
                f'<line x1="-8" x2="10" y1="-4" y2="-4" stroke="{colour}" stroke-width="2" '
                f'stroke-dasharray="{DASHES[number % len(DASHES)]}"/>'
                if dashes
                else shape(0, -4, number, name)
            )
            self.legend.append((mark, name))

    def _placed(self) -> tuple[list[str], list[float]]:
        """Return the legend entries with their positions, and the rows that they use."""
        out, rows, x = [], [0.0], float(self.left)
        for mark, name in self.legend:
            needs = 34 + 1.2 * LETTER * len(name)  # names of regimes have wide + and @
            if x > self.left and x + needs > self.width - RIGHT:
                x = float(self.left)
                rows.append(0.0)
            y = TOP + 18 * (len(rows) - 1) - 4
            out.append(
                f'<g transform="translate({x + 10:.1f} {y})">{mark}<text x="14" y="0" '
                f'fill="{INK}">{escape(name)}</text></g>'
            )
            x += needs
        return out, rows

    def svg(self) -> str:
        """Return the whole picture as a file."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} '
            f'{self.height}" width="{self.width}" '
            f'height="{self.height}" role="img" {FONT}><title>{escape(self.title)}</title>'
            f'<rect width="100%" height="100%" fill="{PAPER}"/>'
            f'<text x="{self.left}" y="20" fill="{INK}" font-size="14" '
            f'font-weight="600">{escape(self.title)}</text>'
            f"{''.join(self._placed()[0])}{self._axes()}{''.join(self.marks)}</svg>\n"
        )

    def _axes(self) -> str:
        xs, ys = self.xs, self.ys
        top, bottom, right = self._top, self.height - BOTTOM, self.width - RIGHT
        digits = [_digits(scale.ticks) for scale in (xs, ys)]
        parts = [
            f'<line x1="{xs(v):.1f}" x2="{xs(v):.1f}" y1="{top}" y2="{bottom}" stroke="{LINE}"/>'
            f'<text x="{xs(v):.1f}" y="{bottom + 16}" text-anchor="middle" '
            f'fill="{SOFT}">{v:.{digits[0]}f}</text>'
            for v in xs.ticks
        ]
        if self.rows:
            parts += [
                f'<text x="{self.left - 10}" y="{ys(i) + 4:.1f}" text-anchor="end" '
                f'fill="{INK}">{escape(name)}</text>'
                for i, name in enumerate(self.rows)
            ]
        else:
            parts += [
                f'<line x1="{self.left}" x2="{right}" y1="{ys(v):.1f}" y2="{ys(v):.1f}" '
                f'stroke="{LINE}"/>'
                f'<text x="{self.left - 8}" y="{ys(v) + 4:.1f}" text-anchor="end" '
                f'fill="{SOFT}">{v:.{digits[1]}f}</text>'
                for v in ys.ticks
            ]
            parts.append(
                f'<text transform="translate(16 {(top + bottom) / 2:.0f}) rotate(-90)" '
                'text-anchor="middle" '
                f'fill="{SOFT}">{escape(self.y_label)}</text>'
            )
        middle = (self.left + right) / 2
        label = (
            f'<text x="{middle:.0f}" y="{self.height - 8}" text-anchor="middle" '
            f'fill="{SOFT}">{escape(self.x_label)}</text>'
        )
        return "".join([*parts, label])


def _digits(ticks: Sequence[float]) -> int:
    """Return the number of decimals that shows all ticks exactly."""
    step = min((abs(b - a) for a, b in pairwise(ticks)), default=1.0)
    return next((d for d in range(7) if abs(step * 10**d - round(step * 10**d)) < 1e-6), 6)


def shape(x: float, y: float, number: int, tip: str) -> str:
    """Return a mark at a pixel: circle, square, diamond or triangle, in the colour of its
    number."""
    colour, kind = PALETTE[number % len(PALETTE)], number % 4
    title = f"<title>{escape(tip)}</title>"
    if kind == 0:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}">{title}</circle>'
    if kind == 1:
        return (
            f'<rect x="{x - 3.5:.1f}" y="{y - 3.5:.1f}" width="7" height="7" '
            f'fill="{colour}">{title}</rect>'
        )
    corners = ((0, -5), (5, 0), (0, 5), (-5, 0)) if kind == 2 else ((0, -5), (4.6, 4), (-4.6, 4))
    points = " ".join(f"{x + dx:.1f},{y + dy:.1f}" for dx, dy in corners)
    return f'<polygon points="{points}" fill="{colour}">{title}</polygon>'


def lines(
    title: str,
    x_label: str,
    y_label: str,
    curves: Mapping[str, Sequence[tuple[float, float]]],
    *,
    unit: bool = False,
) -> str:
    """Return a chart of curves by name over a common x axis; `unit`: y from 0 to 1."""
    xs = [x for points in curves.values() for x, _ in points]
    ys = [y for points in curves.values() for _, y in points]
    chart = Chart(title, x_label, y_label, limits(xs, room=0.0), (0.0, 1.0) if unit else limits(ys))
    chart.names(list(curves), dashes=True)
    for number, (name, points) in enumerate(curves.items()):
        chart.line(points, name, number)
    return chart.svg()


def intervals(
    title: str,
    x_label: str,
    rows: Sequence[tuple[str, str, float, float, float]],
    *,
    unit: bool = False,
) -> str:
    """Return a chart of estimates with intervals: (row, series, low, value, high); the series of
    one row are drawn below each other."""
    names = list(dict.fromkeys(row for row, *_ in rows))
    series = list(dict.fromkeys(one for _, one, *_ in rows))
    values = [v for *_, low, value, high in rows for v in (low, value, high)]
    chart = Chart(
        title,
        x_label,
        "",
        (0.0, 1.0) if unit else limits(values, zero=True),
        (-0.6, len(names) - 0.4),
        height=TOP + BOTTOM + 40 + len(names) * max(24, 14 * len(series)),
        left=int(28 + 1.15 * LETTER * max(map(len, names), default=0)),
        rows=names,
    )
    if len(series) > 1:
        chart.names(series)
    for name, one, low, value, high in rows:
        number = series.index(one)
        shift = (number - (len(series) - 1) / 2) * 0.7 / max(1, len(series))
        tip = f"{name} {one}: {value:.4g} [{low:.4g}, {high:.4g}]"
        chart.interval(names.index(name) + shift, low, value, high, number, tip)
    return chart.svg()


def points(
    title: str,
    x_label: str,
    y_label: str,
    groups: Mapping[str, Sequence[tuple[tuple[float, ...], str]]],
    numbers: Mapping[str, int] | None = None,
) -> str:
    """Return a chart of points (x, y) or segments (x, y, x2, y2) by group, each with a tooltip.
    `numbers` gives the colour and shape of each group."""
    number_of = numbers or _numbered(groups)
    every = [p for group in groups.values() for p, _ in group]
    xs = [v for p in every for v in p[0::2]]
    ys = [v for p in every for v in p[1::2]]
    chart = Chart(title, x_label, y_label, limits(xs), limits(ys), height=420)
    chart.names({name: number_of[name] for name in groups})
    for name, group in groups.items():
        for place, tip in group:
            if len(place) == 4:
                chart.segment((place[0], place[1]), (place[2], place[3]), number_of[name], tip)
            else:
                chart.dot(place[0], place[1], number_of[name], tip)
    return chart.svg()


def histogram(
    title: str,
    x_label: str,
    groups: Mapping[str, Sequence[float]],
    bins: int = 30,
    *,
    least: float | None = None,
    numbers: Mapping[str, int] | None = None,
    beyond: Mapping[str, str] | None = None,
) -> str:
    """Return a histogram with classes of equal width and stacked groups; the first class begins at
    `least`, if given. `numbers` gives the colour of each group, `beyond` what the legend says of
    the group's values that are not drawn."""
    number_of = numbers or _numbered(groups)
    every = [v for group in groups.values() for v in group]
    low, high = limits(every if least is None else [least, *every], room=0.0)
    high = high if high > low else low + 1.0
    step = (high - low) / bins
    counts = {name: _counts(group, low, step, bins) for name, group in groups.items()}
    tallest = max((sum(c[i] for c in counts.values()) for i in range(bins)), default=1)
    chart = Chart(title, x_label, "count", (low, high), (0.0, max(1.0, 1.05 * tallest)))
    left_out = beyond or {}
    chart.names({name + left_out.get(name, ""): number_of[name] for name in groups})
    for i in range(bins):
        base = 0
        for name, count in counts.items():
            if count[i]:
                tip = f"{name}: {count[i]} from {low + i * step:.4g} to {low + (i + 1) * step:.4g}"
                chart.bar(
                    low + i * step,
                    low + (i + 1) * step,
                    base,
                    base + count[i],
                    number_of[name],
                    tip,
                )
                base += count[i]
    return chart.svg()


def _numbered(names: Iterable[str]) -> dict[str, int]:
    return {name: number for number, name in enumerate(names)}


def _counts(values: Sequence[float], low: float, step: float, bins: int) -> list[int]:
    out = [0] * bins
    for value in values:
        out[min(bins - 1, max(0, int((value - low) / step)))] += 1
    return out
