"""Draw the figures of docs/mobile.md from measurements and print their tables; that page has the
commands.

python -m tests.mobile.figures learning LEARNING_FOLDER FIXED_FOLDER... --out
docs/pictures/track-learning.svg python -m tests.mobile.figures speed 0.8=slow.log 1.2=fast.log
--out docs/pictures/track-speed.svg
"""

from __future__ import annotations

import argparse
import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec import Struct
from scipy import stats

from tests.mobile.measure import wilson

TASK = "recover_track"
COLOURS = {"home_on_reflector": "#1f5fbf", "dead_reckon": "#d9541e", "search_pattern": "#2a8f4f"}
WIDTH, HEIGHT, LEFT, TOP = 420.0, 250.0, 50.0, 34.0
RUN = re.compile(r"^\d+ (ok |BAD) +([\d.]+) s,.* rms ([\d.]+) max ([\d.]+) mm")


class FigureRow(Struct, frozen=True):
    """One run of a campaign: its regime, the recovery that was chosen first, and how long it took
    (s)."""

    regime: str
    action: str
    seconds: float
    good: bool


def main() -> None:
    """Parse and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    learning = commands.add_parser("learning")
    learning.add_argument("learned", type=Path)
    learning.add_argument("fixed", type=Path, nargs="+")
    learning.set_defaults(act=draw_learning)
    speed = commands.add_parser("speed")
    speed.add_argument("logs", nargs="+")
    speed.set_defaults(act=draw_speed)
    for each in (learning, speed):
        each.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.act(options)


# --- learning ---------------------------------------------------------------------------------


def draw_learning(options: argparse.Namespace) -> None:
    """Draw a panel for each regime: runs of the learning campaign, and the means of the campaigns
    with a fixed choice."""
    learned = read(options.learned)
    fixed = [row for folder in options.fixed for row in read(folder)]
    regimes = list(dict.fromkeys(row.regime for row in learned))
    panels = []
    for number, regime in enumerate(regimes):
        mine = [row for row in learned if row.regime == regime]
        others = {a: [r for r in fixed if (r.regime, r.action) == (regime, a)] for a in COLOURS}
        panels.append(_learning_panel(number, regime, mine, others))
        _tell(regime, mine, others)
    options.out.write_text(_svg(len(regimes), panels), encoding="utf-8")


def read(folder: Path) -> list[FigureRow]:
    """The rows of a campaign's table."""
    with (folder / "table.csv").open(encoding="utf-8", newline="") as file:
        return [
            FigureRow(
                line["regime"],
                line[f"chosen.{TASK}"],
                float(line["mission_s"]),
                line["score.finished"] == "true" and line["score.stopped_at_T"] == "true",
            )
            for line in csv.DictReader(file)
        ]


def mean_of(seconds: Sequence[float]) -> tuple[float, float]:
    """Mean and half its 95 % interval (Student)."""
    count = len(seconds)
    mean = sum(seconds) / count
    if count < 2:
        return mean, math.nan
    deviation = math.sqrt(sum((each - mean) ** 2 for each in seconds) / (count - 1))
    return mean, float(stats.t.ppf(0.975, count - 1)) * deviation / math.sqrt(count)


