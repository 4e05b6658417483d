"""Make a film of a recorded lock-step run: the simulated laboratory, above the net whose tokens
move."""

from __future__ import annotations

import argparse
from pathlib import Path

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.options import recorded, refuse_idle
from petrobot.services.host.command_line import number, whole

EXAMPLE = (
    "petrobot run catch_ball --mode lockstep --runs 1 --journal runs\n"
    "  petrobot film last --out film.webp"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run", help="a run's id or folder, or `last`")
    parser.add_argument(
        "--out",
        "-o",
        metavar="FILE",
        type=Path,
        required=True,
        help="the film: an animated .webp, .gif or .png",
    )
    parser.add_argument(
        "--begin",
        type=number(least=0.0),
        default=0.0,
        metavar="S",
        help="time of the run at which the film begins (default: %(default)g)",
    )
    parser.add_argument(
        "--seconds",
        type=number(above=0.0),
        default=10.0,
        metavar="S",
        help="longest duration of the film (default: %(default)g)",
    )
    parser.add_argument(
        "--fps",
        type=number(above=0.0),
        default=12.5,
        metavar="N",
        help="images per second (default: %(default)g)",
    )
    parser.add_argument(
        "--width", type=whole(64), default=840, metavar="PX", help="default: %(default)s"
    )
    parser.add_argument(
        "--quality",
        type=whole(1, 100),
        default=75,
        metavar="Q",
        help="quality of a .webp film, 1 to 100 (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Make the film, and print where it is."""
    from petrobot.coordinator.studies.report.film import images, refuse_file, write

    if options.out.suffix.lower() != ".webp":
        why = "only a .webp film has a quality; leave it out, or name the film .webp"
        refuse_idle(options, why, idle={"quality"})
    span = {"begin": options.begin, "seconds": options.seconds}
    try:
        refuse_file(options.out)
        made = list(images(recorded(options.run), **span, fps=options.fps, width=options.width))
        write(options.out, made, options.fps, options.quality)
    except ValueError as fault:
        raise CommandError(2, str(fault)) from fault
    size = options.out.stat().st_size
    print(f"{options.out}: {len(made)} images, {size / 1e6:.2f} MB")
    return 0
