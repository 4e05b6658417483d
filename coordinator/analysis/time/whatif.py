"""What if: change tokens, times, shares or rates of a model without editing its file.

A change is written SUBJECT=NUMBER:

    runs=10                                      tokens of a resource or control place
    locate_ball.error.share=0.05                 one status of all actions of a primitive task:
                                                 `share`, `mean` (s) or `cv`
    locate_ball.locate_hough.success.mean=0.4    the same for one action
    serve.rate=2.5, serve.weight=3               a transition of a net with rates (1/s)

When shares change, the other shares of the action keep their proportions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.task import Estimate, Kind, Status, Task
from petrobot.coordinator.task.net import Net

FIELDS = ("share", "mean", "cv")
FORM = (
    "write PLACE=N, PRIMITIVE.STATUS.share=X (or .mean, .cv), "
    "PRIMITIVE.ACTION.STATUS.mean=X or TRANSITION.rate=X"
)

ROUNDING = 1e-9
"""How far the sum of shares may differ from 1."""

Runs = dict[tuple[str, str], Mapping[Status, Estimate]]


@dataclass(frozen=True, slots=True)
class Change:
    """One change: the name of a number, and its new value."""

    subject: tuple[str, ...]
    value: float

    @property
    def text(self) -> str:
        """The change as it is written on the command line."""
        return f"{'.'.join(self.subject)}={self.value:g}"

    def fault(self, problem: str, remedy: str = FORM) -> NetFileError:
        """Return an error about this change, for the caller to raise."""
        return NetFileError("what if", self.text, problem, remedy)

    def count(self) -> int:
        """Return the value as a number of tokens. Raises NetFileError."""
        if self.value < 0 or self.value != int(self.value):
            raise self.fault("a number of tokens is expected", "give a whole number, 0 or more")
        return int(self.value)


def read_change(text: str) -> Change:
    """Parse a change. Raises NetFileError."""
    subject, sign, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = float("nan")
    if not sign or not subject.strip() or not abs(number) < float("inf"):
        raise NetFileError("what if", text, "not of the form NAME=NUMBER", FORM)
    return Change(tuple(part.strip() for part in subject.split(".")), number)


def change_task(task: Task, measured: Measured, changes: Sequence[Change]) -> tuple[Task, Measured]:
    """Return the task with changed tokens, and the measurements with changed estimates.

    Raises NetFileError.
    """
    runs: Runs = dict(measured.runs)
    sources, late = dict(measured.sources), dict(measured.late)
    said: dict[tuple[str, str], list[str]] = {}
    shares: dict[tuple[str, str], dict[Status, Change]] = {}
    for change in changes:
        if len(change.subject) == 1:
            task = _other_tokens(task, change)
            continue
        for key in _other_estimate(task, runs, change):
            said.setdefault(key, []).append(change.text)
            if change.subject[-1] == "share":
                shares.setdefault(key, {})[Status(change.subject[-2])] = change
            elif change.subject[-2] == Status.ERROR:  # it is of all these ends
                late.pop(key, None)
    for key, wanted in shares.items():
        runs[key] = _with_shares(runs[key], wanted)
    sources |= {key: f"what if {', '.join(texts)}" for key, texts in said.items()}
    expected = measured.expected | (set(sources) - set(measured.runs))
    return task, replace(measured, runs=runs, sources=sources, expected=expected, late=late)


def _other_tokens(task: Task, change: Change) -> Task:
    name, n = change.subject[0], change.count()
    place = task.places.get(name)
    if place is None or place.kind not in (Kind.RESOURCE, Kind.CONTROL):
        raise change.fault(f"{name} is not a resource or control place of {task.name}")
    capacity = None if place.capacity is None else max(place.capacity, n)
    return replace(task, places={**task.places, name: replace(place, tokens=n, capacity=capacity)})


def _other_estimate(task: Task, runs: Runs, change: Change) -> list[tuple[str, str]]:
    """Change the estimates of one action, or of all actions of a primitive task, except the shares,
    which `_with_shares` sets when all changes are known.

    What was measured in single places counts before what is known of the primitive task, so it is
    changed as well. Returns the keys of the changed estimates.
    """
    changed = []
    *subject, word, key = change.subject
    primitive = task.primitive_tasks.get(subject[0]) if subject else None
    if primitive is None or len(subject) > 2 or word not in list(Status) or key not in FIELDS:
        raise change.fault(f"{task.name} has no such number")
    actions = primitive.alternatives if len(subject) == 1 else (subject[1],)
    for action in actions:
        if action not in primitive.alternatives:
            raise change.fault(
                f"{action} is not an alternative of {primitive.name}",
                f"its alternatives are {', '.join(primitive.alternatives)}",
            )
        known = runs.get((primitive.name, action), primitive.estimates)
        places = [p.name for p in task.flat.places.values() if p.task == primitive.name]
        measured = [(place, action) for place in places if (place, action) in runs]
        for one in measured or [(primitive.name, action)]:
            runs[one] = _altered(runs.get(one, known), Status(word), key, change)
            changed.append(one)
    return changed


def _altered(
    known: Mapping[Status, Estimate], status: Status, key: str, change: Change
) -> Mapping[Status, Estimate]:
    value = change.value
    if value < 0 or (key == "share" and value > 1) or (key == "mean" and value == 0):
        raise change.fault("out of range", "a share is from 0 to 1, a mean above 0, a cv 0 or more")
    if status not in known:
        if key != "share":
            raise change.fault(f"no estimate is known for status {status}; set its share first")
        mean = max((e.mean for e in known.values()), default=1.0)
        return {**known, status: Estimate(0.0, mean)}
    if key == "share":
        return known
    return {**known, status: replace(known[status], **{key: value})}


def _with_shares(
    known: Mapping[Status, Estimate], wanted: Mapping[Status, Change]
) -> Mapping[Status, Estimate]:
    """Return the estimates of an action with the wanted shares. Raises NetFileError."""
    # With preemptions as causes of their own, the shares of the statuses add up to less than 1.
    whole = sum(e.share for e in known.values()) or 1.0
    rest = sum(e.share for s, e in known.items() if s not in wanted)
    left = whole - sum(change.value for change in wanted.values())
    *_, last = wanted.values()
    if left < -ROUNDING:
        most = "1" if whole > 1 - ROUNDING else f"{whole:.3g}: other runs are preempted"
        raise last.fault(f"the shares of an action add up to at most {most}")
    if rest == 0 and left > ROUNDING:
        raise last.fault("no other status is known for the remaining share")
    scale = max(left, 0.0) / rest if rest else 0.0
    return {
        s: replace(e, share=wanted[s].value if s in wanted else e.share * scale)
        for s, e in known.items()
    }


def change_net(net: Net, changes: Sequence[Change]) -> Net:
    """Return the net with changed initial tokens. Raises NetFileError."""
    initial = list(net.initial)
    for change in changes:
        name = ".".join(change.subject)
        if name not in net.place_index:
            raise change.fault(f"the net has no place {name}" + _rates_hint(name))
        initial[net.place_index[name]] = change.count()
    return replace(net, initial=tuple(initial))


def _rates_hint(name: str) -> str:
    return ", and no rates (give --rates)" if name.endswith((".rate", ".weight")) else ""


def change_gspn(gspn: Gspn, changes: Sequence[Change]) -> Gspn:
    """Return the GSPN with changed initial tokens, rates and weights. Raises NetFileError."""
    for change in changes:
        name, _, key = ".".join(change.subject).rpartition(".")
        try:
            if key in ("rate", "weight") and name in gspn.net.transition_index:
                if change.value <= 0:
                    raise change.fault("out of range", "rates and weights are above 0")
                gspn = gspn.changed(**{f"{key}s": {name: change.value}})
            else:
                gspn = replace(gspn, net=change_net(gspn.net, [change]))
        except NetFileError:
            raise
        except ValueError as error:
            raise change.fault(str(error)) from error
    return gspn
