"""Files of a calibration: read and write calibration.toml, and read folders of board images with
their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.services.host.toml_text import TomlError, read_toml
from petrobot.services.vision.calibration import Board, BoardView, Calibration
from petrobot.services.vision.optics import Array, Optics

SCHEMA = 1
DEFAULT = Path(__file__).with_name("calibration.toml")
"""Calibration of the simulated camera, made from its images by `petrobot calibrate`."""


class CalibrationFileError(ValueError):
    """A calibration file or a folder of views cannot be used; the message names file, key and
    remedy."""


def calibration_text(calibration: Calibration) -> str:
    """Return the calibration as TOML."""
    optics = calibration.optics
    rows = ",\n  ".join(_numbers(row) for row in optics.rotation)
    return f"""\
# A camera's calibration. Made by `petrobot calibrate`; remake it when camera, lens or table moved.
schema = {SCHEMA}
views = {calibration.views}
residual_px = {calibration.residual_px:.4f}  # rms of the board's corners
table_residual = {calibration.table_residual:.6f}  # m, rms of corners at known places
table_sigma = {calibration.table_sigma:.6f}  # m, standard deviation of a point of the table

[lens]
focal_px = {_numbers(optics.focal)}
centre_px = {_numbers(optics.centre)}
distortion = {_numbers(optics.distortion)}  # k1 k2 p1 p2, OpenCV's order

[pose]
position = {_numbers(optics.position)}  # m, optical centre in the base frame
# camera coordinates of a base-frame point p: rotation (p - position); rows: camera's x, y, z axes
rotation = [
  {rows},
]
"""


def _numbers(values: Any) -> str:
    return "[" + ", ".join(repr(round(float(value), 10)) for value in values) + "]"


def parse_calibration(text: str, name: str) -> Calibration:
    """Read a calibration from TOML; `name` is the file named in error messages. Raises
    CalibrationFileError."""
    try:
        data = read_toml(text, name)
        if data.get("schema") != SCHEMA:
            raise CalibrationFileError(
                f"{name}: schema: expected {SCHEMA}, got {data.get('schema')!r}; remake the file "
                "with petrobot calibrate"
            )
        lens, pose = data["lens"], data["pose"]
        optics = Optics(
            _tuple(lens["focal_px"], 2),
            _tuple(lens["centre_px"], 2),
            _tuple(lens["distortion"], 4),
            np.array(pose["rotation"], float).reshape(3, 3),
            np.array(pose["position"], float).reshape(3),
        )
        quality = (float(data[key]) for key in ("residual_px", "table_residual", "table_sigma"))
        calibration = Calibration(optics, int(data["views"]), *quality)
    except TomlError as fault:
        raise CalibrationFileError(f"{fault}; or remake it with petrobot calibrate") from fault
    except KeyError as fault:
        raise CalibrationFileError(
            f"{name}: key {fault} is missing; remake it with petrobot calibrate"
        ) from fault
    except (TypeError, ValueError) as fault:
        raise CalibrationFileError(f"{name}: {fault}; remake it with petrobot calibrate") from fault
    if not np.allclose(optics.rotation @ optics.rotation.T, np.eye(3), atol=1e-6):
        raise CalibrationFileError(
            f"{name}: [pose] rotation: expected an orthogonal matrix; remake it with petrobot "
            "calibrate"
        )
    return calibration


def _tuple(values: Sequence[float], count: int) -> Any:
    if len(values) != count:
        raise ValueError(f"expected {count} numbers, got {list(values)}")
    return tuple(float(value) for value in values)


def read_views(folder: Path) -> tuple[list[BoardView], Board]:
    """Read the board images of a folder, as its views.toml lists them.

    views.toml: `[board] columns, rows, square` and for each image `[[views]] file`, with `pose` (4
    rows of 4 numbers, board frame to base frame, m) where the board lay at a known place. Raises
    CalibrationFileError.
    """
    board, entries = _listed(folder)
    return [BoardView(_grey(path), pose) for path, pose in entries], board


def missing_views(folder: Path) -> tuple[list[tuple[Path, bool]], Board]:
    """Return the images that views.toml lists and the folder lacks, each with whether its pose is
    known, and the board.

    Raises CalibrationFileError.
    """
    board, entries = _listed(folder)
    return [(path, pose is not None) for path, pose in entries if not path.exists()], board


def _listed(folder: Path) -> tuple[Board, list[tuple[Path, Array | None]]]:
    path = folder / "views.toml"
    try:
        data = read_toml(path.read_bytes(), str(path))
        board = Board(
            int(data["board"]["columns"]),
            int(data["board"]["rows"]),
            float(data["board"]["square"]),
        )
        entries = [(folder / str(entry["file"]), _pose(entry, path)) for entry in data["views"]]
    except OSError as fault:
        raise CalibrationFileError(
            f"{path}: cannot be read ({fault.strerror}); it lists the board images"
        ) from fault
    except TomlError as fault:
        raise CalibrationFileError(str(fault)) from fault
    except KeyError as fault:
        raise CalibrationFileError(
            f"{path}: key {fault} is missing; docs/vision.md shows such a file"
        ) from fault
    return board, entries


def _pose(entry: Mapping[str, Any], path: Path) -> Array | None:
    if "pose" not in entry:
        return None
    try:
        return np.array(entry["pose"], float).reshape(4, 4)
    except (TypeError, ValueError) as fault:
        raise CalibrationFileError(
            f"{path}: pose of {entry['file']}: expected 4 rows of 4 numbers"
        ) from fault


def _grey(path: Path) -> NDArray[np.uint8]:
    if not path.is_file():  # OpenCV would print a warning of its own.
        raise CalibrationFileError(
            f"{path}: file not found; correct `file` in views.toml, or take the image with "
            "petrobot calibrate --source"
        )
    pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise CalibrationFileError(
            f"{path}: not an image; correct `file` in views.toml or take the image again"
        )
    return np.asarray(pixels, np.uint8)
