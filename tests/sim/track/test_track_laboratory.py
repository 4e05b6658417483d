"""The whole laboratory on the bench: a run, its services, faults, images, and the same seed
twice."""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petrobot.services.comm.location_file import load
from petrobot.services.comm.protocol.messages import Outcome
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.laboratory_party import SERVICES
from petrobot.sim.track.course import Track
from petrobot.sim.track.laboratory import TrackLaboratory, make_laboratory
from petrobot.sim.track.truth import TrackSite, read_track_site

Bench = Callable[..., Any]
REPOSITORY = Path(__file__).parents[3]
SERVICES_FILE = REPOSITORY / "services" / "mobile" / "track.services.toml"


# A run


def test_a_driver_that_knows_the_true_state_finishes(rover_bench: Bench) -> None:
    bench = rover_bench()
    assert (
        bench.call("laboratory_prepare", seed=5, regime="mixed", elements=9, interruptions=1).status
        == "success"
    )
    bench.enable()
    score = bench.follow(0.5)
    assert score["finished"]
    assert score["stopped_at_T"]
    assert score["penalties"] == []
    assert (score["interruptions"], score["recovered"]) == (1, 1)
    assert score["rms_mm"] < 8.0
    assert score["time_s"] == pytest.approx(score["length_m"] / 0.5, rel=0.1)
    assert score["track"] == Track.by_seed(5, 9, 1, "mixed").plain()
    assert json.loads(json.dumps(score)) == score


def test_a_new_experiment_puts_the_rover_back_and_keeps_the_drives(rover_bench: Bench) -> None:
    bench = rover_bench()
    bench.call("laboratory_prepare", seed=1, regime="plain")
    bench.enable()
    bench.follow(0.5, end=2.0)
    counted = bench.master.positions[0]
    assert counted > 15e6
    assert bench.call("laboratory_prepare", seed=2, regime="arcs+slip").status == "success"
    assert bench.master.enabled
    bench.wait(0.1)
    start = Track.by_seed(2, 14, 2, "arcs").start
    assert bench.lab.rover.pose == pytest.approx(start, abs=0.04)
    assert bench.lab.rover.pose != start  # it is put down by hand
    assert bench.master.positions[0] == counted
    score = bench.call("laboratory_score").values
    assert (score["time_s"], score["reached_m"], score["regime"]) == (0.0, 0.0, "arcs+slip")


def test_the_reflectors_in_view_are_reported(rover_bench: Bench) -> None:
    bench = rover_bench()
    bench.call("laboratory_prepare", seed=7, regime="straight", elements=10, interruptions=1)
    bench.enable()
    gap = bench.lab.track.gaps[0]
    bench.follow(0.5, end=gap.start - 0.5)
    bench.master.echoes.clear()
    bench.wait(4.0)
    x, y, heading = bench.lab.rover.pose
    ahead = (gap.x - x) * math.cos(heading) + (gap.y - y) * math.sin(heading) - 0.1
    aside = (gap.y - y) * math.cos(heading) - (gap.x - x) * math.sin(heading)
    told = [row[0] for row in bench.master.echoes if row]
    assert len(told) > 90  # a few are missing
    bearing, distance = np.median(np.array(told), axis=0)
    assert bearing == pytest.approx(math.atan2(aside, ahead), abs=0.015)
    assert distance == pytest.approx(math.hypot(ahead, aside, 0.3), abs=0.04)


def test_reflectors_that_have_fallen_give_no_echo(rover_bench: Bench) -> None:
    bench = rover_bench()
    there = []
    for seed in range(60):
        bench.call("laboratory_prepare", seed=seed, regime="arcs+fallen")
        crossings = bench.call("laboratory_score").values["crossings"]
        there += [each["reflector"] for each in crossings]
        assert len(bench.lab._reflectors) == sum(each["reflector"] for each in crossings)
    assert sum(there) / len(there) == pytest.approx(0.3, abs=0.12)
    bench.call("laboratory_prepare", seed=1, regime="arcs")
    assert all(each["reflector"] for each in bench.call("laboratory_score").values["crossings"])


# Images


