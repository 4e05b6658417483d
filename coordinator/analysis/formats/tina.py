"""TINA's textual nets (`.net`): places, transitions, weights `p*2`, test arcs `p?2`, inhibitor arcs
`p?-2`, priorities.

A transition's time interval is refused unless it says nothing ([0,w[); labels are kept, notes are
listed. Source: manual page formats(n) of the TINA toolbox.
"""

from __future__ import annotations

import re

from petrobot.coordinator.analysis.formats.netfile import FormatError, NetDraft, NetFile
from petrobot.coordinator.task.net import Net

TOKEN = re.compile(r"\{(?:\\.|[^}\\])*\}|->|[^\s{]+")
PLAIN = re.compile(r"[A-Za-z_'][\w']*\Z")
SCALE = {"K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
ARC = re.compile(r"(?P<kind>\*|\?-|\?|!-|!)(?P<weight>\d+[KMGT]?)\Z")


def parse_tina(text: str, file: str = "net") -> NetFile:
    """The net in a TINA text. Raises FormatError."""
    return _Reading(text, file).result()


class _Reading:
    def __init__(self, text: str, file: str) -> None:
        self.file = file
        self.name = ""
        self.tokens: dict[str, int] = {}
        self.labels: dict[str, str] = {}
        self.arcs: list[tuple[str, str, int, str, str]] = []
        self.transitions: list[str] = []
        self.above: list[tuple[list[str], list[str]]] = []
        self.notes: list[str] = []
        for number, line in enumerate(text.replace("\\\n", " ").splitlines(), 1):
            words = TOKEN.findall(line.split("#")[0])
            if words:
                self._line(words, f"line {number}")

    def _line(self, words: list[str], at: str) -> None:
        match words[0]:
            case "net":
                self.name = _bare(words[1]) if len(words) > 1 else ""
            case "tr":
                self._transition(words[1:], at)
            case "pl":
                self._place(words[1:], at)
            case "lb":
                self.labels[_bare(words[1])] = _bare(words[2])
            case "pr":
                split = (
                    words.index(">")
                    if ">" in words
                    else words.index("<")
                    if "<" in words
                    else len(words)
                )
                first, second = (
                    [_bare(w) for w in part] for part in (words[1:split], words[split + 1 :])
                )
                self.above.append((first, second) if ">" in words else (second, first))
            case "nt":
                self.notes.append(f"{at}: a note")
            case other:
                raise FormatError(
                    self.file,
                    at,
                    f"a line that begins with {other!r}",
                    "net, tr, pl, lb, pr, nt are known",
                )

    def _transition(self, words: list[str], at: str) -> None:
        if not words:
            raise FormatError(self.file, at, "a transition without a name")
        name = _bare(words[0])
        self.transitions.append(name)
        rest = words[1:]
        if rest and rest[0] == ":":
            self.labels[name], rest = _bare(rest[1]), rest[2:]
        if rest and rest[0][0] in "[]":
            if rest[0] not in ("[0,w[", "[0,inf["):
                raise FormatError(
                    self.file,
                    at,
                    f"a time interval {rest[0]}",
                    "only untimed nets are read: remove it",
                )
            rest = rest[1:]
        if "->" not in rest:
            raise FormatError(
                self.file, at, "no -> in a transition", "write tr NAME INPUTS -> OUTPUTS"
            )
        arrow = rest.index("->")
        for word in _joined(rest[:arrow]):
            self._arc(word, name, at, True)
        for word in _joined(rest[arrow + 1 :]):
            self._arc(word, name, at, False)

    def _arc(self, word: str, transition: str, at: str, into: bool) -> None:
        place, suffix = _split(word)
        kind, weight = "normal", 1
        if suffix:
            found = ARC.match(suffix)
            if found is None or found["kind"][0] == "!" or (found["kind"] != "*" and not into):
                raise FormatError(
                    self.file, at, f"an arc {word!r}", "arcs are p, p*2, p?2 and p?-2"
                )
            kind = {"*": "normal", "?": "test", "?-": "inhibitor"}[found["kind"]]
            weight = _number(found["weight"])
        self.tokens.setdefault(place, 0)
        source, target = (place, transition) if into else (transition, place)
        self.arcs.append((source, target, weight, kind, at))

    def _place(self, words: list[str], at: str) -> None:
        name = _bare(words[0])
        self.tokens.setdefault(name, 0)
        rest = words[1:]
        if rest and rest[0] == ":":
            self.labels[name], rest = _bare(rest[1]), rest[2:]
        for word in rest:
            if not re.fullmatch(r"\(\d+[KMGT]?\)", word):
                raise FormatError(
                    self.file, at, f"{word!r} behind a place", "write pl NAME (TOKENS)"
                )
            self.tokens[name] += _number(word[1:-1])

    def result(self) -> NetFile:
        """The file as a net."""
        draft = NetDraft(self.file)
        for place, tokens in self.tokens.items():
            draft.place(place, tokens)
        priority = self._priorities()
        for transition in dict.fromkeys(self.transitions):
            draft.transition(transition, priority.get(transition, 0))
        tests_last = sorted(self.arcs, key=lambda arc: arc[3] == "test")
        for source, target, weight, kind, at in tests_last:
            draft.arc(source, target, weight, kind, at)
        labels = {n: text for n, text in self.labels.items() if text != n}
        return NetFile(draft.net(), self.name, None, labels, {}, (*draft.notes, *self.notes))

    def _priorities(self) -> dict[str, int]:
        """Levels for the pairwise relation; refused where levels would add pairs that the file does
        not say."""
        pairs = {(high, low) for highs, lows in self.above for high in highs for low in lows}
        if not pairs:
            return {}
        level = dict.fromkeys(self.transitions, 0)
        for _ in level:
            for high, low in pairs:
                level[high] = max(level.get(high, 0), level.get(low, 0) + 1)
        implied = {(a, b) for a in level for b in level if level[a] > level[b]}
        if implied - pairs - {(a, d) for a, b in pairs for c, d in pairs if b == c}:
            remedy = "only priorities that form levels over all transitions are read"
            raise FormatError(self.file, "pr", "priorities between some pairs only", remedy)
        return level


def _joined(words: list[str]) -> list[str]:
    """Words with suffixes of braced names (`{a b}*2`) put together again."""
    out: list[str] = []
    for word in words:
        if out and out[-1].endswith("}") and word[0] in "*?!":
            out[-1] += word
        else:
            out.append(word)
    return out


def _split(word: str) -> tuple[str, str]:
    """(place, suffix that says kind and weight)."""
    end = (
        word.rindex("}") + 1
        if word.startswith("{")
        else next((i for i, c in enumerate(word) if c in "*?!"), len(word))
    )
    return _bare(word[:end]), word[end:]


def _bare(word: str) -> str:
    return re.sub(r"\\(.)", r"\1", word[1:-1]) if word.startswith("{") else word


def _number(text: str) -> int:
    return int(text[:-1]) * SCALE[text[-1]] if text[-1] in SCALE else int(text)


def _quoted(name: str) -> str:
    return name if PLAIN.match(name) else "{" + re.sub(r"([\\{}])", r"\\\1", name) + "}"


def losses(model: NetFile) -> list[str]:
    """What a `.net` file cannot say."""
    net: Net = model.net
    out = []
    if any(c is not None for c in net.capacity):
        out.append("capacities: written as inhibitor arcs")
    if model.gspn is not None:
        out.append("rates and weights")
    return out


def write_tina(model: NetFile) -> str:
    """The TINA text of a net; capacities become inhibitor arcs with the same effect."""
    net = model.net
    lines = [f"net {_quoted(model.name or 'net')}"]
    for t, name in enumerate(net.transitions):
        label = f" : {_quoted(model.labels[name])}" if name in model.labels else ""
        below = net.compiled.bars[t]
        if any(k < 1 for _, k in below):
            raise FormatError(
                "net", f"transition {name}", "its capacity can never be kept", "raise the capacity"
            )
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
