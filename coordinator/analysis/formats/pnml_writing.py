"""PNML out. A net that came from a PNML file goes back into its own tree: pages, graphics,
tool-specific data and names stay.

The standard has no inhibitors, capacities, priorities or rates: inhibitor arcs are written as
`<type value="inhibitor"/>`, which the most tools read, and the rest as our tool-specific data,
which every tool may ignore. `losses` lists what a tool that reads the standard alone would miss.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from itertools import count
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from petrobot.coordinator.analysis.formats.netfile import FormatError, NetFile
from petrobot.coordinator.analysis.formats.pnml_reading import (
    TOOL,
    arc_kind,
    children,
    local,
    nodes,
)

NAMESPACE = "http://www.pnml.org/version-2009/grammar/pnml"
TYPE = "http://www.pnml.org/version-2009/grammar/ptnet"

Arc = tuple[str, str, str]
"""(source, target, kind)."""


def losses(model: NetFile) -> list[str]:
    """What a reader of the bare standard would miss."""
    net, out = model.net, []
    if any(net.inhibit):
        out.append("inhibitor arcs are no part of ISO PNML: written as <type value='inhibitor'/>")
    if any(c is not None for c in net.capacity):
        out.append("capacities are no part of ISO PNML: written as tool-specific data")
    if len(set(net.priority)) > 1:
        out.append("priorities are no part of ISO PNML: written as tool-specific data")
    if model.gspn is not None:
        out.append("rates and weights are no part of ISO PNML: written as tool-specific data")
    return out


def write_pnml(model: NetFile) -> str:
    """The PNML text of a net."""
    root = deepcopy(model.document) if model.document is not None else _fresh(model)
    _Writing(root, model).update()
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
    """The net and its pages, however deep: whatever holds nodes and arcs."""
    yield net
    for page in children(net, "page"):
        yield from _pages(page)


class _Writing:
    """A tree brought in line with a net."""

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
        """Remove what the net no longer has, set what it has, add what is new."""
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
        """Set a label in the form that it already has in the file (`text` or `value`), else as the
        standard says."""
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
            raise FormatError("PNML", "arc", "it has no source or target")
        return name


def _has(node: Element, tag: str) -> bool:
    return any(children(node, tag))
