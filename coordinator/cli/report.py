"""Write a report of a mission run or a campaign: one self-contained HTML page, and its pictures as
SVG and PNG files."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from petrobot.coordinator.cli import CommandError, file_of
from petrobot.coordinator.cli.loading import add_json_argument, load_task, pictures_of, write_json
from petrobot.coordinator.cli.options import refuse_idle
from petrobot.services.host.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.operator.start_from import Recorded
    from petrobot.coordinator.studies.campaign.plan import CampaignPlan
    from petrobot.coordinator.studies.campaign.table import TrialRow
    from petrobot.coordinator.studies.report.run_page import ObservedRun
    from petrobot.coordinator.task import Task

EXAMPLE = (
    "petrobot report campaigns/catch_ball-nikolic_fu-1 --against "
    "campaigns/catch_ball-fixed-1 --out report.html"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "subject",
        metavar="RUN|CAMPAIGN",
        help="a recorded run (id, folder, last) or a campaign's folder",
    )
    parser.add_argument(
        "--against",
        metavar="CAMPAIGN",
        type=Path,
        help="compare with this campaign, trial by trial",
    )
    parser.add_argument(
        "--rho-of",
        metavar="CAMPAIGN",
        type=Path,
        help="weigh costs as the actions of this campaign do (default: of the two)",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help="the page (default: report.html beside what it is about)",
    )
    add_json_argument(parser, "the comparison's numbers")


def run(options: argparse.Namespace) -> int:
    """Write the page and its pictures."""
    from petrobot.coordinator.studies.campaign.plan import MANIFEST

    folder = Path(options.subject)
    if options.against is None:
        why = "it is of a comparison; add --against CAMPAIGN, or leave it out"
        refuse_idle(options, why, idle={"rho_of", "json"})
    if (folder / MANIFEST).exists():
        page, pictures, target = _campaign(folder, options)
    elif options.against is not None:
        raise CommandError(2, f"{folder} is not a campaign: --against compares two campaigns")
    else:
        page, pictures, target = _run(options.subject)
    out = options.out or target
    out = out if out.suffix else out.with_suffix(".html")
    _write(out, page, pictures, quiet=options.json == "-")
    return 0


def _write(page: Path, html: str, pictures: Mapping[str, str], *, quiet: bool) -> None:
    from petrobot.coordinator.studies.report.page import standalone
    from petrobot.coordinator.studies.report.raster import unavailable

    beside = page.with_name(f"{page.stem}_pictures")
    missing = unavailable()
    with file_of(page, "give --out a file that can be written"):
        make_folder(beside)
        write_whole(page, html)
        for name, svg in pictures.items():
            _draw(beside / name, standalone(svg), raster=not missing)
    if not quiet:
        print(f"report: {page}")
        print(f"pictures: {beside} ({len(pictures)} as SVG{'' if missing else ' and PNG'})")
        if missing:
            print(f"no PNG: {missing}")


def _draw(path: Path, svg: str, *, raster: bool) -> None:
    """Write a picture as SVG and PNG. A task's own picture that only browsers can draw is written
    as SVG only."""
    from petrobot.coordinator.studies.report.raster import RasterError, png

    write_whole(path.with_name(f"{path.name}.svg"), svg)
    if raster:
        try:
            write_whole(path.with_name(f"{path.name}.png"), png(svg))
        except RasterError as fault:
            print(f"{path}.svg: no PNG: {fault}", file=sys.stderr)


# --- campaigns --------------------------------------------------------------------------------


def _campaign(folder: Path, options: argparse.Namespace) -> tuple[str, dict[str, str], Path]:
    from petrobot.coordinator.studies.report.campaign_page import (
        CampaignReport,
        comparison_pictures,
        comparison_section,
    )

    plan, task, rows = opened(folder)
    report = CampaignReport(plan, task, rows, _plots(folder))
    if report.without:
        print(f"no probabilities of choices: {report.without}", file=sys.stderr)
    more: list[str] = []
    if options.against is not None:
        found = compared(folder, options.against, options.rho_of)
        one, other = _names(folder, options.against)
        pictures = comparison_pictures(found, one, other)
        more = [comparison_section(found, one, other)]
        report.pictures = {**pictures, **report.pictures}
        if options.json:
            write_json(options.json, found)
    return (
        report.html(more),
        {name: svg for name, (_, svg) in report.pictures.items()},
        folder / "report.html",
    )


def _names(one: Path, other: Path) -> tuple[str, str]:
    names = (one.resolve().name, other.resolve().name)
    return names if names[0] != names[1] else (str(one), str(other))


def opened(folder: Path) -> tuple[CampaignPlan, Task, list[TrialRow]]:
    """Return plan, task and rows of a campaign. Raises CampaignError, and CommandError if it has no
    rows."""
    from petrobot.coordinator.studies.campaign.plan import TASK_COPY, read_manifest
    from petrobot.coordinator.studies.campaign.table import TABLE, read_table

    plan = read_manifest(folder)
    if (copy := folder / TASK_COPY).is_file():  # the task file may have changed since
        digests = {key: said for key, said in plan.digests.items() if key != "task"}
        plan = replace(plan, task=str(copy), digests=digests)
    rows = list(read_table(folder / TABLE))
    if not rows:
        raise CommandError(2, f"{folder}: the table holds no run yet")
    return plan, load_task(plan.task), rows


def compared(one: Path, other: Path, rho_of: Path | None = None) -> dict[str, Any]:
    """Return the comparison of two campaigns' folders as numbers. J weighs costs with the rho of
    the campaign `rho_of`; without it, with that of the two."""
    from petrobot.coordinator.studies.report.comparing import Weighting, compare

    _, task, rows = opened(one)
    _, _, others = opened(other)
    weighting = None if rho_of is None else Weighting.of(task, opened(rho_of)[2])
    try:
        return {"one": one.name, "other": other.name, **compare(task, rows, others, weighting)}
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault


def _plots(folder: Path) -> dict[str, Any]:
    path = folder / "plots.json"
    if not path.exists():
        return {}
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


# --- runs -------------------------------------------------------------------------------------


def _run(name: str) -> tuple[str, dict[str, str], Path]:
    from petrobot.coordinator.cli.options import recorded
    from petrobot.coordinator.drawing import draw
    from petrobot.coordinator.run.folder import RESULT
    from petrobot.coordinator.run.timeline import Timeline
    from petrobot.coordinator.studies.report.run_page import gantt_svg, own_pictures, report_html

    found = recorded(name)
    timeline, observed = Timeline(origin=0.0), _observer(found)  # the journal's clock
    for step in found.steps():
        timeline.stimulus(step.time, step.stimulus)
        for instruction in step.instructions:
            timeline.instruction(step.time, instruction)
        observed.step(step)
    folder = found.journal.path.parent
    result = _result_of(folder / RESULT, found.task)
    drawn, net, measured = (
        pictures_of(found.task, result),
        draw(found.task, error_branches=True),
        observed.pictures(),
    )
    headings = list(dict.fromkeys(heading for heading, _ in measured.values()))
    sections = {
        heading: [svg for own, svg in measured.values() if own == heading] for heading in headings
    }
    told = {**result, "plant": found.plant, "mission": found.journal.header["mission"]}
    page = report_html(told, timeline, net, drawn, sections)
    own = {
        f"own_{i}": svg
        for i, svg in enumerate([*own_pictures(result).values(), *drawn.values()], 1)
    }
    pictures = {
        "gantt": gantt_svg(timeline),
        "net": net,
        **{name: svg for name, (_, svg) in measured.items()},
        **own,
    }
    return page, pictures, folder / "report.html"


def _observer(found: Recorded) -> ObservedRun:
    """Return the observer of the run's actions, with the selector that learned in it if its
    estimates file still exists."""
    from petrobot.coordinator.learning.estimates_file import EstimatesError
    from petrobot.coordinator.learning.session import session_of
    from petrobot.coordinator.studies.report.run_page import ObservedRun

    try:
        session = session_of(found.task, found.journal.header)
    except (EstimatesError, ValueError) as fault:
        print(f"no learned probabilities: {fault}", file=sys.stderr)
        session = None
    return ObservedRun(found.task, None if session is None else session.selector)


def _result_of(path: Path, task: Task) -> dict[str, Any]:
    if not path.exists():
        return {"task": task.name, "reason": "no result"}
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return result
