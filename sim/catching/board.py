"""Board images of the simulated laboratory, as an operator would take them: laid on the table at
measured places, and held by hand.

`python -m petrobot.sim.catching.board DIR` saves them in the format of `petrobot calibrate --views
DIR`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.sim.catching.camera import Array, PinholeCamera
from petrobot.sim.catching.scenery import Chessboard
from petrobot.sim.catching.truth import read_toml, read_truth

CELL = Path(__file__).parents[2] / "services" / "cell.toml"

PLACEMENT = 0.0003
"""Standard deviation of where the board really lies around the measured place (m)."""
DIRECTION = 0.0005
"""The same for its direction (rad)."""
LAID = (
    (0.20, -0.24, 1.6),
    (0.20, 0.20, 1.5),
    (0.28, 0.00, 3.1),
    (0.80, -0.27, 3.1),
    (0.80, 0.00, 0.0),
    (0.80, 0.27, -0.1),
    (1.32, 0.00, 0.1),
    (1.40, 0.24, -1.5),
    (1.40, -0.20, 1.6),
)
"""Middle of the board on the table (m from the near edge, y) and its direction (rad)."""
HELD = (
    (0.35, -0.15, 0.35, 0.45, 0.0, 0.2),
    (0.35, 0.20, 0.30, -0.45, 0.2, -0.4),
    (0.80, 0.00, 0.45, 0.0, 0.5, 0.0),
    (0.80, 0.10, 0.30, 0.4, -0.4, 0.8),
    (0.85, -0.15, 0.55, -0.3, -0.3, 1.5),
    (1.30, 0.15, 0.35, 0.5, 0.1, -0.2),
    (1.25, -0.20, 0.30, -0.4, 0.4, 0.3),
    (0.80, 0.00, 0.70, 0.1, 0.2, 0.1),
)
"""Middle of the board (m from the near edge, y, m above the table) and its turns about x, y and z
(rad)."""


def board_views(
    cell: Mapping[str, Any],
    camera: PinholeCamera,
    rng: np.random.Generator,
    board: Chessboard | None = None,
) -> Iterator[tuple[NDArray[np.uint8], Array | None]]:
    """Yield images of the board with its measured pose (4, 4) in the base frame, None for a held
    board."""
    board = board or Chessboard()
    table = cell["table"]
    for along, y, turn in LAID:
        place = np.array([table["near_edge"] + along, y, table["top"]])
        measured = _centred(place, _turned(0.0, 0.0, turn), board)
        shift = np.array([*rng.normal(0.0, PLACEMENT, 2), 0.0])
        true = _centred(
            place + shift, _turned(0.0, 0.0, turn + float(rng.normal(0.0, DIRECTION))), board
        )
        true[2, 3] = camera.table.top
        yield camera.render_board(true, board), measured
    for along, y, above, *turns in HELD:
        place = np.array([table["near_edge"] + along, y, table["top"] + above])
        yield camera.render_board(_centred(place, _turned(*turns), board), board), None


def save_board_views(
    folder: Path, cell: Mapping[str, Any], camera: PinholeCamera, rng: np.random.Generator
) -> None:
    """Take the images and save them with the measured poses: view01.png, ... and views.toml, in the
    format of `petrobot calibrate`."""
    board = Chessboard()
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        f"[board]\ncolumns = {board.columns}\nrows = {board.rows}\nsquare = {board.square}  # m\n"
    ]
    for number, (pixels, pose) in enumerate(board_views(cell, camera, rng, board), 1):
        name = f"view{number:02}.png"
        cv2.imwrite(str(folder / name), pixels)
        lines.append(f'[[views]]\nfile = "{name}"')
        if pose is not None:
            rows = ",\n".join(
                "  [" + ", ".join(f"{value:.9f}" for value in row) + "]" for row in pose
            )
            lines.append(f"pose = [\n{rows},\n]")
        lines.append("")
    (folder / "views.toml").write_text("\n".join(lines), encoding="utf-8")


def _centred(place: Array, rotation: Array, board: Chessboard) -> Array:
    """Return the pose of a board whose middle is at `place`."""
    middle = np.array([(board.columns - 1) / 2, (board.rows - 1) / 2, 0.0]) * board.square
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place - rotation @ middle
    return pose


def _turned(x: float, y: float, z: float) -> Array:
    """Return the rotation by z, then y, then x about the moving axes (rad)."""
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(angle), np.sin(angle)) for angle in (x, y, z))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)


def main(argv: Sequence[str] | None = None) -> int:
    """Save board images of the simulated camera in its true pose; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m petrobot.sim.catching.board",
        description="Save images of a calibration board taken by the simulated camera.",
        epilog="example:\n  python -m petrobot.sim.catching.board board_images && petrobot "
        "calibrate "
        "--views board_images",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="folder for view01.png, ... and views.toml")
    parser.add_argument(
        "--seed", type=int, default=1, help="of noise and of how the boards really lie (default 1)"
    )
    options = parser.parse_args(argv)
    cell = read_toml(CELL)
    truth = read_truth(cell)
    view = {
        key: getattr(truth.camera, key)
        for key in ("position", "rotation", "focal_px", "principal_px", "distortion")
    }
    view |= {"table_top": truth.table.top, "near_edge": truth.table.near_edge}
    rng = np.random.default_rng(options.seed)
    save_board_views(options.folder, cell, PinholeCamera(cell, view, rng), rng)
    print(f"{len(LAID) + len(HELD)} images saved to {options.folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
