"""What if: change tokens, times, shares or rates of a model without editing its file.

A change is written SUBJECT=NUMBER, or SUBJECT*=FACTOR:

    runs=10                                      tokens of a resource or control place
    locate_ball.error.share=0.05                 one status of all actions of a primitive task:
                                                 `share`, `mean` (s) or `cv`
    locate_ball.locate_hough.success.mean=0.4    the same for one action
    move_to_point.mean*=1.5                      all statuses: the arm is 1.5 times slower
    serve.rate=2.5, serve.weight=3               a transition of a net with rates (1/s)

When shares change, the other shares of the action keep their proportions. The share of `error` is
that of the errors which the action reports: runs that were ended at their deadline keep theirs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.analysis.formats.netfile import NetFileError
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.task import Estimate, Kind, PrimitiveTask, Status, Task
from petrobot.coordinator.task.net import Net

FIELDS = ("share", "mean", "cv")
FORM = (
    "write PLACE=N, PRIMITIVE.STATUS.share=X (or .mean, .cv), "
    "PRIMITIVE.ACTION.STATUS.mean=X or TRANSITION.rate=X; *= multiplies, as PRIMITIVE.mean*=1.5"
)

ROUNDING = 1e-9
"""How far the sum of shares may differ from 1."""

Runs = dict[tuple[str, str], Mapping[Status, Estimate]]


class Change(Struct, frozen=True):
    """One change: the name of a number, and its new value, or what multiplies it."""

    subject: tuple[str, ...]
    value: float
    factor: bool = False

    @property
    def text(self) -> str:
        """The change as it is written on the command line."""
        return f"{'.'.join(self.subject)}{'*' * self.factor}={self.value:g}"

    def new(self, old: float) -> float:
        """Return the changed number."""
        return old * self.value if self.factor else self.value

    def fault(self, problem: str, remedy: str = FORM) -> NetFileError:
        """Return an error about this change, for the caller to raise."""
        return NetFileError("what if", self.text, problem, remedy)

    def count(self, old: int) -> int:
        """Return the changed number of tokens. Raises NetFileError."""
        new = self.new(old)
        if new < 0 or new != int(new):
            raise self.fault("a number of tokens is expected", "give a whole number, 0 or more")
        return int(new)


def read_change(text: str) -> Change:
    """Parse a change. Raises NetFileError."""
    subject, sign, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        number = float("nan")
    if not sign or not subject.strip() or not abs(number) < float("inf"):
        raise NetFileError("what if", text, "not of the form NAME=NUMBER", FORM)
    factor, subject = subject.rstrip().endswith("*"), subject.rstrip().removesuffix("*")
    return Change(tuple(part.strip() for part in subject.split(".")), number, factor)


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
            if change.subject[-1] == "mean" and (by := measured.preempted.get(key)):
                raise change.fault(
                    f"how often {' and '.join(by)} would preempt such runs of {key[0]}, the "
                    "stochastic view does not know",
                    "`petrobot forecast --estimates CAMPAIGN --what-if` simulates it",
                )
            if change.subject[-1] == "share":
                shares.setdefault(key, {})[Status(change.subject[-2])] = change
            elif Status.ERROR in statuses_of(task, change)[2]:  # it is of all these ends
                late.pop(key, None)
    for key, wanted in shares.items():
        at_deadline = late[key].share if key in late else 0.0
        runs[key] = _with_shares(runs[key], wanted, at_deadline)
    sources |= {key: f"what if {', '.join(texts)}" for key, texts in said.items()}
    expected = measured.expected | (set(sources) - set(measured.runs))
    return task, replace(measured, runs=runs, sources=sources, expected=expected, late=late)


def _other_tokens(task: Task, change: Change) -> Task:
    name = change.subject[0]
    place = task.places.get(name)
    if place is None or place.kind not in (Kind.RESOURCE, Kind.CONTROL):
        raise change.fault(f"{name} is not a resource or control place of {task.name}")
    n = change.count(place.tokens)
    capacity = None if place.capacity is None else max(place.capacity, n)
    return replace(task, places={**task.places, name: replace(place, tokens=n, capacity=capacity)})


def _other_estimate(task: Task, runs: Runs, change: Change) -> list[tuple[str, str]]:
    """Change the estimates of one action, or of all actions of a primitive task, except the shares,
    which `_with_shares` sets when all changes are known.

    What was measured in single places counts before what is known of the primitive task, so it is
    changed as well. Returns the keys of the changed estimates.
    """
    changed = []
    primitive, actions, statuses = statuses_of(task, change)
    for action in actions:
        known = runs.get((primitive.name, action), primitive.estimates)
        places = [p.name for p in task.flat.places.values() if p.task == primitive.name]
        measured = [(place, action) for place in places if (place, action) in runs]
        for one in measured or [(primitive.name, action)]:
            runs[one] = _altered(runs.get(one, known), statuses, change)
            changed.append(one)
    return changed


def statuses_of(task: Task, change: Change) -> tuple[PrimitiveTask, tuple[str, ...], list[Status]]:
    """Return the primitive task of a change of estimates, its actions and statuses that change.

    Raises NetFileError.
    """
    *subject, key = change.subject
    named = bool(subject) and subject[-1] in list(Status)
    statuses = [Status(subject.pop())] if named else list(Status)
    primitive = task.primitive_tasks.get(subject[0]) if subject else None
    every = key == "mean" and change.factor  # only longer or shorter makes sense of all statuses
    if primitive is None or len(subject) > 2 or key not in FIELDS or not (named or every):
        raise change.fault(f"{task.name} has no such number")
    if len(subject) == 1:
        return primitive, primitive.alternatives, statuses
    if subject[1] not in primitive.alternatives:
        raise change.fault(
            f"{subject[1]} is not an alternative of {primitive.name}",
            f"its alternatives are {', '.join(primitive.alternatives)}",
        )
    return primitive, (subject[1],), statuses


def _altered(
    known: Mapping[Status, Estimate], statuses: Sequence[Status], change: Change
) -> Mapping[Status, Estimate]:
    out, key = dict(known), change.subject[-1]
    for status in statuses:
        if status not in known and len(statuses) > 1:
            continue
        if status not in known and key != "share":
            raise change.fault(f"no estimate is known for status {status}; set its share first")
        longest = max((e.mean for e in known.values()), default=1.0)
        old = known.get(status, Estimate(0.0, longest))
        # the shares are set together, by `_with_shares`
        changed = {} if key == "share" else {key: in_range(change, getattr(old, key))}
        out[status] = replace(old, **changed)
    return out


def in_range(change: Change, old: float) -> float:
    """Return the changed share, mean or cv. Raises NetFileError."""
    value, key = change.new(old), change.subject[-1]
    if value < 0 or (key == "share" and value > 1) or (key == "mean" and value == 0):
        raise change.fault("out of range", "a share is from 0 to 1, a mean above 0, a cv 0 or more")
    return value


def _with_shares(
    known: Mapping[Status, Estimate], wanted: Mapping[Status, Change], late: float
) -> Mapping[Status, Estimate]:
    """Return the estimates of an action with the wanted shares. `late`: the part of the share of
    ERROR that comes at the deadline. Raises NetFileError."""
    # With preemptions as causes of their own, the shares of the statuses add up to less than 1.
    whole = sum(e.share for e in known.values()) or 1.0
    rest = sum(e.share for s, e in known.items() if s not in wanted)
    new = {
        status: in_range(change, known[status].share - kept) + kept
        for status, change in wanted.items()
        for kept in (late if status is Status.ERROR else 0.0,)
    }
    left = whole - sum(new.values())
    *_, last = wanted.values()
    if left < -ROUNDING:
        most = "1" if whole > 1 - ROUNDING else f"{whole:.3g}: other runs are preempted"
        raise last.fault(f"the shares of an action add up to at most {most}")
    if rest == 0 and left > ROUNDING:
        raise last.fault("no other status is known for the remaining share")
    scale = max(left, 0.0) / rest if rest else 0.0
    return {s: replace(e, share=new[s] if s in new else e.share * scale) for s, e in known.items()}


def change_net(net: Net, changes: Sequence[Change]) -> Net:
    """Return the net with changed initial tokens. Raises NetFileError."""
    initial = list(net.initial)
    for change in changes:
        name = ".".join(change.subject)
        if name not in net.place_index:
            raise change.fault(f"the net has no place {name}" + _rates_hint(name))
        at = net.place_index[name]
        initial[at] = change.count(initial[at])
    return replace(net, initial=tuple(initial))


def _rates_hint(name: str) -> str:
    return ", and no rates (give --rates)" if name.endswith((".rate", ".weight")) else ""


def change_gspn(gspn: Gspn, changes: Sequence[Change]) -> Gspn:
    """Return the GSPN with changed initial tokens, rates and weights. Raises NetFileError."""
    for change in changes:
        name, _, key = ".".join(change.subject).rpartition(".")
        try:
            if key in ("rate", "weight") and name in gspn.net.transition_index:
                old = getattr(gspn, key)[gspn.net.transition_index[name]]
                new = change.new(old or 1.0)  # `changed` refuses the rate of an immediate one
                if new <= 0:
                    raise change.fault("out of range", "rates and weights are above 0")
                gspn = gspn.changed(**{f"{key}s": {name: new}})
            else:
                gspn = replace(gspn, net=change_net(gspn.net, [change]))
        except NetFileError:
            raise
        except ValueError as error:
            raise change.fault(str(error)) from error
    return gspn
