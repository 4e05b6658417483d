"""Reader of GreatSPN editor projects (`.pnpro`): one GSPN with constants, inhibitors and servers.

In spite of its name, the attribute `delay` of a transition of type EXP is a rate (1/s). Without
`nservers` a timed transition has unlimited servers. Deterministic and general transitions are
refused.
"""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from petrobot.coordinator.analysis.formats.netfile import (
    NetDraft,
    NetFile,
    NetFileError,
    arithmetic,
    whole_number,
)

DRAWN = {"text-box", "group", "point"}
"""Elements that matter only for a drawing."""


def parse_pnpro(text: str | bytes, file: str = "pnpro") -> NetFile:
    """Read the net of a project. Raises NetFileError."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise NetFileError(file, "XML", str(error), "the file is incomplete or not XML") from error
    nets = list(root.iter("gspn"))
    if root.tag != "project" or len(nets) != 1:
        raise NetFileError(
            file,
            root.tag,
            f"expected one GSPN, found {len(nets)}",
            "save a project with exactly one GSPN",
        )
    (net,) = nets
    draft, positions = NetDraft(file), dict[str, tuple[float, float]]()
    names = _constants(net, file)
    for node in net.iter():
        if node.tag in ("place", "transition"):
            positions[node.get("name", "")] = (float(node.get("x", "0")), float(node.get("y", "0")))
        if node.tag == "place":
            _place(draft, node, names)
        elif node.tag == "transition":
            _transition(draft, node, names)
        elif node.tag not in ("gspn", "nodes", "edges", "arc", "constant", "template", *DRAWN):
            raise NetFileError(file, node.tag, "unknown element", "only plain GSPNs are read")
    for i, node in enumerate(net.iter("arc")):
        _arc(draft, node, f"arc {i}", names)
    result = draft.net()
    gspn = draft.gspn(result)
    return NetFile(
        gspn.net if gspn else result, net.get("name", ""), gspn, {}, positions, tuple(draft.notes)
    )


def _constants(net: Element, file: str) -> dict[str, float]:
    names: dict[str, float] = {}
    for node in (*net.iter("constant"), *net.iter("template")):
        name, value = node.get("name", ""), node.get("value") or ""
        if not value:
            raise NetFileError(
                file, f"{node.tag} {name}", "it has no value", "set a value in the editor"
            )
        names[name] = arithmetic(file, f"constant {name}", value, names)
    return names


def _place(draft: NetDraft, node: Element, names: dict[str, float]) -> None:
    name = node.get("name", "")
    if node.get("domain"):
        raise NetFileError(
            draft.file, f"place {name}", "it holds coloured tokens", "unfold the net first"
        )
    draft.place(name, whole_number(draft.file, f"place {name}", node.get("marking") or "0", names))


def _transition(draft: NetDraft, node: Element, names: dict[str, float]) -> None:
    name, kind = node.get("name", ""), node.get("type", "")
    element = f"transition {name}"
    if node.get("guard") or node.get("action"):
        raise NetFileError(
            draft.file, element, "it has a guard or an action", "unfold the net first"
        )
    if kind == "IMM":
        draft.transition(
            name, whole_number(draft.file, element, node.get("priority") or "1", names)
        )
        draft.weights[name] = arithmetic(draft.file, element, node.get("weight") or "1", names)
    elif kind == "EXP":
        draft.transition(name, 0)
        draft.rates[name] = arithmetic(draft.file, element, node.get("delay") or "1", names)
        servers = node.get("nservers") or "Infinite"
        words: dict[str, int | None] = {"Infinite": None, "Single": 1}
        draft.servers[name] = (
            words[servers]
            if servers in words
            else whole_number(draft.file, element, servers, names)
        )
    else:
        raise NetFileError(
            draft.file,
            element,
            f"a transition of type {kind!r}",
            "EXP and IMM transitions are read",
        )


def _arc(draft: NetDraft, node: Element, element: str, names: dict[str, float]) -> None:
    kinds = {"INPUT": "normal", "OUTPUT": "normal", "INHIBITOR": "inhibitor"}
    kind = node.get("kind", "")
    if kind not in kinds:
        raise NetFileError(
            draft.file, element, f"an arc of kind {kind!r}", f"kinds are {', '.join(kinds)}"
        )
    if node.get("is-broken") == "true":
        draft.notes.append(f"{element} is drawn broken")
    weight = whole_number(draft.file, element, node.get("mult") or "1", names)
    draft.arc(node.get("tail", ""), node.get("head", ""), weight, kinds[kind], element)
