"""Reader and writer of GreatSPN editor projects (`.pnpro`): one GSPN; Storm reads them too.

In spite of its name, the attribute `delay` of a transition of type EXP is a rate (1/s). Without
`nservers` a timed transition has unlimited servers. Deterministic and general transitions are
refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from xml.etree.ElementTree import Element, SubElement

from petrobot.coordinator.analysis.formats.netfile import (
    NetDraft,
    NetFile,
    NetFileError,
    thresholds,
)
from petrobot.coordinator.analysis.formats.tree import (
    DRAWN,
    READ,
    Known,
    Only,
    Vocabulary,
    check,
    children,
    line_of,
    local,
    parse_tree,
    xml_text,
)

# --- what is understood ---------------------------------------------------------------------------

UNFOLD = "it is a coloured net: unfold it first"
PLAIN = Only(("",), UNFOLD)
WHERE: dict[str, Known] = {
    "name": READ,
    "x": READ,
    "y": READ,
    **dict.fromkeys(("label-x", "label-y", "rotation", "magnets", "superposition-tags"), DRAWN),
}
CONSTANT = Vocabulary(
    {
        **WHERE,
        **dict.fromkeys(("consttype", "type", "last-binding"), DRAWN),
        "value": READ,
    }
)
ELEMENTS = {
    "place": Vocabulary(
        {
            **WHERE,
            "marking": READ,
            "domain": PLAIN,
            "type": Only(("", "discrete"), "continuous places are not read"),
            **dict.fromkeys(
                ("marking-x", "marking-y", "domain-x", "domain-y", "partition", "part-x", "part-y"),
                DRAWN,
            ),
        }
    ),
    "transition": Vocabulary(
        {
            **WHERE,
            **dict.fromkeys(("type", "delay", "weight", "priority", "nservers"), READ),
            "guard": Only(
                ("", "true"), "guards are not read: unfold the net, or draw arcs instead"
            ),
            "action": Only(("", "true"), UNFOLD),
            **dict.fromkeys(
                (
                    *("delay-x", "delay-y", "weight-x", "weight-y", "priority-x", "priority-y"),
                    *("nservers-x", "nservers-y", "guard-x", "guard-y", "action-x", "action-y"),
                ),
                DRAWN,
            ),
        }
    ),
    "constant": CONSTANT,
    "template": CONSTANT,
}
ARC = Vocabulary(
    {
        **dict.fromkeys(("head", "tail", "kind", "mult"), READ),
        **dict.fromkeys(
            (
                *("mult-k", "mult-x", "mult-y", "head-magnet", "tail-magnet"),
                *("broken", "is-broken", "broken-label"),
            ),
            DRAWN,
        ),
    },
    {"point": DRAWN, "broken-edge": DRAWN},
)
NODES = Vocabulary(
    {},
    {**dict.fromkeys(ELEMENTS, READ), "text-box": DRAWN, "group": DRAWN},
    repeated=frozenset(ELEMENTS),
)
GSPN = Vocabulary(
    {
        "name": READ,
        **dict.fromkeys(
            (
                *("zoom", "show-timed-cmd", "show-color-cmd", "show-fluid-cmd", "show-fluid"),
                *("view-rates", "view-guards", "view-priorities", "view-names"),
                *("view-superpos-tags", "version"),
            ),
            DRAWN,
        ),
    },
    {"nodes": READ, "edges": READ},
)
ARC_KINDS = {"INPUT": "normal", "OUTPUT": "normal", "INHIBITOR": "inhibitor"}


def parse_pnpro(text: str | bytes, file: str = "pnpro") -> NetFile:
    """Read the net of a project. Raises NetFileError."""
    root = parse_tree(text, file)
    # Measures and timed automata (DTA) lie beside a net and are not part of it; whatever else has
    # arcs is a net, also under a name that is unknown here.
    nets = [
        one
        for one in root.iter()
        if one.tag == "gspn" or (one.tag != "dta" and one.find("edges") is not None)
    ]
    if root.tag != "project" or len(nets) != 1:
        raise NetFileError(
            file,
            root.tag,
            f"expected one GSPN, found {len(nets)}",
            "save a project with exactly one GSPN",
            line=root.line,
        )
    return _ProjectReading(nets[0], file).result(root)


class _ProjectReading:
    """Reads one net: constants, which the rest may use, then nodes, then arcs."""

    def __init__(self, net: Element, file: str) -> None:
        self.net, self.draft = net, NetDraft(file)
        self.positions: dict[str, tuple[float, float]] = {}
        self._check(net, GSPN, "gspn")
        nodes = [node for group in children(net, "nodes") for node in group if local(node)]
        for group in children(net, "nodes"):
            self._check(group, NODES, "nodes")
        for group in children(net, "edges"):
            edges = Vocabulary({}, {"arc": READ}, repeated=frozenset({"arc"}))
            self._check(group, edges, "edges")
        for node in nodes:
            if node.tag in ELEMENTS:
                self._check(node, ELEMENTS[node.tag], f"{node.tag} {node.get('name')}")
            elif any(inner.tag in ELEMENTS for inner in node.iter()):
                self.draft.line = line_of(node)
                problem = f"<{node.tag}> contains nodes of the net"
                raise self.draft.fault("nodes", problem, "save the net without it")
            if node.tag in ("constant", "template"):
                self._constant(node)
        for node in nodes:
            self.draft.line = line_of(node)
            if node.tag == "place":
                self._place(node)
            elif node.tag == "transition":
                self._transition(node)
        for i, node in enumerate(net.iter("arc")):
            self._arc(node, f"arc {i}")

    def result(self, root: Element) -> NetFile:
        """Return everything that was read. Raises NetFileError."""
        net = self.draft.net()
        gspn = self.draft.gspn(net)
        others = [local(child) for child in root if child is not self.net and local(child)]
        beyond = [f"<{tag}>" for tag in dict.fromkeys(others)]
        for tag in ("text-box", "group", "point"):
            found = sum(1 for _ in self.net.iter(tag))
            beyond += [f"<{tag}> ({found} elements of the drawing)"] if found else []
        beyond += self.draft.beyond()
        return NetFile(
            gspn.net if gspn else net,
            self.net.get("name", ""),
            gspn,
            {},
            self.positions,
            tuple(self.draft.notes),
            tuple(beyond),
        )

    def _check(self, node: Element, known: Vocabulary, what: str) -> None:
        self.draft.line = line_of(node)
        self.draft.notes += check(self.draft.file, node, known, what)

    def _name(self, node: Element) -> str:
        name = node.get("name")
        if not name:
            raise self.draft.fault(node.tag, "it has no name", "every node needs one")
        return name

    def _constant(self, node: Element) -> None:
        name, value = self._name(node), node.get("value") or ""
        if not value:
            raise self.draft.fault(
                f"{node.tag} {name}",
                "it has no value",
                "set a value in the editor (make a template a constant)",
            )
        if name in self.draft.constants:
            raise self.draft.fault(f"{node.tag} {name}", "it is defined twice", "keep one of them")
        self.draft.constants[name] = self.draft.number(f"constant {name}", value)

    def _drawn(self, node: Element, name: str) -> None:
        what = f"position of {name}"
        self.positions[name] = self.draft.position(what, node.get("x"), node.get("y"))

    def _place(self, node: Element) -> None:
        name = self._name(node)
        tokens = self.draft.whole(f"place {name}", node.get("marking") or "0")
        self.draft.place(name, tokens)
        self._drawn(node, name)

    def _transition(self, node: Element) -> None:
        name, kind, draft = self._name(node), node.get("type", ""), self.draft
        element = f"transition {name}"
        if kind == "IMM":
            draft.transition(name, draft.whole(element, node.get("priority") or "1"))
            draft.weights[name] = float(draft.number(element, node.get("weight") or "1"))
        elif kind == "EXP":
            draft.transition(name, 0)
            draft.rates[name] = float(draft.number(element, node.get("delay") or "1"))
            servers = node.get("nservers") or "Infinite"
            words: dict[str, int | None] = {"Infinite": None, "Single": 1}
            draft.servers[name] = (
                words[servers] if servers in words else draft.whole(element, servers)
            )
        else:
            raise draft.fault(
                element, f"a transition of type {kind!r}", "EXP and IMM transitions are read"
            )
        self._drawn(node, name)

    def _arc(self, node: Element, element: str) -> None:
        self._check(node, ARC, element)
        kind = node.get("kind", "")
        if kind not in ARC_KINDS:
            raise self.draft.fault(
                element, f"an arc of kind {kind!r}", f"kinds are {', '.join(ARC_KINDS)}"
            )
        weight = self.draft.whole(element, node.get("mult") or "1")
        ends = node.get("tail", ""), node.get("head", "")
        if kind != "INHIBITOR" and (ends[0] in self.draft.places) != (kind == "INPUT"):
            raise self.draft.fault(
                element,
                f"an arc of kind {kind} from {ends[0]!r} to {ends[1]!r}",
                "INPUT leads from a place to a transition, OUTPUT back",
            )
        self.draft.arc(*ends, weight, ARC_KINDS[kind], element)


# --- writing --------------------------------------------------------------------------------------

IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
PITCH = 4.0
"""Distance of nodes without positions, in the editor's units (a place is about 2 wide)."""


