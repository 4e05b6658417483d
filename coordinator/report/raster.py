"""Pictures of a report as PNG, for papers and mails that take no SVG: rendered by resvg, twice the size of the SVG.

resvg is one wheel that needs nothing of the system but its fonts; a browser or Cairo would have to be installed apart, and OpenCV
draws no SVG.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

SCALE = 2.0
"""Pixels of the PNG for one of the SVG: sharp on dense screens and in print."""
PAPER = "#ffffff"
REMEDY = 'pip install "resvg-py>=0.5,<1"'
_PROBE = '<svg xmlns="http://www.w3.org/2000/svg" width="40" height="20"><text y="15" font-family="sans-serif">{}</text></svg>'


class RasterError(Exception):
    """No PNG can be made: what is missing or wrong, and the remedy."""


def png(svg: str, scale: float = SCALE) -> bytes:
    """A standalone SVG text as PNG bytes on white. Raises RasterError."""
    missing = unavailable()
    if missing:
        raise RasterError(missing)
    try:
        return bytes(
            _resvg().svg_to_bytes(svg_string=svg, background=PAPER, zoom=scale, sans_serif_family="DejaVu Sans")
        )
    except ValueError as fault:
        raise RasterError(f"the picture is no SVG that can be rendered: {fault}") from fault


@cache
def unavailable() -> str:
    """Why no PNG can be made on this host, with the remedy; empty when it can."""
    try:
        drawn, blank = (_resvg().svg_to_bytes(svg_string=_PROBE.format(text)) for text in ("petrobot", ""))
    except ImportError:
        return f"resvg is not installed: {REMEDY}"
    if drawn == blank:
        return "this host has no fonts, so pictures would have no words: install one (Debian: fonts-dejavu-core)"
    return ""


def _resvg() -> Any:
    return import_module("resvg_py")
