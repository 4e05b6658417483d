"""The command as a user calls it, on campaigns written by the tests: doubts, what-ifs, and files
that do not belong together."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from petrobot.coordinator.analysis.time.completion import Completion, Slope, reliability_slopes
from petrobot.coordinator.cli import main
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest, write_manifest
from petrobot.coordinator.studies.campaign.table import CampaignTable, TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.forecast import registered
from petrobot.coordinator.studies.forecast.choices import misfit
from petrobot.coordinator.studies.forecast.history import Training
from petrobot.coordinator.studies.forecast.residual import routing
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads
from tests.studies.forecast.conftest import TASK, Make, with_transitions
from tests.studies.forecast.test_preempting import ONE_WAY

Write = Callable[..., Path]
QUICK = ["--runs", "60", "--replicates", "20"]
BOTH = ("first_a", "first_b")


@pytest.fixture
def write_campaign(tmp_path: Path) -> Write:
    """Return a function that writes a campaign's folder with given trials of a task file. One that
    begins at 0 is the first of a mission run."""

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
            [
                TrialRow(i, "", i, i if trial.begun else 1, i, 1.0, trial)
                for i, trial in enumerate(trials, 1)
            ]
        )
        return folder

    return write


def slower(k: int, random: np.random.Generator) -> Trial:
    """Watching ends a little before locating, and each trial takes longer than those before."""
    locate = float(random.uniform(0.5, 1.5)) + 0.01 * k
    runs = [
        RunEntry("watch", "watch_a", 0.0, locate - 0.1, "success", taken="found_late"),
        RunEntry("locate", "locate_a", 0.0, locate, "success", taken="found_late"),
    ]
    return Trial(1, 0.0, round(locate, 6), True, 0, runs=runs, fired={"next": 1, "found_late": 1})


def test_a_doubtful_forecast_is_reported_and_not_registered(
    write_campaign: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trials that change with their order: exit code 1 and no file. With --doubtful it is
    registered, and the comparison mentions it. A stochastic view that contradicts the trials is no
    doubt about their figures, so it is left out."""
    random = np.random.default_rng(1)
    train = write_campaign("train", ONE_WAY, [slower(k, random) for k in range(300)])
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
    doubts = [line for line in shown.out.splitlines() if "DOUBTFUL" in line]
    # the runs are dependent, which the stochastic view does not know
    assert "stochastic view: left out: R_goal is 0 by the trials" in shown.out
    assert any("the training's time changes with the order of the trials" in d for d in doubts)
    assert len(max(doubts, key=len)) <= 100
    assert "DOUBTFUL" in shown.err and "--doubtful" in shown.err
    assert "registered" not in shown.out
    assert not out.exists()
    assert main([*told, "--doubtful"]) == 0
    told_of = json.loads(out.read_text(encoding="utf-8"))["regimes"][""]
    assert len(told_of["doubts"]) == len(doubts)
    assert [*told_of["gspn"]] == ["why"]
    new = write_campaign("new", ONE_WAY, [slower(k, random) for k in range(300, 600)], 2)
    capsys.readouterr()
    assert main(["forecast", "--compare", str(out), str(new)]) == 1
    shown = capsys.readouterr()
    assert "registered although doubtful" in shown.out
    assert "\nagrees" not in shown.out and "DISAGREES: at least one" in shown.out


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


