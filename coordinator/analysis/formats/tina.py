"""Reader and writer of TINA's textual nets (`.net`).

Places, transitions, weights `p*2`, test arcs `p?2`, inhibitor arcs `p?-2`, priorities and labels. A
time interval is refused unless it is the trivial one, [0,w[. Source: manual page formats(n) of the
TINA toolbox.
"""

from __future__ import annotations

import re

from petrobot.coordinator.analysis.formats.netfile import NetDraft, NetFile, NetFileError
from petrobot.coordinator.task.net import Net

TOKEN = re.compile(r"\{(?:\\.|[^}\\])*\}|->|[^\s{]+")
PLAIN = re.compile(r"[A-Za-z_'][\w']*\Z")
SCALE = {"K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
ARC = re.compile(r"(?P<kind>\*|\?-|\?|!-|!)(?P<weight>\d+[KMGT]?)\Z")


def parse_tina(text: str, file: str = "net") -> NetFile:
    """Read the net in a TINA text. Raises NetFileError."""
    return _TinaReading(text, file).result()


class _TinaReading:
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
                raise NetFileError(
                    self.file,
                    at,
                    f"a line that begins with {other!r}",
                    "expected net, tr, pl, lb, pr or nt",
                )

    def _transition(self, words: list[str], at: str) -> None:
        if not words:
            raise NetFileError(self.file, at, "a transition without a name")
        name = _bare(words[0])
        self.transitions.append(name)
        rest = words[1:]
        if rest and rest[0] == ":":
            self.labels[name], rest = _bare(rest[1]), rest[2:]
        if rest and rest[0][0] in "[]":
            if rest[0] not in ("[0,w[", "[0,inf["):
                raise NetFileError(
                    self.file,
                    at,
                    f"a time interval {rest[0]}",
                    "only untimed nets are read; remove it",
                )
            rest = rest[1:]
        if "->" not in rest:
            raise NetFileError(
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
                raise NetFileError(
                    self.file, at, f"unknown arc {word!r}", "write p, p*2, p?2 or p?-2"
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
                raise NetFileError(
                    self.file, at, f"unexpected {word!r} after a place", "write pl NAME (TOKENS)"
                )
            self.tokens[name] += _number(word[1:-1])

    def result(self) -> NetFile:
        """Return the net. Raises NetFileError."""
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
        """Return priority levels that express the pairs in the file.

        Raises NetFileError if levels would rank pairs that the file does not rank.
        """
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
            raise NetFileError(self.file, "pr", "priorities between some pairs only", remedy)
        return level


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
    """Return (place, suffix with kind and weight)."""
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
    """Return what a `.net` file cannot express."""
    net: Net = model.net
    out = []
    if any(c is not None for c in net.capacity):
        out.append("capacities: written as inhibitor arcs")
    if model.gspn is not None:
        out.append("rates and weights")
    return out


def write_tina(model: NetFile) -> str:
    """Return the TINA text of a net; capacities become inhibitor arcs with the same effect.

    Raises NetFileError.
    """
    net = model.net
    lines = [f"net {_quoted(model.name or 'net')}"]
    for t, name in enumerate(net.transitions):
        label = f" : {_quoted(model.labels[name])}" if name in model.labels else ""
        below = net.compiled.bars[t]
        if any(k < 1 for _, k in below):
            raise NetFileError(
                "net",
                f"transition {name}",
                "it would always exceed a capacity, so it can never fire",
                "raise the capacity",
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
