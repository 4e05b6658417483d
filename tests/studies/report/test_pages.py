"""Report pages of toy campaigns, and comparisons whose numbers are known."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import binomtest

from petrobot.coordinator.cli import main
from petrobot.coordinator.run.timeline import Bar, Timeline
from petrobot.coordinator.studies.campaign.conduct import Campaign
from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial
from petrobot.coordinator.studies.report.action_pictures import (
    learned_curves,
    objective_curves,
)
from petrobot.coordinator.studies.report.campaign_page import CampaignReport, story, timeline_of
from petrobot.coordinator.studies.report.comparing import (
    Weighting,
    compare,
    cost_weight,
    objective_intervals,
    paired,
)
from petrobot.coordinator.studies.report.plots import declared, finished
from petrobot.coordinator.studies.report.run_page import gantt_svg, own_pictures
from petrobot.coordinator.task import Status
from petrobot.coordinator.task.file import load
from tests.studies.campaign.conftest import HERE, SERVICES, TASK, InlinePool

TOY = load(TASK)


def row(
    k: int, action: str, status: str, seconds: float, goal: bool, regime: str = "easy"
) -> TrialRow:
    """Return a trial with one run of look."""
    run = RunEntry(
        "look", action, 0.0, seconds, status, seconds=seconds, cost=seconds, taken="seen"
    )
    trial = Trial(1, 0.0, seconds, True, int(goal), status, "", [run])
    return TrialRow(
        k,
        regime,
        1,
        k,
        0,
        1.0,
        trial,
        {"parts.n": k, "parts.gripped": goal, "parts.x": 0.1 * k, "parts.y": seconds},
    )


# --- comparisons ------------------------------------------------------------------------------


def test_comparison_by_hand() -> None:
    """Ten pairs: three better, one worse; McNemar's exact p for 3 against 1; J from the sums with
    one rho."""
    one = [row(k, "look_quick", "success" if k < 8 else "failure", 1.0, k < 8) for k in range(10)]
    other = [
        row(
            k,
            "look_long",
            "success" if k in (0, 1, 2, 3, 4, 9) else "failure",
            2.0,
            k in (0, 1, 2, 3, 4, 9),
        )
        for k in range(10)
    ]
    found = compare(TOY, one, other)
    share = found["shares"]["R_goal"]
    assert (share["one"], share["other"], share["only_one"], share["only_other"]) == (
        0.8,
        0.6,
        3,
        1,
    )
    assert share["p"] == pytest.approx(binomtest(3, 4).pvalue)
    assert share["difference"] == pytest.approx(0.2)
    assert share["interval"][0] < 0.2 < share["interval"][1]
    assert found["shares"]["parts.gripped"]["difference"] == pytest.approx(0.2)
    assert found["time"]["difference"] == pytest.approx(-1.0)
    look = found["J"]["look"]  # rho = 1 / 2 s
    assert (look["one"], look["other"]) == (
        pytest.approx(1 - 0.8 + 0.5),
        pytest.approx(1 - 0.6 + 1.0),
    )
    assert look["interval"][0] <= look["difference"] <= look["interval"][1]
    assert found["J"]["mean"]["one"] == look["one"]
    weighted = compare(TOY, one, other, Weighting({"look": 0.1}, 0.2))["J"]
    assert weighted["look"]["difference"] == pytest.approx((0.2 + 0.1) - (0.4 + 0.2))
    assert weighted["task"]["difference"] == pytest.approx((0.2 + 0.2) - (0.4 + 0.4))


def test_pairs_have_equal_seeds() -> None:
    """Trials that only one campaign has are left out and counted."""
    one = [row(k, "look_quick", "success", 1.0, True) for k in range(4)]
    other = [row(k, "look_quick", "success", 1.0, True) for k in range(2, 8)]
    other[0].trial = None
    assert len(paired(one, other).one) == 1
    assert paired(one, other).left_out == 8
    with pytest.raises(ValueError, match="no trial in common"):
        compare(TOY, one, [row(0, "look_quick", "success", 1.0, True, regime="rough")])
    with pytest.raises(ValueError, match="one trial in common"):
        compare(TOY, one, other)


def test_equal_campaigns_do_not_differ() -> None:
    """There is no difference and no significance."""
    rows = [
        row(k, "look_quick", "success" if k % 3 else "failure", 1.0, k % 3 > 0) for k in range(30)
    ]
    found = compare(TOY, rows, rows)
    assert found["shares"]["R_goal"]["p"] == 1.0
    assert found["J"]["look"]["interval"] == [0.0, 0.0]


def test_the_interval_of_the_difference_covers() -> None:
    """In 200 worlds with a difference of 0.1, about 190 of the 95 % intervals cover it."""
    random = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        draws = random.random(120)
        one = [row(k, "look_quick", "success", 1.0, bool(draws[k] < 0.8)) for k in range(120)]
        other = [
            row(k, "look_quick", "success", 1.0, bool(0.15 < draws[k] < 0.85)) for k in range(120)
        ]
        from petrobot.coordinator.studies.report.comparing import share_difference

        found = share_difference(
            paired(one, other), lambda r: r.trial is not None and r.trial.goals > 0
        )
        hits += found["interval"][0] <= 0.1 <= found["interval"][1]
    assert 180 <= hits <= 199


def test_rho_is_one_over_the_largest_mean_cost() -> None:
    """The maximum is over all actions of both campaigns."""
    rows = [row(0, "look_quick", "success", 1.0, True), row(1, "look_long", "success", 4.0, True)]
    assert cost_weight(TOY, "look", rows) == 0.25
    assert cost_weight(TOY, "grip", rows) == 0.0


# --- pages ------------------------------------------------------------------------------------


def test_objective_curves_end_at_the_tables_j() -> None:
    """The last point is J computed from all sums."""
    rows = [
        row(
            k,
            "look_quick" if k % 2 else "look_long",
            "success" if k % 4 else "error",
            1.0 + k % 2,
            True,
        )
        for k in range(40)
    ]
    (curves,) = objective_curves(TOY, rows)
    assert list(curves.objective["look_quick"][-1]) == pytest.approx([40, 1 - 1.0 + 2.0 / 2.0])
    assert list(curves.objective["look_long"][-1]) == pytest.approx([40, 1 - 0.5 + 1.0 / 2.0])
    assert sum(points[-1][1] for points in curves.probability.values()) == pytest.approx(1.0)


def test_declared_pictures_come_from_the_score_alone() -> None:
    """Points, lines and histograms are declared by column names; those without values are left
    out."""
    rows = [{"t.x": 0.1 * i, "t.y": float(i), "t.kind": i % 2 == 0} for i in range(10)]
    plots = {
        "points": {"x": "t.x", "y": "t.y", "colour": "t.kind", "title": "P"},
        "lines": {"kind": "lines", "x": "t.x", "y": "t.y", "x2": "t.y", "y2": "t.x"},
        "histogram": {"kind": "histogram", "x": "t.y", "most": 5},
        "nothing": {"x": "u.x", "y": "u.y"},
        "nonsense": 3,
    }
    made = declared(plots, rows)
    assert set(made) == {"points", "lines", "histogram"}
    for svg in made.values():
        ElementTree.fromstring(svg)
    assert made["points"].count("<circle") + made["points"].count("<rect x") >= 10
    assert finished({"pictures": {"a": "<svg/>", "b": "<script/>"}}) == {"a": "<svg/>"}


def test_values_beyond_a_histogram_are_counted() -> None:
    """Also if all of a group are, and a bar of the others is still where it belongs."""
    rows = [{"t.x": x, "t.what": what} for x, what in [(3.0, "caught"), (160.0, "missed")]]
    rows += [{"t.x": 400.0, "t.what": "missed"}, {"t.x": None, "t.what": "missed"}]
    plot = {"kind": "histogram", "x": "t.x", "least": 0.0, "most": 150.0, "colour": "t.what"}
    svg = declared({"misses": plot}, rows)["misses"]
    assert "missed (2 beyond 150)" in svg and "caught: 1 from" in svg
    assert "beyond" not in declared({"misses": {**plot, "most": 500.0}}, rows)["misses"]


def test_a_word_has_the_same_colour_in_every_picture() -> None:
    """Whichever group is larger, and whether the others are there at all."""

    def colour_of(word: str, words: list[str], kind: str) -> str:
        rows = [{"t.x": float(i), "t.y": 1.0, "t.what": what} for i, what in enumerate(words)]
        plot = {"kind": kind, "x": "t.x", "y": "t.y", "colour": "t.what"}
        legend = re.search(
            rf'fill="(var\([^"]*\))"><title>{word}</title>', declared({"p": plot}, rows)["p"]
        )
        assert legend is not None
        return legend[1]

    words = [["caught"], ["missed", "missed", "caught"], ["caught", "caught", "missed"]]
    for kind in ("points", "histogram"):
        found = {colour_of("caught", some, kind) for some in words}
        assert found == {colour_of("caught", ["caught", "dropped"], "points")}
        assert colour_of("missed", words[1], kind) == colour_of("missed", ["missed"], kind)
    assert colour_of("missed", ["missed"], "points") != found.pop()


def test_combinations_have_intervals_that_cover_them() -> None:
    """Over repeated campaigns of 40 trials, also of a combination that hardly ever fails."""
    rng, truth = np.random.default_rng(3), 0.97
    weighting = Weighting({"look": 0.1}, 0.2)
    covered = np.zeros(2)
    for _ in range(150):
        rows = []
        for k, good in enumerate(rng.random(40) < truth):
            seconds = (2.0 if good else 1.0) + float(rng.uniform(-0.2, 0.2))
            end = "success" if good else "failure"
            rows.append(row(k, "look_quick", end, seconds, bool(good)))
        bounds = objective_intervals(TOY, rows, weighting)
        for i, rho in enumerate((0.1, 0.2)):
            j = 1.0 - truth + rho * (1.0 + truth)
            covered[i] += bounds[i][0] <= j <= bounds[i][1]
    assert covered.min() >= 0.9 * 150


def test_one_trial_of_a_combination_gives_no_interval_of_j() -> None:
    """Of its cost only one number is known."""
    one = row(0, "look_quick", "success", 2.0, True)
    weighting = Weighting({"look": 0.1}, 0.2)
    assert np.isnan(objective_intervals(TOY, [one], weighting)).all()
    assert np.isnan(objective_intervals(TOY, [], weighting)).all()


def test_a_runs_own_pictures() -> None:
    """The same declarations serve a single run's result."""
    result = {
        "parts": [{"n": 1, "x": 0.1, "y": 2.0, "gripped": True}],
        "plots": {"p": {"title": "Parts", "x": "parts.x", "y": "parts.y"}},
    }
    assert list(own_pictures(result)) == ["Parts"]


