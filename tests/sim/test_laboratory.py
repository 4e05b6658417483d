"""The laboratory as a party: whole cycles, bus, camera, faults, services; and that it is
deterministic to the bit."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from petrobot.services.comm.lockstep.channels import images_wanted
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.codec import decode, encode
from petrobot.services.comm.protocol.messages import Executed, Outcome
from petrobot.services.host.numba_kernels import SWITCH
from petrobot.sim.catching.referee import MOST_ROWS
from petrobot.sim.catching.site import Site
from petrobot.sim.catching.thrower import ThrowOutcome, draw_throw
from petrobot.sim.catching.truth import Scatter
from petrobot.sim.laboratory_party import Exposures
from tests.sim.conftest import needs_bullet

REPOSITORY = Path(__file__).parents[2]
Bench = Any
"""Made by the fixture `bench` of conftest.py."""
Benches = Callable[..., Bench]
Digests = Callable[..., list[str]]


@pytest.mark.parametrize("regime", ["A", "B", "C"])
def test_the_oracles_poses_do_catch_in_the_whole_cell(
    bench: Benches, site: Site, regime: str
) -> None:
    """Drives, arm, cup and ball together: a catcher that knows the oracle's pose catches the balls
    that the oracle calls reachable."""
    here = bench(seed=11, regime=regime)
    here.enable()
    here.want_images(0.001)
    for n in range(1, 3):
        row = here.catch_one()
        assert (
            row["n"] == n
            and row["reachable"]
            and row["outcome"] == "caught"
            and row["miss_mm"] < 3.0
        )
        assert row["speed"] == draw_throw(11, n, site.cell, site.truth(regime)).speed
    assert here.master.emergencies == []


def test_the_digital_input_shows_the_ball(bench: Benches) -> None:
    here = bench(seed=11)
    here.enable()
    here.want_images(0.001)
    assert here.run(lambda: here.lab.world.course is not None, 3.0)
    here.master.move(here.now, here.lab.referee.last.pose.tolist())
    assert not here.master.inputs & 0x01 and here.master.inputs & 0x02
    assert here.run(lambda: here.lab.world.barrier, 6.0)
    assert here.run(lambda: bool(here.master.inputs & 0x01), 3 * TICK)


# Thrower


def test_nothing_is_thrown_without_images_or_away_from_home(bench: Benches) -> None:
    here = bench(seed=1)
    here.enable()
    here.wait(2.0)
    assert here.lab.world.course is None
    here.move([angle + 0.1 for angle in here.home])
    here.want_images(0.001)
    here.wait(2.0)
    assert here.lab.world.course is None
    here.move(here.home)
    assert here.run(lambda: here.lab.world.course is not None, 2.0)


# Camera


def test_images_come_at_their_rate_with_their_true_age(bench: Benches) -> None:
    here = bench(seed=1)
    here.want_images(50.0)
    here.wait(0.4)
    arrivals = [now for now, _ in here.images]
    assert np.diff(arrivals) == pytest.approx(0.02)
    exposed = [now - body["age"] for now, body in here.images]
    assert np.diff(exposed) == pytest.approx(0.02) and [
        b["sequence"] for _, b in here.images
    ] == list(range(len(exposed)))
    assert {round(body["age"], 6) for _, body in here.images} == {0.008}
    pixels = here.images[0][1]["pixels"]
    assert pixels.shape == (480, 640) and pixels.dtype == np.uint8 and pixels.std() > 10.0


@pytest.mark.parametrize(("regime", "age"), [("A+latency200", 0.208), ("A+latency400", 0.408)])
def test_latency_delays_images_and_is_part_of_their_age(
    bench: Benches, regime: str, age: float
) -> None:
    here = bench(seed=1, regime=regime)
    here.want_images(25.0)
    here.wait(0.6)
    assert here.images[0][0] == pytest.approx(age, abs=TICK + 1e-9)
    assert [body["age"] for _, body in here.images] == pytest.approx([age] * len(here.images))


def test_stated_ages_scatter_in_the_regime_of_scattered_ages(bench: Benches) -> None:
    here = bench(seed=1, regime="A+jitter")
    here.want_images(50.0)
    here.wait(4.0)
    errors = np.array([body["age"] - 0.008 for _, body in here.images])
    assert errors.std() == pytest.approx(0.003, rel=0.2) and abs(errors.mean()) < 0.001
    assert errors.min() >= -0.008 - 1e-9


def test_images_are_lost_in_the_regime_of_lost_images(bench: Benches) -> None:
    here = bench(seed=1, regime="A+dropped_images")
    here.want_images(50.0)
    here.wait(4.0)
    assert len(here.images) == pytest.approx(140, abs=25)


def test_frames_are_lost_in_the_regime_of_lost_frames(bench: Benches) -> None:
    here = bench(seed=1, regime="A")
    here.enable()
    here.lab.truth = replace(here.lab.truth, scatter=Scatter(frames_lost=0.3))
    begun = here.master.heard()
    here.wait(4.0)
    # An answer needs the SYNC (0.7) and its own transmission (0.7).
    assert (here.master.heard() - begun) / (1000 * 6) == pytest.approx(0.49, abs=0.04)


def brightening(here: Bench, ball: tuple[float, float, float], velocity: Any) -> Any:
    """Return by how much (grey levels) a ball changes the image around its centre."""
    camera = here.lab.camera()
    u, v, _ = (round(x) for x in camera.pixel(ball))
    window = slice(v - 30, v + 30), slice(u - 30, u + 30)
    return (camera.render(ball, velocity).astype(int) - camera.background)[window]


def test_a_bridge_hides_the_ball(bench: Benches) -> None:
    here = bench(seed=3, regime="B+occluded")
    seen = [
        (brightening(here, (x, 0.05, 0.62), (-1.0, 0.0, 0.0)) > 25).sum() for x in (1.6, 1.27, 0.9)
    ]
    assert seen[0] > 60 and seen[1] == 0 and seen[2] > 60


def test_a_blurred_ball_is_longer(bench: Benches) -> None:
    """3 m/s for 16 ms instead of 4 ms: 48 mm and 12 mm, in addition to the ball's own 40 mm."""
    lengths = []
    for regime in ("B", "B+blur"):
        change = brightening(bench(seed=3, regime=regime), (1.5, 0.0, 0.62), (-3.0, 0.0, 0.0))
        rows, columns = np.nonzero(change > 20)
        lengths.append(max(rows.std(), columns.std()))
    assert 1.3 < lengths[1] / lengths[0] < 2.0


