"""PNML in: ISO/IEC 15909-2 place/transition nets with pages and reference nodes, and what tools
write beyond the standard.

Beyond it: inhibitor and test arcs in the notations of the special-arcs extension and ProM
(`arctype`), PIPE, TINA, GreatSPN and Storm (`type value`), TAPAAL and Romeo (`type` attribute), and
as tool-specific data; PIPE's `Default,1`, rates, timed flags, servers and priorities; our own
tool-specific data. An arc of unknown kind is refused, never taken for a normal one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from petrobot.coordinator.analysis.formats.netfile import (
    FormatError,
    NetDraft,
    NetFile,
    whole_number,
)

TOOL = "petrobot"
NORMAL = {"", "normal", "timed", "place-transition", "transition-place"}
INHIBITOR = {"inhibitor", "inhibition", "inhibitorarc", "logicalinhibitor", "tapninhibitor"}
TEST = {"test", "read", "readarc", "testarc", "logicaltest"}
PLACE_TRANSITION = (
    "ptnet",
    "pnmlcoremodel",
    "p/t net",
    "petri net",
    "ptnetb",
    "ptinhibitornet",
    "inhibitorptnet",
    "gspn",
    "epnml-1.0",
    "epnml-1.1",
    "pnml-pt",
)


def local(element: Element) -> str:
    """An element's tag without its namespace; empty for comments and instructions."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def children(element: Element, tag: str) -> Iterator[Element]:
    """Children with a local tag."""
    return (child for child in element if local(child) == tag)


def nodes(net: Element) -> Iterator[Element]:
    """The objects of a net and of its pages, however deep. What else holds such tags (final
    markings, tool-specific data, unfoldings) is none of them.
    """
    for child in net:
        if local(child) == "page":
            yield from nodes(child)
        elif local(child) in (
            "place",
            "transition",
            "arc",
            "referencePlace",
            "referenceTransition",
        ):
            yield child


def label(element: Element, tag: str) -> str | None:
    """Text of a label child (`<tag><text>..` or PIPE's `<tag><value>..`), None if there is no such
    child."""
    for child in children(element, tag):
        for inner in child:
            if local(inner) in ("text", "value"):
                return (inner.text or "").strip()
        return (child.text or "").strip()
    return None


def own_data(element: Element) -> dict[str, str]:
    """Our tool-specific data of an element."""
    for data in children(element, "toolspecific"):
        if data.get("tool") == TOOL:
            return {local(item): (item.text or "").strip() for item in data if local(item)}
    return {}


ENTITY = re.compile(r"<!ENTITY", re.IGNORECASE)


def parse_pnml(text: str | bytes, file: str = "PNML") -> NetFile:
    """The net in a PNML text. Raises FormatError."""
    root = _tree(text, file)
    nets = [root] if local(root) == "net" else list(children(root, "net"))
    if len(nets) != 1:
        problem = f"{len(nets)} nets" if nets else "no <net>"
        raise FormatError(file, "pnml", problem, "a file holds one net here: split it")
    (net,) = nets
    kind = (net.get("type") or "").strip().lower()
    if kind and not any(kind.rstrip("/").endswith(known) for known in PLACE_TRANSITION):
        raise FormatError(
            file,
            f"net {net.get('id')}",
            f"a net of type {net.get('type')!r}",
            "only P/T nets are read",
        )
    return _Reading(net, file).result(root)


def _tree(text: str | bytes, file: str) -> Element:
    if ENTITY.search(text if isinstance(text, str) else text.replace(b"\0", b"").decode("latin-1")):
        raise FormatError(
            file,
            "XML",
            "a PNML file that defines entities",
            "they can grow without bound: write them out",
        )
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    try:
        parser.feed(text)
        root = parser.close()
    except ElementTree.ParseError as error:
        raise FormatError(file, "XML", str(error), "the file is cut short or no XML") from error
    assert isinstance(root, Element)
    return root


