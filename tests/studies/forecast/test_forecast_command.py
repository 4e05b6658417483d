"""The command as a user calls it, on campaigns written by the tests: doubts, what-ifs, and files
that do not belong together."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest, write_manifest
from petrobot.coordinator.studies.campaign.rows import TrialRow
from petrobot.coordinator.studies.campaign.table import CampaignTable
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.forecast.choices import misfit
from petrobot.coordinator.studies.forecast.history import Training
from petrobot.coordinator.studies.forecast.residual import routing
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads
from tests.studies.forecast.conftest import TASK, Make
from tests.studies.forecast.test_preempting import ONE_WAY

Write = Callable[..., Path]
QUICK = ["--runs", "60", "--replicates", "20"]
BOTH = ("first_a", "first_b")


@pytest.fixture
def write_campaign(tmp_path: Path) -> Write:
    """Return a function that writes a campaign's folder with given trials of a task file."""

    def write(name: str, text: str, trials: list[Trial], seed: int = 1, **more: Any) -> Path:
        task = loads(text, "task.toml")
        path = tmp_path / f"{task.name}.toml"
        path.write_text(text, encoding="utf-8")
        folder = tmp_path / name
        folder.mkdir()
        plan = CampaignPlan(
            str(path),
            "nowhere.toml",
            len(trials),
            ("",),
            seed,
            digests={"task": digest(path)},
            **more,
        )
        write_manifest(folder, plan)
        CampaignTable(folder, task).append(
            [TrialRow(i, "", i, 1, i, 1.0, trial) for i, trial in enumerate(trials, 1)]
        )
        return folder

    return write


def dependent(random: np.random.Generator) -> Trial:
    """Draw trials in which watching always ends a little before locating, which two independent
    runs would not do and no context explains."""
    locate = float(random.uniform(0.5, 1.5))
    runs = [
        RunEntry(
            "watch",
            "watch_a",
            0.0,
            locate - 0.1,
            "success",
            taken="found_late",
            seconds=locate - 0.1,
        ),
        RunEntry("locate", "locate_a", 0.0, locate, "success", taken="found_late", seconds=locate),
    ]
    return Trial(1, 0.0, round(locate, 6), True, 0, runs=runs, fired={"next": 1, "found_late": 1})


