"""A new effect is one file: it appears in fit, diagnosis, plan, blind studies, report and page without another line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import frictrack

pytestmark = pytest.mark.slow
EFFECT = '''"""Magnet: a magnet below the course pulls the mass toward one place."""

import numpy as np

from frictrack.effects.definition import DirectCheck, Parameter, TestDraw

COMPASS_STD = 0.1  # N


def columns(path, nonlinear):
    z = (path.x - nonlinear["x_m"]) / nonlinear["width"]
    return (z * np.exp(-(z**2) / 2))[:, None]


def describe(effect):
    return f"a pull of {effect.value('F'):.2f} N toward x = {effect.value('x_m'):.3f} m"


equation = "F z exp(-z^2/2), z = (x - x_m)/width"
parameters = (
    Parameter("F", "N", linear=True),
    Parameter("x_m", "m", scan=lambda span: np.linspace(span.x_min, span.x_max, 41), signed=True),
    Parameter("width", "m", scan=lambda span: np.geomspace(0.02, 0.1, 5) * (span.x_max - span.x_min)),
)
what = "A magnet below the course."
looks_like = "a pull forth and back round one place, in either direction of motion"
mistaken_for = "a patch, in one direction"
confirm = "Hold a compass to the course."
source = "a test"
invariant = "a magnet keeps its place and pulls in either direction of motion"
direct_check = DirectCheck("compass", "Move a compass along the course", lambda e: (e.rms("F") / COMPASS_STD) ** 2)
test_draw = TestDraw(positive=True)
'''

# What else may be missing, and may be mistaken for it: with all effects this takes half a minute more.
FEW = ("coulomb", "stribeck", "viscous", "drag", "vibration", "texture", "patch", "spring", "slope")

# Run in the temporary package; prints what every part of the program says about the effect.
SCRIPT = """
import json
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from frictrack.validation.blind.truth_sampling import LAWS, candidates, draw_truth
from frictrack.effects import LIBRARY
from frictrack.fit import global_search
from frictrack.flow import Session, open_study, plan
from frictrack.diagnose.experiments import candidates as planned_runs, selection
from frictrack.workbench.summaries import effect_library

# less work of what is not asked here: the searches of a report, and a plan of many runs
for module, name, value in (
    (global_search, "MAX_EVALUATIONS", 4000),
    (selection, "MAX_RUNS", 1),
    (planned_runs, "SPEEDS_M_S", (4.0,)),
    (planned_runs, "RETURN_SPEEDS_M_S", (4.0,)),
):
    assert hasattr(module, name)
    setattr(module, name, value)

rng = np.random.default_rng(1)
text = '[study]\\nname = "magnet"\\nmass = "0.3 kg"\\nmodel = ["coulomb", "viscous"]\\n'
t = np.arange(350) / 2000.0
for i, v0 in enumerate((2.5, 4.5, -3.5)):
    def change(t, y):
        z = (y[0] - 0.2) / 0.03
        return [y[1], -(1.5 * np.sign(v0) + 0.2 * y[1] + 0.8 * z * np.exp(-(z**2) / 2)) / 0.3]
    x = solve_ivp(change, (0, t[-1]), [0.0 if v0 > 0 else 0.4, v0], t_eval=t, rtol=1e-9, atol=1e-12).y[0]
    rows = np.c_[t, x + 1e-5 * rng.normal(size=len(t))]
    np.savetxt(f"r{i}.csv", rows, delimiter=",", header="t_s,x_m", comments="")
    text += f'\\n[[run]]\\nname = "r{i}"\\ntable = "r{i}.csv"\\n'
Path("study.toml").write_text(text)

session = Session(open_study(Path("study.toml")))
before = session.fit()["errors"]["heldout_rms_um"]
diagnosis = session.diagnose()
session.add("magnet")
fitted = session.fit()
planned = json.dumps(plan(open_study(Path("study.toml"))), default=str)
report = session.report().read_text(encoding="utf-8")
turn = list(dict.fromkeys(name for law, _ in LAWS for name in candidates("one", law))).index("magnet")
print(json.dumps({
    "last": list(LIBRARY)[-1],
    "missing": diagnosis["missing"],
    "here": next(c for c in diagnosis["candidates"] if c["effect"] == "magnet")["words"]["here"],
    "limits": "magnet" in diagnosis["detection_limits"],
    "parameters": {k: v["value"] for k, v in fitted["parameters"].items() if k.startswith("magnet")},
    "heldout": [before, fitted["errors"]["heldout_rms_um"]],
    "plan": planned.count("magnet"),
    "hidden": draw_truth(3, "one", turn).hidden,
    "report": report.count("magnet"),
    "page": {one["name"]: one["what"] for one in effect_library(open_study(Path("study.toml")))}["magnet"],
}))
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What a copy of the package with one more file says of the effect in it."""
    folder = tmp_path_factory.mktemp("package")
    source = Path(frictrack.__file__).parent
    shutil.copytree(source, folder / "frictrack")
    library = folder / "frictrack" / "effects" / "library"
    for path in library.glob("[!_]*.py"):
        if path.stem not in FEW:
            path.unlink()
    (library / "magnet.py").write_text(EFFECT, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_it_is_found_fitted_and_lowers_the_error(said):
    assert said["last"] == "magnet"
    assert said["missing"] == ["magnet"]
    values = said["parameters"]
    assert abs(values["magnet.F"] - 0.8) < 0.02
    assert abs(values["magnet.x_m"] - 0.2) < 0.002
    assert abs(values["magnet.width"] - 0.03) < 0.001
    assert said["heldout"][1] < 0.1 * said["heldout"][0]


def test_it_describes_itself_in_the_numbers_of_the_study(said):
    assert said["here"].startswith("A pull of 0.8")
    assert "toward x = 0.2" in said["here"]
    assert said["limits"]


def test_a_plan_takes_it_for_a_possible_cause(said):
    assert said["plan"]


def test_it_is_hidden_in_blind_studies(said):
    assert said["hidden"] == ["magnet"]


def test_report_and_page_show_it(said):
    assert said["report"] > 5
    assert said["page"] == "A magnet below the course."