class _Reading:
    """One net being read."""

    def __init__(self, net: Element, file: str) -> None:
        self.element, self.file = net, file
        self.draft = NetDraft(file)
        self.labels: dict[str, str] = {}
        self.positions: dict[str, tuple[float, float]] = {}
        self.references: dict[str, str] = {}
        self.untimed: list[str] = []
        for node in self._nodes("place"):
            self._place(node)
        for node in self._nodes("transition"):
            self._transition(node)
        for tag in ("referencePlace", "referenceTransition"):
            for node in self._nodes(tag):
                self.references[self._id(node)] = node.get("ref") or ""
        for node in self._nodes("arc"):
            self._arc(node)

    def result(self, root: Element) -> NetFile:
        """The file with everything read."""
        net = self.draft.net()
        if self.draft.rates and self.untimed:
            for name in self.untimed:
                self.draft.weights.setdefault(name, 1.0)
        name = label(self.element, "name") or self.element.get("id") or ""
        notes = tuple(self.draft.notes)
        gspn = self.draft.gspn(net)
        return NetFile(
            gspn.net if gspn else net, name, gspn, self.labels, self.positions, notes, root
        )

    def _nodes(self, tag: str) -> Iterator[Element]:
        return (node for node in nodes(self.element) if local(node) == tag)

    def _id(self, node: Element) -> str:
        name = node.get("id")
        if not name:  # an empty one names nothing either
            raise FormatError(self.file, local(node), "it has no id", "every node of PNML has one")
        return name

    def _common(self, node: Element, name: str) -> None:
        text = label(node, "name")
        if text and text != name:
            self.labels[name] = text
        for graphics in children(node, "graphics"):
            for position in children(graphics, "position"):
                self.positions[name] = (
                    float(position.get("x", "0")),
                    float(position.get("y", "0")),
                )

    def _place(self, node: Element) -> None:
        name = self._id(node)
        marking = label(node, "initialMarking") or node.get("initialMarking") or "0"
        tokens = self._count(f"place {name}", marking)
        self.draft.place(name, tokens, self._capacity(node, name))
        self._common(node, name)

    def _capacity(self, node: Element, name: str) -> int | None:
        """A place's capacity; PIPE writes 0 for an unlimited one."""
        own = own_data(node).get("capacity")
        if own is not None:
            return self._count(f"capacity of {name}", own)
        return self._count(f"capacity of {name}", label(node, "capacity") or "0") or None

    def _count(self, element: str, text: str) -> int:
        """A number, also as PIPE writes it: `Default,2` or `Default,2,Red,0`."""
        parts = [part.strip() for part in text.split(",")]
        if len(parts) > 1:
            pairs = list(zip(parts[::2], parts[1::2], strict=False))
            coloured = [
                colour for colour, n in pairs if colour.lower() != "default" and n not in ("", "0")
            ]
            if coloured:
                raise FormatError(
                    self.file,
                    element,
                    f"tokens of the colour {coloured[0]!r}",
                    "only plain tokens are read",
                )
            text = next((n for colour, n in pairs if colour.lower() == "default"), "0")
        return whole_number(self.file, element, text or "0")

    def _transition(self, node: Element) -> None:
        name, own = self._id(node), own_data(node)
        urgency = own.get("priority") or label(node, "priority") or "0"
        self.draft.transition(name, whole_number(self.file, f"priority of {name}", urgency))
        self._common(node, name)
        rate = own.get("rate") or label(node, "rate")
        if "weight" in own:
            self.draft.weights[name] = self._number(f"weight of {name}", own["weight"])
        elif rate is not None and "weight" not in own:
            self._timing(node, name, self._number(f"rate of {name}", rate or "1"), own)
        else:
            self.untimed.append(name)

    def _timing(self, node: Element, name: str, rate: float, own: dict[str, str]) -> None:
        timed = label(node, "timed")
        if timed is not None and timed.lower() != "true":
            self.draft.weights[name] = rate
            return
        self.draft.rates[name] = rate
        infinite = (label(node, "infiniteServer") or "").lower() == "true" or own.get(
            "servers"
        ) == "infinite"
        servers = own.get("servers", "1")
        self.draft.servers[name] = (
            None if infinite else whole_number(self.file, f"servers of {name}", servers)
        )
        if timed is not None and self.draft.transitions[name]:
            self.draft.notes.append(
                f"transition {name}: the priority of a timed transition has no effect in a GSPN"
            )
            self.draft.transitions[name] = 0

    def _number(self, element: str, text: str) -> float:
        try:
            return float(text)
        except ValueError as error:
            raise FormatError(
                self.file, element, f"{text!r} is no number", "write a rate in 1/s"
            ) from error

    def _arc(self, node: Element) -> None:
        element = f"arc {node.get('id') or '(no id)'}"
        source, target = (
            self._resolved(node.get(end) or "", element) for end in ("source", "target")
        )
        inscription = label(node, "inscription") or node.get("inscription") or "1"
        kind = arc_kind(node, self.file, element)
        if node.get("type", "").lower() in ("timed", "tapninhibitor") and inscription.strip() in (
            "[0,inf)",
            "[0,inf]",
            "",
        ):
            inscription = label(node, "weight") or node.get("weight") or "1"
        self.draft.arc(source, target, self._count(element, inscription), kind, element)

    def _resolved(self, name: str, element: str) -> str:
        """The node behind a chain of references."""
        seen = {name}
        while name in self.references:
            name = self.references[name]
            if name in seen:
                raise FormatError(
                    self.file, element, f"the references around {name!r} go round in a circle"
                )
            seen.add(name)
        return name


def arc_kind(node: Element, file: str, element: str) -> str:
    """normal, inhibitor or test. Raises FormatError for any other kind."""
    said = [node.get("type", ""), node.get("arctype", ""), node.get("kind", "")]
    for tag in ("type", "arctype", "arcType"):
        for child in children(node, tag):
            said.append(child.get("value") or label(node, tag) or "")
    said += [local(child) for child in node if local(child).lower() in INHIBITOR | TEST]
    for data in children(node, "toolspecific"):
        said += _tool_specific_kinds(data)
    kinds = {word.strip().lower() for word in said} - NORMAL
    if kinds <= set():
        return "normal"
    if kinds <= INHIBITOR:
        return "inhibitor"
    if kinds <= TEST:
        return "test"
    unknown = sorted(kinds - INHIBITOR - TEST) or sorted(kinds)
    remedy = "normal, inhibitor and test arcs are read; replace it in the tool that wrote the file"
    raise FormatError(file, element, f"an arc of the kind {', '.join(unknown)}", remedy)


def _tool_specific_kinds(data: Element) -> Iterator[str]:
    """Arc kinds told inside tool-specific data: `<inhibitor/>`, `<type>inhibitor</type>`,
    `type="inhibitor"`."""
    for inner in data.iter():
        name = local(inner).lower()
        if name in INHIBITOR | TEST | {"reset"}:
            yield name
        if name in ("type", "arctype", "kind"):
            yield inner.get("value") or (inner.text or "").strip()
            yield from (
                (item.text or "").strip() for item in inner if local(item) in ("text", "value")
            )
        if inner is not data and name == "arc":
            yield inner.get("type", "")
