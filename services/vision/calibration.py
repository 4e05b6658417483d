"""Calibration from images of a chessboard: lens, distortion and the camera's pose in the base
frame, solved together.

Views whose board pose in the base frame is known (laid on the table at measured places) tie the
camera to the base; views held by hand at any tilt determine the lens. The start values come from
OpenCV's calibrateCamera (Z. Zhang, "A flexible new technique for camera calibration", 2000). Then
one least-squares problem covers all unknowns: intrinsics, camera pose, and each view's pose; a
prior holds known poses to their measured values within their accuracy (bundle adjustment). No
hand-eye routine is needed, which OpenCV 5 no longer has. Pure: images in, calibration out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.host.toml_text import TomlError, read_toml
from petrobot.services.vision.optics import Array, Optics

CORNER_WINDOW = 5
"""px, half width of the window in which a corner is refined; less than half the side of a square in
any view."""
RULER = (0.1, 0.002, 0.001)
"""Accuracies that the adjustment begins with: of a corner (px), of a board's measured direction
(rad) and of its measured place (m), as with a ruler. The images tell the real ones."""
FINEST = (0.002, 1e-5, 1e-5)
"""The same, least ones: exact corners or places would get weights without bound."""
ROUNDS = 20
"""Most rounds of estimating the accuracies."""
FEWEST_VIEWS, FEWEST_KNOWN = 6, 3
"""Fewest views with the whole board, and fewest of them with a known pose."""
LEAST_TILT, FOCAL_SHARE, SCALE_SHARE = 10.0, 0.02, 0.01
"""Least angle between two boards (degrees); greatest standard deviation of the focal length, as a
share of it; and greatest share by which distances of boards may be other ones than stated."""
WRONG_POSE = 0.05, 5.0
"""How far (m, degrees) a board may be from where its pose says, by the first estimate: a pose that
is further off is wrong, not inaccurate."""
MOST_STEPS = 500
"""Steps of a fit; one that converges takes about ten."""
LENS = 8
"""Number of lens unknowns: fx fy cx cy k1 k2 p1 p2."""


class CalibrationError(ValueError):
    """The images do not determine a calibration; the message says why and what to do."""


class Board(Struct, frozen=True):
    """A chessboard of `columns` x `rows` inner corners with squares of `square` m.

    Origin of its frame: the first corner, beside the black square that touches the printed corner
    of the board; x along the columns, z out of the board.
    """

    columns: int = 9
    rows: int = 6
    square: float = 0.060

    def points(self) -> Array:
        """Return the inner corners (rows * columns, 3) in the board's frame (m)."""
        y, x = np.mgrid[0 : self.rows, 0 : self.columns].astype(float)
        return (
            np.stack([x.ravel(), y.ravel(), np.zeros(self.rows * self.columns)], axis=-1)
            * self.square
        )


class BoardView(Struct, frozen=True):
    """One image of the board, grey levels (height, width); `pose` (4, 4) from board frame to base
    frame, None where unknown; `name` that of its file."""

    pixels: NDArray[np.uint8]
    pose: Array | None = None
    name: str = ""


class Calibration(Struct, frozen=True):
    """A calibrated camera and how accurately it is known."""

    optics: Optics
    views: int
    residual_px: float
    """rms distance between the corners and where the calibrated camera expects them."""
    table_residual: float
    """m, rms distance on the board's plane between corners of the known views and their stated
    positions."""
    table_sigma: float
    """m, standard deviation (from the covariance of the fit) of a point of the table, rms over the
    image."""


def find_corners(pixels: NDArray[np.uint8], board: Board) -> Array | None:
    """Return the inner corners (n, 2) px in the order of `Board.points`; None when the whole board
    is not in view."""
    found, corners = cv2.findChessboardCornersSB(
        pixels, (board.columns, board.rows), None, cv2.CALIB_CB_ACCURACY
    )
    if not found or corners is None:
        return None
    limit = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 0.001)
    corners = cv2.cornerSubPix(pixels, corners, (CORNER_WINDOW, CORNER_WINDOW), (-1, -1), limit)
    grid = np.asarray(corners, float).reshape(board.rows, board.columns, 2)
    if np.linalg.det(np.stack([grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]])) > 0.0:
        # Seen from the printed side, the turn from x to y is to the left, but image y points down.
        grid = grid[::-1]
    ordered = grid.reshape(-1, 2)
    return ordered if _begins_black(pixels, ordered, board) else ordered[::-1]


