"""Mistakes that newcomers make in their own robot, and the message for each: file and line, key,
what was expected, what was found, what to do."""

from __future__ import annotations

import argparse
import copy
import io
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.operator.session import RunSession
from petrobot.coordinator.studies.campaign.plan import MANIFEST
from petrobot.services.comm.location_file import code as cell_code

CHECK = ["check", "arm_bot.toml"]
TASK, CELL, CODE = "arm_bot.toml", "services.toml", "arm_bot.py"
RUN = ["run", "arm_bot.toml", "--mode", "lockstep", "--quiet", "--no-page"]

Reader = Callable[[str, float], tuple[list[cell_code.Facts], str]]
Mistake = tuple[str, str, str, str]
"""File, original text, text with the mistake, and the message as a regular expression. LINE means
the line of the mistake, or any line if the message is about another file."""

IN_THE_TASK: list[Mistake] = [
    (
        TASK,
        "schema = 1",
        "schema = 2",
        r"arm_bot.toml:LINE: schema: 2 is not known.*write schema = 1",
    ),
    (TASK, "schema = 1", "", r":1: schema: missing; write schema = 1, the layout that"),
    (
        TASK,
        "there = {",
        "start = {",
        r":30: transitions.start: already written in line 29; drop one",
    ),
    (
        TASK,
        'kind = "resource", tokens = 1',
        'kind = "resource"',
        r":LINE: places.axis: it never holds a token; so .*start, .* can never fire, and .*fetch",
    ),
    (
        TASK,
        'kind = "resource", tokens = 1',
        'kind = "resource", tokens = 9000000000',
        r":LINE: places.axis.tokens: expected at most 1,000,000,000 tokens, got 9000000000",
    ),
    (TASK, "[task]", "[tsk]", r":LINE: tsk: unknown key.*did you mean 'task'\?"),
    (TASK, 'final = "parts == 0"', "", r":5: task.final: missing; give a text"),
    (TASK, '"parts == 0"', '"part == 0"', r":LINE: task.final: in 'part == 0'.*'part'.*parts"),
    (
        TASK,
        "grip:normal",
        "grip:success",
        r"none of normal, .*; write grip:normal, and when = \"grip.status == 'success'\"",
    ),
    (TASK, '"parts == 0"', '"parts = 0"', r":LINE: task.final: .* at column 7 of 'parts = 0'"),
    (
        TASK,
        'name = "arm_bot"',
        'name = "arm_bot',
        r":LINE: not valid TOML: the quote in column 8 is not closed; cl",
    ),
    (
        TASK,
        '"parts == 0"',
        '"parts - 1 == 0"',
        r":LINE: .*'-' has no meaning .*computes nothing; let",
    ),
    (TASK, '"parts == 0"', "0", r":LINE: task.final: 0 is not a text; give a text"),
    (
        TASK,
        '["delivered"]',
        '["deliverd"]',
        r"goal_transitions: unknown transition 'deliverd'.*deliv",
    ),
    (TASK, '["delivered"]', '"delivered"', r":LINE: task.goal_transitions: .* is not a list"),
    (TASK, 'runs_place = "parts"', 'runs_place = "axis"', r":LINE: .*a control place, got 'axis'"),
    (TASK, 'to = "broken"', 'to = "brokn"', r":LINE: errors.to: 'brokn' is not a place.*'broken'"),
    (
        TASK,
        "deadline = 8.0",
        "deadline = 0",
        r":LINE: .*above 0 and at most 1e\+09 s, got 0 s; give",
    ),
    (TASK, "deadline = 8.0", "deadline = 1e300", r":LINE: .*at most 1e\+09 s, got 1e\+300 s; give"),
    (
        TASK,
        "deadline = 8.0",
        'deadline = "8 s"',
        r":LINE: .*deadline: '8 s' is not a number; give a",
    ),
    (TASK, "deadline = 8.0", "deadline = nan", r":LINE: .*expected a finite number, got nan"),
    (
        TASK,
        "deadline = 8.0",
        "deadline = 8.0, estimates = { move = { mean = 2.0 } }",
        r":LINE: .*estimates.move: unknown key; known here: error, failure, success",
    ),
    (
        TASK,
        "deadline = 8.0",
        "dedline = 8.0",
        r":LINE: .*dedline: unknown key; did you mean 'deadli",
    ),
    (
        TASK,
        "move = {",
        'move = { alternatives = ["mov"],',
        r":LINE: .*no node offers the action 'mov'.*'move'[^|]*add \[act",
    ),
    (
        TASK,
        "move = {",
        "move = { alternatives = [],",
        r":LINE: primitive_tasks.move.alternatives: it has no action; name at",
    ),
    (TASK, "tokens = 3", "tokens = -3", r":LINE: places.parts.tokens: expected 0 or more.*got -3"),
    (TASK, "tokens = 3", "tokens = 3.5", r":LINE: places.parts.tokens: 3.5 is not a whole number"),
    (
        TASK,
        "tokens = 3",
        "tokens = 3, capacity = 2",
        r":LINE: .*capacity of at least 3, got 2; raise",
    ),
    (
        TASK,
        'kind = "control"',
        'kind = "counter"',
        r":LINE: .*'counter' is none of action, .*control",
    ),
    (
        TASK,
        'kind = "action", tries',
        'task = "grip", tries',
        r":LINE: .*kind: missing.*write kind =",
    ),
    (TASK, '"action", tries', '"action", task = "gripp", tries', r":LINE: .*'gripp'.*mean 'grip'"),
    (TASK, "tries = 3", "tries = 0", r":LINE: places.grip.tries: 0 tries; give 1 or more"),
    (TASK, "tries = 3", "tries = 101", r":LINE: places.grip.tries: 101 tries; .* at most 100; for"),
    (
        TASK,
        "[places]",
        '[events]\nshut = { by = "grip", memory = "latched" }\n\n[places]',
        r"events.shut.memory: an internal event is kept as long as its run is active; drop",
    ),
    (
        TASK,
        "final_error",
        'prepare = "move"\nfinal_error',
        r":LINE: task.prepare: 'move' is an action, and not a service.*\[services.move\] in the",
    ),
    (
        TASK,
        "tries = 3",
        "timeout = 9.0",
        r":LINE: .*timeout: 9.0 s is longer than the deadline.*2.0 s",
    ),
    (
        TASK,
        'tries = 3, holds = "axis"',
        'holds = "axs"',
        r":LINE: .*'axs' is not a resource.*'axis'",
    ),
    (
        TASK,
        'tries = 3, holds = "axis"',
        'holds = "broken"',
        r":LINE: .*write kind = \"resource\" in places.broken",
    ),
    (
        TASK,
        '[errors]\nto = "broken"',
        "",
        r":23: places.fetch: no outgoing arc `error`[^|]*\[errors\] to = ",
    ),
    (TASK, '["grip:normal"]', '["grip"]', r":LINE: .*its arc must say when.*write grip:normal"),
    (TASK, '["grip:normal"]', '["grip:success"]', r":LINE: .*'success' is none of normal, error"),
    (TASK, '["grip:normal"]', '["grab:normal"]', r":LINE: .*unknown place 'grab'"),
    (
        TASK,
        'out = ["carry"]',
        'out = "carry"',
        r":LINE: transitions.gripped.out: 'carry' is not a list",
    ),
    (TASK, 'out = ["carry"]', 'out = ["carry"], when = "bin == 1"', r":LINE: .*'bin'"),
    (
        TASK,
        'out = ["carry"]',
        'out = ["carry"], event = "button"',
        r":LINE: .*unknown event 'button'",
    ),
    (
        TASK,
        'out = ["carry"]',
        'out = ["carry"], set = { n = 1 }',
        r":LINE: .*'n' is not a variable",
    ),
    (TASK, "lost = { in", "lost = in", r"arm_bot.toml:LINE: not valid TOML: "),
    (
        TASK,
        "broken = {}",
        "broken = { # don't\n}",
        r":LINE: not valid TOML: the brace in column 10 is not",
    ),
    (
        TASK,
        'tries = 3, holds = "axis"',
        "listen = True",
        r":LINE: not valid TOML: True is Python; write true or false",
    ),
    (
        TASK,
        'out = ["grip"]',
        'out = ["grip"], when = "fetch.status == success"',
        r":LINE: .*when: .*'success' is unknown at column 17; a text is written in quotes: 'succ",
    ),
    (
        TASK,
        "start = { ",
        'start = { when = "axis == 1", ',
        r":LINE: .*'axis' is unknown at column 1; tokens are tested by arcs: in = \[\"axis\"\], or",
    ),
    (
        TASK,
        "start = { ",
        'start = { when = "fast", ',
        r":LINE: .*'fast' is unknown at column 1; it may read carry.executed, carry.reason, ",
    ),
    (
        TASK,
        'kind = "action", tries',
        "kind = action, tries",
        r":LINE: not valid TOML: action is a text without quotes; write \"action\"",
    ),
    (
        TASK,
        '["grip:error"] }',
        """["grip:error"], when = "grip.reason != 'sliped'" }""",
        r":LINE: transitions.lost.when: no action of grip ends with the cause 'sliped'.*'slipped'",
    ),
    (
        TASK,
        '["carry:normal"] }',
        '["carry:normal", nothing] }',
        r":LINE: not valid TOML: nothing is a text without quotes",
    ),
    (
        TASK,
        "args = { to = 0.2 }",
        "args = { speed = 0.2 }",
        r":LINE: .*'move' has no argument 'speed'; it has: to",
    ),
    (
        TASK,
        '{ in = ["carry:normal"] }',
        '{ in = ["carry:error"] }',
        r":26: places.carry: no outgoing arc `normal`",
    ),
]

