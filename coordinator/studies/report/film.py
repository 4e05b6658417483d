"""A film of a recorded lock-step run: what the simulated laboratory shows, above the net whose
tokens move.

A run in lock step is the same whenever it is simulated, so nothing is recorded for the film: the
run is simulated again, and its firings are compared with the recorded ones. A laboratory takes part
by a method `side_view()` of its party, which returns the world as it is now as SVG; without one the
film shows the net alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.drawing import Overlay, draw
from petrobot.coordinator.engine import Fired
from petrobot.coordinator.launch import lockstep_mission, lockstep_party
from petrobot.coordinator.operator.start_from import Departure, Recorded, departing
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.run.timeline import Firing, Timeline
from petrobot.coordinator.studies.report.raster import png
from petrobot.coordinator.task import End, Task
from petrobot.services.comm.lockstep.cell import Delays, LockStepCell
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.host.toml_text import InputError

Picture = NDArray[np.uint8]
FORMATS = (".webp", ".gif", ".png")
FLIGHT = 0.4
"""Duration of a token's way to a transition and on to the next place (s)."""
SAME = 1e-3
"""Greatest difference of the times of two firings (s): a journal rounds them."""


class NoFilmError(InputError, ValueError):
    """The film cannot be made; the text says why and what to do."""


def images(
    found: Recorded, *, begin: float, seconds: float, fps: float, width: int
) -> Iterator[Picture]:
    """Simulate a recorded run again and yield its images (rows, columns, 3; blue, green, red) from
    `begin` on (s). Raises NoFilmError, also for a run that does not repeat itself."""
    header, task = found.journal.header, found.task
    if header["mode"] != "lockstep":
        problem = f"{header['mission']} is a run in real time, which cannot be repeated"
        raise NoFilmError(f"{problem}; record one with --mode lockstep --journal FOLDER")
    setting = departing(found.journal, task, found.engine, Departure(header["mission"], 0))
    mission, timeline = lockstep_mission(found.directory, setting), Timeline()
    mission.executor.observers.append(timeline)
    leader = CoordinatorParty(found.directory, mission)
    parties = [lockstep_party(found.directory, node) for node in found.directory.nodes.values()]
    cell = LockStepCell([leader, *parties], Delays(found.directory.delays()))
    views = [view for p in parties if (view := getattr(p, "side_view", None)) is not None]
    every = max(1, round(1.0 / (fps * TICK)))
    drawn: list[tuple[float, tuple[int, ...], list[str]]] = []
    while not leader.over and cell.now < begin + seconds:
        if cell.tick % every == 0 and cell.now >= begin:
            drawn.append((cell.now, mission.executor.state.marking, [v() for v in views]))
        cell.step()
    origin = timeline.origin or 0.0
    _refuse_other(found, timeline.firings, origin)
    for now, marking, worlds in drawn:
        net = _net(task, marking, now - origin, timeline.firings)
        yield np.vstack([_image(svg, width) for svg in (*worlds, net)])


def _refuse_other(found: Recorded, firings: Sequence[Firing], origin: float) -> None:
    """Raise NoFilmError if the simulated run fires otherwise than the recorded one."""
    recorded = (
        (step.time - origin, one.transition)
        for step in found.steps()
        for one in step.instructions
        if isinstance(one, Fired)
    )
    for one, then in zip_longest(firings, recorded):
        if one is None:
            return  # the film ends before the run
        if then is None or then[1] != one.transition or abs(then[0] - one.time) > SAME:
            was = f"fired {then[1]} at {then[0]:.3f} s" if then else "had ended"
            raise NoFilmError(
                f"{found.journal.header['mission']}: simulated again it fires {one.transition} at "
                f"{one.time:.3f} s, where the recorded run {was}; record it again with this "
                "version of petrobot and this physics"
            )


def _net(task: Task, marking: tuple[int, ...], now: float, firings: Sequence[Firing]) -> str:
    """Return the net at a time: tokens of the last firings are on their way."""
    shown, moving = list(marking), dict[tuple[str, str], float]()
    for firing in firings:
        way = (now - firing.time) / FLIGHT
        if not 0.0 <= way < 1.0:
            continue
        transition = task.flat.transitions[firing.transition]
        if way < 0.5:
            taken = [a.place for a in transition.inputs if a.end is not End.GOING]
            moving |= {(place, firing.transition): 2.0 * way for place in taken}
        else:
            moving |= {(firing.transition, o.place): 2.0 * way - 1.0 for o in transition.outputs}
        for output in transition.outputs:
            at = task.net.place_index[output.place]
            shown[at] = max(0, shown[at] - output.weight)
    return draw(task, marking=tuple(shown), overlay=Overlay(moving=moving, legend=f"{now:.1f} s"))


def _image(svg: str, width: int) -> Picture:
    """Return an SVG as an image of this width (px)."""
    first = np.frombuffer(png(svg, 1.0), np.uint8)
    whole = cv2.imdecode(first, cv2.IMREAD_COLOR)
    assert whole is not None
    height = round(whole.shape[0] * width / whole.shape[1])
    size = (width, height)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)


def refuse_file(path: Path) -> None:
    """Raise NoFilmError for a film that could not be written."""
    if path.suffix.lower() not in FORMATS:
        raise NoFilmError(f"{path}: expected a name that ends in {', '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise NoFilmError(f"{path}: give an existing folder")
    if not hasattr(cv2, "imwriteanimation"):
        raise NoFilmError(f"OpenCV {cv2.__version__} writes no animations; install 4.11 or later")


def write(path: Path, pictures: Sequence[Picture], fps: float, quality: int) -> None:
    """Write an animated picture that repeats for ever, in the format of the suffix. Raises
    NoFilmError."""
    if not pictures:
        raise NoFilmError("the run has no image in that time; give another --begin")
    film = cv2.Animation()
    film.frames = list(pictures)
    film.durations = [round(1000.0 / fps)] * len(pictures)
    if not cv2.imwriteanimation(str(path), film, [cv2.IMWRITE_WEBP_QUALITY, quality]):
        raise NoFilmError(f"{path}: cannot be written; give another file")
