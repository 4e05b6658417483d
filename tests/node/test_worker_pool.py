"""Actions without a device: each run has its own worker, workers are started and retired as needed,
and every run ends once."""

from __future__ import annotations

import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.comm.protocol.messages import Answer, Call, Cancel, Command, Outcome
from petrobot.services.node.inline_host import HOLD, answer_of
from petrobot.services.node.worker_host import PATIENCE
from petrobot.services.node.worker_pool import BUSY_AFTER, IDLE_LIMIT, KEPT, WorkerPool
from petrobot.services.worker.pipe import Item
from petrobot.services.worker.process import DROPPED, STREAM_AT, WANTED
from tests.node.test_worker_host import FakeChild, HostBench


class OneByOne(FakeChild):
    """A fake worker that begins a call when the one before it has ended, like a real worker without
    a device."""

    ended = 0
    withdrawn: tuple[str, ...] = ()

    def say(self, item: Item) -> None:
        self.ended += isinstance(item, Outcome)
        super().say(item)
        if self.withdrawn and isinstance(item, Outcome):
            dropped, self.withdrawn = list(self.withdrawn), ()
            super().say([DROPPED, dropped])

    def take_back(self) -> int:
        calls = [item.id for item in self.got if isinstance(item, Call)]
        begun = min(self.given, self.ended + 1)
        count = self.given - begun
        self.withdrawn += tuple(calls[len(calls) - count :])
        self.given = begun
        return count


class Pool(HostBench):
    """A pool whose workers are fake."""

    place: WorkerPool

    def __init__(self, most: int = 4) -> None:
        super().__init__("", OneByOne)
        self.place = WorkerPool(self.hosting, most)
        self.place.start()

    def living(self) -> list[FakeChild]:
        return [child for child in self.children if not child.dead]

    def make_ready(self) -> None:
        for child in self.living():
            child.ready()

    def of(self, identity: str) -> FakeChild:
        """Return the worker that got a run."""
        (child,) = [
            c
            for c in self.children
            if identity in {o.id for o in c.orders() if isinstance(o, Call)}
            and identity not in getattr(c, "withdrawn", ())
        ]
        return child

    def begin_alone(self, *identities: str) -> None:
        """Begin runs with so much time between them that none waits behind another."""
        for identity in identities:
            self.run(PATIENCE)
            self.begin(identity)
            self.make_ready()

    def answer(self, verb: str) -> Answer | None:
        self.place.command(self.clock.now, Command(verb, verb))
        return next((report for report in self.run() if isinstance(report, Answer)), None)


def test_each_run_has_a_worker_and_one_spare_worker_waits() -> None:
    bench = Pool()
    bench.make_ready()
    bench.begin("a")
    assert len(bench.children) == 2, "the next run should find a worker that is up"
    bench.make_ready()
    bench.begin_alone("b")
    assert bench.of("a") is bench.children[0] and bench.of("b") is bench.children[1]
    bench.of("a").say(Outcome("a", "success"))
    bench.run()
    bench.begin("c")
    assert bench.of("c") is bench.children[0], "the first worker is used again"


def test_the_death_of_one_worker_ends_only_its_run() -> None:
    bench = Pool()
    bench.make_ready()
    bench.begin_alone("a", "b")
    bench.of("a").die(-11)
    assert [(r.id, r.cause) for r in bench.run()] == [("a", "worker_died")]
    bench.of("b").say(Outcome("b", "success"))
    assert [(r.id, r.status) for r in bench.run()] == [("b", "success")]


def test_beyond_the_limit_a_run_is_busy() -> None:
    bench = Pool(most=2)
    bench.make_ready()
    bench.begin_alone("a", "b", "c")
    assert bench.run(BUSY_AFTER - 0.1) == []
    assert [(r.id, r.cause, r.executed) for r in bench.run(0.2)] == [("c", "busy", "no")]
    bench.begin("d")
    bench.of("b").say(Outcome("b", "success"))
    assert [r.id for r in bench.run()] == ["b"] and bench.of("d") is bench.of("b")
    told = bench.answer("status")
    assert told is not None and told.data["answer"] == "busy" and len(bench.children) == 2


def test_idle_workers_retire_but_a_few() -> None:
    bench = Pool(most=6)
    bench.make_ready()
    bench.begin_alone(*"abcd")
    for identity in "abcd":
        bench.of(identity).say(Outcome(identity, "success"))
    bench.run(IDLE_LIMIT - 1.0)
    assert not any(child.left for child in bench.children)
    bench.run(2.0)
    left = [child for child in bench.children if child.left]
    assert len(bench.children) - len(left) == KEPT and not bench.children[0].left
    assert len(bench.place.children()) == len(bench.children), "the node waits for those, too"
    for child in left:
        child.die(0)
    bench.run()
    assert len(bench.place.children()) == KEPT


def test_answers_and_addresses_go_to_the_worker_that_asked() -> None:
    bench = Pool()
    bench.make_ready()
    bench.begin_alone("a", "b")
    a, b = bench.of("a"), bench.of("b")
    b.say(Call("b/1", "service", parent="b"))
    b.say([WANTED, "points"])
    bench.run()
    bench.place.take(0.0, Outcome("b/1", "success"))
    bench.place.stream_at("points", "h", 1, "t")
    assert bench.wanted == ["points"]
    assert b.got[-2:] == [Outcome("b/1", "success"), [STREAM_AT, "points", "h", 1, "t"]]
    assert not [item for item in a.words() if item[0] == STREAM_AT]
    assert not [item for item in a.got if isinstance(item, Outcome)]


