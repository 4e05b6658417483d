"""Charts: well-formed, everything inside the picture, and marks at the right positions."""

from __future__ import annotations

import hashlib
import math
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.studies.report import charts, page as colours, raster
from petrobot.coordinator.studies.report.charts import Chart, Scale, limits

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False)


def elements(svg: str) -> list[ElementTree.Element]:
    """Return all elements of a picture, which must be a well-formed XML document."""
    return list(ElementTree.fromstring(svg).iter())


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=20))
def test_lines_stay_inside_for_any_numbers(points: list[tuple[float, float]]) -> None:
    """Every vertex is inside the picture."""
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
    [
        ([], False, (-0.04, 1.04)),
        ([3.0], True, (0.0, 3.12)),
        ([math.nan, 1.0, 2.0], False, (0.96, 2.04)),
    ],
)
def test_limits(values: list[float], zero: bool, expected: tuple[float, float]) -> None:
    """Limits leave room on both sides, or start from zero on request."""
    assert limits(values, zero=zero) == pytest.approx(expected)


def test_histogram_counts_every_value_once() -> None:
    """The heights of stacked groups are their counts."""
    svg = charts.histogram("t", "s", {"a": [0.0, 0.1, 1.0], "b": [1.0]}, bins=2)
    tips = [e.text or "" for e in elements(svg) if e.tag.endswith("title")]
    counts = [int(found.group(1)) for tip in tips if (found := re.match(r"\w: (\d+) from", tip))]
    assert sum(counts) == 4


def test_intervals_name_rows_and_series() -> None:
    """There is a row for each name, and a mark with a tooltip for each estimate."""
    svg = charts.intervals(
        "R", "R", [("act", "A", 0.2, 0.5, 0.7), ("act", "B", 0.1, 0.2, 0.3)], unit=True
    )
    texts = [e.text for e in elements(svg) if e.tag.endswith("text")]
    assert {"act", "A", "B"} <= set(texts)
    assert "act A: 0.5 [0.2, 0.7]" in svg


def test_a_long_legend_is_wrapped() -> None:
    """Names stay inside the picture."""
    chart = Chart("t", "x", "y", (0.0, 1.0), (0.0, 1.0))
    chart.names([f"a rather long name, number {i}" for i in range(8)])
    places = [
        float(m.group(1)) for m in re.finditer(r'<g transform="translate\(([\d.]+) ', chart.svg())
    ]
    assert max(places) + 34 + charts.LETTER * 28 <= 640 + 34
    assert (
        len(
            set(
                re.findall(
                    r'translate\([\d.]+ ([\d.-]+)\)"><circle|translate\([\d.]+ ([\d.-]+)\)',
                    chart.svg(),
                )
            )
        )
        > 1
    )


def test_shapes_differ_by_more_than_colour() -> None:
    """There are four kinds of marks."""
    assert len({charts.shape(0, 0, i, "").split(" ")[0] for i in range(2)}) == 2
    corners = {re.sub(r'fill="[^"]+"', "", charts.shape(0, 0, i, "")) for i in range(4)}
    assert len(corners) == 4


def test_a_picture_in_its_own_file_has_the_light_colours() -> None:
    """A picture in its own file uses no variable of the page. Colours from elsewhere stay as they
    are."""
    svg = charts.points("t", "x", "y", {str(i): [((float(i), 1.0), "tip")] for i in range(9)})
    assert {f"var(--{name})" for name in colours.SERIES} <= set(
        re.findall(r"var\(--[a-z0-9-]+\)", svg)
    )
    alone = colours.standalone(svg)
    assert "var(" not in alone
    assert all(
        colours.LIGHT[name] in alone for name in (*colours.SERIES, "ink", "soft", "line", "paper")
    )
    assert (
        colours.standalone("<svg fill='var(--mine)'/>")
        == "<svg xmlns=\"http://www.w3.org/2000/svg\" fill='var(--mine)'/>"
    )


def _luminance(colour: str) -> float:
    """Return the relative luminance (WCAG 2.2)."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    """Return the contrast ratio (WCAG 2.2), 1 to 21."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", [colours.LIGHT, colours.DARK], ids=["day", "night"])
def test_text_and_marks_have_enough_contrast(scheme: dict[str, str]) -> None:
    """WCAG 2.2 level AA on paper and panel: 4.5 for text, 3 for marks on dark; marks on light have
    the colours of Okabe and Ito."""
    for ground in (scheme["paper"], scheme["panel"]):
        assert all(contrast(scheme[name], ground) >= 4.5 for name in ("ink", "soft"))
        if scheme is colours.DARK:
            assert all(
                contrast(scheme[name], ground) >= 3.0
                for name in (*colours.SERIES, "success", "failure", "error")
            )


def test_a_picture_becomes_a_png_with_its_text() -> None:
    """The decoded image has twice the size, a white background, and a title."""
    image = cv2.imdecode(
        np.frombuffer(
            raster.png(colours.standalone(charts.lines("Title", "x", "y", {}))), np.uint8
        ),
        1,
    )
    bare = cv2.imdecode(
        np.frombuffer(raster.png(colours.standalone(charts.lines("", "x", "y", {}))), np.uint8), 1
    )
    assert image is not None and bare is not None and image.shape == (640, 1280, 3)
    assert image[0, 0].tolist() == [255, 255, 255] and image.min() < 60
    rows, columns = np.nonzero(np.any(image != bare, axis=2))
    assert len(rows) > 100 and rows.max() < 60 and columns.min() > 100
    with pytest.raises(raster.RasterError, match="not an SVG"):
        raster.png("<svg")


def test_without_resvg_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line is printed and no picture is made."""
    monkeypatch.setitem(sys.modules, "resvg_py", None)
    raster.unavailable.cache_clear()
    try:
        with pytest.raises(raster.RasterError, match="resvg-py"):
            raster.png("<svg/>")
    finally:
        raster.unavailable.cache_clear()


def test_a_missing_font_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No picture is made, as its text would be missing."""
    monkeypatch.setattr(raster, "FONT", tmp_path / "gone.ttf")
    raster.unavailable.cache_clear()
    try:
        assert "gone.ttf" in raster.unavailable()
    finally:
        raster.unavailable.cache_clear()


def test_text_is_drawn_only_with_the_shipped_font() -> None:
    """The font equals the published one to the byte, and no font of the host is used, whatever the
    picture names."""
    assert hashlib.sha256(raster.FONT.read_bytes()).hexdigest() == (
        "3fdf69cabf06049ea70a00b5919340e2ce1e6d02b0cc3c4b44fb6801bd1e0d22"
    )
    picture = (
        '<svg xmlns="http://www.w3.org/2000/svg" width="90" height="20">'
        '<text y="15" font-family="{}">W&#246;rter: &#961; &#8804; 1</text></svg>'
    )
    named, others = (
        raster.png(picture.format("DejaVu Sans")),
        ("Liberation Serif", "monospace", "system-ui"),
    )
    assert all(raster.png(picture.format(family)) == named for family in others)
