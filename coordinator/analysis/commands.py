"""The commands analyse, simulate, convert and show --graph as functions: exit code, text, data.

Clocks and random generators come from the caller.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import hypot, isfinite, isnan, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.analysis.execution.chain import MissionFigures, played
from petrobot.coordinator.analysis.execution.progress import progress_of
from petrobot.coordinator.analysis.formats import FORMATS, read_net, written
from petrobot.coordinator.analysis.formats.netfile import (
    NetFile,
    NetFileError,
    read_rates,
    unit_rates,
)
from petrobot.coordinator.analysis.limits import OUT_OF_MEMORY, OutOfTime, until
from petrobot.coordinator.analysis.may_run import BUDGET, Cell, assumed, devices_of
from petrobot.coordinator.analysis.net.ends_net import ends_net
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.net.picture import graph_svg
from petrobot.coordinator.analysis.net.space import INTERRUPTED, SearchLimits, explore
from petrobot.coordinator.analysis.report import CUT, FULL, LATE, Analysis, analyse
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.measured import Measured, NoEstimate
from petrobot.coordinator.analysis.time.measures import (
    Measure as UserMeasure,
    read_measures,
    value_of,
)
from petrobot.coordinator.analysis.time.simulate import (
    IntervalEstimate,
    Simulation,
    goal_by_marking,
    simulate,
)
from petrobot.coordinator.analysis.time.stochastic import StochasticView, stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import (
    MATTERS,
    SAME,
    TIME,
    rough_fits,
    timer_shares,
)
from petrobot.coordinator.analysis.time.whatif import (
    Change,
    change_gspn,
    change_net,
    change_task,
    read_change,
)
from petrobot.coordinator.task import End, Kind, Place, Status, Task, Transition
from petrobot.coordinator.task.file import load
from petrobot.coordinator.task.net import Net
from petrobot.coordinator.task.wording import wrapped
from petrobot.services.host.whole_file import write_whole

OK, FAULT, BAD_INPUT = 0, 1, 2
SURE = 1e-4
"""Probability below which chance does not explain a difference from played missions."""
SEARCHED = 0.5
"""Share of the seconds of an analysis that its searches may use; the rest is for the verdicts."""
UNFINISHED = (
    "stopped early: replicas that were still active are left out, so those that take long are "
    "missing in shares and times; use fewer --replicas, or a --horizon"
)
FEWER = (
    "stopped early: the estimates are of the first {} of {} replicas, which all came to their end"
)

Measure = Callable[[Task, Cell | None], Measured]
"""Returns what was measured of a task that runs in a cell."""
CellOf = Callable[[Task], Cell | None]
"""Returns the cell in which a task runs; None: there is no location file."""


class CommandResult(Struct, frozen=True):
    """The result of a command: exit code, text for the terminal, plain data."""

    code: int
    text: str
    data: dict[str, Any]
    analysis: Analysis | None = None
    """The analysis itself, to draw its witnesses; only from `analyse_command`."""


def _full(code: int, text: str) -> CommandResult:
    """Return the result if the memory is used up. It is made before the work: at the MemoryError
    there may be none left for it, as the exception still holds all that was read."""
    return CommandResult(code, text, {"error": text})


def open_model(path: Path) -> Task | NetFile:
    """Open a task (`.toml`) or a net file. Raises NetFileError and the errors of `load`."""
    return load(path) if path.suffix == ".toml" else read_net(path)


def analyse_command(
    path: Path,
    *,
    view: str | None = None,
    rates: Path | str | None = None,
    stages: int = 8,
    limits: SearchLimits | None = None,
    structure: bool = True,
    changes: Sequence[str] = (),
    measure: Measure | None = None,
    measures: Sequence[str] = (),
    cell_of: CellOf | None = None,
) -> CommandResult:
    """Run `petrobot analyse`: code 0 if `Analysis.ok`, 1 if not (or unknown), 2 for bad input.

    `rates` is a rates file, or "unit". Without a `view`, a net with rates (passed here or in its
    file) is analysed as "gspn", everything else as "ordinary". `changes` (see `whatif`) are
    compared with the file as it is; code and text are those of the changed model.

    `measure` gives the measurements of a task; without it the declared estimates count. `measures`
    are expressions of the user (see `time.measures`); they need the numbers over time. `cell_of`
    gives the cell of a task; without one its actions share no devices.

    The seconds of `limits` are for everything together: searches get SEARCHED of them, and what
    follows stops at their end with "unknown". `structure` asks for invariants, siphons and traps
    in the data; they are not computed otherwise.
    """
    limits = limits or SearchLimits()
    clock, deadlines = limits.clock, _deadlines(limits, 1 + bool(changes))
    due = deadlines[-1][0]
    full = _full(FAULT, f"{path}: the memory was used up; give more --memory, or fewer --states")
    try:
        expressions = read_measures(measures)
        with until(due, clock):
            model = open_model(path)
        view = view or _view(model, rates)
        if expressions and view == "ordinary":
            why = "the ordinary view has no times: give --view gspn"
            raise NetFileError("--measure", expressions[0].text, "there are no numbers", why)
        subject, name, notes = _subject(model, rates, view)
        cell = _cell(model, cell_of)
        known = _measured(model, measure, cell)
        notes = (*notes, assumed(cell)) if isinstance(model, Task) else notes
        wanted = [read_change(text) for text in changes]
        plain = model.net if isinstance(model, NetFile) and rates is not None else None
        asked: list[tuple[Subject, Measured | None, Net | None]] = [(subject, known, plain)]
        if wanted:
            of_tokens = [c for c in wanted if plain and ".".join(c.subject) in plain.place_index]
            tokens = plain and change_net(plain, of_tokens)
            asked.append((*_changed(subject, known, wanted), tokens))
        analyses: list[Analysis] = []
        for (one, measured, ordinary), (ends, searched) in zip(asked, deadlines, strict=True):
            with until(ends, clock):
                found = analyse(
                    one,
                    name=name or path.stem,
                    view=view,
                    measured=measured,
                    stages=stages,
                    limits=replace(limits, due=searched),
                    ordinary=ordinary,
                    devices=devices_of(cell),
                )
            analyses.append(found)
        with until(due, clock):
            analyses[-1], data, said = _told(analyses[-1], structure)
            if wanted:
                now, as_it_is, _ = _told(analyses[0], False)
                what = [change.text for change in wanted]
                data |= {"what_if": what, "as_it_is": as_it_is}
                said += ["", f"what if {', '.join(what)}:", *_compared(now, analyses[-1])]
            if expressions:
                said += _tell_measures(expressions, analyses, data)
            times = ["time(0.9)"] * bool(wanted) + [one.text for one in expressions]
            notes += _unlike_missions(" ".join(times), analyses)
    except (NetFileError, ValueError, OverflowError) as error:
        return _refused(path, error)
    except OutOfTime as late:  # the input is good, and the answer is not known
        told = f"{_named(path, late)}; give more --seconds"
        return CommandResult(FAULT, told, {"error": told})
    except OUT_OF_MEMORY:
        return full
    notes = (*notes, *_raised_by(analyses[-1]))
    said += [wrapped(f"note: {note}", 4) for note in notes]
    answered = None not in data.get("measures", {}).values()
    return CommandResult(
        OK if analyses[-1].ok and answered else FAULT,
        "\n".join(said),
        data | {"notes": [*data["notes"], *notes]},
        analysis=analyses[-1],
    )


RAISED = {"limit of ": "--states", "memory limit": "--memory", "time limit": "--seconds"}
"""The option that raises a limit, by the first words of the reason that names it."""


def _raised_by(found: Analysis) -> Iterator[str]:
    """Yield a note that names the options that raise the limits which ended the searches; none
    where another note names them."""
    reasons = [found.qualitative.space.reason]
    reasons += [found.progress.x.reason] if found.progress else []
    options = [o for words, o in RAISED.items() if any(r.startswith(words) for r in reasons)]
    told = " ".join(found.told)
    if options := [option for option in options if option not in told]:
        yield f"to search further give more {' and '.join(options)}"


def _deadlines(limits: SearchLimits, analyses: int) -> list[tuple[float | None, float | None]]:
    """Return when each of the analyses must end, and its search before that; None: no limit.

    Each gets the same share of the seconds.
    """
    if limits.seconds is None:
        return [(None, None)] * analyses
    began, span = limits.clock() if limits.clock else 0.0, limits.seconds / analyses
    ends = [began + (i + 1) * span for i in range(analyses)]
    return [(end, end - (1 - SEARCHED) * span) for end in ends]


def _tell_measures(
    measures: Sequence[UserMeasure], analyses: Sequence[Analysis], data: dict[str, Any]
) -> list[str]:
    """Add each measure of the user to the data, and return the lines that tell it in all analyses.
    Raises NetFileError."""
    rows = {one.name: _measure_values(one, analyses) for one in measures}
    data["measures"] = {name: values[-1] for name, values in rows.items()}
    if "as_it_is" in data:
        data["as_it_is"]["measures"] = {name: values[0] for name, values in rows.items()}
    lines = (f"  {name:28}{' -> '.join(map(_digits, values))}" for name, values in rows.items())
    return ["", "measures:", *lines]


def _unlike_missions(text: str, analyses: Sequence[Analysis]) -> tuple[str, ...]:
    """Return, as a note, which `late(S)` and `time(Q)` of a text missions with exact times have
    otherwise: by more than MATTERS, and than chance explains."""
    off = dict[str, None]()
    for call, word, argument in re.findall(r"((time|late)\(\s*([^()]*?)\s*\))", text):
        for one in analyses:
            if one.forecast is not None and one.missions is not None and one.missions.times:
                with suppress(OutOfTime):
                    value = value_of(UserMeasure(call, call), one.forecast)
                    there, chance = _played(one.missions, word, float(argument), value)
                    if abs(value - there) > MATTERS * abs(there) and chance < SURE:
                        off[f"{call} is {value:.6g} here, {there:.6g} there"] = None
    note = f"doubtful, as durations have few phases: missions with exact times: {'; '.join(off)}"
    return (note,) * bool(off)


def _played(plays: MissionFigures, word: str, given: float, value: float) -> tuple[float, float]:
    """Return `time(given)` or `late(given)` of played missions, and the probability that as few or
    as many of them are below it, or late, if `value` is right."""
    from scipy.special import bdtr, bdtrc  # here: most commands have none of these numbers

    times, n = np.sort(plays.times), plays.missions
    if word == "time":
        n, share, there = len(times), given, float(np.quantile(times, given))
        count = int(np.searchsorted(times, value))
    else:
        share, count = value, n - int(np.searchsorted(times, given * (1 + SAME), "right"))
        there = count / n
    return there, min(bdtr(count, n, share), bdtrc(count - 1, n, share) if count else 1.0)


def _measure_values(measure: UserMeasure, analyses: Sequence[Analysis]) -> list[float | None]:
    """Return the value of a measure in each analysis; None where it could not be computed, which
    its notes explain. Raises NetFileError."""
    values: list[float | None] = []
    for analysis in analyses:
        numbers, value = analysis.forecast or analysis.run, None
        if numbers is not None:
            with suppress(OutOfTime):
                value = value_of(measure, numbers)
        values.append(value)
    return values


def _view(model: Task | NetFile, rates: Path | str | None) -> str:
    """Return the default view: "gspn" for a net with rates, else "ordinary"."""
    return (
        "gspn"
        if isinstance(model, NetFile) and (rates is not None or model.gspn is not None)
        else "ordinary"
    )


def _named(path: Path, error: Exception) -> str:
    """Return the error message, prefixed by the file unless the message names it already."""
    told = str(error)
    return (
        told
        if isinstance(error, NetFileError) or told.startswith(f"{path}:")
        else f"{path}: {told}"
    )


def _refused(path: Path, error: Exception) -> CommandResult:
    told = _named(path, error)
    return CommandResult(BAD_INPUT, told, {"error": told})


def _told(found: Analysis, structure: bool) -> tuple[Analysis, dict[str, Any], list[str]]:
    """Return the analysis with its data and text.

    Structure, the verdicts of progress and the distribution of the completion time are computed
    only now, so Ctrl-C may arrive here, or time or memory be used up: then the forecast is left
    out, and what is not known stays unknown. Of a forecast that lacks only that distribution
    nothing else is left out.
    """
    try:
        data = found.to_json(structure=structure)
        numbers = found.forecast
        if numbers is None or numbers.completion_probability == 0 or data["forecast"]["quantiles"]:
            return found, data, [found.text()]
        if LATE not in found.notes:
            found, data["notes"] = (
                replace(found, notes=(*found.notes, LATE)),
                [*data["notes"], LATE],
            )
        return found, data, [found.text()]
    except KeyboardInterrupt:
        note, cut = CUT, True
    except OutOfTime:
        note, cut = LATE, found.interrupted
    except OUT_OF_MEMORY:
        note, cut = FULL, found.interrupted
    notes = tuple(dict.fromkeys((*found.notes, note)))
    part = replace(found, interrupted=cut, forecast=None, notes=notes)
    return part, part.to_json(structure=False), [part.text()]


Subject = Task | Net | Gspn


def _cell(model: Task | NetFile, cell_of: CellOf | None) -> Cell | None:
    """Return the cell of a task; a net of another tool has none."""
    return cell_of(model) if cell_of is not None and isinstance(model, Task) else None


def _measured(model: Task | NetFile, measure: Measure | None, cell: Cell | None) -> Measured:
    """Return the measurements of a task. Raises NetFileError if the model is not a task."""
    if measure is None:
        return Measured()
    if not isinstance(model, Task):
        raise _no_estimates(model)
    return measure(model, cell)


def _no_estimates(net: NetFile) -> NetFileError:
    problem = "this is a net; estimates are of tasks"
    return NetFileError("--estimates", net.name, problem, "leave it out; rates are in the file")


def _changed(
    subject: Subject, measured: Measured, changes: Sequence[Change]
) -> tuple[Subject, Measured | None]:
    if isinstance(subject, Task):
        return change_task(subject, measured, changes)
    return (
        change_gspn(subject, changes) if isinstance(subject, Gspn) else change_net(subject, changes)
    ), None


def _compared(now: Analysis, then: Analysis) -> list[str]:
    """Return a table of the verdicts and numbers before and after the changes."""
    words = {True: "yes", False: "NO", None: "unknown"}
    rows = [
        (name.replace("_", " "), words[before.holds], words[after.holds])
        for (name, before), after in zip(
            now.verdicts().items(), then.verdicts().values(), strict=True
        )
        if before.holds is not after.holds
    ]
    try:
        one, other = now.figures(), then.figures()
    except OutOfTime:
        one, other = {}, {}
    rows += [(name, _digits(one.get(name)), _digits(other.get(name))) for name in {**one, **other}]
    lines = [f"  {'':30}{'as it is':>14}{'what if':>14}"]
    return [*lines, *(f"  {name:30}{before:>14}{after:>14}" for name, before, after in rows)]


def _digits(figure: float | None) -> str:
    return "-" if figure is None or isnan(figure) else f"{figure:.6g}"


def _subject(
    model: Task | NetFile, rates: Path | str | None, view: str
) -> tuple[Subject, str, tuple[str, ...]]:
    """Return (what to analyse, its name, notes). Raises NetFileError for rates that do not fit."""
    if isinstance(model, Task):
        if rates is not None:
            remedy = (
                "leave it out: a task's times are its `estimates` and `mean_wait`, and "
                "--what-if changes them"
            )
            raise NetFileError(
                "--rates", str(rates), f"{model.name} is a task; rates are for net files", remedy
            )
        return model, model.name, ()
    if rates == "unit":
        return unit_rates(model), model.name, (*model.notes, "every transition has the rate 1/s")
    if rates is not None:
        path = Path(rates)
        return read_rates(_text(path), str(path), model), model.name, model.notes
    if view != "gspn":
        return model.net, model.name, model.notes
    if model.gspn is None:
        raise NetFileError(
            model.name or "net", "rates", "the file has none", "give --rates FILE, or --rates unit"
        )
    return model.gspn, model.name, model.notes


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        problem = error.strerror or str(error)
        raise NetFileError(str(path), "file", problem, "give a readable file") from error
    except UnicodeDecodeError as error:
        raise NetFileError(str(path), "file", str(error), "give a UTF-8 file") from error


def simulate_command(
    path: Path,
    random: np.random.Generator,
    *,
    rates: Path | str | None = None,
    replicas: int = 1000,
    horizon: float | None = None,
    warmup: float = 0.0,
    firings: int = 10_000_000,
    stages: int = 64,
    changes: Sequence[str] = (),
    measure: Measure | None = None,
    progress: Callable[[int, float], None] | None = None,
    cell_of: CellOf | None = None,
) -> CommandResult:
    """Run `petrobot simulate`: a task until it is final or dead, a net until `horizon` (s).

    A net needs a horizon; for a task it is optional. `changes` as in `whatif`.
    """
    told = f"{path}: the memory was used up; use fewer --replicas, or a smaller net"
    full = _full(BAD_INPUT, told)
    try:
        model, wanted = open_model(path), [read_change(text) for text in changes]
        cell = _cell(model, cell_of)
        known = _measured(model, measure, cell)
        subject, name, notes = _subject(model, rates, "gspn")
        goal = lost = task = view = measured = None
        if isinstance(model, Task):
            task, measured = change_task(model, known, wanted)
            view = stochastic_view(
                task, measured, stages=stages, timer_stages=stages, devices=devices_of(cell)
            )
            gspn, notes = view.gspn, (*view.assumptions, assumed(cell))
            goal = goal_by_marking(lambda m: view.ended(m) is Status.SUCCESS)
            lost = goal_by_marking(lambda m: view.ended(m) is Status.ERROR)
        else:
            assert isinstance(subject, Gspn)
            gspn = change_gspn(subject, wanted)
            if horizon is None:
                raise NetFileError(
                    str(path), "horizon", "a net has no final marking", "give --horizon SECONDS"
                )
        seen = simulate(
            gspn,
            random,
            replicas=replicas,
            horizon=np.inf if horizon is None else horizon,
            warmup=warmup,
            goal=goal,
            lost=lost,
            firings=firings,
            progress=progress,
        )
        if task is not None and view is not None:
            doubts = [*view.doubts]
            if horizon is None and seen.complete:
                doubts += _unlike_the_engine(task, measured, devices_of(cell), seen, stages)
            notes = (*(f"doubtful: {text}" for text in doubts), *_rough(view, seen, stages), *notes)
        if not seen.complete:
            missing = seen.active or seen.replicas == replicas  # of all, Ctrl-C came in the last
            notes = (UNFINISHED if missing else FEWER.format(seen.replicas, replicas), *notes)
        return _simulated(name or path.stem, seen, notes)
    except (NetFileError, NoEstimate, ValueError, KeyError, OverflowError) as error:
        return _refused(path, error)
    except OUT_OF_MEMORY:
        return full


def _rough(view: StochasticView, seen: Simulation, stages: int) -> list[str]:
    """Return, as a note, which durations have too few phases for quantiles of the time: error times
    share of the time, as for the exact solution."""
    net, fired = view.gspn.net, dict[str, float]()
    chains: dict[str, set[str]] = {}
    """By duration: the chains of phases that it has, also those that it shares."""
    for label, (key, _, _) in view.begins.items():
        given = {net.places[p] for p, _ in net.produce[net.transition_index[label]]}
        chains.setdefault(key, set()).update(view.chains[p] for p in given & set(view.chains))
    shares = {
        key: sum(seen.mean_tokens[p].mean for p, chain in view.chains.items() if chain in own)
        for key, own in chains.items()
    }
    for case, name in view.origin.items():
        fired[name] = fired.get(name, 0.0) + seen.throughput[case].mean
    found = rough_fits(view.fit_errors, shares | timer_shares(view, fired))
    rough = {key: error for key, error, _ in found}
    most = 100 * max(rough.values(), key=abs, default=0.0)
    few = f"off by up to {most:+.0f} %, because a duration has at most {stages} phases"
    return [f"approximated: the 90 % quantile of {', '.join(rough)} is {few}"] if rough else []


def _unlike_the_engine(
    task: Task,
    measured: Measured | None,
    devices: Mapping[str, str] | None,
    seen: Simulation,
    stages: int,
) -> list[str]:
    """Return which figures of a simulation missions on the execution graph have otherwise, where
    the engine decides conflicts and times have no phases; or why that is not known."""
    assert seen.completed is not None
    try:
        x = progress_of(OrdinaryView(task), BUDGET.steps, measured, devices).x
        if not x.complete:
            raise ValueError("the execution graph is too large")
        plays = played(x, measured)
    except (ValueError, OutOfTime, KeyboardInterrupt, *OUT_OF_MEMORY) as why:
        memory = "out of memory" if isinstance(why, OUT_OF_MEMORY) else INTERRUPTED
        return [f"not compared with missions of the engine: {str(why) or memory}"]
    share, off = seen.completed.mean, list[str]()
    here = {"P_complete": (share, sqrt(share * (1 - share) / seen.replicas))}
    if seen.time is not None:
        here[TIME] = (seen.time.mean, float(seen.times.std()) / sqrt(len(seen.times)))
    for name, (value, error) in here.items():
        mean, other = plays.figures[name]
        if abs(value - mean) > max(5 * hypot(error, other), MATTERS * abs(mean)):
            off.append(f"{name} {value:.6g} here, {mean:.6g} there (standard error {other:.2g})")
    said = f"{plays.missions} missions of the execution graph have other figures: {', '.join(off)}"
    assumed = (
        "conflicts that neither priority nor weight decides are drawn, and a timer or a duration "
        f"has at most {stages} phases"
    )
    return [f"{said}. Here {assumed}"] * bool(off)


def _simulated(name: str, seen: Simulation, notes: tuple[str, ...]) -> CommandResult:
    def plain(one: IntervalEstimate) -> list[float | None]:
        return [x if isfinite(x) else None for x in (one.mean, one.low, one.high)]

    data: dict[str, Any] = {
        "name": name,
        "replicas": seen.replicas,
        "firings": seen.firings,
        "complete": seen.complete,
        "throughput": {t: plain(one) for t, one in seen.throughput.items()},
        "mean_tokens": {p: plain(one) for p, one in seen.mean_tokens.items()},
        "notes": list(notes),
    }
    lines = [
        f"{name}: {seen.replicas} replicas, {seen.firings} firings"
        + ("" if seen.complete else " (stopped early)")
    ]
    if seen.completed is not None:
        data["completed"] = plain(seen.completed)
        lines.append(f"  completed {_interval(seen.completed)}")
    if seen.time is not None:
        quantiles = {f"{q:g}": seen.quantile(q) for q in (0.5, 0.9, 0.99)}
        data |= {"time": plain(seen.time), "quantiles": quantiles}
        lines.append(
            f"  time {_interval(seen.time)} s; "
            + ", ".join(f"{q}: {t:.4g} s" for q, t in quantiles.items())
        )
    if seen.completed is None:
        lines += [f"  {t:24} {_interval(one)} /s" for t, one in seen.throughput.items()]
    return CommandResult(
        OK if seen.complete else FAULT, "\n".join([*lines, *(f"note: {n}" for n in notes)]), data
    )


def _interval(one: IntervalEstimate) -> str:
    return f"{one.mean:.6g} [{one.low:.6g}, {one.high:.6g}]"


def convert_command(
    source: Path,
    target: Path,
    *,
    view: str | None = None,
    exact: bool = False,
    measure: Measure | None = None,
    cell_of: CellOf | None = None,
) -> CommandResult:
    """Run `petrobot convert`: formats follow from the file endings; losses are listed.

    `view` of a task: "ordinary" or "gspn" (default: "gspn" for formats with rates, or if there is
    a `measure`). `exact` writes the ends net in place of the ordinary one.
    """
    assumed: list[str] = []
    which = ""
    told = f"{source}: the memory was used up; the net is too large for {target.suffix}"
    full = _full(BAD_INPUT, told)
    try:
        model = open_model(source)
        if exact and (not isinstance(model, Task) or view is not None or measure is not None):
            told = "the ends net of a task without times; leave out --view and --estimates"
            raise NetFileError("--exact", str(source), f"expected {told}", "or leave out --exact")
        if measure is not None and view == "ordinary":
            told = "the ordinary net has no times"
            raise NetFileError("--estimates", str(source), told, "leave out --view ordinary")
        if isinstance(model, Task):
            wanted = written_view(target, view, exact, measure is not None)
            cell = _cell(model, cell_of if wanted == "gspn" else None)
            known = _measured(model, measure, cell)
            model, lost, assumed = _exported(model, wanted, known, cell)
            which = f" ({WRITTEN[wanted]})"
        elif measure is not None:
            raise _no_estimates(model)
        elif view == "gspn" and model.gspn is None:
            raise NetFileError(str(source), "rates", "the file has none", "convert it as it is")
        elif view == "ordinary" and model.gspn is not None:
            model, lost = replace(model, gspn=None), [*model.notes, "rates and weights"]
        else:
            lost = list(model.notes)
        text, more = written(model, target)
        write_whole(target, text)
    except (NetFileError, NoEstimate, ValueError, OverflowError) as error:
        return _refused(source, error)
    except OUT_OF_MEMORY:
        return full
    except OSError as error:
        return CommandResult(
            BAD_INPUT,
            f"{target}: {error.strerror or error}; name a file that can be written",
            {"error": str(error)},
        )
    lost += more
    lines = [f"{source} -> {target}{which}", *(f"not kept: {what}" for what in lost)]
    lines += [f"assumed: {what}" for what in assumed]
    data = {"source": str(source), "target": str(target), "not_kept": lost, "assumed": assumed}
    return CommandResult(OK, "\n".join(lines), data)


def written_view(target: Path, view: str | None, exact: bool, measured: bool) -> str:
    """Return which net of a task `convert_command` writes, a key of `WRITTEN`."""
    form = FORMATS.get(target.suffix.lower())
    timed = measured or (form is not None and form.timed)
    return view or ("exact" if exact else "gspn" if timed else "ordinary")


WRITTEN = {
    "ordinary": "the ordinary net; --exact writes the one with the ends of runs",
    "exact": "the ends net: how a run ended is kept",
    "gspn": "the stochastic view: rates and weights",
}
"""Which net of a task a file holds."""


def _exported(
    task: Task, view: str, measured: Measured, cell: Cell | None
) -> tuple[NetFile, list[str], list[str]]:
    """Return a task as a net file in one of its views, what is lost, and what is assumed."""
    if view == "gspn":
        devices = devices_of(cell)
        timed = stochastic_view(task, measured, stages=8, timer_stages=8, devices=devices)
        made = NetFile(timed.gspn.net, task.name, timed.gspn)
        return made, [], [*timed.assumptions, assumed(cell)]
    flat = task.flat
    transitions = flat.transitions.values()
    n = ends_net(task) if view == "exact" else None
    parts = {
        "actions and the ends of their runs": n is None
        and any(p.kind is Kind.ACTION for p in flat.places.values()),
        "events (they may come at any time)": any(t.events for t in transitions),
        "conditions": n is None and any(t.when is not None for t in transitions),
        "timers (they may elapse at any time)": any(t.after is not None for t in transitions),
        "priorities": any(t.priority for t in transitions),
        "weights of transitions": any(t.weight is not None for t in transitions),
        "preemption (an ordinary arc instead)": n is None
        and any(a.end in (End.PREEMPT, End.GOING) for t in transitions for a in t.inputs),
        "the order of runs and of the file, and steps of several transitions": n is not None,
    }
    lost = [part for part, has in parts.items() if has]
    if n is None:
        return net_file_of(task), lost, []
    return NetFile(n.net, task.name), [*lost, *n.left_out], []


def net_file_of(task: Task) -> NetFile:
    """Return the ordinary net of a task with its labels and positions."""
    flat = task.flat
    positions: dict[str, tuple[float, float]] = {}
    labels: dict[str, str] = {}
    for node in (*flat.places.values(), *flat.transitions.values()):
        assert isinstance(node, Place | Transition)
        if node.x is not None and node.y is not None:
            positions[node.name] = (node.x, node.y)
        if node.label:
            labels[node.name] = node.label
    return NetFile(task.net, task.name, None, labels, positions)


def graph_command(path: Path) -> CommandResult:
    """Run `petrobot show --graph`: the reachability graph as SVG in data["svg"], with the path to
    the first deadlock highlighted."""
    try:
        model = open_model(path)
        net, final = model.net, None
        space = explore(net, limits=SearchLimits(states=10_000))
    except (NetFileError, ValueError, OverflowError) as error:
        return _refused(path, error)
    if isinstance(model, Task):
        final = space.where(OrdinaryView(model).is_end)
    stuck = [int(i) for i in space.dead if final is None or not final[i]]
    shown = tuple(space.path(stuck[0])) if stuck else ()
    svg = graph_svg(space, witness=shown, final=final)
    partial = "" if space.complete else f" (partial: {space.reason})"
    return CommandResult(
        OK,
        f"{len(space)} markings, {space.edges} edges{partial}",
        {"svg": svg, "witness": list(shown)},
    )


def gspn_of(
    path: Path, *, measure: Measure | None, cell_of: CellOf | None
) -> tuple[StochasticView | NetFile, str]:
    """Return the stochastic view of a task, or a net file with rates, and which cell is assumed
    (empty for a net file).

    Raises NetFileError, NoEstimate and the errors of `load`.
    """
    model = open_model(path)
    cell = _cell(model, cell_of)
    known = _measured(model, measure, cell)
    if isinstance(model, Task):
        return stochastic_view(model, known, devices=devices_of(cell)), assumed(cell)
    if model.gspn is None:
        raise NetFileError(str(path), "rates", "the file has none", "give a file with rates")
    return model, ""
