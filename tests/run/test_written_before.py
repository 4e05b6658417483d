"""Users' files can still be read: these were written by petrobot at commit 1eefa30.

The files lie in `written_at_1eefa30/`. They were made by the commands of their names: `run` in lock
step with learning (`lockstep`, `lab.estimates`), in real time (`realtime`), of the rover (`rover`),
and of six balls (`killed`: its journal is cut off in the middle, its result is that of the whole
run); `campaign` of 60 trials, and `forecast --out` from it, and a campaign of another seed to
compare them with (`later`). They are never made again.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.run.recording import alike
from tests.sim.conftest import needs_bullet

FILES = Path(__file__).parent / "written_at_1eefa30"


def given(path: Path) -> Any:
    """Return the JSON in a file."""
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["lockstep", "realtime", "rover", "killed"])
def test_a_journal_replays_without_a_difference(
    name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(FILES / "runs" / name)]) == 0
    assert "all as recorded" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("name", "kept"), [pytest.param("killed", 1.0, marks=needs_bullet), ("rover", 0.85)]
)
def test_a_killed_run_resumes_to_the_same_end_as_without_the_kill(
    name: str, kept: float, tmp_path: Path
) -> None:
    """Also if the installation with its shipped files no longer exists, and the journal is cut off
    within a record (`kept`: the share of it that is left)."""
    folder = tmp_path / name
    folder.mkdir()
    journal = (FILES / "runs" / name / "run.journal").read_bytes()
    (folder / "run.journal").write_bytes(journal[: int(kept * len(journal))])
    assert (
        main(["resume", str(folder), "--quiet", "--no-page", "--json", str(tmp_path / "end.json")])
        == 0
    )
    end, whole = given(tmp_path / "end.json"), given(FILES / "runs" / name / "result.json")
    # Another processor computes other last digits.
    differs = [k for k in whole if k not in ("wall_s", "journal") and not alike(whole[k], end[k])]
    assert not differs
    assert main(["replay", str(folder)]) == 0


@needs_bullet
def test_an_estimates_file_is_shown_and_continued(tmp_path: Path) -> None:
    estimates = tmp_path / "lab.estimates"
    shutil.copy(FILES / "lab.estimates", estimates)
    assert main(["learned", "show", str(estimates), "--json", str(tmp_path / "before.json")]) == 0
    more = ["run", "catch_ball", "--mode", "lockstep", "--runs", "1", "--quiet", "--seed", "6"]
    assert main([*more, "--learn", str(estimates)]) == 0
    assert main(["learned", "show", str(estimates), "--json", str(tmp_path / "after.json")]) == 0
    before, after = given(tmp_path / "before.json"), given(tmp_path / "after.json")
    assert _trials(before) == {"locate_ball": 3, "track_ball": 3, "move_to_point": 3}
    assert _trials(after) == {name: count + 1 for name, count in _trials(before).items()}


def _trials(shown: Any) -> dict[str, int]:
    """Return the number of runs behind the estimates, by primitive task with alternatives."""
    tasks = ("locate_ball", "track_ball", "move_to_point")
    return {
        name: sum(a["runs"] for a in shown["primitive_tasks"][name]["actions"]) for name in tasks
    }


def test_a_registered_forecast_is_compared_with_a_campaign_that_ran_later(tmp_path: Path) -> None:
    later = tmp_path / "later"
    shutil.copytree(FILES / "later", later)
    compared = ["forecast", "--compare", str(FILES / "forecast.json"), str(later)]
    assert main([*compared, "--json", str(tmp_path / "compared.json")]) == 0
    rows = given(tmp_path / "compared.json")["rows"]
    assert {row["runs"] for row in rows} == {60} and {row["regime"] for row in rows} == {"A"}


def test_a_campaign_is_compared_with_a_copy_of_itself_in_a_report(tmp_path: Path) -> None:
    same = tmp_path / "same"
    shutil.copytree(FILES / "campaign", same)
    against = ["report", str(FILES / "campaign"), "--against", str(same)]
    numbers = str(tmp_path / "numbers.json")
    assert main([*against, "--out", str(tmp_path / "page.html"), "--json", numbers]) == 0
    assert given(tmp_path / "numbers.json")["pairs"] == 60
