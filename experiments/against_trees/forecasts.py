"""Part (b): forecasts of twenty structural changes from 300 trials, against what then happens.

The training chooses every alternative at random. The forecasts are the share of balls caught, and
the mean and 90 % quantile of a trial's time, each with a 95 % interval for the new trials if the
method has one.

- petrobot: `petrobot forecast`, with `--choose` for other choices, the changed task file for other
  nets, and `--what-if` for slower and more faulty actions.
- product: computed by hand. Steps succeed and last independently of each other: the
  product of their shares, the sum of their means, a normal quantile; intervals by a bootstrap.
- bootstrap: the training trials that made the new choices, resampled; other changes are not seen.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from experiments.against_trees.faults import Edit, Edits, apply
from experiments.against_trees.results import PLANT, TASK, Line, Results, Size
from experiments.against_trees.verified import petrobot
from petrobot.coordinator.studies.campaign.block import LoadedPlan, run_block
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest
from petrobot.coordinator.studies.campaign.table import TABLE, read_table
from petrobot.coordinator.studies.campaign.trials import Trial
from petrobot.coordinator.studies.forecast.registered import read

REGIME = "A"
"""The plant knows no regimes; the task has one."""
TRAINING_SEED, NEW_SEED = 302, 402
BLOCK = 20
RESAMPLED = 400
NORMAL_90 = 1.2816
FIGURES = ("R_goal", "mean", "q90")
FORECAST = "forecast.json"
METHODS = ("petrobot", "product", "bootstrap")
ALTERNATIVES = {
    "locate_ball": ("locate_background", "locate_mog2", "locate_hough", "locate_threshold",
                    "locate_compensated"),
    "track_ball": ("predict_least_squares", "predict_kalman", "predict_constant_velocity"),
    "move_to_point": ("intercept_tilted", "intercept_upright"),
}  # fmt: skip
TASK_ACTIONS = {
    **ALTERNATIVES, "catch_ball": ("follow_and_wait",), "return_home": ("empty_and_home",),
    "recover_arm": ("reset_and_home",),
}  # fmt: skip
CAMERA = (*ALTERNATIVES["locate_ball"], *ALTERNATIVES["track_ball"])
ARM = (*ALTERNATIVES["move_to_point"], "follow_and_wait", "empty_and_home", "reset_and_home")

Samples = NDArray[np.float64]


class StructuralChange(Struct, frozen=True):
    """One change. `choices` by primitive task; `slow` and `faults` by action; `net` edits the task
    file."""

    name: str
    choices: Mapping[str, str] = field(default_factory=dict)
    slow: Mapping[str, float] = field(default_factory=dict)
    faults: Mapping[str, float] = field(default_factory=dict)
    net: Edits = ()
    looks: int = 1
    """How often the arm looks for a ball before it counts as not thrown."""

    @property
    def what_if(self) -> list[str]:
        """The change of actions as options of `petrobot forecast`."""
        of = {action: name for name, actions in TASK_ACTIONS.items() for action in actions}
        slower = [f"{of[action]}.{action}.mean*={by:g}" for action, by in self.slow.items()]
        faulty = [
            f"{of[action]}.{action}.error.share*={by:g}" for action, by in self.faults.items()
        ]
        return [part for change in (*slower, *faulty) for part in ("--what-if", change)]


def _choice(name: str, **choices: str) -> StructuralChange:
    return StructuralChange(name, choices)


_LOOK_AGAIN: Edits = (
    Edit('out = ["arm_free", "camera_free"]', 'out = ["look_again"]', "transitions.not_located"),
    Edit("[places.track_ball]", """[places.look_again]
kind = "action"
task = "locate_ball"
out = { ball = "ball" }

[transitions.located_late]
in = ["look_again:normal"]
out = ["track_ball", "move_to_point"]

[transitions.not_located_again]
in = ["look_again:error"]
out = ["arm_free", "camera_free"]

