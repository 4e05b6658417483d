"""Pictures of a report as PNG, for papers and mails that do not accept SVG: rendered by resvg at
twice the size of the SVG.

resvg is one wheel without system dependencies. A browser or Cairo would have to be installed
separately, and OpenCV does not draw SVG. Text is drawn only with the font shipped beside this file,
so a picture looks the same on every host.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from petrobot.services.host.toml_text import InputError

SCALE = 2.0
"""Pixels of the PNG for each pixel of the SVG: sharp on dense screens and in print."""
PAPER = "#ffffff"
REMEDY = 'pip install "resvg-py>=0.5,<1"'
FONT = Path(__file__).parent / "fonts" / "DejaVuSans.ttf"
"""DejaVu Sans 2.35 as its authors published it, with its licence beside it."""
FAMILY = "DejaVu Sans"


class RasterError(InputError):
    """No PNG can be made; the text says what is missing or wrong and what to do."""


def png(svg: str, scale: float = SCALE) -> bytes:
    """Render a standalone SVG text as PNG on white. Raises RasterError."""
    missing = unavailable()
    if missing:
        raise RasterError(missing)
    try:
        return bytes(
            _resvg().svg_to_bytes(
                svg_string=svg,
                background=PAPER,
                zoom=scale,
                skip_system_fonts=True,
                font_files=[str(FONT)],
                font_family=FAMILY,
                sans_serif_family=FAMILY,
                serif_family=FAMILY,
                monospace_family=FAMILY,
            )
        )
    except ValueError as fault:
        raise RasterError(f"the picture is not an SVG that can be rendered: {fault}") from fault


@cache
def unavailable() -> str:
    """Return why this installation cannot make a PNG, and what to do; empty if it can."""
    try:
        _resvg()
    except ImportError:
        return f"resvg is not installed: {REMEDY}"
    if not FONT.is_file():
        return f"{FONT}: the font of the pictures is missing; install petrobot again"
    return ""


def _resvg() -> Any:
    return import_module("resvg_py")
