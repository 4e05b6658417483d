"""The laboratory as a party: parts of a seed, images, the referee's verdicts, a tray that is
changed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.picking.gripper import ToolPose
from petrobot.sim.picking.laboratory import EXCHANGE, PickingLaboratory, Referee
from petrobot.sim.picking.parts import contact
from petrobot.sim.picking.world import PickingWorld
from tests.sim.picking.bench import FINGERS, camera, cube, puck, scene, site

AWAY = ToolPose(0.1, 0.0, 0.2, 0.0, 0.0)


@pytest.mark.parametrize("regime", ["plain", "many", "plain+crowded"])
def test_parts_of_a_seed_lie_apart_where_they_are_looked_for(regime: str) -> None:
    shipped = site()
    truth = shipped.truth(regime)
    for seed in range(5):
        parts = shipped.parts(truth, np.random.default_rng(seed))
        again = shipped.parts(truth, np.random.default_rng(seed))
        assert [p.outline() for p in parts] == [p.outline() for p in again]
        assert len(parts) == truth.parts
        (x0, x1), (y0, y1) = shipped.cell["parts"]["x"], shipped.cell["parts"]["y"]
        assert all(x0 <= p.x <= x1 and y0 <= p.y <= y1 for p in parts)
        pairs = [(a, b) for a in parts for b in parts if a.number < b.number]
        assert all(contact(a.outline(), b.outline()) is None for a, b in pairs)


def test_another_seed_gives_other_parts_and_too_many_are_refused() -> None:
    assert scene(1)[0][0].x != scene(2)[0][0].x
    shipped = site()
    with pytest.raises(LaboratoryError, match="500 do not fit"):
        shipped.parts(shipped.truth("plain"), np.random.default_rng(0), 500)


@pytest.mark.parametrize(
    ("regime", "text"),
    [
        ("nonsense", "must begin with one of plain"),
        ("plain+fog", "unknown disturbance 'fog'"),
        ("plain+shadow+person", "shadow and person both set darkness"),
    ],
)
def test_an_impossible_regime_is_refused_with_the_possible_ones(regime: str, text: str) -> None:
    with pytest.raises(LaboratoryError, match=text):
        site().truth(regime)


def test_the_top_of_a_part_is_where_the_camera_projects_it() -> None:
    part, light = cube(0.16, 0.03), site().truth("plain").light(1.0)
    image = camera().take([part], [], 0.02, light, np.random.default_rng(0))
    (u, v), *_ = camera().mount.pixels([(part.x, part.y, part.top)])
    bright = np.argwhere(image > 180).mean(axis=0)
    assert math.dist(bright, (v, u)) < 0.6


@pytest.mark.parametrize("arm", ["so101", "ur5e"])
def test_a_laboratory_is_at_rest_until_it_is_moved_and_is_repeatable(arm: str) -> None:
    scores = []
    for _ in range(2):
        laboratory = PickingLaboratory("laboratory", site(arm), lambda name: name)
        laboratory.serve("laboratory_prepare", {"seed": 3, "regime": "plain"})
        rest = laboratory.arm.tool(laboratory.controller.joints())
        for k in range(50):
            laboratory.tick(k * 0.004)
        assert math.dist(rest, laboratory.arm.tool(laboratory.controller.joints())) < 2e-3
        score = laboratory.serve("laboratory_score", {})
        assert score["on_table"] == score["parts"] == 5 and score["grips"] == 0
        scores.append((score, laboratory.picture().tobytes()))
    assert scores[0] == scores[1]


def world_with(*places: tuple[float, float]) -> PickingWorld:
    """Cubes at these places on the shipped table."""
    parts = [cube(x, y) for x, y in places]
    for number, part in enumerate(parts):
        part.number = number
    return PickingWorld(site().table, FINGERS, parts, np.random.default_rng(0))


def watched(world: PickingWorld, seconds: float, pose: ToolPose = AWAY) -> Referee:
    """A referee that has watched for so long."""
    referee = Referee(world, site().trays, site().belongs, 0.0)
    for k in range(round(seconds / 0.02)):
        referee.watch(k * 0.02, pose)
    return referee


def test_the_referee_tells_trays_apart_and_counts_what_is_lost() -> None:
    slots = {name: tray["slots"] for name, tray in site().trays.items()}
    right, wrong = slots["boxes"][0], slots["rounds"][0]
    world = world_with(tuple(right), tuple(wrong), (0.15, 0.0), (0.9, 0.0))
    world.parts[3].lost = True
    score = watched(world, 0.1).score(0.1, [])
    assert [score[k] for k in ("in_tray", "wrong_tray", "on_table", "lost")] == [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("place", "status", "cause"),
    [
        ("boxes", "success", ""),
        ("rounds", "failure", "wrong_tray"),
        ("table", "failure", "not_in_tray"),
    ],
)
def test_placing_is_judged_by_the_position_of_the_part(place: str, status: str, cause: str) -> None:
    trays = site().trays
    at = tuple(trays[place]["slots"][0]) if place in trays else (0.15, 0.0)
    world = world_with((0.15, 0.05))
    referee = watched(world, 0.1)
    world.parts[0].x, world.parts[0].y = at
    for k in range(5, 50):
        referee.watch(k * 0.02, AWAY)
    cycle = {"begun_ago": 1.0, "ended_ago": 0.0, "provisional": [{"run": "r", "place": "p"}]}
    verdict = referee.score(1.0, [cycle])["verdicts"]["r"]
    assert (verdict["status"], verdict["cause"]) == (status, cause)


@pytest.mark.parametrize("near", [False, True])
def test_a_full_tray_is_changed_once_the_fingers_are_away(near: bool) -> None:
    tray = site().trays["boxes"]
    world = world_with(*(tuple(slot) for slot in tray["slots"]))
    x, y = tray["position"]
    pose = ToolPose(x, y, 0.1, 0.0, 0.0) if near else AWAY
    referee = watched(world, EXCHANGE + 0.2, pose)
    assert len(world.parts) == (4 if near else 0)
    score = referee.score(4.0, [])
    assert score["in_tray"] == 4 and score["trays_changed"] == (0 if near else 1)


def test_a_round_part_rolls_farther_than_a_box() -> None:
    ways = []
    for part in (cube(0.1, 0.0), puck(0.1, 0.0)):
        part.z = 0.05
        world = PickingWorld(site().table, FINGERS, [part], np.random.default_rng(4))
        world._fall(part, None)
        ways.append(math.hypot(part.x - 0.1, part.y))
    assert 0.0 < ways[0] < ways[1]