[places.track_ball]"""),
)  # fmt: skip

CHANGES: tuple[StructuralChange, ...] = (
    _choice("locate by mog2", locate_ball="locate_mog2"),
    _choice("locate by hough", locate_ball="locate_hough"),
    _choice("locate by threshold", locate_ball="locate_threshold"),
    _choice("locate compensated", locate_ball="locate_compensated"),
    _choice("predict by Kalman", track_ball="predict_kalman"),
    _choice("predict by constant velocity", track_ball="predict_constant_velocity"),
    _choice("intercept upright", move_to_point="intercept_upright"),
    _choice(
        "threshold, constant velocity, upright", locate_ball="locate_threshold",
        track_ball="predict_constant_velocity", move_to_point="intercept_upright",
    ),
    _choice(
        "mog2, Kalman, tilted", locate_ball="locate_mog2", track_ball="predict_kalman",
        move_to_point="intercept_tilted",
    ),
    StructuralChange("arm 1.5 times slower", slow=dict.fromkeys(ARM, 1.5)),
    StructuralChange("arm 2 times slower", slow=dict.fromkeys(ARM, 2.0)),
    StructuralChange("arm 2 times faster", slow=dict.fromkeys(ARM, 0.5)),
    StructuralChange("camera 1.5 times slower", slow=dict.fromkeys(CAMERA, 1.5)),
    StructuralChange("faults of locating x 10",
                     faults=dict.fromkeys(ALTERNATIVES["locate_ball"], 10.0)),
    StructuralChange("faults of moving x 10",
                     faults=dict.fromkeys(ALTERNATIVES["move_to_point"], 10.0)),
    StructuralChange("faults of catching x 10", faults={"follow_and_wait": 10.0}),
    StructuralChange("faults of going home x 10", faults={"empty_and_home": 10.0}),
    StructuralChange("look a second time", net=_LOOK_AGAIN, looks=2),
    StructuralChange("no second attempt to recover", net=(
        Edit("tokens = 3\ncapacity = 3", "tokens = 0\ncapacity = 3", "places.attempts"),
    )),
    StructuralChange("reset the arm after each miss", net=(
        Edit('out = ["return_home"]', 'out = ["recover_arm"]', "transitions.missed"),
    )),
)  # fmt: skip


def world(change: StructuralChange, folder: Path) -> tuple[Path, Path]:
    """Write task and location file of the changed world. Return their paths."""
    task = apply(TASK.read_text(encoding="utf-8"), change.net)
    edits = []
    for action in {**change.slow, **change.faults}:
        slow, faults = change.slow.get(action, 1.0), change.faults.get(action, 1.0)
        old = f'action = "{action}" }}'
        new = f'action = "{action}", slow = {slow}, faults = {faults} }}'
        edits.append(Edit(old, new, f"actions.{action}"))
    services = apply(PLANT.read_text(encoding="utf-8"), tuple(edits))
    folder.mkdir(parents=True, exist_ok=True)
    paths = folder / "catch_ball.toml", folder / "plant.toml"
    for path, text in zip(paths, (task, services), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def trials_of(change: StructuralChange, folder: Path, runs: int) -> list[Trial]:
    """Run new trials in the changed world with petrobot: choices at random, but for those of the
    change."""
    task, services = world(change, folder)
    files = {"task": str(task), "services": str(services)}
    plan = CampaignPlan(
        files["task"], files["services"], runs, (REGIME,), NEW_SEED, "random", block=BLOCK,
        batch=0, digests={key: digest(Path(path)) for key, path in files.items()},
    )  # fmt: skip
    bench = LoadedPlan.of(plan)
    weights = {
        name: {action: 1.0 for action in offered if change.choices.get(name, action) == action}
        for name, offered in ALTERNATIVES.items()
    }
    found = []
    for block in plan.blocks:
        done = run_block(bench, block, [weights] * block.count)
        found += [Trial.from_plain(plain) for plain in done["trials"]]
    return found


# --- petrobot's forecasts -------------------------------------------------------------------------


def by_petrobot(change: StructuralChange, train: Path, runs: int, out: Path) -> dict[str, Any]:
    """Register a forecast of a change from the folder of the training campaign: value and interval
    by figure."""
    task, _ = world(change, out)
    chosen = ",".join(f"{name}={action}" for name, action in change.choices.items())
    petrobot(
        "forecast", str(task), "--services", str(PLANT), "--estimates", str(train),
        "--runs", str(runs), "--doubtful", "--out", str(out / FORECAST),
        *change.what_if, *(("--choose", chosen) if chosen else ()),
    )  # fmt: skip
    made = read(out / FORECAST)
    said = made["regimes"][REGIME]
    figures = {name: said["figures"][name] for name in FIGURES}
    return {
        **{name: [one["value"], one["interval"]] for name, one in figures.items()},
        "from": said["from"], "doubts": said["doubts"], "sha256": made["sha256"],
    }  # fmt: skip


# --- by hand --------------------------------------------------------------------------------------


class Steps(Struct, frozen=True):
    """The steps of the training trials, one row per trial; nan where a step did not run."""

    goal: Samples
    time: Samples
    """Duration of each trial (s)."""
    seconds: Mapping[str, Samples]
    well: Mapping[str, Samples]
    """1 where a step succeeded: no error, and for catching, the ball in the cup."""
    chosen: Mapping[str, NDArray[Any]]


STEPS = ("locate_ball", "move_to_point", "catch_ball", "return_home")


def steps_of(trials: Sequence[Trial]) -> Steps:
    """Tabulate the first run of each step of each trial."""
    names = (*STEPS, "track_ball")
    first = [{run.place: run for run in reversed(trial.runs)} for trial in trials]

    def column(name: str, value: Any) -> Samples:
        return np.array([value(one[name]) if name in one else np.nan for one in first])

    def well(name: str) -> Samples:
        if name == "catch_ball":
            return column(name, lambda run: float(run.taken == "caught"))
        return column(name, lambda run: float(run.status != "error"))

    times = [np.nan if trial.time is None else trial.time for trial in trials]
    return Steps(
        np.array([float(trial.goals > 0) for trial in trials]),
        np.array(times, dtype=float),
        {name: column(name, lambda run: run.took) for name in names},
        {name: well(name) for name in names},
        {
            name: np.array([one[name].action if name in one else "" for one in first])
            for name in ALTERNATIVES
        },
    )


def chosen_rows(change: StructuralChange, steps: Steps) -> NDArray[np.bool_]:
    """Return which training trials made the choices of the change (a step that did not run agrees
    with every choice)."""
    kept = np.ones(len(steps.goal), dtype=bool)
    for name, action in change.choices.items():
        kept &= (steps.chosen[name] == action) | (steps.chosen[name] == "")
    return kept


def by_product(change: StructuralChange, steps: Steps, runs: int) -> dict[str, Any]:
    """Forecast by independent steps: each figure with an interval for so many new trials."""
    rng = np.random.default_rng(1)
    n = len(steps.goal)
    point = _product(change, steps, np.arange(n))
    drawn = []
    for _ in range(RESAMPLED):
        share, mean, q90, spread = _product(change, steps, rng.integers(0, n, n))
        noise = rng.normal(size=2) * spread / np.sqrt(runs)
        # the standard error of a normal sample's 90 % quantile is 1.71 times that of its mean
        drawn.append((rng.binomial(runs, share) / runs, mean + noise[0], q90 + 1.71 * noise[1]))
    return _with_intervals(point[:3], np.array(drawn))


def _product(
    change: StructuralChange, steps: Steps, rows: NDArray[Any]
) -> tuple[float, float, float, float]:
    share, mean, variance = 1.0, 0.0, 0.0
    for name in STEPS:
        wanted, kept = change.choices.get(name), rows
        if wanted is not None:
            kept = rows[steps.chosen[name][rows] == wanted]
        ran = kept[~np.isnan(steps.seconds[name][kept])]
        seconds, well = steps.seconds[name][ran], steps.well[name][ran]
        action = wanted or TASK_ACTIONS[name][0]
        slow, faults = change.slow.get(action, 1.0), change.faults.get(action, 1.0)
        right = float(well.mean()) if len(well) else 1.0
        if name != "catch_ball":  # a missed ball is not a fault
            right = max(0.0, 1.0 - (1.0 - right) * faults)
        looks = change.looks if name == "locate_ball" else 1
        lasts = float(seconds.mean()) * slow if len(seconds) else 0.0
        mean += share * lasts * (1.0 + (looks - 1) * (1.0 - right))
        variance += float(seconds.var()) * slow * slow if len(seconds) else 0.0
        if name != "return_home":
            share *= 1.0 - (1.0 - right) ** looks
    spread = float(np.sqrt(variance))
    return share, mean, mean + NORMAL_90 * spread, spread


def by_bootstrap(change: StructuralChange, steps: Steps, runs: int) -> dict[str, Any]:
    """Forecast by resampling the training trials that made the new choices."""
    rng = np.random.default_rng(2)
    rows = np.flatnonzero(chosen_rows(change, steps))
    point = figures(steps.goal[rows], steps.time[rows])
    drawn = []
    for _ in range(RESAMPLED):
        own = rng.choice(rows, len(rows))
        new = rng.choice(own, runs)
        drawn.append(figures(steps.goal[new], steps.time[new]))
    return _with_intervals(point, np.array(drawn))


def figures(goal: Samples, times: Samples) -> tuple[float, float, float]:
    """Return share of goals, mean and 90 % quantile of the time."""
    times = times[~np.isnan(times)]
    return float(goal.mean()), float(times.mean()), float(np.quantile(times, 0.9))


def _with_intervals(point: Sequence[float], drawn: Samples) -> dict[str, Any]:
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    return {name: [point[k], [float(low[k]), float(high[k])]] for k, name in enumerate(FIGURES)}


# --- the part -------------------------------------------------------------------------------------


def forecast_one(number: int, train: str, folder: str, runs: int) -> Line:
    """Forecast a change by all methods."""
    change = CHANGES[number]
    rows = [row.trial for row in read_table(Path(train) / TABLE)]
    steps = steps_of([trial for trial in rows if trial is not None])
    return {
        "change": number,
        "name": change.name,
        "at": time.time(),
        "runs": runs,
        "petrobot": by_petrobot(change, Path(train), runs, Path(folder)),
        "product": by_product(change, steps, runs),
        "bootstrap": by_bootstrap(change, steps, runs),
    }


def measure_one(number: int, folder: str, runs: int) -> Line:
    """Run the new trials of a change."""
    begun = time.time()
    steps = steps_of(trials_of(CHANGES[number], Path(folder), runs))
    kept = ~np.isnan(steps.time)
    found = figures(steps.goal, steps.time)
    return {
        "change": number, "name": CHANGES[number].name, "begun": begun, "runs": len(kept),
        "ended": int(kept.sum()), **dict(zip(FIGURES, found, strict=True)),
    }  # fmt: skip


def measure(results: Results, size: Size, workers: int) -> None:
    """Train, register every forecast, then measure."""
    train = results.folder / "train"
    if not (train / "result.json").exists():
        petrobot(
            "campaign", str(TASK), "--services", str(PLANT), "--runs", str(size.training),
            "--regime", REGIME, "--selector", "random", "--seed", str(TRAINING_SEED),
            "--block", str(BLOCK), "--workers", "1", "--out", str(train),
        )  # fmt: skip
    worlds = {f"{n:02}": results.folder / "worlds" / f"{n:02}" for n in range(len(CHANGES))}
    results.measure(
        "registered", forecast_one,
        [(key, (int(key), str(train), str(own), size.trials)) for key, own in worlds.items()],
        workers,
    )  # fmt: skip
    results.measure(
        "measured", measure_one,
        [(key, (int(key), str(own), size.trials)) for key, own in worlds.items()], workers,
    )  # fmt: skip
