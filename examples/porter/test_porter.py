"""Tests of the porter without a robot, in simulated time."""

from pathlib import Path

from porter import Base, drive_careful, watch

from petrobot import check_driver, rehearse, rehearse_task


def test_the_base_keeps_the_rules_of_drivers():
    there_and_back = [{"to": "shelf"}, {"to": "dock"}]
    assert check_driver(Base, there_and_back, simulated=True).faults == []


def test_it_drives_slowly_while_nobody_watches():
    played = rehearse(drive_careful, device=Base({"blind": 0.2}, None), to="shelf")
    assert played.result.status == "success" and 5.0 < played.seconds < 5.2


def test_the_watch_sends_a_speed_limit():
    played = rehearse(watch, cancel_after=2.0)
    assert {values for _, stream, values in played.published if stream == "limit"} <= {
        (1.0,),
        (0.3,),
    }


def test_the_task_may_run_and_ends_well():
    assert rehearse_task(Path(__file__).with_name("deliver.toml"))["status"] == "success"
