"""Long run, transient, completion and derivatives against closed forms and dense linear algebra."""

from __future__ import annotations

from math import exp, factorial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from scipy.stats import erlang

from petrobot.coordinator.analysis.net.graph import Graph, Mask
from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.analysis.time import linear
from petrobot.coordinator.analysis.time.completion import (
    completion,
    completion_time,
    reliability_slopes,
    time_slopes,
)
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn, TimelessTrap, Values
from petrobot.coordinator.analysis.time.linear import SolveOrder, solve, stationary
from petrobot.coordinator.analysis.time.markov import (
    Generator,
    long_run,
    poisson_weights,
)
from petrobot.coordinator.analysis.time.stochastic import stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import forecast
from petrobot.coordinator.task.file import load
from petrobot.coordinator.task.net import Net
from tests.analysis.generators import KANBAN_RATES, kanban, queue, repairman, stages
from tests.analysis.random_nets import gspns, transient


def test_a_queue_with_one_server() -> None:
    run = long_run(Chain.of(Gspn.of(queue(5), {"arrive": 0.8, "serve": 1.0})))
    assert run.throughput["serve"] == pytest.approx(0.7289444010755486, abs=1e-12)
    p = 0.8 ** np.arange(6) / sum(0.8 ** np.arange(6))
    assert run.mean_tokens["waiting"] == pytest.approx(float(p @ np.arange(6)), abs=1e-12)
    assert run.occupancy["waiting"] == pytest.approx(1 - p[0], abs=1e-12)
    assert run.utilisation["serve"] == pytest.approx(1 - p[0], abs=1e-12)
    assert run.residual < 1e-14


@pytest.mark.parametrize(("c", "K"), [(2, 5), (3, 7), (4, 4)])
def test_a_queue_with_several_servers(c: int, K: int) -> None:
    a, mu = 1.7, 0.6
    run = long_run(Chain.of(Gspn.of(queue(K), {"arrive": a, "serve": mu}, servers={"serve": c})))
    weights = [
        (a / mu) ** n / (factorial(n) if n <= c else factorial(c) * c ** (n - c))
        for n in range(K + 1)
    ]
    p = np.array(weights) / sum(weights)
    assert run.throughput["arrive"] == pytest.approx(a * (1 - p[K]), abs=1e-12)
    assert run.mean_tokens["waiting"] == pytest.approx(float(p @ np.arange(K + 1)), abs=1e-12)


def test_the_machine_repairman() -> None:
    n, fail, repair = 6, 0.3, 1.1
    run = long_run(
        Chain.of(Gspn.of(repairman(n), {"fail": fail, "repair": repair}, servers={"fail": None}))
    )
    weights = np.array(
        [factorial(n) / factorial(n - k) * (fail / repair) ** k for k in range(n + 1)]
    )
    p = weights / weights.sum()
    assert run.mean_tokens["down"] == pytest.approx(float(p @ np.arange(n + 1)), abs=1e-12)
    assert run.throughput["repair"] == pytest.approx(repair * (1 - p[0]), abs=1e-12)


@pytest.mark.parametrize("k", [1, 2, 25, 400])
def test_erlang_completion(k: int) -> None:
    rate = 3.0
    chain = Chain.of(Gspn.of(stages(k), {f"t{i}": rate for i in range(k)}))
    goal = chain.space.tokens(k) > 0
    done = completion(chain, goal)
    assert done.probability == 1.0
    assert done.mean == pytest.approx(k / rate, rel=1e-12) and done.variance == pytest.approx(
        k / rate**2, rel=1e-9
    )
    shape = completion_time(chain, goal)
    exact = erlang(k, scale=1 / rate)
    for q in (0.05, 0.5, 0.9, 0.99):
        assert shape.quantile(q) == pytest.approx(float(exact.ppf(q)), rel=1e-9)
        assert shape.cdf(float(exact.ppf(q))) == pytest.approx(q, rel=1e-9)