def test_another_duration_is_registered_and_compared(
    write_campaign: Write, make_trials: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The comparison says what was changed, and that the runs are not like that; a wrong change is
    one message."""
    train = write_campaign("train", TASK, make_trials(300, np.random.default_rng(1)))
    out = tmp_path / "f.json"
    told = ["forecast", str(tmp_path / "pair.toml"), "--estimates", str(train), *QUICK]
    slow = ["--what-if", "first.mean*=3", "--doubtful", "--out", str(out)]
    assert main([*told, *slow]) == 0
    assert "no trial tests the changes: first.mean*=3" in " ".join(capsys.readouterr().out.split())
    assert registered.read(out)["regimes"][""]["what_if"] == ["first.mean*=3"]
    same = write_campaign("same", TASK, make_trials(300, np.random.default_rng(2)), 2)
    assert main(["forecast", "--compare", str(out), str(same)]) == 1
    assert "note: what if, regime -: first.mean*=3" in capsys.readouterr().out
    for change, words in (
        ("first.mean", "not of the form"),
        ("first.error.cv=2", "durations as measured"),
    ):
        assert main([*told, "--what-if", change]) == 2
        assert words in capsys.readouterr().err


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
        (("", ""), ["--choose", "first=first_c"], "--choose: first=first_c is not known to pair"),
    ],
    ids=["another task", "unknown choice"],
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


def test_a_task_that_was_changed_is_forecast_by_the_simulated_net(
    write_campaign: Write, make_trials: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The trials are of another form: they tell of its runs, but no figure comes straight from
    them. A file that differs in words, guesses, the order of arcs, the wording of a condition or
    the number of runs is the same task."""
    train = write_campaign("train", TASK, make_trials(200, np.random.default_rng(1), actions=BOTH))
    forms = {
        "words": "# another comment\n" + TASK.replace("tokens = 4", "tokens = 7"),
        "texts": TASK.replace('goal = "done"', 'goal = "it is there"\nspecification = "seen"')
        .replace("mean_wait = 1.0", 'mean_wait = 2.0\ntext = "a lamp"')
        .replace('name = "pair"', 'name = "pair"\ngoal = "all jobs done"'),
        "same end": TASK.replace(
            '"jobs == 0 and free == 1"', '"not (free  != 1 or jobs > 0) and true"'
        ),
        "order of arcs": TASK.replace('["jobs", "free"]', '["free", "jobs"]'),
        "in short": TASK.replace('task = "first"', 'task = "first"\nholds = ["free"]')
        .replace('in = ["jobs", "free"]', 'in = ["jobs"]')
        .replace('task = "second"', 'task = "second"\nholds = ["free"]')
        .replace('out = ["free"]', "out = []"),
        "slower": TASK.replace("deadline = 9.0", "deadline = 8.0"),
        "other end": TASK.replace('"jobs == 0 and free == 1"', '"jobs <= 1 and free == 1"'),
        "other goal": TASK.replace('["done"]', '["missed"]'),
        "one action": TASK.replace('"first_a", ', ""),
        "another place": TASK.replace("second", "third"),
    }
    path, out = tmp_path / "given.toml", tmp_path / "forecast.json"
    found = {}
    for name, text in forms.items():
        path.write_text(text, encoding="utf-8")
        main(["forecast", str(path), "--estimates", str(train), *QUICK, "--json", str(out)])
        found[name] = json.loads(out.read_text(encoding="utf-8"))["regimes"][""]
    assert {name: (said["from"], said["same"]) for name, said in found.items()} == {
        "words": ("trials", True),
        "texts": ("trials", True),
        "same end": ("trials", True),
        "order of arcs": ("trials", True),
        "in short": ("trials", True),
        "slower": ("net", False),
        "other end": ("net", False),
        "other goal": ("net", False),
        "one action": ("net", False),
        "another place": ("net", False),
    }
    assert found["one action"]["choices"]["first"] == {"first_b": 1.0}
    (note,) = found["another place"]["notes"]
    assert note == "no training run entered third: forecast with probability 0"
    assert not found["slower"]["doubts"]
    assert {row["of"] for row in found["slower"]["residual"]} >= {"goal", "time"}, "as it was run"
    assert any("another form" in text for text in found["slower"]["assumptions"])
    path.write_text(TASK.replace("first_", "other_").replace("second_a", "other_c"), "utf-8")
    assert main(["forecast", str(path), "--estimates", str(train), *QUICK]) == 2
    assert "no run of an action place and an action of" in capsys.readouterr().err


def test_a_place_that_is_new_in_a_changed_task_is_played_with_runs_of_its_primitive_task(
    write_campaign: Write, tmp_path: Path
) -> None:
    """A second try in a place of its own. 0.6 of the trials get through the first place, so 0.6 of
    the others get through there."""
    trials = [
        Trial(
            1, 0.0, 1.0 + (k % 5 < 3), True, int(k % 5 < 3),
            runs=[
                RunEntry("first", "first_a", 0.0, 1.0, "success" if k % 5 < 3 else "error"),
                RunEntry("second", "second_a", 1.0, 1.0, "success", taken="done", cancelled=True),
            ][: 1 + (k % 5 < 3)],
        )
        for k in range(300)
    ]  # fmt: skip
    train = write_campaign("train", TASK, trials)
    again = with_transitions("""
[places.again]
kind = "action"
task = "first"
over: again:normal -> second
gone: again:error -> free
""")
    path, out = tmp_path / "given.toml", tmp_path / "forecast.json"
    off = 'in = ["first:error"]\nout = '
    assert TASK.count(off + '["free"]') == 1
    path.write_text(TASK.replace(off + '["free"]', off + '["again"]') + again, encoding="utf-8")
    main(["forecast", str(path), "--estimates", str(train), *QUICK, "--json", str(out)])
    said = json.loads(out.read_text(encoding="utf-8"))["regimes"][""]
    assert said["notes"] == [
        "no training run entered again: its runs are taken to be like those of first"
    ]
    assert said["figures"]["R_goal"]["value"] == pytest.approx(0.84, abs=0.02)
    assert said["figures"]["mean"]["value"] == pytest.approx(0.6 * 2 + 0.4 * 2 + 0.24, abs=0.05)


LIMITS = with_transitions("""
schema = 1
[task]
name = "limits"
final = "jobs == 0 and free == 1"
goal_transitions = ["done"]
runs_place = "jobs"
[primitive_tasks.move]
deadline = 9.0
[places]
jobs = { kind = "control", tokens = 4 }
free = { kind = "resource", tokens = 1 }
fetch = { kind = "action", task = "move", timeout = 3.0 }
bring = { kind = "action", task = "move" }
begin: jobs, free -> fetch
on: fetch:normal -> bring
late: fetch:error -> free
done: bring:normal -> free
lost: bring:error -> free
""")
"""Two places of one primitive task that end its runs after 3 and 9 s."""


def _moved(k: int) -> Trial:
    """Return a trial of `LIMITS`; each run takes 1, 2, 3, 4 or 5 s, if nothing ends it."""
    first, second = 1.0 + k % 5, 1.0 + (k // 5) % 5
    runs = [
        RunEntry("fetch", "move", 0.0, first, "success", seconds=first, taken="on"),
        RunEntry("bring", "move", first, second, "success", seconds=second, taken="done"),
    ]
    if first > 3.0:
        runs = [RunEntry("fetch", "move", 0.0, 3.0, "error", "deadline", seconds=3.0, taken="late")]
    return Trial(1, 0.0, sum(r.took for r in runs), True, len(runs) - 1, runs=runs)


@pytest.mark.parametrize(
    ("change", "goals", "exact", "doubtful"),
    [
        (("schema", "schema"), 0.6, 0.6, False),
        (("timeout = 3.0", "timeout = 2.0"), 0.4, 0.4, False),
        (("deadline = 9.0", "deadline = 3.5"), 0.6 * 0.6, 0.6 * 0.6, False),
        (("timeout = 3.0", "timeout = 6.0"), None, None, True),
        (('bring = { kind = "action"', 'other = { kind = "action", timeout = 2.5'),
         0.6 * 0.4, None, False),
        # a run token that is given back ends its trial
        (('in = ["fetch:error"]\nout = ["free"]', 'in = ["fetch:error"]\nout = ["free", "jobs"]'),
         0.6, 0.6, False),
    ],
)  # fmt: skip
def test_a_changed_deadline_ends_the_runs_that_were_measured(
    change: tuple[str, str],
    goals: float | None,
    exact: float | None,
    doubtful: bool,
    write_campaign: Write,
    tmp_path: Path,
) -> None:
    """Also runs that stand for those of a place that no run entered. The exact solution does not
    mix places that end runs after different times. What a shorter deadline cut off is a guess."""
    train = write_campaign("train", LIMITS, [_moved(k) for k in range(500)])
    path, out = tmp_path / "given.toml", tmp_path / "forecast.json"
    changed = LIMITS.replace(*change)
    if "other" in changed:
        changed = changed.replace('"bring', '"other')
    path.write_text(changed, encoding="utf-8")
    main(["forecast", str(path), "--estimates", str(train), *QUICK, "--json", str(out)])
    said = json.loads(out.read_text(encoding="utf-8"))["regimes"][""]
    assert any("lasts longer than any measured one" in d for d in said["doubts"]) is doubtful
    if goals is not None:
        assert said["figures"]["R_goal"]["value"] == pytest.approx(goals, abs=0.02)
    if exact is not None:
        assert said["gspn"]["R_goal"] == pytest.approx(exact, abs=1e-6)


def test_an_estimates_file_does_not_tell_places_with_different_deadlines_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from petrobot.coordinator.studies.campaign.observed import estimates_of, write_estimates

    task, own = loads(LIMITS, "limits.toml"), tmp_path / "limits.toml"
    rows = [TrialRow(i, "", i, 1, i, 1.0, _moved(i)) for i in range(500)]
    path = write_estimates(tmp_path, estimates_of(task, rows, "t"), {}, "t")
    own.write_text(LIMITS, encoding="utf-8")
    assert main(["forecast", str(own), "--estimates", str(path), *QUICK]) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert (
        "DOUBTFUL: fetch and bring end runs of move after different times (3 s, 9 s), and" in shown
    )


def test_estimates_of_another_task_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """This includes a file of estimates."""
    from petrobot.coordinator.studies.campaign.observed import estimates_of, write_estimates

    random = np.random.default_rng(1)
    task = loads(ONE_WAY, "scan.toml")
    rows = [TrialRow(i, "", i, 1, i, 1.0, slower(i, random)) for i in range(20)]
    path = write_estimates(tmp_path, estimates_of(task, rows, "t"), {}, "t")
    own = tmp_path / "pair.toml"
    own.write_text(TASK, encoding="utf-8")
    assert main(["forecast", str(own), "--estimates", str(path), *QUICK]) == 2
    assert "it holds estimates of locate, watch; pair has first, second" in capsys.readouterr().err
    own.write_text(ONE_WAY, encoding="utf-8")
    assert main(["forecast", str(own), "--estimates", str(path), *QUICK]) == 1
    shown = capsys.readouterr().out
    assert "no trials to compare with" in shown
    assert "DOUBTFUL: locate and watch may be active at the same time, and" in shown


# --- places that training never entered -------------------------------------------------------

BRANCH = TASK.replace(
    '[transitions.off]\nin = ["first:error"]\nout = ["free"]',
    '[transitions.off]\nin = ["first:error"]\nout = ["repair"]\n'
    '[transitions.repaired]\nin = ["repair:normal"]\nout = ["free"]\n'
    '[transitions.broken]\nin = ["repair:error"]\nout = ["free"]',
).replace(
    "[events.signal]",
    '[primitive_tasks.repair]\ngoal = "repaired"\nalternatives = ["repair_a", "repair_b"]\n'
    "deadline = 9.0\n[events.signal]",
) + '[places.repair]\nkind = "action"\ntask = "repair"\n'  # fmt: skip


def unbroken(make_trials: Make, n: int) -> list[Trial]:
    """Trials whose first run never ends with ERROR."""
    trials = make_trials(2 * n, np.random.default_rng(5))
    return [t for t in trials if t.runs[0].status != "error"][:n]


def test_a_place_that_training_never_entered_forbids_nothing(
    write_campaign: Write, make_trials: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has probability 0, with a note of what that is worth, also in the stochastic view; a
    what-if about it is refused with the reason."""
    train = write_campaign("train", BRANCH, unbroken(make_trials, 200))
    out = tmp_path / "f.json"
    told = ["forecast", str(tmp_path / "pair.toml"), "--estimates", str(train), *QUICK]
    assert main([*told, "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "no training run entered repair: forecast with probability 0 (below 0.015" in shown
    assert len(max(shown.splitlines()[:-1], key=len)) <= 100  # the last one has the file's path
    made = json.loads(out.read_text(encoding="utf-8"))["regimes"][""]
    assert made["figures"]["P_complete"]["value"] == 1.0
    assert made["gspn"]["P_complete"] == pytest.approx(1.0, abs=1e-12)
    assert made["gspn"]["mean"] > 0
    assert main([*told, "--choose", "repair=repair_b"]) == 2
    assert "repair: no training run entered repair" in capsys.readouterr().err


def test_an_estimates_file_is_counted_in_runs(
    write_campaign: Write, make_trials: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """60 trials of about two runs each are neither 60 trials nor as many trials as runs there."""
    from petrobot.coordinator.studies.campaign.observed import estimates_of, write_estimates

    task = loads(TASK, "pair.toml")
    trials = make_trials(60, np.random.default_rng(1))
    rows = [
        TrialRow(i, "", i, i if trial.begun else 1, i, 1.0, trial) for i, trial in enumerate(trials)
    ]
    path = write_estimates(tmp_path, estimates_of(task, rows, "t"), {}, "t")
    own = tmp_path / "pair.toml"
    own.write_text(TASK, encoding="utf-8")
    assert main(["forecast", str(own), "--estimates", str(path), *QUICK]) == 0
    shown = capsys.readouterr().out
    assert f"from {sum(len(t.runs) for t in trials)} runs of an estimates file" in shown
    assert "by simulating the net" in shown and "trials, by" not in shown
    # such a file names the transitions of preempted runs only: no shares to compare with
    out = tmp_path / "f.json"
    assert main(["forecast", str(own), "--estimates", str(path), *QUICK, "--out", str(out)]) == 0
    new = write_campaign("new", TASK, make_trials(200, np.random.default_rng(2)), 2)
    capsys.readouterr()
    main(["forecast", "--compare", str(out), str(new), "--json", "-"])
    assert json.loads(capsys.readouterr().out)["routing"] == []
    said = json.loads(out.read_text(encoding="utf-8"))["regimes"][""]
    assert 55 <= said["training_trials"] <= 65
    # all completed: that of 60 trials, not of as many as there are runs and waits
    assert 0.93 < said["figures"]["P_complete"]["confidence"][0] < 0.95


def test_services_say_where_the_new_trials_run(
    write_campaign: Write, make_trials: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An action that the location file gives to no node is refused."""
    train = write_campaign("train", TASK, make_trials(100, np.random.default_rng(1)))
    told = ["forecast", str(tmp_path / "pair.toml"), "--estimates", str(train), *QUICK]
    cell = tmp_path / "services.toml"
    for actions, code in ((("first_a", "second_a"), 0), (("second_a",), 2)):
        text = "".join(f'[actions.{a}]\nnode = "arm"\nrun = "json:dumps"\n' for a in actions)
        cell.write_text(
            f'schema = 1\n[nodes.arm]\nhost = "127.0.0.1"\nport = 9101\n{text}', encoding="utf-8"
        )
        assert main([*told, "--services", str(cell)]) == code, capsys.readouterr().err
    assert "first=first_a is chosen in pair, but" in capsys.readouterr().err


def test_a_disagreement_of_the_distribution_is_a_disagreement(
    write_campaign: Write, make_trials: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Equal shares, mean and 90 % quantile, but other times between: the last line does not say
    that the forecast agrees."""
    random = np.random.default_rng(4)

    def timed(times: np.ndarray) -> list[Trial]:
        runs = [RunEntry("first", "first_a", 0.0, 1.0, "success", taken="on")]
        return [Trial(1, 0.0, round(float(t), 6), True, 1, runs=runs) for t in times]

    train = write_campaign("train", TASK, timed(random.uniform(1.0, 3.0, 1000)))
    out = tmp_path / "f.json"
    told = ["forecast", str(tmp_path / "pair.toml"), "--estimates", str(train), *QUICK]
    assert main([*told, "--out", str(out)]) == 0
    # 2.2 +- 0.01 and 1.8 +- 0.01 instead of what lies between 1.6 and 2.4
    times = random.uniform(1.0, 3.0, 1000)
    middle = np.abs(times - 2.0) < 0.4
    times[middle] = np.where(times[middle] < 2.0, 1.6, 2.4)
    new = write_campaign("new", TASK, timed(times), 2)
    capsys.readouterr()
    assert main(["forecast", "--compare", str(out), str(new)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any("distribution of the time" in line and "DISAGREES" in line for line in lines)
    assert lines[-1].startswith("DISAGREES") and "agrees" not in lines


def test_rounding_errors_give_no_interval(
    write_campaign: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A task that always completes, whatever the shares, has derivatives of rounding errors in a
    large chain. An interval from 1 to 1 would promise that it completes."""

    def rough(done: Completion) -> dict[str, Slope]:
        exact = reliability_slopes(done)
        return {x: replace(one, derivative=1e-14 * n) for n, (x, one) in enumerate(exact.items())}

    monkeypatch.setattr(registered, "reliability_slopes", rough)
    trials = []
    for k in range(60):
        status = "failure" if k % 3 else "success"
        runs = [
            RunEntry("first", "first_a", 0.0, 1.0, status, taken="on"),
            RunEntry("second", "second_a", 1.0, 1.0, "success", taken="missed"),
        ]
        trials.append(Trial(1, 0.0, 2.0 + k / 60, True, 0, runs=runs))
    train = write_campaign("train", TASK, trials)
    told = ["forecast", str(tmp_path / "pair.toml"), "--estimates", str(train), *QUICK]
    assert main([*told, "--json", str(tmp_path / "f.json")]) in (0, 1)
    found = json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["regimes"][""]["gspn"]
    assert found["P_complete"] == 1.0
    assert found["P_complete_interval"] is None


@pytest.mark.parametrize(
    ("shape", "every", "why"),
    [
        (4, 0.0, ""),
        (10_000, 0.0, "durations are fitted by their mean"),
        (10_000, 5.0, "trials of the training overlapped, and the view has one at a time"),
    ],
)
def test_a_quantile_that_few_phases_change_is_doubtful(
    shape: int,
    every: float,
    why: str,
    write_campaign: Write,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Eight phases are enough for a gamma distribution of shape 4, not for nearly fixed times.
    Trials that overlap are not those of the view anyway."""
    random = np.random.default_rng(1)
    text = (
        'schema = 1\n[task]\nname = "wait"\nfinal = "over == 1"\nruns_place = "jobs"\n'
        '[places.jobs]\nkind = "control"\ntokens = 1\n[places.over]\nkind = "control"\n'
        '[primitive_tasks.a]\ngoal = "g"\nalternatives = ["a_a"]\ndeadline = 99.0\n'
        '[places.a]\nkind = "action"\n[transitions.begin]\nin = ["jobs"]\nout = ["a"]\n'
        '[transitions.on]\nin = ["a:normal"]\nout = ["over"]\n'
    )
    trials = []
    for k in range(200):
        time = float(random.gamma(shape, 10 / shape))
        runs = [RunEntry("a", "a_a", 0.0, time, "success", taken="on")]
        trials.append(Trial(k + 1, every * k, time, True, 0, runs=runs))
    train = write_campaign("train", text, trials)
    main(["forecast", str(tmp_path / "wait.toml"), "--estimates", str(train), *QUICK])
    said = " ".join(capsys.readouterr().out.split())
    outside = "doubtful: its 90 % quantile is outside the interval above, because"
    assert f"{outside} {why}" in said if why else outside not in said


def test_trials_of_a_rare_success_keep_their_digits(
    write_campaign: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six steps that succeed every tenth time complete once in a million: the trials only bound it,
    the chain says it, with its error."""
    random = np.random.default_rng(1)
    text = (
        'schema = 1\n[task]\nname = "steps"\nfinal = "over == 1"\nruns_place = "jobs"\n'
        '[places.jobs]\nkind = "control"\ntokens = 1\n[places.over]\nkind = "control"\n'
        '[places.gone]\nkind = "control"\n[transitions.begin]\nin = ["jobs"]\nout = ["a"]\n'
    )
    for step, after in zip("abcdef", [*"bcdef", "over"], strict=True):
        text += (
            f'[primitive_tasks.{step}]\ngoal = "g"\nalternatives = ["{step}_a"]\ndeadline = 9.0\n'
            f'[places.{step}]\nkind = "action"\ntask = "{step}"\n'
            f'[transitions.{step}_on]\nin = ["{step}:normal"]\nout = ["{after}"]\n'
            f'[transitions.{step}_lost]\nin = ["{step}:error"]\nout = ["gone"]\n'
        )
    # each trial is one run of a step, so that all steps are measured equally often
    trials = []
    for k in range(1200):
        step, lost = "abcdef"[k % 6], bool(random.random() > 0.1)
        status, taken = ("error", f"{step}_lost") if lost else ("success", f"{step}_on")
        runs = [RunEntry(step, f"{step}_a", 0.0, 1.0, status, taken=taken)]
        trials.append(Trial(1, 0.0, None, False, 0, runs=runs))
    train = write_campaign("train", text, trials)
    told = ["forecast", str(tmp_path / "steps.toml"), "--estimates", str(train), *QUICK]
    assert main([*told, "--json", str(tmp_path / "f.json")]) in (0, 1)
    made = json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["regimes"][""]
    shares = [
        np.mean([t.runs[0].status == "success" for t in trials if t.runs[0].place == step])
        for step in "abcdef"
    ]
    found = made["gspn"]
    assert found["P_complete"] == pytest.approx(float(np.prod(shares)), rel=1e-6)
    assert found["P_complete_error"] < 1e-12
    # var(log P) = sum (1 - p) / (n p)
    sd = float(np.sqrt(sum((1 - p) / (200 * p) for p in shares)))
    low, high = found["P_complete_interval"]
    assert high / low == pytest.approx(np.exp(2 * 1.96 * sd), rel=1e-6)
    assert low < 1e-6 < high
    assert made["figures"]["P_complete"]["confidence"][1] < 0.005
    assert "e-0" in capsys.readouterr().out
