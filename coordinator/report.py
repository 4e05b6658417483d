"""A mission run as one self-contained HTML page: result, net, Gantt of the runs, firings and reasons of errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from coordinator.task import Status
from coordinator.timeline import Bar, Timeline

STYLE = """
:root{color-scheme:light dark;--ink:#1b1f24;--soft:#5b6570;--line:#d7dce1;--paper:#fff;--panel:#f5f7f9;
--success:#1a7f4b;--failure:#b7791f;--error:#c0362c;--none:#7a8794}
@media (prefers-color-scheme:dark){:root{--ink:#e8ecf0;--soft:#9aa6b2;--line:#343b43;--paper:#14181c;--panel:#1d2329;
--success:#43b97f;--failure:#e0a94a;--error:#ef6f64;--none:#8794a1}}
body{margin:0 auto;max-width:1100px;padding:2rem 1.5rem 4rem;background:var(--paper);color:var(--ink);
font:15px/1.5 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
h1{font-size:1.7rem;margin:0 0 .25rem}h2{font-size:1.15rem;margin:2.2rem 0 .6rem}
p.lead{color:var(--soft);margin:0 0 1.5rem}
.numbers{display:flex;flex-wrap:wrap;gap:.75rem}.numbers div{background:var(--panel);border-radius:8px;padding:.6rem .9rem}
.numbers b{display:block;font-size:1.25rem}.numbers span{color:var(--soft);font-size:.85rem}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:.35rem .6rem;border-bottom:1px solid var(--line);vertical-align:top}
th{color:var(--soft);font-weight:600;font-size:.85rem}
.success{color:var(--success)}.failure{color:var(--failure)}.error{color:var(--error)}
.picture{overflow-x:auto;background:var(--panel);border-radius:8px;padding:.75rem}.picture svg{max-width:100%;height:auto}
details summary{cursor:pointer;color:var(--soft)}
"""

ROW, LEFT, WIDTH = 26, 150, 1040


def report_html(result: Mapping[str, Any], timeline: Timeline, net_svg: str = "") -> str:
    """The page. `result` is the mission's result; its list "throws" or any other list of tables becomes a table."""
    title = f"{result.get('task', 'task')}: {result.get('status', '')}"
    parts = [
        f"<h1>{escape(str(result.get('task', 'task')))}</h1>",
        f'<p class="lead">{_status(result.get("status"))} {escape(str(result.get("reason", "")))}</p>',
        _numbers(result),
        *(_section(key.capitalize(), _table(rows)) for key, rows in result.items() if _is_table(rows)),
        _section("Runs over time", f'<div class="picture">{gantt_svg(timeline)}</div>'),
        _section("The net", f'<div class="picture">{net_svg}</div>') if net_svg else "",
        _section("What went wrong", _faults(timeline)),
        _section("Firings", _firings(timeline)),
    ]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width,initial-scale=1"><style>{STYLE}</style></head>'
        f"<body>{''.join(parts)}</body></html>\n"
    )


def gantt_svg(timeline: Timeline) -> str:
    """Runs as bars over time, one row for each place (time axis in s since the mission began)."""
    bars = list(timeline.bars.values())
    if not bars:
        return "<p>No run was started.</p>"
    places = list(dict.fromkeys(bar.place for bar in bars))
    end = max([bar.ended or bar.begun for bar in bars] + [1e-3])
    scale = (WIDTH - LEFT - 20) / end
    height = ROW * len(places) + 40
    rows = "".join(
        f'<text x="0" y="{ROW * i + 17}" fill="var(--ink)">{escape(place)}</text>'
        f'<line x1="{LEFT}" x2="{WIDTH - 20}" y1="{ROW * (i + 1)}" y2="{ROW * (i + 1)}" stroke="var(--line)"/>'
        for i, place in enumerate(places)
    )
    drawn = "".join(_bar(bar, places.index(bar.place), scale, end) for bar in bars)
    axis = "".join(
        f'<text x="{LEFT + t * scale:.1f}" y="{height - 12}" fill="var(--soft)" text-anchor="middle">{t:g} s</text>'
        for t in _ticks(end)
    )
    return (
        f'<svg viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" font-size="13" role="img" '
        f'aria-label="Gantt chart of the runs">{rows}{drawn}{axis}</svg>'
    )


def _bar(bar: Bar, row: int, scale: float, end: float) -> str:
    ended = end if bar.ended is None else bar.ended
    colour = f"var(--{bar.status.value if bar.status else 'none'})"
    name = f"{bar.run}: {bar.action}, {bar.begun:.2f} to {ended:.2f} s"
    why = f" ({bar.cause}: {bar.text})" if bar.cause else ""
    status = bar.status.value if bar.status else "preempted"
    return (
        f'<rect x="{LEFT + bar.begun * scale:.2f}" y="{ROW * row + 5}" width="{max(1.5, (ended - bar.begun) * scale):.2f}" '
        f'height="{ROW - 9}" rx="3" fill="{colour}"><title>{escape(f"{name}, {status}{why}")}</title></rect>'
    )


def _ticks(end: float) -> list[float]:
    step = next((s for s in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500) if end / s <= 12), 1000)
    return [i * step for i in range(int(end / step) + 1)]


def _is_table(rows: Any) -> bool:
    return isinstance(rows, list) and bool(rows) and all(isinstance(row, Mapping) for row in rows)


def _numbers(result: Mapping[str, Any]) -> str:
    cells = [
        f"<div><b>{escape(_text(value))}</b><span>{escape(key)}</span></div>"
        for key, value in result.items()
        if isinstance(value, int | float | str) and key not in ("task", "status", "reason")
    ]
    return f'<div class="numbers">{"".join(cells)}</div>'


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join(f"<tr>{''.join(f'<td>{_cell(c, row.get(c))}</td>' for c in columns)}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _cell(column: str, value: Any) -> str:
    return _status(value) if column == "status" else escape(_text(value))


def _status(value: Any) -> str:
    known = value in tuple(Status)
    return f'<b class="{value}">{escape(str(value).upper())}</b>' if known else escape(_text(value))


def _text(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value)
    return str(value)


def _section(title: str, body: str) -> str:
    return f"<h2>{escape(title)}</h2>{body}"


def _faults(timeline: Timeline) -> str:
    rows = [
        {
            "time": f"{bar.ended:.2f} s",
            "place": bar.place,
            "action": bar.action,
            "status": bar.status.value,
            "why": _why(bar),
        }
        for bar in timeline.bars.values()
        if bar.status in (Status.FAILURE, Status.ERROR) and bar.ended is not None and bar.status
    ]
    rows += [
        {"time": f"{time:.2f} s", "place": report.of, "action": "", "status": report.severity.value, "why": report.text}
        for time, report in timeline.reports
    ]
    return _table(rows) if rows else "<p>Nothing: every run met its specification.</p>"


def _why(bar: Bar) -> str:
    return f"{bar.cause}: {bar.text}" if bar.text else bar.cause


def _firings(timeline: Timeline) -> str:
    rows: Iterable[Mapping[str, Any]] = (
        {"": f.number, "time": f"{f.time:.3f} s", "transition": f.transition, "because of": f.cause}
        for f in timeline.firings
    )
    table = _table(list(rows)) if timeline.firings else "<p>None.</p>"
    return f"<details><summary>{len(timeline.firings)} firings</summary>{table}</details>"
