"""Thirty design faults, each transcribed into the net, the tree and the state machine.

A fault is a few edits of the correct program's text. Where a fault is impossible in a program, its
edits are None: for example, the tree has no resources to lose, because its parallels join by
themselves. That counts in its favour.
"""

from __future__ import annotations

from typing import NamedTuple

from msgspec import Struct


class Edit(NamedTuple):
    """Replace `old` by `new`. In the net, `old` is looked for in one TOML table only; an empty
    `old` removes that table. In other programs `old` must occur `times` times."""

    old: str
    new: str = ""
    table: str = ""
    times: int = 1


Edits = tuple[Edit, ...]


class DesignFault(Struct, frozen=True):
    """A design fault, and its edits in each program. None: the fault is impossible there."""

    name: str
    kind: str
    net: Edits | None
    tree: Edits | None
    machine: Edits | None


def apply(text: str, edits: Edits) -> str:
    """Return the text with the edits. Raises ValueError for an edit that does not fit."""
    for edit in edits:
        begin, end = 0, len(text)
        if edit.table:
            begin = text.find(f"\n[{edit.table}]\n") + 1
            if begin == 0:
                raise ValueError(f"there is no table {edit.table}")
            end = text.find("\n[", begin) + 1 or len(text)
        part = text[begin:end]
        if edit.old and part.count(edit.old) != edit.times:
            found = part.count(edit.old)
            raise ValueError(f"{edit.old!r} occurs {found} times, expected {edit.times}")
        text = text[:begin] + (part.replace(edit.old, edit.new) if edit.old else "") + text[end:]
    return text


def _drop(*tables: str) -> Edits:
    return tuple(Edit("", table=f"transitions.{name}") for name in tables)


def _put(table: str, old: str, new: str) -> Edits:
    return (Edit(old, new, table),)


def _unbranched(text: str) -> str:
    """Return a branch of the state machine that no longer asks for an error."""
    asked, _, rest = text.partition('                    if self.status == "error":')
    _, _, right = rest.partition("                    else:\n")
    return asked + right.replace("                        ", "                    ")


def _text(old: str, new: str = "", times: int = 1) -> Edits:
    return (Edit(old, new, times=times),)


_TRACK = """FailureIsSuccess("track or lose", Timeout(
        "track", Act(cell, track, reads="ball"), 6.0
    ))  # fmt: skip"""
_ARM = 'Selector("arm", True, [Sequence("take", True, [reach, catch, home]), recover])'
_MOVE = 'until_caught(cell, "reach", Timeout("move", Act(cell, move), 6.0))'
_WAIT = 'until_caught(cell, "wait", Timeout("follow", Act(cell, "follow_and_wait"), 4.0))'
_HOME = 'Timeout("home", Act(cell, "empty_and_home"), 10.0)'
_RETRY = 'Retry("recover", Timeout("reset", Act(cell, "reset_and_home"), 30.0), 4)'
_DEAL = 'Parallel("deal with it", ParallelPolicy.SuccessOnAll(), [follow, arm])'
_NO_BALL = """                    if self.status == "error":
                        self.used()
                    else:
                        assert"""
_NOT_MOVED = """                elif self.ended(MOVE):
                    if self.status == "error":"""
_MOVED = """                elif self.ended(MOVE):
                    if self.status == "error":
                        self.recover()
                    else:
                        self.seen = self.cell.count("ball_caught")
                        self.enter(State.CATCHING, "follow_and_wait")
"""
_CATCH_ENDED = """                elif self.ended(CATCH):
                    if self.status == "error":
                        self.recover()
                    else:
                        self.enter(State.HOMING, "empty_and_home")
"""
_HOMED = """                if self.ended(HOME):
                    if self.status == "error":
                        self.recover()
                    else:
                        self.used()
"""
_CAMERA_BUSY = """        if self.tracking is not None:  # the camera is not free yet
            self.begun, self.seen = self.cell.now, self.cell.count("image_tick")
        elif self.balls == 0:"""
