"""`run --learn` and `learned` from the command line: two runs in a row, frozen, merged; and nothing
is touched without --learn."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.engine import Engine
from petrobot.coordinator.launch import resumed_mission, with_runs
from petrobot.coordinator.learning.estimate import Observation, Tally, TallyKey
from petrobot.coordinator.learning.estimates_file import EstimatesError, EstimatesFile
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.session import LearningSession, LearningSetting, session_of
from petrobot.coordinator.operator.session import LockstepSession
from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.coordinator.run.mission import MissionError
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.task import Status
from tests.learning.cell import HEAD, TASK_FILE, directory, run, sorting
from tests.learning.conftest import tally_of

MOCK = """
schema = 1
[actions.pick_fast]
status = "error"
cause = "slipped"
seconds = 0.1
[actions.pick_slow]
seconds = [0.2, 0.3]
values = { weight = 1.5 }
[actions.pick_blind]
status = "error"
cause = "missed"
seconds = 0.2
[actions.place_soft]
seconds = 0.2
values = { tries = 2 }
[actions.place_hard]
seconds = 0.2
values = { tries = 1 }
"""


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with services.toml and scripted actions for the sorting task."""
    actions = "".join(
        f'[actions.{a}]\nrun = "math:sqrt"\ntask = "{p.name}"\nnode = "node"\n'
        for p in sorting().primitive_tasks.values()
        for a in p.alternatives
    )
    (tmp_path / "services.toml").write_text(HEAD + actions, encoding="utf-8")
    (tmp_path / "mock.toml").write_text(MOCK, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def petrobot(*more: str, runs: int = 6) -> tuple[int, dict[str, Any]]:
    """Run the sorting task in lock step; return the result without its wall-clock time."""
    given = [
        "--mode",
        "lockstep",
        "--runs",
        str(runs),
        "--mock",
        "mock.toml",
        "--json",
        "out.json",
        "--quiet",
    ]
    code = main(["run", str(TASK_FILE), *given, *more])
    result: dict[str, Any] = json.loads(Path("out.json").read_text(encoding="utf-8"))
    del result["wall_s"]
    return code, result


def _uses_the_measurements(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Check that analyse, simulate, show and convert compute with a file instead of the task's own
    estimates, and say so."""
    capsys.readouterr()
    task, more = str(TASK_FILE), ["--estimates", file]
    main(["analyse", task, "--view", "gspn", "--json", "-"])
    assert "forecast" not in json.loads(capsys.readouterr().out)  # the task declares no estimates
    main(["analyse", task, "--view", "gspn", *more, "--json", "-"])
    sources = json.loads(capsys.readouterr().out)["forecast"]["sources"]
    assert any(text.startswith("measured in") and "in missions" in text for text in sources)
    for command in (
        ["simulate", task, *more, "--replicas", "2", "--json", "-"],
        ["show", task, *more, "--heat"],
        ["show", task, *more, "--view", "gspn"],
        ["convert", task, "learned.pnpro", *more],
    ):
        assert main(command) in (0, 1)
        said = capsys.readouterr().out
        assert "measured in" in said or command[0] != "show"
    assert main(["analyse", "catch_ball", *more]) == 2
    assert "nothing was measured of catch_ball" in capsys.readouterr().err


def test_learning_continues_in_the_next_run(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two runs in a row add up; a new file and the same seed give the same estimates again."""
    learn = ("--learn", "learned.db", "--selector", "nikolic_fu_fast")
    code, first = petrobot(*learn)
    assert code == 0
    assert first["learned"]["context"] == "regime=A"
    code, second = petrobot(*learn)
    runs = first["learned"]["runs_counted"] + second["learned"]["runs_counted"]
    kept = EstimatesFile(cell / "learned.db").read()
    assert sum(t.runs + t.censored for t in kept.estimates.tallies.values()) == runs > 12
    assert kept.generation == 2
    assert kept.states("nikolic_fu_fast")["pick"]["learners"]["regime=A"]["k"] == 12
    _uses_the_measurements("learned.db", capsys)
    _, again = petrobot("--learn", "other.db", "--selector", "nikolic_fu_fast")
    again["learned"]["file"] = first["learned"]["file"]
    assert again == first
    assert main(["learned", "show", "learned.db", "--target", "0.9", "--json", "shown.json"]) == 0
    shown = json.loads(Path("shown.json").read_text(encoding="utf-8"))["primitive_tasks"]
    assert {row["action"] for row in shown["pick"]["actions"]} == {
        "pick_fast",
        "pick_slow",
        "pick_blind",
    }
    assert shown["pick"]["best"] in (None, "pick_slow")
    assert "nikolic_fu_fast regime=A" in capsys.readouterr().out.replace("\n", " ")


def test_costs_are_shown_in_the_measure_used_for_learning(cell: Path) -> None:
    """The default is the measure that the task declares for each primitive task, with its unit;
    `--cost` selects another one."""
    petrobot("--learn", "learned.db", runs=12)

    def shown(*more: str) -> dict[str, Any]:
        assert main(["learned", "show", "learned.db", "--json", "shown.json", *more]) == 0
        found: dict[str, Any] = json.loads(Path("shown.json").read_text(encoding="utf-8"))[
            "primitive_tasks"
        ]
        return found

    declared = shown()
    assert {task: about["cost"] for task, about in declared.items()} == {
        "pick": "wall",
        "place": "value:tries",
    }
    place = EstimatesFile(cell / "learned.db").read().estimates.of("place")
    for row in declared["place"]["actions"]:
        (tally,) = place[row["action"]].values()
        assert row["C"] == pytest.approx(tally.cost("value:tries").mean)
    counted = shown("--cost", "count")
    assert all(
        row["C"] == 1.0 for about in counted.values() for row in about["actions"] if row["runs"]
    )


def test_the_only_action_that_works_is_learned(cell: Path) -> None:
    """One of three picking actions succeeds: after 150 runs it has nearly all probability, and with
    learning frozen it is always chosen."""
    _, result = petrobot("--learn", "learned.db", runs=150)
    assert result["learned"]["probabilities"]["pick"]["pick_slow"] > 0.9
    before = (cell / "learned.db").read_bytes()
    _, frozen = petrobot("--learn", "learned.db", "--frozen", runs=3)
    assert frozen["learned"]["runs_counted"] == 0
    assert frozen["firings"] == 3 * 3
    assert (cell / "learned.db").read_bytes() == before


def test_without_learn_nothing_is_read_or_changed(cell: Path) -> None:
    """The result is the same with and without an estimates file, and the file is unchanged."""
    _, clean = petrobot()
    petrobot("--learn", "learned.db", runs=20)
    files = {p: p.read_bytes() for p in cell.iterdir() if p.name != "out.json"}
    _, after = petrobot()
    assert after == clean
    assert "learned" not in after
    assert {p: p.read_bytes() for p in cell.iterdir() if p.name != "out.json"} == files


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--selector", "ucb1"], "--selector needs --learn"),
        (["--target", "0.9"], "--target needs --learn"),
        (["--frozen"], "--frozen needs --learn"),
        (["--learn", "none.db", "--frozen"], "without --frozen first"),
        (["--learn", "mock.toml"], "not a database"),
        (["--learn", "learned.db", "--context", "speed"], "no parameter or variable 'speed'"),
        (["--learn", "learned.db", "--selector", "greedy"], "invalid choice"),
        (
            ["--learn", "learned.db", "--target", "7"],
            "--target: 7 is not a number of more than 0 and at most 1",
        ),
    ],
)
def test_bad_input_is_refused(
    cell: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2 and one line of error, before anything runs or is written."""
    given = [
        "run",
        str(TASK_FILE),
        "--mode",
        "lockstep",
        "--mock",
        "mock.toml",
        "--quiet",
        *arguments,
    ]
    assert main(given) == 2
    assert said in capsys.readouterr().err
    assert not (cell / "learned.db").exists()


def test_the_subcommands_of_learned(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Merge adds, freeze holds the selectors, reset forgets; unknown names are refused."""
    petrobot("--learn", "one.db", runs=8)
    petrobot("--learn", "two.db", "--seed", "9", runs=8)
    frozen_at = json.dumps(
        EstimatesFile(cell / "one.db").read().states("nikolic_fu_fast")["pick"]["learners"]
    )
    assert main(["learned", "freeze", "one.db", "pick"]) == 0
    petrobot("--learn", "one.db", runs=4)
    states = EstimatesFile(cell / "one.db").read().states("nikolic_fu_fast")
    assert json.dumps(states["pick"]["learners"]) == frozen_at
    assert states["pick"]["frozen"]
    assert not states["place"]["frozen"]
    assert main(["learned", "thaw", "one.db"]) == 0
    assert main(["learned", "merge", "one.db", "two.db"]) == 0
    runs = sum(
        t.runs
        for t in EstimatesFile(cell / "one.db").read().estimates.of("pick")["pick_slow"].values()
    )
    assert main(["learned", "merge", "one.db", "two.db", "two.db"]) == 0
    again = sum(
        t.runs
        for t in EstimatesFile(cell / "one.db").read().estimates.of("pick")["pick_slow"].values()
    )
    assert again == runs
    assert main(["learned", "reset", "one.db", "pick"]) == 0
    assert not EstimatesFile(cell / "one.db").read().estimates.of("pick")
    capsys.readouterr()
    for arguments, said in (
        (["show", "none.db"], "no such file"),
        (["merge", "one.db"], "what?"),
        (["merge", "one.db", "none.db"], "no such file"),
        (["reset", "one.db", "fly"], "no primitive task 'fly'"),
        (["show", "one.db", "--cost", "pictures"], "not a cost measure"),
        (["show", "one.db", "--cost", "value:"], "not a cost measure"),
        (
            ["show", "two.db", "--cost", "value:nosuch"],
            "the results have: value:tries, value:weight",
        ),
        (["show", "two.db", "pick", "--cost", "value:tries"], "the results have: value:weight"),
        (["show", "one.db", "--target", "7"], "7 is not a number of more than 0 and at most 1"),
        (["show", "one.db", "--rho", "-3"], "-3 is not a number of at least 0"),
        (["show", "one.db", "--budget", "nan"], "nan is not a number of more than 0"),
        (["show", "one.db", "--context", "nowhere"], "has the contexts 'regime=A'"),
        (
            ["task", "one.db", str(TASK_FILE), "--context", "nowhere"],
            "has the contexts 'regime=A'",
        ),
    ):
        assert main(["learned", *arguments]) == 2
        assert said in capsys.readouterr().err


def told(path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[dict[str, Any], str]:
    """Return what `learned show` writes and prints."""
    capsys.readouterr()
    out = path.with_suffix(".json")
    assert main(["learned", "show", str(path), "--json", str(out), *more]) == 0
    shown: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))["primitive_tasks"]
    return shown, " ".join(capsys.readouterr().out.split())


