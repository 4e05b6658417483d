"""The interface between the laboratory and its mechanics: which back end is chosen, that the
package runs without PyBullet, and that records of two back ends are never mixed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from petrobot.coordinator.cli import main
from petrobot.coordinator.learning.estimate import Observation, Tally, TallyKey
from petrobot.coordinator.learning.estimates_file import EstimatesError, EstimatesFile
from petrobot.coordinator.learning.learning import Estimates
from petrobot.coordinator.run.journal import read_journal
from petrobot.coordinator.task import Status
from petrobot.services.comm.location_file import FIRST_PHYSICS, load, physics_of, same_physics
from petrobot.sim.catching import physics as seam
from petrobot.sim.catching.laboratory import make_laboratory
from petrobot.sim.catching.physics import BULLET, PORTABLE, PORTABLE_VERSION, choose, version
from petrobot.sim.catching.truth import LABORATORY_FILE, LaboratoryError
from tests.sim.conftest import needs_bullet

ROOT = Path(__file__).parents[2]
NOW = f"portable {PORTABLE_VERSION}"


def test_without_a_name_bullet_is_chosen_where_it_is_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for there, expected in ((object(), BULLET), (None, PORTABLE)):
        monkeypatch.setattr(seam, "find_spec", lambda name, there=there: there)
        assert choose() == expected
        assert choose(PORTABLE) == PORTABLE


def test_an_unavailable_back_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LaboratoryError, match='expected "bullet" or "portable", got \'mujoco\''):
        choose("mujoco")
    monkeypatch.setattr(seam, "find_spec", lambda name: None)
    with pytest.raises(LaboratoryError, match=r'not installed here .* write physics = "portable"'):
        choose(BULLET)


def cell(folder: Path, key: str = "", laboratory: str = "") -> Path:
    """A copy of services.toml with a key of the simulated node and a line of the laboratory's
    file."""
    text = (ROOT / "services.toml").read_text(encoding="utf-8")
    made = "petrobot.sim.catching.laboratory:make_laboratory"
    text = text.replace(f'sim = "{made}"\n', f'sim = "{made}"\n{key}\n')
    if laboratory:
        (folder / "laboratory.toml").write_text(
            laboratory + "\n" + LABORATORY_FILE.read_text(encoding="utf-8"), encoding="utf-8"
        )
        text = text.replace("[parameters]\n", '[parameters]\nlaboratory = "laboratory.toml"\n')
    file = folder / "services.toml"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("key", "laboratory", "expected"),
    [
        ('physics = "portable"', "", NOW),
        ("", 'physics = "portable"', NOW),
        ('physics = "portable"', 'physics = "bullet"', NOW),
        pytest.param("", "", FIRST_PHYSICS, marks=needs_bullet),
        pytest.param(
            'physics = "bullet"', 'physics = "portable"', FIRST_PHYSICS, marks=needs_bullet
        ),
    ],
)
def test_services_toml_and_the_laboratory_file_name_the_back_end(
    tmp_path: Path, key: str, laboratory: str, expected: str
) -> None:
    directory = load(cell(tmp_path, key, laboratory))
    assert physics_of(directory) == expected
    made = make_laboratory(directory, "laboratory")
    assert made.physics == made.serve("laboratory_score", {})["physics"] == expected
    made.close()


@pytest.mark.parametrize(
    ("key", "laboratory", "where"),
    [('physics = "ode"', "", "[nodes.laboratory]"), ("", 'physics = "ode"', "laboratory.toml")],
)
def test_a_wrong_name_is_refused_with_its_position(
    tmp_path: Path, key: str, laboratory: str, where: str
) -> None:
    with pytest.raises(LaboratoryError) as caught:
        physics_of(load(cell(tmp_path, key, laboratory)))
    assert where in str(caught.value) and "'ode'" in str(caught.value)


def test_a_laboratory_with_only_one_physics_does_not_name_it() -> None:
    assert physics_of(load(ROOT / "services" / "mobile" / "track.services.toml")) == ""


@needs_bullet
def test_bullet_reports_the_installed_version() -> None:
    assert version(BULLET) == FIRST_PHYSICS


def test_old_records_count_as_bullets() -> None:
    assert same_physics("", FIRST_PHYSICS) and same_physics("", "") and same_physics(NOW, NOW)
    assert not same_physics("", NOW) and not same_physics(NOW, FIRST_PHYSICS)


@pytest.mark.processes
def test_a_whole_run_without_pybullet_and_its_records(tmp_path: Path) -> None:
    """As on a computer without PyBullet: two balls are caught, and journal, result and estimates
    name the portable back end."""
    program = (
        "import sys; sys.modules['pybullet'] = None\n"
        "from petrobot.coordinator.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    given = ["run", "catch_ball", "--mode", "lockstep", "--seed", "3", "--runs", "2"]
    given += ["--journal", str(tmp_path / "runs"), "--json", str(tmp_path / "out.json")]
    given += ["--learn", str(tmp_path / "lab.estimates"), "--services", str(cell(tmp_path))]
    done = subprocess.run(
        [sys.executable, "-c", program, *given],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert (result["physics"], result["caught"], result["over"]) == (NOW, 2, 2)
    (journal,) = (tmp_path / "runs").glob("*/run.journal")
    assert read_journal(journal).header["physics"] == NOW
    assert EstimatesFile(tmp_path / "lab.estimates").read().physics == NOW


@needs_bullet
def test_a_run_with_another_physics_is_refused_before_it_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    learned = tmp_path / "lab.estimates"
    EstimatesFile(learned).add(some_estimates(), {}, physics=NOW)
    before = EstimatesFile(learned).read()
    given = ["run", "catch_ball", "--mode", "lockstep", "--runs", "1", "--learn", str(learned)]
    assert main([*given, "--journal", str(tmp_path / "runs")]) == 2
    said = capsys.readouterr().err
    assert NOW in said and FIRST_PHYSICS in said and "not pooled" in said
    assert EstimatesFile(learned).read() == before and not list(tmp_path.glob("runs/*"))


def some_estimates() -> Estimates:
    made, key = Estimates(), TallyKey("locate_ball", "locate_hough", "")
    made.tallies[key] = Tally().adding(Observation(Status.SUCCESS, 0.4), "t")
    return made


@pytest.mark.parametrize(
    ("mine", "other", "fits"),
    [
        (NOW, NOW, True),
        ("", "", True),
        ("", FIRST_PHYSICS, True),
        (FIRST_PHYSICS, "", True),
        (NOW, "", False),
        ("", NOW, False),
        (NOW, FIRST_PHYSICS, False),
    ],
)
def test_estimates_of_two_physics_are_not_merged(
    tmp_path: Path, mine: str, other: str, fits: bool
) -> None:
    """An empty name stands for a file written before files named their physics."""
    files = [EstimatesFile(tmp_path / name) for name in ("mine", "other")]
    for file, physics in zip(files, (mine, other), strict=True):
        file.add(some_estimates(), {}, physics=physics)
    if fits:
        files[0].merge(files[1].path)
        assert files[0].read().physics == (other or mine)
        return
    with pytest.raises(EstimatesError, match="different physics are not pooled"):
        files[0].merge(files[1].path)
    with pytest.raises(EstimatesError, match="different physics are not pooled"):
        files[0].add(some_estimates(), {}, physics=other)
    files[0].reset()
    files[0].add(some_estimates(), {}, physics=other)  # An emptied file accepts any physics.
    assert files[0].read().physics == other


def test_a_campaign_is_not_continued_with_another_physics() -> None:
    from petrobot.coordinator.studies.campaign.plan import CampaignPlan, differences, identity

    plans = [
        CampaignPlan("t", "s", 10, ("A",), physics=physics) for physics in ("", FIRST_PHYSICS, NOW)
    ]
    assert differences(plans[0], plans[1]) == [] and identity(plans[0]) == identity(plans[1])
    assert differences(plans[1], plans[2]) == ["physics"] == differences(plans[0], plans[2])
    assert identity(plans[2]) != identity(plans[0])
    old = plans[0].to_plain()
    del old["physics"]  # a manifest of an earlier version
    assert CampaignPlan.from_plain(old) == plans[0]


@needs_bullet
def test_a_worker_with_another_physics_is_refused() -> None:
    """Workers of a campaign may be on different computers."""
    from petrobot.coordinator.studies.campaign.block import LoadedPlan, run_block
    from petrobot.coordinator.studies.campaign.plan import CampaignError, CampaignPlan

    task = ROOT / "coordinator" / "tasks" / "catch_ball.toml"
    plan = CampaignPlan(str(task), str(ROOT / "services.toml"), 1, ("A",), physics=NOW)
    with pytest.raises(CampaignError, match=f"ran with the physics '{FIRST_PHYSICS}'"):
        run_block(LoadedPlan.of(plan), plan.blocks[0], [{}])
