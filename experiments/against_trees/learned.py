"""Part (c): task-level regret while disturbances switch, which no program is told.

Regret counts balls: the chance of the best fixed combination under the present disturbance, minus
the balls caught. The plant is scripted, so that chance is known (`chance`). petrobot's selectors
get task credit and, as everything here counts balls, rho = 0.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from py_trees.behaviour import Behaviour
from py_trees.blackboard import Blackboard
from py_trees.common import Status
from py_trees.composites import Selector, Sequence
from py_trees.decorators import Repeat, Timeout
from py_trees.trees import BehaviourTree

from experiments.against_trees.cell import Cell, Make
from experiments.against_trees.faults import Edit, apply
from experiments.against_trees.forecasts import ALTERNATIVES
from experiments.against_trees.missions import net_mission, program_mission
from experiments.against_trees.plant import ACTIONS
from experiments.against_trees.results import PLANT, TASK, Line, Results, Size, keyed
from experiments.against_trees.tree import Act, TreeProgram, create_root
from petrobot.coordinator.learning.learner import Contexts, LearningSelector
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.task.file import load as load_task
from petrobot.services.comm.location_file import Directory, load

DISTURBANCES: Mapping[str, Mapping[str, float]] = {
    "none": {},
    "dim light": {
        "locate_background": 25.0,
        "locate_mog2": 35.0,
        "locate_threshold": 10.0,
        "locate_compensated": 8.0,
    },
    "stiff joint": {"intercept_tilted": 15.0, "locate_mog2": 10.0},
}
"""By disturbance: the factor on the share of errors of the actions that suffer."""
BALLS = 5
"""Balls of a mission; learning continues from mission to mission."""
EACH = 100
"""Trials after which the disturbance switches."""
LEARNERS = ("tracking", "nikolic_fu_fast", "thompson")
TREES = ("fixed", "fallback", "epsilon")
POLICIES = (*(f"net {name}" for name in LEARNERS), *(f"tree {name}" for name in TREES))
EPSILON, STEP = 0.1, 0.1
HARD = (np.arange(200) + 0.5) / 200
"""Hardness of a ball, at which chances are averaged."""

Combination = tuple[str, str, str]


def chance(combination: Combination, faults: Mapping[str, float]) -> float:
    """Return the chance to catch a ball with these actions under a disturbance: the plant's own
    numbers."""

    def fine(action: str, hard: Any) -> Any:
        like = ACTIONS[action]
        share = like.error * faults.get(action, 1.0) * (0.5 + 1.5 * hard * hard)
        return (1.0 - like.hang) * (1.0 - np.minimum(share, 1.0))

    locate, track, move = combination
    good = ACTIONS[locate].good * ACTIONS[track].good * ACTIONS[move].good
    into_cup = np.minimum(good * (1.15 - 0.4 * HARD * HARD), 1.0)
    waited = 0.1 + 0.9 * fine("follow_and_wait", HARD)  # one ball in ten is caught before the wait
    return float(fine(locate, 0.0) * np.mean(fine(move, HARD) * into_cup * waited))


def best(faults: Mapping[str, float]) -> tuple[Combination, float]:
    """Return the best fixed combination under a disturbance, and its chance."""
    every = itertools.product(*ALTERNATIVES.values())
    chances = {(a, b, c): chance((a, b, c), faults) for a, b, c in every}
    first = max(chances, key=lambda one: chances[one])
    return first, chances[first]


def directory_of(disturbance: str) -> Directory:
    """Return the plant under a disturbance."""
    edits = tuple(
        Edit(f'"{action}" }}', f'"{action}", faults = {factor} }}', f"actions.{action}")
        for action, factor in DISTURBANCES[disturbance].items()
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plant.toml"
        path.write_text(apply(PLANT.read_text(encoding="utf-8"), edits), encoding="utf-8")
        return load(path)


# --- trees that choose ----------------------------------------------------------------------------


class Choice:
    """An epsilon-greedy choice with a constant step, so that it forgets, as an author would write
    it who knows that the world changes."""

    def __init__(self, actions: tuple[str, ...], rng: np.random.Generator) -> None:
        self.actions, self.rng = actions, rng
        self.value = dict.fromkeys(actions, 1.0)
        self.picked = ""

    def pick(self) -> str:
        """Pick an action."""
        if self.rng.random() < EPSILON:
            self.picked = str(self.rng.choice(self.actions))
        else:
            self.picked = max(self.actions, key=lambda action: self.value[action])
        return self.picked

    def reward(self, caught: bool) -> None:
        """Learn from the ball, if something was chosen for it."""
        if self.picked:
            self.value[self.picked] += STEP * (caught - self.value[self.picked])
        self.picked = ""


class Pick(Act):
    """A primitive action whose alternative is chosen when it starts."""

    def __init__(self, cell: Cell, choice: Choice, reads: str = "", writes: str = "") -> None:
        super().__init__(cell, choice.actions[0], reads, writes)
        self.choice = choice

    def initialise(self) -> None:
        """Choose, and start."""
        self.action = self.choice.pick()
        super().initialise()


class Learn(Behaviour):
    """Reports to every choice whether the ball was caught."""

    def __init__(self, choices: Mapping[str, Choice]) -> None:
        super().__init__("learn")
        self.choices, self.before = choices, 0

    def update(self) -> Status:
        """Compare the count with that of the last ball."""
        caught = Blackboard.get("caught")
        for choice in self.choices.values():
            choice.reward(caught > self.before)
        self.before = caught
        return Status.SUCCESS


class ChoosingTree(TreeProgram):
    """The tree with other behaviours for locating, tracking and moving. Without choices it tries
    other ways of locating when the first one fails."""

    def __init__(self, cell: Cell, balls: int, choices: Mapping[str, Choice]) -> None:
        super().__init__(cell, balls)
        root = create_root(cell, balls)
        assert isinstance(root, Repeat)
        if choices:
            _put(root, "locate", Pick(cell, choices["locate_ball"], writes="ball"))
            _put(root, "track", Pick(cell, choices["track_ball"], reads="ball"))
            _put(root, "move", Pick(cell, choices["move_to_point"]))
            one = root.decorated
            one.parent = None
            root.children[0] = root.decorated = Sequence("ball", True, [one, Learn(choices)])
            root.decorated.parent = root
        else:
            names = ("locate_background", "locate_compensated", "locate_hough")
            tries = [Act(cell, name, writes="ball") for name in names]
            _put(root, "locate", Selector("locate by any", True, tries))
        self.tree = BehaviourTree(root)
        self.tree.setup()


def _put(root: Behaviour, name: str, child: Behaviour) -> None:
    """Put another behaviour under the Timeout decorator of a name."""
    for node in root.iterate():
        if isinstance(node, Timeout) and node.name == name:
            node.children[0] = node.decorated = child
            child.parent = node
            return
    raise KeyError(name)


# --- the part -------------------------------------------------------------------------------------


def measure_one(policy: str, seed: int, trials: int) -> Line:
    """Run one policy through the switching disturbances. `caught` has one entry for a mission."""
    program, _, name = policy.partition(" ")
    task = load_task(TASK)
    directories = {one: directory_of(one) for one in DISTURBANCES}
    learning = Learning(task, name, Question(rho=0.0), credit="task") if program == "net" else None
    rng = np.random.default_rng(seed)
    choices = {one: Choice(offered, rng) for one, offered in ALTERNATIVES.items()}
    given = choices if name == "epsilon" else {}
    make: Make = TreeProgram if name == "fixed" else lambda c, n: ChoosingTree(c, n, given)
    caught = []
    for k in range(trials // BALLS):
        directory = directories[phase(k * BALLS)]
        mission_seed = 1_000_000 * (seed + 1) + k
        if learning is not None:
            selector = LearningSelector(learning, Contexts(()), seed=seed, generation=k)
            done = net_mission(directory, task, BALLS, mission_seed, selector=selector)
        else:
            done = program_mission(directory, make, BALLS, mission_seed)
        if done.report.crash:
            raise RuntimeError(f"{policy}: {done.report.crash}")
        caught.append(done.report.caught)
    return {"policy": policy, "seed": seed, "trials": trials, "caught": caught}


def phase(trial: int) -> str:
    """Return the disturbance at a trial (from 0)."""
    return list(DISTURBANCES)[trial // EACH % len(DISTURBANCES)]


def regret(caught: list[int]) -> list[float]:
    """Return the regret (balls) after each mission."""
    chances = {one: best(faults)[1] for one, faults in DISTURBANCES.items()}
    ideal = [BALLS * chances[phase(k * BALLS)] for k in range(len(caught))]
    return [float(one) for one in np.cumsum(ideal) - np.cumsum(caught)]


def measure(results: Results, size: Size, workers: int) -> None:
    """Run every policy with every seed."""
    results.measure(
        "learned",
        measure_one,
        [
            (key, (policy, seed, size.learning))
            for key, policy, seed in keyed(POLICIES, range(1, size.learning_seeds + 1))
        ],
        workers,
    )
