"""Nets for tests and benchmarks: families from the literature and small ones."""

from __future__ import annotations

from petrobot.coordinator.task.net import Net

Weights = dict[str, int]


def kanban(n: int) -> Net:
    """Kanban system with n cards in each of four cells: 16 places, 16 transitions (Ciardo & Tilgner
    1996)."""
    places: Weights = {}
    arcs: dict[str, tuple[Weights, Weights]] = {}
    for i in range(1, 5):
        places |= {f"pm{i}": 0, f"pback{i}": 0, f"pkan{i}": n, f"pout{i}": 0}
        arcs[f"tredo{i}"] = ({f"pm{i}": 1}, {f"pback{i}": 1})
        arcs[f"tback{i}"] = ({f"pback{i}": 1}, {f"pm{i}": 1})
        arcs[f"tok{i}"] = ({f"pm{i}": 1}, {f"pout{i}": 1})
    arcs["tin1"] = ({"pkan1": 1}, {"pm1": 1})
    arcs["tsynch123"] = (
        {"pout1": 1, "pkan2": 1, "pkan3": 1},
        {"pkan1": 1, "pm2": 1, "pm3": 1},
    )
    arcs["tsynch234"] = (
        {"pout2": 1, "pout3": 1, "pkan4": 1},
        {"pkan2": 1, "pkan3": 1, "pm4": 1},
    )
    arcs["tout4"] = ({"pout4": 1}, {"pkan4": 1})
    return Net.build(places, arcs)


KANBAN_RATES = {
    "tredo1": 0.36, "tredo2": 0.42, "tredo3": 0.39, "tredo4": 0.33,
    "tok1": 0.84, "tok2": 0.98, "tok3": 0.91, "tok4": 0.77,
    "tback1": 0.3, "tback2": 0.3, "tback3": 0.3, "tback4": 0.3,
    "tin1": 1.0, "tsynch123": 0.4, "tsynch234": 0.5, "tout4": 0.9,
}  # fmt: skip
"""Rates of Ciardo & Tilgner's model, all single server."""


def philosophers(n: int) -> Net:
    """n philosophers who take the left fork, then the right one: 5 n places, 5 n transitions; can
    deadlock."""
    places: Weights = {}
    arcs: dict[str, tuple[Weights, Weights]] = {}
    for i in range(n):
        left, right = f"fork{i}", f"fork{(i + 1) % n}"
        places |= {f"think{i}": 1, left: 1, f"hasleft{i}": 0, f"hasright{i}": 0, f"eat{i}": 0}
        arcs[f"left_first{i}"] = ({f"think{i}": 1, left: 1}, {f"hasleft{i}": 1})
        arcs[f"right_first{i}"] = ({f"think{i}": 1, right: 1}, {f"hasright{i}": 1})
        arcs[f"then_right{i}"] = ({f"hasleft{i}": 1, right: 1}, {f"eat{i}": 1})
        arcs[f"then_left{i}"] = ({f"hasright{i}": 1, left: 1}, {f"eat{i}": 1})
        arcs[f"done{i}"] = ({f"eat{i}": 1}, {f"think{i}": 1, left: 1, right: 1})
    return Net.build(places, arcs)


def queue(capacity: int) -> Net:
    """A queue with room for `capacity` customers; arrivals are blocked when it is full (with rates:
    M/M/c/K)."""
    return Net.build(
        {"free": capacity, "waiting": 0},
        {"arrive": ({"free": 1}, {"waiting": 1}), "serve": ({"waiting": 1}, {"free": 1})},
    )


def repairman(machines: int) -> Net:
    """Machines that fail and are repaired by one person (or several, by the servers of
    `repair`)."""
    return Net.build(
        {"up": machines, "down": 0},
        {"fail": ({"up": 1}, {"down": 1}), "repair": ({"down": 1}, {"up": 1})},
    )


def stages(k: int) -> Net:
    """k phases in a row: an Erlang distribution if all rates are equal."""
    places = {f"s{i}": int(i == 0) for i in range(k + 1)}
    return Net.build(places, {f"t{i}": ({f"s{i}": 1}, {f"s{i + 1}": 1}) for i in range(k)})


