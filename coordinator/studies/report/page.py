"""HTML that all report pages share: style, figures, tables, sections with pictures."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from petrobot.coordinator.task import Status
from petrobot.services.host.json_text import without_controls

# --- colours ---

# Series: the palette of M. Okabe and K. Ito (2008), distinguishable with colour blindness, the
# yellow darkened for white paper.

COLOURS: Mapping[str, tuple[str, str]] = {
    "ink": ("#1b1f24", "#e8ecf0"),
    "soft": ("#5b6570", "#9aa6b2"),
    "line": ("#d7dce1", "#343b43"),
    "paper": ("#ffffff", "#14181c"),
    "panel": ("#f5f7f9", "#1d2329"),
    "success": ("#1a7f4b", "#43b97f"),
    "failure": ("#b7791f", "#e0a94a"),
    "error": ("#c0362c", "#ef6f64"),
    "none": ("#7a8794", "#8794a1"),
    "series-1": ("#0072b2", "#3fa0dc"),
    "series-2": ("#d55e00", "#ec7a2c"),
    "series-3": ("#009e73", "#21b98d"),
    "series-4": ("#cc79a7", "#d992ba"),
    "series-5": ("#e69f00", "#e69f00"),
    "series-6": ("#56b4e9", "#8accf2"),
    "series-7": ("#7a6a00", "#b9a52e"),
    "series-8": ("#555555", "#a0a0a0"),
}
LIGHT, DARK = ({name: pair[i] for name, pair in COLOURS.items()} for i in (0, 1))
"""Colours by day, and of every picture that is a file of its own; and colours by night."""
SERIES = tuple(name for name in LIGHT if name.startswith("series"))


def variables(colours: Mapping[str, str]) -> str:
    """Return the colours as CSS variables."""
    return "".join(f"--{name}:{colour};" for name, colour in colours.items())


def standalone(svg: str) -> str:
    """Turn a picture of a page into a file of its own, with the page's light colours and a name
    space."""
    svg = without_controls(svg)
    svg = re.sub(r"var\(--([a-z0-9-]+)\)", lambda found: LIGHT.get(found[1], found[0]), svg)
    return (
        svg
        if "xmlns=" in svg[:400]
        else svg.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    )


STYLE = (
    f"""
:root{{color-scheme:light dark;{variables(LIGHT)}}}
@media (prefers-color-scheme:dark){{:root{{{variables(DARK)}}}}}
"""
    + """body{margin:0 auto;max-width:1100px;padding:2rem 1.5rem 4rem;
background:var(--paper);color:var(--ink);
font:15px/1.5 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
h1{font-size:1.7rem;margin:0 0 .25rem}h2{font-size:1.15rem;margin:2.2rem 0 .6rem}
p.lead{color:var(--soft);margin:0 0 1.5rem}
.numbers{display:flex;flex-wrap:wrap;gap:.75rem}
.numbers div{background:var(--panel);border-radius:8px;padding:.6rem .9rem}
.numbers b{display:block;font-size:1.25rem}.numbers span{color:var(--soft);font-size:.85rem}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:.35rem .6rem;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--soft);font-weight:600;font-size:.85rem}
.success{color:var(--success)}.failure{color:var(--failure)}.error{color:var(--error)}
.picture{overflow-x:auto;background:var(--panel);border-radius:8px;padding:.75rem}
.picture svg{max-width:100%;height:auto}
.gallery{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,500px),1fr));gap:.75rem}
h3{margin:1.2rem 0 .3rem;font-size:1rem}h3 small{color:var(--soft);font-weight:400}
.wide{overflow-x:auto}
details summary{cursor:pointer;color:var(--soft)}
"""
)


def html_page(title: str, parts: Iterable[str]) -> str:
    """Return a whole page that needs no other file."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        # A page has no scripts of its own; the pictures of a task come from code of users.
        """<meta http-equiv="Content-Security-Policy" content="script-src 'none'">"""
        f"<title>{escape(without_controls(title))}</title>"
        '<meta name="viewport" '
        f'content="width=device-width,initial-scale=1"><style>{STYLE}</style></head>'
        f"<body>{without_controls(''.join(parts))}</body></html>\n"
    )


def gallery(pictures: Iterable[str]) -> str:
    """Return pictures side by side, as far as there is room."""
    framed = "".join(picture(svg) for svg in pictures)
    return f'<div class="gallery">{framed}</div>' if framed else ""


def apart(svg: str, alternative: str) -> str:
    """Return a picture that has its own style sheet, embedded so that its style does not affect the
    page."""
    data = b64encode(svg.encode("utf-8")).decode("ascii")
    image = (
        f'<img src="data:image/svg+xml;base64,{data}" alt="{escape(alternative)}" '
        'style="max-width:100%">'
    )
    return f'<div class="picture">{image}</div>'


def picture(svg: str) -> str:
    """Return a picture in its frame."""
    return f'<div class="picture">{svg}</div>'


def is_table(rows: Any) -> bool:
    """Return whether a value is a list of records."""
    return isinstance(rows, list) and bool(rows) and all(isinstance(row, Mapping) for row in rows)


def numbers(result: Mapping[str, Any]) -> str:
    """Return the plain values of a result in large type."""
    cells = [
        f"<div><b>{escape(text(value))}</b><span>{escape(key)}</span></div>"
        for key, value in result.items()
        if isinstance(value, int | float | str) and key not in ("task", "status", "reason")
    ]
    return f'<div class="numbers">{"".join(cells)}</div>'


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return records as a table; the columns are in the order of their first use."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{cell(c, row.get(c))}</td>' for c in columns)}</tr>" for row in rows
    )
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def cell(column: str, value: Any) -> str:
    """Return one cell; statuses have their colours."""
    return status(value) if column == "status" else escape(text(value))


def status(value: Any) -> str:
    """Return a status in its colour."""
    known = value in tuple(Status)
    return f'<b class="{value}">{escape(str(value).upper())}</b>' if known else escape(text(value))


def text(value: Any) -> str:
    """Return a value as text for people."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(text(item) for item in value)
    return str(value)


def section(title: str, body: str) -> str:
    """Return a heading and what is under it; nothing without a body."""
    return f"<h2>{escape(title)}</h2>{body}" if body else ""