IN_THE_CELL: list[Mistake] = [
    (CELL, 'node = "pc"', 'node = "pcc"', r"services.toml:LINE: devices.axis.node: .*'pcc'.*'pc'"),
    (
        CELL,
        "arm_bot:Axis",
        "arm_bot:Axes",
        r":LINE: devices.axis.driver: .*no 'Axes'; did you mean 'Axis'",
    ),
    (
        CELL,
        'move", device = "axis"',
        'move", node = "pc"',
        r":LINE: actions.move: uses ctx.command \(arm_bot.py:\d+\) and has no device; write",
    ),
    (CELL, "arm_bot:Axis", "armbot:Axis", r":LINE: .*no module 'armbot' on this host; install"),
    (
        CELL,
        'arm_bot:Axis"',
        "arm_bot:Axis",
        r":LINE: not valid TOML: the quote in column 32 is not",
    ),
    (
        CELL,
        "move = { run",
        "move = {\n run",
        r":LINE: not valid TOML: the brace in column 8 is not closed in its line; write all of it",
    ),
    (CELL, "arm_bot:Axis", "arm_bot.Axis", r":LINE: .*write an import path \"module:Class\""),
    (CELL, "arm_bot:Axis", "arm_bot:move", r":LINE: .*is not a class; a driver is a class derived"),
    (
        CELL,
        "speed = 0.5",
        'speed = "fast"',
        r":LINE: devices.axis.top_speed: expected a number above 0 \(m/s\), found 'fast'",
    ),
    (
        CELL,
        "speed = 0.5",
        "speed = 0",
        r":LINE: devices.axis.top_speed: expected a number above 0 \(m/s\), found 0",
    ),
    (
        CELL,
        "speed = 0.5",
        "sped = 0.5",
        r":LINE: devices.axis.top_sped: unknown key; did you mean 'top_speed'",
    ),
    (
        CELL,
        "top_speed = 0.5",
        "max_speed = 0.5",
        r":LINE: devices.axis.max_speed: unknown key; did you mean 'top_speed'",
    ),
    (CELL, "top_speed = 0.5", "speed = nan", r":LINE: .*the normal speed, found nan"),
    (CELL, "top_speed = 0.5", "top_speed = inf", r":LINE: .*above 0 \(m/s\), found inf"),
    (
        CELL,
        "top_speed = 0.5",
        "top_speed = 2024-01-01",
        r":LINE: devices.axis.top_speed: a date is not plain data; write it in quotes",
    ),
    (CELL, "top_speed = 0.5", "limit = 1", r"axis.limit: unknown key; known: top_speed, length"),
    (
        CELL,
        "[actions]",
        '[streams.speed]\nto = "axis"\nperiod = 100\n[actions]',
        r":11: streams.speed.period: 100 s between two set points; 0.05 would be 50 ms",
    ),
    (
        CELL,
        'run = "arm_bot:grip"',
        'run = "arm_bot:grip", args = { slips = "three" }',
        r"services.toml:LINE: actions.grip.args.slips: .* expects slips: float, found 'three'",
    ),
    (
        CELL,
        'run = "arm_bot:grip"',
        'run = "arm_bot:grip", args = { force = 1 }',
        r":LINE: actions.grip.args: grip has no argument 'force'; known: slips",
    ),
    (
        CELL,
        "arm_bot:grip",
        "arm_bot:gripp",
        r":LINE: actions.grip.run: .*no 'gripp'; did you mean 'gri",
    ),
    (
        CELL,
        "grip = {",
        "move = {",
        r":LINE: actions.move: already written in line 10; drop one of the two, or rename it",
    ),
    (CELL, "[actions]", "[action]", r":LINE: action: .*did you mean 'actions'"),
    (
        CELL,
        "port = 7501",
        "port = 75010",
        r":LINE: nodes.pc.port: is 75010; write a port from 1 to",
    ),
    (
        CELL,
        'run = "arm_bot:grip"',
        'run = "arm_bot:grip", args = { slip = 1 }',
        r":11: .*no argument 'slip'; did you mean",
    ),
    (
        CELL,
        "arm_bot:Axis",
        "arm_bot.py:Axis",
        r":LINE: .*a module is named without .py: .*'arm_bot:",
    ),
    (
        CELL,
        "[actions]",
        '[services]\nmemory = { node = "pc", run = "arm_bot:grip" }\n[actions]',
        r"services.memory.run: is built in, and actions use it by `ctx.get` and .*; drop it, or",
    ),
    (CELL, "arm_bot:grip", "random:grip", r":LINE: .*'random' is Python's own module"),
]

IN_THE_CODE: list[Mistake] = [
    (
        CODE,
        "    def step(",
        "    async def step(",
        r":7: devices.axis.driver: `step` of Axis is `async`: .*; write `def step`",
    ),
    (
        CODE,
        "def step(self, now: float)",
        "def step(self)",
        r":7: devices.axis.driver: `step` of Axis \(arm_bot.py:\d+\) takes \(self\), but is ca",
    ),
    (
        CODE,
        "async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:\n",
        "def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:\n"
        "    yield 0.3\n    return success()\n\n\n"
        "async def other(ctx: Context[Remote], *, slips: float = 0.2) -> Result:\n",
        r"arm_bot.py:\d+: `yield` makes grip a generator, which does nothing; report progress by",
    ),
    (
        CODE,
        "    return success()",
        "    return late(ctx)\n\n\nasync def late(ctx: Context[Remote]) -> Result:\n"
        "    return success()",
        r"arm_bot.py:\d+: `return late\(...\)` without `await` does nothing; write `return aw",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        "await ctx.progress(0.5)",
        r"arm_bot.py:\d+: `await ctx.progress\(0.5\)`: it returns at once; write it without `awa",
    ),
    (CODE, "return {", "{", r"arm_bot.py:\d+: `state` of Axis returns nothing; write `return`"),
    (CODE, "return self.at ==", "self.at ==", r"`stopped` of Axis returns nothing; write"),
    (CODE, "def step(", "def steps(", r"`steps` of Axis is never called; did you mean `step`"),
    (
        CODE,
        'top_speed: float = key(0.5, "m/s", above=0)',
        "top_speed: float = 0.5",
        r":7: .*Axis does not read it; write top_speed = key\(0.5\) in the class",
    ),
    (
        CODE,
        "grip(ctx: Context[Remote], *, slips: float",
        "grip(slips: float",
        r"arm_bot.py:\d+: grip takes no context; its first parameter is `ctx`, found 'slips'",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        "import asyncio; await asyncio.sleep(0.3)",
        r"arm_bot.py:\d+: asyncio.sleep does not work in an action; write `await ctx.sleep",
    ),
    (
        CODE,
        "most = self.speed *",
        "most = self.speeed *",
        r"arm_bot.py:\d+: `self.speeed` is set nowhere; did you mean `self.speed`\?",
    ),
    (
        CODE,
        "self.goal = self.at\n",
        'self.ports.raise_evnt("stopped")\n',
        r"arm_bot.py:\d+: `self.ports` has no `raise_evnt`; did you mean `self.ports.raise_event`",
    ),
    (
        CODE,
        "    return success()",
        '    return {"held": True}',
        r"arm_bot.py:\d+: `return {'held': True}` is not a result; write `return success\(\)`",
    ),
    (
        CODE,
        "return error(",
        "raise error(",
        r"arm_bot.py:\d+: `raise error\(.*\)`: a result is returned; write `return`",
    ),
    (
        CODE,
        'ctx.random("grip")',
        "ctx.random()",
        r"arm_bot.py:\d+: `ctx.random\(\)`: missing a required .* it is `ctx.random\(purp",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        'count = ctx.get("held", 0)\n    await ctx.put("held", count + 1)',
        r"arm_bot.py:\d+: `ctx.get` does nothing without `await`",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        'ctx.publish("speed", slips)\n    await ctx.sleep(0.3)',
        r"arm_bot.py:\d+: `ctx.publish\('speed', slips\)`: set points are a list of numbers",
    ),
    (
        CODE,
        "period = 0.01",
        "period = 0",
        r":LINE: devices.axis.driver: Axis.period: .*above 0.*found 0",
    ),
    (
        CODE,
        "    length: float = key(",
        "    limit: float = key(1.0)\n    length: float = key(",
        r":7: devices.axis.limit: Axis declares the key 'limit', which has another .*; rename",
    ),
    (
        CODE,
        "    length: float = key(",
        "    ports: str = key('x')\n    length: float = key(",
        r":7: devices.axis.ports: Axis declares the key 'ports'.*such as own_ports",
    ),
    (
        CODE,
        '"dry_run", "pause")',
        '"dry_run", "puase")',
        r":7: devices.axis.driver: Axis.obeys: expected some of dry_run, pause, .*; found 'puase'",
    ),
    (
        CODE,
        "    period = 0.01",
        "    # period = 0.01",
        r":LINE: devices.axis.driver: Axis has `step` and no period: it is never called; wri",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        'await ctx.put("parts", 1)',
        r"arm_bot.py:\d+: the global memory is on no node; write \[services.memory\] node = \"pc\"",
    ),
    (
        CODE,
        "class Axis(Driver):",
        "class Axis:",
        r":LINE: .*Axis has no hold|close.*derive it from petrobot.Dr",
    ),
    (
        CODE,
        "    def stop(self, now: float) -> None:\n        self.goal = self.at\n",
        "",
        r":7: devices.axis.driver: Axis has command, stopped, but no stop: .* write both",
    ),
    (
        CODE,
        'obeys = ("speed", "workspace", "dry_run", "pause")',
        'obeys = "speed"',
        r":7: .*Axis.obeys: expected a tuple, found 'speed'; write obeys = \(\"speed\",\)",
    ),
    (
        CODE,
        "    def setup(self) -> None:\n",
        "    def __init__(self, config: Any, ports: Any) -> None:\n",
        r":7: .* Axis does not call the one of Driver, .* top_speed, length, .*or write `setup`",
    ),
    (
        CODE,
        "period = 0.01",
        "period = 50",
        r"arm_bot.py:\d+: Axis.period is 50 s between two steps",
    ),
    (
        CODE,
        'if ctx.random("grip").random()',
        "import random\n    if random.random()",
        r"arm_bot.py:\d+: random.random does not use the seed: .*draw from `ctx.random",
    ),
    (
        CODE,
        'if ctx.random("grip").random()',
        "import random\n    if random.Random().random()",
        r"arm_bot.py:\d+: random.Random does not use the seed: .*draw from `ctx.random",
    ),
    (
        CODE,
        '"dry_run", "pause")',
        '"pause")',
        r"note    services.toml: --dry-run is refused: the drivers of axis do not obey it",
    ),
    (
        CODE,
        "async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:\n",
        "async def settle(ctx: Context[Remote]) -> bool:\n    return False\n\n\n"
        "async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:\n"
        "    if not settle(ctx):\n        return success()\n",
        r"arm_bot.py:\d+: `settle` does nothing without `await`; write `await settle",
    ),
    (
        CODE,
        'ctx.command({"to": to})',
        'ctx.command({"to": to}, until="arived")',
        r"arm_bot.py:\d+: the state of Axis has no 'arived'.*mean 'arrived'.*returns arrived",
    ),
    (
        CODE,
        'await ctx.command({"to": to})',
        'seen = await ctx.command({"to": to})\n    print(seen["a"])',
        r"arm_bot.py:\d+: the state of Axis has no 'a'.*its `state` returns arrived, at",
    ),
    (CODE, "import Context, Driver,", "import Contxt, Driver,", r":LINE: .*'Contxt'|cannot import"),
    (
        CODE,
        "await ctx.command({",
        "ctx.command({",
        r"arm_bot.py:\d+: `ctx.command` does nothing without `await`",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        "ctx.sleep(0.3)",
        r"arm_bot.py:\d+: `ctx.sleep` does nothing without",
    ),
    (
        CODE,
        "await ctx.command({",
        "await ctx.comand({",
        r"warning arm_bot.py:\d+: `ctx` has no `comand`; did you mean `ctx.command`",
    ),
    (
        CODE,
        "if not await ctx.wait(",
        "if not ctx.wait(",
        r"arm_bot.py:\d+: `ctx.wait` does nothing",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        "await ctx.call('grip', 1.0)",
        r"arm_bot.py:\d+: the result of `ctx.call` is dropped[^|]*`ctx.put`",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        "import time; time.sleep(0.3)",
        r"arm_bot.py:\d+: time.sleep stops everyth",
    ),
    (
        CODE,
        "async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:\n",
        "def vendor():\n    import time\n\n    time.sleep(0.3)\n\n\n"
        "async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:\n    vendor()\n",
        r"arm_bot.py:\d+: time.sleep: while it waits, its action can neither be paused",
    ),
    (
        CODE,
        "    def step(self, now: float) -> None:\n",
        "    def step(self, now: float) -> None:\n        import time; time.sleep(0.02)\n",
        r"arm_bot.py:\d+: time.sleep in `step`: the driver misses its cycles",
    ),
    (
        CODE,
        "*, to: float)",
        "*, goal: float)",
        r":LINE: places.fetch.args.to: .*'move' has no argument 'to'",
    ),
    (
        CODE,
        "*, to: float)",
        "*, to: float, fast: bool)",
        r":LINE: .*'move' needs the argument 'fast'.*give args",
    ),
    (CODE, "*, to: float)", "*, to: str)", r":LINE: .*'move' expects to: str, found 0.2"),
    (
        CODE,
        '"blocked"',
        '"jammed"',
        r"error_causes.blocked: no action of move returns the error 'blocked'",
    ),
    (CODE, '"blocked"', '"jammed"', r"error_causes: its actions also return jammed.*declare each"),
    (
        CODE,
        "await ctx.sleep(0.3)",
        'ctx.publish("speed", [1.0])',
        r"arm_bot.py:\d+: the stream 'speed' is not",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        'ctx.raise_event("shut")',
        r"arm_bot.py:\d+: 'grip' raises the event 'shut'",
    ),
    (
        CODE,
        "class Axis",
        "raise SystemExit(3)\n\n\nclass Axis",
        r":LINE: .*importing it ended the process|SystemExit",
    ),
    (CODE, "class Axis", "import nothere\n\n\nclass Axis", r"imports 'nothere' \(arm_bot.py:9\)"),
    (CODE, "class Axis", "1 / 0\n\n\nclass Axis", r"ZeroDivisionError: .* \(arm_bot.py:9\); corr"),
    (
        CODE,
        'key(1.0, "m, from',
        'key("one", "m, from',
        r":7: devices.axis.length: expected a number .*, found the default 'one' of its `key`",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        'lamp = await ctx.call("lamp", 1.0)',
        r"arm_bot.py:\d+: there is no service 'lamp'.*declare \[services.lamp\]",
    ),
    (
        CODE,
        "await ctx.sleep(0.3)",
        "await ctx.sleep(30)",
        r"arm_bot.py:\d+: `ctx.sleep` lasts 30 s, longer than the deadline of grip \(2 s\)",
    ),
    (
        CODE,
        '{"at": self.at,',
        '{"at": {self.at},',
        r"`state` of Axis contains a set, which is not plain data; write a list",
    ),
    (
        CODE,
        "error, key, success",
        "error, key",
        r"arm_bot.py:\d+: `success` is not defined; write `from petrobot import success`",
    ),
    (
        CODE,
        "return success(at=",
        "return success(at=at, was=",
        r"arm_bot.py:\d+: `at` is not defined; .* it",
    ),
    (
        CODE,
        "    return success()",
        "    return success(was=mine)\n\n\ndef other() -> int:\n    mine = 1\n    return mine",
        r"arm_bot.py:\d+: `mine` is not defined; .* it",
    ),
    (
        CODE,
        "    return success()",
        "    await ctx.sleep(0.1)",
        r"arm_bot.py:\d+: grip returns no result here; end it with `return success\(\)`",
    ),
    (
        CODE,
        "    return success()",
        "    return True",
        r"arm_bot.py:\d+: `return True` is not a result; write `return success\(\)`",
    ),
    (
        CODE,
        "    return success()",
        "    return success",
        r"arm_bot.py:\d+: `return success` is not a result; write `return success\(\)`",
    ),
    (
        CODE,
        "return success()",
        "return success(True)",
        r"arm_bot.py:\d+: `success\(True\)`: its text is of type bool; write `success\(name",
    ),
    (
        CODE,
        'error("slipped", "the part slipped out")',
        "error()",
        r"`error\(\)`: missing a required argument: 'cause'; write `error\(\"cause\", \"text\"\)`",
    ),
    (
        CODE,
        "    await ctx.sleep(0.3)",
        "    end = ctx.now + 0.3\n    while ctx.now < end:\n        pass",
        r"arm_bot.py:\d+: this loop never ends, .* not even the clock; .*`await ctx.sleep",
    ),
    (
        CODE,
        'ctx.device.state["arrived"]',
        'ctx.device.state["arived"]',
        r"arm_bot.py:\d+: the state of Axis has no 'arived' \(did you mean 'arrived'.*returns arr",
    ),
    (
        CODE,
        'ctx.device.state["arrived"]',
        "ctx.device.arrived",
        r"arm_bot.py:\d+: `ctx.device` has no 'arrived'.*Axis runs in another process: .*`ctx.dev",
    ),
    (
        CODE,
        "async def grip(ctx: Context[Remote]",
        "class Saw(Driver):\n    pass\n\n\nasync def grip(ctx: Context[Saw]",
        r"services.toml:\d+: actions.grip.device: its `ctx` is a Context\[Saw\], .* driver is Axis",
    ),
    (
        CODE,
        "class Axis",
        "import os; os._exit(3)\n\n\nclass Axis",
        r":LINE: .*ended the process \(exit code 3\)",
    ),
]