def write_pnpro(model: NetFile) -> str:
    """Return a project with the net; capacities become inhibitor arcs with the same effect.

    Without rates all transitions are immediate, with their own priorities. Raises NetFileError.
    """
    model, _ = model.with_names(IDENTIFIER)
    net, gspn = model.net, model.gspn
    root = Element("project", {"name": model.name or "net", "version": "121"})
    element = SubElement(root, "gspn", {"name": model.name or "net"})
    nodes, edges = SubElement(element, "nodes"), SubElement(element, "edges")
    least = min(net.priority, default=0)
    for p, name in enumerate(net.places):
        marking = {"marking": str(net.initial[p])} if net.initial[p] else {}
        SubElement(nodes, "place", {"name": name, **marking, **_at(model.positions, name, p, 0)})
    for t, name in enumerate(net.transitions):
        if gspn is None:
            kind = {"type": "IMM", "priority": str(net.priority[t] - least + 1)}
        elif (rate := gspn.rate[t]) is None:
            kind = {"type": "IMM", "priority": str(net.priority[t]), "weight": repr(gspn.weight[t])}
        else:
            servers = gspn.servers[t]
            kind = {"type": "EXP", "delay": repr(rate)}
            kind["nservers"] = str(servers) if servers is not None else "Infinite"
        SubElement(nodes, "transition", {"name": name, **kind, **_at(model.positions, name, t, 1)})
    for t, name in enumerate(net.transitions):
        for p, k in thresholds(net, t):
            _edge(edges, net.places[p], name, "INHIBITOR", k)
        for p, w in net.consume[t]:
            _edge(edges, net.places[p], name, "INPUT", w)
        for p, w in net.produce[t]:
            _edge(edges, name, net.places[p], "OUTPUT", w)
    return xml_text(root)


def _at(
    positions: Mapping[str, tuple[float, float]], name: str, number: int, row: int
) -> dict[str, str]:
    x, y = positions.get(name, (PITCH * number, PITCH * row))
    return {"x": f"{x:.10g}", "y": f"{y:.10g}"}


def _edge(edges: Element, tail: str, head: str, kind: str, weight: int) -> None:
    mult = {"mult": str(weight)} if weight > 1 else {}
    SubElement(edges, "arc", {"tail": tail, "head": head, "kind": kind, **mult})
