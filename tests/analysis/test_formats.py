"""Readers and writers of net files: nothing changes the behaviour of a net silently."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from copy import deepcopy
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace

from petrobot.coordinator.analysis.formats import (
    FORMATS,
    HAS,
    READ,
    Feature,
    losses,
    read_net,
    written,
)
from petrobot.coordinator.analysis.formats.greatspn import parse_pnpro
from petrobot.coordinator.analysis.formats.netfile import NetDraft, NetFile, NetFileError
from petrobot.coordinator.analysis.formats.pnml import NAMESPACE, parse_pnml, write_pnml
from petrobot.coordinator.analysis.formats.tina import parse_tina, write_tina
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn
from petrobot.coordinator.task.net import Net
from tests.analysis.generators import KANBAN_RATES, kanban, queue
from tests.analysis.random_nets import gspns, nets

ISO = """<?xml version="1.0"?>
<pnml xmlns="http://www.pnml.org/version-2009/grammar/pnml">
 <net id="n" type="http://www.pnml.org/version-2009/grammar/ptnet"><name>
<text>two pages</text></name>
  <!-- kept -->
  <page id="one">
   <place id="p"><name><text>start</text><graphics><offset x="3" y="4"/></graphics></name>
    <graphics><position x="10" y="20"/></graphics><initialMarking><text>2</text></initialMarking>
    <toolspecific tool="paint" version="9"><colour>red</colour></toolspecific></place>
   <transition id="t"/>
   <arc id="a" source="p" target="t"><inscription><text>2</text></inscription></arc>
   <arc id="b" source="t" target="r2"/>
   <referencePlace id="r2" ref="r1"/>
  </page>
  <page id="two"><place id="q"/><referencePlace id="r1" ref="q"/>
<referenceTransition id="rt" ref="t"/>
   <arc id="c" source="rt" target="q"/></page>
 </net></pnml>"""


def test_pages_and_references_are_followed() -> None:
    model = parse_pnml(ISO)
    assert model.net == Net.build({"p": 2, "q": 0}, {"t": ({"p": 2}, {"q": 2})})
    assert (
        model.labels == {"p": "start"}
        and model.positions == {"p": (10.0, 20.0)}
        and model.name == "two pages"
    )
    assert any("added up" in note for note in model.notes)


def test_a_round_trip_keeps_pages_graphics_and_tool_specific_data() -> None:
    model = parse_pnml(ISO)
    changed = replace(model, net=replace(model.net, initial=(5, 1)))
    text = write_pnml(changed)
    for kept in (
        'tool="paint"',
        "<colour>red</colour>",
        'offset x="3"',
        "kept",
        'id="two"',
        'ref="q"',
        'x="10"',
    ):
        assert kept in text
    again = parse_pnml(text)
    assert again.net == changed.net and again.labels == model.labels and again.notes == ()


def test_removed_and_added_nodes_reach_the_file() -> None:
    model = parse_pnml(ISO)
    other = Net.build(
        {"q": 1, "fresh": 0},
        {"t": ({"q": 1}, {"fresh": 3}), "u": ({"fresh": 1}, {})},
        inhibitors={"u": {"q": 2}},
    )
    again = parse_pnml(write_pnml(replace(model, net=other, positions={"fresh": (7.0, 8.0)})))
    assert (
        again.net.initial,
        again.net.consume,
        again.net.produce,
        again.net.inhibit,
    ) == _in_order(other, again.net)
    assert again.positions["fresh"] == (7.0, 8.0)


@settings(max_examples=40, deadline=None)
@given(nets())
def test_pnml_round_trip_of_any_net(net: Net) -> None:
    assert parse_pnml(write_pnml(NetFile(net))).net == net


@settings(max_examples=40, deadline=None)
@given(gspns())
def test_pnml_round_trip_of_any_gspn(gspn: Gspn) -> None:
    again = parse_pnml(write_pnml(NetFile(gspn.net, gspn=gspn)))
    assert again.gspn is not None
    assert (again.gspn.rate, again.gspn.servers, again.gspn.net.priority) == (
        gspn.rate,
        gspn.servers,
        gspn.net.priority,
    )
    assert all(
        a == b
        for a, b, r in zip(again.gspn.weight, gspn.weight, gspn.rate, strict=True)
        if r is None
    )


def arc_file(arc: str, extra: str = "") -> str:
    return f"""<pnml><net id="n" type="P/T net">
