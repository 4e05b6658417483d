"""Measure R(n) and C(n) of the mean of n pictures, and draw them: `python plot.py [RUNS]`.

It runs one campaign in which the actions take turns, reads its table, and writes `pictures.svg`.
The curve is the theory for Gaussian noise: R(n) = 1 - exp(-n a^2 / (2 s^2)), with accuracy a and
noise s.
"""

import csv
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from math import exp, sqrt
from pathlib import Path

HERE = Path(__file__).parent
TARGET, ACCURACY, NOISE, MOST = 0.9, 1.0, 1.0, 14
LEFT, TOP, WIDTH, HEIGHT = 60, 20, 480, 240


def measured(runs: int, folder: Path) -> dict[int, tuple[int, int]]:
    """Return for each n how many runs there were, and how many met the specification."""
    command = [sys.executable, "-m", "petrobot", "campaign", str(HERE / "locate.toml")]
    command += ["--runs", str(runs), "--selector", "round_robin", "--out", str(folder), "--quiet"]
    subprocess.run(command, check=True)
    found: dict[int, tuple[int, int]] = {}
    with (folder / "table.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            for run in json.loads(row["runs"]):
                n = int(run[1].rpartition("_")[2])  # place, action, begun, took, status, ...
                count, met = found.get(n, (0, 0))
                found[n] = count + 1, met + (run[4] == "success")
    return dict(sorted(found.items()))


def theory(n: float) -> float:
    """Return the probability that the mean of n pictures is accurate enough."""
    return 1 - exp(-n * ACCURACY**2 / (2 * NOISE**2))


def svg(found: Mapping[int, tuple[int, int]]) -> str:
    """Draw R(n) with 95 % intervals beside its theory, and C(n) = n."""

    def at(n: float, share: float) -> str:
        return f"{LEFT + WIDTH * n / MOST:.1f},{TOP + HEIGHT * (1 - share):.1f}"

    def line(a: str, b: str, more: str) -> str:
        (x1, y1), (x2, y2) = a.split(","), b.split(",")
        return f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" {more}/>'

    def text(at: str, words: str, more: str = "") -> str:
        x, y = at.split(",")
        return f'<text x="{x}" y="{y}" {more}>{words}</text>'

    curve = " ".join(at(n / 10, theory(n / 10)) for n in range(MOST * 10 + 1))
    parts = [
        f'<polyline points="{curve}" fill="none" stroke="#1f5fa8"/>',
        line(at(0, 0), at(MOST, 1), 'stroke="#b25a00"'),
        line(at(0, TARGET), at(MOST, TARGET), 'stroke="#777" stroke-dasharray="4 3"'),
        line(at(0, 0), at(MOST, 0), 'stroke="#000"'),
        line(at(0, 0), at(0, 1), 'stroke="#000"'),
        text(at(MOST, TARGET), f" target {TARGET:g}"),
        text(at(MOST, 1), f" C(n) = n, {MOST} at the top", 'fill="#b25a00"'),
        text(at(MOST, 0.945), " R(n)", 'fill="#1f5fa8"'),
        text(at(MOST / 2, -0.15), "pictures n", 'text-anchor="middle"'),
    ]
    for n, (count, met) in found.items():
        share = met / count
        half = 1.96 * sqrt(max(share * (1 - share), 1 / count) / count)
        low, high = max(0.0, share - half), min(1.0, share + half)
        x, y = at(n, share).split(",")
        parts.append(line(at(n, low), at(n, high), 'stroke="#1f5fa8"'))
        parts.append(f'<circle cx="{x}" cy="{y}" r="3.5" fill="#1f5fa8"/>')
        parts.append(text(at(n, -0.07), str(n), 'text-anchor="middle"'))
    enough = [n for n, (count, met) in found.items() if met / count >= TARGET]
    if enough:
        best = min(enough)
        parts.append(line(at(best, 0), at(best, 1), 'stroke="#2a7a2a" stroke-dasharray="2 2"'))
        parts.append(text(at(best, 0.03), f" cheapest: {best}", 'fill="#2a7a2a"'))
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="660" height="320" '
        f'font-family="sans-serif" font-size="12">\n'
        f'<rect width="660" height="320" fill="#fff"/>\n{body}\n</svg>\n'
    )


def main() -> None:
    """Measure, print, draw."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1200
    with tempfile.TemporaryDirectory() as folder:
        found = measured(runs, Path(folder) / "campaign")
    for n, (count, met) in found.items():
        print(f"n {n:2}   C {n:2}   R {met / count:.3f} of {count} runs, in theory {theory(n):.3f}")
    enough = [n for n, (count, met) in found.items() if met / count >= TARGET]
    print(f"cheapest n with R of at least {TARGET:g}: {min(enough) if enough else 'none'}")
    Path("pictures.svg").write_text(svg(found), encoding="utf-8")


if __name__ == "__main__":
    main()