def shares(seconds: float, **by_context: tuple[int, int]) -> dict[str, Tally]:
    """Return tallies with (successes, failures) by context."""
    ends = {
        c: [Status.SUCCESS] * good + [Status.FAILURE] * bad for c, (good, bad) in by_context.items()
    }
    return {
        c: tally_of([Observation(status, seconds) for status in statuses])
        for c, statuses in ends.items()
    }


def file_of(path: Path, asked: Question | None = None, **actions: dict[str, Tally]) -> Path:
    """Write an estimates file of one primitive task."""
    tallies = {
        TallyKey("pick", a, c): tally for a, by in actions.items() for c, tally in by.items()
    }
    EstimatesFile(path).add(Estimates(tallies), {}, asked={"pick": asked} if asked else None)
    return path


def test_show_lists_the_worst_case_and_each_context(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pooled over unequal shares of easy and hard contexts, the better action would look worse."""
    good = shares(1.0, easy=(98, 2), hard=(560, 440))
    bad = shares(1.0, easy=(900, 100), hard=(40, 60))
    shown, text = told(file_of(tmp_path / "x.db", good=good, bad=bad), capsys)
    by_name = {row["action"]: row for row in shown["pick"]["actions"]}
    assert by_name["good"]["R_over_all_runs"] < by_name["bad"]["R_over_all_runs"]
    assert [by_name[a]["R"] for a in ("good", "bad")] == [0.56, 0.40]
    assert [by_name[a]["J"] for a in ("good", "bad")] == pytest.approx([1.44, 1.60])
    assert shown["pick"]["best"] == "good"
    parts = {(row["action"], row["context"]): row for row in shown["pick"]["by_context"]}
    assert {key: row["R"] for key, row in parts.items()} == {
        ("good", "easy"): 0.98, ("good", "hard"): 0.56, ("bad", "easy"): 0.9, ("bad", "hard"): 0.4,
    }  # fmt: skip
    assert all(row["J"] == pytest.approx(2 - row["R"]) for row in parts.values())
    assert "good * 1100 0.56" in text and "hard 1000 0.56" in text and "easy 100 0.98" in text
    alone, text = told(tmp_path / "x.db", capsys, "--context", "easy")
    assert {row["action"]: row["R"] for row in alone["pick"]["actions"]} == {
        "good": 0.98,
        "bad": 0.9,
    }
    assert "hard" not in text


def test_no_action_is_recommended_for_a_target_that_none_is_known_to_meet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two successes of two show no R of 0.9; sixty of sixty do."""
    few = file_of(tmp_path / "few.db", good=shares(1.0, any=(2, 0)))
    shown, text = told(few, capsys, "--target", "0.9")
    assert shown["pick"]["to_reach"] is None and "good meets R 0.9 in: none" in text
    assert "R 0.9 is met by no action so far" in text and "costs least" not in text
    many = file_of(tmp_path / "many.db", good=shares(1.0, any=(60, 0)))
    shown, text = told(many, capsys, "--target", "0.9", "--budget", "0.5")
    assert shown["pick"]["to_reach"]["action"] == "good"
    assert "R 0.9 costs least with good" in text and "cost 0.5 buys nothing known" in text


def test_show_uses_the_target_stored_in_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The stored target is the default; `--target` overrides it, and a single context has no
    target."""
    path = tmp_path / "x.db"
    act = shares(1.0, calm=(990, 10), windy=(900, 100), storm=(500, 500))
    act["windy"] = shares(2.0, windy=(900, 100))["windy"]
    file_of(
        path,
        Question("wall", 0.85, 0.25),
        act=act,
        weak=shares(1.0, calm=(5, 5), windy=(5, 5), storm=(5, 5)),
    )
    shown, text = told(path, capsys)
    row, weak = shown["pick"]["actions"]
    assert (shown["pick"]["target"], shown["pick"]["rho"]) == (0.85, 0.25)
    assert (row["scenario"], row["scenarios"], row["C"], row["worst"]) == (
        "windy",
        ["calm", "windy"],
        2.0,
        "storm",
    )
    assert row["J"] == pytest.approx(1 - 0.5 + 0.25 * 2.0)
    assert weak["J"] is None
    assert "act meets R 0.85 in: calm, windy, where it costs 2 at most" in text
    assert (
        "target R 0.85" in text and "weak does not surely reach R 0.85 in any context: no J" in text
    )
    shown, text = told(path, capsys, "--target", "0.995", "--rho", "0")
    assert shown["pick"]["target_unmet"]
    assert [row["J"] for row in shown["pick"]["actions"]] == [0.5, 0.5]
    assert "no action surely reaches R 0.995 in any context: judged without a target" in text
    assert told(path, capsys, "--context", "storm")[0]["pick"]["target"] is None


def test_notes_explain_what_the_table_cannot_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Notes on contexts that not all actions share, costs that no result reports, and other
    criteria of other machines."""
    some, none = shares(1.0, A=(5, 5), B=(9, 1)), shares(1.0, C=(5, 5))
    _, text = told(file_of(tmp_path / "x.db", one=some, other=shares(1.0, A=(5, 5))), capsys)
    assert "judged over the contexts in which all actions were run: A" in text
    path = file_of(tmp_path / "y.db", Question("value:images"), one=some, other=none)
    file_of(tmp_path / "z.db", Question("cpu", 0.8, 0.1), one=some)
    EstimatesFile(path).merge(tmp_path / "z.db")
    shown, text = told(path, capsys)
    assert "no context in which all actions were run" in text
    assert shown["pick"]["uncosted"] == ["one", "other"]
    assert "one: no run reported value:images, so its cost is taken as 0" in text
    assert "elsewhere it was judged by --cost cpu --target 0.8 --rho 0.1" in text
    _, text = told(path, capsys, "--cost", "wall")
    assert "no run reported" not in text


def test_runs_without_a_verdict_are_shown_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They have no part in R; an action all of whose runs are such is not compared."""
    open_ = Observation(Status.SUCCESS, 1.0, judged=False)
    some = {"A": tally_of([Observation(Status.FAILURE, 1.0, "late"), open_, open_])}
    path = file_of(
        tmp_path / "x.db", one=some, two={"A": tally_of([open_])}, three=shares(1.0, A=(3, 1))
    )
    shown, text = told(path, capsys)
    rows = {row["action"]: row for row in shown["pick"]["actions"]}
    assert [(a, r["runs"], r["unjudged"], r["R"]) for a, r in sorted(rows.items())] == [
        ("one", 1, 2, 0.0),
        ("three", 4, 0, 0.75),
        ("two", 0, 1, None),
    ]
    assert "one: 1 failure: late, 2 not judged, which do not count in R" in text
    assert shown["pick"]["best"] == "three"


def test_a_run_warns_that_a_cost_was_never_reported(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No result holds the number that the task file names as cost: one line for each action, with
    the remedy."""
    spoilt = cell / "sorting.toml"
    spoilt.write_text(
        TASK_FILE.read_text(encoding="utf-8").replace("value:tries", "value:trees"),
        encoding="utf-8",
    )
    petrobot("--learn", "learned.db", runs=2)
    assert "reported" not in capsys.readouterr().err
    assert (
        main(
            [
                "run",
                str(spoilt),
                "--mode",
                "lockstep",
                "--mock",
                "mock.toml",
                "--quiet",
                "--learn",
                "x.db",
            ]
        )
        == 0
    )
    assert "place: no run of place_soft reported value:trees" in capsys.readouterr().err


def test_a_declared_cost_counts_until_one_is_measured_and_stands_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also in a file that another one was merged into; only for the measure it was declared in."""
    asked = Question("value:euro", declared=(("one", 2.0), ("two", 5.0)))
    paid = [Observation(Status.SUCCESS, 1.0, values={"euro": x}) for x in (3.0, 4.0, 5.0)]
    given = file_of(tmp_path / "x.db", asked, one=shares(1.0, A=(3, 1)), two={"A": tally_of(paid)})
    merged = tmp_path / "y.db"
    EstimatesFile(merged).merge(given)
    for path in (given, merged):
        shown, text = told(path, capsys)
        rows = {row["action"]: row for row in shown["pick"]["actions"]}
        assert [(rows[a]["C"], rows[a]["C_declared"]) for a in ("one", "two")] == [(2, 2), (4, 5)]
        assert rows["two"]["C_low"] == pytest.approx(4 - 4.302653 / 3**0.5, abs=1e-4)
        assert shown["pick"]["rho"] == 0.25 and rows["one"]["J"] == pytest.approx(0.25 + 0.5)
        assert "C declared" in text and "2 declared 2" in text and "4 1.52-6.48 5" in text
        assert not shown["pick"]["uncosted"]
    shown, text = told(given, capsys, "--cost", "wall")
    assert "declared" not in text
    assert all(row["C_declared"] is None for row in shown["pick"]["actions"])


@pytest.mark.parametrize(
    "command", [["show", "learned.db"], ["task", "learned.db", str(TASK_FILE)]]
)
def test_a_narrow_terminal_cuts_no_number(
    command: list[str],
    cell: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A pipe has 80 columns, too."""
    petrobot("--learn", "learned.db", runs=3)
    capsys.readouterr()
    monkeypatch.setenv("COLUMNS", "50")
    assert main(["learned", *command]) == 0
    told = capsys.readouterr().out
    assert "95 %" in told or "primitive task" in told
    assert "\N{HORIZONTAL ELLIPSIS}" not in told


def test_probabilities_are_shown_of_selectors_that_learn_them(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that only count keep equal ones, by which none of them chooses."""
    for selector in ("fixed", "round_robin", "nikolic_fu"):
        petrobot("--learn", "learned.db", "--selector", selector, runs=3)
    capsys.readouterr()
    shown, text = told(Path("learned.db"), capsys)
    assert list(shown["pick"]["selectors"]) == ["nikolic_fu"]
    assert "nikolic_fu " in text and "fixed" not in text and "round_robin" not in text


def test_r_and_c_of_the_whole_task(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """R and C of the primitive tasks, and of one run of the whole task computed through its net."""
    petrobot("--learn", "learned.db", "--selector", "round_robin", runs=30)
    assert main(["learned", "task", "learned.db", str(TASK_FILE), "--json", "task.json"]) == 0
    found = json.loads(Path("task.json").read_text(encoding="utf-8"))
    parts = {p["primitive_task"]: p for p in found["primitive_tasks"]}
    assert parts["pick"]["R"] == pytest.approx(1 / 3, abs=0.01)
    assert parts["place"]["runs"] == pytest.approx(1 / 3, abs=0.01)
    assert found["R_conj"] == pytest.approx(1 / 3, abs=0.01)
    assert 0 < found["R_goal"] < found["R_conj"], "a jam counts no try, yet no part is placed"
    assert found["P_complete"] == pytest.approx(1.0)
    assert found["cost"] is None, "seconds and tries must not be added"
    assert found["R_conj_interval"][0] < found["R_conj"] < found["R_conj_interval"][1]
    told = capsys.readouterr().out
    assert "every run a success" in told and "do not add: give --cost" in told
    seen = found["measured"]
    assert seen["trials"] == 30 and seen["R_conj"] == pytest.approx(found["R_conj"], abs=0.1)
    assert seen["R_conj_interval"][0] < seen["R_conj"] < seen["R_conj_interval"][1]
    assert seen["C"] is None and "measured: 30 trials of the task" in told
    assert "these trials do not tell C and J of this cost" in " ".join(told.split())
    assert main(["learned", "show", "learned.db", "--json", "shown.json"]) == 0
    shown = json.loads(Path("shown.json").read_text(encoding="utf-8"))
    assert shown["tasks"] == {"sorting": seen}
    assert "sorting: 30 trials of the task (regime=A): R_conj" in capsys.readouterr().out
    one = ["learned", "task", "learned.db", str(TASK_FILE), "--json", "task.json"]
    assert main([*one, "--cost", "wall", "--rho", "0.25"]) == 0
    same = json.loads(Path("task.json").read_text(encoding="utf-8"))
    assert same["rho"] == 0.25 and same["cost_interval"][0] < same["cost"]
    assert same["J"] == pytest.approx(1 - same["R_conj"] + 0.25 * same["cost"])
    assert main(["learned", "show", "learned.db", "--cost", "wall", "--json", "shown.json"]) == 0
    shown = json.loads(Path("shown.json").read_text(encoding="utf-8"))["primitive_tasks"]
    mixed = {p["primitive_task"]: p["C"] for p in same["primitive_tasks"]}
    costs = [a["C"] for a in shown["place"]["actions"]]
    assert min(costs) <= mixed["place"] <= max(costs), "both commands must show the same costs"
    # The rho by which a campaign judged every action is that of the whole task, too.
    asked = {name: Question("wall", rho=0.25) for name in ("pick", "place")}
    EstimatesFile(Path("learned.db")).add(Estimates({}), {}, asked=asked)
    assert main([*one, "--cost", "wall"]) == 0
    again = json.loads(Path("task.json").read_text(encoding="utf-8"))
    assert (again["rho"], again["J"]) == (0.25, same["J"])
    assert main([*one, "--cost", "value:nothing"]) == 2
    assert main([*one, "--budget", "3"]) == 2
    capsys.readouterr()
    assert main(["learned", "task", "learned.db"]) == 2
    assert main(["learned", "task", "learned.db", "no_such_task"]) == 2
    assert "which task?" in capsys.readouterr().err


def test_a_run_that_could_not_save_what_it_learns_does_not_begin(tmp_path: Path) -> None:
    """It was noticed at its end."""
    task, file = sorting(), tmp_path / "file"
    file.touch()
    with pytest.raises(EstimatesError, match="Not a directory; give --learn a file"):
        LearningSession(task, LearningSetting(file / "learned.db"), seed=5)
    assert [*tmp_path.iterdir()] == [file]


def test_a_run_that_was_saved_and_resumed_counts_once(tmp_path: Path) -> None:
    """The session of a resumed run starts from the estimates with which the run started, and adds
    only what was not saved before."""
    task, path = sorting(), tmp_path / "learned.db"
    one = LearningSession(task, LearningSetting(path), seed=5)
    header = {"seed": 5, "learning": json.loads(json.dumps(one.beginning()))}
    run(task, one.selector, runs=9, seed=5)
    half = len(one.selector.records) // 2
    interrupted = session_of(task, header)
    assert interrupted is not None
    for record in one.selector.records[:half]:
        interrupted.selector.records.append(record)
        interrupted.learning.apply(record)
    interrupted.save()
    resumed = session_of(task, header)
    assert resumed is not None
    for record in one.selector.records:
        resumed.selector.records.append(record)
        resumed.learning.apply(record)
    resumed.save()
    kept = EstimatesFile(path).read()
    for key, tally in one.learning.gained.tallies.items():
        assert kept.estimates.tally(key).counts == tally.counts
    for of, sums in one.learning.gained.trials.items():
        saved = kept.estimates.trials[of]
        assert (saved.n, saved.success, saved.runs) == (sums.n, sums.success, sums.runs)
        assert saved.cost.total == pytest.approx(sums.cost.total) and saved.n == 9
    assert kept.states("nikolic_fu_fast") == one.learning.state()
    assert directory(task).actions
    assert session_of(task, {"seed": 5}) is None
    with pytest.raises(ValueError, match="declared"):
        session_of(
            task,
            {
                "seed": 5,
                "learning": {k: v for k, v in header["learning"].items() if k != "declared"},
            },
        )
    assert TallyKey("pick", "pick_slow", "regime=A") in kept.estimates.tallies


def test_a_resumed_mission_restores_its_selector(tmp_path: Path) -> None:
    """At the end of an interrupted journal the resumed selector has the state of the live one, and
    makes the same next choice."""
    task, path = sorting(), tmp_path / "learned.db"
    session = LearningSession(task, LearningSetting(path), seed=5)
    header = {
        "mission": "sorting/5",
        "mode": "lockstep",
        "seed": 5,
        "runs": 9,
        "parameters": task.parameters,
        "learning": session.beginning(),
    }
    store = JournalStore(JournalWriter(tmp_path / "run.journal", header), 0.0)
    run(task, session.selector, runs=9, seed=5, store=store)
    store.writer.sync()
    whole = (tmp_path / "run.journal").read_bytes()
    (tmp_path / "half.journal").write_bytes(whole[: len(whole) // 2])
    journal = read_journal(tmp_path / "half.journal")
    known, _ = with_runs(task, 9)
    resumed = session_of(task, json.loads(json.dumps(journal.header)))
    assert resumed is not None
    mission, _ = resumed_mission(
        directory(task),
        known,
        Engine(known, {}),
        journal,
        [resumed.selector],
        100.0,
        resumed.selector,
    )
    n = len(resumed.selector.records)
    assert 0 < n < len(session.selector.records)
    assert resumed.selector.records == session.selector.records[:n]
    again = LearningSession(task, LearningSetting(path), seed=5)
    for record in session.selector.records[:n]:
        again.learning.apply(record)
    assert resumed.learning.state() == again.learning.state()
    assert mission.executor.selector is resumed.selector


# --- plants -----------------------------------------------------------------------------------


def sampled(good: int, bad: int, salt: str) -> Tally:
    """Return a tally of runs of one second."""
    tally = Tally()
    for i in range(good + bad):
        status = Status.SUCCESS if i < good else Status.FAILURE
        tally = tally.adding(Observation(status, 1.0), salt)
    return tally


def learned_in(path: Path, plant: str, **actions: tuple[int, int]) -> None:
    """Add runs of a plant to an estimates file: successes and failures by action of `pick`."""
    known = {
        TallyKey("pick", a, "regime=A"): sampled(*counts, plant) for a, counts in actions.items()
    }
    EstimatesFile(path).add(Estimates(known), {}, plant=plant)


def test_mock_runs_do_not_move_what_was_learned_in_a_simulation(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both are shown, with their plant; the simulated runs judge."""
    path = cell / "learned.db"
    learned_in(path, "simulated", pick_fast=(25, 0), pick_slow=(5, 20))
    assert petrobot("--learn", "learned.db")[0] == 0
    capsys.readouterr()
    shown, text = told(path, capsys)
    rows = {(row["action"], row["source"]): row for row in shown["pick"]["actions"]}
    fast = rows["pick_fast", "simulated"]
    assert (fast["R"], fast["runs"]) == (1.0, 25) and shown["pick"]["source"] == "simulated"
    assert shown["pick"]["best"] == "pick_fast" and shown["pick"]["level_with_best"] == []
    assert rows["pick_fast", "mock"]["R"] == 0.0 and rows["pick_fast", "mock"]["runs"] > 0
    assert "never pooled" in text and "pick_fast *" in text
    assert shown["place"]["source"] == "mock"
    mock, _ = told(path, capsys, "--plant", "mock")
    assert {row["source"] for row in mock["pick"]["actions"]} == {"mock"}
    assert main(["learned", "show", "learned.db", "--plant", "real"]) == 2
    assert "expected one of: mock, simulated" in capsys.readouterr().err
    more = ["--estimates", "learned.db", "--runs", "10"]
    assert main(["forecast", str(TASK_FILE), *more]) == 2
    assert "several plants, which are never pooled: mock, simulated" in capsys.readouterr().err
    assert main(["analyse", str(TASK_FILE), "--estimates", "learned.db", "--json", "-"]) in (0, 1)
    assert "those of plant simulated, not pooled with: mock" in capsys.readouterr().err


def test_a_file_that_does_not_say_its_plant_is_shown_so(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = cell / "learned.db"
    learned_in(path, "", pick_fast=(5, 0))
    assert "plant" not in told(path, capsys)[1]
    learned_in(path, "mock", pick_fast=(0, 5))
    shown, text = told(path, capsys)
    assert shown["pick"]["source"] == "" and "judged by the runs of plant unknown alone" in text


@pytest.mark.parametrize(("trials", "runs", "good"), [(10.0, 14.0, 8.0), (200.0, 54.0, 40.0)])
def test_a_simulated_estimate_is_a_discounted_prior_of_a_real_one(
    cell: Path, capsys: pytest.CaptureFixture[str], trials: float, runs: float, good: float
) -> None:
    """It counts as so many trials, and never as more than it has; it is not stored as real runs,
    and never counts twice."""
    path = cell / "learned.db"
    learned_in(path, "simulated", pick_fast=(40, 10), pick_slow=(5, 5))
    learned_in(path, "mock", pick_fast=(0, 90))
    learned_in(path, "real", pick_fast=(0, 4))
    for _ in range(2):
        setting = LearningSetting(path, plant="real", prior=trials)
        session = LearningSession(sorting(), setting, 1)
        batch = session.learning.selectors["pick"].learner("regime=A")
        assert (batch.runs[0, 0], batch.successes[0, 0]) == (runs, good)
        assert batch.cost[0, 0] == pytest.approx(runs)
        session.save()
    shown, text = told(path, capsys)
    assert shown["pick"]["prior"] == {"source": "simulated", "trials": trials}
    assert f"count the runs of plant simulated, as {trials:g} trials of each action" in text
    rows = {(row["action"], row["source"]): row["runs"] for row in shown["pick"]["actions"]}
    assert rows["pick_fast", "real"] == 4 and rows["pick_fast", "simulated"] == 50


def test_a_prior_that_is_not_there_and_a_frozen_choice_of_another_plant_are_refused(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(TASK_FILE), "--prior"]) == 2
    assert "--prior needs --learn" in capsys.readouterr().err
    path = cell / "learned.db"
    learned_in(path, "real", pick_fast=(4, 0))
    with pytest.raises(EstimatesError, match="needs runs of another plant than real"):
        LearningSession(sorting(), LearningSetting(path, plant="real", prior=5.0), 1)
    with pytest.raises(EstimatesError, match="--prior needs --credit action"):
        LearningSession(sorting(), LearningSetting(path, plant="real", prior=5.0, credit="task"), 1)
    assert petrobot("--learn", "mock.db")[0] == 0
    with pytest.raises(EstimatesError, match="learned nothing in this plant"):
        LearningSession(sorting(), LearningSetting(cell / "mock.db", plant="real", frozen=True), 1)
    assert (
        LearningSession(sorting(), LearningSetting(cell / "mock.db", plant="mock", frozen=True), 1)
        .learning.selectors["pick"]
        .learners
    )


def test_the_gate_says_what_a_target_needs(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = cell / "learned.db"
    learned_in(path, "real", pick_fast=(38, 0), pick_slow=(90, 10))
    shown, text = told(path, capsys, "--target", "0.95")
    assert "pick_fast: 38 of 38 in regime=A: lower bound 0.908; 73 needed for 0.95" in text
    assert "pick_slow: 90 of 100 in regime=A: lower bound 0.826; R itself is not above 0.95" in text
    assert shown["pick"]["target_unmet"]
    for row in shown["pick"]["actions"]:
        assert row["J_low"] <= row["J"] < row["J_high"]


def test_estimates_that_cannot_be_saved_do_not_hide_why_the_run_failed(
    cell: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = cell / "learned.db"

    async def lead(session: LockstepSession, watch: object) -> None:
        path.mkdir()  # the estimates file is replaced during the run
        raise MissionError("the camera is gone")

    monkeypatch.setattr(LockstepSession, "_lead", lead)
    given = ["--mode", "lockstep", "--mock", "mock.toml", "--quiet", "--learn", str(path)]
    assert main(["run", str(TASK_FILE), *given]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == "petrobot run: the camera is gone", said
    assert any("what it learned is not saved" in line and str(path) in line for line in said), said


def test_a_run_that_ended_without_its_result_counts_once(
    cell: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The coordinator dies between the estimates and the result: the resume that gives the result
    adds nothing, and leaves what others have learned since then."""

    def die(session: LockstepSession) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(LockstepSession, "keep_result", die)
        given = ["--mode", "lockstep", "--mock", "mock.toml", "--quiet", "--journal", "runs"]
        assert main(["run", str(TASK_FILE), *given, "--learn", "learned.db"]) == 2
    once = EstimatesFile(cell / "learned.db").read()
    assert petrobot("--learn", "learned.db")[0] == 0
    both = EstimatesFile(cell / "learned.db").read()
    assert main(["resume", "last", "--quiet", "--json", "again.json"]) == 0
    again = EstimatesFile(cell / "learned.db").read()
    assert once.estimates.tallies and again.estimates.tallies == both.estimates.tallies
    assert again.selectors == both.selectors and again.generation == both.generation == 2
    counted = json.loads(Path("again.json").read_text(encoding="utf-8"))["learned"]["runs_counted"]
    assert counted == sum(t.runs + t.censored for t in once.estimates.tallies.values())


def test_a_file_that_was_reset_says_that_it_holds_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, seen = tmp_path / "lab.db", Estimates()
    seen.tallies[TallyKey("pick", "A", "")] = Tally().adding(Observation(Status.SUCCESS, 1.0), "t")
    EstimatesFile(file).add(seen, {})
    assert main(["learned", "reset", str(file)]) == 0
    capsys.readouterr()
    assert main(["learned", "show", str(file)]) == 0
    assert capsys.readouterr().out == f"{file}: no run has been learned from\n"