def test_the_log_of_a_trial_says_which_transition_took_which_run() -> None:
    """Runs are listed in the order of their ends, with reasons."""
    runs = [
        RunEntry("look", "look_quick", 0.0, 1.0, "success", taken="seen"),
        RunEntry("grip", "grip_soft", 1.0, 0.5, "error", "jammed", "stuck fast", taken="stuck"),
    ]
    told = story(Trial(1, 0.0, 1.5, True, 0, "error", "jammed", runs))
    assert (
        told
        == "1.00 s look_quick success, seen; 1.50 s grip_soft ERROR (jammed: stuck fast), stuck"
    )
    bars = timeline_of(
        [TrialRow(1, "", 1, 1, 0, 1.5, Trial(1, 2.0, 1.5, True, 0, "error", "", runs))]
    ).bars
    assert [(bar.begun, bar.ended) for bar in bars.values()] == [(2.0, 3.0), (3.0, 3.5)]


@pytest.mark.processes
def test_report_of_campaigns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One self-contained page has every documented picture, also as files; and a comparison of two
    campaigns."""
    monkeypatch.syspath_prepend(str(HERE))
    for name, selector in (("learnt", "nikolic_fu"), ("fixed", "fixed")):
        arguments = [
            "--runs",
            "40",
            "--regime",
            "easy,rough",
            "--selector",
            selector,
            "--block",
            "10",
            *(("--batch", "10") if name == "learnt" else ()),
        ]
        assert (
            main(
                [
                    "campaign",
                    str(TASK),
                    "--services",
                    str(SERVICES),
                    "--workers",
                    "1",
                    "--out",
                    str(tmp_path / name),
                    *arguments,
                ]
            )
            == 0
        )
    page, numbers = tmp_path / "page.html", tmp_path / "numbers.json"
    told = [
        "report",
        str(tmp_path / "learnt"),
        "--against",
        str(tmp_path / "fixed"),
        "--out",
        str(page),
        "--json",
        str(numbers),
    ]
    assert main(told) == 0
    html = page.read_text(encoding="utf-8")
    assert "http://" not in html.replace("http://www.w3.org/2000/svg", "") and "<script" not in html
    files = {path.stem for path in (tmp_path / "page_pictures").glob("*.svg")}
    assert {
        "comparison",
        "reliability_look",
        "cost_grip",
        "own_parts",
        "times",
        "latencies",
        "gantt",
    } <= files
    assert {"probability_look__easy", "objective_look__rough"} <= files
    for path in (tmp_path / "page_pictures").glob("*.svg"):
        ElementTree.parse(path)
        assert "var(--" not in path.read_text(encoding="utf-8")
    assert json.loads(numbers.read_text(encoding="utf-8"))["pairs"] > 30
    capsys.readouterr()
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    assert main(["report", "last", "--against", str(tmp_path / "fixed")]) == 2


def test_learned_probabilities_are_derived_from_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last point of the curve is the selector's final state."""
    import asyncio

    from petrobot.coordinator.studies.campaign.conduct import Campaign
    from petrobot.coordinator.studies.campaign.plan import CampaignPlan, digest
    from tests.studies.campaign.conftest import InlinePool

    monkeypatch.syspath_prepend(str(HERE))
    digests = {"task": digest(TASK), "services": digest(SERVICES)}
    plan = CampaignPlan(
        str(TASK),
        str(SERVICES),
        40,
        ("easy",),
        selector="nikolic_fu",
        block=10,
        batch=10,
        digests=digests,
    )
    campaign = Campaign(tmp_path / "c", plan)
    asyncio.run(campaign.run(InlinePool(plan)))
    report = CampaignReport(plan, campaign.bench.task, list(campaign.table.rows()), {})
    known = campaign.policy.state()["easy"]["look"]["p"]
    (look,) = [t for t in report.trials if t.primitive_task == "look"]
    assert {action: points[-1][1] for action, points in look.probability.items()} == known
    assert "probability_look__easy" in report.pictures