READY = '[services.ready]\nnode = "pc"\nrun = "arm_bot:ready"\n\n'
ALONE = "def ready(ctx: Context, *, seed: int) -> Result:\n    return success()\n\n\n"
COMMANDED = '    await ctx.command({"to": to})\n'

MEMORISES = (CELL, "[actions]", '[services]\nmemory = { node = "pc" }\n\n[actions]', "")
STREAM = (CELL, "[actions]", '[streams]\nlamp = { to = "axis", period = 0.1 }\n\n[actions]', "")
SHOWS = 'ctx.publish("lamp", [1.0])'

EYE = "class Eye(Driver):\n    def look(self) -> int:\n        return 3\n\n\n"
SEEN = [
    (CODE, "class Axis", f"{EYE}class Axis", ""),
    (CELL, "[actions]", 'eye = { node = "pc", driver = "arm_bot:Eye" }\n\n[actions]', ""),
    (CELL, 'grip", device = "axis"', 'grip", device = "eye"', ""),
]

BOTH: list[tuple[list[Mistake], str]] = [
    (
        [*SEEN, (CODE, "await ctx.sleep(0.3)", "ctx.device.lok()", "")],
        r"arm_bot.py:\d+: `ctx.device` has no 'lok' \(did you mean 'look'\?\).*write it in Eye",
    ),
    (
        [
            (TASK, '"parts == 0"', '"part == 0"', ""),
            (CELL, "top_speed", "topspeed", ""),
        ],
        r"arm_bot.toml:\d+: task.final: .*\nservices.toml:\d+: devices.axis.topspeed: unknown key",
    ),
    (
        [
            (CELL, "port = 7501", "prt = 7501", ""),
            (CELL, "axis = {", "move = {", ""),
        ],
        r"services.toml:\d+: nodes.pc.prt: .*\nservices.toml:\d+: actions.move: the name is taken",
    ),
    *(
        (
            [MEMORISES, (CODE, "    return success()", f"    {one}", "")],
            r"arm_bot.py:\d+: `ctx.get` does nothing without `await`; write `await ctx.get",
        )
        for one in (
            'return success(parts=ctx.get("parts", 0))',
            'return success(parts=ctx.get("parts", 0) + 1)',
            'await ctx.put("parts", ctx.get("parts", 0))\n    return success()',
        )
    ),
    (
        [STREAM, (CODE, "await ctx.sleep(0.3)", 'ctx.publish("lamp", {"on": 1.0})', "")],
        r"`ctx.publish\('lamp', {'on': 1.0}\)`: .* write `ctx.publish\('lamp', \[...\]\)`",
    ),
    (
        [STREAM, (CODE, "await ctx.sleep(0.3)", 'ctx.publish("lamp", -1.7)', "")],
        r"`ctx.publish\('lamp', -1.7\)`: set points are a list of numbers; write",
    ),
    (  # what follows from an undefined name is not told
        [
            (TASK, "args = { to = 0.2 }", 'args = { to = 0.2 }, out = { at = "w" }', ""),
            (TASK, "[places]", '[variables.w]\ntype = "float"\n\n[places]', ""),
            (CODE, "return success(at", "return sucess(at", ""),
        ],
        r"^\S+: may not run because of arm_bot.py:\d+\n+error +arm_bot.py:\d+: `sucess` is not def",
    ),
    (
        [
            (TASK, '"action", tries', '"action", out = { width = "w" }, tries', ""),
            (TASK, "[places]", '[variables.w]\ntype = "float"\n\n[places]', ""),
        ],
        r"places.grip.out.width: no action of grip returns a value 'width'.*return it",
    ),
    (
        [
            (TASK, "[errors]", "[errors]", ""),
            (TASK, "final_error", 'prepare = "ready"\nfinal_error', ""),
        ],
        r":LINE: task.prepare: there is no service 'ready'.*declare \[services.ready\]",
    ),
    (
        [
            (TASK, "[errors]", 'prepare = "ready"\n\n[errors]', ""),
            (CELL, "[actions]", f"{READY}[actions]", ""),
            (CODE, "async def move", f"{ALONE}async def move", ""),
        ],
        r":LINE: task.prepare: 'ready' does not take runs.*write .* `ctx, \*, runs, seed`",
    ),
    (
        [
            (CELL, "top_speed = 0.5", "depth = 0.5", ""),
            (CODE, "top_speed: float = key", "depth: float\n    top_speed: float = key", ""),
        ],
        r":7: devices.axis.depth: Axis declares only its type; write depth: ... = key\(\) in",
    ),
    (
        [(CELL, "arm_bot:grip", "arm_bot:Axis", "")],
        r"actions.grip.run: 'arm_bot:Axis' is a class; name a function: an action is an `async`",
    ),
    (
        [(CELL, 'move", device = "axis"', 'move", node = "pc"', ""), (CODE, COMMANDED, "", "")],
        r"actions.move: uses ctx.device \(arm_bot.py:\d+\) and has no device; write",
    ),
]