def test_a_second_ball_rolls_with_half_of_the_balls(bench: Benches) -> None:
    here = bench(seed=3, regime="B+two_balls")
    seconds = [here.lab._throw_second(0.0, n) for n in range(1, 201)]
    assert sum(one is not None for one in seconds) == pytest.approx(100, abs=25)
    one = next(second for second in seconds if second is not None)
    times = [t for t in np.arange(0.0, 3.0, 0.02) if one.seen(float(t))]
    assert 0.7 < times[-1] - times[0] < 1.6  # 1.5 m at 1.5 to 2 m/s, and a fall
    (ball, velocity), *_ = one.seen(float(times[5]))
    image = here.lab.camera().render(None, others=[(ball, velocity)]).astype(int)
    u, v, _ = (round(x) for x in here.lab.camera().pixel(ball))
    assert image[v, u] - int(here.lab.camera().background[v, u]) > 25


def test_a_cup_of_another_size_changes_image_and_contact(bench: Benches) -> None:
    here = bench(seed=1, regime="A+cup50")
    assert here.lab.camera().cup_radius == here.lab.truth.cup.radius == 0.025


def test_a_new_request_drops_images_exposed_for_the_old_one(bench: Benches) -> None:
    here = bench(seed=1, regime="A+latency200")
    here.want_images(50.0)
    here.wait(0.1)
    here.post("control", "camera", images_wanted(50.0, 2))
    here.wait(0.3)
    assert {body["generation"] for _, body in here.images} == {2}
    here.post("control", "camera", images_wanted(0.0, 3))
    here.wait(0.05)
    count = len(here.images)
    here.wait(0.3)
    assert len(here.images) == count


def test_exposures_keep_their_clock_at_any_rate() -> None:
    exposures = Exposures()
    exposures.want(0.0, 30.0, 1)
    taken = [k * TICK for k in range(2500) if exposures.due(k * TICK)]
    assert len(taken) == pytest.approx(300, abs=1)
    assert max(abs(t - n / 30.0) for n, t in enumerate(taken)) < TICK + 1e-9


# Faults


def fault(here: Bench, kind: str, **arguments: object) -> None:
    assert here.call("laboratory_fault", kind=kind, **arguments).status == "success"


@pytest.mark.parametrize(
    ("kind", "share"), [("dead_camera", None), ("drop_images", 1.0), ("drop_images", 0.5)]
)
def test_images_fail_for_a_while(bench: Benches, kind: str, share: float | None) -> None:
    here = bench(seed=1)
    here.want_images(50.0)
    here.wait(0.1)
    count = len(here.images)
    fault(here, kind, duration=0.4, **({} if share is None else {"share": share}))
    here.wait(0.4)
    came = len(here.images) - count
    assert came <= 2 if share != 0.5 else 3 <= came <= 17
    here.wait(0.2)
    assert len(here.images) - count - came >= 9