def test_combinations_by_hand() -> None:
    """Two combinations are compared with one rho, the lower J first; a trial that ended early
    counts as planned."""
    from petrobot.coordinator.studies.report.campaign_page import by_combination

    rows = [
        row(
            k,
            "look_quick" if k % 2 else "look_long",
            "success" if k % 4 else "error",
            1.0 + k % 2,
            k % 4 > 0,
        )
        for k in range(40)
    ]
    planned = [
        {"look": "look_quick" if k % 2 else "look_long", "grip": "grip_soft"} for k in range(40)
    ]
    assert by_combination(TOY, rows) == []  # Grip was not run.
    best, other = by_combination(TOY, rows, planned)
    assert (
        dict(best.combination)["look"] == "look_long"
    )  # 1 - .5 + 1/2 = 1.0 and 1 - 1 + 2/2 = 1.0: the first by name
    assert [best.objective, other.objective] == pytest.approx([1.0, 1.0])
    assert (best.goal, other.goal, best.trials) == (0.5, 1.0, 20)
    assert other.task_objective == pytest.approx(0.0 + 2.0 / 1.5)


def test_report_of_a_recorded_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is made from the journal alone, and with the task's own pictures if there is a result."""
    from petrobot.coordinator.launch import Setting, lockstep_party, make_mission, with_runs
    from petrobot.coordinator.run.folder import JOURNAL, RESULT, header
    from petrobot.coordinator.run.journal import JournalWriter
    from petrobot.coordinator.run.lockstep import CoordinatorParty
    from petrobot.coordinator.run.recording import JournalStore
    from petrobot.services.comm.location_file import load as load_directory
    from petrobot.services.comm.lockstep.cell import LockStepCell

    monkeypatch.syspath_prepend(str(HERE))
    directory, parameters = load_directory(SERVICES), {**TOY.parameters, "regime": "rough"}
    given = {"services_path": str(SERVICES), "seed": 3, "runs": 8, "parameters": parameters}
    texts = (TASK.read_text(encoding="utf-8"), SERVICES.read_text(encoding="utf-8"))
    folder = tmp_path / "fetch-1"
    store = JournalStore(
        JournalWriter(folder / JOURNAL, header("fetch-1", *texts, "lockstep", given)), 0.0
    )
    mission = make_mission(
        directory, Setting(with_runs(TOY, 8)[0], parameters, 8, 3), "fetch-1", "boot", store
    )
    party = CoordinatorParty(directory, mission)
    assert LockStepCell(
        [party, *(lockstep_party(directory, node) for node in directory.nodes.values())]
    ).run(lambda: party.over, 100_000)
    store.writer.sync()
    assert main(["report", str(folder)]) == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    failed = [
        run for run in mission.tally.runs if run.status is not None and run.status != "success"
    ]
    assert failed and all(run.cause in page for run in failed)
    assert page.count("<rect x=") >= len(mission.tally.runs)
    (folder / RESULT).write_text(json.dumps(mission.result("lockstep", 1.0)), encoding="utf-8")
    assert main(["report", str(folder), "--out", str(tmp_path / "again.html")]) == 0
    assert "Where parts lay" in (tmp_path / "again.html").read_text(encoding="utf-8")
    drawn = {p.stem for p in (tmp_path / "again_pictures").glob("*.svg")}
    actions = {
        f"{what}_{task}" for what in ("reliability", "cost") for task in ("look", "grip", "mend")
    }
    objectives = {f"objective_{task}__rough" for task in ("look", "grip")}
    assert drawn == {"gantt", "net", "own_1", "latencies"} | objectives | actions
    capsys.readouterr()


