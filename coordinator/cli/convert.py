"""Read a net in one format and write it in another, by the files' endings; whatever cannot be kept
is listed."""

from __future__ import annotations

import argparse
from pathlib import Path

from petrobot.coordinator.cli.loading import (
    add_estimates_argument,
    add_json_argument,
    add_services_argument,
    cell_finder,
    measurements,
    task_path,
)
from petrobot.coordinator.cli.options import refuse_idle

EXAMPLE = "petrobot convert catch_ball catch_ball.pnml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    from petrobot.coordinator.analysis.formats import FORMATS

    endings = (e + f" ({form.tool})" * bool(form.tool) for e, form in FORMATS.items())
    timed = " and ".join(ending for ending, form in FORMATS.items() if form.timed)
    parser.add_argument(
        "source", help="a net or task file, or the name of a task that comes with petrobot"
    )
    parser.add_argument("target", type=Path, help=f"the file to write: {', '.join(endings)}")
    parser.add_argument(
        "--view",
        choices=("ordinary", "gspn"),
        help="which net of a task: the ordinary one, or the stochastic view with rates (default: "
        f"gspn for {timed} and with --estimates, else ordinary)",
    )
    parser.add_argument(
        "--exact",
        action="store_true",
        help="of a task: write the net that keeps how runs ended, and so has every path of the "
        "execution",
    )
    add_estimates_argument(parser)
    add_services_argument(parser)
    add_json_argument(parser, "what was not kept")


def run(options: argparse.Namespace) -> int:
    """Convert the file, and list what could not be kept."""
    from petrobot.coordinator.analysis.commands import convert_command, written_view
    from petrobot.coordinator.cli.analyse import bounded, give

    measured = options.estimates is not None
    view = written_view(options.target, options.view, options.exact, measured)
    source = task_path(options.source)
    if source.suffix == ".toml" and view != "gspn":
        why = f"its devices are of the stochastic view, and the {view} net is written; add --view"
        refuse_idle(options, f"{why} gspn, or leave it out", idle={"services"})
    with bounded(options.source):  # a chain (`.drn`) may be far larger than its net
        found = convert_command(
            source,
            options.target,
            view=options.view,
            exact=options.exact,
            measure=measurements(options.estimates),
            cell_of=cell_finder(options.services, options.source),
        )
    return give(found, options.json)
