"""The catching task as a state machine, as one writes it by hand: a plain loop that is called again
and again, one state for the arm and one run for the camera beside it."""

from __future__ import annotations

from enum import Enum, auto

from experiments.against_trees.cell import Cell, Run

IMAGES, LOCATE, TRACK, MOVE, CATCH, HOME, RECOVER = 10.0, 8.0, 6.0, 6.0, 4.0, 10.0, 30.0
"""s that each step may take."""
ATTEMPTS = 4
"""Resets of the arm before it is given up."""


class State(Enum):
    """Where the arm stands."""

    IDLE = auto()
    LOCATING = auto()
    MOVING = auto()
    CATCHING = auto()
    HOMING = auto()
    RECOVERING = auto()


class MachineProgram:
    """Catches so many balls."""

    def __init__(
        self,
        cell: Cell,
        balls: int,
        locate: str = "locate_background",
        track: str = "predict_least_squares",
        move: str = "intercept_tilted",
    ) -> None:
        self.cell, self.balls = cell, balls
        self.locate, self.track, self.move = locate, track, move
        self.over = self.gave_up = False
        self.caught = 0
        self.state = State.IDLE
        self.run: Run | None = None
        self.tracking: Run | None = None
        self.begun = self.track_begun = cell.now
        self.seen = cell.count("image_tick")
        self.failed = 0
        self.ball: list[float] = []

    def tick(self) -> None:
        """Do what can be done now."""
        self.follow_ball()
        match self.state:
            case State.IDLE:
                self.idle()
            case State.LOCATING:
                if self.ended(LOCATE):
                    if self.status == "error":
                        self.used()
                    else:
                        assert self.run is not None and self.run.outcome is not None
                        self.ball = self.run.outcome.values["ball"]
                        self.tracking = self.cell.start(self.track, ball=self.ball)
                        self.track_begun = self.cell.now
                        self.seen = self.cell.count("ball_caught")
                        self.enter(State.MOVING, self.move)
            case State.MOVING:
                if self.cell.count("ball_caught") > self.seen:
                    self.catch()
                elif self.ended(MOVE):
                    if self.status == "error":
                        self.recover()
                    else:
                        self.seen = self.cell.count("ball_caught")
                        self.enter(State.CATCHING, "follow_and_wait")
            case State.CATCHING:
                if self.cell.count("ball_caught") > self.seen:
                    self.catch()
                elif self.ended(CATCH):
                    if self.status == "error":
                        self.recover()
                    else:
                        self.enter(State.HOMING, "empty_and_home")
            case State.HOMING:
                if self.ended(HOME):
                    if self.status == "error":
                        self.recover()
                    else:
                        self.used()
            case State.RECOVERING:
                if self.ended(RECOVER):
                    if self.status != "error":
                        self.used()
                    elif self.failed + 1 < ATTEMPTS:
                        self.failed += 1
                        self.enter(State.RECOVERING, "reset_and_home")
                    else:
                        self.gave_up = True
                        self.over = self.tracking is None

    def idle(self) -> None:
        """Begin with the next ball at the next image; a camera without images uses the ball up."""
        if self.tracking is not None:  # the camera is not free yet
            self.begun, self.seen = self.cell.now, self.cell.count("image_tick")
        elif self.balls == 0:
            self.over = True
        elif self.cell.count("image_tick") > self.seen:
            self.enter(State.LOCATING, self.locate)
        elif self.cell.now - self.begun > IMAGES:
            self.used()

    def follow_ball(self) -> None:
        """The camera's side: it is free when the run ends, or has lasted too long."""
        if self.tracking is not None:
            if self.cell.now - self.track_begun > TRACK:
                self.cell.cancel(self.tracking)
            if self.tracking.outcome is not None or self.tracking.cancelled:
                self.tracking = None

    def catch(self) -> None:
        """The ball is in the cup: the arm's run is not needed any more."""
        assert self.run is not None
        self.caught += 1
        self.cell.cancel(self.run)
        self.enter(State.HOMING, "empty_and_home")

    def recover(self) -> None:
        """Reset the arm, with all attempts."""
        self.failed = 0
        self.enter(State.RECOVERING, "reset_and_home")

    def used(self) -> None:
        """The ball is done with, one way or another."""
        self.balls -= 1
        self.state, self.begun = State.IDLE, self.cell.now
        self.seen = self.cell.count("image_tick")

    def enter(self, state: State, action: str) -> None:
        """Start the run of a state."""
        self.state, self.begun = state, self.cell.now
        self.run = self.cell.start(action)

    def ended(self, within: float) -> bool:
        """Whether the state's run has ended; one that lasts too long is cancelled."""
        assert self.run is not None
        if self.run.outcome is None and self.cell.now - self.begun > within:
            self.cell.cancel(self.run)
        return self.run.outcome is not None

    @property
    def status(self) -> str:
        """How the state's run has ended."""
        assert self.run is not None
        return self.run.status
