"""The examples of docs/analysis-examples.md, run exactly as written there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main

PAGE = Path(__file__).parents[2] / "docs" / "analysis-examples.md"
FILE = re.compile(r"as `([\w.]+)`:\n\n```\w+\n(.*?)```", re.DOTALL)
COMMAND = re.compile(r"```console\n\$ petrobot ([^\n]+)\n(.*?)```\n.*?exit code is (\d)", re.DOTALL)


def test_the_examples_of_the_page_print_what_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = PAGE.read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    files = dict(FILE.findall(text))
    assert set(files) == {"good.toml", "stuck.toml", "queue.net", "rates.toml"}
    for name, content in files.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    commands = COMMAND.findall(text)
    assert len(commands) == 3
    for command, shown, code in commands:
        assert main(command.split()) == int(code), command
        printed = capsys.readouterr().out
        assert " ".join(printed.split()) == " ".join(shown.split()), command


def test_the_arrivals_of_the_queue_are_those_of_the_formula() -> None:
    assert "0.590164" in PAGE.read_text(encoding="utf-8")
    assert pytest.approx(0.590164, abs=1e-6) == 0.8 * (1 - 0.8**2 / (1 + 0.8 + 0.8**2))
