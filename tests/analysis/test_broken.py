"""Mistakes of designers are found, with a witness that replays and a picture, in every shipped
task."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import pytest
from msgspec.structs import replace

from petrobot.coordinator.analysis.may_run import BUDGET, may_run
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.analyse import draw_witnesses, refused
from petrobot.coordinator.cli.loading import load_directory
from petrobot.coordinator.drawing import Overlay, draw
from petrobot.coordinator.operator.task_check import cell_of
from petrobot.coordinator.task import Kind, Task
from petrobot.coordinator.task.file import dumps, load
from petrobot.coordinator.task.net import Net
from tests.analysis.broken import TASKS, VARIANTS, damaged, judged
from tests.analysis.random_nets import brute_force
from tests.waiting import Limit

SHIPPED = sorted(TASKS.glob("*.toml"))
EXPECTED = {
    "missing_recovery": {"deadlock_free", "returned"},
    "double_resource": {"one_run_each", "deadlock_free"},
    "leaking_token": {"one_run_each", "deadlock_free"},
}
"""Verdicts of which each broken variant refutes at least one: two runs at once, an end that is
never reached, or a resource that is not returned."""


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_tasks_are_sound(path: Path) -> None:
    """Nothing speaks against running the shipped tasks. Verdicts that do not hold would hold if the
    operator repaired what `final_error` leaves. Every error exit returns to the nominal flow."""
    found = judged(load(path))
    assert found.ok and found.progress is not None
    again = found.progress.mended
    verdicts = {
        name: verdict.holds or (name in again and again[name].holds)
        for name, verdict in found.verdicts().items()
        if name != "safe"
    }
    assert all(verdicts.values()), verdicts
    for recovery in found.progress.recoveries:
        assert recovery.possible.holds or recovery.kappa == -1, recovery.error_exit


def replayed(task: Task, firings: Sequence[str]) -> dict[str, int]:
    """Return the marked places after the firings."""
    *_, last = task.net.replay(firings) if firings else (task.net.initial,)
    return {p: n for p, n in zip(task.net.places, last, strict=True) if n}


@pytest.mark.once
@pytest.mark.parametrize("kind", VARIANTS)
@pytest.mark.parametrize("name", ["catch_ball", "follow_track"])
def test_broken_variants_are_caught(name: str, kind: str, tmp_path: Path) -> None:
    """Each variant has a witness that the net replays, and a picture that shows where it leads."""
    task = VARIANTS[kind](load(TASKS / f"{name}.toml"))
    found = judged(task, steps=10_000)  # what is wrong shows early
    assert not found.ok
    bad = dict(refused(found))
    against = next(verdict for verdict in bad if verdict in EXPECTED[kind])
    verdict = bad[against]
    assert verdict.witness is not None
    assert replayed(task, verdict.witness.firings) == verdict.witness.marking
    made = {p.stem: p for p in draw_witnesses(found, task, tmp_path)}
    root = ElementTree.fromstring(made[f"{task.name}-{against}"].read_text(encoding="utf-8"))
    texts = [e.text or "" for e in root.iter() if e.get("class") == "turn"]
    turns = sorted(
        int(turn) for text in texts for turn in text.replace("…", "").split(",") if turn.strip()
    )
    assert turns and turns[-1] == len(verdict.witness.firings)


def carried(task: Task) -> Task:
    """A shipped task that finds its own location file from any folder."""
    return replace(task, services=str((TASKS / task.services).resolve())) if task.services else task


def faults_by_brute_force(task: Task) -> set[str]:
    """Return the faults of a task, found by checking its markings one by one."""
    found = brute_force(task.net, 5000)
    if found is None:
        return {"bounded"}
    order, edges = found
    names, view = task.net.places, OrdinaryView(task)
    out, good = set[str](), {i for i, m in enumerate(order) if view.is_end(m)}
    busy = {i for i, _, _ in edges}
    out |= {"sound"} if good & busy else set()
    ended, before = good.copy(), {j: set[int]() for j in range(len(order))}
    for i, _, j in edges:
        before[j].add(i)
    limit = Limit("the last predecessor", steps=len(order) + 1)
    while good and limit.left():
        good = set().union(*(before[j] for j in good)) - ended
        ended |= good
    out |= {"sound"} if len(ended) < len(order) else set()
    single = [
        p.name for p in task.flat.places.values() if p.kind is Kind.ACTION and p.servers is None
    ]
    out |= {"one_run_each"} if any(m[names.index(p)] > 1 for m in order for p in single) else set()
    resources = [names.index(p.name) for p in task.flat.places.values() if p.kind is Kind.RESOURCE]
    ends = [m for m in order if view.is_final(m)]
    return out | (
        {"returned"} if any(m[p] != order[0][p] for m in ends for p in resources) else set()
    )


SAMPLE = {"catch_ball": (10, 18, 5_000), "follow_track": (9, 40, 20_000)}
"""How many of a task's single mistakes, the step from one to the next, and the stimuli and firings
that a graph of it may have. A harmless mistake needs no more, which the test checks; a graph of
another one may have many times as many states. The rover's graphs are larger."""


