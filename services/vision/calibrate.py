"""The calibration command: turns a folder of board images into calibration.toml, takes missing
images with a camera, and measures a camera's latency.

The folder's views.toml lists the board and the images with their known poses (docs/vision.md shows
one). `add_arguments`, `run` and EXAMPLE serve `petrobot calibrate`; `calibrate_main` is the same
command on its own (python -m petrobot.services.vision.calibrate).
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.services.comm.streams.camera import open_images
from petrobot.services.comm.streams.image import ImageSource
from petrobot.services.host.whole_file import write_whole
from petrobot.services.vision.calibration import (
    Calibration,
    CalibrationError,
    CalibrationFileError,
    calibrate,
    calibration_text,
    find_corners,
    missing_views,
    read_views,
)

Pixels = NDArray[np.uint8]
EXAMPLE = "petrobot calibrate --views board_images --output calibration.toml"
RATE, PATIENCE, SETTLE = 10.0, 5.0, 3
"""Images/s while board images are taken, seconds to wait for one, and images dropped while the
exposure settles."""
LATENCY_RATE, FLASHES, SEEN_AFTER = 1000.0, 40, 0.5
"""Images/s asked for while the latency is measured (a camera takes as many as it can), flashes, and
seconds after which each of them has surely been seen."""
LEAST_CHANGE = 30.0
"""Grey levels by which the flash must change the brightest place of an image."""
POOR_PX, POOR_PLACE = 0.5, 0.005
"""Residuals (px, m) above which the report says how to make better images."""
EXIT_BAD_INPUT = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--views",
        type=Path,
        metavar="DIR",
        help="folder with views.toml and board images",
    )
    parser.add_argument(
        "--latency",
        action="store_true",
        help="measure the latency of the camera --source, which looks at this terminal",
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("calibration.toml"),
        metavar="FILE",
        help="what to write",
    )
    parser.add_argument(
        "--source",
        metavar="SOURCE",
        help='camera that takes the images not there yet: "capture:0", "file:PATH" or "sim"',
    )
    parser.add_argument(
        "--address",
        default="",
        metavar="HOST:PORT",
        help="of the simulated camera, with --source sim",
    )


def run(
    options: argparse.Namespace,
    say: Callable[[str], None] = print,
    wait: Callable[[str], str] = input,
) -> int:
    """Calibrate; return the exit code. `say` prints; `wait` asks the operator to place the
    board."""
    if options.latency:
        return _latency(options, say)
    if options.views is None:
        print("calibrate: give --views DIR, or --latency with --source", file=sys.stderr)
        return EXIT_BAD_INPUT
    if not options.output.parent.is_dir():  # Check before the work, not after it.
        print(
            f"calibrate: {options.output}: folder {options.output.parent} does not exist; "
            "create it",
            file=sys.stderr,
        )
        return EXIT_BAD_INPUT
    try:
        if options.source:
            config = {"source": options.source, "address": options.address}
            take_missing(options.views, open_images(config, time.monotonic), say, wait)
        views, board = read_views(options.views)
        found = calibrate(views, board)
        write_whole(options.output, calibration_text(found))
    except (CalibrationError, CalibrationFileError, ConnectionError, ValueError) as fault:
        print(f"calibrate: {fault}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OSError as fault:
        text = (
            f"{fault.filename or options.output}: {fault.strerror or fault}; name a file "
            "that can be used"
        )
        print(f"calibrate: {text}", file=sys.stderr)
        return EXIT_BAD_INPUT
    say(report(found, len(views)))
    say(f"written to {options.output}")
    return 0


def report(found: Calibration, views: int) -> str:
    """Return what the calibration found, as text for the operator."""
    x, y, z = found.optics.position
    poor = found.residual_px > POOR_PX or found.table_residual > POOR_PLACE
    hint = (
        f"better are {POOR_PX:g} px and {POOR_PLACE * 1e3:g} mm: take sharper images, of a flatter "
        "board, and measure [board] square and the places again"
    )
    return "\n".join(
        [
            f"board seen whole in {found.views} of {views} images",
            f"corners within {found.residual_px:.3f} px rms, known places within "
            f"{found.table_residual * 1e3:.2f} mm rms",
            f"a point of the table is known to {found.table_sigma * 1e3:.2f} mm (standard "
            "deviation)",
            f"focal length {found.optics.focal[0]:.1f} px, camera at ({x:.4f}, {y:.4f}, {z:.4f}) m",
            *[hint] * poor,
        ]
    )


def take_missing(
    folder: Path, source: ImageSource, say: Callable[[str], None], wait: Callable[[str], str]
) -> None:
    """Take each image that views.toml lists and the folder lacks. Raises ConnectionError when the
    camera sends no image."""
    files, board = missing_views(folder)
    if not files:
        return
    source.start(RATE)
    try:
        for path, known in files:
            place = "at its known place" if known else "tilted, anywhere in view"
            while True:
                wait(f"{path.name}: hold the board still {place}, then press Enter ")
                pixels = _settled(source)
                if find_corners(pixels, board) is not None:
                    break
                say("the board is not completely in view; try again")
            cv2.imwrite(str(path), pixels)
    finally:
        source.close()


def _settled(source: ImageSource) -> Pixels:
    """Return a fresh image after dropping the first ones."""
    taken, deadline = 0, time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        image = source.newest()
        if image is None:
            time.sleep(0.01)
            continue
        taken += 1
        if taken > SETTLE:
            return image.pixels
    raise ConnectionError(f"no image for {PATIENCE} s: is the camera connected?")


def _latency(options: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Measure with the terminal as the flash; return the exit code."""
    if not options.source:
        print("calibrate: --latency needs --source", file=sys.stderr)
        return EXIT_BAD_INPUT
    try:
        source = open_images({"source": options.source, "address": options.address}, time.monotonic)
        found, spread = measure_latency(source, _flash_terminal)
    except (ConnectionError, ValueError) as fault:
        print(f"calibrate: {fault}", file=sys.stderr)
        return EXIT_BAD_INPUT
    say(f"latency {found:.3f} s, within {spread:.3f} s for half of the {FLASHES} flashes")
    say("it includes the delay of the display, often 0.01 to 0.03 s; write what is left as")
    say("`latency` into the camera's table in services.toml")
    return 0


