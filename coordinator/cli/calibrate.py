"""Calibrate a camera from images of a board: its lens, and its pose in the base frame."""

from __future__ import annotations

import argparse

from petrobot.coordinator.cli import CommandError, file_of

EXAMPLE = "petrobot calibrate --views board_images --simulated --output calibration.toml"
ROOM = "petrobot.services.vision.calibrate"
LABORATORY = "petrobot.sim.catching.board:main"
"""Takes board images with the simulated camera at its true pose: `main([folder])`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the calibration, and one that takes simulated images first."""
    from petrobot.coordinator.launch import load_object

    load_object(f"{ROOM}:add_arguments")(parser)
    parser.add_argument(
        "--simulated",
        action="store_true",
        help="take the board images with the simulated camera first, into an empty DIR",
    )


def run(options: argparse.Namespace) -> int:
    """Take the images if --simulated is given; calibrate."""
    from petrobot.coordinator.launch import load_object

    if options.simulated and options.views is not None:
        _take(options)
    return int(load_object(f"{ROOM}:run")(options))


def _take(options: argparse.Namespace) -> None:
    from petrobot.coordinator.launch import load_object

    folder = options.views
    if options.source:
        raise CommandError(
            2,
            f"--simulated takes all the images, so --source {options.source} cannot be used with "
            "it; leave one out",
        )
    with file_of(folder, "give --views a folder that can be written"):
        if folder.exists() and any(folder.iterdir()):
            raise CommandError(
                2,
                f"{folder} is not empty; give --simulated an empty folder, so that nothing is "
                "overwritten",
            )
        load_object(LABORATORY)([str(folder)])