def test_a_doubtful_forecast_is_reported_and_not_registered(
    write_campaign: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 1 and no file; with --doubtful it is registered, and the comparison mentions it."""
    random = np.random.default_rng(1)
    train = write_campaign("train", ONE_WAY, [dependent(random) for _ in range(300)])
    out = tmp_path / "f.json"
    told = [
        "forecast",
        str(tmp_path / "scan.toml"),
        "--estimates",
        str(train),
        *QUICK,
        "--out",
        str(out),
    ]
    assert main(told) == 1
    shown = capsys.readouterr()
    assert (
        "DOUBTFUL: simulated trials with the training's own choices differ from the measured "
        "ones: goal" in shown.out
    )
    assert "DOUBTFUL" in shown.err and "--doubtful" in shown.err
    assert "registered" not in shown.out
    assert not out.exists()
    assert main([*told, "--doubtful"]) == 0
    assert json.loads(out.read_text(encoding="utf-8"))["regimes"][""]["doubts"]
    new = write_campaign("new", ONE_WAY, [dependent(random) for _ in range(300)], 2)
    capsys.readouterr()
    assert main(["forecast", "--compare", str(out), str(new)]) == 1
    assert "registered although doubtful" in capsys.readouterr().out


def test_a_what_if_is_compared_with_runs_that_choose_so(
    write_campaign: Write, make_trials: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Others are refused with the matching choices; matching runs agree, also in the shares of
    outgoing transitions."""
    train = write_campaign("train", TASK, make_trials(900, np.random.default_rng(1), actions=BOTH))
    out = tmp_path / "f.json"
    told = ["forecast", str(tmp_path / "pair.toml"), "--estimates", str(train), *QUICK]
    assert main([*told, "--choose", "first=first_b", "--out", str(out)]) == 0
    mixed = write_campaign(
        "mixed", TASK, make_trials(300, np.random.default_rng(2), actions=BOTH), 2
    )
    capsys.readouterr()
    assert main(["forecast", "--compare", str(out), str(mixed)]) == 2
    said = capsys.readouterr().err
    assert "it forecasts first=first_b; the campaign chooses first: first_" in said
    assert "--choose first=first_b" in said
    alone = write_campaign(
        "alone", TASK, make_trials(300, np.random.default_rng(3), actions=("first_b",)), 3
    )
    assert main(["forecast", "--compare", str(out), str(alone)]) == 0
    plain = tmp_path / "plain.json"
    assert main([*told, "--out", str(plain)]) == 0
    assert main(["forecast", "--compare", str(plain), str(mixed)]) == 0
    assert main(["forecast", "--compare", str(plain), str(alone)]) == 2
    assert "the campaign chooses first=first_b" in capsys.readouterr().err


def test_shares_of_outgoing_transitions_are_those_of_the_chosen_actions(
    pair: Task, make_trials: Make
) -> None:
    """Trials with another action say nothing about the what-if."""
    trials = make_trials(400, np.random.default_rng(5), actions=BOTH)
    training = Training.of(pair, trials)
    for action in BOTH:
        own = Training.of(pair, [t for t in trials if t.runs[0].action == action])
        choices = {"first": {action: 1.0}, "second": {"second_a": 1.0}}
        assert routing(training, choices) == routing(own)
    assert routing(training, {"first": dict.fromkeys(BOTH, 0.5)}) == routing(training)


@pytest.mark.parametrize(
    ("choices", "more", "run", "fits"),
    [
        ({"a": 0.5, "b": 0.5}, {}, {"a": 480, "b": 520}, True),
        ({"a": 0.5, "b": 0.5}, {}, {"a": 1000}, False),
        ({"a": 0.5, "b": 0.5}, {}, {"a": 900, "b": 100}, False),
        ({"a": 1.0}, {"asked": ["t"]}, {"a": 5}, True),
        ({"a": 1.0}, {"asked": ["t"]}, {"a": 500, "b": 1}, False),
        ({"a": 1.0}, {"asked": [], "choice_runs": {"t": 2}}, {"a": 6, "b": 4}, True),
        ({"a": 1.0}, {"asked": [], "choice_runs": {"t": 300}}, {"a": 6, "b": 4}, False),
        ({"a": 1.0}, {}, {"a": 6, "b": 4}, False),
        ({"a": 1.0, "b": 0.0}, {"asked": ["t"]}, {"a": 6}, True),
    ],
)
def test_campaigns_that_do_not_match_a_forecast(
    choices: dict[str, float], more: dict[str, Any], run: dict[str, int], fits: bool
) -> None:
    """With 400 training trials, a mix of actions is rejected by its shares, and a single action
    because the others are missing, unless they were hardly ever run."""
    said = {"choices": {"t": choices}, "training_trials": 400, **more}
    assert misfit(said, {"t": run, "of another forecast": {"x": 5}}) == ([] if fits else ["t"])


@pytest.mark.parametrize(
    ("change", "more", "said"),
    [
        (None, [], "the campaign ran pair, not scan; give --estimates of scan"),
        (('"first_a", ', ""), [], "first of pair has no action first_a (first_b)"),
        (("second", "third"), [], "pair has no action place second"),
        (("", ""), ["--choose", "first=first_c"], "--choose: first=first_c is not known to pair"),
    ],
    ids=["another task", "another action", "another place", "unknown choice"],
)
def test_bad_input(
    change: tuple[str, str] | None,
    more: list[str],
    said: str,
    write_campaign: Write,
    make_trials: Make,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Exit code 2, and one line that names file, key and remedy."""
    train = write_campaign("train", TASK, make_trials(60, np.random.default_rng(1), actions=BOTH))
    path = tmp_path / "given.toml"
    path.write_text(ONE_WAY if change is None else TASK.replace(*change), encoding="utf-8")
    assert main(["forecast", str(path), "--estimates", str(train), *QUICK, *more]) == 2
    shown = capsys.readouterr().err
    assert said in shown
    assert shown.count("\n") == 1


def test_estimates_of_another_task_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """This includes a file of estimates."""
    from petrobot.coordinator.studies.campaign.observed import estimates_of, write_estimates

    random = np.random.default_rng(1)
    task = loads(ONE_WAY, "scan.toml")
    rows = [TrialRow(i, "", i, 1, i, 1.0, dependent(random)) for i in range(20)]
    path = write_estimates(tmp_path, estimates_of(task, rows, "t"), {}, "t")
    own = tmp_path / "pair.toml"
    own.write_text(TASK, encoding="utf-8")
    assert main(["forecast", str(own), "--estimates", str(path), *QUICK]) == 2
    assert "it holds estimates of locate, watch; pair has first, second" in capsys.readouterr().err
    own.write_text(ONE_WAY, encoding="utf-8")
    assert main(["forecast", str(own), "--estimates", str(path), *QUICK]) == 0
    assert "no trials to compare with" in capsys.readouterr().out
