"""What if: changing one number gives the same result as a file with that number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from petrobot.coordinator.analysis.commands import analyse_command, simulate_command
from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.analysis.report import analyse
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.analysis.time.whatif import change_net, change_task, read_change
from petrobot.coordinator.task import Estimate, Status
from petrobot.coordinator.task.file import dumps, load
from petrobot.coordinator.task.net import Net
from tests.analysis.broken import TASKS

CATCH = TASKS / "catch_ball.toml"


@pytest.mark.once
def test_changed_tokens_equal_those_in_a_file(tmp_path: Path) -> None:
    """runs=1 gives the same result as a file with one token."""
    edited = tmp_path / "one.toml"
    task = load(CATCH)
    one = replace(task, places={**task.places, "runs": replace(task.places["runs"], tokens=1)})
    edited.write_text(dumps(one), encoding="utf-8")
    what_if = analyse_command(CATCH, view="gspn", stages=1, changes=["runs=1"])
    as_file = analyse_command(edited, view="gspn", stages=1)
    assert what_if.data["states"] == as_file.data["states"] < what_if.data["as_it_is"]["states"]
    assert what_if.data["forecast"]["mean"] == pytest.approx(
        as_file.data["forecast"]["mean"], rel=1e-12
    )
    assert "mean time" in what_if.text and what_if.data["what_if"] == ["runs=1"]


def test_shares_keep_their_proportions() -> None:
    """A changed error share scales the other statuses and leaves other actions alone."""
    task = load(CATCH)
    estimates = task.primitive_tasks["locate_ball"].estimates
    first = task.primitive_tasks["locate_ball"].alternatives[0]
    change = read_change(f"locate_ball.{first}.error.share=0.5")
    _, measured = change_task(task, Measured(), [change])
    (key, found), *others = measured.runs.items()
    assert key == ("locate_ball", first) and not others
    assert sum(e.share for e in found.values()) == pytest.approx(1.0)
    assert found[Status.ERROR] == replace(estimates[Status.ERROR], share=0.5)
    ratio = found[Status.SUCCESS].share / estimates[Status.SUCCESS].share
    assert all(
        found[s].share == pytest.approx(ratio * e.share)
        for s, e in estimates.items()
        if s is not Status.ERROR
    )


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_several_shares_of_one_action_hold_together(order: tuple[int, int]) -> None:
    """Each share is the one that was given, whatever comes after it."""
    task, changes = load(CATCH), ["locate_ball.error.share=0.2", "locate_ball.failure.share=0.3"]
    _, measured = change_task(task, Measured(), [read_change(changes[i]) for i in order])
    for key, found in measured.runs.items():
        shares = {status: one.share for status, one in found.items()}
        assert shares[Status.ERROR] == 0.2 and shares[Status.FAILURE] == 0.3
        assert shares[Status.SUCCESS] == pytest.approx(0.5)
        assert all(change in measured.sources[key] for change in changes)


def test_shares_that_add_up_to_one_are_accepted() -> None:
    """All of the rounded sum of the declared shares may be given to one status."""
    task = load(CATCH)
    shares = {Status.SUCCESS: 0.7, Status.FAILURE: 0.2, Status.ERROR: 0.1}
    assert 0.7 + 0.2 + 0.1 < 1.0  # `sum` rounds once from CPython 3.12 on
    known = {status: Estimate(share, 1.0) for status, share in shares.items()}
    arm = replace(task.primitive_tasks["recover_arm"], estimates=known)
    task = replace(task, primitive_tasks={**task.primitive_tasks, "recover_arm": arm})
    _, measured = change_task(task, Measured(), [read_change("recover_arm.error.share=1")])
    (found,) = measured.runs.values()
    assert {s: e.share for s, e in found.items()} == dict.fromkeys(shares, 0.0) | {Status.ERROR: 1}
    too_many = ["recover_arm.error.share=0.6", "recover_arm.failure.share=0.6"]
    with pytest.raises(NetFileError, match="add up to at most 1; "):
        change_task(task, Measured(), [read_change(text) for text in too_many])


@pytest.mark.once
def test_improvements_improve_the_result() -> None:
    """Fewer errors complete more often; a status that never occurred may be given a share."""
    task = load(CATCH)

    def complete(*changes: str) -> float:
        read = [read_change(text) for text in ("runs=1", *changes)]
        other, measured = change_task(task, Measured(), read)
        found = analyse(other, view="gspn", measured=measured, stages=1).forecast
        assert found is not None
        return found.completion_probability

    worse = complete("recover_arm.error.share=0.9")
    assert worse < complete() < complete("recover_arm.error.share=0.0") <= 1.0
    sure = {Status.SUCCESS: Estimate(1.0, 0.5)}
    known = Measured(
        runs={("recover_arm", a): sure for a in task.primitive_tasks["recover_arm"].alternatives}
    )
    _, supposed = change_task(task, known, [read_change("recover_arm.error.share=0.25")])
    (found,) = supposed.runs.values()
    assert {s: e.share for s, e in found.items()} == {Status.SUCCESS: 0.75, Status.ERROR: 0.25}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("runs", "not of the form NAME=NUMBER"),
        ("runs=many", "not of the form NAME=NUMBER"),
        ("runs=1.5", "whole number"),
        ("locate_ball=1", "not a resource or control place"),
        ("nobody.error.share=0.1", "catch_ball has no such number"),
        ("locate_ball.crash.share=0.1", "catch_ball has no such number"),
        ("locate_ball.nobody.error.share=0.1", "not an alternative of locate_ball"),
        ("locate_ball.error.share=1.5", "out of range"),
        ("locate_ball.success.mean=0", "out of range"),
    ],
)
def test_impossible_changes_are_refused(text: str, said: str) -> None:
    """One clear line, and the exit code for bad input."""
    outcome = analyse_command(CATCH, changes=[text])
    assert outcome.code == 2 and said in outcome.text and "what if" in outcome.text


def test_nets_with_and_without_rates(tmp_path: Path) -> None:
    """A PNML net: tokens always, rates only if it has any."""
    net = tmp_path / "cycle.net"
    net.write_text("tr work a -> b\ntr rest b -> a\npl a (1)\n", encoding="utf-8")
    outcome = analyse_command(net, view="gspn", rates="unit", changes=["work.rate=3", "a=2"])
    assert outcome.data["throughput"]["work"] == pytest.approx(12 / 13, rel=1e-9)
    assert outcome.data["as_it_is"]["throughput"]["work"] == pytest.approx(0.5)
    assert analyse_command(net, changes=["work.rate=3"]).code == 2
    with pytest.raises(NetFileError, match="no place c"):
        change_net(Net.build({"a": 1}, {}), [read_change("c=1")])


def test_measures_of_the_file_as_it_is_are_in_the_data() -> None:
    """The text has each measure before and after the change; so have the data."""
    found = analyse_command(CATCH, view="gspn", changes=["runs=1"], measures=["p=time(0.9)"])
    before, after = found.data["as_it_is"]["measures"]["p"], found.data["measures"]["p"]
    assert f"{before:.6g} -> {after:.6g}" in found.text and after < before / 2


@pytest.mark.parametrize("tokens", [0, 1])
def test_a_task_without_transitions_has_figures(tokens: int, tmp_path: Path) -> None:
    """It is at its end, or never comes there: no traceback, and no time is `nan` or 4e-31 s."""
    path = tmp_path / "still.toml"
    path.write_text(
        'schema = 1\n[task]\nname = "t"\nfinal = "a == 0"\nruns_place = "a"\n'
        f'[places]\na = {{ kind = "control", tokens = {tokens} }}\n'
    )
    outcome = analyse_command(path, view="gspn", changes=[f"a={1 - tokens}"])
    rows = {line[:32].strip(): line[32:].split() for line in outcome.text.splitlines()}
    one, other = ("0", "-") if tokens == 0 else ("-", "0")
    assert rows["mean time (s)"] == [one, other]
    assert rows["90 % quantile of the time (s)"] == [one, other]
    assert "nan" not in outcome.text and "few phases:" not in outcome.text
    seen = simulate_command(path, np.random.default_rng(1), replicas=20).data
    assert seen["completed"][0] == 1 - tokens


def test_simulation_accepts_the_same_changes() -> None:
    """Twice the runs take twice as long."""

    def mean(*changes: str) -> float:
        random = np.random.default_rng(3)
        outcome = simulate_command(CATCH, random, replicas=300, stages=2, changes=changes)
        return float(outcome.data["time"][0])

    assert mean("runs=2") == pytest.approx(2 * mean("runs=1"), rel=0.1)


def test_the_rate_of_a_transition_includes_its_copies_for_tries(tmp_path: Path) -> None:
    """The file has one `put`; each part is put once, after a second try too."""
    path = tmp_path / "task.toml"
    path.write_text(
        """schema = 1
