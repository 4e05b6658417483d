"""The forecast of one regime: figures straight from the training trials where they tell, else from
the simulated net; and the product rule for comparison."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.analysis.time.whatif import Change, statuses_of
from petrobot.coordinator.studies.forecast.choices import choice_counts, choices_of
from petrobot.coordinator.studies.forecast.direct import (
    LEAST,
    SCORES,
    confidence_interval,
    design_effect,
    effective,
    mean_figure,
    missions,
    predictive_interval,
    quantile_figure,
    share_weight,
    time_figure,
    trial_weights,
)
from petrobot.coordinator.studies.forecast.distributions import (
    Drawer,
    RunDistributions,
    dependences,
    siblings,
)
from petrobot.coordinator.studies.forecast.history import CENSORED, Codes, Runs, Training, Values
from petrobot.coordinator.studies.forecast.net_arrays import SUCCESS, Structure
from petrobot.coordinator.studies.forecast.play import Choices, Play, Played
from petrobot.coordinator.studies.forecast.residual import (
    NEGLIGIBLE,
    branch_doubts,
    chosen_so,
    condition_doubts,
    doubts,
    durations,
    entered,
    event_doubts,
    limit_doubts,
    measured,
    order_doubts,
    parallel_doubts,
    rare_doubts,
    residuals,
    routing,
)
from petrobot.coordinator.studies.forecast.whatif import changed

POINT = 40_000
"""Trials simulated for the expected figures of the simulated net. The simulation error of a share
is then below 0.25 points (standard error sqrt(0.25 / 40000))."""
REPLICATES = 200
TOGETHER = 25_000
"""Trials simulated side by side."""
SHARES = ("R_goal", "P_complete", "R_conj")
TIMES = ("mean", "q90")
GRID = tuple(float(q) for q in np.linspace(0.005, 0.995, 100))
"""Probabilities at which the distribution of the time is stored."""
TRIALS, NET = "trials", "net"
"""Where the figures come from: the training trials themselves, or the simulated net."""
NO_TRIALS = (
    "an estimates file contains no trials: successive runs of one trial are taken as independent, "
    "and nothing tests that; give a campaign's folder"
)
CHANGED = (
    "what if: the figures come from the simulated net, and no trial tests the changes: {}; runs "
    "depend on each other as in the training"
)
OTHER_FORM = (
    "the campaign ran another form of this task: the figures come from the simulated net, and no "
    "trial tests them; run a campaign of this form to test them"
)
NO_FIGURE: dict[str, Any] = {"value": None, "interval": None, "confidence": None}


class Request(Struct, frozen=True):
    """What a forecast is asked for."""

    runs: int
    """Number of trials that will be run."""
    choices: Choices
    seed: int = 1
    replicates: int = REPLICATES
    """Bootstrap samples of the simulated net."""
    point: int = POINT
    """Trials that the simulated net plays for the expected figures."""
    net: bool | None = None
    """True: the figures come from the simulated net in any case. False: from it only where the
    trials do not tell, and it is not compared with the training."""
    changes: Sequence[Change] = ()
    """Other durations and shares of statuses than the training has."""


def told_changes(request: Request) -> str:
    """Return the changes as they are written on the command line."""
    return ", ".join(change.text for change in request.changes)


def figures(played: Played, weights: Values | None = None) -> dict[str, float]:
    """Return the forecast figures of simulated or measured trials; times are nan if no trial
    completed."""
    w = np.ones(len(played.goals)) if weights is None else weights
    kept = played.completed & ~np.isnan(played.time) & (w > 0)
    times = played.time[kept]
    return {
        "R_goal": float(np.average(played.goals > 0, weights=w)),
        "P_complete": float(np.average(played.completed, weights=w)),
        "R_conj": float(np.average(played.all_success, weights=w)),
        "mean": float(np.average(times, weights=w[kept])) if len(times) else float("nan"),
        "q90": float(np.quantile(times, 0.9)) if len(times) else float("nan"),
    }


def predict(training: Training, request: Request) -> dict[str, Any]:
    """Forecast further trials of a regime. Raises ValueError for a choice of which nothing was
    measured, and for a net that must be simulated but cannot be."""
    counts, own = choice_counts(training), choices_of(training)
    asked = sorted(
        name for name, chosen in request.choices.items() if dict(chosen) != own.get(name)
    )
    _refuse_unmeasured(training, request.choices, asked)
    weights = trial_weights(training, request.choices)
    repeats = training.repeats and not request.changes
    straight = repeats and (not asked or effective(weights) >= LEAST) and not request.net
    random = np.random.default_rng(request.seed)
    found = (
        _from_trials(training, request, weights, random)
        if straight
        else _from_net(training, request, random, asked)
    )
    if not training.task.flat.goal_transitions:
        del found["figures"]["R_goal"]
    return {
        "training_trials": len(training.trials),
        "training_runs": _runs(training),
        "whole": training.whole,
        "same": training.same,
        "runs": request.runs,
        **found,
        "product": product_rule(training, request),
        "dependence": dependences(training),
        **(_by_place(training, request.choices) if repeats else {"routing": {}}),
        "choice_runs": {name: sum(actions.values()) for name, actions in counts.items()},
        "asked": asked,
        "not_back": (away := sum(t.completed and t.time is None for t in training.trials)),
        "notes": [*_never_back(away, len(training.trials)), *_never_entered(training, straight)],
    }


def _by_place(training: Training, choices: Choices) -> dict[str, Any]:
    """Return how tokens left each place, in how many trials they came there, and how long the runs
    of each action took. An estimates file tells none of them, nor do trials of another form of the
    task, or before a change of durations and shares."""
    laws = [
        {
            "place": place,
            "action": action,
            **_law(times, even := np.ones(len(times)), design_effect(times, even, mission)),
        }
        for (place, action), (times, mission) in durations(training, choices).items()
    ]
    return {
        "routing": routing(training, choices),
        "entered": entered(training, choices),
        "chosen_trials": len(chosen_so(training, choices)),
        "durations": laws,
    }


def _refuse_unmeasured(training: Training, choices: Choices, asked: list[str]) -> None:
    """Raise ValueError for choices without runs in the training."""
    names, runs = training.vocabulary, training.runs
    known = set(zip(runs.place.tolist(), runs.action.tolist(), strict=True))
    entered = {place for place, _ in known}
    for primitive in asked:
        own = [
            q
            for q, place in enumerate(names.places)
            if training.task.primitive_task_of(place).name == primitive
        ]
        if not any(q in entered for q in own):
            raise ValueError(
                f"{primitive}: no training run entered {', '.join(names.places[q] for q in own)}, "
                "so nothing can be said about other choices there; leave it out of the choices, "
                "or train with trials that get there"
            )
        for q in own:
            for action, probability in choices[primitive].items():
                code = names.actions.index(action) + 1
                if probability > 0 and q in entered and (q, code) not in known:
                    raise ValueError(
                        f"{primitive}: {action} was never run in {names.places[q]}, so nothing is "
                        "known of it; train with --selector random"
                    )


def _never_back(away: int, trials: int) -> list[str]:
    """Note how many of the trials have no time."""
    text = "some token was not back when the run ended, so the mean and the quantile lack them"
    return [f"{away} of {trials} training trials have no time: {text}"] if away else []


def _never_entered(training: Training, straight: bool) -> list[str]:
    """Note the action places that no training run entered, with what that is worth, or with whose
    runs the simulated net plays them."""
    entered, task = set(training.runs.place.tolist()), training.task
    most = 1.0 - 0.05 ** (1.0 / len(training.trials))  # rule of three, exactly: (1 - p)^n = 5 %
    out = []
    for q, place in enumerate(training.vocabulary.places):
        if q in entered:
            continue
        longest, like = task.primitive_task_of(place).deadline, siblings(training, place)
        if straight:
            text = (
                f"forecast with probability 0 (below {most:.2g} per trial, 95 %; runs of its "
                f"deadline, {longest:g} s, would add up to {most * longest:.2g} s to the mean time)"
            )
        elif like:
            text = f"its runs are taken to be like those of {' and '.join(like)}"
        else:
            text = "forecast with probability 0"
        out.append(f"no training run entered {place}: {text}")
    return out


# --- figures straight from the trials ---


def _from_trials(
    training: Training, request: Request, weights: Values, random: np.random.Generator
) -> dict[str, Any]:
    real, mission = measured(training), missions(training)
    point, worth = figures(real, weights), effective(weights)
    kept = real.completed & ~np.isnan(real.time) & (weights > 0)
    times, own = real.time[kept], weights[kept]
    runs = max(1, round(request.runs * point["P_complete"]))
    found: dict[str, Any] = {}
    for name, happened in (
        ("R_goal", real.goals > 0),
        ("P_complete", real.completed),
        ("R_conj", real.all_success),
    ):
        likeness = design_effect(happened.astype(np.float64), weights, mission)
        found[name] = _share(point[name], worth, request.runs, likeness)
    likeness = 1.0
    if len(times) > 1:
        likeness = design_effect(times, own, mission[kept])
        late = design_effect((times > point["q90"]).astype(np.float64), own, mission[kept])
        found["mean"] = mean_figure(times, own, runs, random, likeness)
        found["q90"] = quantile_figure(times, own, runs, 0.9, late)
        likeness = max(likeness, late)
    told = {name: found.get(name, NO_FIGURE) for name in (*SHARES, *TIMES)}
    return {
        "from": TRIALS,
        "figures": told,
        "law": _law(times, own, likeness),
        "doubts": [*order_doubts(training), *rare_doubts(training, weights, told)],
        **_beside(training, request),
    }


def _share(value: float, weight: float, runs: int, likeness: float = 1.0) -> dict[str, Any]:
    worth = weight / likeness
    return {
        "value": round(value, 6),
        "interval": predictive_interval(value, worth, max(1, round(runs / likeness))),
        "confidence": confidence_interval(value, worth),
        "weight": round(worth, 3),
        "likeness": round(likeness, 3),
    }


def _law(times: Values, weights: Values, likeness: float = 1.0) -> dict[str, Any]:
    """Return the distribution of the time as quantiles, and how many trials it is worth."""
    if not len(times):
        return {"q": list(GRID), "s": [], "trials": 0.0}
    order = np.argsort(times)
    reached = np.cumsum(weights[order]) / weights.sum()
    at = np.searchsorted(reached, np.array(GRID) - 1e-12)
    s = (
        np.quantile(times, GRID)
        if (weights == weights[0]).all()
        else times[order][np.minimum(at, len(times) - 1)]
    )
    return {
        "q": list(GRID),
        "s": [round(float(v), 6) for v in s],
        "trials": round(effective(weights) / likeness, 3),
        "likeness": round(likeness, 3),
    }


def _beside(training: Training, request: Request) -> dict[str, Any]:
    """Return how well the simulated net repeats the training: it decides nothing here."""
    if request.net is False:
        return _net_told([], None, 0.0, [])
    try:
        net = _SimulatedNet(training)
        played = net.replayed(request.seed)
    except ValueError as fault:
        return _net_told([], None, 0.0, [f"the net was not simulated: {fault}"])
    return _net_told(residuals(training, played), net.runs, played.endless / len(played.goals), [])


def _net_told(
    residual: list[dict[str, Any]],
    measured_runs: RunDistributions | None,
    endless: float,
    assumptions: list[str],
) -> dict[str, Any]:
    return {
        "residual": residual,
        "contexts": measured_runs.count if measured_runs is not None else 0,
        "splits": measured_runs.splits() if measured_runs is not None else [],
        "endless": round(endless, 6),
        "assumptions": assumptions,
    }


# --- figures of the simulated net ---


def _from_net(
    training: Training, request: Request, random: np.random.Generator, asked: Sequence[str]
) -> dict[str, Any]:
    net = _SimulatedNet(training)
    tested = training if training.repeats else training.earlier
    residual, runs = [], training.runs
    if tested is not None:
        known = net if tested is training else _SimulatedNet(tested)
        residual = residuals(tested, known.replayed(request.seed))
    if request.changes or asked:
        runs = changed(training, training.runs, request.changes)
        net = _SimulatedNet(replace(training, runs=runs, changes=request.changes), asked)
    whole = net.once(request.choices, request.point, random)
    samples = net.bootstrap(request, random)
    point, n = figures(whole), _worth(training, whole, request.point)
    times = whole.time[whole.completed]
    law = _law(times, np.ones(len(times)))
    told = {
        **{name: _net_share(point[name], samples[name], request.runs, n) for name in SHARES},
        **{name: _net_time(point[name], samples[name], request.runs, n) for name in TIMES},
    }
    return {
        "from": NET,
        "training_trials": n,
        "figures": told,
        "law": {**law, "trials": float(n)},
        "doubts": [
            *doubts(residual, whole, request.point),
            *_what_if_doubts(training, runs),
            *event_doubts(training),
            *condition_doubts(training, net.structure.moves),
            *branch_doubts(
                training, net.structure.moves, {*asked, *_reshared(training, request.changes)}
            ),
            *parallel_doubts(training),
            *limit_doubts(training),
            *order_doubts(training),
            *rare_doubts(training, np.ones(len(training.trials)), told),
        ],
        **_net_told(
            residual,
            net.runs,
            whole.endless / request.point,
            [
                *net.structure.assumptions,
                *([] if training.whole else [NO_TRIALS]),
                *([] if training.same else [OTHER_FORM]),
                *([CHANGED.format(told_changes(request))] if request.changes else []),
            ],
        ),
    }


def _runs(training: Training) -> int:
    """Return the number of measured runs. Of an estimates file a training has each run once for
    every place of its primitive task."""
    if training.whole:
        return len(training.runs)
    by_place, runs = Counter(training.runs.place.tolist()), Counter[str]()
    for q, place in enumerate(training.vocabulary.places):
        name = training.task.flat.places[place].task
        runs[name] = max(runs[name], by_place[q])
    return runs.total()


def _worth(training: Training, played: Played, count: int) -> int:
    """Return of how many trials the training is. An estimates file does not say it: as many as have
    its runs, by `count` played trials."""
    each = sum(sum(ways.values()) for ways in played.ways.values()) / count
    if training.whole or not each:
        return len(training.trials)
    return max(2, round(_runs(training) / each))


def _net_share(value: float, samples: Values, runs: int, training: int) -> dict[str, Any]:
    sd = float(samples.std(ddof=1)) if len(samples) > 1 else 0.0
    return _share(value, share_weight(value, sd, runs, training), runs)


def _net_time(value: float, samples: Values, runs: int, training: int) -> dict[str, Any]:
    known = samples[~np.isnan(samples)]
    if not len(known) or np.isnan(value):
        return NO_FIGURE
    sd = float(known.std(ddof=1)) if len(known) > 1 else 0.0
    # variance of a figure of new trials ~ 1 / training + 1 / new trials
    alone = sd / np.sqrt(1.0 + training / runs)
    both = np.array([SCORES[3], -SCORES[3]])
    return time_figure(value, value + sd * SCORES, value + alone * both)


def _reshared(training: Training, changes: Sequence[Change]) -> set[str]:
    """Return the primitive tasks whose runs end otherwise."""
    shares = [change for change in changes if change.subject[-1] == "share"]
    return {statuses_of(training.task, change)[0].name for change in shares}


def _what_if_doubts(training: Training, runs: Runs) -> Iterator[str]:
    """Yield in words where changed runs end by themselves later than any measured run did."""
    was, names = training.runs, training.vocabulary
    freed = was.preempted & ~was.censored & ~runs.preempted
    for q in np.unique(was.place[freed]).tolist():
        own = (was.place == q) & ~was.preempted
        beyond = freed & (was.place == q) & (was.took >= was.took[own].max(initial=0.0))
        share = len(np.unique(was.trial[beyond])) / max(1, len(np.unique(was.trial)))
        if share > NEGLIGIBLE:
            yield (
                f"in {share:.1%} of the trials a run in {names.places[q]} was preempted later than "
                "any ended by itself, so how long it would take now is a guess"
            )


class _SimulatedNet:
    """The task's net with the measured runs of one training."""

    def __init__(self, training: Training, asked: Sequence[str] = ()) -> None:
        """`asked`: the primitive tasks whose actions are chosen otherwise than in the training.
        Raises ValueError for a net that cannot be simulated."""
        chosen = [
            q
            for q, place in enumerate(training.vocabulary.places)
            if training.task.primitive_task_of(place).name in asked
        ]
        self.structure = Structure.of(training.task, training.whole)
        self.runs = RunDistributions(training, chosen=chosen)
        self._training = training
        # Steps after which a simulated trial counts as endless (the forecast says how many did).
        # A heuristic: of n trials with geometric numbers of steps, one more is five times as long
        # as the longest with a probability of about 5! / n^5, which is 1e-6 for n = 40.
        longest = max(len(trial.runs) + len(trial.waits) for trial in training.trials)
        self._longest = 100 + 5 * longest

    def played(
        self, choices: Choices, weights: Values, replicate: Codes, random: np.random.Generator
    ) -> Played:
        """Play one trial for each entry of `replicate`, a row of `weights`. Raises ValueError for
        what was never measured."""
        drawer = Drawer(self.runs, self._training.waits, weights, random)
        cell = (self._training.devices, self._training.periods)
        try:
            return Play(self.structure, drawer, choices, replicate, self._longest, *cell).run()
        except KeyError as fault:
            place, action = fault.args[0]
            names = self._training.vocabulary
            raise ValueError(
                f"{names.places[place]}: no run of {names.actions[action - 1]} was measured; train "
                "with more trials"
            ) from fault

    def once(self, choices: Choices, count: int, random: np.random.Generator) -> Played:
        """Play `count` trials, all training trials counting alike."""
        even = np.ones((1, len(self._training.trials)))
        return self.played(choices, even, np.zeros(count, np.int64), random)

    def replayed(self, seed: int) -> Played:
        """Play four times as many trials as were run, with the choices of the training."""
        random = np.random.default_rng([seed, 1])
        return self.once(choices_of(self._training), 4 * len(self._training.trials), random)

    def bootstrap(self, request: Request, random: np.random.Generator) -> dict[str, Values]:
        """Return the figures of `runs` new trials for resampled training trials.

        Trials are resampled as a whole (cluster bootstrap), because the runs of one trial depend on
        each other.
        """
        n = len(self._training.trials)
        at_once = max(1, TOGETHER // request.runs)
        found: dict[str, list[float]] = {name: [] for name in (*SHARES, *TIMES)}
        for begin in range(0, request.replicates, at_once):
            count = min(at_once, request.replicates - begin)
            weights = random.multinomial(n, np.full(n, 1.0 / n), size=count).astype(np.float64)
            replicate = np.repeat(np.arange(count), request.runs)
            played = self.played(request.choices, weights, replicate, random)
            for b in range(count):
                own = replicate == b
                one = Played(
                    played.goals[own],
                    played.completed[own],
                    played.all_success[own],
                    played.time[own],
                )
                for name, value in figures(one).items():
                    found[name].append(value)
        return {name: np.array(values) for name, values in found.items()}


def product_rule(training: Training, request: Request) -> dict[str, Any]:
    """Return the product of reliabilities over the places of the normal flow: R_conj of a series,
    if all were independent."""
    names, choices = training.vocabulary, request.choices
    runs = changed(training, training.runs, request.changes)
    status, _ = names.parts(runs.outcome)
    normal = [q for q, p in enumerate(names.places) if p not in training.task.flat.error_elements]
    value, factors = 1.0, {}
    for q in normal:
        chosen = choices.get(training.task.primitive_task_of(names.places[q]).name, {})
        r = whole = 0.0
        for action, probability in chosen.items():
            own = (
                (runs.place == q)
                & (runs.action == names.actions.index(action) + 1)
                & (status != CENSORED)  # a preempted one counts as its arc says
            )
            if own.any():
                r, whole = (
                    r
                    + probability
                    * float(np.average(status[own] == SUCCESS, weights=runs.weight[own])),
                    whole + probability,
                )
        if whole:
            factors[names.places[q]] = round(r / whole, 6)
            value *= r / whole
    return {"R_conj": round(value, 6), "factors": factors}
