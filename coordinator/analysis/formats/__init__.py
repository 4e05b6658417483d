"""Net files by their endings: read, write, and list what the written format cannot keep.

`FORMATS` is the one table of what each format can say, and `losses` the one place that compares it
with a net: a feature that the net has and the table does not promise for the format is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from re import Pattern

from msgspec import Struct, field

from petrobot.coordinator.analysis.formats import exports, greatspn, pnml, tina
from petrobot.coordinator.analysis.formats.netfile import NetFile, NetFileError
from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn


class Feature(StrEnum):
    """What a net may have beyond places, transitions, weighted arcs and tokens, in plain words."""

    NAME = "the name of the net"
    LABELS = "display names"
    POSITIONS = "positions of the drawing"
    INHIBITORS = "inhibitor arcs"
    CAPACITIES = "capacities"
    PRIORITIES = "priorities"
    UNTIMED = "that no transition has a time"
    RATES = "rates and weights"
    SERVERS = "numbers of servers"
    BEYOND = "data beyond the net"


HAS: Mapping[Feature, Callable[[NetFile], bool]] = {
    Feature.NAME: lambda model: bool(model.name),
    Feature.LABELS: lambda model: bool(model.labels),
    Feature.POSITIONS: lambda model: bool(model.positions),
    Feature.INHIBITORS: lambda model: any(model.net.inhibit),
    Feature.CAPACITIES: lambda model: any(c is not None for c in model.net.capacity),
    Feature.PRIORITIES: lambda model: len(set(model.net.priority)) > 1,
    Feature.UNTIMED: lambda model: model.gspn is None and bool(model.net.transitions),
    Feature.RATES: lambda model: model.gspn is not None,
    Feature.SERVERS: lambda model: (
        model.gspn is not None
        and any(
            rate is not None and servers != 1
            for rate, servers in zip(model.gspn.rate, model.gspn.servers, strict=True)
        )
    ),
    Feature.BEYOND: lambda model: bool(model.beyond),
}


KEPT = ""
AS_INHIBITORS = "written as inhibitor arcs with the same effect"
OWN_DATA = "not part of ISO PNML: written as tool-specific data, which only petrobot reads"


LARGEST_CHAIN = SearchLimits(states=1_000_000, memory=2 << 30)
"""Limits of the search when the chain of a net is written."""


class Format(Struct, frozen=True):
    """What a file format can say: `says` maps a feature to KEPT or to the form it is written in."""

    write: Callable[[NetFile], str]
    tool: str = ""
    """The tools that it is for."""
    says: Mapping[Feature, str] = field(default_factory=dict)
    text: Callable[[str], str] = str
    """How a name of a net or a display name is written."""
    names: Pattern[str] | None = None
    """The names that the format allows; others are replaced."""
    timed: bool = False
    """Whether it is for rates: a task is written as its stochastic view."""
    instead: str = ""
    """What is written, if it is not the net at all."""


FORMATS: Mapping[str, Format] = {
    ".pnml": Format(
        pnml.write_pnml,
        "",
        {
            Feature.NAME: KEPT,
            Feature.LABELS: KEPT,
            Feature.POSITIONS: KEPT,
            Feature.UNTIMED: KEPT,
            Feature.INHIBITORS: "not part of ISO PNML: written as arc types of other tools "
            "(`type` and `arctype`); a tool that reads only the standard takes them for normal "
            "arcs",
            Feature.CAPACITIES: OWN_DATA,
            Feature.PRIORITIES: OWN_DATA,
            Feature.RATES: OWN_DATA,
            Feature.SERVERS: OWN_DATA,
        },
        names=pnml.XML_ID,
    ),
    ".net": Format(
        tina.write_tina,
        "TINA",
        {
            Feature.NAME: KEPT,
            Feature.LABELS: KEPT,
            Feature.UNTIMED: KEPT,
            Feature.INHIBITORS: KEPT,
            Feature.PRIORITIES: KEPT,
            Feature.CAPACITIES: AS_INHIBITORS,
        },
        tina.one_line,
        tina.ANY_NAME,
    ),
    ".pnpro": Format(
        greatspn.write_pnpro,
        "GreatSPN, Storm",
        {
            Feature.NAME: KEPT,
            Feature.POSITIONS: KEPT,
            Feature.INHIBITORS: KEPT,
            Feature.RATES: KEPT,
            Feature.SERVERS: KEPT,
            Feature.PRIORITIES: KEPT,
            Feature.CAPACITIES: AS_INHIBITORS,
            Feature.UNTIMED: "written as immediate transitions of weight 1",
        },
        names=greatspn.IDENTIFIER,
        timed=True,
    ),
    ".lola": Format(
        exports.write_lola,
        "LoLA",
        {
            Feature.UNTIMED: KEPT,
            Feature.INHIBITORS: "kept where the place has a capacity, left out elsewhere",
            Feature.CAPACITIES: "written as complementary places with the same effect",
        },
        names=exports.LOLA_NAME,
    ),
    ".dot": Format(
        exports.write_dot,
        "Graphviz",
        {
            Feature.NAME: KEPT,
            Feature.LABELS: KEPT,
            Feature.UNTIMED: KEPT,
            Feature.INHIBITORS: "drawn with a round head",
        },
    ),
    ".drn": Format(
        lambda model: exports.write_drn(Chain.of(_timed(model), limits=LARGEST_CHAIN)),
        "Storm",
        timed=True,
        instead="the net itself: only its chain over the tangible markings is written",
    ),
}
"""Formats that can be written, by ending; `petrobot convert` has them all from here."""

READ: Mapping[str, Callable[[bytes, str], NetFile]] = {
    ".pnml": pnml.parse_pnml,
    ".xml": pnml.parse_pnml,
    ".tapn": pnml.parse_pnml,
    ".pnpro": greatspn.parse_pnpro,
    ".net": lambda text, file: tina.parse_tina(_utf8(text, file), file),
}
"""Readers by ending. `.xml` is PNML as PIPE writes it, `.tapn` as TAPAAL does. Bytes, because XML
declares its encoding."""


def losses(model: NetFile, ending: str) -> list[str]:
    """Return what a file of this ending does not say of the net, or says in another form."""
    target = FORMATS[ending]
    if target.instead:
        return [target.instead]
    return list(_losses(model, target, ending))


def _losses(model: NetFile, target: Format, ending: str) -> Iterator[str]:
    in_place = ending == ".pnml" and model.document is not None
    for feature, has in HAS.items():
        if feature is Feature.BEYOND or not has(model):
            continue
        if feature not in target.says:
            yield str(feature)
        elif target.says[feature] != KEPT:
            yield f"{feature}: {target.says[feature]}"
    texts = {Feature.NAME: [model.name], Feature.LABELS: [*model.labels.values()]}
    for feature, kept in texts.items():
        if feature in target.says and any(target.text(text) != text for text in kept):
            yield f"{feature}: line ends are written as spaces"
    if not in_place:
        yield from model.beyond
        if target.names is not None:
            _, renamed = model.with_names(target.names)
            if renamed:
                some = ", ".join(f"{old!r} as {new!r}" for old, new in list(renamed.items())[:3])
                yield f"{len(renamed)} ids that the format does not allow: written {some}" + (
                    ", ..." if len(renamed) > 3 else ""
                )


def read_net(path: Path) -> NetFile:
    """Read the net in a file. Raises NetFileError, also for a file that cannot be opened."""
    reader = READ.get(path.suffix.lower())
    if reader is None:
        raise NetFileError(
            str(path), "file", f"{path.suffix or 'no'} ending", f"expected one of {', '.join(READ)}"
        )
    try:
        text = path.read_bytes()
    except OSError as error:
        raise NetFileError(
            str(path), "file", error.strerror or str(error), "give a readable file"
        ) from error
    return reader(text, str(path))


def _utf8(text: bytes, file: str) -> str:
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = text.count(b"\n", 0, error.start) + 1
        raise NetFileError(file, "file", str(error), "give a UTF-8 file", line=line) from error


def _timed(model: NetFile) -> Gspn:
    if model.gspn is None:
        raise NetFileError("drn", "rates", "the net has none", "give rates; a CTMC needs them")
    return model.gspn


def written(model: NetFile, target: Path) -> tuple[str, list[str]]:
    """Return (the net as text, what is lost) in the format of the target's ending.

    Raises NetFileError.
    """
    found = FORMATS.get(target.suffix.lower())
    if found is None:
        ending = f"the ending {target.suffix}" if target.suffix else "a file without ending"
        raise NetFileError(
            str(target), "file", f"no writer for {ending}", f"end its name in {', '.join(FORMATS)}"
        )
    try:
        return found.write(model), losses(model, target.suffix.lower())
    except NetFileError as error:
        raise NetFileError(str(target), error.element, error.problem, error.remedy) from error
