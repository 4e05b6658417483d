"""Compare a measurement with a forecast that was registered before: predictive tests, equivalence
tests, and the distribution of the time.

Shares: beta-binomial predictive limits; a share of 1 that was forecast from n trials still allows a
miss in another n. Times: a normal distribution with the predictive deviation of the bootstrap. The
significance levels of many comparisons are adjusted by the method of S. Holm, Scandinavian Journal
of Statistics 6 (1979) 65-70. Equivalence: two one-sided tests at 5 % each, that is, the 90 %
interval of the measurement lies within the margin around the forecast (D. J. Schuirmann, J.
Pharmacokinetics and Biopharmaceutics 15 (1987) 657-680).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.stats import binom, chi2_contingency, kstwobign, norm, t

from petrobot.coordinator.learning.statistics import wilson
from petrobot.coordinator.studies.forecast.direct import (
    SCORES,
    holm,
    predictive_interval,
    share_p_value,
    share_weight,
)
from petrobot.coordinator.studies.forecast.history import Training, Values
from petrobot.coordinator.studies.forecast.predict import SHARES, figures
from petrobot.coordinator.studies.forecast.residual import (
    all_on_one_side,
    durations,
    entered,
    measured,
    routing,
    ways_table,
)

FAMILY = ("R_goal", "P_complete", "R_conj", "mean", "q90")
"""Figures that are compared. They are tested together with the distributions of the time and the
routing of all regimes, by Holm's method."""
EQUIVALENT = ("R_goal", "P_complete", "mean", "q90")
"""Figures whose equivalence makes a comparison equivalent."""
LEVEL = 0.01
MARGIN_SHARE = 0.02
MARGIN_TIME = 0.05
EQUIVALENCE = 0.90


def agreement(forecast: Mapping[str, Any], regimes: Mapping[str, Training]) -> dict[str, Any]:
    """Compare the forecast of each regime with what was measured. Raises ValueError if they have no
    regime in common."""
    common = [name for name in forecast["regimes"] if name in regimes]
    if not common:
        raise ValueError(
            f"no regime in common: the campaign ran {', '.join(regimes)}, the forecast is of "
            f"{', '.join(forecast['regimes'])}"
        )
    rows: list[dict[str, Any]] = []
    controls, laws, ways, took = [], [], [], []
    for name in common:
        said, training = forecast["regimes"][name], regimes[name]
        family = [f for f in FAMILY if f != "R_goal" or training.task.flat.goal_transitions]
        rows += [_row(name, figure, said, training) for figure in family]
        controls.append(_product(name, said, training))
        laws.append(_law(name, said, training))
        ways += _routing(name, said, training)
        took += _durations(name, said, training)
    tested = [row for row in (*rows, *laws, *ways, *took) if row["p"] is not None]
    for row, p in zip(tested, holm([row["p"] for row in tested]), strict=True):
        row["p_holm"] = p
        row["agrees"] = p >= LEVEL
    return {
        "rows": rows,
        "negative_control": controls,
        "law": laws,
        "routing": ways,
        "durations": took,
        "agrees": all(row["agrees"] for row in tested),
        "equivalent": all(row["equivalent"] for row in rows if row["figure"] in EQUIVALENT),
        "product_rejected": [row["regime"] for row in controls if row["rejected"]],
    }


def _row(regime: str, figure: str, said: Mapping[str, Any], training: Training) -> dict[str, Any]:
    played = measured(training)
    value, found = figures(played)[figure], said["figures"][figure]
    times = played.time[~np.isnan(played.time)]
    n = len(training.trials)
    row: dict[str, Any] = {
        "regime": regime,
        "figure": figure,
        "forecast": found["value"],
        "interval": found["interval"],
        "measured": None if math.isnan(value) else round(value, 6),
        "runs": n,
        "p": None,
        "p_holm": None,
        "agrees": None,
        "margin": None,
        "measured_90": None,
        "equivalent": False,
    }
    if found["value"] is None or row["measured"] is None:
        return row
    if figure in SHARES:
        weight = (
            found["weight"]
            if "weight" in found
            else share_weight(found["value"], found["sd"], said["runs"], said["training_trials"])
        )
        # trials of one mission run that are alike count as fewer, in the new runs, too
        size = max(1, round(n / found.get("likeness", 1.0)))
        row["interval"] = predictive_interval(found["value"], weight, size)
        row["p"] = share_p_value(found["value"], weight, round(value * size), size)
        low, high = wilson(round(value * n), n, EQUIVALENCE)
        row["margin"] = MARGIN_SHARE
    else:
        row["p"] = time_p_value(
            found["value"], _curve(found), value, said["runs"], len(times), said["training_trials"]
        )
        low, high = mean_interval(times) if figure == "mean" else quantile_interval(times, 0.9)
        row["margin"] = round(MARGIN_TIME * found["value"], 6)
    row["measured_90"] = [round(low, 6), round(high, 6)]
    row["equivalent"] = (
        abs(low - found["value"]) <= row["margin"] and abs(high - found["value"]) <= row["margin"]
    )
    return row


def _curve(found: Mapping[str, Any]) -> Values:
    """Return the predictive distribution of a time at SCORES; files of older versions contain only
    its standard deviation."""
    if "curve" in found:
        return np.array(found["curve"])
    return np.asarray(found["value"] + found["sd"] * SCORES)