WATCHES = [
    (
        TASK,
        "broken = {}\n",
        'broken = {}\nwatch = { kind = "action", task = "grip", tokens = 1, listen = true }\n',
        "",
    ),
    (
        TASK,
        "[transitions]\n",
        '[transitions]\nseen = { in = ["watch:normal"], out = ["watch"] }\n',
        "",
    ),
]

WIDTH = (TASK, '"action", tries', '"action", out = { width = "w" }, tries', "")
TYPED = '[variables.w]\ntype = "float"\n\n[places]'
MEMORY = '[services.memory]\nnode = "pc"\n\n[actions]'
READS = (CODE, "await ctx.sleep(0.3)", 'print(await ctx.get("part"))', "")


def by_cause(cause: str) -> Mistake:
    """Errors of `grip` are told apart by their cause."""
    lost = """lost = { in = ["grip:error"], when = "grip.reason == 'CAUSE'" }
others = { in = ["grip:error"], out = ["broken"], when = "grip.reason != 'CAUSE'" } #"""
    return (TASK, 'lost = { in = ["grip:error"] }', lost.replace("CAUSE", cause), "")


DOUBTED: list[tuple[list[Mistake], str, list[Mistake]]] = [
    (
        [by_cause("jammed")],
        r":\d+: transitions.lost.when: no action of grip ends with the cause 'jammed'",
        [(CODE, 'error("slipped"', 'error(ctx.device.state.get("fault", "slipped")', "")],
    ),
    ([by_cause("slipped")], "", []),
    ([by_cause("device_fenced")], "", []),
    (
        [(TASK, "move = { ", 'move = { cost = "value:way", ', "")],
        "primitive_tasks.move.cost: the action 'move' returns no value 'way'",
        [(CODE, "return success(at", "return success(way=1.0, at", "")],
    ),
    (
        [(CODE, "most = self.speed *", "most = self.speeed *", "")],
        "`self.speeed` is set nowhere",
        [(CODE, "top_speed: float = key", "speeed: float\n    top_speed: float = key", "")],
    ),
    (  # what a driver raises is no event of the action that names the driver as its device
        [
            (TASK, "[places]", "[events.full]\nearly = 'keep'\nmemory = 'latched'\n\n[places]", ""),
            (CODE, "self.goal = self.at\n", "self.ports.raise_event('full')\n", ""),
            (CODE, "async def grip(ctx: Context[Remote]", "async def grip(ctx: Context[Axis]", ""),
        ],
        "",
        [],
    ),
    ([*SEEN, (CODE, "await ctx.sleep(0.3)", "ctx.device.look()", "")], "", []),
    (
        WATCHES,
        r":\d+: places.watch: it listens, and its run keeps axis until .*: carry, fetch, grip wait",
        [(CELL, 'grip", device = "axis"', 'grip", node = "pc"', "")],
    ),
    (
        [
            (CODE, 'ctx.device.state["arrived"]', 'ctx.device.state["homed"]', ""),
            (CODE, '{"at": self.at,', '{**vars(self), "at": self.at,', ""),
        ],
        "",
        [],
    ),
    ([(CODE, "    return success()", "    await ctx.wait(lambda: False)", "")], "", []),
    (
        [
            WIDTH,
            (TASK, "[places]", TYPED, ""),
            (CODE, "return success()", 'return success(width="wide")', ""),
        ],
        r":\d+: places.grip.out.width: 'grip' gives width as str .* variable w is float",
        [(CODE, '"wide"', "1", "")],
    ),
    (
        [
            (TASK, "[places]", TYPED, ""),
            (TASK, "args = { to = 0.2 }", 'args = { to = { var = "w" } }', ""),
        ],
        r":\d+: variables.w: places.fetch.args reads it, but no run writes it .* w is none there",
        [(TASK, "args = { to = { var", 'out = { at = "w" }, args = { to = { var', "")],
    ),
    (
        [
            (TASK, "[places]", TYPED.replace('"float"', '"str"\ninitial = "0.2"'), ""),
            (TASK, "args = { to = 0.2 }", 'args = { to = { var = "w" } }', ""),
        ],
        r":\d+: places.fetch.args.to: .* expects to: float, found w, which is str",
        [(TASK, 'type = "str"\ninitial = "0.2"', 'type = "int"\ninitial = 0', "")],
    ),
    (
        [STREAM, (CODE, "    return success()", f"    {SHOWS}\n    return success()", "")],
        r":\d+: `ctx.publish\('lamp', \[1.0\]\)` just before `return` is not sent",
        [(CODE, f"    {SHOWS}\n", f"    {SHOWS}\n    await ctx.sleep(0.1)\n", "")],
    ),
    (
        [READS, (CELL, "[actions]", MEMORY, "")],
        r"arm_bot.py:\d+: no action or service writes 'part', so it is None",
        [(CODE, 'await ctx.command({"to": to})', 'await ctx.put("part", to)', "")],
    ),
    (
        [READS, (CELL, "[actions]", MEMORY, "")],
        r"no action or service writes 'part'",
        [(CODE, 'await ctx.command({"to": to})', 'await ctx.put(f"p{to}", to)', "")],
    ),
    (
        [READS, (CELL, "[actions]", MEMORY, "")],
        r"no action or service writes 'part'",
        [(CODE, 'await ctx.command({"to": to})', "print(ctx)", "")],
    ),
    (
        [(CODE, "await ctx.sleep(0.3)", "await ctx.sleep(LONG)\n    LONG = 1", "")],
        "",
        [(CODE, "class Axis", "LONG = 30.0\n\n\nclass Axis", "")],
    ),
]
"""Mistakes, the warning, and what makes it untrue: then `check` is silent. Some have no warning in
the first place."""

GRIPPED = (
    "when = \"grip.status == 'success'\" }\n"
    'slid = { in = ["grip:normal"], out = ["broken"], when = "grip.status == \'failure\'" }'
)

HELPER = (
    "async def close(ctx: Context[Remote]) -> None:\n    await ctx.sleep(0.3)\n\n\nasync def grip"
)

LATE = (
    "async def beyond(ctx: Context[Remote]) -> Result:\n    return success()\n\n\n"
    "late: Any = beyond\n\n\nasync def grip"
)

IN_THE_RUN: list[tuple[list[Mistake], int, str]] = [
    (
        [
            (CODE, "async def grip", HELPER, ""),
            (CODE, "  await ctx.sleep(0.3)\n    if", "  close(ctx)\n    if", ""),
        ],
        0,
        r"error +grip#\d, grip on pc for grip: exception:.*'close' was never awaited in grip \("
        r"arm_bot.py:\d+\): it did nothing.*only 0 of 3 goals were met; the exit code is 0 because",
    ),
    (  # and Python's own warning is not shown beside it
        [
            (CODE, "async def grip", LATE, ""),
            (CODE, "    await ctx.sleep(0.3)\n    if", "    return late(ctx)\n    if", ""),
        ],
        0,
        r"\A(?!.*never awaited).*bad_result: returned beyond\(...\) without `await`; write `return",
    ),
    (
        [(CODE, "await ctx.sleep(0.3)", "ctx.sleep(0.3)", "")],
        0,
        r"'wait' or 'sleep' of the context was never awaited in grip \(arm_bot.py:\d+\): it did",
    ),
    (
        [(CODE, 'lambda: ctx.device.state["arrived"]', 'ctx.device.state["arrived"]', "")],
        1,
        r"ctx.wait: expected a function, as in `ctx.wait\(lambda: ...\)`, found \w+ in move \(arm",
    ),
    (
        [(CODE, 'ctx.command({"to": to})', "ctx.device.go(to)", "")],
        1,
        r"'go' in move \(arm_bot.py:\d+\); its driver runs in another process: .*command.*state",
    ),
    (
        [
            (
                CODE,
                "        self.at = self.goal",
                "        self.ports.serial('x', 1)\n        self.at = self.goal",
                "",
            )
        ],
        2,
        r"^petrobot run: services.toml: devices.axis: lock step has no line .* real time, or",
    ),
    (
        [(CODE, "return {", "{", "")],
        3,
        r"state: expected a dict, found a NoneType, returned by `state` \(arm_bot.py:\d+\)",
    ),
    (
        [(CODE, "    def command(", "    async def command(", "")],
        2,
        r"devices.axis: arm_bot:Axis refuses it: `command` of Axis is `async`: .* write `def comm",
    ),
    (
        [(CODE, "if not self.paused:", "1 / 0\n        if not self.paused:", "")],
        3,
        r"node pc: device axis: its driver failed: ZeroDivisionError.* in step \(arm_bot.py:\d+\)",
    ),
    (
        [(CODE, '{"at": self.at,', '{"at": self,', "")],
        3,
        r"device axis: .*state.at: a Axis is not plain data, returned by `state` \(arm_bot.py:\d+",
    ),
    (
        [(CODE, "await ctx.sleep(0.3)", 'await ctx.sleep(float("nan"))', "")],
        0,
        r"ctx.sleep: expected a number of seconds, found nan in grip \(arm_bot.py:\d+\)",
    ),
    (
        [
            (TASK, "[places]", '[variables.w]\ntype = "str"\n\n[places]', ""),
            (TASK, "args = { to = 0.2 }", 'args = { to = 0.2 }, out = { at = "w" }', ""),
        ],
        0,
        r"fetch#1 \(move\) gave 0.2, which is no str for .at.; variable w is none",
    ),
    (
        [
            (CODE, "import Context,", "import failure, Context,", ""),
            (CODE, 'return error("slipped"', 'return failure("slipped"', ""),
            (CODE, "< slips", "< 1.0", ""),
            (TASK, 'out = ["carry"] }', f'out = ["carry"], {GRIPPED}', ""),
        ],
        1,
        r"given up: broken.*failure +grip#1, grip on pc for grip: slipped: the part slipped out",
    ),
    (
        [(CODE, "period = 0.01", "period = 10", "")],
        1,
        r"the driver has published nothing for \d.\d s \(does it block, or is its `period` not in",
    ),
]
"""Mistakes that only a run shows, its exit code, and what its end says."""

