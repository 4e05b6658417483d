"""Reader and writer of PNML (ISO/IEC 15909-2): place/transition nets, pages, reference nodes.

The reader also accepts what tools write beyond the standard: inhibitor and test arcs as in the
special-arcs extension and ProM (`arctype`), PIPE, TINA, GreatSPN and Storm (`type value`), TAPAAL
and Romeo (`type` attribute), or in tool-specific data; PIPE's `Default,1`, rates, timed flags,
servers and priorities; our own tool-specific data. An arc of an unknown kind is refused, never read
as a normal one.

A net that was read from PNML is written back into its own XML tree, so pages, graphics and the data
of other tools stay. The standard has no inhibitors, capacities, priorities or rates: inhibitor arcs
are written as `<type value="inhibitor"/>`, which most tools read, and the rest as our tool-specific
data, which other tools ignore. `losses` lists what a tool would miss that reads only the standard.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from copy import deepcopy
from itertools import count
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from petrobot.coordinator.analysis.formats.netfile import (
    NetDraft,
    NetFile,
    NetFileError,
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
    """Return the tag of an element without its namespace; "" for comments and instructions."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def children(element: Element, tag: str) -> Iterator[Element]:
    """Yield the children with this tag, in any namespace."""
    return (child for child in element if local(child) == tag)


