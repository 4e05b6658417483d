"""docs/protocol.md agrees with the code: kinds, fields, limits, codes and the example."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from petrobot.services.comm.calls.callee import Retention
from petrobot.services.comm.calls.caller import Patience
from petrobot.services.comm.calls.link import LinkTiming
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.codec import LIMITS
from tests.comm.conftest import KINDS
from tests.comm.ends import frame

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
ROWS = {
    int(row[1]): row
    for row in re.finditer(
        r"^ ?(\d+) ([A-Z_]+) +(C|S|both) +(\d+ \w+) *(.*(?:\n {20,}.*)*)$", PAGE, re.M
    )
}
UNITS = {"B": 1, "KiB": 1024, "MiB": 1024 * 1024}
SERVICES = Path(m.__file__).parents[2]
CODE = "\n".join(path.read_text(encoding="utf-8") for path in sorted(SERVICES.rglob("*.py")))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_the_table_of_messages(kind: type[m.Message]) -> None:
    row = ROWS[kind.KIND]
    fields = list(kind.__struct_fields__)
    assert (
        re.findall(r"(\w+) (?:str|int|dur|bool|bytes|map|\*text\*|\[\w+\])(?=[ ,)]|$)", row[5])
        == fields
    )
    required = fields[: len(fields) - len(kind.__struct_defaults__)]
    assert [name for name in fields if f"({name}" not in row[5]] == required
    number, unit = row[4].split()
    assert int(number) * UNITS[unit] == LIMITS[kind.KIND]


def test_the_example() -> None:
    call = m.Call("c1", "track", {"t": 1.5}, 2.0, 3, "b1", "p0", 7)
    block = PAGE.split("parent `p0`, seed 7:\n```\n")[1].split("```")[0]
    shown = b"".join(bytes.fromhex(re.split(r"  +", line)[0]) for line in block.splitlines())
    assert shown == frame(call)


def test_the_codes_and_causes_are_the_codes() -> None:
    tables = re.findall(r"^\| ([a-z_, ]+) \|", PAGE, re.M)
    named = {name for row in tables for name in row.split(", ")} - {
        "opening",
        "open",
        "closing",
        "closed",
        "state",
    }
    named -= {"code", "cause", "kind", "busy"}
    assert len(named) > 30
    assert [name for name in sorted(named) if f'"{name}"' not in CODE] == []


def test_the_times() -> None:
    assert (
        LinkTiming().heartbeat,
        LinkTiming().silence,
        LinkTiming().handshake,
        LinkTiming().user_timeout,
    ) == (
        0.25,
        1.0,
        2.0,
        1.5,
    )
    assert (Patience().reconnect, Patience().accept, Patience().stop) == (2.0, 1.0, 5.0)
    assert (Retention().results, Retention().result_count, Retention().lease) == (600.0, 1_000, 2.0)
    assert Retention().id_groups == 100_000
    for said in (
        "after 0.25 s",
        "for 1.0 s",
        "There are 2 s",
        "(1.5 s)",
        "for 10 minutes (at most 1,000",
        "last three digits are bits of one group; there are 100,000 groups",
    ):
        assert said in " ".join(PAGE.split())