def sample(name: str) -> list[tuple[str, Task]]:
    """Return a sample of all single mistakes in a shipped task."""
    count, step, _ = SAMPLE[name]
    found = list(damaged(carried(load(TASKS / f"{name}.toml"))))[::step]
    assert len(found) == count
    return found


@pytest.mark.once
@pytest.mark.parametrize(
    ("name", "number"), [(name, i) for name, (count, *_) in SAMPLE.items() for i in range(count)]
)
def test_single_mistakes_are_refused_if_they_matter(name: str, number: int) -> None:
    """The analysis refuses what deadlocks or leaks, and its witness replays."""
    what, task = sample(name)[number]
    wrong = faults_by_brute_force(task)
    cell = cell_of(load_directory(Path(task.services))) if task.services else None
    answer = may_run(task, cell, replace(BUDGET, steps=SAMPLE[name][2]))
    # "sound" of the ordinary net also asks that nothing is enabled at an end; the engine ends
    # when it rests there, whatever a later event or time would have enabled.
    assert not answer.ok or wrong <= {"sound"}, (what, wrong)
    if answer.analysis is None:  # the file itself is inconsistent
        return
    if answer.ok:
        assert answer.analysis.progress is not None and answer.analysis.progress.x.complete
    objections = answer.analysis.objections
    if wrong != {"bounded"} or answer.analysis.qualitative.space.complete:
        # The ordinary net forgets how runs ended and where the engine rests: it sees fewer dead
        # ends, and takes markings for ends that satisfy `final` only in passing.
        refused_for = set(objections) - {"deadlock_free"}
        assert refused_for ^ wrong <= {"sound", "returned"}, what
    for verdict in objections.values():
        assert verdict.witness is not None
        assert replayed(task, verdict.witness.firings) == verdict.witness.marking, what


@pytest.mark.parametrize("name", SAMPLE)
def test_the_sample_holds_mistakes_that_matter_and_others(name: str) -> None:
    """Else the test above would show nothing."""
    matter = [bool(faults_by_brute_force(task)) for _, task in sample(name)]
    assert matter.count(True) >= 5 and matter.count(False) >= 1


@pytest.mark.processes
def test_a_task_that_loops_and_never_ends_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """No deadlock and no extra token, but the rover's stop can fail for ever: no end can be
    reached."""
    task = carried(load(TASKS / "follow_track.toml"))
    lost = task.transitions["stop_failed"]
    outputs = tuple(
        replace(o, place="camera_idle") if o.place == "trouble" else o for o in lost.outputs
    )
    path = tmp_path / "round.toml"
    path.write_text(
        dumps(
            replace(
                task, transitions={**task.transitions, lost.name: replace(lost, outputs=outputs)}
            )
        )
    )
    assert main(["check", str(path)]) == 2
    told = capsys.readouterr().out
    step = "stop_at_t ends in error -> stop_failed"
    assert f"`final` cannot be reached any more after: {step}\n" in told and "not sound" in told


@pytest.mark.processes
def test_check_refuses_and_analyse_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`petrobot check` refuses a broken file, `petrobot analyse --pictures` shows why."""
    path = tmp_path / "twice.toml"
    path.write_text(
        dumps(VARIANTS["leaking_token"](load(TASKS / "catch_ball.toml"))), encoding="utf-8"
    )
    assert main(["check", str(path)]) == 2
    assert "may not run" in capsys.readouterr().out
    assert main(["analyse", str(path), "--pictures", str(tmp_path / "why")]) == 1
    assert "entered while its run is still there" in capsys.readouterr().out
    assert (tmp_path / "why" / "catch_ball-one_run_each.svg").exists()


@pytest.mark.processes
def test_check_writes_witnesses_that_replay(tmp_path: Path) -> None:
    """In the JSON of `petrobot check`."""
    path, found = tmp_path / "lost.toml", tmp_path / "found.json"
    task = VARIANTS["missing_recovery"](load(TASKS / "catch_ball.toml"))
    path.write_text(dumps(task), encoding="utf-8")
    assert main(["check", str(path), "--json", str(found)]) == 2
    objections = json.loads(found.read_text(encoding="utf-8"))["objections"]
    assert set(objections) & EXPECTED["missing_recovery"]
    for verdict in objections.values():
        assert replayed(task, verdict["witness"]["firings"]) == verdict["witness"]["marking"]


def test_an_overlay_colours_and_numbers() -> None:
    """A halo for each place with heat, firing numbers beside transitions, a legend at the
    bottom."""
    net = Net.build({"a": 1, "b": 0}, {"t": ({"a": 1}, {"b": 1}), "u": ({"b": 1}, {"a": 1})})
    svg = draw(net, overlay=Overlay(heat={"a": 0.25}, path=("t", "u", "t"), legend="what it means"))
    root = ElementTree.fromstring(svg)
    assert [e.get("fill-opacity") for e in root.iter() if e.get("class") == "warm"] == ["0.27"]
    assert {e.text for e in root.iter() if e.get("class") == "turn"} == {"1, 3", "2"}
    assert any(e.text == "what it means" for e in root.iter())
    assert "warm" not in {e.get("class") for e in ElementTree.fromstring(draw(net)).iter()}
