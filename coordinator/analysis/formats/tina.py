"""Reader and writer of TINA's textual nets (`.net`).

Places, transitions, weights `p*2`, test arcs `p?2`, inhibitor arcs `p?-2`, priorities and labels. A
time interval is refused unless it is the trivial one, [0,w[. Source: manual page formats(n) of the
TINA toolbox.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from petrobot.coordinator.analysis.formats.netfile import NetDraft, NetFile, thresholds
from petrobot.coordinator.task.net import Net

TOKEN = re.compile(r"\s*(\{(?:\\.|[^}\\])*\}|->|[^\s{}#]+)")
PLAIN = re.compile(r"[A-Za-z_'][A-Za-z0-9_']*\Z")
BARE = re.compile(r"[\w'.\-]+")
"""Names that are read without braces; other signs say something else, such as `[1,2]` a time."""
SCALE = {"K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "P": 10**15, "E": 10**18}
ARC = re.compile(r"(?P<kind>\*|\?-|\?|!-|!)(?P<weight>[0-9]{1,300}[KMGTPE]?)\Z")
MARKING = re.compile(r"\(([0-9]{1,300}[KMGTPE]?)\)")
INTERVAL = re.compile(r"[\[\]][0-9]+,([0-9]+[\[\]]|(w|inf)\[)")


def parse_tina(text: str, file: str = "net") -> NetFile:
    """Read the net in a TINA text. Raises NetFileError."""
    return _TinaReading(text, file).result()


class _TinaReading:
    def __init__(self, text: str, file: str) -> None:
        self.draft = NetDraft(file)
        self.name = ""
        self.tokens: dict[str, int] = {}
        self.labels: dict[str, tuple[str, int]] = {}
        self.arcs: list[tuple[str, str, int, str, int]] = []
        self.transitions: dict[str, int] = {}
        """The line on which each transition occurs first."""
        self.above: list[tuple[list[str], list[str], int]] = []
        self.beyond: list[str] = []
        self.line = 0
        for self.line, line in _logical_lines(text):
            self.draft.line = self.line
            words = self._words(line)
            if words:
                self._statement(words)

    def _words(self, line: str) -> list[str]:
        """Return the words of a line up to a comment. Raises NetFileError."""
        words, at = [], 0
        while line[at:].strip():
            if line[at:].lstrip().startswith("#"):
                break
            found = TOKEN.match(line, at)
            if found is None:
                rest = line[at:].strip()
                raise self.draft.fault("line", f"unexpected {rest[:20]!r}", "braces come in pairs")
            words.append(found[1])
            at = found.end()
        return words

    def _statement(self, words: list[str]) -> None:
        match words[0]:
            case "net":
                self._only(words, 2, "net NAME")
                self.name = _bare(words[1]) if len(words) > 1 else ""
            case "tr":
                self._transition(words[1:])
            case "pl":
                self._place(words[1:])
            case "lb":
                self._only(words, 3, "lb NODE LABEL")
                if len(words) < 3:
                    raise self.draft.fault(
                        " ".join(words), "a label needs a node and a text", "write lb NODE LABEL"
                    )
                self.labels[_bare(words[1])] = _bare(words[2]), self.line
            case "pr":
                self._priority(words[1:])
            case "nt":
                self.beyond.append(f"the note in line {self.line}")
            case other:
                raise self.draft.fault(
                    "line",
                    f"a line that begins with {other!r}",
                    "a net of TINA has the lines net, tr, pl, lb, pr and nt",
                )

    def _only(self, words: list[str], most: int, form: str) -> None:
        if len(words) > most:
            raise self.draft.fault(words[0], f"unexpected {words[most]!r}", f"write {form}")

    def _priority(self, words: list[str]) -> None:
        signs = [word for word in words if word in ("<", ">")]
        if len(signs) != 1 or words[0] in signs or words[-1] in signs:
            raise self.draft.fault("pr", "not of the form A ... > B ...", "write pr HIGH > LOW")
        split = words.index(signs[0])
        first, second = ([_bare(w) for w in part] for part in (words[:split], words[split + 1 :]))
        high, low = (first, second) if signs[0] == ">" else (second, first)
        self.above.append((high, low, self.line))

    def _labelled(self, name: str, rest: list[str]) -> list[str]:
        """Read `: LABEL` after a name; return the words that follow."""
        if not rest or rest[0] != ":":
            return rest
        if len(rest) < 2:
            raise self.draft.fault(name, "no label after the colon", "write NAME : LABEL")
        self.labels[name] = _bare(rest[1]), self.line
        return rest[2:]

    def _transition(self, words: list[str]) -> None:
        if not words:
            raise self.draft.fault("tr", "a transition without a name", "write tr NAME IN -> OUT")
        name = self._named(words[0])
        element = f"transition {name}"
        self.transitions.setdefault(name, self.line)
        rest = self._labelled(name, words[1:])
        if rest and rest[0][0] in "[]":
            # Spaces may stand inside an interval.
            parts = (n for n in range(1, 6) if INTERVAL.fullmatch("".join(rest[:n])))
            length = next(parts, 1)
            interval, rest = "".join(rest[:length]), rest[length:]
            if interval not in ("[0,w[", "[0,inf["):
                raise self.draft.fault(
                    element, f"a time interval {interval}", "only untimed nets are read; remove it"
                )
        self._arcs(rest, element, lambda word, first: self._arc(word, name, True, first))

    def _named(self, word: str) -> str:
        """Return the name that a word gives to a node. Raises NetFileError."""
        name = _bare(word)
        if name == word and not BARE.fullmatch(word):
            problem = f"{word!r} is not a name"
            raise self.draft.fault("line", problem, "write a name with other signs in braces")
        return name

    def _arcs(self, words: list[str], element: str, arc: Callable[[str, bool], None]) -> None:
        """Read `INPUTS -> OUTPUTS`, or nothing; `arc` receives a word and whether it is an
        input."""
        if not words:
            return
        if words.count("->") != 1:
            problem = "no -> in its line" if "->" not in words else "two -> in its line"
            raise self.draft.fault(element, problem, "write INPUTS -> OUTPUTS behind it")
        arrow = words.index("->")
        for word in _joined(words[:arrow]):
            arc(word, True)
        for word in _joined(words[arrow + 1 :]):
            arc(word, False)

    def _arc(self, word: str, node: str, of_transition: bool, first: bool) -> None:
        """Read an arc of a node: `first` is an input of it, and leads to or from the node that
        `word` names."""
        name, suffix = _split(word)
        other = self._named(name) if name else ""
        place, transition = (other, node) if of_transition else (node, other)
        consumes = first == of_transition
        kind, weight = "normal", 1
        if suffix or not other:
            found = ARC.match(suffix)
            if (
                found is None
                or not other
                or found["kind"][0] == "!"
                or (found["kind"] != "*" and not consumes)
            ):
                raise self.draft.fault(
                    f"transition {transition}", f"unknown arc {word!r}", "write p, p*2, p?2 or p?-2"
                )
            kind = {"*": "normal", "?": "test", "?-": "inhibitor"}[found["kind"]]
            weight = _number(found["weight"])
        self.tokens.setdefault(place, 0)
        self.transitions.setdefault(transition, self.line)
        source, target = (place, transition) if consumes else (transition, place)
        self.arcs.append((source, target, weight, kind, self.line))

    def _place(self, words: list[str]) -> None:
        if not words:
            raise self.draft.fault("pl", "a place without a name", "write pl NAME (TOKENS)")
        name = self._named(words[0])
        self.tokens.setdefault(name, 0)
        rest = self._labelled(name, words[1:])
        while rest and (found := MARKING.fullmatch(rest[0])):
            self.tokens[name] += _number(found[1])
            rest = rest[1:]
        element = f"place {name}"
        if rest and (rest[0][0] == "(" or "->" not in rest):
            problem = f"unexpected {rest[0]!r} after a place"
            raise self.draft.fault(element, problem, "write pl NAME (TOKENS)")
        self._arcs(rest, element, lambda word, first: self._arc(word, name, False, first))

    def result(self) -> NetFile:
        """Return the net. Raises NetFileError."""
        draft = self.draft
        for place, tokens in self.tokens.items():
            draft.place(place, tokens)
        priority = self._priorities()
        for transition, draft.line in self.transitions.items():
            draft.transition(transition, priority.get(transition, 0))
        for source, target, weight, kind, draft.line in self.arcs:
            draft.arc(source, target, weight, kind, f"transition {_of(draft, source, target)}")
        for name, (_, draft.line) in self.labels.items():
            if name not in draft.places and name not in draft.transitions:
                raise draft.fault(f"label of {name}", "no such node", "name a place or transition")
        labels = {n: text for n, (text, _) in self.labels.items() if text not in ("", n)}
        return NetFile(
            draft.net(), self.name, None, labels, {}, tuple(draft.notes), tuple(self.beyond)
        )

    def _priorities(self) -> dict[str, int]:
        """Return priority levels that express the pairs in the file.

        The level of a transition is the length of the longest chain of pairs below it. Raises
        NetFileError for a cycle, and if levels would rank pairs that the file does not rank.
        """
        lower: dict[str, set[str]] = {name: set() for name in self.transitions}
        for highs, lows, line in self.above:
            self.draft.line = line
            for name in (*highs, *lows):
                if name not in lower:
                    raise self.draft.fault(
                        "pr", f"{name!r} is not a transition", "name transitions of the net"
                    )
            for high in highs:
                lower[high].update(lows)
        if not self.above:
            return {}
        number = {name: i for i, name in enumerate(lower)}
        level, below = dict[str, int](), dict[str, int]()  # below: a bit mask of all ranked below
        waiting = set(lower)
        while waiting:
            ready = [name for name in lower if name in waiting and lower[name] <= level.keys()]
            if not ready:
                raise self.draft.fault(
                    "pr",
                    f"the priorities of {', '.join(sorted(waiting)[:5])} form a cycle",
                    "remove one of them",
                )
            for name in ready:
                level[name] = max((level[one] + 1 for one in lower[name]), default=0)
                below[name] = 0
                for one in lower[name]:
                    below[name] |= below[one] | 1 << number[one]
            waiting -= set(ready)
        at_most = [0] * (max(level.values()) + 1)
        for name, own in level.items():
            for higher in range(own + 1, len(at_most)):
                at_most[higher] |= 1 << number[name]
        if any(below[name] != at_most[level[name]] for name in level):
            remedy = "only priorities that form levels over all transitions are read"
            raise self.draft.fault("pr", "priorities between some pairs only", remedy)
        return level


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield (number of its first line, line); a backslash at the end continues a line."""
    begun, held = 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        begun = begun or number
        if line.endswith("\\"):
            held += line[:-1] + " "
            continue
        yield begun, held + line
        begun, held = 0, ""
    if held:
        yield begun, held