def test_report_of_a_run_that_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It shows the learned probabilities of each trial as `run` learned them; without the estimates
    file the rest is still drawn."""
    monkeypatch.syspath_prepend(str(HERE))
    learned, journals = tmp_path / "learned.db", tmp_path / "runs"
    told = [
        "run",
        str(TASK),
        "--services",
        str(SERVICES),
        "--mode",
        "lockstep",
        "--runs",
        "12",
        "--seed",
        "3",
        "--quiet",
    ]
    assert (
        main([*told, "--regime", "rough", "--learn", str(learned), "--journal", str(journals)]) == 0
    )
    (folder,) = journals.iterdir()
    assert main(["report", str(folder)]) == 0
    picture = (folder / "report_pictures" / "probability_look__rough.svg").read_text(
        encoding="utf-8"
    )
    ElementTree.fromstring(picture)
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert all(action in picture for action in result["learned"]["probabilities"]["look"])
    learned.write_bytes(b"no database at all, but long enough to be looked at" * 9)
    capsys.readouterr()
    assert main(["report", str(folder), "--out", str(tmp_path / "later.html")]) == 0
    assert "no learned probabilities" in capsys.readouterr().err
    assert not (tmp_path / "later_pictures" / "probability_look__rough.svg").exists()
    assert (tmp_path / "later_pictures" / "reliability_look.svg").exists()


@pytest.mark.parametrize(("selector", "batch"), [("nikolic_fu", 6), ("random", 0)])
def test_a_learning_picture_has_the_first_trial_and_the_last(
    selector: str, batch: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trials whose run was repeated are no more trials; the choice is still open at the first."""
    monkeypatch.syspath_prepend(str(HERE))
    digests = {"task": digest(TASK), "services": digest(SERVICES)}
    plan = CampaignPlan(
        *(str(TASK), str(SERVICES), 12, ("easy",)), selector=selector, block=3, batch=batch,
        digests=digests,
    )  # fmt: skip
    campaign = Campaign(tmp_path / "c", plan)
    asyncio.run(campaign.run(InlinePool(plan)))
    rows = [
        replace(row, trial=replace(row.trial, runs=[*row.trial.runs, *row.trial.runs]))
        for row in campaign.table.rows()
        if row.trial is not None
    ]
    trials = objective_curves(TOY, rows)
    learned_curves(plan, rows, trials)
    assert [one.primitive_task for one in trials] == ["look", "grip"]
    for one in trials:
        for points in one.probability.values():
            assert (points[0][0], points[-1][0]) == (1, 12)
            even = pytest.approx(1 / len(one.probability), abs=1e-6)
            assert selector == "random" or points[0][1] == even


# --- the Gantt chart ----------------------------------------------------------------------------


def test_a_letter_that_does_not_fit_its_bar_is_left_out() -> None:
    """Many short failures in a row: no letter reaches over the bars beside it. The one of a long
    run stays."""
    short = [Bar(f"s{i}", "look", "look", i / 10, (i + 0.9) / 10, Status.FAILURE) for i in range(9)]
    long = Bar("long", "look", "look", 1.0, 10.0, Status.ERROR)
    svg = gantt_svg(Timeline({bar.run: bar for bar in (*short, long)}))
    assert svg.count("<rect") == 10
    assert re.findall(r">([FEP])</text>", svg) == ["E"]
