"""Reader and writer of PNML (ISO/IEC 15909-2): place/transition nets, pages, reference nodes.

The reader also accepts what tools write beyond the standard:

- inhibitor and test arcs as in the special-arcs extension and ProM (`arctype`), PIPE, TINA,
  GreatSPN and Storm (`type value`), TAPAAL and Romeo (`type` attribute), or in tool-specific data;
- PIPE: labels in `value` (`Default,1`), rates, timed flags, servers and priorities;
- TAPAAL: `inputArc`, `outputArc`, `inhibitorArc`, `transportArc`, markings and weights as
  attributes, if no time interval, invariant or urgent transition restricts the net and it is no
  game; what version 4 says again in colours, if `dot` is the only one;
- our own tool-specific data.

`PLACE`, `TRANSITION`, `ARC` and `NET` list everything that is understood; all else is refused.

A net that was read from ISO PNML is written back into its own XML tree, so pages, graphics and the
data of other tools stay; any other net is written as a new ISO document. The standard has no
inhibitors, capacities, priorities or rates. Inhibitor arcs are written in the two notations that
most tools read, and the rest as our tool-specific data, which other tools ignore.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from copy import deepcopy
from itertools import chain, count
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from petrobot.coordinator.analysis.formats.netfile import NetDraft, NetFile, NetFileError
from petrobot.coordinator.analysis.formats.tree import (
    DRAWN,
    LABEL,
    READ,
    Known,
    Note,
    Only,
    Vocabulary,
    check,
    children,
    label,
    line_of,
    local,
    parse_tree,
    spoken,
    xml_text,
)

TOOL = "petrobot"
NORMAL = {"", "normal", "timed", "place-transition", "transition-place"}
INHIBITOR = {"inhibitor", "inhibition", "inhibitorarc", "logicalinhibitor", "tapninhibitor"}
TEST = {"test", "read", "readarc", "testarc", "logicaltest"}
PLACE_TRANSITION = re.compile(
    r"(.*://(.*[/#])?)?(ptnet|pnmlcoremodel|p/t net|petri net|ptnetb|ptinhibitornet|inhibitorptnet"
    r"|gspn|epnml-1\.[01]|pnml-pt|(www\.)?laas\.fr/tina/tpn)/?"
)
"""Types of nets, in lower case: a name, alone or as the last part of an address."""

# --- what is understood ---------------------------------------------------------------------------

UNTIMED = "only untimed nets are read: remove the times, or export the net as untimed"
ENDLESS = Only(("[0,inf]", "[0,w[", "0", "1", ""), UNTIMED, r"\[0,inf\)(:[0-9]+)?")
"""Inscriptions of TAPAAL's timed arcs that restrict nothing; `:2` numbers a pair of transport
arcs."""
UNFOLD = "it is a coloured net: unfold it first"
DOTS = Only((), UNFOLD, r"\(*[0-9]+'dot(\.all)?\)*")
"""How TAPAAL writes a number of uncoloured tokens beside the plain number."""
DOT_SORT = {"declaration", "structure", "declarations", "namedsort", "dot"}
"""What the declaration of a file may contain in which `dot` is the only colour."""
GAME = "games are not read: give every transition to player 0 and save the net as no game"
PLAYER = Only(("0", ""), GAME)
FLAG = Only(("true", "false", ""), "write true or false")
STOCHASTIC = Note(("", "constant", "1", "1.0"), "not read: give rates with --rates")

DRAWING: dict[str, Known] = dict.fromkeys(
    ("displayName", "nameOffsetX", "nameOffsetY", "angle", "size", "rotation"), DRAWN
)
NODE_PARTS: dict[str, Known] = {
    "name": READ,
    "graphics": DRAWN,
    "toolspecific": DRAWN,
    "description": DRAWN,
    "documentation": DRAWN,
    "orientation": DRAWN,
}
POSITIONS: dict[str, Known] = {"positionX": READ, "positionY": READ}
PLACE = Vocabulary(
    {
        **DRAWING,
        **POSITIONS,
        "id": READ,
        "name": READ,
        "initialMarking": READ,
        "invariant": Only(("<inf", ""), UNTIMED),
    },
    {
        **NODE_PARTS,
        "initialMarking": READ,
        "capacity": READ,
        "type": Only(("", "dot"), UNFOLD),
        "hlinitialMarking": DOTS,
    },
)
TRANSITION = Vocabulary(
    {
        **DRAWING,
        **POSITIONS,
        "id": READ,
        "name": READ,
        "infiniteServer": DRAWN,
        "player": PLAYER,
        "urgent": Only(("false", ""), UNTIMED),
        "priority": READ,
        "distribution": STOCHASTIC,
        "rate": STOCHASTIC,
        "value": STOCHASTIC,
        "weight": STOCHASTIC,
        "firingMode": DRAWN,
        # Parameters of the distribution, which has a note of its own.
        **dict.fromkeys(("a", "b", "c", "mean", "stddev", "shape", "scale", "p"), DRAWN),
        **dict.fromkeys(("logMean", "logStddev"), DRAWN),
    },
    {
        **NODE_PARTS,
        "rate": READ,
        "timed": FLAG,
        "infiniteServer": FLAG,
        "priority": READ,
        "player": PLAYER,
        "urgent": Only(("false", ""), UNTIMED),
        "condition": Only(("", "true"), UNFOLD),
        "guard": Only(("", "true"), UNFOLD),
        "delay": Only(("0infty", "0infinity"), UNTIMED),
    },
)
ARC = Vocabulary(
    {
        **DRAWING,
        "id": READ,
        "source": READ,
        "target": READ,
        "type": READ,
        "arctype": READ,
        "kind": READ,
        "weight": READ,
        "inscription": READ,
        "transportID": DRAWN,
    },
    {
        **NODE_PARTS,
        "inscription": READ,
        "weight": READ,
        "type": READ,
        "arctype": READ,
        "arcType": READ,
        "arcpath": DRAWN,
        "tagged": Only(("false", ""), "tagged tokens are not read"),
        "hlinscription": DOTS,
        **dict.fromkeys(("inhibitor", "inhibition", "read", "test"), READ),
    },
)
REFERENCE = Vocabulary({**DRAWING, "id": READ, "ref": READ}, NODE_PARTS)
ARCS = {"arc": "", "inputArc": "", "outputArc": "", "inhibitorArc": "inhibitor", "transportArc": ""}
"""Elements that are arcs, with the kind that the element alone says."""
OBJECTS = {
    "place": PLACE,
    "transition": TRANSITION,
    "referencePlace": REFERENCE,
    "referenceTransition": REFERENCE,
    **dict.fromkeys(ARCS, ARC),
    "transportArc": Vocabulary({**ARC.attributes, "transition": READ}, ARC.children),
}
NET = Vocabulary(
    {
        "id": READ,
        "type": READ,
        "name": READ,
        "active": Only(("true",), "activate the net, or give a file with one net"),
    },
    {
        **dict.fromkeys((*OBJECTS, "page", "name"), READ),
        **dict.fromkeys(
            (
                "graphics",
                "toolspecific",
                "description",
                "documentation",
                "labels",
                "token",
                "stategroup",
                "finalmarkings",
                "definition",
            ),
            DRAWN,
        ),
        "declaration": Only((), UNFOLD),
    },
    repeated=frozenset((*OBJECTS, "page")),
)
ROOT = Vocabulary(
    {"version": DRAWN},
    {
        "net": READ,
        **dict.fromkeys(("name", "toolspecific", "queries", "query"), DRAWN),
        "feature": READ,
        "k-bound": DRAWN,
        "declaration": READ,
        "variable": Only((), UNFOLD),
        "shared-place": Only((), "export the composed net: it has no shared places"),
        "shared-transition": Only((), "export the composed net: it has no shared transitions"),
        "constant": READ,
    },
    repeated=frozenset({"net", "constant"}),
)
FEATURE = Vocabulary(
    {
        # Colours and times are refused where they are; TAPAAL says "timed" of most plain nets.
        **dict.fromkeys(("isColored", "isTimed"), DRAWN),
        "isGame": Only(("false", ""), GAME),
        "isStochastic": Note(("false", ""), "not read: give rates with --rates"),
    }
)
OWN = {
    "place": Vocabulary({"tool": READ, "version": READ}, {"capacity": READ}),
    "transition": Vocabulary(
        {"tool": READ, "version": READ},
        dict.fromkeys(("priority", "rate", "weight", "servers"), READ),
    ),
}
OWN_NOWHERE = Vocabulary({"tool": READ, "version": READ})
"""Our tool-specific data, by the element that may contain it."""


def nodes(net: Element) -> Iterator[Element]:
    """Yield the objects of a net and of its pages at any depth.

    The same tags also occur elsewhere (final markings, tool-specific data, unfoldings); those are
    not objects of the net.
    """
    for child in net:
        if local(child) == "page":
            yield from nodes(child)
        elif local(child) in OBJECTS:
            yield child


def own_data(element: Element) -> dict[str, str]:
    """Return our tool-specific data of an element."""
    for data in children(element, "toolspecific"):
        if data.get("tool") == TOOL:
            return {local(item): (item.text or "").strip() for item in data if local(item)}
    return {}


def parse_pnml(text: str | bytes, file: str = "PNML") -> NetFile:
    """Read the net in a PNML text. Raises NetFileError."""
    root = parse_tree(text, file)
    if local(root) not in ("pnml", "net"):
        remedy = "expected <pnml>"
        if local(root) == "project":
            remedy = "a project of GreatSPN is read as .pnpro: rename the file"
        raise NetFileError(file, f"<{local(root)}>", "this is not PNML", remedy, line=root.line)
    notes = check(file, root, ROOT, "pnml") if local(root) == "pnml" else []
    for feature in children(root, "feature"):
        notes += check(file, feature, FEATURE, "feature")
    for part in (part for one in children(root, "declaration") for part in one.iter()):
        if local(part) and local(part) not in DOT_SORT:
            raise NetFileError(
                file, "declaration", f"it declares <{local(part)}>", UNFOLD, line=line_of(part)
            )
    nets = [root] if local(root) == "net" else list(children(root, "net"))
    if len(nets) != 1:
        problem = f"{len(nets)} nets" if nets else "no <net>"
        raise NetFileError(
            file, "pnml", problem, "expected one net per file; split it", line=root.line
        )
    (net,) = nets
    kind = (net.get("type") or "").strip().lower()
    if kind and not PLACE_TRANSITION.fullmatch(kind):
        raise NetFileError(
            file,
            f"net {net.get('id')}",
            f"a net of type {net.get('type')!r}",
            "only P/T nets are read",
            line=line_of(net),
        )
    return _PnmlReading(root, net, file, notes).result(root)


class _PnmlReading:
    """Reads one net: places, transitions, references, then arcs, which need the others."""

    def __init__(self, root: Element, net: Element, file: str, notes: list[str]) -> None:
        self.element = net
        self.draft = NetDraft(file)
        self.draft.notes += notes
        self.labels: dict[str, str] = {}
        self.positions: dict[str, tuple[float, float]] = {}
        self.references: dict[str, str] = {}
        self.untimed: list[str] = []
        self._containers(net, "net")
        for constant in children(root, "constant"):
            self._constant(constant)
        for node in self._nodes("place"):
            self._place(node)
        for node in self._nodes("transition"):
            self._transition(node)
        for tag in ("referencePlace", "referenceTransition"):
            for node in self._nodes(tag):
                self._reference(node)
        for node in self._nodes("referencePlace", "referenceTransition"):
            self._check_reference(node)
        for node in self._nodes(*ARCS):
            self._arc(node)

    def _containers(self, node: Element, what: str) -> None:
        """Check the net and its pages."""
        self._check(node, NET, what)
        for page in children(node, "page"):
            self._containers(page, f"page {page.get('id') or '(no id)'}")

    def _check(self, node: Element, known: Vocabulary, what: str) -> None:
        self.draft.line = line_of(node)
        self.draft.notes += check(self.draft.file, node, known, what)
        for child in node:
            if known.children.get(local(child)) == READ and local(child) not in known.repeated:
                label_of = f"{what}: <{local(child)}>"
                self.draft.notes += check(self.draft.file, child, LABEL, label_of)
                if len(list(spoken(child))) > 1:
                    self.draft.line = line_of(child)
                    raise self.draft.fault(label_of, "it has several values", "keep one of them")
        own = [data for data in children(node, "toolspecific") if data.get("tool") == TOOL]
        for data in own:
            self.draft.notes += check(
                self.draft.file, data, OWN.get(local(node), OWN_NOWHERE), f"{what}: our data"
            )
        if len(own) > 1:
            self.draft.line = line_of(own[1])
            raise self.draft.fault(what, "it has our data twice", "keep one of them")

    def result(self, root: Element) -> NetFile:
        """Return everything that was read. Raises NetFileError."""
        net = self.draft.net()
        if self.draft.rates and self.untimed:
            for name in self.untimed:
                self.draft.weights.setdefault(name, 1.0)
                self.draft.notes.append(f"transition {name}: without a rate, it is immediate")
        name = (
            label(self.element, "name") or self.element.get("name") or self.element.get("id") or ""
        )
        gspn = self.draft.gspn(net)
        return NetFile(
            gspn.net if gspn else net,
            name,
            gspn,
            self.labels,
            self.positions,
            tuple(self.draft.notes),
            (*_beyond(root), *self.draft.beyond()),
            root if _is_iso(root, self.element) else None,
        )

    def _nodes(self, *tags: str) -> Iterator[Element]:
        return (node for node in nodes(self.element) if local(node) in tags)

    def _id(self, node: Element) -> str:
        self.draft.line = line_of(node)
        name = node.get("id")
        if not name:  # missing or empty
            raise self.draft.fault(local(node), "it has no id", "every node needs one")
        return name

    def _reference(self, node: Element) -> None:
        name = self._id(node)
        self._check(node, REFERENCE, f"reference {name}")
        known = (self.draft.places, self.draft.transitions, self.references)
        if any(name in names for names in known):
            raise self.draft.fault(name, "this id occurs twice", "ids must be unique in a file")
        self.references[name] = node.get("ref") or ""

    def _check_reference(self, node: Element) -> None:
        kind = local(node).removeprefix("reference").lower()
        element = f"reference {self._id(node)}"
        found = self._resolved(node.get("ref") or "", element)
        if found not in (self.draft.places if kind == "place" else self.draft.transitions):
            raise self.draft.fault(element, f"{found!r} is not a {kind}", f"refer to a {kind}")

    def _constant(self, node: Element) -> None:
        self.draft.line = line_of(node)
        name = node.get("name") or ""
        self.draft.constants[name] = self.draft.number(f"constant {name}", node.get("value") or "")

    def _dots(self, node: Element, tag: str) -> str:
        """Return a number that TAPAAL says again in colours (`DOTS`), or ""."""
        return "".join(re.findall("[0-9]", label(node, tag) or ""))

    def _common(self, node: Element, name: str) -> None:
        what = f"{local(node)} {name}"
        text = label(node, "name") or node.get("name")
        if text and text != name:
            self.labels[name] = text
        spots = [
            (position.get("x"), position.get("y"))
            for graphics in children(node, "graphics")
            for position in children(graphics, "position")
        ]
        if not spots and node.get("positionX"):
            spots = [(node.get("positionX"), node.get("positionY"))]
        for x, y in spots:
            self.positions[name] = self.draft.position(f"position of {what}", x, y)

    def _place(self, node: Element) -> None:
        name = self._id(node)
        self._check(node, PLACE, f"place {name}")
        said = label(node, "initialMarking"), node.get("initialMarking")
        tokens = self._agreed(
            f"place {name}", "numbers of tokens", (*said, self._dots(node, "hlinitialMarking"))
        )
        self.draft.place(name, tokens or 0, self._capacity(node, name))
        self._common(node, name)

    def _capacity(self, node: Element, name: str) -> int | None:
        """Return the capacity of a place; PIPE writes 0 for an unlimited one."""
        own = own_data(node).get("capacity")
        if own is not None:
            return self._count(f"capacity of {name}", own)
        return self._count(f"capacity of {name}", label(node, "capacity") or "0") or None

    def _agreed(self, element: str, what: str, said: Iterable[str | None]) -> int | None:
        """Return the number that all of these say; None if none says any."""
        counts = {self._count(element, text) for text in said if text}
        if len(counts) > 1:
            raise self.draft.fault(element, f"it has the {what} {sorted(counts)}", "give one")
        return counts.pop() if counts else None

    def _count(self, element: str, text: str) -> int:
        """Return a number, also as PIPE writes it: `Default,2` or `Default,2,Red,0`."""
        parts = [part.strip() for part in text.split(",")]
        if len(parts) > 1:
            if len(parts) % 2:
                raise self.draft.fault(
                    element, f"{text!r} is not COLOUR,NUMBER,...", "write a plain number"
                )
            pairs = list(zip(parts[::2], parts[1::2], strict=True))
            coloured = [
                colour for colour, n in pairs if colour.lower() != "default" and n not in ("", "0")
            ]
            if coloured:
                raise self.draft.fault(
                    element, f"tokens of the colour {coloured[0]!r}", "only plain tokens are read"
                )
            plain = [n for colour, n in pairs if colour.lower() == "default"]
            if len(plain) > 1:
                raise self.draft.fault(element, f"{text!r} says Default twice", "give one number")
            text = plain[0] if plain else "0"
        return self.draft.whole(element, text or "0")

    def _transition(self, node: Element) -> None:
        name, own = self._id(node), own_data(node)
        self._check(node, TRANSITION, f"transition {name}")
        said = own.get("priority"), label(node, "priority"), node.get("priority")
        self.draft.transition(name, self._agreed(f"transition {name}", "priorities", said) or 0)
        self._common(node, name)
        rate = own.get("rate") or label(node, "rate")
        timed = (label(node, "timed") or "").lower() == "true"
        if "weight" in own and rate is not None:
            raise self.draft.fault(f"transition {name}", "a rate and a weight", "keep one of them")
        if timed and rate is None:
            raise self.draft.fault(f"transition {name}", "timed, but without a rate", "give a rate")
        if "weight" in own:
            self.draft.weights[name] = float(self.draft.number(f"weight of {name}", own["weight"]))
        elif rate is not None:
            self._timing(node, name, float(self.draft.number(f"rate of {name}", rate or "1")), own)
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
            None if infinite else self.draft.whole(f"servers of {name}", servers)
        )
        if timed is not None and self.draft.transitions[name]:
            self.draft.notes.append(
                f"transition {name}: a priority has no effect on a timed transition of a GSPN"
            )
            self.draft.transitions[name] = 0

    def _arc(self, node: Element) -> None:
        tag = local(node)
        element = f"{tag} {node.get('id') or '(no id)'}"
        self._check(node, OBJECTS[tag], element)
        source, target = (
            self._resolved(node.get(end) or "", element) for end in ("source", "target")
        )
        weight = self._weight(node, element)
        if tag != "transportArc":
            kind = arc_kind(node, self.draft.file, element)
            self.draft.arc(source, target, weight, kind, element)
            return
        middle = self._resolved(node.get("transition") or "", element)
        for one, other in ((source, middle), (middle, target)):
            self.draft.arc(one, other, weight, "normal", element)

    def _weight(self, node: Element, element: str) -> int:
        """Return the weight of an arc. Raises NetFileError for time intervals and contradictions.

        ISO says it in the label `inscription`. TAPAAL writes an interval in the attribute
        `inscription` of arcs from places and a meaningless 1 in that of the others, and the weight
        in the attribute `weight` or in a label.
        """
        said = [node.get("weight"), label(node, "weight"), label(node, "inscription")]
        said += [self._dots(node, "hlinscription")]
        drawn = node.get("inscription")
        interval = [text for text in (*said, drawn) if text and text[0] in "[("]
        for text in interval:
            if not ENDLESS.allows(text):
                raise self.draft.fault(element, f"the time interval {text}", ENDLESS.remedy)
        counts = [text for text in said if text not in interval]
        if not any(counts) and not interval:
            counts = [drawn]
        weight = self._agreed(element, "weights", counts)
        return 1 if weight is None else weight

    def _resolved(self, name: str, element: str) -> str:
        """Return the node at the end of a chain of references."""
        found = _end_of(self.references, name)
        if found is None:
            raise self.draft.fault(element, f"the references around {name!r} form a circle")
        return found


def _end_of(references: dict[str, str], name: str) -> str | None:
    """Return where a chain of references ends, None for a circle.

    All on the way lead there directly afterwards, so that long chains are followed once.
    """
    passed = set[str]()
    while name in references:
        if name in passed:
            return None
        passed.add(name)
        name = references[name]
    references.update(dict.fromkeys(passed, name))
    return name


def _is_iso(root: Element, net: Element) -> bool:
    """Return whether a tree is ISO PNML apart from additions, so that it can be written back.

    Labels of other dialects (`value`), nodes that carry labels as attributes, and rates outside of
    tool-specific data would be missed by tools that read only the standard.
    """
    if root is net or not root.tag.startswith(f"{{{NAMESPACE}}}") or net.get("type") != TYPE:
        return False
    dialect = {"rate", "timed", "infiniteServer", "capacity", "priority", "player", "weight"}
    for node in nodes(net):
        if local(node) in set(ARCS) - {"arc"} or set(node.attrib) & {"initialMarking", "weight"}:
            return False
        for child in node:
            if local(child) in dialect:
                return False
            if local(child) in ("name", "initialMarking", "inscription") and any(
                local(inner) == "value" for inner in child
            ):
                return False
    return True


def _beyond(root: Element) -> Iterator[str]:
    """Yield what a tree contains beyond the net, as far as no other format has it."""
    net = root if local(root) == "net" else next(children(root, "net"))
    tools = [
        data.get("tool") or "unknown"
        for data in root.iter()
        if local(data) == "toolspecific" and data.get("tool") != TOOL
    ]
    for tool in dict.fromkeys(tools):
        yield f"data of the tool {tool} ({tools.count(tool)} elements)"
    pages = sum(1 for _ in _pages(net)) - 1
    if pages > 1:
        yield f"the division into {pages} pages"
    if any(local(node).startswith("reference") for node in nodes(net)):
        yield "reference nodes: the arcs lead to the nodes themselves"
    spots = sum(
        1
        for node in nodes(net)
        for part in node.iter()
        if local(part) in ("offset", "arcpath", "fill", "line", "dimension", "font")
        or (local(part) == "position" and local(node) in ARCS)
    )
    if spots:
        yield f"{spots} details of the drawing (paths of arcs, offsets of labels, colours)"
    for tag in ("finalmarkings", "labels", "stategroup", "definition", "query", "queries"):
        found = sum(1 for part in root.iter() if local(part) == tag)
        if found:
            yield f"<{tag}> ({found} elements)"


def arc_kind(node: Element, file: str, element: str) -> str:
    """Return the kind: normal, inhibitor or test. Raises NetFileError for any other."""
    said = [ARCS[local(node)], node.get("type", ""), node.get("arctype", ""), node.get("kind", "")]
    if said[1] == "transport" and (node.get("inscription") or "")[:1] == "[":
        said[1] = ""  # half of a transport arc of TAPAAL: without times the same as two arcs
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
    problem = f"an arc of the kind {', '.join(unknown)}"
    raise NetFileError(file, element, problem, remedy, line=line_of(node))


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


# --- writing --------------------------------------------------------------------------------------

NAMESPACE = "http://www.pnml.org/version-2009/grammar/pnml"
TYPE = "http://www.pnml.org/version-2009/grammar/ptnet"

XML_ID = re.compile(r"[^\W\d][\w.\-]*")
"""Ids that XML allows (the production NCName, a little narrower)."""

Arc = tuple[str, str, str]
"""(source, target, kind)."""


def write_pnml(model: NetFile) -> str:
    """Return the ISO PNML text of a net. Raises NetFileError for characters XML cannot hold."""
    if model.document is None:
        model, _ = model.with_names(XML_ID)
    root = deepcopy(model.document) if model.document is not None else _fresh(model)
    _PnmlWriting(root, model).update()
    ElementTree.register_namespace("", NAMESPACE)
    return xml_text(root)


def _fresh_id(stem: str, taken: set[str]) -> str:
    return next(
        name for name in chain([stem], (f"{stem}{i}" for i in count())) if name not in taken
    )


def _fresh(model: NetFile) -> Element:
    taken = {*model.net.places, *model.net.transitions}
    net_id, page_id = (_fresh_id(stem, taken) for stem in ("net", "page"))
    root = Element(f"{{{NAMESPACE}}}pnml")
    net = SubElement(root, f"{{{NAMESPACE}}}net", {"id": net_id, "type": TYPE})
    if model.name:
        SubElement(
            SubElement(net, f"{{{NAMESPACE}}}name"), f"{{{NAMESPACE}}}text"
        ).text = model.name
    SubElement(net, f"{{{NAMESPACE}}}page", {"id": page_id})
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
            node.get("id") or "": node.get("ref") or ""
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
        self._own(node, {"capacity": str(capacity)} if capacity is not None else {})

    def _transition(self, node: Element | None, name: str, t: int) -> None:
        node = node if node is not None else self._new("transition", name)
        data, gspn = {}, self.model.gspn
        if self.net.priority[t]:
            data["priority"] = str(self.net.priority[t])
        if gspn is not None:
            rate, servers = gspn.rate[t], gspn.servers[t]
            data |= {"rate": repr(rate)} if rate is not None else {"weight": repr(gspn.weight[t])}
            if rate is not None and servers != 1:
                data["servers"] = str(servers) if servers is not None else "infinite"
        self._own(node, data)

    def _new(self, tag: str, name: str) -> Element:
        node = SubElement(self.page, f"{self.prefix}{tag}", {"id": name})
        self._set(node, "name", self.model.labels.get(name, name))
        if name in self.model.positions:
            x, y = self.model.positions[name]
            graphics = SubElement(node, f"{self.prefix}graphics")
            SubElement(graphics, f"{self.prefix}position", {"x": f"{x:.10g}", "y": f"{y:.10g}"})
        return node

    def _set(self, node: Element, tag: str, text: str | None) -> None:
        """Set the text of a label."""
        if text is None:
            return
        for child in children(node, tag):
            for inner in children(child, "text"):
                for comment in list(inner):
                    inner.remove(comment)
                inner.text = text
                return
            child.text = None
            SubElement(child, f"{self.prefix}text").text = text
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
                # PIPE, TINA, GreatSPN and Storm read the first notation, ProM and pm4py the second.
                SubElement(node, f"{self.prefix}type", {"value": "inhibitor"})
                kinds = SubElement(node, f"{self.prefix}arctype")
                SubElement(kinds, f"{self.prefix}text").text = "inhibitor"

    def _resolved(self, name: str | None) -> str:
        return _end_of(self.references, name or "") or ""


def _has(node: Element, tag: str) -> bool:
    return next(children(node, tag), None) is not None
