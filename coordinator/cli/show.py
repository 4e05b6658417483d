"""Draw a task as SVG or PNG: places, transitions, tokens and events; error branches are hidden
unless asked for."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from petrobot.coordinator.cli import CommandError, file_of
from petrobot.coordinator.cli.loading import (
    add_estimates_argument,
    add_services_argument,
    add_task_argument,
    cell_finder,
    load_task,
    measurements,
    task_path,
)
from petrobot.coordinator.cli.options import refuse_idle
from petrobot.services.host.whole_file import write_whole

if TYPE_CHECKING:
    from petrobot.coordinator.drawing import Overlay
    from petrobot.coordinator.task import Task

EXAMPLE = "petrobot show catch_ball --errors --out catch_ball.svg"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_task_argument(parser)
    parser.add_argument("--errors", action="store_true", help="draw the error branches too")
    parser.add_argument(
        "--inside", metavar="MACRO", default="", help="draw what is inside a macro place"
    )
    parser.add_argument(
        "--expanded",
        action="store_true",
        help="draw the net that is executed and analysed: what is written in short (`tries`, "
        "`holds`, `[errors]`, subnets) as places and transitions",
    )
    parser.add_argument(
        "--graph", action="store_true", help="draw the reachability graph instead (of any net file)"
    )
    parser.add_argument(
        "--view",
        choices=("ordinary", "gspn"),
        default="ordinary",
        help="gspn: the stochastic view, with timed (boxes) and immediate transitions (bars), "
        "their rates and weights, and where these come from",
    )
    add_estimates_argument(parser)
    add_services_argument(parser)
    parser.add_argument(
        "--heat",
        action="store_true",
        help="colour the action places by what a shorter time there saves",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        default="-",
        help="where to draw, a file .svg or .png (default: SVG to standard output)",
    )


def run(options: argparse.Namespace) -> int:
    """Draw the picture and write it."""
    from petrobot.coordinator.cli.analyse import bounded

    _refuse_idle(options)
    out = Path(options.out)
    if out.suffix not in ("", ".svg", ".png"):
        text = f"--out {out}: expected a file .svg or .png, found {out.suffix}"
        raise CommandError(2, text)
    drawn = _graph if options.graph else _gspn if options.view == "gspn" else _net
    with bounded(options.task):
        svg = drawn(options)
    if options.out == "-":
        print(svg)
        return 0
    with file_of(out, "give --out a file that can be written"):
        write_whole(out, _png(svg, out) if out.suffix == ".png" else svg)
    return 0


def _png(svg: str, out: Path) -> bytes:
    from petrobot.coordinator.studies.report.raster import RasterError, png

    try:
        return png(svg)
    except RasterError as fault:
        raise CommandError(2, f"{out}: no PNG: {fault}; or give --out a file .svg") from fault


def _net(options: argparse.Namespace) -> str:
    from petrobot.coordinator.drawing import draw, expanded

    task = load_task(options.task)
    if options.expanded and options.inside:
        raise CommandError(2, "--inside opens a macro place; the expanded net has none: leave one")
    if options.expanded:
        task = expanded(task)
    overlay = _heat(task, options) if options.heat else None
    try:
        return draw(task, error_branches=options.errors, overlay=overlay, inside=options.inside)
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault


def _refuse_idle(options: argparse.Namespace) -> None:
    """Raise CommandError for an option that this drawing would ignore."""
    if options.graph:
        why = "the reachability graph has no such choice; leave it out, or --graph"
        refuse_idle(options, why, heeded={"task", "graph", "out"})
    timed = options.heat or options.view == "gspn"
    for name in ("estimates", "services"):
        if getattr(options, name) is not None and not timed:
            raise CommandError(2, f"--{name} is for --heat and --view gspn; add one of them")


def _gspn(options: argparse.Namespace) -> str:
    """Draw the stochastic view of a task, or a net file that has rates. Raises CommandError."""
    from petrobot.coordinator.analysis.commands import gspn_of
    from petrobot.coordinator.studies.report.gspn_picture import gspn_svg

    for name in ("errors", "expanded", "inside", "heat"):
        if getattr(options, name):
            problem = f"--{name} is of the ordinary view; leave out --view gspn"
            raise CommandError(2, problem)
    path = task_path(options.task)
    try:
        model, assumed = gspn_of(
            path,
            measure=measurements(options.estimates),
            cell_of=cell_finder(options.services, options.task),
        )
    except (ValueError, OverflowError) as fault:
        text = str(fault)
        named = text if text.startswith(str(path)) else f"{path}: {text}"
        raise CommandError(2, named) from fault
    legend = f"Assumed: {assumed}." if assumed else f"Rates and weights: {path.name}."
    return gspn_svg(model, legend, path.stem)


def _heat(task: Task, options: argparse.Namespace) -> Overlay:
    """Return an overlay of what a shorter time in each action place saves, as forecast. Raises
    CommandError."""
    from petrobot.coordinator.analysis.limits import OutOfTime
    from petrobot.coordinator.analysis.may_run import assumed, devices_of
    from petrobot.coordinator.analysis.report import heat
    from petrobot.coordinator.analysis.time.stochastic import stochastic_view
    from petrobot.coordinator.analysis.time.task_forecast import forecast
    from petrobot.coordinator.drawing import Overlay

    cell = cell_finder(options.services, options.task)(task)
    measure = measurements(options.estimates)
    known = measure(task, cell) if measure else None
    try:
        view = stochastic_view(task, known, devices=devices_of(cell))
        shares = heat(forecast(view))
    except OutOfTime:
        raise
    except (ValueError, ArithmeticError) as why:
        raise CommandError(2, f"{task.name}: no heat without a forecast: {why}") from why
    if not shares:
        raise CommandError(2, f"{task.name}: no heat: no action takes time")
    most = max(shares, key=lambda place: shares[place])
    # All sources would make the line of the legend too long.
    sources = view.numbers.items()
    own = [s for s, names in sources if any(name.startswith(f"{most}.") for name in names)]
    count = {source: len(names) for source, names in sources}
    measured = sum(n for source, n in count.items() if source.startswith("measured"))
    told = (
        f"Warm: what 1 % less time there saves, by the forecast; the bottleneck is {most}: "
        f"{shares[most]:.2f} % ({'; '.join(own)}). {measured} of {sum(count.values())} "
        f"numbers are measured. Assumed: {assumed(cell)}."
    )
    return Overlay(heat=shares, legend=told)


def _graph(options: argparse.Namespace) -> str:
    from petrobot.coordinator.analysis.commands import graph_command

    outcome = graph_command(task_path(options.task))
    if outcome.code:
        raise CommandError(outcome.code, outcome.text)
    return str(outcome.data["svg"])