def nodes(net: Element) -> Iterator[Element]:
    """Yield the objects of a net and of its pages at any depth.

    The same tags also occur elsewhere (final markings, tool-specific data, unfoldings); those are
    not objects of the net.
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
    """Return the text of a label (`<tag><text>..` or PIPE's `<tag><value>..`), or None."""
    for child in children(element, tag):
        for inner in child:
            if local(inner) in ("text", "value"):
                return (inner.text or "").strip()
        return (child.text or "").strip()
    return None


def own_data(element: Element) -> dict[str, str]:
    """Return our tool-specific data of an element."""
    for data in children(element, "toolspecific"):
        if data.get("tool") == TOOL:
            return {local(item): (item.text or "").strip() for item in data if local(item)}
    return {}


ENTITY = re.compile(r"<!ENTITY", re.IGNORECASE)


def parse_pnml(text: str | bytes, file: str = "PNML") -> NetFile:
    """Read the net in a PNML text. Raises NetFileError."""
    root = _tree(text, file)
    nets = [root] if local(root) == "net" else list(children(root, "net"))
    if len(nets) != 1:
        problem = f"{len(nets)} nets" if nets else "no <net>"
        raise NetFileError(file, "pnml", problem, "expected one net per file; split it")
    (net,) = nets
    kind = (net.get("type") or "").strip().lower()
    if kind and not any(kind.rstrip("/").endswith(known) for known in PLACE_TRANSITION):
        raise NetFileError(
            file,
            f"net {net.get('id')}",
            f"a net of type {net.get('type')!r}",
            "only P/T nets are read",
        )
    return _PnmlReading(net, file).result(root)


def _tree(text: str | bytes, file: str) -> Element:
    if ENTITY.search(text if isinstance(text, str) else text.replace(b"\0", b"").decode("latin-1")):
        raise NetFileError(
            file,
            "XML",
            "the file defines XML entities",
            "replace them by their text (nested entities could exhaust the memory)",
        )
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    try:
        parser.feed(text)
        root = parser.close()
    except ElementTree.ParseError as error:
        raise NetFileError(file, "XML", str(error), "the file is incomplete or not XML") from error
    assert isinstance(root, Element)
    return root


class _PnmlReading:
    """Reads one net: places, transitions, references, then arcs, which need the others."""

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
        """Return everything that was read. Raises NetFileError."""
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
        if not name:  # missing or empty
            raise NetFileError(self.file, local(node), "it has no id", "every node needs one")
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
        """Return the capacity of a place; PIPE writes 0 for an unlimited one."""
        own = own_data(node).get("capacity")
        if own is not None:
            return self._count(f"capacity of {name}", own)
        return self._count(f"capacity of {name}", label(node, "capacity") or "0") or None

    def _count(self, element: str, text: str) -> int:
        """Return a number, also as PIPE writes it: `Default,2` or `Default,2,Red,0`."""
        parts = [part.strip() for part in text.split(",")]
        if len(parts) > 1:
            pairs = list(zip(parts[::2], parts[1::2], strict=False))
            coloured = [
                colour for colour, n in pairs if colour.lower() != "default" and n not in ("", "0")
            ]
            if coloured:
                raise NetFileError(
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
                f"transition {name}: a priority has no effect on a timed transition of a GSPN"
            )
            self.draft.transitions[name] = 0

    def _number(self, element: str, text: str) -> float:
        try:
            return float(text)
        except ValueError as error:
            raise NetFileError(
                self.file, element, f"expected a number, got {text!r}", "write a rate in 1/s"
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
        """Return the node at the end of a chain of references."""
        seen = {name}
        while name in self.references:
            name = self.references[name]
            if name in seen:
                raise NetFileError(
                    self.file, element, f"the references around {name!r} form a circle"
                )
            seen.add(name)
        return name


def arc_kind(node: Element, file: str, element: str) -> str:
    """Return the kind: normal, inhibitor or test. Raises NetFileError for any other."""
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
    raise NetFileError(file, element, f"an arc of the kind {', '.join(unknown)}", remedy)


def _tool_specific_kinds(data: Element) -> Iterator[str]:
    """Yield arc kinds inside tool-specific data: `<inhibitor/>`, `<type>inhibitor</type>`,
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


NAMESPACE = "http://www.pnml.org/version-2009/grammar/pnml"
TYPE = "http://www.pnml.org/version-2009/grammar/ptnet"

Arc = tuple[str, str, str]
"""(source, target, kind)."""


def losses(model: NetFile) -> list[str]:
    """Return what a reader of the bare standard would miss."""
    net, out = model.net, []
    if any(net.inhibit):
        out.append("inhibitor arcs are not part of ISO PNML: written as <type value='inhibitor'/>")
    if any(c is not None for c in net.capacity):
        out.append("capacities are not part of ISO PNML: written as tool-specific data")
    if len(set(net.priority)) > 1:
        out.append("priorities are not part of ISO PNML: written as tool-specific data")
    if model.gspn is not None:
        out.append("rates and weights are not part of ISO PNML: written as tool-specific data")
    return out


def write_pnml(model: NetFile) -> str:
    """Return the PNML text of a net."""
    root = deepcopy(model.document) if model.document is not None else _fresh(model)
    _PnmlWriting(root, model).update()
    namespace = root.tag[1:].partition("}")[0] if root.tag.startswith("{") else ""
    if namespace:
        ElementTree.register_namespace("", namespace)
    ElementTree.indent(root)
    return (
        "<?xml version='1.0' encoding='UTF-8'?>\n"
        + ElementTree.tostring(root, encoding="unicode")
        + "\n"
    )


def _fresh(model: NetFile) -> Element:
    root = Element(f"{{{NAMESPACE}}}pnml")
    net = SubElement(root, f"{{{NAMESPACE}}}net", {"id": "net", "type": TYPE})
    if model.name:
        SubElement(
            SubElement(net, f"{{{NAMESPACE}}}name"), f"{{{NAMESPACE}}}text"
        ).text = model.name
    SubElement(net, f"{{{NAMESPACE}}}page", {"id": "page"})
    return root


def _pages(net: Element) -> Iterator[Element]:
    """Yield the net and its pages at any depth: everything that contains nodes and arcs."""
    yield net
    for page in children(net, "page"):
        yield from _pages(page)


class _PnmlWriting:
    """Updates an XML tree to match a net, and leaves everything else in it alone."""

    def __init__(self, root: Element, model: NetFile) -> None:
        self.root, self.model, self.net = root, model, model.net
        self.element = root if local(root) == "net" else next(children(root, "net"))
        self.parents = list(_pages(self.element))
        self.page = self.parents[1] if len(self.parents) > 1 else self.element
        self.prefix = (
            self.element.tag[: self.element.tag.index("}") + 1] if "}" in self.element.tag else ""
        )
        self.references = {
            node.get("id"): node.get("ref")
            for node in nodes(self.element)
            if local(node).startswith("reference")
        }

    def update(self) -> None:
        """Remove what the net no longer has, set what it has, and add what is new."""
        self._drop_missing()
        known = {
            node.get("id"): node
            for node in nodes(self.element)
            if local(node) in ("place", "transition")
        }
        for p, name in enumerate(self.net.places):
            self._place(known.get(name), name, p)
        for t, name in enumerate(self.net.transitions):
            self._transition(known.get(name), name, t)
        self._arcs()

    def _drop_missing(self) -> None:
        names = {"place": set(self.net.places), "transition": set(self.net.transitions)}
        for parent in self.parents:
            for node in list(parent):
                if node.get("id") not in names.get(local(node), {node.get("id")}):
                    parent.remove(node)

    def _place(self, node: Element | None, name: str, p: int) -> None:
        node = node if node is not None else self._new("place", name)
        tokens, capacity = self.net.initial[p], self.net.capacity[p]
        self._set(
            node, "initialMarking", str(tokens) if tokens or _has(node, "initialMarking") else None
        )
        limits = (
            {"capacity": str(capacity)}
            if capacity is not None and not _has(node, "capacity")
            else {}
        )
        self._own(node, limits)

    def _transition(self, node: Element | None, name: str, t: int) -> None:
        node = node if node is not None else self._new("transition", name)
        data, gspn = {}, self.model.gspn
        if self.net.priority[t] and not _has(node, "priority"):
            data["priority"] = str(self.net.priority[t])
        if gspn is not None and not _has(node, "rate"):
            rate, servers = gspn.rate[t], gspn.servers[t]
            data |= {"rate": repr(rate)} if rate is not None else {"weight": repr(gspn.weight[t])}
            if rate is not None and servers != 1:
                data["servers"] = str(servers) if servers is not None else "infinite"
        elif gspn is not None:
            rate = gspn.rate[t]
            self._set(node, "rate", repr(rate if rate is not None else gspn.weight[t]))
        self._own(node, data)

    def _new(self, tag: str, name: str) -> Element:
        node = SubElement(self.page, f"{self.prefix}{tag}", {"id": name})
        self._set(node, "name", self.model.labels.get(name, name))
        if name in self.model.positions:
            x, y = self.model.positions[name]
            graphics = SubElement(node, f"{self.prefix}graphics")
            SubElement(graphics, f"{self.prefix}position", {"x": f"{x:g}", "y": f"{y:g}"})
        return node

    def _set(self, node: Element, tag: str, text: str | None) -> None:
        """Set a label in the form it already has in the file (`text` or `value`), else as
        `text`."""
        if text is None:
            return
        for child in children(node, tag):
            for inner in child:
                if local(inner) in ("text", "value"):
                    piped = "," in (inner.text or "")
                    inner.text = f"Default,{text}" if piped else text
                    return
            child.text = text
            return
        SubElement(SubElement(node, f"{self.prefix}{tag}"), f"{self.prefix}text").text = text

    def _own(self, node: Element, data: dict[str, str]) -> None:
        for old in list(children(node, "toolspecific")):
            if old.get("tool") == TOOL:
                node.remove(old)
        if data:
            own = SubElement(node, f"{self.prefix}toolspecific", {"tool": TOOL, "version": "1"})
            for key, value in data.items():
                SubElement(own, f"{self.prefix}{key}").text = value

    def _wanted(self) -> dict[Arc, int]:
        wanted: dict[Arc, int] = {}
        for t, name in enumerate(self.net.transitions):
            wanted |= {(self.net.places[p], name, "normal"): w for p, w in self.net.consume[t]}
            wanted |= {(name, self.net.places[p], "normal"): w for p, w in self.net.produce[t]}
            wanted |= {(self.net.places[p], name, "inhibitor"): w for p, w in self.net.inhibit[t]}
        return wanted

    def _arcs(self) -> None:
        wanted, used = self._wanted(), {node.get("id") for node in self.root.iter()}
        for parent in self.parents:
            for node in [child for child in parent if local(child) == "arc"]:
                arc = (
                    self._resolved(node.get("source")),
                    self._resolved(node.get("target")),
                    arc_kind(node, "", ""),
                )
                weight = wanted.pop(arc, None)
                if weight is None:
                    parent.remove(node)
                else:
                    self._set(
                        node,
                        "inscription",
                        str(weight) if weight > 1 or _has(node, "inscription") else None,
                    )
        fresh = (f"arc{i}" for i in count() if f"arc{i}" not in used)
        for (source, target, kind), weight in wanted.items():
            node = SubElement(
                self.page,
                f"{self.prefix}arc",
                {"id": next(fresh), "source": source, "target": target},
            )
            if weight > 1:
                self._set(node, "inscription", str(weight))
            if kind == "inhibitor":
                SubElement(node, f"{self.prefix}type", {"value": "inhibitor"})

    def _resolved(self, name: str | None) -> str:
        while name in self.references:
            name = self.references[name]
        if name is None:
            raise NetFileError("PNML", "arc", "it has no source or target")
        return name


def _has(node: Element, tag: str) -> bool:
    return any(children(node, tag))
