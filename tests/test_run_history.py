"""What was slid before a run: distances and rests, and the effects that they part, integrated by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from runs import measured
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.diagnose import diagnose
from frictrack.effects import LIBRARY
from frictrack.fit import add_effect, fit

MASS = 0.35
SPEEDS = (3.0, 5.0, 6.0, 4.0, 5.0, -5.0, 3.5, 6.0)  # m/s
PAUSES = (0.0, 10.0, 60.0, 10.0, 600.0, 15.0, 300.0, 8.0)  # s


def heating(k, tau):
    """Dry friction, N, in proportion to what is slid in this run and still warm of those before."""
    return lambda slid, earlier: 7.0 - k * (slid + sum(way * np.exp(-rest / tau) for rest, way in earlier))


def run_in(dF, length):
    """Dry friction, N, that falls with all that has been slid."""
    return lambda slid, earlier: 7.0 - dF * (1 - np.exp(-(slid + sum(way for _, way in earlier)) / length))


def series(dry, *, scatter=0.01, seed=3, sigma=1e-5):
    """Runs one after the other, m x'' = -s level dry(...) - 0.6 v, with noise of sigma m; and what was before each."""
    rng, now, done, runs, pasts = np.random.default_rng(seed), 0.0, [], [], []
    for i, (speed, pause) in enumerate(zip(SPEEDS, PAUSES, strict=True)):
        now += pause
        past, s, level = tuple((now - end, way) for end, way in done), np.sign(speed), 1 + scatter * rng.normal()

        def moves(t, y, past=past, s=s, level=level):
            return [y[1], -(s * level * dry(abs(y[0]), past) + 0.6 * y[1]) / MASS]

        t = np.arange(0, 0.1, 1 / 4000)
        solved = solve_ivp(moves, (0, t[-1]), [0.0, speed], t_eval=t, rtol=1e-11, atol=1e-13)
        runs.append(measured(t, solved.y[0], sigma=sigma, mass=MASS, name=f"r{i}", rng=rng, pitch=1e-3))
        now += t[-1]
        done.append((now, abs(solved.y[0, -1])))
        pasts.append(past)
    return runs, pasts


def test_rests_add_up_and_distances_are_those_of_the_motion():
    runs, pasts = series(lambda slid, earlier: 7.0)
    for run, past in zip(ft.with_earlier_runs(runs, PAUSES), pasts, strict=True):
        np.testing.assert_allclose(np.reshape(run.earlier, (-1, 2)), np.reshape(past, (-1, 2)), atol=1e-4)


def test_before_an_unknown_pause_nothing_is_known():
    runs = ft.samples.runs()[:3]
    known = [run.earlier for run in ft.with_earlier_runs(runs, [None, 5.0, None])]
    assert known[0] == ()
    assert known[1] is not None
    assert known[2] is None
    assert [run.earlier for run in ft.with_earlier_runs(runs, [3.0, None, None])] == [None] * 3
    with pytest.raises(FrictrackError, match="expected one pause for each of the 3 runs but got 2"):
        ft.with_earlier_runs(runs, [None, 5.0])


PARTED = [
    ("heating", heating(2.0, 30.0), {"k": 2.0, "tau": 30.0}),
    ("run_in", run_in(1.0, 2.0), {"dF": 1.0, "length": 2.0}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "dry"), [(name, dry) for name, dry, _ in PARTED])
def test_the_effect_is_named(name, dry):
    found = diagnose(fit(["coulomb", "viscous"], ft.with_earlier_runs(series(dry)[0], PAUSES)), quick=True)
    assert (found.verdict, found.missing) == ("missing", [name])


@pytest.mark.parametrize(("name", "dry", "truth"), PARTED)
def test_its_values_are_right_where_friction_levels_change_with_them(name, dry, truth):
    fitted = fit(["coulomb", "viscous", name], ft.with_earlier_runs(series(dry)[0], PAUSES))
    for parameter, value in truth.items():
        estimate = fitted.parameters[f"{name}.{parameter}"]
        assert abs(estimate.value - value) < 3 * estimate.std
        assert estimate.std < 0.3 * value


@pytest.mark.slow
def test_a_law_that_took_up_much_of_the_effect_gives_it_back_when_the_effect_is_added():
    """Levels and Stribeck effect imitate it; its motions start elsewhere, by many standard deviations of 0.7 um."""
    runs = ft.with_earlier_runs(series(heating(1.0, 30.0), sigma=7e-7)[0], PAUSES)
    found = add_effect(fit("tustin", runs).solution, LIBRARY["heating"])
    assert found.chi2 == pytest.approx(found.problem.n_frames, rel=0.1)


def test_without_pauses_the_reason_is_said():
    found = diagnose(fit(["coulomb", "viscous"], series(lambda slid, earlier: 7.0)[0]), quick=True)
    assert found.verdict == "complete"
    assert any("run_in and heating need the pause of every run; give pause" in remark for remark in found.remarks)


@pytest.mark.slow
def test_a_study_file_gives_the_pauses(tmp_path):
    runs, _ = series(heating(1.0, 30.0))
    text = '[study]\nmass = 0.35\nmodel = ["coulomb", "viscous"]\n[camera]\nfps = 4000\n'
    for run, pause in zip(runs, PAUSES, strict=True):
        seen = run.displacement
        rows = np.column_stack([seen.t, seen.x, seen.sigma_x])
        np.savetxt(tmp_path / f"{run.name}.csv", rows, delimiter=",", header="t_s,x_m,sigma_m", comments="")
        text += f'[[run]]\ntable = "{run.name}.csv"\n' + (f'pause = "{pause / 60} min"\n' if pause else "")
    (tmp_path / "study.toml").write_text(text)
    session = ft.flow.Session(ft.flow.open_study(tmp_path / "study.toml"))
    session.fit()
    assert session.diagnose(1)["missing"] == ["heating"]
    before = session.models.input_hash
    (tmp_path / "study.toml").write_text(text.replace(f'"{10 / 60} min"', '"5 s"'))
    assert ft.flow.Session(ft.flow.open_study(tmp_path / "study.toml")).models.input_hash != before
