"""What a study file tells its laws beside place and time: the vertical motion, the clamp and the length of the beam."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runs import FPS, KNOWN, MASS, lift

from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.fit import fit
from frictrack.flow import Session, open_study
from frictrack.simulate import Conditions, simulate

LAW = {
    "coulomb": {"F_c": 8.0},
    "viscous": {"F_v": 1.2},
    "measured_load": {"coefficient": 1.0},
    "beam_vibration": {"amplitude": 1.0, "frequency": 60.0, "r": 0.8, "beam_length": 0.9, "phase": 0.4},
}
HEAD = f"""
[study]
mass = "{MASS} kg"
model = ["{'", "'.join(LAW)}"]
"""


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tables with x and y, of a mass that is carried up and down over a beam that rings, and their motion."""
    folder = tmp_path_factory.mktemp("measured")
    rng, t = np.random.default_rng(0), np.arange(480) / FPS
    text = HEAD
    for i, speed in enumerate((3.0, 5.0)):
        slide = simulate(models.of(LAW), LAW, Conditions(MASS, lift=lift, **KNOWN["beam_vibration"]), t, (0.0, speed))
        y = -lift(t) / (2 * np.pi * 33.0) ** 2
        seen = np.column_stack([t, slide.x, y]) + [0, 2e-6, 2e-6] * rng.standard_normal((len(t), 3))
        np.savetxt(folder / f"r{i}.csv", seen, delimiter=",", header="t_s,x_m,y_m", comments="")
        text += f'\n[[run]]\ntable = "r{i}.csv"\nclamp_x = "-100 mm"\nbeam_length = "0.9 m"\n'
    path = folder / "study.toml"
    path.write_text(text)
    Session(open_study(path)).bring_up_to("motion")
    return folder


@pytest.fixture
def study_file(measured: Path, tmp_path: Path) -> Path:
    shutil.copytree(measured, tmp_path, dirs_exist_ok=True)
    return tmp_path / "study.toml"


def test_the_law_is_found_and_a_beam_measured_anew_is_fitted_anew(study_file: Path) -> None:
    session = Session(open_study(study_file))
    parameters = session.fit()["parameters"]
    assert parameters["beam_vibration.beam_length"] | {"at_bound": False} == {
        **{"value": 0.9, "std": 0.0, "unit": "m", "at_bound": False, "reason": "fixed"}
    }
    assert parameters["measured_load.coefficient"]["value"] == pytest.approx(1.0, abs=0.03)
    for name in ("frequency", "r", "amplitude"):
        found = parameters[f"beam_vibration.{name}"]
        assert found["value"] == pytest.approx(LAW["beam_vibration"][name], abs=max(5 * found["std"], 0.02))
    study_file.write_text(study_file.read_text().replace('"0.9 m"', '"1.1 m"'))
    again = Session(open_study(study_file)).fit()["parameters"]
    assert again["beam_vibration.beam_length"]["value"] == 1.1
    assert again["beam_vibration.r"]["value"] > 1.2 * parameters["beam_vibration.r"]["value"]


@pytest.mark.slow
def test_a_length_that_nobody_measured_is_fitted(study_file: Path) -> None:
    runs = [work.to_run() for work in Session(open_study(study_file)).bring_up_to("motion")]
    blind = [replace(run, beam_length=None) for run in runs]
    found = fit(["coulomb", "viscous", "beam_vibration"], blind).parameters["beam_vibration.beam_length"]
    assert found.reason != "fixed"  # from so short a travel it may well be told as unknown, but not as given
    assert found.std != 0.0


def test_the_sign_of_y_counts(study_file: Path) -> None:
    """A picture turned upside down lightens the mass where it is pressed on."""
    runs = [work.to_run() for work in Session(open_study(study_file)).bring_up_to("motion")]
    turned = [replace(r, motion=replace(r.motion, a_y=-r.motion.a_y)) for r in runs]
    law = ["coulomb", "viscous", "measured_load"]
    assert fit(law, runs).parameters["measured_load.coefficient"].value > 0.5
    assert fit(law, turned).parameters["measured_load.coefficient"].value < 0.05


def test_what_is_not_told_is_asked_for(study_file: Path) -> None:
    table = study_file.parent / "r1.csv"
    table.write_text(table.read_text().replace("y_m", "height"))
    with pytest.raises(FrictrackError, match="measured_load needs the vertical motion of every run; give a film, or a"):
        Session(open_study(study_file)).fit()
    text = study_file.read_text().replace('"measured_load", ', "").replace('clamp_x = "-100 mm"\n', "")
    study_file.write_text(text)
    with pytest.raises(FrictrackError, match=r"beam_vibration needs the place of the clamp of every run; give clamp_x"):
        Session(open_study(study_file)).fit()
