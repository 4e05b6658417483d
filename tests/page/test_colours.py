"""The page's colours in both themes: contrast of text and of controls (WCAG 2.1, 1.4.3, 1.4.11)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import petrobot.coordinator.page

CSS = Path(petrobot.coordinator.page.__file__).parent / "static" / "style" / "base.css"
TEXT = 4.5
CONTROL = 3.0
GROUNDS = ("surface", "raised", "bg", "paper")
SOFT = ("accent", "ok", "warn", "bad", "hold")
PAIRS = [
    *((text, ground, TEXT) for text in ("text", "muted") for ground in GROUNDS),
    *((text, f"{ground}-soft", TEXT) for text in ("text", "muted") for ground in SOFT),
    *((text, ground, TEXT) for text in SOFT for ground in ("surface", f"{text}-soft")),
    *(("on-colour", ground, TEXT) for ground in (*SOFT, "muted")),
    *(("line-strong", ground, CONTROL) for ground in ("surface", "raised")),
    ("idle", "paper", CONTROL),
]


def colours(selector: str) -> dict[str, str]:
    """Return the colours of a theme by name."""
    css = CSS.read_text(encoding="utf-8")
    block = css[css.index(selector) :].partition("}")[0]
    return dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", block))


def luminance(colour: str) -> float:
    """Return the relative luminance of an sRGB colour (WCAG 2.1)."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (v / 12.92 if v <= 0.03928 else ((v + 0.055) / 1.055) ** 2.4 for v in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@pytest.mark.parametrize("theme", [":root {", ':root[data-theme="dark"] {'])
def test_text_and_controls_have_enough_contrast(theme: str) -> None:
    found = colours(theme)
    low = {}
    for front, ground, least in PAIRS:
        dark, light = sorted((luminance(found[front]), luminance(found[ground])))
        if (ratio := (light + 0.05) / (dark + 0.05)) < least:
            low[front, ground] = round(ratio, 2)
    assert low == {}