def _of(draft: NetDraft, source: str, target: str) -> str:
    return source if source in draft.transitions else target


def _joined(words: list[str]) -> list[str]:
    """Join the suffix of a braced name (`{a b}*2`) to it again."""
    out: list[str] = []
    for word in words:
        if out and out[-1].endswith("}") and word[0] in "*?!":
            out[-1] += word
        else:
            out.append(word)
    return out


def _split(word: str) -> tuple[str, str]:
    """Return (place as it is written, suffix with kind and weight)."""
    end = (
        word.rindex("}") + 1
        if word.startswith("{")
        else next((i for i, c in enumerate(word) if c in "*?!"), len(word))
    )
    return word[:end], word[end:]


def _bare(word: str) -> str:
    return re.sub(r"\\(.)", r"\1", word[1:-1]) if word.startswith("{") else word


def _number(text: str) -> int:
    return int(text[:-1]) * SCALE[text[-1]] if text[-1] in SCALE else int(text)


def _quoted(name: str) -> str:
    """Return a name or label as it is written."""
    name = one_line(name)
    return name if PLAIN.match(name) else "{" + re.sub(r"([\\{}])", r"\\\1", name) + "}"


def one_line(text: str) -> str:
    """Return a name or label as a file of TINA can hold it: a line end becomes a space."""
    return " ".join(text.splitlines())


