"""Net files of other tools, as the command reads them: odd ids, pages, encodings, unbounded
nets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.analysis.commands import (
    analyse_command,
    convert_command,
    simulate_command,
)
from petrobot.coordinator.analysis.formats import read_net
from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.analysis.net.coverability import coverability, find_pump
from petrobot.coordinator.analysis.net.qualitative import examine
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.cli import main
from petrobot.coordinator.task.file import load
from petrobot.coordinator.task.net import Net
from tests.analysis.generators import philosophers

HEAD = (
    '<pnml xmlns="http://www.pnml.org/version-2009/grammar/pnml"><net id="n" '
    'type="{}">{}</net></pnml>'
)
PTNET = "http://www.pnml.org/version-2009/grammar/ptnet"


def pnml(tmp_path: Path, body: str, kind: str = PTNET, encoding: str = "utf-8") -> Path:
    """Write a file with this net."""
    path = tmp_path / "net.pnml"
    path.write_bytes(
        f'<?xml version="1.0" encoding="{encoding}"?>{HEAD.format(kind, body)}'.encode(encoding)
    )
    return path


def place(name: str, tokens: int = 0) -> str:
    """Return a place as in the standard."""
    return f'<place id="{name}"><initialMarking><text>{tokens}</text></initialMarking></place>'


def arc(source: str, target: str, weight: int = 1, more: str = "") -> str:
    """Return an arc as in the standard."""
    inscription = f"<inscription><text>{weight}</text></inscription>" if weight != 1 else ""
    return (
        f'<arc id="{source}-{target}" source="{source}" target="{target}">{inscription}{more}</arc>'
    )


def analysed(path: Path, **more: Any) -> dict[str, Any]:
    """Return the JSON of the command, parsed strictly."""
    text = json.dumps(analyse_command(path, load, **more).data, allow_nan=False)
    data: dict[str, Any] = json.loads(text)
    return data


LOOP = (
    place("a", 1)
    + place("b")
    + '<transition id="t"/><transition id="u"/>'
    + arc("a", "t")
    + arc("t", "b")
)
LOOP += arc("b", "u") + arc("u", "a")


def test_data_of_other_tools_is_not_part_of_the_net(tmp_path: Path) -> None:
    """Final markings (pm4py) name places again, and tool-specific data may contain whole nets; a
    round trip keeps both."""
    final = (
        '<finalmarkings><marking><place idref="a"><text>1</text></place></marking></finalmarkings>'
    )
    other = (
        '<toolspecific tool="x" version="1"><place id="z"/><arc id="q" source="z" '
        'target="t"/></toolspecific>'
    )
    path = pnml(tmp_path, LOOP + final + other)
    data = analysed(path)
    assert (
        data["net"] == {"places": 2, "transitions": 2, "arcs": 4}
        and data["states"] == 2
        and data["live"]
    )
    target = tmp_path / "again.pnml"
    assert convert_command(path, target, load).code == 0
    again = target.read_text(encoding="utf-8")
    assert 'idref="a"' in again and 'id="z"' in again and 'source="z"' in again
    assert read_net(target).net == read_net(path).net


@pytest.mark.parametrize("encoding", ["utf-8", "iso-8859-1", "utf-16"])
def test_a_file_declares_its_encoding(tmp_path: Path, encoding: str) -> None:
    path = pnml(tmp_path, LOOP.replace('"a"', '"läufer &lt;1&gt;"'), encoding=encoding)
    assert set(analysed(path)["bounds"]) == {"läufer <1>", "b"}


@pytest.mark.parametrize(
    "kind",
    [
        "http://www.pnml.org/version-2009/grammar/symmetricnet",
        "http://www.pnml.org/version-2009/grammar/highlevelnet",
        "http://www.pnml.org/version-2009/grammar/pt-hlpng",
        "http://www.pnml.org/version-2009/extensions/timednet",
    ],
)
def test_nets_of_other_types_are_refused(tmp_path: Path, kind: str) -> None:
    with pytest.raises(NetFileError, match="only P/T nets are read"):
        read_net(pnml(tmp_path, LOOP, kind))
    assert main(["analyse", str(pnml(tmp_path, LOOP, kind)), "--json", "-"]) == 2


def test_numbers_are_computed_if_rates_are_given(tmp_path: Path) -> None:
    """No --view is needed; without rates the numbers are null."""
    path, rates = pnml(tmp_path, LOOP), tmp_path / "rates.toml"
    rates.write_text("[rates]\nt = 2.0\nu = 3.0\n", encoding="utf-8")
    bare = analysed(path)
    assert bare["throughput"] is None and bare["mean_tokens"] is None and bare["residual"] is None
    timed = analysed(path, rates=rates)
    assert timed["throughput"] == pytest.approx({"t": 1.2, "u": 1.2}) and timed["mean_tokens"][
        "a"
    ] == pytest.approx(0.6)
    assert timed["residual"] < 1e-12 and analysed(path, rates="unit")["throughput"][
        "t"
    ] == pytest.approx(0.5)
    both = tmp_path / "both.pnml"
    both.write_text(
        path.read_text(encoding="utf-8").replace(
            '"t"/>', '"t"><rate><value>2.0</value></rate></transition>'
        )
    )
    assert analysed(both)["throughput"] is not None  # rates found in the file


def test_a_rates_file_does_not_change_the_ordinary_view(tmp_path: Path) -> None:
    """Immediate transitions fire before timed ones only in the stochastic view: `states` are
    those of the net."""
    body = place("a", 1) + place("b", 1) + place("c") + '<transition id="t"/><transition id="u"/>'
    body += arc("a", "t") + arc("t", "c") + arc("b", "u") + arc("u", "c")
    path, rates = pnml(tmp_path, body), tmp_path / "rates.toml"
    rates.write_text("[weights]\nt = 1.0\n", encoding="utf-8")
    data = analysed(path, rates=rates)
    assert data["states"] == 4 and data["deadlock"] is True
    assert data["throughput"] == {"t": 0.0, "u": 0.0} and data["mean_tokens"]["c"] == pytest.approx(
        2.0
    )


def test_an_unbounded_net_is_recognised_early(tmp_path: Path) -> None:
    """An unbounded net has no sizes; dead transitions and sources come from the tree and the
    arcs."""
    body = (
        place("a")
        + place("never")
        + '<transition id="in"/><transition id="out"/><transition id="dead"/>'
    )
    body += arc("in", "a") + arc("a", "out") + arc("never", "dead") + arc("dead", "a")
    data = analysed(pnml(tmp_path, body))
    assert data["bounded"] is False and data["states"] is None and data["edges"] is None
    assert (
        data["max_tokens_per_place"] is None
        and data["max_tokens_in_marking"] is None
        and data["complete"] is False
    )
    assert (
        data["quasi_live"] is False
        and data["dead_transitions"] == ["dead"]
        and data["live"] is False
    )
    assert data["deadlock"] is False and "unbounded" in data["reason"]
    witness = data["verdicts"]["bounded"]["witness"]
    net = read_net(tmp_path / "net.pnml").net
    *_, before = net.replay(witness["firings"])
    *_, after = net.replay(witness["loop"] * 3, before)
    assert sum(after) > sum(before)


def test_a_pump_that_no_inhibitor_can_stop_is_enough() -> None:
    """p0 has an inhibitor arc and grows by a transition without one, so the Karp-Miller tree cannot
    be used."""
    net = Net.build(
        {"p": 0}, {"grow": ({}, {"p": 3}), "use": ({"p": 1}, {})}, inhibitors={"use": {"p": 2}}
    )
    assert coverability(net).bounded is None
    found = examine(explore(net, limits=SearchLimits(states=50)))
    assert (
        found.bounded.holds is False
        and found.bounded.witness is not None
        and found.bounded.witness.loop == ("grow",)
    )
    barred = Net.build({"p": 0}, {"grow": ({}, {"p": 1})}, inhibitors={"grow": {"p": 5}})
    assert find_pump(explore(barred)) is None
    # With the second token, a transition of higher priority takes both: the tokens do not grow
    # further.
    urgent = Net.build({"p": 0}, {"in": ({}, {"p": 1}), "out": ({"p": 2}, {})}, priority={"out": 1})
    assert explore(urgent).complete and find_pump(explore(urgent)) is None


def test_an_upper_bound_is_not_a_maximum() -> None:
    """In an incomplete space invariants bound a place by 2, but nothing shows that it ever holds
    2 tokens."""
    net = philosophers(12)
    part = examine(explore(net, limits=SearchLimits(states=100)))
    assert part.bounded.holds is True and part.most == 1  # seen, and no place can hold more
    idle = Net.build(
        {
            "a": 2,
            "b": 0,
            "gate": 0,
            **{f"x{i}": 1 for i in range(12)},
            **{f"y{i}": 0 for i in range(12)},
        },
        {"merge": ({"a": 2}, {"b": 2}), "split": ({"b": 1, "gate": 1}, {"a": 1, "gate": 1})}
        | {f"t{i}": ({f"x{i}": 1}, {f"y{i}": 1}) for i in range(12)},
    )
    doubled = Net.build({"a": 1, "b": 0}, {"t": ({"a": 1}, {"b": 2}), "u": ({"b": 2}, {"a": 1})})
    assert examine(explore(idle, limits=SearchLimits(states=50))).most == 2
    assert examine(explore(doubled, limits=SearchLimits(states=1))).most is None


def test_more_tokens_than_a_word_can_count(tmp_path: Path) -> None:
    """Above 63 bits: a weight leads to a partial result, an initial marking to one clear error."""
    body = place("a", 1) + '<transition id="t"/>' + arc("a", "t") + arc("t", "a", 1 << 62)
    data = analysed(pnml(tmp_path, body))
    assert data["bounded"] is False and data["states"] is None
    outcome = analyse_command(pnml(tmp_path, place("a", 1 << 80)), load)
    assert outcome.code == 2 and "63" in outcome.text and "net.pnml" in outcome.text


def test_empty_nets(tmp_path: Path) -> None:
    """Without transitions: one dead marking, its own home. Without places: a transition that can
    always fire."""
    alone = analysed(pnml(tmp_path, place("a", 2)), rates="unit")
    assert (alone["states"], alone["deadlock"], alone["home_states"], alone["live"]) == (
        1,
        True,
        1,
        True,
    )
    assert (
        alone["mean_tokens"] == {"a": 2.0}
        and alone["throughput"] == {}
        and alone["max_tokens_in_marking"] == 2
    )
    free = analysed(pnml(tmp_path, '<transition id="t"/>'), rates="unit")
    assert (free["states"], free["edges"], free["deadlock"], free["live"]) == (1, 1, False, True)
    assert free["throughput"] == pytest.approx({"t": 1.0})
    empty = analysed(pnml(tmp_path, ""))
    assert empty["net"] == {"places": 0, "transitions": 0, "arcs": 0} and empty["states"] == 1


def test_a_simulation_without_time_is_valid_json(tmp_path: Path) -> None:
    """Immediate transitions fire for ever, so no time is observed: the result is null, not NaN."""
    import numpy as np

    path, rates = pnml(tmp_path, LOOP), tmp_path / "rates.toml"
    rates.write_text("[weights]\nt = 1\nu = 1\n", encoding="utf-8")
    seen = simulate_command(
        path, load, np.random.default_rng(1), rates=rates, replicas=3, horizon=1.0, firings=200
    )
    assert seen.code == 1 and seen.data["complete"] is False
    assert json.loads(json.dumps(seen.data, allow_nan=False))["throughput"]["t"] == [
        None,
        None,
        None,
    ]
    trapped = analysed(path, rates=rates)
    assert trapped["throughput"] is None and any(
        "time never passes" in note for note in trapped["notes"]
    )