def test_a_drive_fault_stops_its_drive_and_is_reported(bench: Benches) -> None:
    here = bench(seed=1)
    here.enable()
    fault(here, "drive_fault", joint=3, after=0.1)
    assert here.run(lambda: bool(here.master.status[2] & 0x08), 0.3)
    assert here.run(lambda: len(here.master.emergencies) == 1, 0.1)
    assert here.lab.plant.braked[2] and not here.lab.plant.braked[0]


def test_bus_off_silences_the_bus_both_ways(bench: Benches) -> None:
    here = bench(seed=1)
    here.enable()
    here.want_images(0.001)
    fault(here, "bus_off", duration=0.1)
    seen = here.master.position.copy()
    here.master.move(here.now, [angle + 0.05 for angle in here.home])
    here.wait(0.09)
    assert (here.master.position == seen).all()
    assert abs(here.lab.plant.q[0] - here.home[0]) < 0.01  # The set points did not arrive.


def test_frames_are_lost_at_the_configured_rate(bench: Benches) -> None:
    here = bench(seed=1)
    here.enable()
    fault(here, "can_errors", share=0.3)
    here.wait(0.02)
    heard = here.master.heard
    begun = heard()
    here.wait(4.0)
    # An answer needs the SYNC (0.7) and its own transmission (0.7).
    assert (heard() - begun) / (1000 * 6) == pytest.approx(0.49, abs=0.04)
    fault(here, "clear")
    here.wait(0.1)
    begun = heard()
    here.wait(0.2)
    assert heard() - begun == 50 * 6


def test_a_slow_arm_is_slow(bench: Benches) -> None:
    here = bench(seed=1)
    here.enable()
    fault(here, "slow_arm", factor=0.3)
    here.wait(0.02)
    here.master.move(here.now, [here.home[0] + 1.0, *here.home[1:]])
    fastest = 0.0
    for _ in range(200):
        here.step()
        fastest = max(fastest, abs(here.lab.plant.qd[0]))
    assert 0.1 < fastest < 0.36 * here.lab.plant.model.speed[0]


def test_arm_power_fails_and_returns(bench: Benches) -> None:
    here = bench(seed=1)
    here.enable()
    fault(here, "arm_power", duration=0.2)
    here.wait(0.1)
    assert all(here.lab.plant.braked) and not here.master.inputs & 0x02
    here.wait(0.2)
    assert here.master.inputs & 0x02
    assert here.run(lambda: here.master.enabled, 1.0)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"kind": "fire"}, "unknown fault 'fire'"),
        ({"kind": "drive_fault"}, "joint is missing"),
        ({"kind": "drive_fault", "joint": 7}, "from 1 to 6"),
        ({"kind": "drive_fault", "joint": 1.5}, "whole number"),
        ({"kind": "slow_arm", "factor": 0.0}, "from 0.05 to 1"),
        ({"kind": "dead_camera", "joint": 1}, "unknown key 'joint'"),
        ({"kind": "drop_images", "share": "half"}, "from 0 to 1, got 'half'"),
        ({}, "unknown fault ''"),
    ],
)
def test_an_invalid_fault_is_refused(
    bench: Benches, arguments: dict[str, object], says: str
) -> None:
    outcome = bench().call("laboratory_fault", **arguments)
    assert outcome.status == "error" and outcome.cause == "bad_arguments" and says in outcome.text
    assert outcome.executed is Executed.NO


# Services