def fms(n: int) -> Net:
    """Flexible manufacturing system, n parts of each of three kinds: 22 places, 20 transitions
    (Ciardo & Trivedi 1993)."""
    places: Weights = {"M1": 3, "M2": 1, "M3": 2, "P3": n, "P3M2": 0, "P3s": 0}
    places |= dict.fromkeys(("P12", "P12wM3", "P12M3", "P12s"), 0)
    arcs: dict[str, tuple[Weights, Weights]] = {}
    for kind, machine, partner in (("P1", "M1", "P2"), ("P2", "M2", "P1")):
        waits, works, done, stored, joins = (
            f"{kind}{s}" for s in (f"w{machine}", machine, "d", "s", f"w{partner}")
        )
        places |= {kind: n} | dict.fromkeys((waits, works, done, stored, joins), 0)
        arcs[f"arrive{kind}"] = ({kind: 1}, {waits: 1})
        arcs[f"begin{kind}"] = ({waits: 1, machine: 1}, {works: 1})
        arcs[f"end{kind}"] = ({works: 1}, {done: 1, machine: 1})
        arcs[f"store{kind}"] = ({done: 1}, {stored: 1})
        arcs[f"join{kind}"] = ({done: 1}, {joins: 1})
        arcs[f"ship{kind}"] = ({stored: 1}, {kind: 1})
    arcs["assemble"] = ({"P1wP2": 1, "P2wP1": 1}, {"P12": 1})
    arcs["arriveP12"] = ({"P12": 1}, {"P12wM3": 1})
    arcs["beginP12"] = ({"P12wM3": 1, "M3": 1}, {"P12M3": 1})
    arcs["endP12"] = ({"P12M3": 1}, {"P12s": 1, "M3": 1})
    arcs["shipP12"] = ({"P12s": 1}, {"P1": 1, "P2": 1})
    arcs["beginP3"] = ({"P3": 1}, {"P3M2": 1})
    arcs["endP3"] = ({"P3M2": 1}, {"P3s": 1})
    arcs["shipP3"] = ({"P3s": 1}, {"P3": 1})
    return Net.build(places, arcs)


def shared_memory(n: int) -> Net:
    """n processors, each with a memory that the others reach over one bus: n (n + 3) + 1 places,
    n (2 n + 1) transitions.

    From the Model Checking Contest: 3^n + n (n - 1) 3^(n - 1) markings, 1,863 for n = 5 and
    1,830,519 for n = 10.
    """
    places: Weights = {"bus": 1}
    arcs: dict[str, tuple[Weights, Weights]] = {}
    for i in range(n):
        places |= {f"active{i}": 1, f"memory{i}": 1, f"own{i}": 0, f"queue{i}": 0}
        arcs[f"begin_own{i}"] = ({f"active{i}": 1}, {f"own{i}": 1})
        arcs[f"end_own{i}"] = ({f"own{i}": 1}, {f"active{i}": 1})
        arcs[f"request{i}"] = ({f"active{i}": 1}, {f"queue{i}": 1})
        for j in range(n):
            if i != j:
                access, held = f"access{i}_{j}", {f"memory{j}": 1, "bus": 1}
                places[access] = 0
                arcs[f"begin{i}_{j}"] = ({f"queue{i}": 1, **held}, {access: 1})
                arcs[f"end{i}_{j}"] = ({access: 1}, {f"active{i}": 1, **held})
    return Net.build(places, arcs)


def robot_cell(stations: int, parts: int, robots: int = 2) -> Net:
    """A production cell: robots carry parts from a stock through machines that fail and are
    repaired, and back on pallets.

    6 stations + 4 places, 8 stations + 1 transitions. A robot that waits with a part for a broken
    machine puts it back (the error branch); a repair also needs a robot to hold the part.
    """
    places: Weights = {"stock": parts, "robots": robots, "fitter": 1, "finished": 0}
    arcs: dict[str, tuple[Weights, Weights]] = {"restock": ({"finished": 1}, {"stock": 1})}
    for i in range(stations):
        idle, fetched, working, done, broken, carried = (
            f"{s}{i}" for s in ("idle", "fetched", "working", "done", "broken", "carried")
        )
        places |= {idle: 1} | dict.fromkeys((fetched, working, done, broken, carried), 0)
        arcs[f"fetch{i}"] = ({"stock": 1, "robots": 1}, {fetched: 1})
        arcs[f"load{i}"] = ({fetched: 1, idle: 1}, {working: 1, "robots": 1})
        arcs[f"put_back{i}"] = ({fetched: 1, broken: 1}, {broken: 1, "stock": 1, "robots": 1})
        arcs[f"finish{i}"] = ({working: 1}, {done: 1})
        arcs[f"fail{i}"] = ({working: 1}, {broken: 1, "stock": 1})
        arcs[f"mend{i}"] = (
            {broken: 1, "fitter": 1, "robots": 1},
            {idle: 1, "fitter": 1, "robots": 1},
        )
        arcs[f"unload{i}"] = ({done: 1, "robots": 1}, {carried: 1, idle: 1})
        arcs[f"deliver{i}"] = ({carried: 1}, {"finished": 1, "robots": 1})
    return Net.build(places, arcs)
