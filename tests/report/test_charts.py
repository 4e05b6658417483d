"""Charts: well-formed, everything inside, and marks where the numbers say."""

from __future__ import annotations

import math
import re
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.report import charts
from coordinator.report.charts import Chart, Scale, limits

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False)


def elements(svg: str) -> list[ElementTree.Element]:
    """All elements of a picture; it is well-formed XML of its own."""
    return list(ElementTree.fromstring(svg).iter())


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=20))
def test_lines_stay_inside_whatever_the_numbers(points: list[tuple[float, float]]) -> None:
    """Every vertex lies within the picture."""
    svg = charts.lines("a < b", "x", "y", {"one & two": points})
    (line,) = [e for e in elements(svg) if e.tag.endswith("polyline")]
    for pair in line.attrib["points"].split():
        x, y = (float(v) for v in pair.split(","))
        assert 0 <= x <= 640 and 0 <= y <= 320


@given(NUMBERS, st.floats(1e-6, 1e6))
def test_ticks_are_round_and_inside(low: float, span: float) -> None:
    """Between two and nine of them."""
    scale = Scale(low, low + span, 0.0, 100.0)
    if abs(low) / span > 1e6:
        return
    assert 2 <= len(scale.ticks) <= 9
    assert all(-1e-6 <= scale(v) <= 100.0 + 1e-6 for v in scale.ticks)


def test_scale_by_hand() -> None:
    """0 to 10 on 100 to 200 pixels."""
    scale = Scale(0.0, 10.0, 100.0, 200.0)
    assert [scale(v) for v in (0, 5, 10)] == [100.0, 150.0, 200.0]
    assert scale.ticks == [0, 2, 4, 6, 8, 10]


@pytest.mark.parametrize(
    ("values", "zero", "expected"),
    [([], False, (-0.04, 1.04)), ([3.0], True, (0.0, 3.12)), ([math.nan, 1.0, 2.0], False, (0.96, 2.04))],
)
def test_limits(values: list[float], zero: bool, expected: tuple[float, float]) -> None:
    """Room on both sides, from zero on if asked."""
    assert limits(values, zero=zero) == pytest.approx(expected)


def test_histogram_counts_every_value_once() -> None:
    """Stacked groups: the heights are the counts."""
    svg = charts.histogram("t", "s", {"a": [0.0, 0.1, 1.0], "b": [1.0]}, bins=2)
    tips = [e.text or "" for e in elements(svg) if e.tag.endswith("title")]
    counts = [int(found.group(1)) for tip in tips if (found := re.match(r"\w: (\d+) from", tip))]
    assert sum(counts) == 4


def test_intervals_name_rows_and_series() -> None:
    """A row for each name, a mark for each estimate with its tip."""
    svg = charts.intervals("R", "R", [("act", "A", 0.2, 0.5, 0.7), ("act", "B", 0.1, 0.2, 0.3)], unit=True)
    texts = [e.text for e in elements(svg) if e.tag.endswith("text")]
    assert {"act", "A", "B"} <= set(texts)
    assert "act A: 0.5 [0.2, 0.7]" in svg


def test_a_long_legend_breaks() -> None:
    """Names never leave the picture."""
    chart = Chart("t", "x", "y", (0.0, 1.0), (0.0, 1.0))
    chart.names([f"a rather long name, number {i}" for i in range(8)])
    places = [float(m.group(1)) for m in re.finditer(r'<g transform="translate\(([\d.]+) ', chart.svg())]
    assert max(places) + 34 + charts.LETTER * 28 <= 640 + 34
    assert (
        len(set(re.findall(r'translate\([\d.]+ ([\d.-]+)\)"><circle|translate\([\d.]+ ([\d.-]+)\)', chart.svg()))) > 1
    )


def test_shapes_differ_by_more_than_colour() -> None:
    """Four kinds of marks."""
    assert len({charts.shape(0, 0, i, "").split(" ")[0] for i in range(2)}) == 2
    corners = {re.sub(r'fill="[^"]+"', "", charts.shape(0, 0, i, "")) for i in range(4)}
    assert len(corners) == 4
