"""Net files of other tools, as the command reads them: odd ids, pages, encodings, unbounded
nets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import pytest

from petrobot.coordinator.analysis import formats
from petrobot.coordinator.analysis.commands import (
    analyse_command,
    convert_command,
    simulate_command,
)
from petrobot.coordinator.analysis.formats import losses, pnml as formats_pnml, read_net, tree
from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.analysis.formats.tree import local
from petrobot.coordinator.analysis.net.coverability import coverability, find_pump
from petrobot.coordinator.analysis.net.qualitative import examine
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.cli import main
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
    text = json.dumps(analyse_command(path, **more).data, allow_nan=False)
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
    assert convert_command(path, target).code == 0
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
        "http://www.example.org/timedptnet",
        "Timed P/T net",
        "Coloured Petri net",
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
    outcome = analyse_command(pnml(tmp_path, place("a", 1 << 80)))
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
        path, np.random.default_rng(1), rates=rates, replicas=3, horizon=1.0, firings=200
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


TAPAAL = (
    '<pnml xmlns="http://www.informatik.hu-berlin.de/top/pnml/ptNetb">\n{before}'
    '<net active="true" id="N" type="P/T net">\n'
    '<place id="p" initialMarking="2" invariant="&lt; inf" name="p">{marking}</place>\n'
    '<place id="q" initialMarking="0" invariant="&lt; inf" name="q">{sort}</place>\n'
    '<transition id="t" name="t" player="{player}" priority="0" urgent="false" {stochastic}/>\n'
    '<arc id="A1" inscription="[0,inf){pair}" source="p" target="t" {arc} weight="{weight}">'
    '{dots}</arc>\n<arc id="A2" inscription="1" source="t" target="q" type="normal" weight="1"/>\n'
    '</net><feature isColored="false" isGame="{game}"/></pnml>'
)
DOT_SORT = (
    "<declaration><structure><declarations>{}</declarations></structure></declaration>\n"
).format
DOT = DOT_SORT('<namedsort id="dot" name="dot"><dot/></namedsort>')
DOTS = "<{0}><text>{1}</text><structure><numberof/></structure></{0}>".format
SORT = '<type><text>dot</text><structure><usersort declaration="dot"/></structure></type>'
AS_SAVED = {
    "before": "",
    "marking": "",
    "sort": "",
    "stochastic": "",
    "player": "0",
    "game": "false",
    "pair": "",
    "arc": 'type="timed"',
    "weight": "2",
    "dots": "",
}
VERSION_4 = {
    "before": DOT,
    "marking": SORT + DOTS("hlinitialMarking", "(2'dot)"),
    "sort": SORT,
    "stochastic": 'distribution="uniform" a="0.5" b="1.5" firingMode="Oldest" weight="Infinity"',
    "dots": DOTS("hlinscription", "2'dot"),
}


@pytest.mark.parametrize(
    "more",
    [
        {},
        VERSION_4,
        {"before": '<constant name="N" value="2"/>\n', "weight": "N"},
        {"pair": ":2", "arc": 'type="transport" transportID="2"'},
    ],
)
def test_files_as_tapaal_saves_them(tmp_path: Path, more: dict[str, str]) -> None:
    """Version 4 says each number again in colours, also in nets that have none."""
    path = tmp_path / "net.tapn"
    path.write_text(TAPAAL.format(**AS_SAVED | more), encoding="utf-8")
    model = read_net(path)
    assert model.net == Net.build({"p": 2, "q": 0}, {"t": ({"p": 2}, {"q": 1})})
    constants = [text for text in losses(model, ".pnml") if "constants" in text]
    named = "<constant" in more.get("before", "")
    assert constants == ["the names of the constants N"] * named


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            {"before": DOT_SORT('<namedsort id="c"><cyclicenumeration/></namedsort>')},
            r":2: declaration: it declares <cyclicenumeration>; it is a coloured net",
        ),
        (
            VERSION_4 | {"marking": DOTS("hlinitialMarking", "(3'dot)")},
            r"numbers of tokens \[2, 3\]",
        ),
        (VERSION_4 | {"dots": DOTS("hlinscription", "1'dot")}, r"it has the weights \[1, 2\]"),
        (VERSION_4 | {"dots": DOTS("hlinscription", "2'x")}, "2'x"),
        ({"before": '<shared-place name="p"/>\n'}, ":2: pnml: element <shared-place> is not read"),
        (
            {"before": '<shared-place name="p"/><net id="M" type="P/T net"/>\n'},
            "export the composed net",
        ),
        ({"before": '<constant name="N" value="x"/>\n'}, ":2: constant N: 'x' has no value"),
        ({"player": "1"}, ":5: transition t: attribute player is '1'; games are not read: give ev"),
        ({"game": "true"}, ":8: feature: attribute isGame is 'true'; games are not read"),
        ({"game": 'false" isOdd="1'}, ":8: feature: unknown attribute isOdd"),
        ({"arc": 'type="timed" transition="t"'}, ":6: arc A1: unknown attribute transition"),
    ],
)
def test_files_of_tapaal_that_say_more_than_a_net(
    tmp_path: Path, more: dict[str, str], said: str
) -> None:
    path = tmp_path / "net.tapn"
    path.write_text(TAPAAL.format(**AS_SAVED | more), encoding="utf-8")
    with pytest.raises(NetFileError, match=said):
        read_net(path)


def test_stochastic_files_of_tapaal_are_read_with_a_note(tmp_path: Path) -> None:
    path = tmp_path / "net.tapn"
    text = TAPAAL.format(
        **AS_SAVED | {"game": 'false" isStochastic="true', "stochastic": 'rate="3"'}
    )
    path.write_text(text, encoding="utf-8")
    assert len([note for note in read_net(path).notes if "not read: give rates" in note]) == 2


NOT_T = '<transition id="t"/>'
OURS = '<transition id="t"><toolspecific tool="petrobot" version="1">{}</toolspecific></transition>'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (NOT_T, OURS.format("<prioritty>2</prioritty>"), "our data: unknown element <prioritty>"),
        (NOT_T, OURS.format("<rate>2</rate><weight>1</weight>"), "a rate and a weight"),
        (NOT_T, OURS.format("</toolspecific><toolspecific tool='petrobot'>"), "our data twice"),
        (NOT_T, '<transition id="t"><timed><value>yes</value></timed></transition>', "is 'yes'"),
        (NOT_T, '<transition id="t"><timed><value>true</value></timed></transition>', "a rate"),
        (
            NOT_T,
            '<transition id="t" priority="2"><priority><value>1</value></priority></transition>',
            r"priorities \[1, 2\]",
        ),
        ('<place id="a">', '<place id="a" initialMarking="7">', r"numbers of tokens \[1, 7\]"),
        ("<text>1<", "<value>2</value><text>1<", "it has several values"),
        (">1<", ">Default,1,Default,2<", "says Default twice"),
    ],
)
def test_what_a_net_file_says_twice_or_in_unknown_words(
    tmp_path: Path, old: str, new: str, said: str
) -> None:
    path = pnml(tmp_path, LOOP)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(NetFileError, match=said):
        read_net(path)


@pytest.mark.parametrize("first", [True, False])
def test_a_test_arc_beside_a_normal_one_takes_nothing_more(tmp_path: Path, first: bool) -> None:
    """Whichever of them comes first in the file."""
    tested = arc("a", "t", 2, '<type value="test"/>')
    both = (tested, arc("a", "t")) if first else (arc("a", "t"), tested)
    path = pnml(tmp_path, place("a", 3) + '<transition id="t"/>' + "".join(both))
    assert read_net(path).net == Net.build({"a": 3}, {"t": ({"a": 2}, {"a": 1})})


TINA_PNML = LOOP.replace(
    '<transition id="t"/>',
    '<transition id="t"><delay><interval xmlns="http://www.w3.org/1998/Math/MathML" '
    'closure="{}"><cn>0</cn>{}</interval></delay></transition>',
)
TINA = "http://www.laas.fr/tina/tpn"


def test_pnml_of_tina_with_endless_intervals(tmp_path: Path) -> None:
    """Its net type is that of time Petri nets, also for nets without times."""
    endless = pnml(tmp_path, TINA_PNML.format("closed-open", "<ci>infty</ci>"), TINA)
    assert read_net(endless).net == read_net(pnml(tmp_path, LOOP)).net
    with pytest.raises(NetFileError, match="<delay> is '04'; only untimed nets"):
        read_net(pnml(tmp_path, TINA_PNML.format("closed", "<cn>4</cn>"), TINA))


PROJECT = (
    '<project name="P" version="121">\n'
    '<gspn name="G" show-timed-cmd="false" view-rates="false" zoom="125"><nodes>\n'
    '<place magnets="THREE_PER_SIDE" marking="N" name="p" x="6.0" y="5.0"/>\n'
    '<transition delay="{delay}" {more} name="t" type="EXP" x="9.0" y="5.0"/>\n'
    '<{kind} last-binding="3" name="N" type="INTEGER" {value} x="1.0" y="1.0"/></nodes>\n'
    '<edges><arc broken="true" head="t" head-magnet="9" kind="INPUT" tail="p" tail-magnet="3"/>'
    "</edges></gspn></project>"
)


def test_a_project_as_greatspn_saves_it(tmp_path: Path) -> None:
    path = tmp_path / "net.PNPRO"
    said = {"delay": "1.5", "more": "", "kind": "template", "value": 'value="2"'}
    path.write_text(PROJECT.format(**said), encoding="utf-8")
    model = read_net(path)
    assert model.net == Net.build({"p": 2}, {"t": ({"p": 1}, {})})
    assert model.gspn is not None and model.gspn.rate == (1.5,)
    for change, words in (
        ({"value": ""}, ":5: template N: it has no value"),
        ({"delay": "0"}, ":4: rates: t: expected a positive, finite rate"),
        ({"more": 'nservers="0"'}, ":4: rates: t: "),
        ({"more": 'guard="#p &gt; 1"'}, ":4: .*guards are not read"),
    ):
        path.write_text(PROJECT.format(**said | change), encoding="utf-8")
        with pytest.raises(NetFileError, match=words):
            read_net(path)


@pytest.mark.parametrize(
    "text",
    [
        "tr t a*2 b?3 -> c\ntr u c?-2 -> a*5\npl a (1K)\npl b (2)",
        "tr t\ntr u\npl a (1K) u*5 -> t*2\npl b (2) -> t?3\npl c t -> u?-2",
        "pl a (1K) u*5 -> t*2\npl b (2) -> t?3\npl c t -> u?-2",
        "tr t [ 0 , w [ a*2 b?3 -> c\ntr u [0, w[ c?-2 -> a*5\npl a (1000)\npl b (1)\npl b (1)",
    ],
)
def test_a_net_of_tina_is_the_sum_of_its_lines(tmp_path: Path, text: str) -> None:
    """Arcs may stand in the lines of places, and spaces inside intervals."""
    path = tmp_path / "net.net"
    path.write_text(text, encoding="utf-8")
    found = read_net(path).net
    wanted = Net.build(
        {"a": 1000, "b": 2, "c": 0},
        {"t": ({"a": 2, "b": 3}, {"b": 3, "c": 1}), "u": ({}, {"a": 5})},
        inhibitors={"u": {"c": 2}},
    )
    arcs = [
        {(found.places[p], found.transitions[t], w) for t, row in enumerate(rows) for p, w in row}
        for rows in (found.consume, found.produce, found.inhibit)
    ]
    assert dict(zip(found.places, found.initial, strict=True)) == {"a": 1000, "b": 2, "c": 0}
    assert arcs == [
        {(wanted.places[p], wanted.transitions[t], w) for t, row in enumerate(rows) for p, w in row}
        for rows in (wanted.consume, wanted.produce, wanted.inhibit)
    ]


def test_large_numbers_of_tina(tmp_path: Path) -> None:
    path = tmp_path / "net.net"
    path.write_text("tr t p*2P -> q*1E\npl p (3E)\n", encoding="utf-8")
    net = read_net(path).net
    assert net.initial[0] == 3 * 10**18
    assert net.consume == (((0, 2 * 10**15),),) and net.produce == (((1, 10**18),),)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tr t p q\n", "net.net:1: transition t: no -> in its line"),
        ("\npl p t -> u -> v\n", "net.net:2: place p: two -> in its line"),
        ("pl p t?1 -> u\n", r"net.net:1: transition t: unknown arc 't\?1'"),
        ("pl p (1) (<2)\n", "net.net:1: place p: unexpected '(<2)'"),
        ("tr t a -> b\ntr a a -> b\n", "net.net:2: a: this id occurs twice"),
        ("|0|\n|\n", "net.net:1: line: a line that begins with '|0|'; a net of TINA"),
        ("tr t a -> b\npl {p\xe9}\n", "net.net:2: file: 'utf-8' codec"),
        ("tr t [0,w[ [1,2] a -> b\n", "net.net:1: line: '[1,2]' is not a name"),
        ("tr <t> a -> b\n", "net.net:1: line: '<t>' is not a name"),
    ],
)
def test_faults_of_a_tina_file_have_a_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "net.net"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(NetFileError) as raised:
        read_net(path)
    assert said.replace("\\", "") in str(raised.value)


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ('<referencePlace id="r" ref="nowhere"/>', "reference r: 'nowhere' is not a place"),
        ('<referencePlace id="r" ref="t"/>', "reference r: 't' is not a place"),
        ('<referenceTransition id="r" ref="a"/>', "reference r: 'a' is not a transition"),
        ('<referencePlace id="r" ref="s"/><referencePlace id="s" ref="r"/>', "form a circle"),
    ],
)
def test_a_reference_leads_to_a_node_of_its_kind(tmp_path: Path, reference: str, said: str) -> None:
    """Also one that no arc uses."""
    with pytest.raises(NetFileError, match=said):
        read_net(pnml(tmp_path, LOOP + reference))


def test_a_comment_is_not_part_of_a_number(tmp_path: Path) -> None:
    noted = place("a", 1).replace(">1<", ">1<!--2-->3<")
    assert read_net(pnml(tmp_path, noted)).net.initial == (13,)


def chained(size: int) -> str:
    """Return a net with arcs and references in proportion to the size, the last ones first."""
    nodes = "".join(place(f"p{i}", 1) + f'<transition id="t{i}"/>' for i in range(size))
    references = "".join(
        f'<referencePlace id="r{i}" ref="{f"r{i - 1}" if i else "p0"}"/>' for i in range(size)
    )
    last = "".join(arc(f"r{size - 1}", f"t{i}") for i in range(size))
    return nodes + references + last


def test_reading_a_file_takes_time_in_proportion_to_its_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counted in steps: tags looked at, and references followed."""
    steps = 0

    class Counted(dict[str, str]):
        def __getitem__(self, name: str) -> str:
            nonlocal steps
            steps += 1
            return super().__getitem__(name)

    def counted(element: Element) -> str:
        nonlocal steps
        steps += 1
        return local(element)

    end_of = formats_pnml._end_of

    def followed(references: dict[str, str], name: str) -> str | None:
        watched = Counted(references)
        found = end_of(watched, name)
        references.update(watched)
        return found

    monkeypatch.setattr(tree, "local", counted)
    monkeypatch.setattr(formats_pnml, "_end_of", followed)
    taken = []
    for size in (50, 400):
        steps = 0
        path = pnml(tmp_path, chained(size))
        target = tmp_path / "again.pnml"
        assert convert_command(path, target).code == 0
        assert read_net(target).net == read_net(path).net
        taken.append(steps)
    assert taken[1] < 12 * taken[0]


def test_a_chain_without_an_end_is_not_followed_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writing a chain searches for all markings, within limits."""
    assert formats.LARGEST_CHAIN.states is not None and formats.LARGEST_CHAIN.memory is not None
    monkeypatch.setattr(formats, "LARGEST_CHAIN", SearchLimits(states=1000))
    path, rates = tmp_path / "grows.pnpro", tmp_path / "grows.drn"
    path.write_text(
        '<project><gspn name="g"><nodes><place name="p" x="0" y="0"/><transition name="t" '
        'type="EXP" nservers="1" x="1" y="1"/></nodes><edges><arc kind="OUTPUT" tail="t" head="p"/>'
        "</edges></gspn></project>",
        encoding="utf-8",
    )
    outcome = convert_command(path, rates)
    assert outcome.code == 2 and "the search stopped: limit of 1000" in outcome.text
    assert not rates.exists()