def _begins_black(pixels: NDArray[np.uint8], corners: Array, board: Board) -> bool:
    """Return whether the inner square at the first corner is black; tells the board from itself
    turned by 180 degrees."""
    grid = corners.reshape(board.rows, board.columns, 2)

    def square(row: int, column: int) -> float:
        u, v = np.rint(grid[row : row + 2, column : column + 2].mean(axis=(0, 1))).astype(int)
        return float(pixels[v - 1 : v + 2, u - 1 : u + 2].mean())

    return square(0, 0) < (square(0, 1) + square(1, 0)) / 2


def calibrate(views: Sequence[BoardView], board: Board) -> Calibration:
    """Calibrate from board images. Raises CalibrationError when they are too few, or do not fit
    together."""
    sizes = {view.pixels.shape[::-1]: view.name for view in views}
    if len(sizes) > 1:
        listed = ", ".join(f"{name} {wide}x{high}" for (wide, high), name in sizes.items())
        raise CalibrationError(f"expected images of one size, of one camera, found {listed}")
    seen = [
        (corners, view)
        for view in views
        if (corners := find_corners(view.pixels, board)) is not None
    ]
    known = sum(view.pose is not None for _, view in seen)
    if len(seen) < FEWEST_VIEWS or known < FEWEST_KNOWN:
        raise CalibrationError(
            f"the whole board is seen in {len(seen)} of {len(views)} images, {known} of them "
            "with a known pose; "
            f"take at least {FEWEST_VIEWS}, {FEWEST_KNOWN} of them at known places of the table"
        )
    height, width = seen[0][1].pixels.shape
    return adjust(
        [corners for corners, _ in seen],
        [view.pose for _, view in seen],
        board,
        (width, height),
        [view.name for _, view in seen],
    )


def adjust(
    corners: Sequence[Array],
    poses: Sequence[Array | None],
    board: Board,
    size: tuple[int, int],
    names: Sequence[str] = (),
) -> Calibration:
    """Calibrate from the corners (n, 2) px of each view, its pose (4, 4) or None, the image's
    width and height, and names of the views for messages.

    Raises CalibrationError when the views do not determine the camera.
    """
    return _Adjustment(board, corners, poses, size, names).solve()


