"""XML of net files: a parser that knows the lines, and tables of what a reader understands.

A reader declares for each element which attributes and children it reads (`READ`), which do not
change the behaviour of the net (`DRAWN`), and which are accepted with one meaning only (`Only`).
Everything else is refused with its line, so no part of a net is dropped in silence.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import cast
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from msgspec import Struct, field

from petrobot.coordinator.analysis.formats.netfile import BETWEEN, FILE, NetFileError
from petrobot.coordinator.analysis.limits import keep_time

DEEPEST = 100
"""The most levels of elements. Real files have about ten; deeper trees exhaust Python's stack."""


NO_MEMORY = expat.errors.codes[expat.errors.XML_ERROR_NO_MEMORY]
"""What expat reports when its own memory is used up, instead of a MemoryError."""


class LineElement(Element):
    """An element that knows the line on which it begins."""

    line: int = 0


class Only(Struct, frozen=True):
    """Accepted with one of these values (compared without spaces, in lower case), else refused."""

    values: tuple[str, ...]
    remedy: str
    form: str = ""
    """Also accepted: what this regular expression matches."""

    def allows(self, text: str) -> bool:
        """Return whether the value means nothing beyond a plain net."""
        plain = "".join(text.lower().split())
        return plain in self.values or bool(self.form and re.fullmatch(self.form, plain))


class Note(Struct, frozen=True):
    """Accepted with any value; if it is not one of `silent`, the reader adds the text as a note."""

    silent: tuple[str, ...]
    text: str


READ = "read"
DRAWN = "drawn"
Known = str | Only | Note


class Vocabulary(Struct, frozen=True):
    """What a reader knows of one element: its attributes and its children, by local name."""

    attributes: Mapping[str, Known] = field(default_factory=dict)
    children: Mapping[str, Known] = field(default_factory=dict)
    repeated: frozenset[str] = frozenset()
    """Children that are read and may occur more than once."""


def parse_tree(text: str | bytes, file: str) -> LineElement:
    """Parse XML. Raises NetFileError for anything but well-formed XML without entities."""
    return _Parsing(file).parse(text)


class _Parsing:
    """Builds the tree from the events of expat, which tell the line, without recursion."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.parser = expat.ParserCreate(namespace_separator="}")
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.CommentHandler = self._comment
        self.parser.EntityDeclHandler = self._entity
        self.parser.SkippedEntityHandler = self._skipped
        self.open: list[Element] = []
        self.last: Element | None = None
        """The child that ended last in the innermost open element; text after it is its tail."""
        self.root: LineElement | None = None
        self.elements = 0
        """How many elements have begun."""

    def parse(self, text: str | bytes) -> LineElement:
        """Return the root. Raises NetFileError."""
        try:
            self.parser.Parse(text, True)
        except expat.ExpatError as error:
            if error.code == NO_MEMORY:
                raise MemoryError from error
            raise NetFileError(
                self.file,
                "XML",
                expat.ErrorString(error.code),
                "the file is incomplete, no XML, or not in the encoding that it declares",
                line=error.lineno,
            ) from error
        except NetFileError:  # a ValueError too, and complete
            raise
        except (ValueError, LookupError) as error:  # an encoding that is unknown, or of many bytes
            raise self._fault(str(error), "save the file as UTF-8") from error
        assert self.root is not None  # expat accepts no document without an element
        return self.root

    def _fault(self, problem: str, remedy: str) -> NetFileError:
        line = self.parser.CurrentLineNumber
        return NetFileError(self.file, "XML", problem, remedy, line=line)

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self.elements += 1
        if self.elements % BETWEEN == 0:
            keep_time(FILE)
        if len(self.open) >= DEEPEST:
            raise self._fault(
                f"elements nested more than {DEEPEST} deep", "flatten the pages of the net"
            )
        node = LineElement(
            _braced(name), {_braced(key): value for key, value in attributes.items()}
        )
        node.line = self.parser.CurrentLineNumber
        if self.open:
            self.open[-1].append(node)
        else:
            self.root = node
        self.open.append(node)
        self.last = None

    def _end(self, _: str) -> None:
        self.last = self.open.pop()

    def _text(self, text: str) -> None:
        if self.last is None:
            self.open[-1].text = (self.open[-1].text or "") + text
        else:
            self.last.tail = (self.last.tail or "") + text

    def _comment(self, text: str) -> None:
        if self.open:
            comment = cast(Element, ElementTree.Comment(text))
            self.open[-1].append(comment)
            self.last = comment

    def _entity(self, *_: object) -> None:
        raise self._fault(
            "the file defines XML entities",
            "replace them by their text (nested entities could exhaust the memory)",
        )

    def _skipped(self, name: str, _: object) -> None:
        raise self._fault(f"the entity &{name}; is not defined here", "replace it by its text")


def _braced(name: str) -> str:
    """Return a name as ElementTree writes it: {namespace}local."""
    return "{" + name if "}" in name else name


def local(element: Element) -> str:
    """Return the tag of an element without its namespace; "" for comments."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def line_of(element: Element) -> int | None:
    """Return the line on which an element begins; None if it was not read from a file."""
    return element.line if isinstance(element, LineElement) else None


