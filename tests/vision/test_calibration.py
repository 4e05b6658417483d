"""Calibration: it finds the true camera from rendered board images, and many cameras from corners
alone; files and command."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from petrobot.coordinator.cli import main
from petrobot.services.comm.streams.image import Image
from petrobot.services.vision import calibrate as command
from petrobot.services.vision.calibration import (
    DEFAULT,
    Board,
    BoardView,
    Calibration,
    CalibrationError,
    CalibrationFileError,
    adjust,
    calibrate,
    calibration_text,
    find_corners,
    parse_calibration,
    read_views,
)
from petrobot.services.vision.optics import Array, Optics
from petrobot.sim.catching.board import HELD, LAID, board_views
from petrobot.sim.catching.camera import PinholeCamera
from tests.vision.bench import nominal_optics
from tests.vision.test_optics import drawn_optics

pytestmark = pytest.mark.once

Views = list[BoardView]


def table_error(found: Optics, camera: PinholeCamera | Optics) -> Array:
    """Return the distances (m) between balls on the table and their positions according to the
    calibrated camera."""
    x, y = np.meshgrid(np.linspace(0.62, 2.22, 17), np.linspace(-0.45, 0.45, 9))
    balls = np.stack([x, y, np.full_like(x, 0.62)], axis=-1).reshape(-1, 3)
    off = found.to_plane(camera.project(balls), 0.62) - balls[:, :2]
    return np.asarray(np.hypot(off[:, 0], off[:, 1]))


@pytest.fixture(scope="module")
def folder(shared: Callable[..., Path]) -> Path:
    """Take board images with the simulated camera, as an operator would, and calibrate from them
    (`made.toml`)."""

    def take(base: Path) -> None:
        made = base / "made.toml"
        told = ["--views", str(base / "views"), "--simulated", "--output", str(made)]
        with redirect_stdout(StringIO()) as said:
            assert main(["calibrate", *told]) == 0
        assert "board seen whole in" in said.getvalue() and str(made) in said.getvalue()

    return shared("calibration", take) / "views"


@pytest.fixture(scope="module")
def views(folder: Path) -> Views:
    return read_views(folder)[0]


@pytest.fixture(scope="module")
def found(folder: Path) -> Calibration:
    made = folder.with_name("made.toml")
    return parse_calibration(made.read_text(encoding="utf-8"), made.name)


def test_rendered_boards_give_the_true_camera(
    found: Calibration, pinhole: PinholeCamera, cell: dict[str, Any]
) -> None:
    error = table_error(found.optics, pinhole)
    assert float(np.sqrt(np.mean(error**2))) < 0.5e-3
    assert error.max() < 1.0e-3
    nominal = table_error(nominal_optics(cell), pinhole)
    assert float(np.sqrt(np.mean(nominal**2))) > 5e-3, (
        "the truth differs: there was something to find"
    )
    assert found.residual_px < 0.15
    assert found.table_residual < 1e-3
    assert found.table_sigma < 0.6e-3
    assert found.optics.focal[0] == pytest.approx(pinhole.focal, abs=2.0)


def test_distortion_matters(found: Calibration, pinhole: PinholeCamera) -> None:
    straight = replace(found.optics, distortion=(0.0, 0.0, 0.0, 0.0))
    assert table_error(straight, pinhole).max() > 10e-3


def test_shipped_calibration_fits_the_simulated_camera(pinhole: PinholeCamera) -> None:
    shipped = parse_calibration(DEFAULT.read_text(encoding="utf-8"), DEFAULT.name)
    error = table_error(shipped.optics, pinhole)
    assert float(np.sqrt(np.mean(error**2))) < 0.5e-3
    assert not np.allclose(shipped.optics.position, pinhole.position, atol=1e-7), (
        "calibrated, not copied"
    )


def synthetic_corners(
    optics: Optics, rng: np.random.Generator, noise: float, placement: float
) -> tuple[Any, Any]:
    """Return corners (px) and stated poses of boards on the table and held up, without images."""
    corners: list[Array] = []
    poses: list[Array | None] = []
    board = Board()
    middle = np.array([(board.columns - 1) / 2, (board.rows - 1) / 2, 0.0]) * board.square
    for along, y, turn in LAID:
        rotation = cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, np.array([0.62 + along, y, 0.60]) - rotation @ middle
        moved = pose[:3, 3] + [*rng.normal(0, placement, 2), 0.0]
        points = board.points() @ rotation.T + moved
        corners.append(optics.project(points) + rng.normal(0, noise, (len(points), 2)))
        poses.append(pose)
    for along, y, above, *turns in HELD:
        rotation = cv2.Rodrigues(np.array(turns))[0]
        points = (board.points() - middle) @ rotation.T + [0.62 + along, y, 0.60 + above]
        corners.append(optics.project(points) + rng.normal(0, noise, (len(points), 2)))
        poses.append(None)
    return corners, poses


@pytest.mark.parametrize("seed", range(4))
def test_any_camera_is_found_from_exact_corners(cell: dict[str, Any], seed: int) -> None:
    truth = drawn_optics(cell, seed)
    corners, poses = synthetic_corners(truth, np.random.default_rng(seed), 0.0, 0.0)
    result = adjust(corners, poses, Board(), (640, 480))
    assert table_error(result.optics, truth).max() < 1e-6
    assert np.allclose(result.optics.distortion, truth.distortion, atol=1e-5)
    assert np.allclose(result.optics.position, truth.position, atol=1e-5)


def test_stated_accuracy_is_that_of_repeated_calibrations(cell: dict[str, Any]) -> None:
    """The standard deviation that a calibration states agrees with the scatter of repeated
    calibrations of one camera."""
    truth, errors, stated = drawn_optics(cell, 0), [], []
    for seed in range(6):
        corners, poses = synthetic_corners(truth, np.random.default_rng(seed), 0.07, 0.0003)
        result = adjust(corners, poses, Board(), (640, 480))
        errors.append(table_error(result.optics, truth))
        stated.append(result.table_sigma)
    measured = float(np.sqrt(np.mean(np.square(errors))))
    assert measured < 0.5e-3
    assert 0.4 < np.mean(stated) / measured < 2.5


@pytest.mark.parametrize(("noise", "placement"), [(0.07, 0.002), (0.3, 0.0003), (0.02, 0.001)])
def test_the_images_tell_how_well_the_boards_were_measured(
    cell: dict[str, Any], noise: float, placement: float
) -> None:
    """A laboratory that measures its boards badly learns it: residual and stated accuracy grow
    with the errors, though nobody stated them."""
    truth, errors, found = drawn_optics(cell, 3), [], []
    for seed in range(3):
        corners, poses = synthetic_corners(truth, np.random.default_rng(seed), noise, placement)
        found.append(adjust(corners, poses, Board(), (640, 480)))
        errors.append(table_error(found[-1].optics, truth))
    assert [f.residual_px for f in found] == pytest.approx([noise * 2**0.5] * 3, rel=0.1)
    stated = np.mean([f.table_sigma for f in found])
    assert 0.4 < stated / float(np.sqrt(np.mean(np.square(errors)))) < 2.5


def _turned(poses: list[Array | None]) -> list[Array | None]:
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    return [poses[0], None if poses[1] is None else poses[1] @ turn, *poses[2:]]


@pytest.mark.parametrize(
    ("views", "square", "wrong", "text"),
    [
        (range(9), 0.06, list, "within 0 degrees of parallel.*hold the board at six places"),
        ([0] * 8, 0.06, list, "do not determine the lens"),
        ([*range(5), 10], 0.06, list, "do not determine the lens: .*or too few are tilted"),
        (range(17), 0.05, list, r"0\.83\d+ times .* square 0\.06 m instead of 0\.05 m"),
        (range(17), 0.061, list, r"square 0\.06 m instead of 0\.061 m"),
        (range(17), 6.0, list, r"square 0\.06 m instead of 6 m"),
        (range(17), 0.06, _turned, "^view 2: the board is not where the pose says"),
        (range(17), 0.06, lambda p: [p[1], p[0], *p[2:]], "^view 1, view 2: the board is not"),
    ],
)
def test_poor_boards_are_refused_with_a_reason(
    cell: dict[str, Any],
    views: Sequence[int],
    square: float,
    wrong: Callable[[list[Array | None]], list[Array | None]],
    text: str,
) -> None:
    """A fit to them would take minutes, or give a wrong lens with a small standard deviation."""
    noise = np.random.default_rng(7)
    corners, poses = synthetic_corners(nominal_optics(cell), noise, 0.05, 0.0003)
    chosen = [corners[view] + noise.normal(0.0, 0.05, corners[view].shape) for view in views]
    with pytest.raises(CalibrationError, match=text):
        adjust(chosen, wrong([poses[view] for view in views]), Board(square=square), (640, 480))


def test_images_of_two_sizes_are_refused() -> None:
    small, large = (
        BoardView(np.zeros(size, np.uint8), name=name)
        for size, name in (((48, 64), "a.png"), ((96, 128), "b.png"))
    )
    with pytest.raises(CalibrationError, match=r"of one size.*a\.png 64x48, b\.png 128x96"):
        calibrate([small, large], Board())


def test_the_report_says_how_to_make_better_images() -> None:
    good = parse_calibration(DEFAULT.read_text(encoding="utf-8"), "lab.toml")
    assert "better are" not in command.report(good, 17)
    assert "take sharper images" in command.report(replace(good, residual_px=1.1), 17)
    assert "the places again" in command.report(replace(good, table_residual=0.008), 17)


def test_too_few_views_are_refused(views: Views) -> None:
    with pytest.raises(CalibrationError, match="known pose; take at least 6"):
        calibrate(views[:3], Board())
    blank = BoardView(np.zeros((480, 640), np.uint8), np.eye(4))
    with pytest.raises(CalibrationError, match="seen in 0 of 2 images"):
        calibrate([blank] * 2, Board())


def test_corners_come_in_the_boards_order_whichever_way_it_lies(pinhole: PinholeCamera) -> None:
    board = Board()
    for turn in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0]
        pose[:3, 3] = np.array([1.42, 0.0, 0.6]) - pose[:3, :3] @ [0.24, 0.15, 0.0]
        corners = find_corners(pinhole.render_board(pose), board)
        assert corners is not None
        wanted = pinhole.project(board.points() @ pose[:3, :3].T + pose[:3, 3])
        assert np.abs(corners - wanted).max() < 1.0


def test_file_round_trip(cell: dict[str, Any]) -> None:
    corners, poses = synthetic_corners(drawn_optics(cell, 0), np.random.default_rng(0), 0.1, 0.001)
    found = adjust(corners, poses, Board(), (640, 480))
    again = parse_calibration(calibration_text(found), "calibration.toml")
    assert np.allclose(again.optics.rotation, found.optics.rotation, atol=1e-9)
    assert again.optics.focal == pytest.approx(found.optics.focal, abs=1e-8)
    assert again.views == found.views


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("schema = 1", "schema = 7", "schema: expected 1, got 7"),
        ("centre_px", "center_px", "key 'centre_px' is missing"),
        ("[pose]", "[pose", "not valid TOML"),
        ("position = [", "position = [1.0, ", "cannot reshape"),
        ("rotation = [\n  [", "rotation = [\n  [9", "expected an orthogonal matrix"),
    ],
)
def test_bad_file_is_refused_with_file_and_remedy(old: str, new: str, fault: str) -> None:
    text = DEFAULT.read_text(encoding="utf-8").replace(old, new, 1)
    with pytest.raises(CalibrationFileError, match=r"lab\.toml:.*remake it") as refused:
        parse_calibration(text, "lab.toml")
    assert fault in str(refused.value)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (None, "cannot be read"),
        ("[board", "not valid TOML"),
        ("[board]\ncolumns = 9\nrows = 6\n", "key 'square' is missing"),
        (
            '[board]\ncolumns=9\nrows=6\nsquare=0.06\n[[views]]\nfile="a.png"\n',
            "a.png: file not found",
        ),
        (
            '[board]\ncolumns=9\nrows=6\nsquare=0.06\n[[views]]\nfile="a.png"\npose=[1]\n',
            "expected 4 rows of 4",
        ),
        (
            '[board]\ncolumns=9\nrows=6\nsquare=0.06\n[[views]]\nfile="a.png"\n'
            "pose=[[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n",
            "pose of a.png: its first three columns are not a rotation",
        ),
        ('[board]\ncolumns="nine"\nrows=6\nsquare=0.06\n', "[board]: expected columns and rows"),
        ("[board]\ncolumns=9\nrows=1\nsquare=0.06\nviews=[]", "[board]: expected columns and"),
    ],
)
def test_bad_views_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, fault: str
) -> None:
    if text is not None:
        (tmp_path / "views.toml").write_text(text, encoding="utf-8")
    assert (
        command.calibrate_main(["--views", str(tmp_path), "--output", str(tmp_path / "out.toml")])
        == 2
    )
    assert fault in capsys.readouterr().err
    assert not (tmp_path / "out.toml").exists()


def test_missing_images_are_taken_from_the_camera(
    folder: Path, views: Views, tmp_path: Path
) -> None:
    """For a folder with only views.toml, each image is taken when the operator confirms, and again
    if the board is not fully visible."""
    lines = (folder / "views.toml").read_text(encoding="utf-8").split("[[views]]")
    (tmp_path / "views.toml").write_text("[[views]]".join(lines[:3]), encoding="utf-8")
    shown = [np.zeros((480, 640), np.uint8), views[0].pixels, views[1].pixels]
    asked: list[str] = []

    class Hand:
        """A camera that shows the board that the operator holds."""

        condition = ""
        sequence = 0

        def start(self, rate: float) -> None:
            assert rate > 0

        def stop(self) -> None: ...

        def close(self) -> None:
            asked.append("closed")

        def newest(self) -> Image | None:
            self.sequence += 1
            return Image(shown[len(asked) - 1], 0.0, self.sequence)

    def press_enter(text: str) -> str:
        asked.append(text)
        return ""

    said: list[str] = []
    command.take_missing(tmp_path, Hand(), said.append, press_enter)
    assert said == ["the board is not completely in view; try again"]
    assert asked[-1] == "closed" and len(asked) == 4
    taken, _ = read_views(tmp_path)
    assert np.array_equal(taken[0].pixels, views[0].pixels) and np.array_equal(
        taken[1].pixels, views[1].pixels
    )


def test_measured_places_differ_from_true_ones(
    cell: dict[str, Any], pinhole: PinholeCamera
) -> None:
    """The simulated operator makes errors: boards do not lie exactly where they were measured."""
    poses = [
        pose
        for _, pose in zip(
            range(3), board_views(cell, pinhole, np.random.default_rng(0)), strict=False
        )
    ]
    first = find_corners(poses[0][0], Board())
    stated = poses[0][1]
    assert first is not None and stated is not None
    wanted = pinhole.project(Board().points() @ stated[:3, :3].T + stated[:3, 3])
    assert 0.01 < np.abs((first - wanted).mean(axis=0)).max() < 0.6


def test_shipped_calibration_is_what_the_command_makes(
    found: Calibration, pinhole: PinholeCamera
) -> None:
    """`--simulated` takes all images first and then calibrates. The shipped file was made in this
    way while the accuracies of corners and places were still constants; it stays, as all recorded
    runs in lock step used it."""
    shipped = parse_calibration(DEFAULT.read_text(encoding="utf-8"), DEFAULT.name)
    apart = table_error(found.optics, shipped.optics)
    assert float(np.sqrt(np.mean(apart**2))) < found.table_sigma
    assert table_error(found.optics, pinhole).max() < 1e-3


def test_the_command_overwrites_nothing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views, made = tmp_path / "views", tmp_path / "made.toml"
    told = ["calibrate", "--views", str(views), "--simulated", "--output", str(made)]
    assert main([*told, "--source", "capture:0"]) == 2
    assert "leave one out" in capsys.readouterr().err and not views.exists()
    assert main(["calibrate", "--views", str(folder), "--simulated", "--output", str(made)]) == 2
    assert f"{folder} is not empty" in capsys.readouterr().err and not made.exists()
    nowhere = ["--output", str(tmp_path / "nowhere" / "c.toml")]
    assert main(["calibrate", "--views", str(folder), *nowhere]) == 2
    assert "nowhere/c.toml: folder" in capsys.readouterr().err


class Screen:
    """A camera of 100 images/s whose images come 0.08 s after mid-exposure, before a screen; and
    the time in which that happens."""

    condition = ""
    late = 0.08

    def __init__(self) -> None:
        self.now = 0.0
        self.changes = [(0.0, 0.0)]
        self.sequence = -1

    def flash(self, bright: bool) -> None:
        """The screen."""
        self.changes.append((self.now, 200.0 * bright))

    def monotonic(self) -> float:
        """The time (s); asking takes some of it."""
        self.now += 1e-5
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self.now += seconds

    def start(self, rate: float) -> None:
        """It is always on."""

    def stop(self) -> None:
        """It stays on."""

    def close(self) -> None:
        """Nothing to release."""

    def newest(self) -> Image | None:
        """Each image is exposed at one moment, in its middle."""
        if int((self.now - self.late) * 100) == self.sequence:
            return None
        self.sequence = int((self.now - self.late) * 100)
        level = [to for at, to in self.changes if at <= self.sequence / 100][-1]
        pixels = np.full((8, 8), 20, np.uint8)
        pixels[2:6, 2:6] += np.uint8(level)
        return Image(pixels, self.now, self.sequence)


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Screen:
    """With its own time, which the command then goes by."""
    made = Screen()
    monkeypatch.setattr(command, "time", made)
    return made


def test_the_latency_of_a_camera_is_measured(screen: Screen) -> None:
    latency, spread = command.measure_latency(screen, screen.flash)
    assert latency == pytest.approx(screen.late, abs=0.002)
    assert 0.001 < spread < 0.005, "flashes meet any phase of a period of 0.01 s"


def test_a_camera_that_does_not_see_the_flash_is_reported(screen: Screen) -> None:
    with pytest.raises(ConnectionError, match="does not see the flash: point it at the terminal"):
        command.measure_latency(screen, lambda bright: None)


@pytest.mark.parametrize(
    ("given", "text"),
    [([], "give --views DIR, or --latency"), (["--latency"], "--latency needs --source")],
)
def test_what_to_do_must_be_said(
    given: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.calibrate_main(given) == 2
    assert text in capsys.readouterr().err