class _Adjustment:
    """The least-squares problem.

    Unknowns: lens (8), camera pose (6: rotation vector and translation), and one pose (6) per view:
    for a known view its deviation from the stated pose in the board's frame, for any other the
    board in the camera's frame.

    How well corners, directions and places are measured is unknown, too, and differs from
    laboratory to laboratory. The three variances are estimated with the rest: each is the sum of
    its squared residuals by their redundancy (Forstner, "Ein Verfahren zur Schaetzung von
    Varianz- und Kovarianzkomponenten", AVN 86, 1979), in turns with the fit.
    """

    def __init__(
        self,
        board: Board,
        corners: Sequence[Array],
        poses: Sequence[Array | None],
        size: tuple[int, int],
        names: Sequence[str],
    ) -> None:
        self._points = board.points()
        self._corners = corners
        self._poses = poses
        self._size = size
        self._board = board
        self._names = names or [f"view {number}" for number in range(1, len(corners) + 1)]
        self._accuracy = np.array(RULER)
        """Of a corner (px), a stated direction (rad) and a stated place (m)."""
        known = sum(pose is not None for pose in poses)
        self._kind = np.repeat(
            [0, *[1, 2] * known], [2 * len(self._points) * len(corners), *[3] * (2 * known)]
        )
        """For each residual, which of the three it is an error of."""

    def solve(self) -> Calibration:
        """Start from calibrateCamera, refine all unknowns together, report residuals."""
        first = self._fit(self._start())
        self._accuracy = self._estimated(first.fun, first.jac)
        fit = self._fit(first.x)
        optics = self._optics(fit.x)
        corner = fit.fun[self._kind == 0] * self._accuracy[0]
        residual = float(np.sqrt(2.0 * np.mean(corner**2)))
        return Calibration(
            optics,
            len(self._corners),
            residual,
            self._table_residual(optics),
            self._table_sigma(fit.x, fit.jac),
        )

    def _fit(self, start: Array) -> Any:
        # Imported here, not above: a node that only reads a calibration would otherwise load scipy
        # for nothing, a third of its start.
        from scipy.optimize import least_squares

        fit = least_squares(
            self._residuals,
            start,
            self._slopes,
            method="lm",
            x_scale="jac",
            xtol=1e-10,
            max_nfev=MOST_STEPS,
        )
        if not fit.success:
            raise CalibrationError(
                f"the calibration does not converge ({fit.message}); take more and sharper images"
            )
        return fit

    def _estimated(self, residuals: Array, jacobian: Array) -> Array:
        """Return the accuracies that a fit shows. Its Jacobian is kept, as the accuracies change
        the solution only a little. The part of a residual that the unknowns do not take up is its
        redundancy; the accuracy of a kind is the root of its sum of squares over its redundancy
        (estimation of variance components, as in adjustments of geodetic nets)."""
        accuracy = self._accuracy
        for _ in range(ROUNDS):
            weight = (self._accuracy / accuracy)[self._kind]
            slopes, off = jacobian * weight[:, None], residuals * weight
            inverse = np.linalg.pinv(slopes.T @ slopes, hermitian=True) @ slopes.T
            off = off - slopes @ (inverse @ off)
            redundancy = np.bincount(self._kind, 1.0 - np.einsum("ij,ji->i", slopes, inverse))
            squares = np.bincount(self._kind, off**2)
            before = accuracy
            accuracy = np.maximum(before * np.sqrt(squares / redundancy), FINEST)
            if np.allclose(accuracy, before, rtol=0.01):
                break
        return np.asarray(accuracy)

    def _start(self) -> Array:
        points = [self._points.astype(np.float32)] * len(self._corners)
        corners = [c.astype(np.float32)[:, None, :] for c in self._corners]
        _, matrix, distortion, turns, shifts, spread, *_ = cv2.calibrateCameraExtended(
            points,
            corners,
            self._size,
            np.eye(3),
            np.zeros(5),
            flags=cv2.CALIB_FIX_K3,
        )
        placed = [
            _pose(np.ravel(turn), np.ravel(shift))
            for turn, shift in zip(turns, shifts, strict=True)
        ]
        self._check(float(spread[:2].max() / matrix[0, 0]), placed)
        first = next(i for i, pose in enumerate(self._poses) if pose is not None)
        base = placed[first] @ np.linalg.inv(np.asarray(self._poses[first]))
        parts = [
            [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]],
            np.ravel(distortion)[:4],
            _vector(base),
        ]
        parts += [
            np.zeros(6) if known is not None else _vector(p)
            for known, p in zip(self._poses, placed, strict=True)
        ]
        return np.concatenate([np.asarray(part, float) for part in parts])

    def _check(self, focal_share: float, placed: Sequence[Array]) -> None:
        """Refuse what no fit can mend, by the first estimates: the standard deviation of the focal
        length, as its share, and the boards' poses in the camera's frame."""
        normals = np.array([pose[:3, 2] for pose in placed])
        tilt = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))
        if tilt < LEAST_TILT or not focal_share <= FOCAL_SHARE:
            raise CalibrationError(
                f"the images do not determine the lens: the boards lie within {tilt:.0f} degrees "
                "of parallel, or too few are tilted; hold the board at six places, tilted by 20 to "
                "45 degrees to different sides"
            )
        known = [
            (name, pose, stated)
            for name, pose, stated in zip(self._names, placed, self._poses, strict=True)
            if stated is not None
        ]
        seen, said = (
            sum(float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a in poses for b in poses)
            for poses in ([view[1] for view in known], [view[2] for view in known])
        )
        if said and abs(seen / said - 1.0) > SCALE_SHARE:
            raise CalibrationError(
                f"the known boards are {seen / said:.4g} times as far apart as their poses say: is "
                f"the side of a square {self._board.square * said / seen:.3g} m instead of "
                f"{self._board.square:g} m, are all poses in m?"
            )
        # Each known view tells where the base is; those that disagree with most are wrong.
        middle = np.append(np.mean([pose @ self._middle() for *_, pose in known], axis=0)[:3], 1.0)
        bases = [pose @ np.linalg.inv(stated) for _, pose, stated in known]
        apart = np.array([[_apart(a, b, middle) for a in bases] for b in bases]) / WRONG_POSE
        agree = apart.max(axis=2) <= 1.0
        best = agree[int(agree.sum(axis=1).argmax())]
        if not best.all():
            wrong = ", ".join(view[0] for view, fine in zip(known, best, strict=True) if not fine)
            raise CalibrationError(
                f"{wrong}: the board is not where the pose says, if the other views are right: "
                "origin at the first inner corner, beside a black square, x along the columns, z "
                "up; or columns and rows of [board] are exchanged"
            )

    def _middle(self) -> Array:
        """Return the middle of the board in its frame (4,)."""
        return np.append(self._points.mean(axis=0), 1.0)

    def _residuals(self, unknown: Array) -> Array:
        """Return the corner residuals in units of their accuracy, then the deviations of the known
        views in units of theirs."""
        fx, fy, cx, cy = unknown[:4]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        base = _pose(unknown[LENS : LENS + 3], unknown[LENS + 3 : LENS + 6])
        accuracy = np.repeat(self._accuracy[1:], 3)
        parts, priors = [], []
        for k, (corners, known) in enumerate(zip(self._corners, self._poses, strict=True)):
            own = unknown[LENS + 6 + 6 * k : LENS + 12 + 6 * k]
            pose = _pose(own[:3], own[3:])
            if known is not None:
                pose = base @ known @ pose
                priors.append(own / accuracy)
            turn = cv2.Rodrigues(pose[:3, :3])[0]
            expected = cv2.projectPoints(self._points, turn, pose[:3, 3], matrix, unknown[4:LENS])[
                0
            ]
            parts.append((expected.reshape(-1, 2) - corners).ravel() / self._accuracy[0])
        return np.concatenate(parts + priors)

    def _slopes(self, unknown: Array) -> Array:
        """Return the Jacobian by central differences. A view's pose changes only its own residuals,
        so all views are moved at once."""
        rows = 2 * len(self._points)
        views = len(self._corners)
        own_rows = np.arange(views * rows).reshape(views, rows)
        slopes = np.zeros((len(self._residuals(unknown)), len(unknown)))
        for k in range(LENS + 6):
            step = np.zeros(len(unknown))
            step[k] = 1e-6 * max(1.0, abs(unknown[k]))
            slopes[:, k] = (self._residuals(unknown + step) - self._residuals(unknown - step)) / (
                2.0 * step[k]
            )
        for k in range(6):
            columns = LENS + 6 + 6 * np.arange(views) + k
            step = np.zeros(len(unknown))
            step[columns] = 1e-6
            change = (self._residuals(unknown + step) - self._residuals(unknown - step)) / 2e-6
            for view, column in enumerate(columns):
                slopes[own_rows[view], column] = change[own_rows[view]]
            known = [
                column
                for column, pose in zip(columns, self._poses, strict=True)
                if pose is not None
            ]
            prior_rows = views * rows + 6 * np.arange(len(known)) + k
            slopes[prior_rows, known] = change[prior_rows]
        return slopes

    def _optics(self, unknown: Array) -> Optics:
        fx, fy, cx, cy, k1, k2, p1, p2 = (float(value) for value in unknown[:LENS])
        base = _pose(unknown[LENS : LENS + 3], unknown[LENS + 3 : LENS + 6])
        return Optics(
            (fx, fy), (cx, cy), (k1, k2, p1, p2), base[:3, :3], -base[:3, :3].T @ base[:3, 3]
        )

    def _table_residual(self, optics: Optics) -> float:
        squares = []
        for corners, pose in zip(self._corners, self._poses, strict=True):
            if pose is not None:
                stated = self._points @ pose[:3, :3].T + pose[:3, 3]
                squares.append(
                    np.sum(
                        (optics.to_plane(corners, float(pose[2, 3])) - stated[:, :2]) ** 2, axis=-1
                    )
                )
        return float(np.sqrt(np.mean(squares)))

    def _table_sigma(self, unknown: Array, jacobian: Array) -> float:
        """Propagate the covariance of the fit to the plane of the known views, at a grid of
        pixels."""
        covariance = np.linalg.pinv(jacobian.T @ jacobian)[: LENS + 6, : LENS + 6]
        u, v = np.meshgrid(
            np.linspace(0, self._size[0] - 1, 9), np.linspace(0, self._size[1] - 1, 7)
        )
        grid = np.stack([u.ravel(), v.ravel()], axis=-1)
        z = float(np.mean([pose[2, 3] for pose in self._poses if pose is not None]))
        middle = self._optics(unknown).to_plane(grid, z).ravel()
        slopes = np.empty((len(middle), LENS + 6))
        for k in range(LENS + 6):
            step = np.sqrt(covariance[k, k])
            moved = unknown.copy()
            moved[k] += step
            slopes[:, k] = (self._optics(moved).to_plane(grid, z).ravel() - middle) / step
        variances = np.einsum("ij,jk,ik->i", slopes, covariance, slopes).reshape(-1, 2)
        return float(np.sqrt(variances.sum(axis=-1).mean()))


