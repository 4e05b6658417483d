"""Place/transition nets in PNML (ISO/IEC 15909-2) to and from drawings: names, marking, weights and positions; pure.

Read with the standard library's expat, which expands no external entities; a document with a DTD is refused, so that
internal ones cannot grow either.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from xml.sax.saxutils import escape, quoteattr

import tomlkit

from coordinator.task import Kind, Task

TYPE = "http://www.pnml.org/version-2009/grammar/ptnet"
SPACE = "http://www.pnml.org/version-2009/grammar/pnml"
LARGEST = 4 << 20
_FORBIDDEN = re.compile(r"<!(?:DOCTYPE|ENTITY)", re.IGNORECASE)
_NOT_NAME = re.compile(r"\W+")


class PnmlError(ValueError):
    """The text is no place/transition net in PNML."""


def write(task: Task) -> str:
    """The task's ordinary net, macro places expanded. Inhibitor arcs carry `<type value="inhibitor"/>`, as TINA and
    PIPE read them; what PNML has no words for (events, conditions, ends) is left out."""
    flat = task.flat
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<pnml xmlns="{SPACE}">']
    lines += [f'  <net id="net" type="{TYPE}">', f"    {_named(task.name)}", '    <page id="page">']
    for place in flat.places.values():
        tokens = f"<initialMarking><text>{place.tokens}</text></initialMarking>" if place.tokens else ""
        where = _position(place.x, place.y)
        lines.append(
            f"      <place id={quoteattr(place.name)}>{_named(place.label or place.name)}{where}{tokens}</place>"
        )
    for t in flat.transitions.values():
        where = _position(t.x, t.y)
        lines.append(f"      <transition id={quoteattr(t.name)}>{_named(t.label or t.name)}{where}</transition>")
    for number, (source, target, weight, inhibits) in enumerate(_arcs(flat)):
        inscription = f"<inscription><text>{weight}</text></inscription>" if weight != 1 else ""
        kind = '<type value="inhibitor"/>' if inhibits else ""
        ends = f"source={quoteattr(source)} target={quoteattr(target)}"
        lines.append(f'      <arc id="arc{number}" {ends}>{inscription}{kind}</arc>')
    return "\n".join([*lines, "    </page>", "  </net>", "</pnml>", ""])


def _arcs(task: Task) -> Iterator[tuple[str, str, int, bool]]:
    for t in task.transitions.values():
        yield from ((a.place, t.name, a.weight, False) for a in t.inputs)
        yield from ((t.name, a.place, a.weight, False) for a in t.outputs)
        yield from ((a.place, t.name, a.threshold, True) for a in t.inhibitors)


def _named(name: str) -> str:
    return f"<name><text>{escape(name)}</text></name>"


def _position(x: float | None, y: float | None) -> str:
    return "" if x is None or y is None else f'<graphics><position x="{x:g}" y="{y:g}"/></graphics>'


def read(text: str) -> str:
    """The net as the text of a task file: its places are control places, to be given their meaning by drawing on.

    Raises PnmlError.
    """
    if len(text) > LARGEST or _FORBIDDEN.search(text):
        raise PnmlError("too large, or with a DTD")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as fault:
        raise PnmlError(f"not XML: {fault}") from fault
    nets = [e for e in root if _tag(e) == "net"]
    if _tag(root) != "pnml" or not nets:
        raise PnmlError("no <pnml> with a <net>")
    return _document(nets[0])


def _document(net: ET.Element) -> str:
    nodes = {kind: [e for e in net.iter() if _tag(e) == kind] for kind in ("place", "transition", "arc")}
    names: dict[str, str] = {}
    taken: set[str] = set()
    for element in (*nodes["place"], *nodes["transition"]):
        names[element.get("id", "")] = _free(_text(element, "name") or element.get("id", ""), taken)
    document = tomlkit.document()
    document.add("schema", tomlkit.item(1))
    name = _free(_text(net, "name") or "imported", set())
    document.add("task", tomlkit.item({"name": name, "final": "false"}))
    places = tomlkit.table(is_super_table=True)
    for element in nodes["place"]:
        tokens = _number(_text(element, "initialMarking"), 0)
        fields = {"kind": Kind.CONTROL.value, **({"tokens": tokens} if tokens else {}), **_where(element)}
        places.add(names[element.get("id", "")], tomlkit.item(fields))
    transitions = tomlkit.table(is_super_table=True)
    arcs = _read_arcs(nodes["arc"], names, {names[e.get("id", "")] for e in nodes["place"]})
    for element in nodes["transition"]:
        own = names[element.get("id", "")]
        table = {"in": arcs.get((own, "in"), []), "out": arcs.get((own, "out"), []), **_where(element)}
        transitions.add(own, tomlkit.item(table))
    document.add("places", places)
    document.add("transitions", transitions)
    return tomlkit.dumps(document)


def _read_arcs(elements: list[ET.Element], names: dict[str, str], places: set[str]) -> dict[tuple[str, str], list[str]]:
    arcs: dict[tuple[str, str], list[str]] = {}
    for element in elements:
        source, target = names.get(element.get("source", "")), names.get(element.get("target", ""))
        if source is None or target is None or (source in places) == (target in places):
            raise PnmlError(f"arc {element.get('id')!r} does not join a place and a transition")
        weight = _number(_text(element, "inscription"), 1)
        times = f"*{weight}" if weight > 1 else ""
        inhibits = any(_tag(e) == "type" and e.get("value") == "inhibitor" for e in element)
        if target in places:
            arcs.setdefault((source, "out"), []).append(f"{target}{times}")
        else:
            arcs.setdefault((target, "in"), []).append(f"{'!' if inhibits else ''}{source}{times}")
    return arcs


def _tag(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def _text(element: ET.Element, child: str) -> str:
    for found in element:
        if _tag(found) == child:
            return next((e.text.strip() for e in found if _tag(e) == "text" and e.text), "")
    return ""


def _number(text: str, default: int) -> int:
    digits = re.search(r"\d{1,9}", text)
    return int(digits[0]) if digits else default


def _where(element: ET.Element) -> dict[str, int]:
    for graphics in element:
        position = next((e for e in graphics if _tag(e) == "position"), None) if _tag(graphics) == "graphics" else None
        if position is not None:
            try:
                return {axis: round(float(position.get(axis, ""))) for axis in ("x", "y")}
            except ValueError:
                return {}
    return {}


def _free(label: str, taken: set[str]) -> str:
    stem = _NOT_NAME.sub("_", label.strip()).strip("_") or "element"
    if stem[0].isdigit():
        stem = f"n{stem}"
    name, n = stem, 2
    while name in taken:
        name, n = f"{stem}_{n}", n + 1
    taken.add(name)
    return name