def children(element: Element, tag: str) -> Iterator[Element]:
    """Yield the children with this tag, in any namespace."""
    return (child for child in element if local(child) == tag)


def label(element: Element, tag: str) -> str | None:
    """Return the text of a label (`<tag><text>..` or PIPE's `<tag><value>..`), or None."""
    return next((_said(child) for child in children(element, tag)), None)


def _said(found: Element) -> str:
    """Return the text of a label's element."""
    return next(spoken(found), None) or _text(found).strip()


def spoken(found: Element) -> Iterator[str]:
    """Yield the texts that a label says in elements and attributes of their own; one is enough."""
    for inner in found:
        if local(inner) in ("text", "value"):
            yield _text(inner).strip()
    if value := found.get("value"):
        yield value.strip()


def _text(element: Element) -> str:
    """Return all text inside an element but comments, which `itertext` would include."""
    inner = (((_text(child) if local(child) else "") + (child.tail or "")) for child in element)
    return (element.text or "") + "".join(inner)


LABEL = Vocabulary(
    {"id": DRAWN, "value": READ},
    {"text": READ, "value": READ, "graphics": DRAWN, "offset": DRAWN, "toolspecific": DRAWN},
)


def check(file: str, node: Element, known: Vocabulary, what: str) -> list[str]:
    """Refuse what a vocabulary does not contain; return the notes about what it contains.

    `what` names the element in messages ("place p"). Raises NetFileError.
    """
    notes = []
    for key, value in node.attrib.items():
        if "}" in key:  # xml:id, xsi:schemaLocation: about the document, not about the net
            continue
        rule = known.attributes.get(key)
        notes += _judged(file, node, what, f"attribute {key}", value, rule, known.attributes)
    seen = set[str]()
    for child in node:
        tag = local(child)
        if not tag:
            continue
        rule = known.children.get(tag)
        text = "" if rule is None or isinstance(rule, str) else _said(child)
        notes += _judged(file, child, what, f"element <{tag}>", text, rule, known.children)
        if rule is not READ and not isinstance(rule, Only):
            continue
        if tag in seen and tag not in known.repeated:
            raise NetFileError(
                file, what, f"<{tag}> occurs twice", "keep one of them", line=line_of(child)
            )
        seen.add(tag)
    return notes


def _judged(
    file: str,
    at: Element,
    what: str,
    part: str,
    value: str,
    rule: Known | None,
    known: Mapping[str, Known],
) -> list[str]:
    if rule is None:
        read = ", ".join(sorted(key for key, own in known.items() if own != DRAWN))
        remedy = f"read here: {read or 'nothing'}; remove it in the tool that wrote the file"
        raise NetFileError(file, what, f"unknown {part}", remedy, line=line_of(at))
    if isinstance(rule, Only) and not rule.allows(value):
        found = f"{part} is {value!r}" if rule.values or rule.form else f"{part} is not read"
        raise NetFileError(file, what, found, rule.remedy, line=line_of(at))
    if isinstance(rule, Note) and "".join(value.lower().split()) not in rule.silent:
        return [f"{what}: {part} = {value!r}: {rule.text}"]
    return []


NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
"""Characters outside of the production Char of XML 1.0."""


def xml_text(root: Element) -> str:
    """Return a tree as an XML document. Raises NetFileError for characters XML cannot hold."""
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    if found := NOT_XML.search(text):
        raise NetFileError(
            "XML", "names", f"one holds the character {found[0]!r}", "XML has none: rename it"
        )
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{text}\n"