[task]
name = "t"
final = "parts == 0 and hand == 1"
[primitive_tasks.grip]
deadline = 900.0
[primitive_tasks.grip.estimates]
success = { share = 0.5, mean = 1.0, cv = 1.0 }
error = { share = 0.5, mean = 1.0, cv = 1.0 }
[places]
parts = { kind = "control", tokens = 1 }
hand = { kind = "resource", tokens = 1 }
grip = { kind = "action", tries = 2 }
[transitions]
next = { in = ["parts", "hand"], out = ["grip"] }
put = { in = ["grip:normal"], out = ["hand"] }
drop = { in = ["grip:error"], out = ["hand"] }
""",
        encoding="utf-8",
    )
    measures = ["put=rate(put)*mean", "second=rate(put.1)*mean"]
    found = analyse_command(path, view="gspn", measures=measures).data["measures"]
    assert found == pytest.approx({"put": 0.75, "second": 0.25})


def test_a_measure_that_a_net_does_not_have_names_those_that_it_has(tmp_path: Path) -> None:
    path = tmp_path / "queue.net"
    path.write_text("pl free (2)\ntr arrive free -> busy\ntr serve busy -> free\n", "utf-8")
    found = analyse_command(path, rates="unit", measures=["late(3)"])
    assert found.code == 2
    assert found.text.endswith("; write an expression of rate(T), tokens(P), marked(P)")
