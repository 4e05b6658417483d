"""Regime names, disturbances, and errors of the installation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import fields

from petrobot.sim.catching.puma_model import read_arm
from petrobot.sim.catching.site import Site, read_site
from petrobot.sim.catching.truth import (
    LABORATORY_FILE,
    LaboratoryError,
    Truth,
    read_toml,
    read_truth,
)
from petrobot.sim.laboratory_party import camera_of

SETTINGS = read_toml(LABORATORY_FILE)


def changed(one: Truth, other: Truth) -> set[str]:
    """Return the names of the fields in which two truths differ."""
    names = {f.name for f in fields(Truth)} - {"regime", "settings", "camera", "cup", "table"}
    parts = {name: (getattr(one, name), getattr(other, name)) for name in names}
    for part in ("camera", "cup", "table"):
        a, b = getattr(one, part), getattr(other, part)
        parts |= {f"{part}.{f.name}": (getattr(a, f.name), getattr(b, f.name)) for f in fields(a)}
    return {name for name, (a, b) in parts.items() if not np.array_equal(a, b)}


@pytest.mark.parametrize(
    ("name", "differs"),
    [
        ("A+drift", {"light_drift"}),
        ("A+dim", {"light_level"}),
        ("A+dark15", {"light_level"}),
        ("A+miscalibrated", {"camera.position", "camera.rotation", "cup.mouth"}),
        ("A+latency200", {"image_latency"}),
        ("A,latency400", {"image_latency"}),
        ("A + arm50", {"arm_speed"}),
        ("A+arm30", {"arm_speed"}),
        ("A+bouncy", {"cup.restitution"}),
        ("A+cup50", {"cup.radius"}),
        ("A+jitter+blur+two_balls", {"scatter"}),
        ("A+dim+arm50+bouncy", {"light_level", "arm_speed", "cup.restitution"}),
        ("C", {"speed"}),
    ],
)
def test_a_disturbance_changes_only_what_it_names(site: Site, name: str, differs: set[str]) -> None:
    assert changed(site.truth("A"), site.truth(name)) == differs


def test_another_installation_differs_in_what_installations_differ_in(site: Site) -> None:
    """Camera, mounting, table, cup, friction and spin, the same for every regime and seed; what a
    regime disturbs comes on top."""
    shipped, one, two = (site.truth(name) for name in ("C", "C@1", "C@2"))
    mounted = {f"camera.{f.name}" for f in fields(shipped.camera)} | {"joint_zero", "cup.mouth"}
    mounted |= {"table.top", "table.near_edge", "table.far_edge"}
    differs = mounted | {"cup.radius", "cup.restitution"}
    assert changed(shipped, one) == changed(one, two) == differs
    assert changed(one, site.truth("A@1")) == {"speed"}
    assert changed(one, site.truth("C+bouncy+dim@1")) == {"light_level", "cup.restitution"}
    assert changed(one, site.truth("C@1")) == changed(shipped, site.truth("C@0")) == set()
    found = [site.truth(f"C@{n}") for n in range(1, 40)]
    for key, of in (
        ("friction", [t.settings["ball"]["friction"] for t in found]),
        ("least_spin", [t.settings["ball"]["spin"][0] for t in found]),
        ("cup_radius", [t.cup.radius for t in found]),
        ("cup_restitution", [t.cup.restitution for t in found]),
    ):
        low, high = SETTINGS["installations"][key]
        assert low <= min(of) < max(of) <= high and max(of) - min(of) > 0.7 * (high - low), key
    off = np.array([t.camera.position - shipped.camera.position for t in found])
    assert np.abs(off).max() < 4.5 * SETTINGS["installations"]["camera_position"]


def test_every_disturbance_of_the_file_is_tried_here(site: Site) -> None:
    for name in SETTINGS["disturbances"]:
        assert changed(site.truth("B"), site.truth(f"B+{name}")), name


def test_a_contest_is_the_regime_that_the_file_names(site: Site) -> None:
    assert len(SETTINGS["contests"]) >= 3
    for name, meant in SETTINGS["contests"].items():
        assert not changed(site.truth(meant), site.truth(name)), name
        assert not changed(site.truth(f"{meant}+jitter@3"), site.truth(f"{name}+jitter@3")), name
        with pytest.raises(LaboratoryError, match="both set"):
            site.truth(f"{name}+{meant.rpartition('+')[2]}")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Q", "must begin with one of A, B, C, D, E, F"),
        ("dim", "must begin with"),
        ("A+fog", "unknown disturbance 'fog'"),
        ("A@two", "number of an installation after @, got 'two'"),
        ("A@", "number of an installation after @, got ''"),
        ("A@1+dim", "number of an installation after @, got '1+dim'"),
        ("A+latency200+latency400", "latency200 and latency400 both set image_latency"),
    ],
)
def test_an_unknown_name_is_refused(site: Site, name: str, says: str) -> None:
    with pytest.raises(LaboratoryError, match=says.replace("+", r"\+")):
        site.truth(name)


def test_the_true_cell_is_near_the_nominal_one_but_differs(site: Site) -> None:
    truth, cell = site.truth("A"), site.cell
    assert 1e-4 < np.linalg.norm(truth.camera.position - cell["camera"]["position"]) < 0.03
    assert 1e-4 < np.linalg.norm(truth.cup.mouth - cell["cup"]["mouth"]) < 0.005
    assert 0.0 < np.abs(truth.joint_zero).max() < 2e-3
    assert truth.camera.rotation @ truth.camera.rotation.T == pytest.approx(np.eye(3))
    assert truth.camera.rotation[2] @ [0.0, 0.0, -1.0] > 0.999


def test_light_drifts_around_its_level(site: Site) -> None:
    truth = site.truth("A+drift")
    levels = [truth.light(0.1 * k) for k in range(80)]
    assert max(levels) == pytest.approx(1.35, abs=0.01) and min(levels) == pytest.approx(
        0.65, abs=0.01
    )
    assert {site.truth("A").light(t) for t in (0.0, 1.0, 5.0)} == {1.0}


def test_the_file_says_how_even_the_light_is_and_the_camera_shows_it(
    site: Site, tmp_path: Path
) -> None:
    nominal = site.truth("A")
    assert nominal.light_gradient == (-0.50, 0.10) and nominal.vignetting == 0.20
    text = LABORATORY_FILE.read_text(encoding="utf-8")
    file = tmp_path / "laboratory.toml"
    file.write_text(text.replace("light_gradient = [-0.50, 0.10]", "light_gradient = [0.0, 0.0]"))
    even = read_truth(site.cell, "A", file)
    assert changed(nominal, even) == {"light_gradient"}
    bright, dim = (
        camera_of(site.cell, truth, np.random.default_rng(0)).illumination
        for truth in (even, nominal)
    )
    assert float(bright[240, 630]) == pytest.approx(float(bright[240, 9]), abs=1e-3)
    assert float(dim[240, 630]) < 0.7 * float(dim[240, 9])


@pytest.mark.parametrize("text", ["[table\n", "[arm]\n", ""])
def test_a_bad_cell_file_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "cell.toml"
    file.write_text(text)
    with pytest.raises(LaboratoryError, match=r"cell\.toml"):
        read_site(file)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(LaboratoryError, match=r"nowhere\.toml: cannot be read"):
        read_site(tmp_path / "nowhere.toml")


def test_a_cell_without_a_key_is_refused(site: Site) -> None:
    cell = {name: dict(table) for name, table in site.cell.items() if isinstance(table, dict)}
    del cell["camera"]["focal_px"]
    with pytest.raises(LaboratoryError, match="focal_px"):
        read_truth(cell, "A")


@pytest.mark.parametrize("text", ["", "joint = []\nlink = []\n"])
def test_a_bad_arm_file_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(text)
    with pytest.raises(LaboratoryError, match=r"arm\.toml"):
        read_arm(file)