ANY_NAME = re.compile(r"[^\n\r\x0b\x0c\x1c-\x1e\x85\u2028\u2029]+")
"""Names in braces may hold everything but the end of a line; a place and a transition must differ.
"""


def write_tina(model: NetFile) -> str:
    """Return the TINA text of a net; capacities become inhibitor arcs with the same effect.

    Raises NetFileError.
    """
    model, _ = model.with_names(ANY_NAME)
    net: Net = model.net
    lines = [f"net {_quoted(model.name)}"] * bool(model.name)
    for t, name in enumerate(net.transitions):
        label = f" : {_quoted(model.labels[name])}" if name in model.labels else ""
        below = thresholds(net, t)
        need = [_quoted(net.places[p]) + (f"*{w}" if w > 1 else "") for p, w in net.consume[t]]
        need += [f"{_quoted(net.places[p])}?-{k}" for p, k in below]
        give = [_quoted(net.places[p]) + (f"*{w}" if w > 1 else "") for p, w in net.produce[t]]
        lines.append(f"tr {_quoted(name)}{label} {' '.join(need)} -> {' '.join(give)}".rstrip())
    for p, name in enumerate(net.places):
        label = f" : {_quoted(model.labels[name])}" if name in model.labels else ""
        tokens = f" ({net.initial[p]})" if net.initial[p] else ""
        lines.append(f"pl {_quoted(name)}{label}{tokens}")
    levels = sorted(set(net.priority))
    for low, high in ((low, high) for i, low in enumerate(levels) for high in levels[i + 1 :]):
        first, second = (
            " ".join(
                _quoted(n)
                for n, own in zip(net.transitions, net.priority, strict=True)
                if own == level
            )
            for level in (high, low)
        )
        lines.append(f"pr {first} > {second}")
    return "\n".join(lines) + "\n"