def _pose(turn: Array, shift: Array) -> Array:
    """Return the pose (4, 4) of a rotation vector (3,) and a translation (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.asarray(turn, float))[0]
    pose[:3, 3] = shift
    return pose


def _apart(a: Array, b: Array, point: Array) -> tuple[float, float]:
    """Return how far two poses (4, 4) put a point (4,) apart (m), and their angle (degrees)."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return float(np.linalg.norm((a - b) @ point)), float(angle)


def _vector(pose: Array) -> Array:
    """Return rotation vector and translation (6,) of a pose (4, 4)."""
    return np.concatenate([np.ravel(cv2.Rodrigues(pose[:3, :3])[0]), pose[:3, 3]])


# --- files ---

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
    return [BoardView(_grey(path), pose, path.name) for path, pose in entries], board


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
        if min(board.columns, board.rows) < 3 or not 0.0 < board.square < 10.0:
            raise ValueError
        entries = [(folder / str(entry["file"]), _pose_of(entry, path)) for entry in data["views"]]
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
    except (TypeError, ValueError) as fault:
        if isinstance(fault, CalibrationFileError):
            raise
        raise CalibrationFileError(
            f"{path}: [board]: expected columns and rows from 3, and square in m (the side of a "
            f"square), found {data.get('board')}"
        ) from fault
    return board, entries


def _pose_of(entry: Mapping[str, Any], path: Path) -> Array | None:
    if "pose" not in entry:
        return None
    try:
        pose = np.array(entry["pose"], float).reshape(4, 4)
        turn = pose[:3, :3]
        if np.abs(turn @ turn.T - np.eye(3)).max() > 0.01 or np.linalg.det(turn) < 0.0:
            raise CalibrationFileError(
                f"{path}: pose of {entry['file']}: its first three columns are not a rotation: "
                "expected three directions of length 1, at right angles, right-handed"
            )
        return pose
    except (TypeError, ValueError) as fault:
        if isinstance(fault, CalibrationFileError):
            raise
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
