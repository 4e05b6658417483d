"""Floor plan and film of a run, from its score alone."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from petrobot.sim.track.course import Track
from petrobot.sim.track.film import FilmError, FilmView, film, images, main
from petrobot.sim.track.plan import floor_plan, pictures, summary

ROVER_FILE = Path(__file__).parents[3] / "services" / "mobile" / "rover.toml"
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def nominal() -> dict[str, Any]:
    return tomllib.loads(ROVER_FILE.read_text(encoding="utf-8"))


@pytest.fixture
def score(rover_bench: Callable[..., Any]) -> dict[str, Any]:
    """A drive over the first interruption, with a turn off the track at its end."""
    bench = rover_bench(seed=5, regime="mixed")
    bench.enable()
    bench.follow(0.8, end=bench.lab.track.gaps[0].end + 1.0)
    bench.drive(0.4, 0.8)
    bench.wait(3.0)
    found: dict[str, Any] = bench.lab.referee.score(bench.now)
    assert [each["kind"] for each in found["penalties"]] == ["track_left"]
    return found


def test_the_plan_shows_track_reflectors_path_and_penalties(score: dict[str, Any]) -> None:
    root = ElementTree.fromstring(floor_plan([score]))
    track = Track.read(score["track"])
    drawn = [element.get("d", "") for element in root.iter(f"{SVG}path")]
    assert sum(1 for element in root.iter(f"{SVG}rect")) >= len(track.elements)
    arcs = sum(1 for element in track.elements if element.painted and element.kind != "S")
    assert sum("A1 1" in path for path in drawn) == arcs
    reflectors = [g for g in root.iter(f"{SVG}circle") if g.get("fill") == "#ffd43b"]
    assert [(float(c.get("cx", 0)), float(c.get("cy", 0))) for c in reflectors] == [
        pytest.approx((gap.x, gap.y), abs=0.01) for gap in track.gaps
    ]
    way = max(drawn, key=len)
    points = np.array([[float(v) for v in pair.split()] for pair in re.split("[ML]", way)[1:]])
    assert np.abs(points - np.array(score["path"])[:, 1:3]).max() < 1e-3
    assert "track_left" in "".join(element.text or "" for element in root.iter(f"{SVG}title"))
    assert summary(score) in "".join(element.text or "" for element in root.iter(f"{SVG}text"))


def test_two_runs_are_distinguished_and_names_are_escaped(score: dict[str, Any]) -> None:
    root = ElementTree.fromstring(floor_plan([score, score], ["homing & more", "<search>"]))
    texts = [element.text or "" for element in root.iter(f"{SVG}text")]
    assert [text.partition(":")[0] for text in texts] == ["homing & more", "<search>"]
    strokes = {
        element.get("stroke")
        for element in root.iter(f"{SVG}path")
        if len(element.get("d", "")) > 300
    }
    assert len(strokes) == 2


def test_an_animated_plan_goes_past_every_row_of_the_path(score: dict[str, Any]) -> None:
    assert "animateTransform" not in floor_plan([score])
    root = ElementTree.fromstring(floor_plan([score], seconds=10.0))
    moves = list(root.iter(f"{SVG}animateTransform"))
    assert {move.get("type") for move in moves} == {"translate", "rotate"}
    for move in moves:
        times = [float(t) for t in (move.get("keyTimes") or "").split(";")]
        assert times[0] == 0.0
        assert times[-1] == 1.0
        assert len(times) == len((move.get("values") or "").split(";")) == len(score["path"])


def test_the_report_gets_a_plan_and_a_film(score: dict[str, Any]) -> None:
    made = pictures({"task": "follow_track", **score})
    assert [("animateTransform" in svg) for svg in made.values()] == [False, True]
    assert all(ElementTree.fromstring(svg).tag == f"{SVG}svg" for svg in made.values())
    assert pictures({"task": "follow_track", "status": "ERROR"}) == {}


def test_a_plan_needs_a_run() -> None:
    with pytest.raises(ValueError, match="one score"):
        floor_plan([])


def test_the_films_images_show_the_rover_where_it_was(
    score: dict[str, Any], nominal: dict[str, Any]
) -> None:
    view = FilmView(Track.read(score["track"]))
    shown = list(images(score, nominal, fps=5.0, speedup=5.0))
    path = np.array(score["path"])
    assert len(shown) == pytest.approx(path[-1, 0], abs=1.0)
    for number in (2, len(shown) // 2, len(shown) - 2):
        x, y, _ = (float(np.interp(path[0, 0] + number, path[:, 0], path[:, k])) for k in (1, 2, 3))
        u, v = view.pixel(x, y)
        assert shown[number][v, u].tolist() == [230, 120, 30]
        assert view.still.shape[0] <= shown[number].shape[0]
    assert all(image.shape[0] % 2 == 0 and image.shape[1] % 2 == 0 for image in shown)


@pytest.mark.parametrize("suffix", [".avi", ".gif"])
def test_a_film_is_written(
    score: dict[str, Any], nominal: dict[str, Any], tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"run{suffix}"
    count = film(score, nominal, path, fps=10.0, speedup=20.0)
    if suffix == ".gif":
        _, animation = cv2.imreadanimation(str(path))
        assert len(animation.frames) == count
        return
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == count > 3
    video.release()


def test_the_reason_why_a_run_cannot_be_filmed_is_reported(
    score: dict[str, Any], nominal: dict[str, Any], tmp_path: Path
) -> None:
    with pytest.raises(FilmError, match=r"'\.mov'"):
        film(score, nominal, tmp_path / "run.mov")
    with pytest.raises(FilmError, match="no path"):
        film({**score, "path": []}, nominal, tmp_path / "run.gif")


def test_the_command_line(
    score: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result, plan = tmp_path / "run.json", tmp_path / "run.svg"
    result.write_text(json.dumps({"task": "follow_track", **score}))
    assert main([str(result), "--plan", str(plan), "--animate", "8"]) == 0
    assert summary(score) in capsys.readouterr().out
    assert ElementTree.fromstring(plan.read_text()).tag == f"{SVG}svg"
    result.write_text("{}")
    assert main([str(result), "--plan", str(plan)]) == 2
    assert "no key 'track'" in capsys.readouterr().err
    assert main([str(tmp_path / "none.json"), "--plan", str(plan)]) == 2