def _flash_terminal(bright: bool) -> None:
    """Fill the terminal with white or black (ECMA-48: SGR 107 or 40, erase, reset)."""
    sys.stdout.write(f"\x1b[{107 if bright else 40}m\x1b[2J\x1b[H\x1b[0m")
    sys.stdout.flush()


def measure_latency(source: ImageSource, flash: Callable[[bool], None]) -> tuple[float, float]:
    """Return the median time from mid-exposure until an image is available (s), and the half width
    of the middle half of all measurements (s).

    `flash` makes what the camera sees bright or dark. The first bright image was exposed half a
    period after the flash on average, which is taken off. Raises ConnectionError if the camera
    sends no image or does not see the flash.
    """
    chance = random.Random(1)  # flashes in step with the camera would all meet the same phase
    source.start(LATENCY_RATE)
    try:
        flash(False)
        time.sleep(SEEN_AFTER)
        dark = _settled(source).astype(float)
        flash(True)
        time.sleep(SEEN_AFTER)
        change = _settled(source) - dark
        lit = change > 0.5 * change.max()
        if change.max() < LEAST_CHANGE:
            raise ConnectionError(
                "the camera does not see the flash: point it at the terminal, dim the room"
            )
        middle = float((dark + 0.5 * change)[lit].mean())
        found, times = [], []
        for _ in range(FLASHES):
            flash(False)
            times += _until(source, SEEN_AFTER + chance.random() * 0.2, lambda level: False, lit)
            begin = time.monotonic()
            flash(True)
            seen = _until(source, PATIENCE, lambda level: level > middle, lit)
            if not seen or seen[-1] - begin > PATIENCE - 1.0:
                raise ConnectionError(f"no flash was seen for {PATIENCE} s: does the camera move?")
            found.append(seen[-1] - begin)
        period = float(np.median(np.diff(times)))
    finally:
        source.close()
    low, median, high = np.percentile(np.array(found) - 0.5 * period, [25.0, 50.0, 75.0])
    return float(median), float(high - low) / 2.0


def _until(
    source: ImageSource, seconds: float, holds: Callable[[float], bool], lit: NDArray[np.bool_]
) -> list[float]:
    """Read images until the mean level of their `lit` pixels is as wanted, at most for `seconds`;
    return their times (s)."""
    times: list[float] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        image = source.newest()
        if image is None:
            time.sleep(0.0005)
            continue
        times.append(image.time)
        if holds(float(image.pixels[lit].mean())):
            break
    return times


def calibrate_main(argv: Sequence[str] | None = None) -> int:
    """Run the command on its own; return the exit code: 0 written, 2 bad input."""
    parser = argparse.ArgumentParser(
        prog="calibrate", description=__doc__, epilog=f"example:\n  {EXAMPLE}"
    )
    add_arguments(parser)
    return run(parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(calibrate_main())
