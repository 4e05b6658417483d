"""Film of a run from above, with the view of the rover's camera, as a video or an animated picture.
Needs only a score.

`python -m petrobot.sim.track.film RUN.json --film run.webm --plan run.svg` draws film and floor
plan of a result file.
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.sim.track.camera import Motion, Mount, RoverCamera
from petrobot.sim.track.course import BOARD, SQUARE, Track, TrackError
from petrobot.sim.track.floor import COARSE, ORIGIN, Floor
from petrobot.sim.track.plan import floor_plan, summary

Picture = NDArray[np.uint8]

ROVER_FILE: Final = Path(__file__).parents[2] / "services" / "mobile" / "rover.toml"
WIDTH: Final = 640
"""Greater side of the film (px)."""
_PATH, _ROVER, _REFLECTOR = (15, 72, 217), (230, 120, 30), (59, 212, 255)
"""Blue, green, red."""
_PANEL: Final = (225, 225, 225)
_OUTLINE: Final = np.array([(0.18, 0.0), (0.06, 0.2), (-0.22, 0.2), (-0.22, -0.2), (0.06, -0.2)])
_FOURCC: Final = {".webm": "VP80", ".mp4": "mp4v", ".avi": "MJPG"}
_ANIMATED: Final = (".gif", ".webp")
_EYE: Final = (160, 120)


class FilmError(ValueError):
    """The film cannot be made; the message says what to do."""


class FilmView:
    """The floor from above, cropped to the track's squares and one around them."""

    def __init__(self, track: Track) -> None:
        floor = Floor()
        floor.paint(track)
        self.floor = floor
        squares = np.array([element.square for element in track.elements])
        self._low = np.maximum(squares.min(axis=0) - 1, 0) * SQUARE
        high = np.minimum(squares.max(axis=0) + 2, BOARD) * SQUARE
        wide, tall = high - self._low
        self.scale = float(WIDTH / max(wide, tall))
        first, last = ((np.array((self._low, high)) - ORIGIN) / COARSE).round().astype(int)
        part = floor.coarse[first[1] : last[1], first[0] : last[0]][::-1]
        size = (
            2 * round(wide * self.scale / 2),
            2 * round(tall * self.scale / 2),
        )  # encoders want even numbers
        grey = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.uint8)
        muted = cv2.convertScaleAbs(grey, alpha=0.75, beta=45.0)
        self.still = np.asarray(cv2.cvtColor(muted, cv2.COLOR_GRAY2BGR), np.uint8)
        self._top = float(high[1])
        for gap in track.gaps:
            cv2.circle(self.still, self.pixel(gap.x, gap.y), 5, _REFLECTOR, -1, cv2.LINE_AA)

    def pixel(self, x: float, y: float) -> tuple[int, int]:
        """Return the pixel of a point of the floor (m)."""
        return round((x - float(self._low[0])) * self.scale), round((self._top - y) * self.scale)

    def draw_rover(self, image: Picture, x: float, y: float, heading: float) -> None:
        """Return the rover's outline at a pose."""
        c, s = np.cos(heading), np.sin(heading)
        outline = [self.pixel(x + c * u - s * w, y + s * u + c * w) for u, w in _OUTLINE.tolist()]
        cv2.fillPoly(image, [np.array(outline, np.int32)], _ROVER, cv2.LINE_AA)


def images(
    score: Mapping[str, Any], nominal: Mapping[str, Any], fps: float, speedup: float
) -> Iterator[Picture]:
    """Yield the film's images (rows, columns, 3), blue, green, red; the run is shown `speedup`
    times as fast as it was.

    `nominal`: the rover's file, for the camera's view in the corner.
    """
    rows = np.array(score["path"], float).reshape(-1, 4)
    if len(rows) < 2:
        raise FilmError("the score holds no path: the run has not begun")
    view = FilmView(Track.read(score["track"]))
    camera, rng = _camera(nominal["camera"]), np.random.default_rng(int(score["seed"]))
    trail = view.still
    before = view.pixel(*rows[0, 1:3])
    for now in np.arange(rows[0, 0], rows[-1, 0], speedup / fps).tolist():
        x, y, heading = (float(np.interp(now, rows[:, 0], rows[:, column])) for column in (1, 2, 3))
        at = view.pixel(x, y)
        cv2.line(trail, before, at, _PATH, 2, cv2.LINE_AA)
        before = at
        image = np.full(
            (max(trail.shape[0], _EYE[1] + 40), trail.shape[1] + _EYE[0] + 16, 3), _PANEL, np.uint8
        )
        image[: trail.shape[0], : trail.shape[1]] = trail
        view.draw_rover(image, x, y, heading)
        seen = camera.take(view.floor, Motion(x, y, heading, 0.0, 0.0), rng)
        _inset(image, seen, f"{now:5.1f} s")
        yield image


