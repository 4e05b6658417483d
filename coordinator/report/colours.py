"""The colours of report pages and their pictures, by day and by night, and pictures as files of
their own.

Series are those of M. Okabe and K. Ito, "Color Universal Design" (2008), told apart with every kind
of colour vision; by night the darkest are lighter shades of the same hues.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

LIGHT: Mapping[str, str] = {
    "ink": "#1b1f24",
    "soft": "#5b6570",
    "line": "#d7dce1",
    "paper": "#ffffff",
    "panel": "#f5f7f9",
    "success": "#1a7f4b",
    "failure": "#b7791f",
    "error": "#c0362c",
    "none": "#7a8794",
    "series-1": "#0072b2",
    "series-2": "#d55e00",
    "series-3": "#009e73",
    "series-4": "#cc79a7",
    "series-5": "#e69f00",
    "series-6": "#56b4e9",
    "series-7": "#7a6a00",
    "series-8": "#555555",
}
"""By day, and of every picture that is a file of its own."""
DARK: Mapping[str, str] = {
    "ink": "#e8ecf0",
    "soft": "#9aa6b2",
    "line": "#343b43",
    "paper": "#14181c",
    "panel": "#1d2329",
    "success": "#43b97f",
    "failure": "#e0a94a",
    "error": "#ef6f64",
    "none": "#8794a1",
    "series-1": "#3fa0dc",
    "series-2": "#ec7a2c",
    "series-3": "#21b98d",
    "series-4": "#d992ba",
    "series-5": "#e69f00",
    "series-6": "#8accf2",
    "series-7": "#b9a52e",
    "series-8": "#a0a0a0",
}
"""By night."""
SERIES = tuple(name for name in LIGHT if name.startswith("series"))


def variables(colours: Mapping[str, str]) -> str:
    """The colours as CSS variables."""
    return "".join(f"--{name}:{colour};" for name, colour in colours.items())


def standalone(svg: str) -> str:
    """A picture of a page as a file of its own: with the page's light colours and a name space."""
    svg = re.sub(r"var\(--([a-z0-9-]+)\)", lambda found: LIGHT.get(found[1], found[0]), svg)
    return (
        svg
        if "xmlns=" in svg[:400]
        else svg.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    )