def _tell(
    regime: str, mine: Sequence[FigureRow], others: Mapping[str, Sequence[FigureRow]]
) -> None:
    for action, rows in others.items():
        mean, half = mean_of([row.seconds for row in rows])
        print(
            f"{regime}: {action}: {mean:.1f} +- {half:.1f} s, {sum(r.good for r in rows)} of "
            f"{len(rows)} at the T, alone"
        )
    parts = {
        "all": mine,
        "last half": mine[len(mine) // 2 :],
        "last third": mine[-(len(mine) // 3) :],
    }
    for name, rows in parts.items():
        mean, half = mean_of([row.seconds for row in rows])
        chosen = {action: sum(row.action == action for row in rows) for action in COLOURS}
        good = sum(row.good for row in rows)
        print(
            f"{regime}: learning, {name}: {mean:.1f} +- {half:.1f} s, {good} of {len(rows)} "
            f"at the T, chose {chosen}"
        )


def _learning_panel(
    number: int, regime: str, mine: Sequence[FigureRow], others: Mapping[str, Sequence[FigureRow]]
) -> str:
    most = 1.1 * max(row.seconds for row in (*mine, *(r for rows in others.values() for r in rows)))
    panel = _Panel(
        number,
        (0.0, len(mine) + 1.0),
        (0.0, most),
        f"{regime}, s a run",
        "run of the campaign that learns",
    )
    for action, rows in others.items():
        mean, half = mean_of([row.seconds for row in rows])
        panel.band(mean - half, mean + half, mean, COLOURS[action])
    for n, row in enumerate(mine, 1):
        panel.dot(n, row.seconds, COLOURS.get(row.action, "#666"))
    panel.grid([0, *range(10, len(mine) + 1, 10)], range(0, round(most), 10))
    return panel.text()


# --- speed ------------------------------------------------------------------------------------


def draw_speed(options: argparse.Namespace) -> None:
    """Draw the share of runs that finished and stopped at the T over the requested speed, with 95 %
    intervals."""
    shares = []
    for given in options.logs:
        speed, _, path = given.partition("=")
        runs = [
            found
            for line in Path(path).read_text(encoding="utf-8").splitlines()
            if (found := RUN.match(line))
        ]
        good, count = sum(found[1] == "ok " for found in runs), len(runs)
        low, high = wilson(good, count)
        shares.append((float(speed), good / count, low, high))
        times = [float(found[2]) for found in runs if found[1] == "ok "]
        rms = [float(found[3]) for found in runs]
        print(
            f"{speed} m/s: {good} of {count} ({low:.1%} to {high:.1%}), mean "
            f"{sum(times) / len(times):.1f} s, "
            f"rms mean {sum(rms) / count:.1f} worst {max(rms):.1f} mm, max "
            f"{max(float(f[4]) for f in runs):.0f} mm"
        )
    panel = _Panel(
        0, (0.4, 1.3), (80.0, 101.0), "finished and stopped at the T, %", "speed asked for, m/s"
    )
    panel.line(95.0)
    for speed, share, low, high in sorted(shares):
        panel.bar(speed, 100.0 * low, 100.0 * high, COLOURS["home_on_reflector"])
        panel.dot(speed, 100.0 * share, COLOURS["home_on_reflector"])
    panel.grid([0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2], range(80, 101, 5))
    options.out.write_text(_svg(1, [panel.text()], legend=False), encoding="utf-8")


# --- drawing ----------------------------------------------------------------------------------


class _Panel:
    """One pair of axes."""

    def __init__(
        self, number: int, x: tuple[float, float], y: tuple[float, float], title: str, below: str
    ) -> None:
        self._left = LEFT + number * (WIDTH + LEFT + 10.0)
        self._x, self._y = x, y
        middle = self._left + 0.5 * WIDTH
        self._parts = [
            f'<text x="{self._left:.0f}" y="{TOP - 10:.0f}" font-weight="bold">{title}</text>',
            f'<text x="{middle:.0f}" y="{TOP + HEIGHT + 34:.0f}" '
            f'text-anchor="middle">{below}</text>',
            f'<rect x="{self._left:.0f}" y="{TOP:.0f}" width="{WIDTH:.0f}" '
            f'height="{HEIGHT:.0f}" fill="none" stroke="#999"/>',
        ]

    def _at(self, x: float, y: float) -> tuple[float, float]:
        (x0, x1), (y0, y1) = self._x, self._y
        return self._left + WIDTH * (x - x0) / (x1 - x0), TOP + HEIGHT * (
            1.0 - (y - y0) / (y1 - y0)
        )

    def grid(self, xs: Sequence[float], ys: Sequence[float]) -> None:
        """Numbers at the axes."""
        for x in xs:
            px, _ = self._at(x, self._y[0])
            self._parts.append(
                f'<text x="{px:.1f}" y="{TOP + HEIGHT + 15:.0f}" text-anchor="middle">{x:g}</text>'
            )
        for y in ys:
            _, py = self._at(self._x[0], y)
            self._parts.append(
                f'<text x="{self._left - 5:.0f}" y="{py + 4:.1f}" text-anchor="end">{y:g}</text>'
            )

    def band(self, low: float, high: float, middle: float, colour: str) -> None:
        """A mean and its interval over the whole width."""
        (_, top), (_, bottom), (_, at) = (self._at(self._x[0], y) for y in (high, low, middle))
        place = (
            f'x="{self._left:.0f}" y="{top:.1f}" width="{WIDTH:.0f}" height="{bottom - top:.1f}"'
        )
        self._parts.append(f'<rect {place} fill="{colour}" opacity=".18"/>')
        self._parts.append(_line((self._left, at), (self._left + WIDTH, at), colour))

    def line(self, y: float) -> None:
        """A dashed level."""
        _, at = self._at(self._x[0], y)
        self._parts.append(
            _line((self._left, at), (self._left + WIDTH, at), "#999", ' stroke-dasharray="5 4"')
        )

    def bar(self, x: float, low: float, high: float, colour: str) -> None:
        """An interval."""
        self._parts.append(
            _line(self._at(x, low), self._at(x, high), colour, ' stroke-width="3" opacity=".5"')
        )

    def dot(self, x: float, y: float, colour: str) -> None:
        """A run or a share."""
        px, py = self._at(x, y)
        self._parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="4" fill="{colour}"/>')

    def text(self) -> str:
        """The panel."""
        return "\n".join(self._parts)


def _line(begin: tuple[float, float], end: tuple[float, float], colour: str, more: str = "") -> str:
    (x1, y1), (x2, y2) = begin, end
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}"{more}/>'
    )


def _svg(panels: int, parts: Sequence[str], *, legend: bool = True) -> str:
    width, height = panels * (WIDTH + LEFT + 10.0) + 20.0, TOP + HEIGHT + (70.0 if legend else 44.0)
    names = []
    for number, (action, colour) in enumerate(COLOURS.items() if legend else ()):
        x, y = LEFT + 160.0 * number, height - 10.0
        names.append(f'<circle cx="{x:.0f}" cy="{y - 4:.0f}" r="4" fill="{colour}"/>')
        names.append(f'<text x="{x + 9:.0f}" y="{y:.0f}">{action}</text>')
    if legend:
        note = "dots: the campaign that learns; lines: one choice alone, mean and 95 %"
        names.append(
            f'<text x="{LEFT + 520.0:.0f}" y="{height - 10.0:.0f}" fill="#555">{note}</text>'
        )
    box, font = f'viewBox="0 0 {width:.0f} {height:.0f}"', 'font-family="sans-serif" font-size="12"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {box} {font}>'
    return "\n".join(
        [head, '<rect width="100%" height="100%" fill="#fff"/>', *parts, *names, "</svg>\n"]
    )


if __name__ == "__main__":
    main()
