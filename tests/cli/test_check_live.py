"""`petrobot check --live`: asks the nodes whether they offer what the task needs."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from petrobot.coordinator.cli import check, main
from tests.cli.cell import SERVICES, TASK, RobotNode, directory_in
from tests.waiting import PATIENCE_S


async def said_of(
    folder: Path, services: Path, capsys: pytest.CaptureFixture[str]
) -> tuple[int, str]:
    """Return exit code and output of a live check of the reaching task."""
    task = folder / "reaching.toml"
    task.write_text(TASK, encoding="utf-8")
    capsys.readouterr()
    code = await asyncio.to_thread(
        main, ["check", str(task), "--services", str(services), "--live"]
    )
    return code, capsys.readouterr().out


@pytest.mark.processes
async def test_nodes_that_offer_everything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The nodes are up with the same file: the task may run."""
    monkeypatch.setattr(check, "PATIENCE", PATIENCE_S)
    directory = directory_in(tmp_path)
    robot = RobotNode(directory)
    await robot.start()
    try:
        code, said = await said_of(tmp_path, Path(str(directory.source)), capsys)
    finally:
        await robot.close()
    assert (code, "may run" in said) == (0, True), said


@pytest.mark.processes
async def test_a_node_that_is_not_running(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its address, what it would have offered and the remedy are named; the exit code is that of an
    unreachable node."""
    directory = directory_in(tmp_path)
    code, said = await said_of(tmp_path, Path(str(directory.source)), capsys)
    assert code == 3
    assert "robot at 127.0.0.1" in said and "reach_slowly" in said and "may not run" in said


@pytest.mark.processes
async def test_a_node_with_an_older_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node that was started with another services.toml refuses callers that have this one, and
    the check reports it."""
    monkeypatch.setattr(check, "PATIENCE", PATIENCE_S)
    directory = directory_in(tmp_path)
    robot = RobotNode(directory)
    await robot.start()
    newer = tmp_path / "newer.toml"
    port = directory.nodes["robot"].port
    newer.write_text(
        SERVICES.format(port=port).replace("[actions.reach]", "[actions.reach_far]"),
        encoding="utf-8",
    )
    task = TASK.replace('"reach",', '"reach_far",')
    (tmp_path / "far.toml").write_text(task, encoding="utf-8")
    capsys.readouterr()
    try:
        arguments = ["check", str(tmp_path / "far.toml"), "--services", str(newer), "--live"]
        code = await asyncio.to_thread(main, arguments)
    finally:
        await robot.close()
    said = capsys.readouterr().out
    assert code == 3 and "reach_far" in said, said
