"""A mission run as one self-contained HTML page: result, net, Gantt chart of the runs, firings and
reasons of errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.records import Record, RunEnd
from petrobot.coordinator.run.recording import RecordedStep
from petrobot.coordinator.run.timeline import Bar, Timeline
from petrobot.coordinator.studies.report.action_pictures import (
    Curves,
    Pictures,
    action_pictures,
    add_latencies,
    latency_svg,
    put,
    recorded_curves,
    trial_pictures,
)
from petrobot.coordinator.studies.report.page import (
    apart,
    gallery,
    html_page,
    is_table,
    numbers,
    picture,
    section,
    status,
    table,
)
from petrobot.coordinator.studies.report.plots import declared, finished
from petrobot.coordinator.task import Status, Task

ROW, LEFT, WIDTH = 26, 150, 1040
SECOND = 10.0
"""Least number of pixels per second; a long Gantt chart becomes wider than the page."""
LETTER = 13.0
"""Width of the narrowest bar that gets a letter: a letter with its halo (pixels). On a shorter bar
it would cover the bars beside it."""
LONGEST = 600.0
"""Seconds shown in a Gantt chart; the table of firings lists the rest."""


def report_html(
    result: Mapping[str, Any],
    timeline: Timeline,
    net_svg: str,
    pictures: Mapping[str, str] | None,
    measured: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """Return the page. `result` is the mission's result; its lists of records become tables.

    SVG texts: `pictures`, the task's own by title; `measured`, those of its actions by heading.
    """
    title = f"{result.get('task', 'task')}: {result.get('status', '')}"
    parts = [
        f"<h1>{escape(str(result.get('task', 'task')))}</h1>",
        f'<p class="lead">{status(result.get("status"))} '
        f"{escape(str(result.get('reason', '')))}</p>",
        numbers(result),
        section(
            "Of the task itself",
            gallery([*own_pictures(result).values(), *(pictures or {}).values()]),
        ),
        section("Runs over time", picture(gantt_svg(timeline))),
        *(section(heading, gallery(svgs)) for heading, svgs in (measured or {}).items()),
        *(
            section(key.replace("_", " ").capitalize(), table(rows))
            for key, rows in result.items()
            if is_table(rows)
        ),
        section("The net", apart(net_svg, "the net") if net_svg else ""),
        section("What went wrong", _faults(timeline)),
        section("Firings", _firings(timeline)),
    ]
    return html_page(title, parts)


def own_pictures(result: Mapping[str, Any]) -> dict[str, str]:
    """Return the task's own pictures that its score declares
    (coordinator/studies/report/plots.py)."""
    tables = {name: rows for name, rows in result.items() if is_table(rows)}
    longest = max((len(rows) for rows in tables.values()), default=0)
    rows: list[dict[str, Any]] = [{} for _ in range(longest)]
    for name, records in tables.items():
        for i, record in enumerate(records):
            rows[i] |= {f"{name}.{key}": value for key, value in record.items()}
    plots = result.get("plots", {})
    drawn = declared(plots, rows) if isinstance(plots, Mapping) else {}
    return {
        **{str(plots[name].get("title", name)): svg for name, svg in drawn.items()},
        **finished(result),
    }


def gantt_svg(timeline: Timeline) -> str:
    """Return runs as bars over time, one row for each place (time axis in s since the mission
    began)."""
    bars = [bar for bar in timeline.bars.values() if bar.begun <= LONGEST]
    if not bars:
        return "<p>No run was started.</p>"
    places = list(dict.fromkeys(bar.place for bar in bars))
    left = max(LEFT, 20 + 8 * max(map(len, places)))
    end = min(LONGEST, max([bar.ended or bar.begun for bar in bars] + [1e-3]))
    width = max(WIDTH, int(left + 20 + SECOND * end))
    scale = (width - left - 20) / end
    height = ROW * len(places) + 40
    rows = "".join(
        f'<text x="0" y="{ROW * i + 17}" fill="var(--ink)">{escape(place)}</text>'
        f'<line x1="{left}" x2="{width - 20}" y1="{ROW * (i + 1)}" y2="{ROW * (i + 1)}" '
        'stroke="var(--line)"/>'
        for i, place in enumerate(places)
    )
    drawn = "".join(_bar(bar, places.index(bar.place), scale, end, left) for bar in bars)
    axis = "".join(
        f'<text x="{left + t * scale:.1f}" y="{height - 12}" fill="var(--soft)" '
        f'text-anchor="middle">{t:g} s</text>'
        for t in _ticks(end, 12 * width / WIDTH)
    )
    return (
        f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-size="13" role="img" '
        f'font-family="system-ui,Segoe UI,Roboto,DejaVu Sans,sans-serif" '
        f'{"" if width == WIDTH else STYLE_WIDE}aria-label="Gantt chart of the '
        f'runs">{rows}{drawn}{axis}</svg>'
    )


STYLE_WIDE = 'style="max-width:none" '


def _bar(bar: Bar, row: int, scale: float, end: float, left: int) -> str:
    ended = end if bar.ended is None else min(end, bar.ended)
    colour = f"var(--{bar.status.value if bar.status else 'none'})"
    name = f"{bar.run}: {bar.action}, {bar.begun:.2f} to {ended:.2f} s"
    why = f" ({_why(bar)})" if bar.cause or bar.text else ""
    how = bar.status.value if bar.status else "preempted"
    x, width = left + bar.begun * scale, max(1.5, (ended - bar.begun) * scale)
    tip = f"<title>{escape(f'{name}, {how}{why}')}</title>"
    return (
        f'<rect x="{x:.2f}" y="{ROW * row + 5}" width="{width:.2f}" height="{ROW - 9}" '
        f'rx="3" fill="{colour}">{tip}</rect>'
        + (_letter(bar, x + width / 2, row) if width >= LETTER else "")
    )


def _letter(bar: Bar, x: float, row: int) -> str:
    """Repeat the colour's meaning as a letter on the bar, for runs that did not meet their
    specification: F, E, or P for preempted."""
    if bar.status is Status.SUCCESS:
        return ""
    letter = bar.status.value[0].upper() if bar.status else "P"
    return (
        f'<text x="{x:.2f}" y="{ROW * row + 18}" text-anchor="middle" font-size="11" '
        'font-weight="700" fill="var(--ink)" '
        'stroke="var(--paper)" stroke-width="3" paint-order="stroke" '
        f'pointer-events="none">{letter}</text>'
    )


def _ticks(end: float, most: float) -> list[float]:
    step = next(
        (s for s in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500) if end / s <= most), 1000
    )
    return [i * step for i in range(int(end / step) + 1)]


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
        {
            "time": f"{time:.2f} s",
            "place": report.of,
            "action": "",
            "status": report.severity.value,
            "why": report.text,
        }
        for time, report in timeline.reports
    ]
    return table(rows) if rows else "<p>Nothing: every run met its specification.</p>"


def _why(bar: Bar) -> str:
    return ": ".join(part for part in (bar.cause, bar.text) if part)


BECAUSE: Mapping[str, str] = {
    "AddTokens": "the operator's tokens",
    "Begin": "the mission began",
    "EventOccurred": "an event",
    "ForceExit": "forced by the operator",
    "RaiseEvent": "an event, raised by the operator",
    "RunEnded": "a run ended",
    "RunRaised": "an event, raised by a run",
    "TimerFired": "its time has passed",
    "VariableChanged": "a variable changed",
    "stability": "followed at once",
}
"""By cause of a firing: how it reads."""


def _firings(timeline: Timeline) -> str:
    rows: Iterable[Mapping[str, Any]] = (
        {
            "": f.number,
            "time": f"{f.time:.3f} s",
            "transition": f.transition,
            "because of": BECAUSE.get(f.cause, f.cause),
        }
        for f in timeline.firings
    )
    body = table(list(rows)) if timeline.firings else "<p>None.</p>"
    return f"<details><summary>{len(timeline.firings)} firings</summary>{body}</details>"


# --- what a recorded run tells about its actions ---


class ObservedRun:
    """Replays the steps of a recorded run to an observer that learns, to show what the run tells
    about its actions. `learner`: the selector that learned in the run, as it began; None: nothing
    learned in it."""

    def __init__(self, task: Task, learner: LearningSelector | None = None) -> None:
        self._task = task
        self._learns = learner is not None
        self._selector = learner or LearningSelector(Learning(task))
        self._probability: dict[tuple[str, str], Curves] = {}

    def step(self, step: RecordedStep) -> None:
        """Observe one stimulus and its instructions."""
        seen = len(self._selector.records)
        self._selector.stimulus(step.time, step.stimulus)
        for instruction in step.instructions:
            self._selector.instruction(step.time, instruction)
        self._selector.settled(step.time, step.state)
        if self._learns:
            self._note(self._selector.records[seen:])

    def _note(self, records: Sequence[Record]) -> None:
        """Record the probabilities after each trial that ended."""
        for record in records:
            if not isinstance(record, RunEnd) or record.outcome.status is None:
                continue
            selector = self._selector.learning.selectors.get(record.primitive_task)
            if selector is None:
                continue
            curves = self._probability.setdefault((record.primitive_task, record.context), {})
            for action, p in selector.learned(record.context).items():
                points = curves.setdefault(action, [])
                points.append((len(points) + 1, p))

    def pictures(self) -> Pictures:
        """Return every picture for which there are numbers."""
        trials = recorded_curves(self._task, self._selector.records)
        for one in trials:
            one.probability = (
                self._probability.get((one.primitive_task, one.context), {}) if self._learns else {}
            )
        out = trial_pictures(trials, "learned probability") | action_pictures(
            self._task, self._selector.learning.gained
        )
        latencies: dict[str, list[float]] = {}
        for record in self._selector.records:
            if isinstance(record, RunEnd):
                add_latencies(latencies, record.action, record.outcome.values)
        if latencies:
            put(out, "latencies", "Times", latency_svg(latencies))
        return out