def _inset(image: Picture, seen: Picture, text: str) -> None:
    """Draw the camera's view and the time, right of the plan."""
    left = image.shape[1] - _EYE[0] - 8
    image[8 : 8 + _EYE[1], left : left + _EYE[0]] = seen[..., None]
    cv2.putText(
        image, text, (left, _EYE[1] + 28), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA
    )


def _camera(nominal: Mapping[str, Any]) -> RoverCamera:
    u, v = nominal["principal_px"]
    mount = Mount(
        nominal["forward"],
        nominal["height"],
        nominal["pitch"],
        0.0,
        0.0,
        nominal["focal_px"],
        (u, v),
        *_EYE,
    )
    return RoverCamera(
        mount, nominal["exposure"], (nominal["black"], nominal["white"]), nominal["noise"], 0.0
    )


def film(
    score: Mapping[str, Any],
    nominal: Mapping[str, Any],
    path: Path,
    fps: float = 20.0,
    speedup: float = 4.0,
) -> int:
    """Write the film in the format of the suffix (.webm, .mp4, .avi, .gif, .webp); return the
    number of images.

    Raises FilmError for another suffix, a run without a path, or a file that cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix in _ANIMATED:
        return _write_animation(list(images(score, nominal, fps, speedup)), path, fps)
    if suffix not in _FOURCC:
        raise FilmError(
            f"{path}: unknown film format {suffix!r}; the formats are "
            f"{', '.join((*_FOURCC, *_ANIMATED))}"
        )
    writer: cv2.VideoWriter | None = None
    count = 0
    for image in images(score, nominal, fps, speedup):
        if writer is None:
            size = image.shape[1], image.shape[0]
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*_FOURCC[suffix]), fps, size)
            if not writer.isOpened():
                raise FilmError(
                    f"{path}: this OpenCV writes no {suffix} there; try .gif, or another folder"
                )
        writer.write(image)
        count += 1
    if writer is not None:
        writer.release()
    return count


def _write_animation(pictures: Sequence[Picture], path: Path, fps: float) -> int:
    animation = cv2.Animation()
    animation.frames = list(pictures)
    animation.durations = [round(1000.0 / fps)] * len(pictures)
    if not cv2.imwriteanimation(str(path), animation):
        raise FilmError(f"{path}: cannot be written; give an existing folder")
    return len(pictures)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    commands = argparse.ArgumentParser(
        prog="python -m petrobot.sim.track.film",
        description="Draws the floor plan and the film of a run on the track from its result file.",
        epilog="example:\n  python -m petrobot.sim.track.film run.json --plan run.svg --film "
        "run.webm\n\n"
        "exit codes: 0 done, 2 a file that cannot be used",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands.add_argument(
        "result", type=Path, help="what `petrobot run follow_track --json FILE` wrote"
    )
    commands.add_argument("--plan", type=Path, metavar="FILE", help="write the floor plan (SVG)")
    commands.add_argument(
        "--animate",
        type=float,
        default=0.0,
        metavar="S",
        help="animate the plan: the rover drives the whole run in S seconds",
    )
    commands.add_argument(
        "--film", type=Path, metavar="FILE", help="write the film (.webm, .mp4, .avi, .gif, .webp)"
    )
    commands.add_argument(
        "--speedup", type=float, default=4.0, help="how many times as fast as the run was (4)"
    )
    commands.add_argument(
        "--rover", type=Path, default=ROVER_FILE, help="the rover's numbers (the shipped ones)"
    )
    return commands


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw; return the exit code."""
    options = parser().parse_args(arguments)
    try:
        score = json.loads(options.result.read_text(encoding="utf-8"))
        if options.plan:
            options.plan.write_text(floor_plan([score], seconds=options.animate), encoding="utf-8")
        if options.film:
            nominal = tomllib.loads(options.rover.read_text(encoding="utf-8"))
            film(score, nominal, options.film, speedup=options.speedup)
        print(summary(score))
    except KeyError as fault:
        print(
            f"python -m petrobot.sim.track.film: {options.result}: no key {fault}; give a "
            "result of a run on the track",
            file=sys.stderr,
        )
        return 2
    except (OSError, ValueError, TrackError) as fault:
        print(f"python -m petrobot.sim.track.film: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