ON_THE_LINE: list[tuple[list[str], str]] = [
    (["run", "arm_bt.toml"], r"arm_bt.toml: file: cannot be read: No .*mean 'arm_bot.toml'"),
    (["check", "services.toml"], r"file: this is a location file, not a task; name the task"),
    (["log", "last"], r"no run 'last'; /.*/arm_bot/runs holds no run; change to the folder where"),
    (
        ["check", "arm_bot.py"],
        r"no task 'arm_bot.py': this is a module; name the .toml file of the",
    ),
    (
        ["run", "--mode", "fast"],
        r"^petrobot run: argument --mode: .*realtime.*--help shows its op",
    ),
    (["check", "."], r"no task '.': this is a folder; name the .toml file of the task"),
    (["analyse", "queue.net"], r"^petrobot analyse: queue.net: no such file$"),
    (["run", "armbot"], r"no task 'armbot': give a .toml file, or a task that comes with petrobot"),
    (
        [*RUN, "--runs", "1000000000"],
        r"--runs: 1000000000 is more than the largest number, 1000000",
    ),
    (
        [*RUN, "--seed", "9" * 30],
        r"--seed: 9+ is more than the largest number, 9223372036854775807",
    ),
    (
        ["analyse", "arm_bot.toml", "--memory", "9" * 30],
        r"--memory: 9+ is more than the largest number, 1000000000",
    ),
    ([*RUN, "--set", "speed=1"], r"speed"),
    ([*RUN, "--use", "grip=grab"], r"grab.*grip"),
    ([*RUN, "--services", "cell.toml"], r"cell.toml: No such file"),
    (["start", "arm_bot.toml"], r"unknown command 'start' \(did you mean 'run' or 'up'\?\)"),
    (["arm_bot.toml"], r"unknown command .* \(did you mean 'run arm_bot.toml'\?\)"),
    (["rum", "arm_bot.toml"], r"unknown command 'rum' \(did you mean 'run'\?\)"),
    (["run", "arm_bot"], r"no task 'arm_bot': did you mean arm_bot.toml\?"),
    (["show", TASK, "--out", "x.pdf"], r"--out x.pdf: expected a file .svg or .png, found .pdf"),
    (
        ["new", "robot", "arm_bot", "--folder", ".."],
        r"named 'arm_bot' is there already|exists already",
    ),
]


@pytest.fixture(autouse=True)
def _one_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modules are looked up beside the location file; remove those of earlier tests."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "arm_bot", raising=False)
    monkeypatch.setattr(cell_code, "_ask_process", _read_once)


_read: dict[object, tuple[list[cell_code.Facts], str]] = {}


def _read_once(
    question: str, seconds: float, read: Reader = cell_code._ask_process
) -> tuple[list[cell_code.Facts], str]:
    """Read the same code for the same question only once: most mistakes are in other files, and to
    read it takes a process. The files of each test are in a folder of its own."""
    here = str(Path.cwd())
    texts = tuple((p.name, p.read_bytes()) for p in sorted(Path().glob("*.py")))
    key = (question.replace(here, "."), seconds, texts)
    if (known := _read.get(key)) is None:
        known = read(question, seconds)
        if here not in repr(known):
            _read[key] = known
    return copy.deepcopy(known)


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the files of a robot without a mistake, as `petrobot new robot` writes them, with a
    driver that is written out."""
    folder = tmp_path_factory.mktemp("sound")
    with redirect_stdout(io.StringIO()):
        assert main(["new", "robot", "arm_bot", "--folder", str(folder)]) == 0
    files = {p.name: p.read_text(encoding="utf-8") for p in (folder / "arm_bot").iterdir()}
    files = {name: text.replace("Slide", "Axis") for name, text in files.items()}
    files[TASK] = files[TASK].replace(
        "move = { deadline = 8.0 }             # s",
        'move = { deadline = 8.0, error_causes = { blocked = "something is in the way" } }',
    )
    longhand = Path(__file__).with_name("longhand.py").read_text(encoding="utf-8")
    return files | {CODE: longhand}


def said(*arguments: str) -> tuple[int, str]:
    """Run a command; return exit code and all its output."""
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(out):
        code = main(list(arguments))
    return code, out.getvalue()


def damaged(sound: dict[str, str], mistakes: list[Mistake], folder: Path) -> None:
    """Write the robot with the mistakes into a folder."""
    files = dict(sound)
    for name, old, new, _ in mistakes:
        assert old in files[name], f"{old!r} does not stand in {name}"
        files[name] = files[name].replace(old, new, 1)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


def expect(pattern: str, arguments: list[str], code: int | None = 2) -> None:
    """Check that the command prints this as one message without a traceback."""
    found, words = said(*arguments)
    assert code is None or found == code, words
    lines = re.sub(r" *\n {9,}", " ", words)  # the rest of a long line
    assert re.search(pattern, lines.replace("\n        ", "; "), re.DOTALL), words
    assert "Traceback" not in words, words


WARNINGS = (
    "its `ctx` is a Context",
    "expects to: str",
    "expects slips: float",
    "between two set points",
    "lasts 30 s",
    "no service 'lamp'",
    "no action of move returns",
    "also return jammed",
    "raises the event",
    "is dropped",
    "time.sleep in `step`",
    "time.sleep: while",
    "period is 50",
    "does not use the seed",
    "--dry-run is refused",
    "`steps` of",
    "asyncio.sleep",
    "has no `comand`",
    "has no `raise_evnt`",
    "is set nowhere",
)


@pytest.mark.processes
@pytest.mark.parametrize(
    "mistake", [*IN_THE_TASK, *IN_THE_CELL, *IN_THE_CODE], ids=lambda m: m[2][:40]
)
def test_each_mistake_is_reported(
    sound: dict[str, str], mistake: Mistake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, old, _, pattern = mistake
    damaged(sound, [mistake], tmp_path)
    monkeypatch.chdir(tmp_path)
    line = sound[name].partition(old)[0].count("\n") + 1 if name != CODE else r"\\d+"
    is_warning = any(words in pattern for words in WARNINGS)
    expect(re.sub("LINE", str(line), pattern), CHECK, 0 if is_warning else 2)


@pytest.mark.processes
@pytest.mark.parametrize(("mistakes", "pattern"), BOTH, ids=lambda p: str(p)[-40:])
def test_mistakes_between_files_are_reported(
    sound: dict[str, str],
    mistakes: list[Mistake],
    pattern: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    expect(pattern.replace("LINE", r"\d+"), CHECK)


@pytest.mark.processes
@pytest.mark.parametrize(("mistakes", "told", "true"), DOUBTED, ids=lambda p: str(p)[-40:])
def test_a_warning_about_code_is_given_only_if_it_is_certain(
    sound: dict[str, str],
    mistakes: list[Mistake],
    told: str,
    true: list[Mistake],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    for edits, warned in ((mistakes, bool(told)), ([*mistakes, *true], False)):
        damaged(sound, edits, tmp_path)
        code, words = said(*CHECK)
        assert (code, "\nwarning" in words) == (0, warned), words
        assert not warned or re.search(told, re.sub(r"\n +", " ", words)), words


@pytest.mark.processes
@pytest.mark.parametrize(
    ("mistakes", "code", "pattern"), IN_THE_RUN, ids=lambda found: str(found)[:60]
)
def test_mistakes_that_a_run_shows_are_told_at_its_end(
    sound: dict[str, str],
    mistakes: list[Mistake],
    code: int,
    pattern: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    expect(pattern, RUN, code)


@pytest.mark.processes
@pytest.mark.parametrize(("arguments", "pattern"), ON_THE_LINE, ids=lambda a: " ".join(a[-2:])[:40])
def test_mistakes_on_the_command_line_are_reported(
    sound: dict[str, str],
    arguments: list[str],
    pattern: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "arm_bot"
    folder.mkdir()
    damaged(sound, [], folder)
    monkeypatch.chdir(folder)
    expect(pattern, arguments)


SUBNET: list[Mistake] = [  # used twice; an error in it has no branch
    (
        TASK,
        'grip = { kind = "action", tries = 3, holds = "axis" }',
        'grip = { kind = "macro", subnet = "hold", holds = "axis" }\n'
        'again = { kind = "macro", subnet = "hold", holds = "axis" }',
        "",
    ),
    (
        TASK,
        'out = ["carry"]',
        'out = ["again"] }\nheld = { in = ["again:normal"], out = ["carry"]',
        "",
    ),
    (
        TASK,
        'delivered = { in = ["carry:normal"] }\n',
        """delivered = { in = ["carry:normal"] }

[subnets.hold]
entry = "begin"
normal = "held"
error = "lost"

[subnets.hold.places]
begin = {}
close = { kind = "action", task = "grip" }
held = {}
lost = {}