def time_p_value(
    value: float, curve: Values, seen: float, runs: int, n: int, training: int
) -> float:
    """Return the two-sided p-value of a time of n new trials, given the predictive distribution for
    `runs` of them. Both the sampling error and the training error shrink as n^-1/2."""
    # The distribution belongs to `runs` new trials; rescale to n: variance ~ 1 / new + 1 / training
    scale = math.sqrt((1.0 / n + 1.0 / training) / (1.0 / runs + 1.0 / training))
    at = value + (seen - value) / scale
    slack = 1e-6 * max(1.0, abs(value))  # figures are rounded to microseconds
    if curve[0] - slack <= at <= curve[-1] + slack:
        # where the distribution is flat (an atom), the score that is nearest to 0
        low, high = _score(curve, at - slack), _score(curve, at + slack)
        z = 0.0 if low <= 0.0 <= high else min(abs(low), abs(high))
    else:
        end, middle = (0 if at < value else -1), len(curve) // 2
        slope = abs(curve[end] - curve[middle]) / SCORES[-1]
        z = abs(at - curve[middle]) / slope if slope > 0 else math.inf
    return float(2.0 * norm.sf(z))


def _score(curve: Values, at: float) -> float:
    return float(np.interp(at, curve, SCORES))


def mean_interval(times: Values, level: float = EQUIVALENCE) -> tuple[float, float]:
    """Return Student's interval of the mean."""
    half = (
        float(t.ppf((1 + level) / 2, len(times) - 1) * times.std(ddof=1) / math.sqrt(len(times)))
        if len(times) > 1
        else math.inf
    )
    middle = float(times.mean())
    return middle - half, middle + half


def quantile_interval(times: Values, q: float) -> tuple[float, float]:
    """Return an interval of a quantile between two order statistics, whose ranks are binomial."""
    ordered, n = np.sort(times), len(times)
    low = int(binom.ppf((1 - EQUIVALENCE) / 2, n, q))
    high = int(binom.ppf((1 + EQUIVALENCE) / 2, n, q)) + 1
    return (float(ordered[low - 1]) if low >= 1 else -math.inf), (
        float(ordered[high - 1]) if high <= n else math.inf
    )


def _product(regime: str, said: Mapping[str, Any], training: Training) -> dict[str, Any]:
    """Test the negative control: the product of marginal reliabilities as a forecast of R_conj."""
    value, n = said["product"]["R_conj"], len(training.trials)
    seen = figures(measured(training))["R_conj"]
    p = share_p_value(value, float(said["training_trials"]), round(seen * n), n)
    return {
        "regime": regime,
        "forecast": value,
        "measured": round(seen, 6),
        "p": p,
        "rejected": p < LEVEL,
    }


def _law(regime: str, said: Mapping[str, Any], training: Training) -> dict[str, Any]:
    """Compare the measured and the forecast distribution of the time."""
    time = measured(training).time
    law = {"trials": said["training_trials"], **said["law"]}
    return {"regime": regime, **_distance(law, time[~np.isnan(time)])}


def _distance(law: Mapping[str, Any], measured_times: Values) -> dict[str, Any]:
    """Compare times with a distribution by Kolmogorov's two-sample test, in its asymptotic form;
    ties make it conservative."""
    row: dict[str, Any] = dict.fromkeys(("distance", "limit", "p", "p_holm", "agrees"))
    times = np.sort(measured_times)
    if not len(times) or not law["s"]:
        return row
    grid, q = np.array(law["s"]), np.array(law["q"])
    at = np.searchsorted(times, grid, side="right") / len(times)
    below = np.searchsorted(times, grid, side="left") / len(times)
    distance = float(np.max(np.maximum(q - at, 0.0) + np.maximum(below - q, 0.0)))
    known, new = law["trials"], len(times) / law.get("likeness", 1.0)
    size = math.sqrt(known * new / (known + new))
    return row | {
        "distance": round(distance, 4),
        "limit": round(float(kstwobign.isf(LEVEL)) / size, 4),
        "p": float(kstwobign.sf(distance * size)),
    }


def _durations(regime: str, said: Mapping[str, Any], training: Training) -> list[dict[str, Any]]:
    """Compare how long the runs of each action take in each place: the total may hide it."""
    new = durations(training)
    return [
        {
            "regime": regime,
            **{key: law[key] for key in ("place", "action")},
            **_distance(law, new.get((law["place"], law["action"]), (np.zeros(0),))[0]),
        }
        for law in said.get("durations", ())  # older files have none
    ]


def _routing(regime: str, said: Mapping[str, Any], training: Training) -> list[dict[str, Any]]:
    """Test for each place, by chi-square, whether tokens left it by the same transitions equally
    often in training and new trials; and if only one of them entered it, whether that is chance."""
    before, after = said["routing"], routing(training)
    seen = said.get("entered", {}), entered(training)  # older files do not contain it
    trials = said.get("chosen_trials", 0), len(training.trials)
    rows = []
    for place in sorted({*before, *after}):
        table = ways_table(before.get(place, {}), after.get(place, {}))
        if table.sum(axis=1).all():
            p = float(chi2_contingency(table).pvalue) if table.shape[1] > 1 else None
        elif trials[0]:
            side = int(place in after)
            p = all_on_one_side(seen[side][place], trials[side], trials[1 - side])
        else:
            p = None
        if p is not None:
            row = {"regime": regime, "place": place, "p": p, "p_holm": None, "agrees": None}
            rows.append(row)
    return rows