@needs_bullet
def test_a_preparation_connects_no_physics_client(
    bench: Benches, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In real time the drives are silent as long as a preparation takes; with a new client that was
    40 ms at times, after which the arm's driver takes a drive for lost."""
    import pybullet

    here = bench()
    connected: list[int] = []
    monkeypatch.setattr(pybullet, "connect", connected.append)
    for regime in ("C+dim", "A@2"):
        assert here.call("laboratory_prepare", seed=5, regime=regime).status == "success"
    assert connected == []


def test_prepare_begins_a_new_experiment(bench: Benches) -> None:
    here = bench(seed=1, regime="A")
    here.enable()
    here.want_images(0.001)
    assert here.run(lambda: here.lab.world.course is not None, 3.0)
    answer = here.call("laboratory_prepare", seed=5, regime="C+dim", throws=1, runs=4)
    assert answer.status == "success"
    assert here.lab.world.course is None and here.call("laboratory_score").values["throws"] == []
    row = here.catch_one()
    assert 2.0 <= row["speed"] <= 2.5
    here.wait(2.0)
    assert here.lab.world.course is None  # one throw was asked for
    score = here.call("laboratory_score").values
    assert (score["seed"], score["regime"], score["over"], score["caught"]) == (5, "C+dim", 1, 1)
    course = score["courses"][0]
    assert (
        0.0 < course["exit_after"] < course["caught_after"] < course["ended_after"]
        and course["margin"] > 0.0
    )
    assert abs(course["exit_y"]) < 0.31 and 1.5 < course["exit_speed"] < 2.5


def test_every_ball_is_counted(bench: Benches) -> None:
    """One ball is caught, for one the arm does not move, and one is still rolling."""
    here = bench(seed=1)
    here.enable()
    here.want_images(0.001)
    row = here.catch_one()
    assert row["caught"]
    assert here.run(lambda: here.lab.world.course is not None, 3.0)
    assert here.run(lambda: here.lab.world.course is None, 8.0)
    assert here.run(lambda: here.lab.world.course is not None, 3.0)
    first, second, third = here.lab.referee.score(here.now)["courses"]
    cycles = [
        {
            "n": n,
            "begun_ago": here.now - course["released_after"] + 0.1,
            "ended_ago": here.now - course["released_after"] - 0.1,
            "status": "success",
        }
        for n, course in ((1, first), (2, second), (2, third))
    ]
    score = here.call("laboratory_score", cycles=cycles).values
    counts = {"thrown": 3, "over": 2, "caught": 1, "missed": 1, "never_seen": 1}
    assert {name: score[name] for name in counts} == counts
    assert score["balls"] == [
        {"run": 1, "n": 1, "thrown": 1, "over": 1, "caught": 1, "missed": 0, "never_seen": 0},
        {"run": 2, "n": 2, "thrown": 2, "over": 1, "caught": 0, "missed": 1, "never_seen": 1},
    ]


def test_the_score_of_many_throws_can_be_sent(bench: Benches) -> None:
    """All of them are counted; the newest are told in detail, as many as a message carries."""
    here = bench(seed=1)
    here.enable()
    here.want_images(0.001)
    here.catch_one()
    referee = here.lab.referee
    longest = [{"n": 1, "begun_ago": here.now, "ended_ago": 0.0, "status": "success"}]
    referee._entries *= MOST_ROWS + 200
    score = referee.score(here.now, longest)
    assert (score["thrown"], score["caught"], score["reachable_caught"]) == (MOST_ROWS + 200,) * 3
    assert len(score["throws"]) == len(score["courses"]) == MOST_ROWS
    assert score["rows_left_off"] == 200 and score["balls"][0]["thrown"] == MOST_ROWS
    score["balls"] = [{**score["balls"][0], "run": n} for n in range(MOST_ROWS)]
    sent = Outcome("score", "success", score, "", "", Executed.YES, 0.0, 0.0)
    assert decode(encode(sent)) == sent


def test_a_throw_has_the_status_of_its_cycle(bench: Benches) -> None:
    here = bench(seed=1)
    here.enable()
    here.want_images(0.001)
    here.catch_one()
    released = here.lab.referee.score(here.now)["courses"][0]["released_after"]
    ago = here.now - released
    cycles = [
        {"n": 1, "begun_ago": ago + 5.0, "ended_ago": ago + 1.0, "status": "failure", "cause": "x"},
        {"n": 2, "begun_ago": ago + 1.0, "ended_ago": ago - 1.0, "status": "success", "cause": ""},
    ]
    assert here.call("laboratory_score", cycles=cycles).values["throws"][0]["status"] == "success"
    assert here.call("laboratory_score").values["throws"][0]["status"] is None


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"regime": "Z"}, "must begin with"),
        ({"seed": -1}, "of 0 or more, got -1"),
        ({"seed": "one"}, "of 0 or more, got 'one'"),
        ({"throws": 1.5}, "or none, got 1.5"),
    ],
)
def test_an_invalid_preparation_is_refused(
    bench: Benches, arguments: dict[str, object], says: str
) -> None:
    outcome = bench().call("laboratory_prepare", **arguments)
    assert outcome.status == "error" and says in outcome.text


# Determinism


@pytest.mark.processes
def test_the_same_seed_gives_the_same_bits_here_and_in_new_processes(
    digests: Digests, physics: str
) -> None:
    """Frames, pixels and score are equal; also after the laboratory was prepared for another run,
    and with and without numba."""
    here = digests(3, "B+drift", physics)
    file = str(Path(__file__).with_name("conftest.py"))
    for compiled in ("0", "1"):
        there = subprocess.run(
            [sys.executable, file, "3", "B+drift", physics],
            capture_output=True,
            text=True,
            check=True,
            timeout=240,
            env={
                **os.environ,
                "PYTHONPATH": str(REPOSITORY),
                "PYTHONHASHSEED": "4711",
                SWITCH: compiled,
            },
        )
        assert there.stdout.split()[-2:] == here
    assert digests(3, "B+drift", physics, prepared_before=True) == here
    assert digests(4, "B+drift", physics) != here


def test_outcomes_have_readable_names() -> None:
    assert {str(outcome) for outcome in ThrowOutcome} == {"rolling", "caught", "missed", "dropped"}
