"""A film of a recorded run: its images, what is refused, and a token on its way."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.drawing import Overlay, draw
from petrobot.coordinator.task.file import load
from petrobot.services.comm.location_file import load as load_directory
from petrobot.sim.catching.laboratory import make_laboratory

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a recorded run of the catching task, as far as its first simulated seconds."""
    folder = tmp_path_factory.mktemp("film") / "runs"
    given = ["--mode", "lockstep", "--runs", "1", "--quiet", "--journal", str(folder)]
    assert main(["run", "catch_ball", *given]) == 0
    return next(folder.iterdir())


def test_the_film_shows_laboratory_and_net(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two seconds at four images a second; ball and tokens move from one to the other."""
    film = tmp_path / "film.png"
    options = ["--begin", "0.8", "--seconds", "1", "--fps", "4", "--width", "300"]
    assert main(["film", str(run), "--out", str(film), *options]) == 0
    assert "4 images" in capsys.readouterr().out
    read, animation = cv2.imreadanimation(str(film))
    assert read
    images = [np.asarray(image, np.int64)[..., :3] for image in animation.frames]
    assert len(images) == 4 and {image.shape for image in images} == {images[0].shape}
    half = round(300 * 461 / 928)  # the laboratory is above, the net below
    for before, after in pairwise(images):
        assert np.abs(after[:half] - before[:half]).max() > 50
    assert np.abs(images[1][half:] - images[0][half:]).max() > 50


def test_a_net_without_positions_is_laid_out_alike_for_each_marking(tmp_path: Path) -> None:
    """Images of several sizes are no film. Here no marked place is left at the end."""
    file = tmp_path / "lift.toml"
    file.write_text(
        'schema = 1\n[task]\nname = "lift"\nfinal = "jobs == 0"\nfinal_error = "bad > 0"\n'
        '[errors]\nto = "bad"\n[primitive_tasks]\nmove = { deadline = 5.0 }\n[places]\n'
        'jobs = { kind = "control", tokens = 2 }\nbad = {}\n'
        'up = { kind = "action", task = "move" }\ndown = { kind = "action", task = "move" }\n'
        '[transitions]\nstart = { in = ["jobs", "!up", "!down", "!bad"], out = ["up"] }\n'
        'top = { in = ["up:normal"], out = ["down"] }\nend = { in = ["down:normal"] }\n',
        encoding="utf-8",
    )
    task = load(file)
    markings = [tuple(int(p == k) for p in range(len(task.net.places))) for k in range(4)]
    drawn = [draw(task, marking=marking) for marking in [*markings, (0,) * len(task.net.places)]]
    assert len({re.findall(r'viewBox="([^"]+)"', svg)[0] for svg in drawn}) == 1


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--out", "film.mov"], "expected a name that ends in .webp, .gif, .png"),
        (["--out", "film.gif", "--begin", "99"], "the run has no image in that time"),
        (["--out", "nowhere/film.gif", "--seconds", "0.1"], "give an existing folder"),
    ],
)
def test_what_cannot_be_filmed_is_refused(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    told: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["film", str(run), "--fps", "2", "--width", "64", *options]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("mode", "seed", "told"),
    [
        ("realtime", 1, "is a run in real time, which cannot be repeated"),
        ("lockstep", 2, "record it again with this version"),
    ],
)
def test_a_run_that_does_not_repeat_itself_is_refused(
    run: Path, tmp_path: Path, mode: str, seed: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The journal is that of the run, with another mode or seed in its header."""
    from petrobot.coordinator.run.folder import JOURNAL
    from petrobot.coordinator.run.journal import JournalWriter, read_journal

    known = read_journal(run / JOURNAL)
    journal = JournalWriter(tmp_path / JOURNAL, {**known.header, "mode": mode, "seed": seed})
    for record in known.records:
        journal.append(record.kind, record.data)
    journal.close()
    given = ["--out", str(tmp_path / "film.gif"), "--fps", "1", "--width", "64"]
    assert main(["film", str(tmp_path), *given]) == 2
    assert told in capsys.readouterr().err


def test_a_token_on_its_way_is_on_its_arc() -> None:
    """At the beginning of an arc it is at one end, at the end at the other."""
    task = load(ROOT / "coordinator" / "tasks" / "catch_ball.toml")
    arc = ("locate_ball", "located")
    circle = re.compile(r'<circle class="token" cx="([\d.]+)" cy="([\d.]+)" r="5.5"/>')
    found = [circle.search(draw(task, overlay=Overlay(moving={arc: s}))) for s in (0.0, 0.5, 1.0)]
    spots = [tuple(map(float, match.groups())) for match in found if match]
    assert len(spots) == 3 and spots[0] < spots[1] < spots[2]
    assert circle.search(draw(task, overlay=Overlay(moving={("located", "runs"): 0.5}))) is None


def test_the_laboratory_is_seen_from_beside() -> None:
    """Arm, cup and table, and no ball before the first release."""
    directory = load_directory(ROOT / "services.toml")
    laboratory = make_laboratory(directory, "laboratory")
    try:
        assert "#e8590c" not in laboratory.side_view()  # the colour of balls
        assert json.dumps(laboratory.side_view()).count("<polygon") == 4
    finally:
        laboratory.close()
