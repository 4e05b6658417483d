"""Scripted actions, and rehearsals of actions."""

from __future__ import annotations

from pathlib import Path

import pytest

from petrobot.services.action import Context, Result, Status, failure, provisional, success
from petrobot.services.device import Driver
from petrobot.services.rehearsal import StillRunningError, rehearse, rehearse_task
from petrobot.services.scripted import ScriptError, load


def test_a_script_is_played_line_by_line(tmp_path: Path) -> None:
    file = tmp_path / "script.toml"
    file.write_text(
        "schema = 1\n[actions.one]\nseconds = [0.2, 0.4]\nvalues = { x = 1 }\n"
        '[[actions.two]]\nstatus = "failure"\ncause = "c"\ntext = "t"\nseconds = 0.1\n'
        'events = [{ after = 0.05, name = "half", data = { y = 2 } }, { after = 9.0, name = '
        '"never" }]\n'
        "[[actions.two]]\n"
    )
    script = load(file)
    played = [rehearse(script["two"], anything=1) for _ in range(3)]
    assert [(p.result.status, p.result.cause) for p in played] == [
        ("failure", "c"),
        ("success", ""),
        ("failure", "c"),
    ]
    assert [(round(t, 3), name, data) for t, name, data in played[0].events] == [
        (0.052, "half", {"y": 2})
    ]
    times = {rehearse(script["one"], seed=seed).seconds for seed in range(8)}
    assert len(times) > 3 and all(0.2 - 1e-9 <= t <= 0.4 + 0.004 for t in times)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("schema = 2", "schema: write schema = 1"),
        ("schema = 1\n[action.x]", "action: unknown table; did you mean 'actions'?"),
        ("schema = 1\nactions = 3", "actions: write [actions.NAME] tables"),
        ("schema = 1\n[actions.x]\nstate = 1", "actions.x: unknown key 'state'"),
        (
            'schema = 1\n[actions.x]\nstatus = "good"',
            'status is \'good\'; write "success", "failure" or "error"',
        ),
        (
            "schema = 1\n[actions.x]\nseconds = [2, 1]",
            "seconds is [2, 1]; write a number, or [shortest, longest]",
        ),
        ("schema = 1\n[actions.x]\nvalues = 1", "values is 1; write a table"),
        ("schema = 1\n[actions.x]\nevents = [{ name = 1 }]", "event {'name': 1}; write"),
        ("schema = 1\n[actions]\nx = 1", "actions.x: is 1; write a table with status"),
        ("schema = ", "not valid TOML"),
    ],
)
def test_bad_scripts_are_refused(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "script.toml"
    file.write_text(text)
    with pytest.raises(ScriptError) as caught:
        load(file)
    assert says in str(caught.value) and str(file) in str(caught.value)


def test_a_rehearsal_reports_everything_that_an_action_did() -> None:
    async def act(ctx: Context, *, n: int) -> Result:
        ctx.progress(0.5)
        ctx.publish("s", [1.0])
        answer = await ctx.call("add", n=n)
        await ctx.put("sum", answer.values["sum"])
        if not await ctx.wait(lambda: ctx.device["light"], 1.0):
            return failure("dark")
        ctx.raise_event("seen")
        return success(sum=await ctx.get("sum"), unknown=(await ctx.call("nobody")).cause)

    lamp = {"light": False}
    played = rehearse(
        act,
        device=lamp,
        services={"add": lambda n: success(sum=n + 1)},
        streams={"s": 0.02},
        world=lambda now: lamp.update(light=now > 0.5),
        n=4,
    )
    assert (
        played.result.values == {"sum": 5, "unknown": "unknown_service"}
        and 0.5 < played.seconds < 0.52
    )
    assert [name for _, name, _ in played.calls] == ["add", "memory.put", "memory.get", "nobody"]
    assert (
        len(played.published) == 26 and played.progress == [(0.0, 0.5)] and len(played.events) == 1
    )


def test_a_rehearsal_shows_what_is_provisional_and_what_was_judged() -> None:
    async def act(ctx: Context, run: str) -> Result:
        await ctx.sleep(0.1)
        ctx.verdict(run, failure("crooked"))
        with pytest.raises(ValueError, match=r"pass ctx\.run of the run's own context"):
            ctx.verdict("pick#1", failure("crooked"))
        with pytest.raises(TypeError, match=r"expected a result, such as .* found 'good'"):
            ctx.verdict(run, "good")  # type: ignore[arg-type]
        return provisional(failure("loose", "may hold", force=1.0))

    played = rehearse(act, run="m/pick#1")
    assert played.result == Result(
        Status.FAILURE, {"force": 1.0}, "loose", "may hold", deferred=True
    )
    assert [(run, status, cause) for _, run, status, cause in played.verdicts] == [
        ("m/pick#1", "failure", "crooked")
    ]


def test_the_run_of_one_rehearsal_can_be_judged_in_another() -> None:
    async def pick(ctx: Context) -> Result:
        return provisional(success(run=ctx.run))

    async def judge(ctx: Context, run: str) -> Result:
        ctx.verdict(run, failure("crooked"))
        return success()

    picked = rehearse(pick).result.values["run"]
    assert [run for _, run, _, _ in rehearse(judge, run=picked).verdicts] == [picked]


def test_a_script_may_be_provisional(tmp_path: Path) -> None:
    file = tmp_path / "script.toml"
    file.write_text("schema = 1\n[actions.one]\ndeferred = true\n")
    assert rehearse(load(file)["one"]).result.deferred
    file.write_text('schema = 1\n[actions.one]\ndeferred = "later"\n')
    with pytest.raises(ScriptError, match=r"actions\.one: deferred is 'later'; write true"):
        load(file)


def test_a_rehearsal_has_a_limit() -> None:
    async def act(ctx: Context) -> Result:
        await ctx.sleep(100.0)
        return success()

    with pytest.raises(StillRunningError, match="has not ended after 2 s"):
        rehearse(act, limit=2.0)
    assert rehearse(act, cancel_after=1.0).result.cause == "cancelled"


def test_a_rehearsal_that_does_not_end_says_what_was_done_last_and_no_more() -> None:
    async def count(ctx: Context) -> Result:
        while True:
            number, _ = await ctx.get_versioned("parts", 0)
            await ctx.compare_and_set("parts", 99, number + 1)

    with pytest.raises(StillRunningError, match=r"\d+ calls, the last: .*memory\.") as raised:
        rehearse(count, limit=2.0, memory={"parts": 4})
    assert len(str(raised.value)) < 400


def test_a_rehearsal_has_memory_and_streams_without_a_location_file() -> None:
    class Desk(Driver):
        period = 0.01
        shown = 0.0

        def step(self, now: float) -> None:
            values = self.ports.stream("place").values
            self.shown = 0.0 if values is None else values[0]

    desk = Desk({}, None)

    async def tell(ctx: Context) -> Result:
        ctx.publish("place", [await ctx.get("parts")])
        await ctx.sleep(0.1)
        with pytest.raises(ValueError, match=r"expected a list of numbers, found \{'x': 1\}"):
            ctx.publish("place", {"x": 1})  # type: ignore[arg-type]
        return success(shown=desk.shown)

    played = rehearse(tell, device=desk, memory={"parts": 4})
    assert played.result.values == {"shown": 4.0}
    assert {(stream, values) for _, stream, values in played.published} == {("place", (4.0,))}


def test_a_driver_receives_the_set_points_of_other_actions() -> None:
    class Scale(Driver):
        period = 0.02

        def state(self) -> dict[str, float | None]:
            values = self.ports.stream("weight").values
            return {"weight": None if values is None else values[0]}

        def step(self, now: float) -> None:
            """Nothing moves."""

    async def weigh(ctx: Context) -> Result:
        await ctx.sleep(0.5)
        return success(weight=ctx.device.state["weight"])

    for points, weight in (({"weight": [1.5]}, 1.5), (None, None)):
        played = rehearse(weigh, device=Scale({}, None), set_points=points)
        assert played.result.values == {"weight": weight}


def test_a_driver_may_open_a_stream_in_its_setup_and_be_rehearsed_twice() -> None:
    class Desk(Driver):
        def setup(self) -> None:
            self.place = self.ports.stream("place")
            with pytest.raises(ValueError, match="a driver is made before the seed is known"):
                self.ports.random("noise")
            with pytest.raises(AttributeError, match=r"a test has no ports\.file"):
                self.ports.file("table.csv")

    async def tell(ctx: Context, *, number: float) -> Result:
        begin = ctx.device.place.values
        ctx.publish("place", [number])
        await ctx.sleep(0.95)
        ctx.device.ports.raise_event("seen")
        return success(begin=begin, end=ctx.device.place.values)

    desk = Desk({}, None)
    for number in (1.0, 2.0):
        played = rehearse(tell, device=desk, streams={"place": 0.1}, number=number)
        assert played.result.values == {"begin": None, "end": [number]}
        assert [name for _, name, _ in played.events] == ["seen"]


@pytest.mark.processes
@pytest.mark.parametrize(
    ("old", "new", "status", "told"),
    [
        ("", "", "success", ""),
        ("tokens = 5", "tokens = -5", "", r"petrobot check:\n.*sort.toml:\d+: places.parts.tokens"),
        ("timeout = 7.0", "timeout = 0.1", "error", ""),
    ],
)
def test_a_task_is_checked_and_run(
    old: str, new: str, status: str, told: str, tmp_path: Path
) -> None:
    """One that may not run fails the test with the message of `check`; an ERROR is a result."""
    sorter = Path(__file__).parents[2] / "examples" / "sorter"
    for file in filter(Path.is_file, sorter.iterdir()):
        text = file.read_text(encoding="utf-8").replace('"belt" }', '"belt" }, timeout = 7.0')
        (tmp_path / file.name).write_text(text.replace(old, new))
    if told:
        with pytest.raises(AssertionError, match=told):
            rehearse_task(tmp_path / "sort.toml")
    else:
        result = rehearse_task(str(tmp_path / "sort.toml"), "--seed", "3", "--runs", "1")
        assert (result["status"], result["seed"], result["runs"]) == (status, 3, 1)