[subnets.hold.transitions]
begun = { in = ["begin"], out = ["close"] }
closed = { in = ["close:normal"], out = ["held"] }
""",
        "",
    ),
]
NO_PLACE = (TASK, 'error = "lost"\n', "", "")
NOT_LOST = (TASK, 'lost = { in = ["grip:error"] }', "", "")
NO_BRANCH = r"arm_bot.toml:43: subnets.hold.places.close: no outgoing arc `error`"
USED = "await ctx.sleep(0.3)"
DRIVES = ("command", "stop", "stopped")
LETTERS = 'type = "str"\nvalues = ["a", "b"]\ninitial = "a"'
RAISED = 'self.ports.raise_event("button")\n        if not self.paused:'

OUTER = [
    *SUBNET,
    (
        TASK,
        "[subnets.hold.places]",
        '[subnets.hold.errors]\nto = "lost"\n[subnets.hold.places]',
        "",
    ),
]
AXIS = """class Axis(Rail):
    def state(self) -> Mapping[str, Any]:
        return {"at": self.at, "arrived": self.stopped()}"""
"""A driver that does not use what the class above it has."""

GIVEN = [
    *OUTER,
    (TASK, "[places]", '[variables.w]\ntype = "str"\n\n[places]', ""),
    (TASK, 'subnet = "hold",', 'subnet = "hold", args = { p = { var = "w" } },', ""),
    (
        TASK,
        'again = { kind = "macro", subnet = "hold",',
        'again = { kind = "macro", subnet = "hold", args = { p = { var = "w" } },',
        "",
    ),
    (
        TASK,
        "[subnets.hold.places]",
        '[subnets.hold.parameters]\np = "float"\n[subnets.hold.places]',
        "",
    ),
]
"""A variable that a subnet receives."""
SWAPPED = [*GIVEN, *2 * [(TASK, '{ var = "w" }', '"broken"', "")], (TASK, '"str"', '"float"', "")]
"""A place that it receives, and a variable that it reads."""

REMEDIES: list[tuple[list[Mistake], str, list[Mistake]]] = [
    (
        GIVEN,
        r"places.grip.args.p: w is str, and the parameter is float; change one of the types",
        [(TASK, 'type = "str"', 'type = "int"', "")],
    ),
    (
        [*GIVEN, (TASK, 'p = "float"', 'p = "variable"', "")],
        r"places.grip.args.p: expected a variable, found the value of 'w'; write \"w\"",
        [(TASK, '{ var = "w" }', '"w"', ""), (TASK, '{ var = "w" }', '"w"', "")],
    ),
    (
        [
            *SWAPPED,
            (TASK, 'p = "float"', 'p = "place"', ""),
            (TASK, 'task = "grip" }', 'task = "grip", args = { slips = { var = "p" } } }', ""),
        ],
        r"places.close.args.slips: 'p' is a place, which has no value; name a variable or another",
        [(TASK, 'var = "p"', 'var = "w"', "")],
    ),
    (
        [*GIVEN, (TASK, 'p = "float"', 'p = "place"', "")],
        r"places.grip.args.p: expected a place, found the value of 'w'; write the name of a place",
        [(TASK, '{ var = "w" }', '"broken"', ""), (TASK, '{ var = "w" }', '"broken"', "")],
    ),
    (  # `grip` holds the axis
        [*SUBNET, NO_PLACE],
        r"transitions.lost.in: 'grip' has no error exit; give subnets.hold an `error` place",
        [(TASK, 'normal = "held"', 'normal = "held"\nerror = "lost"', "")],
    ),
    (
        [*SUBNET, NO_PLACE, NOT_LOST],
        rf"{NO_BRANCH}[^|]*add to \[subnets.hold.transitions\] one with in = \[\"close:error\"\]",
        [
            (
                TASK,
                'out = ["held"] }',
                'out = ["held"] }\nx = { in = ["close:error"], out = ["lost"] }',
                "",
            )
        ],
    ),
    (
        [*SUBNET, NO_PLACE, NOT_LOST],
        rf"{NO_BRANCH}[^|]*error = ... in \[subnets.hold\]",
        [(TASK, 'normal = "held"', 'normal = "held"\nerror = "lost"', "")],
    ),
    (
        [
            *OUTER,
            (TASK, 'out = ["held"]', 'out = ["held", "done"]', ""),
            (TASK, "broken = {}", 'broken = {}\ndone = { kind = "control" }', ""),
        ],
        r"closed.out: unknown place 'done'; a subnet gets .*write done = \"place\" in \[sub",
        [
            (
                TASK,
                "[subnets.hold.places]",
                '[subnets.hold.parameters]\ndone = "place"\n[subnets.hold.places]',
                "",
            ),
            (TASK, 'subnet = "hold",', 'subnet = "hold", args = { done = "done" },', ""),
            (
                TASK,
                'again = { kind = "macro", subnet = "hold",',
                'again = { kind = "macro", subnet = "hold", args = { done = "done" },',
                "",
            ),
        ],
    ),
    (
        [(TASK, '[errors]\nto = "broken"', "", "")],
        r":23: places.fetch: no outgoing arc `error`[^|]*\[errors\] to = ",
        [(TASK, "[places]", '[errors]\nto = "broken"\n[places]', "")],
    ),
    (
        [(CODE, USED, 'ctx.raise_event("shut")', "")],
        r"raises the event 'shut', which[^|]*declare \[events.shut\] by = \"grip\"",
        [(TASK, "[places]", '[events.shut]\nby = "grip"\n[places]', "")],
    ),
    (
        [(CODE, USED, 'ctx.publish("speed", [1.0])', "")],
        r"the stream 'speed' is not declared; declare \[streams.speed\] in services.toml",
        [(CELL, "[actions]", '[streams.speed]\nto = "axis"\nperiod = 0.05\n[actions]', "")],
    ),
    (
        [
            (CELL, "[actions]", '[streams.speed]\nto = "axis"\nperiod = 0.05\n[actions]', ""),
            *((CODE, f"def {name}(", f"def own_{name}(", "") for name in DRIVES),
        ],
        r":\d+: devices.axis.driver: Axis follows set points, but has no stop, stopped: [^|]*both",
        [(CODE, f"def own_{name}(", f"def {name}(", "") for name in DRIVES[1:]],
    ),
    (
        [(CODE, USED, 'await ctx.put("parts", 1)', "")],
        r"memory is on no node; write \[services.memory\] node = \"pc\" in services.toml",
        [(CELL, "[actions]", '[services.memory]\nnode = "pc"\n[actions]', "")],
    ),
    (
        [(CODE, "*, to: float)", "*, to: float, fast: bool)", "")],
        r":24: .*needs the argument 'fast'[^|]*here or in \[actions.move\]",
        [(CELL, 'arm_bot:move"', 'arm_bot:move", args = { fast = true }', "")],
    ),
    (
        [(TASK, '"carry:normal"] }', '"carry:normal"], set = { n = 1 } }', "")],
        r"transitions.delivered.set.n: 'n' is not a variable; declare it in \[variables\]",
        [(TASK, "[places]", '[variables]\nn = { type = "int" }\n[places]', "")],
    ),
    *(
        (
            [
                (TASK, '"carry:normal"] }', f'"carry:normal"], set = {{ n = {wrong} }} }}', ""),
                (TASK, "[places]", f"[variables]\nn = {{ {kind} }}\n[places]", ""),
            ],
            rf"transitions.delivered.set.n: {told}",
            [(TASK, f"n = {wrong}", f"n = {right}", "")],
        )
        for kind, wrong, told, right in (
            ('type = "bool"', '"yes"', "'yes' is not a variable; write true or false", "true"),
            ('type = "bool"', "1", "1 is not of type bool; write true or false", "false"),
            ('type = "int"', '"three"', "'three' is not a variable; write a whole number", "3"),
            ('type = "str"', '"yes"', "'yes' is not a .*; texts stand in quotes: ", "\"'yes'\""),
            (
                'type = "str", values = ["a", "b"]',
                '"c"',
                "'c' is not a variable; write one of \"'a'\", \"'b'\"",
                "\"'b'\"",
            ),
        )
    ),
    (
        [
            (TASK, "[places]", f"[variables.w]\n{LETTERS}\n\n[places]", ""),
            (TASK, 'in = ["grip:normal"]', 'when = "w == \'A\'", in = ["grip:normal"]', ""),
        ],
        r"gripped.when: in .*, 'w' is never 'A' at column 6; it may be 'a', 'b'",
        [(TASK, "'A'", "'a'", "")],
    ),
    (
        [
            (TASK, '"action", tries', '"action", out = { wide = "width" }, tries', ""),
            (TASK, "[places]", '[variables.width]\ntype = "float"\n\n[places]', ""),
            (CODE, "return success()", "return success(width=0.1)", ""),
        ],
        r"grip.out.wide: no action of grip returns a value 'wide', but width .*write width = \"w",
        [(TASK, "wide =", "width =", "")],
    ),
    (
        [
            (TASK, "[places]", '[events.button]\nscope = "external"\n\n[places]', ""),
            (CODE, "if not self.paused:", RAISED, ""),
            (CODE, USED, 'ctx.raise_event("button")', ""),
        ],
        r"'grip' raises the event 'button', which is external: only a driver .*of another name, d",
        [
            (CODE, 'ctx.raise_event("button")', 'ctx.raise_event("shut")', ""),
            (TASK, "[places]", '[events.shut]\nby = "grip"\n[places]', ""),
        ],
    ),
    (
        [(TASK, 'kind = "action", tries', 'task = "grip", tries', "")],
        r"places.grip.kind: missing.*write kind = \"action\"",
        [(TASK, 'task = "grip"', 'kind = "action", task = "grip"', "")],
    ),
    (
        [(CODE, "    period = 0.01", "    # no period", "")],
        r"Axis has `step` and no period[^|]*write `period = 0.01`",
        [(CODE, "    # no period", "    period = 0.01", "")],
    ),
    (
        [(CODE, "return {", "{", "")],
        r"`state` of \w+ returns nothing",
        [
            (CODE, "class Axis(", "class Rail(", ""),
            (CODE, "async def move(", f"{AXIS}\n\n\nasync def move(", ""),
        ],
    ),
    (
        [
            *OUTER,
            (TASK, "[places]", '[variables.w]\ntype = "str"\n\n[places]', ""),
            (TASK, 'subnet = "hold",', 'subnet = "hold", args = { f = 3 },', ""),
            (
                TASK,
                'again = { kind = "macro", subnet = "hold",',
                'again = { kind = "macro", subnet = "hold", args = { f = 4 },',
                "",
            ),
            (
                TASK,
                "[subnets.hold.errors]",
                '[subnets.hold.parameters]\nf = "int"\n[subnets.hold.errors]',
                "",
            ),
            (TASK, "closed = {", "closed = { when = \"w == f or close.status == 'good'\",", ""),
        ],
        r"closed.when: in \"w == f or close.status == 'good'\", == at column 3 compares a str with",
        [(TASK, "w == f", "f == 3", ""), (TASK, "good", "success", "")],
    ),
    (
        [(CELL, 'move", device = "axis"', 'move", node = "pc"', "")],
        r"actions.move: uses ctx.command .*write device = ",
        [(CELL, 'move", node = "pc"', 'move", device = "axis"', "")],
    ),
    *(
        (
            [
                (CELL, 'grip", device = "axis"', 'grip", node = "pc"', ""),
                (CODE, USED, f"{USED}\n    print({used})", ""),
            ],
            r"actions.grip: uses ctx.device .*write device = ",
            [(CODE, f"    {USED}\n", f"    {asked}\n    {USED}\n", "")],
        )
        for used, asked in (
            ("ctx.device", "if ctx.device is None:\n        return success()"),
            ("ctx.device", "if not ctx.device:\n        return success()"),
            (
                "axis := ctx.device",
                "axis = ctx.device\n    if axis is None:\n        return success()",
            ),
        )
    ),
]
"""Mistakes, what is found with its remedy, and the remedy followed to the letter."""


@pytest.mark.processes
@pytest.mark.parametrize(("mistakes", "told", "mended"), REMEDIES, ids=lambda p: str(p)[-40:])
def test_a_finding_disappears_with_its_remedy(
    sound: dict[str, str],
    mistakes: list[Mistake],
    told: str,
    mended: list[Mistake],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And it is told once, however often a subnet is used."""
    monkeypatch.chdir(tmp_path)
    for edits, times in ((mistakes, 1), ([*mistakes, *mended], 0)):
        damaged(sound, edits, tmp_path)
        _, words = said(*CHECK)
        lines = re.sub(r"\n +", " ", words)
        assert len(re.findall(told, lines)) == times, words
        assert not times or len(re.findall(told.partition("[^|]")[0], lines)) == 1, words