def test_images_come_at_their_rate_with_their_age(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain", seed=1)
    bench.want_images(25.0)
    bench.wait(2.0)
    assert len(bench.images) == pytest.approx(50, abs=1)
    assert all(0.008 <= body["age"] <= 0.013 for _, body in bench.images)
    assert {body["pixels"].shape for _, body in bench.images} == {(120, 160)}
    count = len(bench.images)
    bench.want_images(0.0)
    bench.wait(1.0)
    assert len(bench.images) <= count + 1


def test_the_image_shows_the_track_ahead(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain", seed=1)
    pixels = bench.lab.picture(bench.now).astype(float)
    row = pixels[100]
    middle = row[78:82].mean()
    assert abs(middle - row[20:40].mean()) > 100.0
    assert row[20:40].std() < 6.0


# Regimes and services


@pytest.mark.parametrize("speed", [0, 0.0, -0.5, 1.3, 5, "fast", float("nan")])
def test_a_speed_beyond_the_wheels_is_refused_with_the_possible_range(
    rover_bench: Bench, speed: object
) -> None:
    ended = rover_bench().call("laboratory_prepare", seed=1, regime="plain", speed=speed)
    assert ended.status == "error" and "speed" in ended.text and "1.2 m/s" in ended.text


@pytest.mark.parametrize("speed", [1, 0.05, 1.2])
def test_a_speed_within_the_range_of_the_wheels_is_accepted(
    rover_bench: Bench, speed: float
) -> None:
    assert (
        rover_bench().call("laboratory_prepare", seed=1, regime="plain", speed=speed).status
        == "success"
    )


def test_every_regime_and_every_disturbance_can_be_prepared(
    track_site: TrackSite, rover_bench: Bench
) -> None:
    bench = rover_bench()
    for regime in track_site.settings["regimes"]:
        assert bench.call("laboratory_prepare", seed=3, regime=regime).status == "success"
        assert bench.lab.truth.regime == regime
    nominal = bench.lab.truth
    for name in track_site.settings["disturbances"]:
        assert bench.call("laboratory_prepare", seed=3, regime=f"arcs+{name}").status == "success"
        assert bench.lab.truth != nominal
    everything = "+".join(["mixed", *track_site.settings["disturbances"]])
    assert bench.call("laboratory_prepare", seed=3, regime=everything).status == "success"


def test_interruptions_are_of_the_regimes_kind(rover_bench: Bench) -> None:
    bench = rover_bench()
    for regime, letters in (("straight", "S"), ("arcs", "LR"), ("plain", "")):
        bench.call("laboratory_prepare", seed=4, regime=regime)
        replaced = {element.kind for element in bench.lab.track.elements if not element.painted}
        assert all(kind in letters for kind in replaced)
        assert bool(replaced) is bool(letters)
    bench.call("laboratory_prepare", seed=4, regime="contest")
    assert bench.lab.track.plain() == Track.contest().plain()


@pytest.mark.parametrize(
    ("service", "arguments", "text"),
    [
        ("laboratory_prepare", {"regime": "loops"}, "'loops'"),
        ("laboratory_prepare", {"regime": "arcs+fog"}, "'fog'"),
        ("laboratory_prepare", {"seed": -1}, "of 0 or more, got -1"),
        ("laboratory_prepare", {"seed": 1.5}, "of 0 or more, got 1.5"),
        ("laboratory_prepare", {"elements": "many"}, "or none, got 'many'"),
        ("laboratory_prepare", {"elements": 3}, "3 elements"),
        ("laboratory_prepare", {"interruptions": 9}, "9 interruptions"),
        ("laboratory_fault", {"kind": "rain"}, "'rain'"),
        ("laboratory_fault", {"kind": "drive_fault"}, "joint is missing"),
        ("laboratory_fault", {"kind": "drive_fault", "joint": 3}, "from 1 to 2"),
        ("laboratory_fault", {"kind": "dead_sensor", "share": 0.5}, "unknown key 'share'"),
    ],
)
def test_invalid_requests_are_refused_and_change_nothing(
    rover_bench: Bench, service: str, arguments: dict[str, Any], text: str
) -> None:
    bench = rover_bench(seed=8)
    track = bench.lab.track
    answer: Outcome = bench.call(service, **arguments)
    assert (answer.status, answer.cause, str(answer.executed)) == ("error", "bad_arguments", "no")
    assert text in answer.text
    assert bench.lab.track is track


def test_a_file_without_its_numbers_is_refused(tmp_path: Path) -> None:
    rover = tmp_path / "rover.toml"
    rover.write_text("[rover]\nwheel_radius = 0.1\n")
    with pytest.raises(LaboratoryError, match=r"rover\.toml.*is missing"):
        read_track_site(rover).truth("plain")
    with pytest.raises(LaboratoryError, match="cannot be read"):
        read_track_site(tmp_path / "none.toml")


# Faults


def prepared(rover_bench: Bench) -> Any:
    bench = rover_bench(seed=1, regime="plain")
    bench.enable()
    bench.want_images(25.0)
    bench.wait(0.2)
    return bench


@pytest.mark.parametrize("kind", ["dead_camera", "drop_images"])
def test_images_stop_and_return(rover_bench: Bench, kind: str) -> None:
    bench = prepared(rover_bench)
    bench.call("laboratory_fault", kind=kind, duration=1.0)
    bench.wait(0.1)
    count = len(bench.images)
    bench.wait(0.8)
    assert len(bench.images) == count
    bench.wait(1.0)
    assert len(bench.images) > count + 15


def test_a_dead_sensor_is_silent(rover_bench: Bench) -> None:
    bench = prepared(rover_bench)
    bench.call("laboratory_fault", kind="dead_sensor", duration=1.0)
    bench.wait(0.05)
    count = len(bench.master.echoes)
    bench.wait(0.8)
    assert len(bench.master.echoes) == count
    bench.wait(1.0)
    assert len(bench.master.echoes) > count + 15


@pytest.mark.parametrize(
    ("kind", "arguments"), [("drive_fault", {"joint": 2}), ("power", {"duration": 5.0})]
)
def test_the_rover_stops_by_itself(
    rover_bench: Bench, kind: str, arguments: dict[str, Any]
) -> None:
    bench = prepared(rover_bench)
    bench.drive(0.5, 0.0)
    bench.wait(1.0)
    bench.call("laboratory_fault", kind=kind, **arguments)
    bench.wait(0.06)
    wheel = bench.lab.rover.wheels[1]
    assert wheel.braked
    assert any(node == 2 for node, _ in bench.master.emergencies)


def test_a_bus_that_is_off_lets_the_drives_stop(rover_bench: Bench) -> None:
    bench = prepared(rover_bench)
    bench.drive(0.5, 0.0)
    bench.wait(1.0)
    bench.call("laboratory_fault", kind="bus_off", duration=1.5)
    bench.wait(1.0)
    assert bench.lab.rover.standing
    bench.call("laboratory_fault", kind="clear")
    assert bench.run(lambda: bench.lab.rover.speed > 0.4, 2.0)


def test_a_rover_that_leaves_the_board_gets_no_power_before_the_next_experiment(
    rover_bench: Bench,
) -> None:
    bench = prepared(rover_bench)
    rover = bench.lab.rover
    rover.x, rover.y, rover.heading = 16.5, 8.0, 0.0
    bench.drive(0.5, 0.0)
    assert bench.run(lambda: bool(rover.wheels[0].braked), 3.0)
    assert rover.x < 17.1
    bench.wait(0.5)  # the bench's master tries to reset the fault
    assert rover.standing
    assert not bench.master.enabled
    assert [each["kind"] for each in bench.call("laboratory_score").values["penalties"]][
        -1
    ] == "left_board"
    bench.call("laboratory_prepare", seed=1)
    assert bench.run(lambda: bench.master.enabled, 1.0)


def test_every_fault_can_be_requested(rover_bench: Bench) -> None:
    bench = prepared(rover_bench)
    for kind, keys in TrackLaboratory.fault_kinds.keys.items():
        arguments = {"joint": 1} if "joint" in keys else {}
        assert (
            bench.call("laboratory_fault", kind=kind, after=100.0, **arguments).status == "success"
        )


# The same seed


def digest(rover_bench: Bench, seed: int, prepare_first: bool) -> str:
    bench = (
        rover_bench(seed=99)
        if prepare_first
        else rover_bench(seed=seed, regime="mixed+flash+slip+blind")
    )
    if prepare_first:
        bench.enable()
    bench.call("laboratory_prepare", seed=seed, regime="mixed+flash+slip+blind")
    bench.enable()
    bench.want_images(25.0)
    score = bench.follow(0.5, end=5.0)
    told = hashlib.sha256(
        json.dumps([score["path"][-5:], score["rms_mm"], bench.master.echoes[-20:]]).encode()
    )
    for _, body in bench.images[-20:]:
        told.update(body["pixels"].tobytes())
    return told.hexdigest()


def test_a_seed_gives_one_run(rover_bench: Bench) -> None:
    assert digest(rover_bench, 3, False) == digest(rover_bench, 3, False)
    assert digest(rover_bench, 3, False) != digest(rover_bench, 4, False)


@pytest.mark.processes
def test_a_seed_gives_one_run_in_another_process(rover_bench: Bench) -> None:
    program = (
        "import json, sys\n"
        "from pathlib import Path\n"
        "from petrobot.sim.track.truth import read_track_site\n"
        "from petrobot.sim.track.laboratory import TrackLaboratory\n"
        "lab = TrackLaboratory('l', read_track_site(Path(sys.argv[1])), str, seed=3, "
        "regime='arcs+flash')\n"
        "print([int(lab.picture(t * 0.04).astype(int).sum()) for t in range(20)], "
        "lab.track.plain())\n"
    )
    rover = str(REPOSITORY / "services" / "mobile" / "rover.toml")
    told = subprocess.run(
        [sys.executable, "-c", program, rover],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
        timeout=240,
    ).stdout
    lab = TrackLaboratory("l", read_track_site(Path(rover)), str, seed=3, regime="arcs+flash")
    assert (
        told.strip() == f"{[int(lab.picture(t * 0.04).astype(int).sum()) for t in range(20)]} "
        f"{lab.track.plain()}"
    )


# The location file


def test_the_location_file_makes_the_laboratory() -> None:
    directory = load(SERVICES_FILE)
    assert directory.laboratory() == "laboratory"
    made = make_laboratory(directory, "laboratory")
    assert isinstance(made, TrackLaboratory)
    assert {directory.where(service) for service in SERVICES} == {"laboratory"}
    assert set(directory.nodes) == {"laboratory", "vision", "drive"}