_EARLY = """                if self.cell.count("ball_caught") > self.seen:
                    self.catch()
                elif self.ended(MOVE):"""
_SEEN = _EARLY.replace("MOVE", "CATCH")
_FREE = "if self.tracking.outcome is not None or self.tracking.cancelled:"
_TRY_AGAIN = "elif self.failed + 1 < ATTEMPTS:"
_GIVE_UP = """                    else:
                        self.gave_up = True
                        self.over = self.tracking is None
"""
_IMAGES = """        elif self.cell.now - self.begun > IMAGES:
            self.used()
"""
_CANCEL = """        self.cell.cancel(self.run)
        self.enter(State.HOMING"""
_TERMINATE = """        if new_status is Status.INVALID and self.run is not None:
            self.cell.cancel(self.run)
"""
_START = "                        self.tracking = self.cell.start(self.track, ball=self.ball)\n"
_LATE = """                        self.seen = self.cell.count("ball_caught")
                        self.enter(State.CATCHING"""

FAULTS: tuple[DesignFault, ...] = (
    DesignFault(
        "the camera is not given back when the ball has left", "lost resource",
        _put("transitions.tracked", 'out = ["camera_free"]', "out = []"), None,
        _text(_FREE, 'if self.tracking.status == "error":'),
    ),
    DesignFault(
        "the camera is not given back when the ball is lost", "lost resource",
        _put("transitions.track_lost", 'out = ["camera_free"]', "out = []"), None,
        _text(_FREE, 'if self.tracking.status in ("success", "failure"):'),
    ),
    DesignFault(
        "the arm is not given back when no ball is seen", "lost resource",
        _put("transitions.not_located", '"arm_free", ', ""), None,
        _text(_NO_BALL, _NO_BALL.replace("self.used()", "pass")),
    ),
    DesignFault(
        "the next ball begins while the camera is busy", "lost resource",
        _put("transitions.start", ', "camera_free"]', "]"),
        _text(_DEAL, _DEAL.replace("SuccessOnAll()", "SuccessOnSelected([arm])")),
        _text(_CAMERA_BUSY, "        if self.balls == 0:"),
    ),
    DesignFault(
        "no error branch at locating", "missing error branch", _drop("not_located"),
        _text('Selector("one ball", True, [Inverter("none to see", see), deal])',
              'Sequence("one ball", True, [see, deal])'),
        _text(_NO_BALL, """                    if True:
                        assert"""),
    ),
    DesignFault(
        "no error branch at tracking", "missing error branch", _drop("track_lost"),
        _text(_TRACK, 'Timeout("track", Act(cell, track, reads="ball"), 6.0)'),
        _text(_FREE, 'if self.tracking.status == "success" or self.tracking.cancelled:'),
    ),
    DesignFault(
        "no error branch at moving", "missing error branch", _drop("move_failed"),
        _text(_ARM, 'Sequence("arm", True, [reach, Selector("rest", True, '
                    '[Sequence("take", True, [catch, home]), recover])])'),
        _text(_MOVED, _unbranched(_MOVED)),
    ),
    DesignFault(
        "no error branch at catching", "missing error branch", _drop("catch_failed"),
        _text("[reach, catch, home]", '[reach, FailureIsSuccess("try", catch), home]'),
        _text(_CATCH_ENDED, _unbranched(_CATCH_ENDED)),
    ),
    DesignFault(
        "no error branch at going home", "missing error branch", _drop("home_failed"),
        _text(_HOME, f'FailureIsSuccess("go", {_HOME})'),
        _text(_HOMED, _unbranched(_HOMED)),
    ),
    DesignFault(
        "no branch for an arm that cannot be recovered", "missing error branch", _drop("give_up"),
        _text(_RETRY, f'FailureIsSuccess("hope", {_RETRY})'), _text(_GIVE_UP),
    ),
    DesignFault(
        "thirty attempts too many", "wrong retry count",
        (Edit("tokens = 3\ncapacity = 3", "tokens = 33\ncapacity = 33", "places.attempts"),
         Edit("capacity = 3", "capacity = 33", "places.failed_attempts")),
        _text("30.0), 4)", "30.0), 34)"), _text("ATTEMPTS = 4", "ATTEMPTS = 34"),
    ),
    DesignFault(
        "one attempt too few", "wrong retry count",
        (Edit("tokens = 3\ncapacity = 3", "tokens = 2\ncapacity = 2", "places.attempts"),
         Edit("capacity = 3", "capacity = 2", "places.failed_attempts")),
        _text("30.0), 4)", "30.0), 3)"), _text("ATTEMPTS = 4", "ATTEMPTS = 3"),
    ),
    DesignFault(
        "attempts are not given back", "wrong retry count",
        (*_drop("forgive"), Edit(', "!failed_attempts"', "", "transitions.arm_back")), None,
        _text("        self.failed = 0\n        self.enter", "        self.enter"),
    ),
    DesignFault(
        "attempts without end", "wrong retry count",
        (*_drop("give_up"), Edit('in = ["recover_arm:error", "attempts"]\n'
                                 'out = ["recover_arm", "failed_attempts"]',
                                 'in = ["recover_arm:error"]\nout = ["recover_arm"]',
                                 "transitions.recover_again")),
        _text("30.0), 4)", "30.0), -1)"),
        (Edit(_TRY_AGAIN, "else:"), Edit(_GIVE_UP)),
    ),
    DesignFault(
        "no time limit at locating", "missing time limit",
        _put("primitive_tasks.locate_ball", "deadline = 8.0 #", "#"),
        _text('Timeout("locate", Act(cell, locate, writes="ball"), 8.0)',
              'Act(cell, locate, writes="ball")'),
        _text("if self.ended(LOCATE):", "if self.run is not None and self.run.outcome:"),
    ),
    DesignFault(
        "no time limit at moving", "missing time limit",
        _put("primitive_tasks.move_to_point", "deadline = 6.0\n", ""),
        _text('Timeout("move", Act(cell, move), 6.0)', "Act(cell, move)"),
        _text("elif self.ended(MOVE):", "elif self.run is not None and self.run.outcome:"),
    ),
    DesignFault(
        "no time limit for images", "missing time limit", _drop("no_images"),
        _text('Timeout("images", ImageTick(cell), 10.0)', "ImageTick(cell)"), _text(_IMAGES),
    ),
    DesignFault(
        "a hundredth of the time for locating", "wrong time limit",
        _put("primitive_tasks.locate_ball", "deadline = 8.0", "deadline = 0.08"),
        _text('writes="ball"), 8.0)', 'writes="ball"), 0.08)'),
        _text("MOVE, CATCH, HOME, RECOVER = 10.0, 8.0",
              "MOVE, CATCH, HOME, RECOVER = 10.0, 0.08"),
    ),
    DesignFault(
        "the wait for images starves the ball's branch", "starving branch",
        _put("transitions.no_images", "after = 10.0", "after = 0.01"),
        _text("ImageTick(cell), 10.0)", "ImageTick(cell), 0.01)"),
        _text("RECOVER = 10.0,", "RECOVER = 0.01,"),
    ),
    DesignFault(
        "giving up starves the attempts", "starving branch",
        _put("transitions.give_up", ', "!attempts"', ""),
        _text(_RETRY, 'Timeout("reset", Act(cell, "reset_and_home"), 30.0)'),
        _text(_TRY_AGAIN, "elif self.failed > ATTEMPTS:"),
    ),
    DesignFault(
        "results of locating swapped", "swapped result",
        (Edit("locate_ball:normal", "locate_ball:error", "transitions.located"),
         Edit("locate_ball:error", "locate_ball:normal", "transitions.not_located")),
        _text('Inverter("none to see", see)', "see"),
        _text(_NO_BALL, _NO_BALL.replace("==", "!=")),
    ),
    DesignFault(
        "results of moving swapped", "swapped result",
        (Edit("move_to_point:normal", "move_to_point:error", "transitions.in_place"),
         Edit("move_to_point:error", "move_to_point:normal", "transitions.move_failed")),
        _text('Timeout("move", Act(cell, move), 6.0)',
              'Inverter("moved", Timeout("move", Act(cell, move), 6.0))'),
        _text(_NOT_MOVED, _NOT_MOVED.replace("==", "!=")),
    ),
    DesignFault(
        "a miss counts as a catch", "swapped result",
        (Edit('["caught", "caught_early"]', '["caught", "caught_early", "missed"]', "task"),),
        (Edit("        self.board.caught += 1\n"),
         Edit("        if self.writes:\n            self.board.set",
              '        if self.action == "empty_and_home":\n'
              '            Blackboard.set("caught", Blackboard.get("caught") + 1)\n'
              "        if self.writes:\n            self.board.set")),
        (Edit("        self.caught += 1\n"),
         Edit("                        self.used()\n            case State.RECOVERING",
              "                        self.caught += 1\n"
              "                        self.used()\n            case State.RECOVERING")),
    ),
    DesignFault(
        "the arm waits for set points that come only after it", "deadlock by order",
        (Edit('out = ["track_ball", "move_to_point"]', 'out = ["move_to_point"]',
              "transitions.located"),
         Edit('out = ["catch_ball"]', 'out = ["track_ball", "catch_ball"]',
              "transitions.in_place")),
        _text(_DEAL, 'Sequence("deal with it", True, [arm, follow])'),
        (Edit(_START), Edit(_LATE, _START + _LATE)),
    ),
    DesignFault(
        "a ball caught early is not noticed", "forgotten preemption",
        (*_drop("caught_early"), Edit('["caught", "caught_early"]', '["caught"]', "task")),
        _text(_MOVE, 'Timeout("move", Act(cell, move), 6.0)'),
        _text(_EARLY, "                if self.ended(MOVE):"),
    ),
    DesignFault(
        "a ball caught is not noticed", "forgotten preemption",
        (*_drop("caught"), Edit('["caught", "caught_early"]', '["caught_early"]', "task")),
        _text(_WAIT, 'Timeout("follow", Act(cell, "follow_and_wait"), 4.0)'),
        _text(_SEEN, "                if self.ended(CATCH):"),
    ),
    DesignFault(
        "a run that is not needed any more is not cancelled", "forgotten cancel",
        _put("transitions.caught", "catch_ball:preempt=success", "catch_ball:going"),
        _text(_TERMINATE, '        """Nothing to do."""\n'),
        _text(_CANCEL, "        self.enter(State.HOMING"),
    ),
    DesignFault(
        "a ball that nobody threw is not used up", "endless loop",
        _put("transitions.not_located", '["arm_free", ', '["runs", "arm_free", '),
        _text('Inverter("none to see", see)',
              'Inverter("none to see", Retry("again", see, -1))'),
        _text(_NO_BALL, _NO_BALL.replace("self.used()", "self.state = State.IDLE")),
    ),
    DesignFault(
        "tracking gets a value that nothing writes", "wrong data",
        _put("places.track_ball", '{ var = "ball" }', '{ var = "bal" }'),
        _text('Act(cell, track, reads="ball")', 'Act(cell, track, reads="bal")'),
        _text("start(self.track, ball=self.ball)", "start(self.track, ball=self.bal)"),
    ),
    DesignFault(
        "an action's name is mistyped", "wrong data",
        (Edit('"intercept_tilted", ', '"intercept_titled", ', "primitive_tasks.move_to_point"),),
        _text('"intercept_tilted"', '"intercept_titled"', 2),
        _text('"intercept_tilted"', '"intercept_titled"'),
    ),
)  # fmt: skip
"""The order is that of the tables in docs/experiment.md."""
