"""Light commands start quickly: they do not import the science that they do not use."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.base.units import _PREFIXES, _UNITS, _WITHOUT_PREFIX, _convert, _convert_with_pint
from frictrack.flow import Session, open_study

HEAVY = ("scipy", "cv2", "pandas", "matplotlib", "pint", "jinja2", "tifffile", "openpyxl")
PARTS = ("fit", "diagnose", "measure.motion", "tracking.driver", "diagnose.experiments", "present.report", "simulate")
SCIENCE = tuple(f"frictrack.{part}" for part in PARTS)
LISTED = """
import sys
from frictrack.cli import main
try:
    main(sys.argv[1:])
except SystemExit:
    pass
sys.stderr.write(" ".join(name for name in sys.modules if name.count(".") < 3))
"""
STUDY = """
[study]
mass = "350 +/- 2 g"
model = ["coulomb", "viscous"]

[camera]
fps = "4 kHz"
scale = "0.5 mm/px"

[[run]]
table = "a.csv"
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    t = np.arange(60) / 4000
    rows = "\n".join(f"{at:.6f},{at - at * at:.9f}" for at in t)
    (tmp_path / "a.csv").write_text(f"t_s,x_m\n{rows}\n", encoding="utf-8")
    (tmp_path / "study.toml").write_text(STUDY, encoding="utf-8")
    return tmp_path / "study.toml"


def imported(*arguments: object) -> set[str]:
    """The modules that a command imports."""
    command = [sys.executable, "-c", LISTED, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return set(done.stderr.splitlines()[-1].split())


def heavy(modules: set[str]) -> list[str]:
    """Those that a light command can do without; the bare `scipy`, which loads its parts on first use, is light."""
    packages = {name.partition(".")[0] for name in modules}
    parts = [name for name in modules if name.startswith("scipy.") and name.count(".") < 2 and name[6] != "_"]
    parts = [name for name in parts if name != "scipy.version"]
    return sorted([*(packages & set(HEAVY[1:])), *parts, *(modules & set(SCIENCE))])


@pytest.mark.parametrize("arguments", [("--help",), ("diagnose", "--help"), ("effects", "--json"), ("--version",)])
def test_commands_without_a_study_import_no_science(arguments: tuple[str, ...]) -> None:
    assert heavy(imported(*arguments)) == []


def test_help_does_not_wait_for_numpy() -> None:
    assert not imported("--help") & {"numpy", "h5py", "pydantic", "rich", "tornado", "asyncio"}
    assert "tornado" not in imported("app", "--help")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("old", "new"), [('mass = "350', 'masss = "350'), ("viscous", "viscos"), ("0.5 mm/px", "0.5 kg")]
)
def test_a_fault_in_a_study_file_is_reported_without_the_science(study: Path, old: str, new: str) -> None:
    study.write_text(STUDY.replace(old, new), encoding="utf-8")
    assert heavy(imported("run", study)) == []


def test_stored_results_are_read_without_the_science(study: Path) -> None:
    Session(open_study(study)).compare()
    for command in ("history", "compare", "verify"):
        assert heavy(imported(command, study)) == [], command


@pytest.mark.few(10)
@pytest.mark.parametrize("unit", _UNITS)
@pytest.mark.parametrize("power", ["", "^2", "^3"])
def test_ordinary_units_convert_as_pint_converts_them(unit: str, power: str) -> None:
    values = np.array([0.35, 350.0, 1 / 3])
    wanted = {"g": "kg", "deg": "rad"}.get(unit, unit) + power
    for prefix in ("",) if unit in _WITHOUT_PREFIX else _PREFIXES:
        given = f"{prefix}{unit}{power}"
        expected = _convert_with_pint(values, given, wanted, "x")
        np.testing.assert_allclose(_convert(values, given, wanted, "x"), expected, rtol=1e-15)


@pytest.mark.few(12)
@pytest.mark.parametrize("given", ["mm/px", "um/ms", "kN/mm^2", "cm^2", "g", "N/m", "deg/s", "m/s^2"])
@pytest.mark.parametrize("wanted", ["m/px", "m/s", "Pa", "kg", "rad/s", "m/s^2", "N", "Hz"])
def test_a_unit_of_another_quantity_is_refused_as_pint_refuses_it(given: str, wanted: str) -> None:
    values = np.array([0.35, 350.0])
    found, expected = (outcome(convert, values, given, wanted) for convert in (_convert, _convert_with_pint))
    assert type(found) is type(expected)
    if isinstance(found, str):
        assert found == expected
    else:
        np.testing.assert_allclose(found, expected, rtol=1e-15)


def outcome(convert, values, given, wanted):
    """Converted values, or the message of the error."""
    try:
        return convert(values, given, wanted, "x")
    except FrictrackError as e:
        return str(e)