@pytest.mark.parametrize(
    ("n", "throughput"), [(1, 0.0925846346333826), (2, 0.173871706178), (3, 0.233071166004)]
)
def test_kanban_throughput_as_published(n: int, throughput: float) -> None:
    run = long_run(Chain.of(Gspn.of(kanban(n), KANBAN_RATES)))
    assert run.throughput["tin1"] == pytest.approx(throughput, abs=1e-10 if n > 1 else 1e-15)
    assert run.throughput["tout4"] == pytest.approx(run.throughput["tin1"], abs=1e-13)
    assert run.residual < 1e-12


@pytest.mark.parametrize("compiled", [False, True])
def test_sweeps_find_what_elimination_finds(
    compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large systems are swept, with numba by a loop of their own (here as plain Python)."""
    chain = Chain.of(Gspn.of(kanban(1), KANBAN_RATES))
    exact = long_run(chain).probability
    monkeypatch.setattr(linear, "DENSE", 1)
    monkeypatch.setattr(linear, "COMPILED_FROM", 0 if compiled else 10**9)
    monkeypatch.setattr(linear, "_compiled", lambda: linear.sweep_in_place)
    assert long_run(chain).probability == pytest.approx(exact, abs=1e-12)
    random = np.random.default_rng(1)
    A = np.where(random.random((40, 40)) < 0.2, random.random((40, 40)), 0.0)
    A *= 0.9 / A.sum(axis=1, keepdims=True)
    rows, columns = np.nonzero(A)
    right = random.random(40)
    swept = linear._sweep(40, rows, columns, A[rows, columns], right)
    assert swept == pytest.approx(np.linalg.solve(np.eye(40) - A, right), rel=1e-10)


@pytest.mark.proof
def test_kanban_4_throughput_as_published() -> None:
    run = long_run(Chain.of(Gspn.of(kanban(4), KANBAN_RATES)))
    assert run.throughput["tin1"] == pytest.approx(0.275889753096, abs=1e-10)


def expm(A: Values) -> Values:
    """Return exp(A) by scaling and squaring its Taylor series.

    scipy 1.17.1 is wrong on triangular matrices with equal diagonal entries.
    """
    halvings = max(0, int(np.ceil(np.log2(max(1e-9, float(np.abs(A).sum(axis=1).max()))))) + 4)
    small, term, total = A / 2.0**halvings, np.eye(len(A)), np.eye(len(A))
    for k in range(1, 16):
        term = term @ small / k
        total = total + term
    return np.asarray(np.linalg.matrix_power(total, 2**halvings))


def dense(chain: Chain) -> tuple[Values, Values]:
    """Return (generator over tangible markings, probability to enter each first) as dense
    matrices."""
    P = np.zeros((chain.n, chain.n))
    np.add.at(P, (chain.source, chain.target), chain.amount)
    v, t = np.flatnonzero(chain.vanishing), chain.tangible
    P[v] /= P[v].sum(axis=1, keepdims=True)
    exits = np.linalg.solve(np.eye(len(v)) - P[np.ix_(v, v)], P[np.ix_(v, t)])
    Q = P[np.ix_(t, t)] + P[np.ix_(t, v)] @ exits
    Q -= np.diag(Q.sum(axis=1))
    start = np.zeros(len(t))
    if chain.vanishing[0]:
        start = exits[v.tolist().index(0)]
    else:
        start[t.tolist().index(0)] = 1.0
    return Q, start


@settings(max_examples=40, deadline=None)
@given(gspns())
def test_transient_and_long_run_against_dense_matrices(gspn: Gspn) -> None:
    chain = Chain.of(gspn)
    assume(chain.n <= 80)
    Q, start = dense(chain)
    times = [0.0, 0.3, 2.5]
    found = transient(chain, times)
    for row, t in zip(found, times, strict=True):
        assert np.allclose(row[chain.tangible], start @ expm(Q * t), atol=1e-10)
    assert not found[:, chain.vanishing].any()
    run = long_run(chain)
    far = start @ np.linalg.matrix_power(expm(Q * 50.0), 200)
    assert np.allclose(run.probability[chain.tangible], far, atol=1e-9)
    assert run.residual < 1e-11
    assert run.probability.sum() == pytest.approx(1.0)


@settings(max_examples=40, deadline=None)
@given(gspns(), st.data())
def test_completion_against_dense_matrices(gspn: Gspn, data: st.DataObject) -> None:
    chain = Chain.of(gspn)
    assume(chain.n <= 80)
    goal = np.zeros(chain.n, dtype=bool)
    goal[data.draw(st.sampled_from(chain.tangible.tolist()))] = True
    assume(not goal[0])
    done = completion(chain, goal)
    Q, start = dense(chain)
    end = goal[chain.tangible]
    stay = ~end & (np.asarray(done.h)[chain.tangible] > 0)
    A = -Q[np.ix_(stay, stay)]
    h = np.linalg.solve(A, Q[np.ix_(stay, end)].sum(axis=1))
    first = np.linalg.solve(A, h)
    second = 2 * np.linalg.solve(A, first)
    p = start[stay]
    whole = p @ h + start[end].sum()
    assert done.probability == pytest.approx(whole, rel=1e-9)
    assert done.mean == pytest.approx(p @ first / whole, rel=1e-8)
    assert done.variance == pytest.approx(
        p @ second / whole - (p @ first / whole) ** 2, rel=1e-6, abs=1e-9
    )
    assert done.residual < 1e-12
    shape, t = completion_time(chain, goal), 1.3
    frozen = Q.copy()
    frozen[~stay] = 0.0
    assert shape.cdf(t) == pytest.approx(
        float((start @ expm(frozen * t))[end].sum()) / whole, abs=1e-8
    )


def bumped(gspn: Gspn, name: str, factor: float) -> Gspn:
    value = gspn.rate[gspn.net.transition_index[name]]
    if value is not None:
        return gspn.changed(rates={name: value * factor})
    return gspn.changed(weights={name: gspn.weight[gspn.net.transition_index[name]] * factor})


@settings(max_examples=40, deadline=None)
@given(gspns(), st.data())
def test_derivatives_against_differences(gspn: Gspn, data: st.DataObject) -> None:
    chain = Chain.of(gspn)
    assume(chain.n <= 80)
    goal = np.zeros(chain.n, dtype=bool)
    goal[data.draw(st.sampled_from(chain.tangible.tolist()))] = True
    assume(not goal[0])
    done = completion(chain, goal)
    by_h, by_time = reliability_slopes(done), time_slopes(done)
    name = data.draw(st.sampled_from(gspn.net.transitions))
    step = 1e-5

    def at(factor: float, mask: Mask) -> tuple[float, float]:
        other = completion(Chain.of(bumped(gspn, name, factor), space=chain.space), mask)
        return other.probability, other.mean

    (h1, t1), (h0, t0) = at(1 + step, goal), at(1 - step, goal)
    assert by_h[name].elasticity * done.probability == pytest.approx(
        (h1 - h0) / (2 * step), abs=1e-6
    )
    assert by_time[name].elasticity * done.mean == pytest.approx(
        (t1 - t0) / (2 * step), rel=1e-4, abs=1e-5
    )
    assert by_time[name].derivative * by_time[name].value == pytest.approx(
        by_time[name].elasticity * done.mean
    )


def cycle_of_immediates(escape: float) -> Gspn:
    net = Net.build(
        {"idle": 1, "a": 0, "b": 0},
        {
            "go": ({"idle": 1}, {"a": 1}),
            "ab": ({"a": 1}, {"b": 1}),
            "ba": ({"b": 1}, {"a": 1}),
            "out": ({"b": 1}, {"idle": 1}),
        },
    )
    return Gspn.of(net, {"go": 2.0}, weights={"out": escape})


def test_immediate_cycles_are_solved_and_timeless_traps_refused() -> None:
    run = long_run(Chain.of(cycle_of_immediates(0.25)))
    assert run.throughput["out"] == pytest.approx(2.0) and run.throughput["ba"] == pytest.approx(
        8.0
    )
    generator = Generator.of(run.chain)
    assert generator.matrix.toarray() == pytest.approx(
        np.ones((1, 1))
    ) and generator.start.tolist() == [1.0]
    trap = Net.build(
        {"idle": 1, "a": 0}, {"go": ({"idle": 1}, {"a": 1}), "spin": ({"a": 1}, {"a": 1})}
    )
    with pytest.raises(TimelessTrap, match="spin"):
        Chain.of(Gspn.of(trap, {"go": 1.0}))


def test_the_long_run_mixes_the_reachable_components() -> None:
    net = Net.build(
        {"start": 1, "left": 0, "right": 0, "back": 0},
        {
            "l": ({"start": 1}, {"left": 1}),
            "r": ({"start": 1}, {"right": 1}),
            "to": ({"right": 1}, {"back": 1}),
            "fro": ({"back": 1}, {"right": 1}),
        },
    )
    run = long_run(Chain.of(Gspn.of(net, {"l": 1.0, "r": 3.0, "to": 1.0, "fro": 2.0})))
    assert run.mean_tokens["left"] == pytest.approx(0.25) and run.mean_tokens[
        "back"
    ] == pytest.approx(0.25)
    assert run.throughput["to"] == pytest.approx(0.75 * 2 / 3)


def test_large_components_by_gauss_seidel_agree_with_elimination() -> None:
    """A birth-death chain of 700 states has a closed form."""
    run = long_run(Chain.of(Gspn.of(queue(699), {"arrive": 0.97, "serve": 1.0})))
    p = 0.97 ** np.arange(700.0)
    p /= p.sum()
    assert np.allclose(run.probability, p, atol=1e-12)
    rows = np.repeat(np.arange(900), 2)
    columns = np.stack([(np.arange(900) + 1) % 900, (np.arange(900) * 7) % 900], axis=1).ravel()
    nu = stationary(900, rows, columns, np.tile([0.7, 0.3], 900))
    P = np.zeros((900, 900))
    np.add.at(P, (rows, columns), np.tile([0.7, 0.3], 900))
    assert np.allclose(nu @ P, nu, atol=1e-15)


def test_completion_of_a_large_component_by_gauss_seidel() -> None:
    """A random walk on 0..700 from 0: the mean time to the top has a closed form."""
    chain = Chain.of(Gspn.of(queue(700), {"arrive": 2.0, "serve": 1.0}))
    done = completion(chain, chain.space.tokens(1) == 700)
    up, down, total, step = 2.0, 1.0, 0.0, 0.0
    for _ in range(700):
        step = (1 + down * step) / up
        total += step
    assert done.mean == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize("keep", [0.99, 0.999])
@pytest.mark.parametrize("edges", ["forward", "backward"])
def test_a_component_on_which_aggregation_diverges_is_still_solved(keep: float, edges: str) -> None:
    """Two loops of 30 and 31 stages side by side: the error differs within each block."""
    state = np.arange(30 * 31)
    one, other = (state + 31) % 930, state - state % 31 + (state + 1) % 31
    ends = np.repeat(state, 2), np.stack([one, other], axis=1).ravel()
    source, target = ends if edges == "forward" else ends[::-1]
    order = np.argsort(source, kind="stable")
    value = np.tile([0.1 * keep, 0.9 * keep], 930)[order]
    first = np.zeros(930)
    first[0] = 1.0
    graph = Graph(930, source[order].astype(np.int32), target[order].astype(np.int32))
    x = solve(SolveOrder.of(graph, None), value, first)
    matrix = np.eye(930)
    np.subtract.at(matrix, (graph.source, graph.target), value)
    assert np.allclose(matrix @ x, first, atol=1e-12)


def test_a_linear_system_without_a_finite_solution_is_an_error_not_a_warning() -> None:
    """Each visit leads to ten more, 400 stages long."""
    line = np.arange(400, dtype=np.int32)
    graph = Graph(400, line[:-1], line[1:])
    with pytest.raises(ArithmeticError):
        solve(SolveOrder.of(graph, None), np.full(399, 10.0), np.ones(400))


@pytest.mark.parametrize("mean", [0.0, 1e-3, 1.0, 30.0, 5e4])
def test_poisson_weights(mean: float) -> None:
    low, weight = poisson_weights(mean)
    assert weight.sum() == pytest.approx(1.0) and (
        low + np.arange(len(weight))
    ) @ weight == pytest.approx(mean, abs=1e-9)
    if mean < 100:
        k = low + len(weight) // 2
        assert weight[k - low] == pytest.approx(exp(-mean) * mean**k / factorial(k), rel=1e-9)


def test_an_unbounded_net_is_not_searched_to_the_limits() -> None:
    """The message names the place that grows, not a limit of time."""
    net = Net.build({"p": 1, "bin": 0}, {"t": ({"p": 1}, {"p": 1, "bin": 1})})
    with pytest.raises(ValueError, match="but bin can grow without bound; simulate instead"):
        Chain.of(Gspn.of(net, {"t": 1.0}))


def test_invalid_gspns_are_refused_with_a_reason() -> None:
    with pytest.raises(ValueError, match="not a transition"):
        Gspn.of(queue(2), {"nobody": 1.0})
    with pytest.raises(ValueError, match="positive, finite"):
        Gspn.of(queue(2), {"arrive": 0.0, "serve": 1.0})
    with pytest.raises(ValueError, match="unlimited only"):
        Gspn.of(Net.build({"p": 0}, {"t": ({}, {"p": 1})}), {"t": 1.0}, servers={"t": None})
    with pytest.raises(ValueError, match="simulate instead"):
        Chain.of(
            Gspn.of(Net.build({"p": 1}, {"t": ({"p": 1}, {"p": 2})}), {"t": 1.0}),
            limits=SearchLimits(states=10),
        )


def test_what_if() -> None:
    gspn = Gspn.of(queue(5), {"arrive": 0.8, "serve": 1.0})
    smaller = gspn.marked({"free": 1}).changed(rates={"serve": 4.0})
    assert long_run(Chain.of(smaller)).throughput["serve"] == pytest.approx(1 / (1 / 0.8 + 1 / 4.0))


@pytest.mark.once
def test_the_distribution_ends_where_rounding_begins() -> None:
    """Many jumps of a large chain leave larger rounding errors than the tolerance; the
    computation still ends."""
    task = load(Path(__file__).parents[2] / "coordinator" / "tasks" / "follow_track.toml")
    found = forecast(stochastic_view(task, stages=8, timer_stages=8))
    whole = completion_time(found.chain, found.done.goal, left=1e-14, steps=60_000)
    assert whole.quantile(0.5) < found.done.mean < whole.quantile(0.99)
    mean = float(np.sum(whole.probability - whole.absorbed) / whole.rate / whole.probability)
    assert mean == pytest.approx(found.done.mean, rel=1e-6)


def test_a_stationary_vector_that_differs_within_blocks_of_neighbours_is_found() -> None:
    """Two rings, one of the even and one of the odd numbers, that hardly exchange anything: steps
    over blocks of consecutive numbers undid what the sweeps had gained, for ever."""
    n = 806
    rows = np.concatenate([np.tile(np.arange(n), 2), [0, 1]])
    ring = np.concatenate([(np.arange(n) + 2) % n, (np.arange(n) - 2) % n])
    columns = np.concatenate([ring, [1, 0]])
    value = np.concatenate([np.ones(2 * n), [1e-4, 3e-4]])
    value /= np.bincount(rows, value)[rows]
    found = stationary(n, rows, columns, value)
    flow = np.bincount(columns, found[rows] * value, n)
    assert np.abs(flow - found).max() < 1e-12 * found.max()
    assert found[::2].sum() / found[1::2].sum() == pytest.approx(3.0, rel=1e-3)
