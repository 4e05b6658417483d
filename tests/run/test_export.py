"""A journal for other tools: JSON lines, XES, MCAP."""

from __future__ import annotations

import importlib
import importlib.util
import json
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.cli.options import recorded
from petrobot.coordinator.engine import Fired, RunRecorded
from petrobot.coordinator.run.export import messages
from tests.run.test_folder import SCRIPT, SERVICES

SHUTTLE = Path(__file__).parents[1] / "chaos" / "shuttle.toml"
JOURNAL = Path(__file__).parent / "golden" / "catch_ball-missed-and-recovered.journal"


def counts() -> Counter[str]:
    """Instructions of the journal by kind."""
    return Counter(
        type(i).__name__ for step in recorded(str(JOURNAL)).steps() for i in step.instructions
    )


def test_the_log_shows_the_text_of_any_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Control characters in it neither reach the terminal nor break a file."""
    (tmp_path / "services.toml").write_text(SERVICES)
    said = 'text = "3 of 5 parts \\u001b[31mfound"\n'
    (tmp_path / "mock.toml").write_text(SCRIPT.replace("seconds = 0.1\n", "seconds = 0.1\n" + said))
    given = ["run", str(SHUTTLE), "--mode", "lockstep", "--quiet", "--journal", str(tmp_path / "r")]
    given += ["--services", str(tmp_path / "services.toml"), "--mock", str(tmp_path / "mock.toml")]
    assert main(given) == 0
    [folder] = (tmp_path / "r").iterdir()
    capsys.readouterr()
    assert main(["log", str(folder)]) == 0
    assert "SUCCESS  3 of 5 parts \ufffd[31mfound\n" in capsys.readouterr().out
    assert main(["log", str(folder), "--format", "xes", "--out", str(tmp_path / "run.xes")]) == 0
    assert main(["report", str(folder), "--out", str(tmp_path / "page")]) == 0
    files = [tmp_path / "run.xes", *(tmp_path / "page_pictures").glob("*.svg")]
    assert len(files) > 1 and all(ElementTree.parse(file) for file in files)
    assert "script-src 'none'" in (tmp_path / "page.html").read_text()


def test_json_lines_contain_everything(tmp_path: Path) -> None:
    out = tmp_path / "run.jsonl"
    assert main(["log", str(JOURNAL), "--format", "jsonl", "--out", str(out)]) == 0
    head, *steps = [json.loads(line) for line in out.read_text().splitlines()]
    assert head["kind"] == "header" and head["mission"] == "catch_ball/1"
    kinds = Counter(i["kind"] for step in steps for i in step["instructions"])
    assert kinds == counts()
    assert [s["t"] for s in steps] == sorted(s["t"] for s in steps)


def test_xes_has_an_event_for_each_firing_start_and_end(tmp_path: Path) -> None:
    """IEEE 1849-2016: one trace; every event has a name, a time and its place in the life cycle."""
    out = tmp_path / "run.xes"
    assert main(["log", str(JOURNAL), "--format", "xes", "--out", str(out)]) == 0
    space = {"x": "http://www.xes-standard.org/"}
    events = ElementTree.parse(out).getroot().findall("x:trace/x:event", space)
    keys = [{child.get("key"): child.get("value") for child in event} for event in events]
    assert all({"concept:name", "time:timestamp", "lifecycle:transition"} <= set(k) for k in keys)
    seen = Counter((k["kind"], k["lifecycle:transition"]) for k in keys)
    told = counts()
    assert seen == {
        ("firing", "complete"): told["Fired"],
        ("run", "start"): told["StartRun"],
        ("run", "complete"): told["RunRecorded"],
    }


def test_messages_of_an_mcap_file() -> None:
    """In order of time: each firing, start and end of each run, and the marking after each
    stimulus, by name of place."""
    found = recorded(str(JOURNAL))
    steps = list(found.steps())
    given = list(messages(found.journal, found.engine.compiled.net, steps))
    told = counts()
    seen = Counter(name for name, _, _ in given)
    assert (seen["firing"], seen["run"], seen["marking"]) == (
        told["Fired"],
        told["StartRun"] + told["RunRecorded"],
        len(steps),
    )
    times = [time for _, time, _ in given]
    assert times == sorted(times) and times[-1] - times[0] == pytest.approx(
        (steps[-1].time - steps[0].time) * 1e9, abs=2
    )
    last = [body for name, _, body in given if name == "marking"][-1]
    assert last["tokens"]["arm_free"] == 1 and last["tokens"]["runs"] == 0
    causes = {
        body["cause"] for name, _, body in given if name == "run" and body["phase"] == "ended"
    }
    assert {"missed", "drive_fault"} <= causes
    assert any(isinstance(i, Fired | RunRecorded) for i in steps[-1].instructions)


@pytest.mark.skipif(
    importlib.util.find_spec("mcap") is None,
    reason="the package mcap is not installed (petrobot[mcap])",
)
def test_an_mcap_file_is_read_back_by_its_own_library(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    assert main(["log", str(JOURNAL), "--mcap", str(path)]) == 0
    reading = importlib.import_module("mcap.reader")
    with path.open("rb") as file:
        got = [
            (channel.topic, json.loads(message.data))
            for _, channel, message in reading.make_reader(file).iter_messages()
        ]
    found = recorded(str(JOURNAL))
    wrote = [
        (f"/petrobot/{name}", body)
        for name, _, body in messages(found.journal, found.engine.compiled.net, found.steps())
    ]
    assert sorted(map(repr, got)) == sorted(map(repr, wrote))
    assert f"{len(wrote)} messages" in capsys.readouterr().out


@pytest.mark.skipif(
    importlib.util.find_spec("mcap") is not None, reason="the package mcap is installed"
)
def test_without_the_package_the_message_names_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["log", str(JOURNAL), "--mcap", str(tmp_path / "run.mcap")]) == 2
    assert "pip install 'petrobot[mcap]'" in capsys.readouterr().err