def test_a_command_is_answered_once_by_all_that_run() -> None:
    bench = Pool()
    bench.make_ready()
    assert bench.answer("picture") is not None and bench.answer("stop") is not None
    bench.begin_alone("a", "b")
    assert bench.answer("hold") is None
    bench.of("a").say(answer_of("hold", "held", {}))
    assert not [r for r in bench.run() if isinstance(r, Answer)]
    bench.of("b").say(answer_of("hold", "held", {}))
    assert [(r.id, r.data["answer"]) for r in bench.run() if isinstance(r, Answer)] == [
        ("hold", "held")
    ]
    bench.make_ready()
    bench.begin("late")
    got = [item for item in bench.of("late").got if isinstance(item, Call | Command)]
    assert got[0] == HOLD and isinstance(got[1], Call), "it begins held"
    told = bench.answer("status")
    assert told is not None and (told.data["answer"], set(told.data["runs"])) == (
        "up",
        {"a", "b", "late"},
    )


def test_calls_at_once_share_a_worker_until_one_takes_long() -> None:
    bench = Pool(most=6)
    bench.make_ready()
    bench.begin_alone("warm")
    bench.of("warm").say(Outcome("warm", "success"))
    bench.run()
    assert len(bench.living()) == KEPT
    names = [f"r{number}" for number in range(8)]
    for name in names:
        bench.begin(name)
    first, second = bench.children[:2]
    assert [len([o for o in c.orders() if isinstance(o, Call)]) for c in (first, second)] == [5, 4]
    second.say(Outcome("r1", "success"))
    bench.make_ready()
    assert [report.id for report in bench.run(PATIENCE / 2)] == ["r1"]
    second.say(Outcome("r3", "success"))
    bench.run(PATIENCE / 2)
    moved = [name for name in names if bench.of(name) is not first]
    assert moved == [name for name in names if name != "r0"], "r0 takes long: no other waits for it"
    assert [report.id for report in bench.reports] == ["warm", "r1", "r3"]


def test_a_call_behind_a_waiting_or_dead_run_goes_to_another_worker() -> None:
    bench = Pool()
    bench.make_ready()
    bench.begin_alone("warm")
    bench.of("warm").say(Outcome("warm", "success"))
    bench.run()
    for name in ("a", "b", "c", "d"):
        bench.begin(name)
    a = bench.of("a")
    a.given = 1  # the worker itself has taken the permits of what it gives back
    a.got = [item for item in a.got if not (isinstance(item, Call) and item.id == "c")]
    a.say([DROPPED, ["c"]])
    bench.run()
    assert bench.of("c") is bench.of("b")
    bench.of("b").die(-11)
    died = [(r.id, r.cause, r.executed) for r in bench.run() if isinstance(r, Outcome)]
    assert died == [("b", "worker_died", "unknown")]
    bench.make_ready()
    bench.run(1.0)
    assert all(not bench.of(name).dead for name in "cd")


@pytest.mark.parametrize("begun", [False, True])
def test_a_call_that_waits_behind_another_is_cancelled_at_once(begun: bool) -> None:
    bench = Pool(most=1)
    bench.make_ready()
    bench.begin("a")
    bench.begin("b")
    worker = bench.children[0]
    if begun:
        worker.say(Outcome("a", "success"))
    bench.place.take(bench.clock.now, Cancel("b", "cancelled: enough"))
    ends = [(r.id, r.cause, r.executed) for r in bench.run()]
    assert ends == ([("a", "", "yes")] if begun else [("b", "cancelled", "no")])
    assert (Cancel("b", "cancelled: enough") in worker.got) is begun
    if not begun:
        assert not bench.place.ready, "the worker has not yet seen that b was taken back"
        worker.say(Outcome("a", "success"))
        assert bench.place.ready


@settings(max_examples=300, deadline=None)
@given(
    acts=st.lists(
        st.tuples(
            st.sampled_from(
                ["begin", "stop", "end", "die", "ready", "hold", "release", "stop all", "wait"]
            ),
            st.integers(0, 7),
        ),
        max_size=40,
    )
)
def test_every_run_ends_once_and_the_pool_accepts_runs_again(acts: list[tuple[str, int]]) -> None:
    bench = Pool()
    begun: list[str] = []
    for act, number in acts:
        living = bench.living()
        child = living[number % len(living)] if living else None
        if act == "begin":
            begun.append(f"r{len(begun)}")
            bench.begin(begun[-1], 5.0)
        elif act == "stop" and begun:
            bench.place.take(bench.clock.now, Cancel(begun[number % len(begun)]))
        elif act == "end" and child:
            for order in child.orders():
                if isinstance(order, Call):
                    child.say(Outcome(order.id, "success"))
        elif act == "die" and child:
            child.die()
        elif act == "ready":
            bench.make_ready()
        elif act in ("hold", "release", "stop all"):
            verb = act.partition(" ")[0]
            bench.place.command(bench.clock.now, Command(verb, verb))
            for each in living:
                if Command(verb, verb) in each.got:
                    each.say(answer_of(verb, "held" if verb == "hold" else "done", {}))
        elif act == "wait":
            bench.run(1.0)
        bench.run()
    bench.place.command(bench.clock.now, Command("last release", "release"))
    for _ in range(30):
        for each in bench.living():
            if each.killed or each.left:
                each.die()
        bench.make_ready()
        bench.run(2.0)
    ends = [report.id for report in bench.reports if isinstance(report, Outcome)]
    assert sorted(ends) == sorted(begun)
    assert bench.place.ready and bench.place.condition == ("up", "")
    bench.begin("last")
    assert bench.of("last") in bench.living()
