"""The drawing of the stochastic view shows a duration as one place and one box."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import pytest
from msgspec.structs import replace

from petrobot.coordinator.analysis.formats.netfile import NetFile
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.stochastic import StochasticView, stochastic_view
from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.drawing.layout import COLUMN, ROW
from petrobot.coordinator.drawing.scene import scene_of_net, scene_of_task
from petrobot.coordinator.studies.report.gspn_picture import blocks_of, folded_chains, gspn_svg
from petrobot.coordinator.task import Estimate, Status
from petrobot.coordinator.task.file import load
from petrobot.coordinator.task.net import Net


@pytest.fixture(scope="module")
def view() -> StochasticView:
    return stochastic_view(load_task("catch_ball"))


def weights(gspn: Gspn) -> dict[str, float]:
    """Return the weights of the choices in each place that one immediate transition after another
    may empty, without those that remove a preempted run."""
    found: dict[str, float] = {}
    for t, name in enumerate(gspn.net.transitions):
        if gspn.rate[t] is None and len(gspn.net.consume[t]) == 1 and "flush" not in name:
            place = gspn.net.places[gspn.net.consume[t][0][0]]
            found[place] = found.get(place, 0.0) + gspn.weight[t]
    return found


def test_chains_are_one_place_and_choices_stay(view: StochasticView) -> None:
    gspn, names = folded_chains(view.gspn, view.chains)
    chains = set(view.chains.values())
    assert set(gspn.net.places) == (set(view.gspn.net.places) - set(view.chains)) | chains
    assert set(names.values()) <= set(view.gspn.net.transitions)
    assert weights(gspn) == pytest.approx(weights(view.gspn)) and len(weights(gspn)) > 10
    drawn = set(names.values())
    assert set(view.origin) <= drawn
    assert {view.statuses[name] for name in drawn & set(view.statuses)} == set(
        view.statuses.values()
    )


def test_a_duration_says_its_phases(view: StochasticView) -> None:
    drawn = gspn_svg(view, "Assumed: nothing.")
    assert "8 phases of" in drawn and "locate_ball.success.0a" in drawn
    assert "locate_ball.success.0a1" not in drawn


def test_a_task_with_a_subnet_is_drawn_with_it_open() -> None:
    porter = load(Path(__file__).parents[3] / "examples" / "porter" / "deliver.toml")
    known = {status: Estimate(1 / 3, 1.0) for status in Status}
    primitives = {n: replace(p, estimates=known) for n, p in porter.primitive_tasks.items()}
    drawn = gspn_svg(stochastic_view(replace(porter, primitive_tasks=primitives)), "")
    for name in ("fetch.drive.going", "fetch.watch.begin", "carry.drive.success", "grasp.begin"):
        assert f'id="{name}"' in drawn, name


def test_it_is_laid_out_as_the_task(view: StochasticView) -> None:
    """What stands for one action place is together; the places lie as in the task's drawing."""
    folded, names = folded_chains(view.gspn, view.chains)
    model, _ = NetFile(folded.net).with_names(
        re.compile(".+")
    )  # no place is called as a transition
    new = dict(zip(model.net.transitions, folded.net.transitions, strict=True))
    origins = {t: view.origin.get(names[old], "") for t, old in new.items()}
    blocks = blocks_of(model.net, origins, view.task)
    assert blocks.of["track_ball.predict_kalman.success"] == "track_ball"
    assert {blocks.of[name] for name in ("in_place 1", "in_place 2")} == {"in_place"}
    scene = scene_of_net(model.net, None, None, None, blocks)
    boxes = dict[str, tuple[float, float, float, float]]()
    for name, block in blocks.of.items():
        x, y = scene.nodes[name].at
        left, top, right, bottom = boxes.get(block, (x, y, x, y))
        boxes[block] = min(x, left), min(y, top), max(x, right), max(y, bottom)
    for (a, one), (b, other) in combinations(boxes.items(), 2):
        beside = one[2] < other[0] or other[2] < one[0] or one[3] < other[1] or other[3] < one[1]
        assert beside, (a, b)
    task = scene_of_task(view.task, True, None, None).nodes
    for a, b in combinations(set(task) & set(boxes), 2):
        for axis, least in ((0, COLUMN), (1, ROW)):
            if task[b].at[axis] - task[a].at[axis] > least:
                centre = [sum(boxes[block][axis::2]) for block in (a, b)]
                assert centre[0] < centre[1], (a, b)


def test_entries_at_several_phases_are_one_and_other_nets_stay_as_they_are() -> None:
    """A run enters at the first phase with weight .25, at the second with .75."""
    net = Net.build(
        {"begin": 1, "d1": 0, "d2": 0, "end": 0},
        {
            "in.1": ({"begin": 1}, {"d1": 1}),
            "in.2": ({"begin": 1}, {"d2": 1}),
            "d1": ({"d1": 1}, {"d2": 1}),
            "d2": ({"d2": 1}, {"end": 1}),
            "flush d1": ({"d1": 1, "end": 1}, {}),
            "flush d2": ({"d2": 1, "end": 1}, {}),
        },
        priority={"in.1": 1, "in.2": 1, "flush d1": 1, "flush d2": 1},
    )
    gspn = Gspn.of(net, {"d1": 2.0, "d2": 2.0}, weights={"in.1": 0.25, "in.2": 0.75})
    folded, names = folded_chains(gspn, {"d1": "d", "d2": "d"})
    assert folded.net.places == ("begin", "d", "end")
    assert names == {"in.1": "in.1", "d": "d2", "flush d": "flush d1"}
    assert folded.weight == (1.0, 1.0, 1.0) and folded.rate == (None, 2.0, None)
    plain, same = folded_chains(gspn, {})
    assert plain == replace(gspn, net=plain.net) and list(same) == list(net.transitions)
