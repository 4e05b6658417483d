"""Measures of the user: arithmetic over the numbers of a forecast or a long run.

Written as an expression, if wanted with a name in front: `late=late(20)`, `time(0.95)`,
`busy=1-marked(arm_free)`, `rate(serve)/rate(arrive)`. The numbers are

- `time(Q)`: the time (s) by which a share Q of the completing mission runs has completed;
- `late(S)`: the probability that a mission run has not completed within S seconds;
- `rate(TRANSITION)`: its firings per second, with those of the copies that `tries` made of it; of a
  task in mission runs without pauses;
- `tokens(PLACE)`, `marked(PLACE)`: time average of its tokens, share of time with any token;
- `P_complete`, `R_goal`, `R_conj`, `mean` (s): as in the forecast.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from fractions import Fraction
from math import isfinite

from msgspec import Struct

from petrobot.coordinator.analysis.formats.netfile import NetFileError, evaluate
from petrobot.coordinator.analysis.time.markov import LongRun
from petrobot.coordinator.analysis.time.task_forecast import Forecast

CALL = re.compile(r"([A-Za-z_]\w*)\(\s*([^()]*?)\s*\)")
LONG_RUN = "rate(T), tokens(P), marked(P)"
FORM = f"write an expression of time(Q), late(S), {LONG_RUN}, mean, P_complete"


class Measure(Struct, frozen=True):
    """A measure as it was written, and its name in tables."""

    name: str
    text: str


def read_measures(texts: Sequence[str]) -> list[Measure]:
    """Split each measure into name and expression. Raises NetFileError."""
    read: dict[str, Measure] = {}
    for text in texts:
        name, _, rest = (part.strip() for part in text.partition("="))
        measure = Measure(name, rest if "=" in text else name)
        if not measure.name or not measure.text:
            raise NetFileError(
                "--measure", name or rest, "a part is empty", "write NAME=EXPRESSION"
            )
        if name in read:
            problem = "two measures have this name"
            raise NetFileError("--measure", name, problem, "write NAME=EXPRESSION")
        read[name] = measure
    return list(read.values())


def value_of(measure: Measure, found: Forecast | LongRun) -> float:
    """Return the value of a measure. Raises NetFileError."""
    numbers: dict[str, Callable[[], float | None]] = {}
    calls: dict[str, Callable[[str], float]] = {
        "rate": lambda name: _rate(measure, name, found),
        "tokens": lambda name: _named(measure, "place", name, found.mean_tokens),
        "marked": lambda name: _named(measure, "place", name, found.occupancy),
    }
    if isinstance(found, Forecast):
        calls |= {
            "time": lambda q: found.completion_time.quantile(_number(measure, q, 1.0)),
            "late": lambda s: _late(found, _number(measure, s, float("inf"))),
        }
        numbers = {
            "P_complete": lambda: found.completion_probability,
            "R_goal": lambda: found.goal_reliability,
            "R_conj": lambda: found.conjunctive_reliability,
            "mean": lambda: found.done.mean,
        }
    names: dict[str, Fraction] = {}
    form = FORM if isinstance(found, Forecast) else f"write an expression of {LONG_RUN}"

    def exact(value: float | None, what: str) -> Fraction:
        if value is None or not isfinite(value):
            raise _fault(measure, f"{what} is not defined here", "leave it out")
        return Fraction(value)

    def called(match: re.Match[str]) -> str:
        word, argument = match.groups()
        if word not in calls:
            raise _fault(measure, f"unknown measure {word}(...)", form)
        name = f"value_{len(names)}"
        names[name] = exact(calls[word](argument), match[0])
        return f" {name} "

    text = CALL.sub(called, measure.text)
    names |= {
        word: exact(number(), word)
        for word, number in numbers.items()
        if re.search(rf"\b{word}\b", text)
    }
    try:
        return float(evaluate(text, names))
    except ZeroDivisionError as error:
        raise _fault(measure, "a division by 0", "divide by what is not 0 here") from error
    except ValueError as error:
        raise _fault(measure, str(error), form) from error


def _late(found: Forecast, seconds: float) -> float:
    share = found.completion_probability
    return 1.0 - share * found.completion_time.cdf(seconds) if share > 0 else 1.0


def _fault(measure: Measure, problem: str, remedy: str) -> NetFileError:
    return NetFileError("--measure", measure.text, problem, remedy)


def _rate(measure: Measure, name: str, found: Forecast | LongRun) -> float:
    rate = _named(measure, "transition", name, found.throughput)
    if isinstance(found, Forecast):
        of_task = found.view.task.flat.transitions.values()
        rate += sum(found.throughput[t.name] for t in of_task if t.copy_of == name != t.name)
    return rate


def _named(measure: Measure, what: str, name: str, known: dict[str, float]) -> float:
    if name not in known:
        raise _fault(measure, f"no {what} {name!r}", f"{what}s: {', '.join(list(known)[:10])}")
    return known[name]


def _number(measure: Measure, text: str, below: float) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise _fault(measure, f"expected a number, got {text!r}", FORM) from error
    if not 0.0 < value < below:
        end = "" if below == float("inf") else f" and less than {below:g}"
        raise _fault(measure, f"{text} is out of range", f"give more than 0{end}")
    return value
