"""The catching task as a behaviour tree, as users of py_trees write it.

After the py_trees tutorials: a behaviour that starts, polls and cancels an action; its data on the
blackboard; Timeout, Retry and Repeat as decorators; sequences and selectors with memory. Parallels
stand where two things go on at once. A result of the status failure lets the task continue, so it
is a SUCCESS of the behaviour; only an error is a FAILURE.
"""

from __future__ import annotations

from py_trees.behaviour import Behaviour
from py_trees.blackboard import Blackboard
from py_trees.common import Access, ParallelPolicy, Status
from py_trees.composites import Parallel, Selector, Sequence
from py_trees.decorators import FailureIsSuccess, Inverter, Repeat, Retry, Timeout
from py_trees.trees import BehaviourTree

from experiments.against_trees.cell import Cell, Run


class Act(Behaviour):
    """A primitive action. `reads` and `writes` are the keys of the blackboard for its argument and
    its result."""

    def __init__(self, cell: Cell, action: str, reads: str = "", writes: str = "") -> None:
        super().__init__(action)
        self.cell, self.action, self.reads, self.writes = cell, action, reads, writes
        self.board = self.attach_blackboard_client(action)
        if reads:
            self.board.register_key(reads, Access.READ)
        if writes:
            self.board.register_key(writes, Access.WRITE)
        self.run: Run | None = None

    def initialise(self) -> None:
        """Start the action."""
        arguments = {self.reads: self.board.get(self.reads)} if self.reads else {}
        self.run = self.cell.start(self.action, **arguments)

    def update(self) -> Status:
        """Poll it."""
        assert self.run is not None
        if self.run.outcome is None:
            return Status.RUNNING
        if self.run.status == "error":
            self.feedback_message = self.run.outcome.cause
            return Status.FAILURE
        if self.writes:
            self.board.set(self.writes, self.run.outcome.values[self.writes])
        return Status.SUCCESS

    def terminate(self, new_status: Status) -> None:
        """Cancel it if the tree turned elsewhere."""
        if new_status is Status.INVALID and self.run is not None:
            self.cell.cancel(self.run)


class Caught(Behaviour):
    """Waits for the light barrier from now on, and counts the ball."""

    def __init__(self, cell: Cell) -> None:
        super().__init__("ball caught")
        self.cell = cell
        self.board = self.attach_blackboard_client("ball caught")
        self.board.register_key("in_cup", Access.WRITE)
        self.board.register_key("caught", Access.WRITE)

    def initialise(self) -> None:
        """Forget what came before."""
        self.seen = self.cell.count("ball_caught")

    def update(self) -> Status:
        """Look whether it came."""
        if self.cell.count("ball_caught") == self.seen:
            return Status.RUNNING
        self.board.in_cup = True
        self.board.caught += 1
        return Status.SUCCESS


class ImageTick(Behaviour):
    """Waits for the next image of the camera."""

    def __init__(self, cell: Cell) -> None:
        super().__init__("image tick")
        self.cell = cell

    def initialise(self) -> None:
        """Forget what came before."""
        self.seen = self.cell.count("image_tick")

    def update(self) -> Status:
        """Look whether it came."""
        came = self.cell.count("image_tick") > self.seen
        return Status.SUCCESS if came else Status.RUNNING


class InCup(Behaviour):
    """Whether the ball is in the cup already."""

    def __init__(self) -> None:
        super().__init__("in cup?")
        self.board = self.attach_blackboard_client("in cup?")
        self.board.register_key("in_cup", Access.READ)

    def update(self) -> Status:
        """Read it from the blackboard."""
        return Status.SUCCESS if self.board.in_cup else Status.FAILURE


class NewBall(Behaviour):
    """Nothing is in the cup."""

    def __init__(self) -> None:
        super().__init__("new ball")
        self.board = self.attach_blackboard_client("new ball")
        self.board.register_key("in_cup", Access.WRITE)

    def update(self) -> Status:
        """Write it to the blackboard."""
        self.board.in_cup = False
        return Status.SUCCESS


def until_caught(cell: Cell, name: str, act: Behaviour) -> Behaviour:
    """Act until it ends, or until the ball is in the cup."""
    policy = ParallelPolicy.SuccessOnOne()
    return Parallel(name, policy, [Caught(cell), act])


def create_root(
    cell: Cell,
    balls: int,
    locate: str = "locate_background",
    track: str = "predict_least_squares",
    move: str = "intercept_tilted",
) -> Behaviour:
    """Return the tree. It fails if the arm cannot be recovered."""
    see = Sequence("see", True, [
        NewBall(),
        Timeout("images", ImageTick(cell), 10.0),
        Timeout("locate", Act(cell, locate, writes="ball"), 8.0),
    ])  # fmt: skip
    follow = FailureIsSuccess("track or lose", Timeout(
        "track", Act(cell, track, reads="ball"), 6.0
    ))  # fmt: skip
    reach = until_caught(cell, "reach", Timeout("move", Act(cell, move), 6.0))
    catch = Selector("catch", True, [
        InCup(),
        until_caught(cell, "wait", Timeout("follow", Act(cell, "follow_and_wait"), 4.0)),
    ])  # fmt: skip
    home = Timeout("home", Act(cell, "empty_and_home"), 10.0)
    recover = Retry("recover", Timeout("reset", Act(cell, "reset_and_home"), 30.0), 4)
    arm = Selector("arm", True, [Sequence("take", True, [reach, catch, home]), recover])
    deal = Parallel("deal with it", ParallelPolicy.SuccessOnAll(), [follow, arm])
    one = Selector("one ball", True, [Inverter("none to see", see), deal])
    return Repeat("all balls", one, balls)


class TreeProgram:
    """Ticks the tree."""

    def __init__(
        self,
        cell: Cell,
        balls: int,
        locate: str = "locate_background",
        track: str = "predict_least_squares",
        move: str = "intercept_tilted",
    ) -> None:
        Blackboard.clear()
        Blackboard.set("caught", 0)
        self.tree = BehaviourTree(create_root(cell, balls, locate, track, move))
        self.tree.setup()
        self.over = self.gave_up = False
        self.caught = 0

    def tick(self) -> None:
        """Tick the tree once."""
        self.tree.tick()
        status = self.tree.root.status
        self.caught = Blackboard.get("caught")
        self.over, self.gave_up = status is not Status.RUNNING, status is Status.FAILURE
