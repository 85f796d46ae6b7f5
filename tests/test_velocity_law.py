"""The law over the speed, and the force of a model through the filter of the measurement."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.present import plots
from frictrack.records import Run

FPS, MASS, GRAVITY = 2000, 0.35, 9.80665


def slide(v0, force, noise=1e-6, cutoff=None, rng=0, mass=MASS):
    """A slide integrated by SciPy, as a run."""
    t = np.arange(0, 0.25, 1 / FPS)
    motion = solve_ivp(
        lambda t, z: [z[1], -force(z[0], z[1]) / mass], (0, t[-1]), [0.0, v0], t_eval=t, rtol=1e-10, atol=1e-12
    )
    x = motion.y[0] + noise * np.random.default_rng(rng).standard_normal(len(t))
    run = Run.from_arrays(t, x, mass=mass, sigma=noise, name=f"v{v0:g}")
    if cutoff is None:
        return run
    filtered = ft.low_pass(run.displacement, cutoff)
    return Run(run.displacement, ft.differentiate(filtered), mass=mass, name=run.name)


def two_ways(x, v):
    """Dry friction that is larger toward +x, and a viscous part."""
    return (1.2 if v > 0 else -0.9) + 0.3 * v


@pytest.fixture(scope="module")
def both_directions():
    runs = [slide(v0, two_ways, rng=k) for k, v0 in enumerate((3.0, 2.0, -3.0, -2.0))]
    return ft.fit(["coulomb", "viscous", "asymmetry"], runs)


def test_law_is_that_of_the_runs_in_each_direction(both_directions):
    forward, backward = both_directions.summary()["law"]
    assert (forward["direction"], backward["direction"]) == (1, -1)
    for branch, dry in ((forward, 1.2), (backward, 0.9)):
        v, F, sigma = (np.array(branch[key]) for key in ("v", "F", "sigma_F"))
        assert np.all(np.diff(v) > 0)
        assert v[-1] == pytest.approx(3.0, abs=0.01)
        assert np.all(np.abs(F - dry - 0.3 * v) < 4 * sigma + 1e-4), np.max(np.abs(F - dry - 0.3 * v) / sigma)
        assert branch["load_N"] == pytest.approx(MASS * GRAVITY)


def test_band_of_the_law_follows_from_the_covariance_of_its_parameters():
    fit = ft.fit(["coulomb", "viscous"], [slide(3.0, lambda x, v: 1.0 + 0.2 * v)])
    (branch,) = fit.law
    slots = [(s.effect, s.parameter) for s in fit.solution.problem.layout.slots]
    at = [slots.index(("coulomb", "F_c")), slots.index(("viscous", "F_v"))]
    c, v = fit.covariance[np.ix_(at, at)], np.array(branch["v"])
    assert np.allclose(branch["sigma_F"], np.sqrt(c[0, 0] + 2 * v * c[0, 1] + v**2 * c[1, 1]), rtol=1e-5)


def test_effects_of_place_and_time_are_no_part_of_the_law():
    fit = ft.fit(["coulomb", "viscous", "patch", "drift"], ft.samples.runs()[:2])
    assert fit.law[0]["effects"] == ["coulomb", "viscous"]
    figure = fit.plot("law")
    points, law = figure.axes[0].lines[:2]
    assert np.allclose(law.get_ydata(), fit.law[0]["F"])
    near = np.interp(points.get_xdata(), law.get_xdata(), law.get_ydata())
    assert np.median(np.abs(points.get_ydata() - near)) < 0.05  # the patch is taken out of the measured force


def test_figure_has_one_panel_per_direction_and_an_axis_of_mu(both_directions):
    figure = both_directions.plot("law")
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["toward +x (v > 0)", "toward −x (v < 0)"]
    (right,) = figure.axes[1].child_axes
    assert right.get_ylabel() == "coefficient of friction µ"
    plots.png(figure)
    low, high = figure.axes[1].get_ylim()
    assert np.allclose(right.get_ylim(), np.array([low, high]) / (MASS * GRAVITY))
    with pytest.raises(FrictrackError, match='expected force or law or convergence but got "laws"'):
        both_directions.plot("laws")


def narrow_patch(x, v):
    return np.sign(v) * (1.0 + 0.6 * np.exp(-0.5 * ((x - 0.2) / 0.012) ** 2))


@pytest.mark.slow
def test_model_is_compared_and_drawn_through_the_filter_of_the_measurement():
    runs = [slide(v0, narrow_patch, cutoff=20.0, rng=k) for k, v0 in enumerate((1.8, 2.2))]
    fit = ft.fit(["coulomb", "patch"], runs)
    assert fit.reduced_chi2 < 1.2
    for run, curve in zip(runs, fit.curves, strict=True):
        seen = ft.differentiate(ft.low_pass(plus_model(run, curve), 20.0))  # filtered as a whole
        inside = slice(80, -80)
        truth = -MASS * seen.a[np.searchsorted(run.motion.t, curve.t - 1e-9)]
        assert np.max(np.abs(curve.F_filtered - truth)[inside]) < 0.002 * np.max(curve.F_model)
        assert np.max(curve.F_model) - np.max(curve.F_filtered) > 0.15  # what the filter takes from the peak
    assert fit.errors["relative_force_error"] < 0.01  # 0.1 where the sharp model was compared with the filtered force
    drawn = fit.plot().axes[0].lines
    measured, model = (line.get_ydata() for line in drawn[:2])
    assert np.nanmax(model) == pytest.approx(np.nanmax(measured), rel=0.02)


def plus_model(run, curve):
    """The displacement of a run with the positions of the model where it was fitted."""
    x = run.displacement.x.copy()
    x[np.searchsorted(run.motion.t, curve.t - 1e-9)] = curve.x_model
    d = run.displacement
    return type(d)(d.t, x, d.y, d.angle, d.sigma_x, d.sigma_y, d.valid)


def test_a_motion_of_an_unknown_filter_leaves_the_force_as_it_is():
    run = slide(2.0, narrow_patch)
    bare = Run(run.displacement, type(run.motion)(**{**vars(run.motion), "smoother": ""}), mass=MASS)
    assert all(c.F_filtered is None for c in ft.fit(["coulomb", "patch"], [bare]).curves)


def test_positions_of_unknown_deviation_are_filtered_with_equal_weights():
    run = slide(2.0, two_ways)
    bare = Run(without_sigma(run.displacement), run.motion, mass=MASS)
    (known,), (unknown,) = (ft.fit(["coulomb", "viscous"], [one]).curves for one in (run, bare))
    assert np.allclose(unknown.F_filtered, known.F_filtered, atol=1e-3)


def without_sigma(d):
    """The same displacement, its deviations unknown."""
    return type(d)(d.t, d.x, d.y, d.angle, np.full(len(d), np.nan), d.sigma_y, d.valid)


def test_frames_that_ring_after_a_push_are_no_points_of_the_law():
    run = slide(3.0, lambda x, v: 1.0 + 0.2 * v)
    fit = ft.fit(["coulomb", "viscous"], [run])
    (results,) = plots.as_runs([run])
    sigma, F = results.friction.sigma_F.copy(), results.friction.F.copy()
    at = np.flatnonzero(results.friction.free)[60:70]
    sigma[at], F[at] = 20 * np.median(sigma), 0.1
    rings = replace(results, friction=replace(results.friction, F=F, sigma_F=sigma))
    measured = plots.law(fit, [rings]).axes[0].lines[0].get_ydata()
    assert len(measured) < len(plots.law(fit, [results]).axes[0].lines[0].get_ydata())
    assert measured.min() > 0.9
