"""Calibrate a camera from images of a board: lens, and where the camera stands in the base frame."""

from __future__ import annotations

import argparse

EXAMPLE = "petrobot calibrate --views board_images --output calibration.toml"
ROOM = "services.vision.calibrate"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options are the calibration's own."""
    from coordinator.launch import load_object

    load_object(f"{ROOM}:add_arguments")(parser)


def run(options: argparse.Namespace) -> int:
    """Calibrate."""
    from coordinator.launch import load_object

    return int(load_object(f"{ROOM}:run")(options))