@pytest.mark.parametrize("begun", [True, False])
def test_an_interrupted_run_says_how_it_is_continued(
    begun: bool,
    sound: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One that has not begun leaves nothing that could be continued."""

    async def ctrl_c(session: RunSession, options: argparse.Namespace) -> None:
        if not begun:
            await session.abandon()
        raise KeyboardInterrupt

    damaged(sound, [], tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("petrobot.coordinator.cli.run._lead_lockstep", ctrl_c)
    assert main([*RUN, "--journal", "runs"]) == 130
    told = r"`petrobot resume runs/arm_bot-\S+` continues this run"
    assert bool(re.search(told, capsys.readouterr().err)) == begun


def test_an_unfinished_campaign_is_named_as_such(tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text("{}", encoding="utf-8")
    expect(r"its campaign is not finished: .* continues it", ["learned", "show", str(tmp_path)])


CAMPAIGN = ["campaign", TASK, "--services", CELL, "--runs", "2", "--out", "out"]


@pytest.mark.processes
@pytest.mark.parametrize("command", [RUN, CAMPAIGN], ids=["run", "campaign"])
@pytest.mark.parametrize(
    ("new", "told"),
    [
        (
            "*, goal: float)",
            r"toml:24: places.fetch.args.to: .*'move' has no argument 'to'",
        ),
        (
            "*, to: float, fast: bool)",
            r":24: places.fetch.args: .*'move' needs the argument 'fast'",
        ),
    ],
)
def test_a_run_does_not_begin_with_wrong_arguments(
    sound: dict[str, str],
    command: list[str],
    new: str,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its source shows them: the first run of the action would fail."""
    damaged(sound, [(CODE, "*, to: float)", new, "")], tmp_path)
    monkeypatch.chdir(tmp_path)
    expect(told, command)
    assert not (tmp_path / "out").exists()


@pytest.mark.processes
def test_an_event_does_not_become_internal_by_its_declaration(tmp_path: Path) -> None:
    """The catching task with `ball_caught` as an internal event, which no action raises: it would
    count each catch as a miss."""
    shipped = Path(__file__).parents[2] / "coordinator" / "tasks" / "catch_ball.toml"
    text = shipped.read_text(encoding="utf-8")
    internal = 'scope = "internal"\nby = "catch_ball"'
    text = text.replace('scope = "external"\nmemory = "latched"\nearly = "drop"', internal).replace(
        '"caught_early"', '"missed"'
    )
    before, _, rest = text.partition("[transitions.caught_early]")
    text = before + "[transitions.move_failed]" + rest.partition("[transitions.move_failed]")[2]
    assert internal in text
    (tmp_path / "internal.toml").write_text(text, encoding="utf-8")
    services = shipped.parents[2] / "services.toml"
    pattern = r"events.ball_caught.by: follow_and_wait of catch_ball never raises 'ball_caught'"
    expect(pattern, ["check", str(tmp_path / "internal.toml"), "--services", str(services)])


@pytest.mark.processes
@pytest.mark.parametrize(
    ("raised", "code"),
    [
        ('tell = ctx.raise_event\n    tell("gone_by")', 0),
        ('getattr(ctx, "raise_event")("gone_by")', 0),
        ("Teller(ctx).tell()", 0),
        ('ctx.progress(0.5, note="gone_by")', 2),
    ],
)
def test_an_internal_event_may_be_raised_in_any_way(raised: str, code: int, tmp_path: Path) -> None:
    """Also by another name of the method, or by an object that keeps the context."""
    (tmp_path / "gates.py").write_text(
        "from petrobot import Context, Result, success\n\n\n"
        "class Teller:\n    def __init__(self, ctx: Context) -> None:\n        self.cell = ctx\n\n"
        '    def tell(self) -> None:\n        self.cell.raise_event("gone_by")\n\n\n'
        f"async def look(ctx: Context) -> Result:\n    {raised}\n    return success()\n",
        encoding="utf-8",
    )
    (tmp_path / "services.toml").write_text(
        'schema = 1\n[nodes]\npc = { host = "127.0.0.1", port = 7499 }\n[actions]\n'
        'look = { run = "gates:look", node = "pc" }\n',
        encoding="utf-8",
    )
    (tmp_path / "gates.toml").write_text(
        'schema = 1\n[task]\nname = "gates"\nfinal = "looks == 0"\nfinal_error = "bad > 0"\n'
        '[errors]\nto = "bad"\n[primitive_tasks]\nlook = { deadline = 5.0 }\n'
        '[events]\ngone_by = { by = "look" }\n[places]\nbad = {}\n'
        'looks = { kind = "control", tokens = 2 }\nlook = { kind = "action" }\n[transitions]\n'
        'start = { in = ["looks", "!look", "!bad"], out = ["look"] }\n'
        'seen = { in = ["look:preempt=success"], event = "gone_by" }\n'
        'unseen = { in = ["look:normal"] }\n',
        encoding="utf-8",
    )
    told = "may run" if code == 0 else "events.gone_by.by: look never raises|of look never raises"
    expect(told, ["check", str(tmp_path / "gates.toml")], code)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("event", "told"),
    [
        ("buton", r"warning .*raises the event 'buton', .*did you mean 'button'"),
        ("knob", r"note .*raises the event 'knob', which .* and nothing raises button"),
    ],
)
def test_an_event_that_a_driver_misspells_is_told(
    sound: dict[str, str],
    event: str,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also that of a device without an action, such as a button."""
    button = "class Button(Driver):\n    period = 0.1\n\n    def step(self, now: float) -> None:\n"
    button += f'        self.ports.raise_event("{event}")\n\n\nclass Axis('
    device = 'button = { node = "pc", driver = "arm_bot:Button" }\n\n[actions]'
    mistakes: list[Mistake] = [
        (TASK, "[errors]", '[events.button]\nscope = "external"\n\n[errors]', ""),
        (CELL, "\n[actions]", device, ""),
        (CODE, "class Axis(", button, ""),
    ]
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    expect(told, CHECK, 0)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("timer", "told"),
    [
        ("dusty_lens", r"warning .*timers.dusty_lens: a timer raises .*did you mean 'dust'"),
        ("beat", r"note .*timers.beat: a timer raises .* and nothing raises dust"),
    ],
)
def test_a_timer_whose_name_is_no_event_of_the_task_is_told(
    sound: dict[str, str], timer: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mistakes: list[Mistake] = [
        (TASK, "[errors]", '[events.dust]\nscope = "external"\n\n[errors]', ""),
        (CELL, "[nodes]", TIMER.replace("button", timer), ""),
    ]
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    expect(told, CHECK, 0)


TIMER = '[timers.button]\nnode = "pc"\nperiod = 1.0\n\n[nodes]'


@pytest.mark.processes
@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        (CODE, "if not self.paused:", RAISED, ""),
        (CELL, "[nodes]", TIMER, ""),
        (
            CODE,
            "if not self.paused:",
            RAISED.replace('"button"', '"button".lower()'),
            "if it never comes",
        ),
        (CODE, "", "", "no driver, action, service or timer of services.toml raises it"),
    ],
    ids=["by a driver", "by a timer", "by a computed name", "by nobody"],
)
def test_a_wait_for_an_event_is_reported_unless_the_cell_raises_it(
    sound: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    old: str,
    new: str,
    told: str,
) -> None:
    """Its code says so: no false alarm, and no word about a hang where nobody can end the wait."""
    start = 'start = { event = "button", '
    mistakes: list[Mistake] = [
        (TASK, "[errors]", '[events.button]\nscope = "external"\n\n[errors]', ""),
        (TASK, "start = { ", start, ""),
        (file, old, new, ""),
    ]
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    code, words = said(*CHECK)
    found = " ".join(words.split())
    assert code == 0 and ("can free the tokens of parts, axis" in found) == bool(told)
    assert told in found


@pytest.mark.processes
def test_a_memory_that_is_on_a_node_is_no_mistake(
    sound: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = '[services.memory]\nnode = "pc"\n\n[actions]'
    used = (CODE, "await ctx.sleep(0.3)", 'await ctx.put("parts", 1)', "")
    damaged(sound, [(CELL, "[actions]", node, ""), used], tmp_path)
    monkeypatch.chdir(tmp_path)
    kept, mended = r"yes  .*, sound\n", r"only if repaired  live, proper, stable, controllable "
    expect(rf"^arm_bot.toml: may run\n  {kept}  {mended}", CHECK, 0)


@pytest.mark.processes
def test_a_coroutine_that_is_passed_on_is_no_mistake(
    sound: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    helper = "async def wink(ctx: Context[Remote]) -> bool:\n    return False\n\n\nasync def grip("
    uses = """job = wink(ctx)
    both: Any = [wink(ctx), wink(ctx)]
    await job
    for one in both:
        await one
    jobs = {n: wink(ctx) for n in (1, 2)}, {1: wink(ctx)}, [wink(ctx) for _ in (1, 2)]
    ctx.device.job = wink(ctx)
    late = wink(ctx)
    print(late, jobs)
"""
    mistakes: list[Mistake] = [
        (CODE, "async def grip(", helper, ""),
        (CODE, "await ctx.sleep(0.3)\n", uses, ""),
    ]
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    expect("^arm_bot.toml: may run", CHECK, 0)


@pytest.mark.processes
def test_a_class_that_cannot_be_hashed_is_read_like_any_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sound: dict[str, str]
) -> None:
    """As some libraries for data bases make them; the process that read it ended."""
    odd = "class Odd(metaclass=type('Meta', (type,), {'__hash__': None})):\n    pass\n\n\n"
    mistakes = [(CODE, "class Axis(Driver):", f"{odd}class Axis(Driver):", "")]
    mistakes += [(CODE, "await ctx.sleep(0.3)", "Odd(); ctx.sleep(0.3)", "")]
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    expect(r"arm_bot.py:\d+: `ctx.sleep` does nothing without", CHECK)


LIFTING = """\
[subnets.lifting]
entry = "lift"
normal = "up"
error = "down"
parameters = { height = "int", speed = "float" }
[subnets.lifting.places]
up = {}
down = {}
lift = { kind = "action", task = "grip" }
[subnets.lifting.transitions]
lifted = { in = ["lift:normal"], out = ["up"] }
[places.rise]
kind = "macro"
subnet = "lifting"
args = { speed = 9 }
[transitions.rising]
in = ["parts"]
out = ["rise"]
[transitions.risen]
in = ["rise:normal"]
[transitions.sunk]
in = ["rise:error"]
"""

TOGETHER: list[list[Mistake]] = [
    [  # each stage of reading: syntax, keys, names, code
        (TASK, 'kind = "resource", tokens', "kind = resource, tokens", r"TOML: resource is a text"),
        (TASK, "deadline = 8.0", "dedline = 8.0", r"move.dedline: unknown key"),
        (TASK, '["grip:normal"]', '["gripp:normal"]', r"gripped.in: unknown place 'gripp'"),
        (
            TASK,
            "args = { to = 0.2 }",
            "args = { two = 0.2 }",
            r"args.two: .* has no argument 'two'",
        ),
        (
            TASK,
            '{ in = ["carry:normal"] }',
            '{ in = ["carry:error"] }',
            r"carry: no outgoing arc `normal`",
        ),
        (CELL, "port = 7501", "port = 75010", r"nodes.pc.port: is 75010"),
        (CELL, "arm_bot:Axis", "arm_bot:Axes", r"devices.axis.driver: .*'Axes'"),
        (CODE, "await ctx.sleep(0.3)", "ctx.sleep(0.3)", r"`ctx.sleep` does nothing without"),
    ],
    [  # a place that is not known keeps the net from being judged, and nothing else
        (TASK, '["grip:normal"]', '["zzz:normal"]', r"gripped.in: unknown place 'zzz'"),
        (TASK, "tries = 3", "tries = 0", r"grip.tries: 0 tries"),
        (TASK, 'runs_place = "parts"', 'runs_place = "axis"', r"task.runs_place: expected a con"),
        (CELL, "top_speed = 0.5", "topspeed = 0.5", r"devices.axis.topspeed: unknown key"),
        (CODE, "    return success()", "    return success", r"`return success` is not a result"),
    ],
    [  # a location file with a fault does not keep the net from being judged
        (TASK, "tokens = 1", "tokens = 0", r"deadlock free: stuck with parts:3"),
        (CELL, 'device = "axis" }\ng', 'devise = "axis" }\ng', r"actions.move.devise: unknown key"),
        (CELL, "arm_bot:grip", "arm_bot:gripp", r"actions.grip.run: .*'gripp'"),
    ],
    [  # a line of the location file that cannot be read
        (TASK, 'to = "broken"', 'to = "brokn"', r"errors.to: 'brokn' is not a place"),
        (CELL, 'arm_bot:Axis"', "arm_bot:Axis", r"services.toml:7: not valid TOML: the quote"),
        (CELL, 'grip", device = "axis"', 'grip", device = "hand"', r"grip.device: no device is na"),
        (CODE, "def stop(", "def stpo(", r"`stpo` of Axis is never called|but no stop"),
    ],
    [  # code that cannot be imported
        (TASK, "final_error", "final_eror", r"task.final_eror: unknown key"),
        (
            TASK,
            '{ in = ["grip:error"] }',
            '{ in = ["grip:eror"] }',
            r"lost.in: .*'eror' is none of",
        ),
        (CODE, "from petrobot", "import nothere\nfrom petrobot", r"it imports 'nothere'"),
    ],
    [  # lines that are no TOML, one below the other: each has a key of its own
        (TASK, 'fetch = { kind = "action"', "fetch = { kind = action", r"toml:24: .*action is a"),
        (TASK, 'grip = { kind = "action"', "grip = { kind = action", r"toml:25: .*action is a"),
        (TASK, 'carry = { kind = "action"', "carry = { kind = action", r"toml:26: .*action is a"),
        (CELL, "arm_bot:grip", "arm_bot:gripp", r"actions.grip.run: .*'gripp'"),
    ],
    # A value of a wrong type, and what an element lacks, leave the other elements readable.
    [
        (
            TASK,
            "final_error",
            'prepare = ["ready"]\nfinal_error',
            r"prepare: .'ready'. is not a text",
        )
    ],
    [(TASK, 'to = "broken"', 'to = ["broken"]', r"errors.to: .'broken'. is not a text")],
    [(TASK, 'to = "broken"', 'to = "fetch"', r"errors.to: 'fetch' is an action place whose own")],
    [(TASK, "tries = 3", "tries = 100000", r"grip.tries: 100000 tries")],
    [
        (
            TASK,
            '{ slipped = "the part slipped out" }',
            '["slipped"]',
            r"error_causes: .'slipped'. is not a table",
        )
    ],
    [(TASK, "[errors]", f"{LIFTING}[errors]", r"rise.args: 'height' is missing; give it")],
    [
        (
            TASK,
            "[errors]",
            LIFTING.replace('normal = "up"\n', "").replace("9", "9, height = 1") + "[errors]",
            r"subnets.lifting.normal: missing; give a text",
        )
    ],
    [(CELL, 'run = "arm_bot:grip"', 'run = "arm_bot:Axis"', r"grip.run: 'arm_bot:Axis' is a cl")],
    [
        (
            CODE,
            "move(ctx: Context[Remote], *, to:",
            "move(*, to:",
            r"move takes no context; its first",
        )
    ],
    [  # nothing can be read of the task: its brace ends nowhere
        (TASK, "[transitions]", "[transitions", r"arm_bot.toml:28: not valid TOML"),
        (CELL, "[actions]", "[action]", r"action: unknown table"),
        (CODE, "period = 0.01", "period = 0", r"Axis.period: expected seconds above 0"),
    ],
]


@pytest.mark.processes
@pytest.mark.parametrize("mistakes", TOGETHER, ids=range(len(TOGETHER)))
def test_one_check_names_all_mistakes(
    sound: dict[str, str],
    mistakes: list[Mistake],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each of them once, and none that follows from another."""
    damaged(sound, mistakes, tmp_path)
    monkeypatch.chdir(tmp_path)
    code, words = said(*CHECK)
    lines = re.sub(r"\n {8,}", " ", words).splitlines()
    found = [one for one in lines if re.match(r"(petrobot check: |error )|\S+:\d+: ", one)]
    assert code == 2 and len(found) == len(mistakes), words
    for *_, pattern in mistakes:
        assert sum(bool(re.search(pattern, one)) for one in found) == 1, (pattern, found)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("await ctx.sleep(0.3)", "await ctx.sleep(0.3", "SyntaxError"),
        ("from petrobot", "import nothere\nfrom petrobot", "it imports 'nothere' (arm_bot.py:6)"),
    ],
)
def test_a_module_that_cannot_be_imported_is_told_once(
    sound: dict[str, str],
    old: str,
    new: str,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not once for each action and driver in it."""
    damaged(sound, [(CODE, old, new, "")], tmp_path)
    monkeypatch.chdir(tmp_path)
    code, words = said(*CHECK)
    assert code == 2 and words.count(told) == words.count("services.toml:") == 1, words


@pytest.mark.processes
@pytest.mark.parametrize(("runs", "code"), [("20", 0), ("21", 2)])
def test_runs_beyond_the_capacity_are_refused(
    sound: dict[str, str], runs: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The capacity also limits the tokens at the start."""
    damaged(sound, [(TASK, "tokens = 3", "tokens = 3, capacity = 20", "")], tmp_path)
    monkeypatch.chdir(tmp_path)
    refusal = (
        r"runs: expected at most 20, the capacity of 'parts', found 21; ask for fewer, or raise"
    )
    expect(refusal if code else "status +success", [*RUN, "--runs", runs], code)


@pytest.mark.processes
def test_more_than_one_run_of_a_task_without_a_place_for_its_runs_is_refused(
    sound: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ran once, and said nothing."""
    line = next(one for one in sound[TASK].splitlines() if one.startswith("runs_place"))
    damaged(sound, [(TASK, line, "", "")], tmp_path)
    monkeypatch.chdir(tmp_path)
    expect(r"runs: expected 1, found 3: arm_bot has no place that", [*RUN, "--runs", "3"])
    expect(r"status +success", [*RUN, "--runs", "1"], 0)


@pytest.mark.processes
def test_a_wrong_call_of_the_device_and_a_stream_without_its_values_are_told(
    sound: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both failed only when their lines were executed."""
    scale = (
        "\n\nclass Scale(Driver):\n    def weigh(self, part: str, times: int = 1) -> float:\n"
        "        wish = self.ports.stream('zero')\n        return wish[0] * times\n\n\n"
        "async def weigh(ctx: Context[Scale]) -> Result:\n    ctx.device.weigh('nut')\n"
        "    ctx.device.weigh(times=2)\n    return success()\n"
    )
    cell = '\n[streams]\nzero = { to = "scale", period = 0.1 }\n'
    cell += '[devices.scale]\nnode = "pc"\ndriver = "arm_bot:Scale"\n'
    files = {**sound, CODE: sound[CODE] + scale, CELL: sound[CELL] + cell}
    grip = 'run = "arm_bot:grip", device = "axis"'
    damaged(files, [(CELL, grip, 'run = "arm_bot:weigh", device = "scale"', "")], tmp_path)
    monkeypatch.chdir(tmp_path)
    code, words = said(*CHECK)
    flat = " ".join(words.split())
    assert code == 2 and "`wish` is the receiving end of a stream" in flat, words
    assert "`ctx.device.weigh(times=2)`: missing a required argument: 'part'" in flat, words
    assert "weigh('nut')" not in flat, words