<place id="p"><initialMarking><text>1</text></initialMarking></place>
    <place id="q"/><transition id="t"/><arc id="a" source="p" target="t" {extra}>{arc}</arc>
    <arc id="b" source="t" target="q"/></net></pnml>"""


@pytest.mark.parametrize(
    ("arc", "extra"),
    [
        ("<arctype><text>inhibitor</text></arctype>", ""),
        ("<arctype>inhibitor</arctype>", ""),
        ('<type value="inhibitor"/>', ""),
        ('<type value="inhibition"/>', ""),
        ("<type><text>inhibitor</text></type>", ""),
        ("", 'type="inhibitor"'),
        ("", 'type="logicalInhibitor"'),
        ("", 'type="tapnInhibitor"'),
        ("<toolspecific tool='x' version='1'><inhibitor/></toolspecific>", ""),
        ("<toolspecific tool='x' version='1'><type>inhibitor</type></toolspecific>", ""),
        ("<toolspecific tool='x' version='1'><arcType>inhibitor</arcType></toolspecific>", ""),
    ],
)
def test_inhibitor_arcs_in_every_notation(arc: str, extra: str) -> None:
    net = parse_pnml(arc_file(arc + "<inscription><text>2</text></inscription>", extra)).net
    assert net.inhibit == (((0, 2),),) and net.consume == ((),)


@pytest.mark.parametrize("arc", ['<type value="test"/>', "<arctype><text>read</text></arctype>"])
def test_test_arcs_do_not_consume(arc: str) -> None:
    net = parse_pnml(arc_file(arc)).net
    assert net.consume == (((0, 1),),) and net.produce == (((0, 1), (1, 1)),)


@pytest.mark.parametrize(
    ("arc", "extra"),
    [
        ('<type value="reset"/>', ""),
        ("<arctype><text>hyper</text></arctype>", ""),
        ("", 'type="transport"'),
        ('<type value="inhibitor"/><arctype><text>read</text></arctype>', ""),
        ("<toolspecific tool='x' version='1'><reset/></toolspecific>", ""),
    ],
)
def test_unknown_arcs_are_refused(arc: str, extra: str) -> None:
    with pytest.raises(NetFileError, match=r"file\.pnml:3: arc a: an arc of the kind"):
        parse_pnml(arc_file(arc, extra), "file.pnml")


PIPE = """<pnml><net id="Net-One" type="P/T net"><token id="Default" red="0"/>
<place id="P0"><initialMarking><value>Default,2</value></initialMarking><capacity>
<value>0</value></capacity></place>
<place id="P1"><initialMarking><value>{empty}</value></initialMarking><capacity>
<value>3</value></capacity></place>
<transition id="T0"><rate><value>2.5</value></rate><timed><value>true</value></timed>
<infiniteServer><value>true</value></infiniteServer><priority>
<value>1</value></priority></transition>
<transition id="T1"><rate><value>0.5</value></rate><timed><value>false</value></timed><priority>
<value>2</value></priority></transition>
<arc id="a" source="P0" target="T0"><inscription><value>Default,1</value></inscription>
<type value="normal"/></arc>
<arc id="b" source="T0" target="P1"><inscription><value>1</value></inscription></arc>
<arc id="c" source="P1" target="T1"><inscription><value></value></inscription></arc>
<arc id="d" source="T1" target="P0"/></net></pnml>"""


def test_pipe_becomes_iso_pnml() -> None:
    """An independent reader of the standard finds all tokens, arcs and names in it."""
    model = parse_pnml(PIPE.format(empty="Default,1"))
    text, lost = written(model, Path("net.pnml"))
    assert "<value>" not in text and "Default" not in text
    root = ElementTree.fromstring(text)
    name = f"{{{NAMESPACE}}}"
    assert root[0].get("type") == "http://www.pnml.org/version-2009/grammar/ptnet"
    tokens = {
        place.get("id"): int(place.findtext(f"{name}initialMarking/{name}text", "0"))
        for place in root.iter(f"{name}place")
    }
    assert tokens == {"P0": 2, "P1": 1}
    assert {(a.get("source"), a.get("target")) for a in root.iter(f"{name}arc")} == {
        ("P0", "T0"),
        ("T0", "P1"),
        ("P1", "T1"),
        ("T1", "P0"),
    }
    assert [what.split(":")[0] for what in lost] == [
        "capacities",
        "priorities",
        "rates and weights",
        "numbers of servers",
    ]
    assert parse_pnml(text).gspn == model.gspn


TAPAAL = """<?xml version="1.0"?><pnml><net id="n" type="P/T net">
<place id="p" name="start" initialMarking="2" invariant="&lt; inf"/>
<place id="q" name="q" initialMarking="0" invariant="&lt; inf"/>
<place id="r" name="r" initialMarking="1" invariant="&lt; inf"/>
<transition player="0" id="t" name="t" urgent="false"/>
<inputArc inscription="[0,inf)" source="p" target="t" weight="2"/>
<outputArc inscription="1" source="t" target="q" weight="3"/>
<transportArc inscription="[0,inf)" source="r" transition="t" target="q"/>
<inhibitorArc source="q" target="t"><inscription><value>4</value></inscription></inhibitorArc>
</net></pnml>"""


def test_files_of_tapaal() -> None:
    net = parse_pnml(TAPAAL).net
    assert net == Net.build(
        {"p": 2, "q": 0, "r": 1},
        {"t": ({"p": 2, "r": 1}, {"q": 4})},
        inhibitors={"t": {"q": 4}},
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[0,inf)", "[2,5]", r"the time interval \[2,5\]"),
        ("&lt; inf", "&lt;= 3", "attribute invariant is '<= 3'; only untimed"),
        ('urgent="false"', 'urgent="true"', "attribute urgent"),
        ('weight="2"', 'weight="N"', "unknown name 'N'"),
        ("<inhibitorArc", '<inhibitorArc weight="2"', r"the weights \[2, 4\]"),
        ('transition="t"', 'transition="q"', "connects a place and a transition"),
        ("inputArc", "resetArc", "unknown element <resetArc>"),
    ],
)
def test_timed_files_of_tapaal_are_refused(old: str, new: str, said: str) -> None:
    with pytest.raises(NetFileError, match=rf"^n\.xml:\d+: .*{said}"):
        parse_pnml(TAPAAL.replace(old, new), "n.xml")


@pytest.mark.parametrize("empty", ["", "Default,0", "0", "Default,0,Red,0", "Default,"])
def test_files_of_pipe(empty: str) -> None:
    model = parse_pnml(PIPE.format(empty=empty))
    assert model.gspn is not None
    assert model.net.initial == (2, 0) and model.net.capacity == (None, 3)
    assert (
        model.gspn.rate == (2.5, None)
        and model.gspn.weight[1] == 0.5
        and model.gspn.servers[0] is None
    )
    again = parse_pnml(write_pnml(replace(model, net=replace(model.net, initial=(1, 0)))))
    assert again.net.initial == (1, 0) and again.gspn is not None and again.gspn.rate == (2.5, None)


def test_coloured_tokens_and_other_net_types_are_refused() -> None:
    with pytest.raises(NetFileError, match="colour 'Red'"):
        parse_pnml(PIPE.format(empty="Default,0,Red,1"))
    with pytest.raises(NetFileError, match="only P/T nets"):
        parse_pnml(
            '<pnml><net id="n" '
            'type="http://www.pnml.org/version-2009/grammar/symmetricnet"/></pnml>'
        )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<pnml><net id='n'>", "incomplete"),
        ("<html/>", "not PNML"),
        ("<pnml><net id='n'><place id='p' ageLimit='3'/></net></pnml>", "unknown attribute age"),
        ("<pnml><net id='n'><place id='p'><colour/></place></net></pnml>", "unknown element <col"),
        ("<pnml><net id='n'><place id='p'/><transition id='t'/><edge source='p' target='t'/></net>"
         "</pnml>", "unknown element <edge>"),
        ("<pnml><net id='n'><page id='g'><link source='p' target='t'/></page></net></pnml>",
         "page g: unknown element <link>"),
        ("<pnml><net id='n'><place id='p'><initialMarking><text>1</text></initialMarking>"
         "<initialMarking><text>2</text></initialMarking></place></net></pnml>", "occurs twice"),
        ("<pnml><net id='n'><place id='p'><initialMarking><structure/></initialMarking></place>"
         "</net></pnml>", "unknown element <structure>"),
        ("<pnml><net id='n'><place id='p'><graphics><position x='a' y='1'/></graphics></place>"
         "</net></pnml>", "position of place p: 'a' has no value"),
        ("<pnml><net id='n'><place id='p'><initialMarking><text>1e999</text></initialMarking>"
         "</place></net></pnml>", "too large"),
        ("<pnml><net id='n'><place id='p'/><referencePlace id='p' ref='p'/></net></pnml>",
         "occurs twice"),
        ("<pnml>" + "<net>" * 20_000, "nested more than"),
        ("<pnml><net id='n'>" + "<page id='g'>" * 20_000 + "</page>" * 20_000 + "</net></pnml>",
         "nested more than"),
        ("<pnml/>", "no <net>"),
        ("<pnml><net id='a'/><net id='b'/></pnml>", "2 nets"),
        ("<pnml><net id='n'><place/></net></pnml>", "no id"),
        ("<pnml><net id='n'><place id='p'/><place id='p'/></net></pnml>", "occurs twice"),
        ("<pnml><net id='n'><place id='p'/><arc id='a' source='p' target='x'/></net></pnml>",
         "connects a place and a transition"),
        ("<pnml><net id='n'><place id='p'><initialMarking><text>two</text></initialMarking></place>"
         "</net></pnml>", "has no value"),
        ("<pnml><net id='n'><place id='p'><initialMarking><text>1.5</text></initialMarking></place>"
         "</net></pnml>", "whole number"),
        ("<pnml><net id='n'><referencePlace id='a' ref='b'/><referencePlace id='b' ref='a'/>"
         "<transition id='t'/>"
         "<arc id='c' source='a' target='t'/></net></pnml>", "circle"),
    ],
)  # fmt: skip
def test_errors_of_broken_files_say_where_and_what(text: str, said: str) -> None:
    with pytest.raises(NetFileError, match=said) as caught:
        parse_pnml(text, "some.pnml")
    assert re.match(r"some\.pnml:1: .+: .+", str(caught.value))


PNPRO = """<?xml version="1.0"?><project name="P" version="121"><gspn name="G"><nodes>
<constant name="mu" consttype="REAL" value="2*(1+0.25)" x="1" y="1"/>
<constant name="N" consttype="INTEGER" value="3"/>
<place marking="N" name="idle" x="1.5" y="2"/><place name="busy" x="3" y="2"/>
<text-box name="b" x="0" y="0">hello</text-box>
<transition name="go" type="EXP" delay="mu" x="2" y="2"/>
<transition name="one" type="EXP" delay="1/4" nservers="1" x="2" y="2"/>
<transition name="now" type="IMM" priority="2" weight="3" x="2" y="2"/></nodes><edges>
<arc tail="idle" head="go" kind="INPUT" mult="2"/>
<arc tail="go" head="busy" kind="OUTPUT" mult="2"><point x="1" y="1"/></arc>
<arc tail="busy" head="one" kind="INPUT"/><arc tail="one" head="idle" kind="OUTPUT"/>
<arc tail="busy" head="now" kind="INPUT"/><arc tail="now" head="idle" kind="OUTPUT"/>
<arc tail="idle" head="now" kind="INHIBITOR"/>
</edges></gspn></project>"""


def test_a_greatspn_project_under_another_ending_is_named() -> None:
    with pytest.raises(NetFileError, match=r"this is not PNML; .* read as \.pnpro: rename"):
        parse_pnml(PNPRO)


def test_delays_in_greatspn_projects_are_rates() -> None:
    model = parse_pnpro(PNPRO)
    assert model.gspn is not None and model.net == model.gspn.net
    assert (
        model.gspn.rate == (2.5, 0.25, None)
        and model.gspn.servers[:2] == (None, 1)
        and model.gspn.weight[2] == 3.0
    )
    assert (
        model.net.initial == (3, 0)
        and model.net.consume[0] == ((0, 2),)
        and model.net.inhibit[2] == ((0, 1),)
    )
    assert model.net.priority[0] == 0 < model.net.priority[2] and model.positions["idle"] == (
        1.5,
        2.0,
    )


@pytest.mark.parametrize("name", ["lambda", "if", "import", "None", "λ", "a1"])
def test_constants_may_have_any_name(name: str) -> None:
    model = parse_pnpro(PNPRO.replace('"mu"', f'"{name}"'))
    assert model.gspn is not None and model.gspn.rate[0] == 2.5


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1+2*3", 7),
        ("(1+2)*3", 9),
        ("-2*-3", 6),
        ("8-4-2", 2),
        ("12/4/3", 1),
        ("1.5e3", 1500),
        (".5*2", 1),
        ("9007199254740993", 9007199254740993),
        ("3*(1/3)", 1),
        ("2*k", 14),
    ],
)
def test_expressions_are_exact(text: str, value: int) -> None:
    draft = NetDraft("file")
    draft.constants["k"] = Fraction(7)
    assert draft.whole("here", text) == value


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('type="IMM"', 'type="GEN"', "EXP and IMM"),
        ('kind="INHIBITOR"', 'kind="RESET"', "kinds are"),
        ('value="2*(1+0.25)"', 'value=""', "set a value"),
        ('delay="mu"', 'delay="nu"', "has no value"),
        ('delay="mu"', 'delay="__import__(1)"', "has no value"),
        ('delay="mu"', f'delay="{"(" * 5000}1{")" * 5000}"', "nested more than"),
        ('delay="mu"', 'delay="mu mu"', "unexpected 'mu'"),
        ('delay="mu"', 'delay="1/(mu-mu)"', "has no value"),
        ('name="idle" x="1.5"', 'name="idle" x="left"', "position of idle"),
        ('name="idle" x', 'name="idle" speed="4" x', "unknown attribute speed"),
        ('name="N" consttype', 'name="mu" consttype', "defined twice"),
        ('name="busy" x', 'name="busy" domain="C" x', "coloured"),
        ("<text-box", "<fluid", "unknown element"),
        ("hello", '<place name="in" x="1" y="1"/>', "<text-box> contains nodes of the net"),
        ('head="one" kind="INPUT"', 'head="one" kind="OUTPUT"', "from 'busy' to 'one'; INPUT"),
        ('tail="one" head="idle" kind="OUTPUT"', 'tail="one" head="idle" kind="INPUT"', "'idle'"),
    ],
)
def test_unsupported_greatspn_features_are_refused(old: str, new: str, said: str) -> None:
    text = PNPRO.replace(old, new).replace(
        "</text-box>", "</fluid>" if new == "<fluid" else "</text-box>"
    )
    with pytest.raises(NetFileError, match=said):
        parse_pnpro(text)


TINA = r"""# a comment
net {my net}
tr t1 : go [0,w[ p*2 q?3 {r s}?-2 -> q {r s}
tr t2 q -> p*2
pl p : start (2) (1K)
pl q (3)
pr t1 > t2
"""


def test_tina_nets() -> None:
    model = parse_tina(TINA)
    assert model.net.places == ("p", "q", "r s") and model.net.initial == (1002, 3, 0)
    assert model.net.consume[0] == ((0, 2), (1, 3)) and model.net.produce[0] == ((1, 4), (2, 1))
    assert model.net.inhibit[0] == ((2, 2),) and model.net.priority == (1, 0)
    assert model.labels == {"t1": "go", "p": "start"} and model.name == "my net"
    empty = parse_tina("net {}\npl p : {}\nlb p {}\n")
    assert not empty.labels and not empty.name and "net" not in write_tina(empty)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("tr t [1,2] p -> q", "time interval"),
        ("tr t p q", "no ->"),
        ("tr t p!2 -> q", "unknown arc 'p!2'"),
        ("tr t p -> q?1", "unknown arc 'q\\?1'"),
        ("zz t", "begins with 'zz'"),
        ("pl p 3", "after a place"),
        ("pl p (2", "after a place"),
        ("pl", "without a name"),
        ("pl p :", "no label after the colon"),
        ("lb p", "needs a node and a text"),
        ("lb", "needs a node and a text"),
        ("lb p q", "no such node"),
        ("net a b", "unexpected 'b'"),
        ("tr", "without a name"),
        ("tr t :", "no label after the colon"),
        ("tr t : go p", "no ->"),
        ("tr t p -> q -> r", "two ->"),
        ("tr t {p -> q", "braces come in pairs"),
        ("tr t *2 -> q", "unknown arc"),
        ("tr a p -> p\\\n q\npr a", "pr: not of the form"),
        ("tr a p -> p\npr a > b", "'b' is not a transition"),
        ("tr a p -> p\ntr b p -> p\npr a > b\npr b > a", "form a cycle"),
        ("tr a p -> p\npr a > a", "form a cycle"),
    ],
)
def test_tina_lines_that_cannot_be_read(line: str, said: str) -> None:
    with pytest.raises(NetFileError, match=said) as caught:
        parse_tina(line, "x.net")
    assert re.match(r"x\.net:\d: ", str(caught.value))


def test_priorities_that_do_not_form_levels_are_refused() -> None:
    with pytest.raises(NetFileError, match="between some pairs only"):
        parse_tina("tr a p -> p\ntr b p -> p\ntr c p -> p\npr a > b\n")


@settings(max_examples=40, deadline=None)
@given(nets(capacities=False))
def test_tina_round_trip_of_any_net(net: Net) -> None:
    again = parse_tina(write_tina(NetFile(net))).net
    assert (again.initial, again.consume, again.produce, again.inhibit) == _in_order(net, again)
    levels = {p: i for i, p in enumerate(sorted(set(net.priority)))}
    assert again.priority == tuple(levels[p] for p in net.priority)


def _in_order(net: Net, other: Net) -> tuple[object, ...]:
    """Return the parts of a net with its places in the order of another net."""
    number = {p: other.place_index[name] for p, name in enumerate(net.places)}
    arcs = [
        tuple(tuple(sorted((number[p], w) for p, w in a)) for a in table)
        for table in (net.consume, net.produce, net.inhibit)
    ]
    initial = tuple(net.initial[net.place_index[name]] for name in other.places)
    return (initial, *arcs)


@settings(max_examples=40, deadline=None)
@given(nets(priorities=False, inhibitors=False))
def test_capacities_are_kept_as_inhibitors(net: Net) -> None:
    try:
        again = parse_tina(write_tina(NetFile(net))).net
    except NetFileError:
        return
    one, two = (explore(n, limits=SearchLimits(states=200)) for n in (net, again))
    assert len(one) == len(two) and one.edges == two.edges


def test_that_immediate_transitions_come_first_is_lost_without_priorities() -> None:
    """A format without priorities has markings in which a timed transition fired before an
    immediate one. So their order is lost, not only their times."""
    net = Net.build({"a": 1}, {"now": ({"a": 1}, {}), "later": ({"a": 1}, {})})
    gspn = Gspn.of(net, {"later": 1.0})
    model = NetFile(gspn.net, gspn=gspn)
    assert "priorities" in losses(model, ".lola")
    assert "priorities" not in losses(model, ".net")
    timed = Gspn.of(net, {"now": 1.0, "later": 1.0})
    assert "priorities" not in losses(NetFile(timed.net, gspn=timed), ".lola")


def test_files_are_chosen_by_their_ending(tmp_path: Path) -> None:
    gspn = Gspn.of(queue(3), {"arrive": 1.0, "serve": 2.0})
    model = NetFile(gspn.net, "queue", gspn)
    for ending in (".pnml", ".net", ".pnpro"):
        text, lost = written(model, Path(f"queue{ending}"))
        path = tmp_path / f"queue{ending}"
        path.write_text(text, encoding="utf-8")
        assert explore(read_net(path).net).edges == 6
        assert any("rates" in note for note in lost) is (ending != ".pnpro")
    for path, said in ((tmp_path / "a.txt", "ending"), (tmp_path / "missing.pnml", "No such file")):
        with pytest.raises(NetFileError, match=said):
            read_net(path)
    with pytest.raises(
        NetFileError,
        match=r"net\.xyz: file: no writer for the ending \.xyz; end its name in \.pnml",
    ):
        written(model, Path("net.xyz"))
    with pytest.raises(NetFileError, match="net: file: no writer for a file without ending"):
        written(model, Path("net"))
    with pytest.raises(NetFileError, match=r"net\.drn: rates: .*give rates"):
        written(NetFile(gspn.net), Path("net.drn"))


def test_losses_are_listed() -> None:
    net = Net.build({"p": 1}, {"t": ({"p": 1}, {})}, inhibitors={"t": {"p": 2}}, capacity={"p": 3})
    assert len(losses(NetFile(net), ".pnml")) == 2
    assert write_tina(NetFile(net)) and "?-2" in write_tina(NetFile(net))


def test_dot_and_drn() -> None:
    gspn = Gspn.of(kanban(1), KANBAN_RATES)
    dot, _ = written(NetFile(gspn.net, 'a "net"', gspn), Path("net.dot"))
    assert (
        dot.count("->") == sum(map(len, (*gspn.net.consume, *gspn.net.produce)))
        and r"\"net\"" in dot
    )
    drn, _ = written(NetFile(gspn.net, gspn=gspn), Path("net.drn"))
    assert "@nr_states\n160\n" in drn and drn.count("\taction 0") == 160
    rates = [float(line.split(":")[1]) for line in drn.splitlines() if line.startswith("\t\t")]
    names = Net.build({"init": 1, "a b": 0, "a_b": 0}, {"t": ({"init": 1}, {"a b": 1, "a_b": 1})})
    drn = FORMATS[".drn"].write(NetFile(names, gspn=Gspn.of(names, {"t": 1.0})))
    assert re.findall("state . .*", drn) == [
        "state 0 !1.0 init init_2",
        "state 1 !1.0 deadlock a_b a_b_2",
    ]
    chain = Chain.of(gspn)
    assert sum(rates) == pytest.approx(float(chain.amount.sum()))


def test_a_drn_chain_may_begin_without_time() -> None:
    """A CTMC where the first tangible marking is certain, else a Markov automaton."""
    arcs = {"l": ({"go": 1}, {"a": 1}), "r": ({"go": 1}, {"b": 1}), "t": ({"a": 1}, {"b": 1})}
    both = Net.build({"go": 1, "a": 0, "b": 0}, arcs)
    drn = FORMATS[".drn"].write(
        NetFile(both, gspn=Gspn.of(both, {"t": 4.0}, weights={"l": 1.0, "r": 3.0}))
    )
    assert "@type: Markov Automaton\n" in drn and "@nr_states\n3\n@nr_choices\n3\n" in drn
    assert drn.endswith(
        "state 0 !4.0 a\n\taction 0\n\t\t1 : 1.0\n"
        "state 1 !1.0 deadlock b\n\taction 0\n\t\t1 : 1.0\n"
        "state 2 !0 init\n\taction 0\n\t\t0 : 0.25\n\t\t1 : 0.75\n"
    )
    one = Net.build({"go": 1, "a": 0, "b": 0}, {name: arcs[name] for name in "lt"})
    drn = FORMATS[".drn"].write(NetFile(one, gspn=Gspn.of(one, {"t": 4.0})))
    assert "@type: CTMC\n" in drn and "state 0 !4.0 init a\n\taction 0\n\t\t1 : 4.0" in drn


def lola_net(text: str) -> Net:
    """Read a LoLA file as its grammar says, with none of the writer's code."""
    net = r"PLACE ([^;]+);\s+MARKING ([^;]*);\s+((?:TRANSITION[^;]+;[^;]+;\s+)+)"
    transition = r"TRANSITION (\S+)\s+CONSUME ([^;]*);\s+PRODUCE ([^;]*);\s+"
    whole = re.fullmatch(net, text)
    assert whole is not None

    def numbers(body: str) -> dict[str, int]:
        parts = [part.partition(": ") for part in body.split(", ")] if body else []
        assert len({name for name, _, _ in parts}) == len(parts)
        assert all(number.isdigit() for _, colon, number in parts if colon)
        return {name: int(number or 1) for name, _, number in parts}

    places = dict.fromkeys(whole[1].split(", "), 0)
    marked = numbers(whole[2])
    assert marked.keys() <= places.keys()
    found = re.findall(transition, whole[3])
    assert re.sub(transition, "", whole[3]) == ""
    return Net.build(places | marked, {n: (numbers(i), numbers(o)) for n, i, o in found})


@settings(max_examples=80, deadline=None)
@given(nets(priorities=False, inhibitors=False), st.data())
def test_a_net_for_lola_has_the_same_graph(net: Net, data: st.DataObject) -> None:
    """With capacities, and with inhibitor arcs on places that have one."""
    bars = [
        (p, st.integers(1, most + 2)) for p, most in enumerate(net.capacity) if most is not None
    ]
    some = st.tuples(*(st.none() | least for _, least in bars))
    inhibit = tuple(
        tuple((p, k) for (p, _), k in zip(bars, data.draw(some), strict=True) if k is not None)
        for _ in net.transitions
    )
    net = replace(net, inhibit=inhibit)
    again = lola_net(FORMATS[".lola"].write(NetFile(net)))
    one, two = (explore(n, limits=SearchLimits(states=200)) for n in (net, again))
    assert len(one) == len(two) and one.edges == two.edges


@settings(max_examples=40, deadline=None)
@given(nets())
def test_lola_explores_at_least_what_can_happen(net: Net) -> None:
    """Whatever is left out only forbids."""
    again = lola_net(FORMATS[".lola"].write(NetFile(net)))
    one, two = (explore(n, limits=SearchLimits(states=100)) for n in (net, again))
    if two.complete:
        width = len(net.places)
        reached = {two.marking(i)[:width] for i in range(len(two))}
        assert {one.marking(i) for i in range(len(one))} <= reached


@pytest.mark.parametrize(
    ("net", "said"),
    [
        (Net.build({}, {"t": ({}, {})}), "lola: places: the net has none; LoLA reads no net"),
        (Net.build({"p": 1}, {}), "lola: transitions: the net has none"),
        (
            Net.build({"p": 2}, {"t": ({"p": 1}, {})}, capacity={"p": 1}),
            "place p: 2 tokens are more than its capacity 1; raise the capacity",
        ),
    ],
)
def test_a_net_that_lola_cannot_hold_is_refused(net: Net, said: str) -> None:
    with pytest.raises(NetFileError, match=said):
        FORMATS[".lola"].write(NetFile(net))


@pytest.mark.parametrize("name", ["PLACE", "a b", "1", "p-1", "SAFE"])
def test_names_that_lola_does_not_allow_are_replaced(name: str) -> None:
    text, lost = written(
        NetFile(Net.build({name: 1, "p.free": 0}, {"t": ({name: 1}, {})}, capacity={name: 1})),
        Path("net.lola"),
    )
    assert name not in lola_net(text).places and any("ids that the format" in what for what in lost)


def test_a_net_without_namespace_is_written_with_it() -> None:
    text = write_pnml(parse_pnml(arc_file("")))
    assert ElementTree.fromstring(text).tag == f"{{{NAMESPACE}}}pnml"
    assert "ns0" not in text and "ns0" not in write_pnml(parse_pnml(ISO))


def test_entities_are_refused() -> None:
    """A document with entities could grow without bound, so it is not even parsed (str and
    bytes)."""
    text = (
        '<!DOCTYPE pnml [<!ENTITY a "aaaa">]><pnml><net id="n"><page id="g"><place '
        'id="&a;"/></page></net></pnml>'
    )
    for form in (text, text.encode()):
        with pytest.raises(NetFileError, match="defines XML entities"):
            parse_pnml(form)


# --- the table of what formats can say ------------------------------------------------------------


@st.composite
def models(draw: st.DrawFn) -> NetFile:
    """Return a net with labels, positions and, perhaps, rates."""
    gspn = draw(st.none() | gspns())
    net = draw(nets()) if gspn is None else gspn.net
    names = (*net.places, *net.transitions)
    some = st.lists(st.sampled_from(names), unique=True)
    spots = st.floats(-1e4, 1e4).map(lambda x: round(x, 3))
    return NetFile(
        net,
        draw(st.sampled_from(["", "a net", "a\nnet"])),
        gspn,
        {name: draw(st.sampled_from(["text", "<&>", "a b", "a\nb"])) for name in draw(some)},
        {name: (draw(spots), draw(spots)) for name in draw(some)},
    )


@settings(max_examples=80, deadline=None)
@given(models(), st.sampled_from([".pnml", ".net", ".pnpro"]))
def test_what_is_not_listed_as_lost_is_kept(model: NetFile, ending: str) -> None:
    """Compare a net that was written and read again, feature by feature, with the table."""
    try:
        text = FORMATS[ending].write(model)
    except NetFileError as error:
        assert "can never fire" in str(error)
        return
    again = READ[ending](text.encode(), "file")
    lost = {what.split(":")[0] for what in losses(model, ending)}
    one, two = again.gspn, model.gspn
    kept = {
        Feature.NAME: again.name == model.name or not model.name,
        Feature.LABELS: dict(again.labels) == dict(model.labels),
        Feature.POSITIONS: all(again.positions.get(n) == at for n, at in model.positions.items()),
        Feature.INHIBITORS: sum(map(len, again.net.inhibit)) >= sum(map(len, model.net.inhibit)),
        Feature.PRIORITIES: _order(again.net.priority) == _order(model.net.priority),
        Feature.RATES: (one and one.rate) == (two and two.rate),
        Feature.SERVERS: (one and one.servers) == (two and two.servers),
    }
    for feature, is_kept in kept.items():
        if HAS[feature](model) and str(feature) not in lost:
            assert is_kept, feature
        elif str(feature) in lost and feature not in FORMATS[ending].says:
            assert not is_kept, feature


def _order(priorities: tuple[int, ...]) -> list[int]:
    """Return the rank of each priority."""
    return [sorted(set(priorities)).index(own) for own in priorities]


@pytest.mark.parametrize("ending", sorted(FORMATS))
def test_odd_names_are_written_and_listed(ending: str) -> None:
    """A place and a transition of the same name, names with spaces, quotes and leading digits."""
    gspn = Gspn.of(
        Net.build({"a b": 1, "x": 0, "1": 0}, {"x": ({"a b": 1}, {"x": 1}), 't"': ({"x": 1}, {})}),
        {"x": 1.0, 't"': 2.0},
    )
    text, lost = written(NetFile(gspn.net, "n", gspn), Path(f"net{ending}"))
    if ending in READ:
        net = READ[ending](text.encode(), "file").net
        assert len(set(net.places + net.transitions)) == 5
        assert len(explore(net)) == len(explore(gspn.net))
        assert any("'x' as 'x_2'" in what or "'x' as 't_x'" in what for what in lost)


# --- mutated files --------------------------------------------------------------------------------

SAMPLES = {".pnml": [ISO, PIPE.format(empty="Default,1"), TAPAAL], ".pnpro": [PNPRO]}


@st.composite
def mutated_trees(draw: st.DrawFn) -> tuple[str, str]:
    """Return (ending, a sample in which some elements or attributes were changed)."""
    ending, texts = draw(st.sampled_from(sorted(SAMPLES.items())))
    root = ElementTree.fromstring(draw(st.sampled_from(texts)))
    words = st.sampled_from(
        ["", "p", "t", "P0", "1", "-1", "1.5", "nan", "[1,2]", "lambda", "arc", "inhibitor", "é"]
    )
    tags = st.sampled_from(["arc", "place", "inputArc", "page", "text", "value", "type", "other"])
    for _ in range(draw(st.integers(1, 4))):
        nodes = list(root.iter())
        node = draw(st.sampled_from(nodes))
        parent = draw(st.sampled_from(nodes))
        match draw(st.integers(0, 5)):
            case 0:
                node.set(
                    draw(st.sampled_from(["id", "source", "type", "weight", "new"])), draw(words)
                )
            case 1:
                node.text = draw(words)
            case 2:
                prefix = node.tag.rpartition("}")[0]
                node.tag = (prefix + "}" if prefix else "") + draw(tags)
            case 3:
                if node not in parent.iter() and parent not in node.iter():
                    parent.append(node)
            case 4:
                parent.extend([deepcopy(child) for child in parent][:3])
            case _:
                if node.attrib:
                    del node.attrib[draw(st.sampled_from(sorted(node.attrib)))]
    return ending, ElementTree.tostring(root, encoding="unicode")


SKIPPED = ("toolspecific", "graphics", "finalmarkings", "labels", "stategroup", "name", "text-box")
"""Elements whose content is about something other than the net."""


def arcs_in(element: ElementTree.Element) -> Iterator[tuple[str, ...]]:
    """Yield the nodes that each element joins, found without any knowledge of the formats."""
    for child in element:
        if child.tag.rpartition("}")[2] in SKIPPED:
            continue
        ends = [child.get(key) for key in ("source", "tail", "transition", "target", "head")]
        if len(found := [end for end in ends if end]) > 1:
            yield tuple(found)
        yield from arcs_in(child)


@settings(max_examples=400, deadline=None)
@given(mutated_trees())
def test_no_mutated_file_loses_an_arc_or_ends_in_a_traceback(case: tuple[str, str]) -> None:
    ending, text = case
    try:
        model = READ[ending](text.encode(), "file")
    except NetFileError as error:
        assert str(error).startswith("file:")
        return
    net, root = model.net, ElementTree.fromstring(text)
    refs = {n.get("id"): n.get("ref") for n in root.iter() if n.get("ref") is not None}

    def resolved(name: str | None) -> str | None:
        for _ in refs:
            name = refs.get(name, name)
        return name

    joined = {
        frozenset((net.places[p], net.transitions[t]))
        for table in (net.consume, net.produce, net.inhibit)
        for t, arcs in enumerate(table)
        for p, _ in arcs
    }
    for ends in arcs_in(root):
        named = [resolved(end) for end in ends]
        assert all(frozenset(pair) in joined for pair in pairwise(named)), ends


def read_or_refused(read: Callable[[], object]) -> None:
    """Check that a text becomes a net or an error that names the file."""
    try:
        assert read() is not None
    except NetFileError as refused:
        assert str(refused).startswith("file"), refused


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_no_bytes_end_in_a_traceback(data: st.DataObject) -> None:
    ending = data.draw(st.sampled_from(sorted(READ)))
    texts = {**SAMPLES, ".net": [TINA]}.get(ending, SAMPLES[".pnml"])
    raw = bytearray(data.draw(st.sampled_from(texts)).encode())
    for _ in range(data.draw(st.integers(1, 5))):
        at = data.draw(st.integers(0, len(raw) - 1))
        raw[at : at + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=4))
        raw = raw or bytearray(b"x")
    read_or_refused(lambda: READ[ending](bytes(raw), "file"))


SIGNS = "* ? : -> > < (1) (2K) [0,w[ [1,2] p*2 p?1 p?-2 # { }"
WORDS = st.sampled_from(
    ["net", "tr", "pl", "lb", "pr", "nt", "a", "b", "{c d}", "p", "q", "\\\n", *SIGNS.split()]
)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.lists(WORDS, max_size=8).map(" ".join), max_size=6).map("\n".join))
def test_no_tina_text_ends_in_a_traceback(text: str) -> None:
    read_or_refused(lambda: parse_tina(text, "file"))
