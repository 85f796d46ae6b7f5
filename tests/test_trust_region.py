"""Steps within a trust region, and fits whose scatter of the levels is estimated on the way."""

import numpy as np
import pytest
from runs import study
from scipy.integrate import solve_ivp
from scipy.optimize import lsq_linear

from frictrack import Run, fit, samples
from frictrack.fit.least_squares import Solution
from frictrack.fit.least_squares.gauss_newton import DampedStep, TrustRegion, damped_step, is_converged

ROWS = np.array([[3.0, 0.2], [0.0, 0.01], [1.0, 0.0]])
RIGHT = np.array([1.0, 2.0, -0.5])
MASS = 0.4  # kg
FREE = np.full(2, -np.inf), np.full(2, np.inf)


def parabola(curvature):
    """A step of length one with predicted fall 2, and its actual fall under a parabola of some curvature."""
    predicted = 2.0
    return DampedStep(np.ones(1), 1.0, predicted), 2 * predicted - curvature


class TestDampedStep:
    def test_without_radius_is_least_squares(self):
        step = damped_step(ROWS, RIGHT, FREE, TrustRegion(1e-12))
        expected = np.linalg.lstsq(ROWS, RIGHT, rcond=None)[0]
        assert step.values == pytest.approx(expected, rel=1e-6)
        assert step.predicted_fall == pytest.approx(RIGHT @ RIGHT - np.sum((RIGHT - ROWS @ expected) ** 2))

    @pytest.mark.parametrize("share", [0.9, 0.5, 0.01])
    def test_is_not_longer_than_the_radius(self, share):
        whole = damped_step(ROWS, RIGHT, FREE, TrustRegion())
        step = damped_step(ROWS, RIGHT, FREE, TrustRegion(radius=share * whole.length))
        assert 0.4 * share * whole.length < step.length <= share * whole.length
        assert 0 < step.predicted_fall < whole.predicted_fall

    def test_stays_within_bounds(self):
        whole = damped_step(ROWS, RIGHT, FREE, TrustRegion())
        high = whole.values.max() / 2
        step = damped_step(ROWS, RIGHT, (np.full(2, -1.0), np.full(2, high)), TrustRegion())
        assert step.values.max() <= high * (1 + 1e-9)

    @pytest.mark.few(6)
    @pytest.mark.parametrize("seed", range(20))
    def test_is_the_least_squares_solution_within_bounds(self, seed):
        rng = np.random.default_rng(seed)
        rows, right = rng.normal(size=(8, 5)), rng.normal(size=8)
        bounds = -rng.uniform(0, 0.3, 5), rng.uniform(0, 0.3, 5)
        expected = lsq_linear(rows, right, bounds)
        step = damped_step(rows, right, bounds, TrustRegion(1e-12))
        assert step.values == pytest.approx(expected.x, abs=1e-6)
        assert step.predicted_fall == pytest.approx(right @ right - 2 * expected.cost, rel=1e-6)

    def test_an_unknown_at_its_bound_does_not_shorten_the_others(self):
        rows, right = np.array([[1.0, 1.0], [0.0, 0.01]]), np.array([1.0, -0.5])  # nearly collinear: free, 51 and -50
        bounds = np.array([-np.inf, -1e-12]), np.full(2, np.inf)
        step = damped_step(rows, right, bounds, TrustRegion(radius=2.0))
        assert step.values == pytest.approx([1.0, 0.0], abs=1e-6)


class TestTrustRegion:
    def test_steps_that_hold_what_they_promise_are_not_shortened(self):
        step, fall = parabola(2.0)
        assert TrustRegion(radius=0.1).after(step, fall).radius > step.length

    @pytest.mark.parametrize("curvature", [4.5, 8.0])
    def test_a_failed_step_is_shortened_to_the_minimum_of_the_parabola(self, curvature):
        step, fall = parabola(curvature)
        assert fall < 0
        assert TrustRegion().after(step, fall).radius == pytest.approx(2.0 / curvature)

    def test_stops_only_where_the_parabola_leaves_little(self):
        step, fall = parabola(4.5)  # its minimum lies 2^2 / 4.5 below the start
        assert is_converged(step, fall, threshold=0.9)
        assert not is_converged(step, fall, threshold=0.85)
        assert not is_converged(step, 1.9, threshold=100.0)  # a good step is followed by another


class TestScatterOfLevels:
    def test_scatter_is_the_estimate_at_the_solution(self):
        # levels of six runs scatter by 3 %; the fit has to end where its scatter is the estimate made there
        runs, levels = study(sigma=1e-6, scatter=0.03, rng=np.random.default_rng(3))
        solution = fit("tustin", runs).solution
        assert solution.tau == pytest.approx(solution.level_scatter()[0], rel=0.02)
        assert solution.tau == pytest.approx(np.std(levels, ddof=1), rel=0.3)


def test_a_fit_ends_where_no_step_lowers_the_misfit(monkeypatch):
    """A level at its bound, scaled to a mean of one, leaves a slope that no step follows."""
    simulated = []
    found = Solution.at.__func__
    monkeypatch.setattr(Solution, "at", classmethod(lambda cls, *a: simulated.append(1) or found(cls, *a)))
    fitted = fit(["coulomb", "stribeck", "viscous"], samples.runs())
    assert fitted.solution.objective < 56728.5  # of a fit that went on for 40 steps each time
    assert len(simulated) < 210  # 239 before


def nearly_equal_runs():
    """Four runs of one block, whose levels scatter by 2 %, under Coulomb, Stribeck and viscous friction."""
    out, rng = [], np.random.default_rng(2)
    for k in range(4):
        level = 1 + 0.02 * rng.standard_normal()
        v_0 = 3.0 * (1 + 0.15 * k)

        def slope(_, y, level=level):
            force = level * (0.8 + 0.4 * np.exp(-((y[1] / 0.5) ** 2))) + 0.05 * y[1]
            return [y[1], -(force + 0.06 * level * np.sin(2 * np.pi * y[0] / 0.021 + 0.7)) / MASS]

        t = np.arange(0, 0.08, 1 / 4000)
        motion = solve_ivp(slope, (0, t[-1]), [0.0, v_0], rtol=1e-10, atol=1e-13, t_eval=t)
        x = motion.y[0] + 5e-6 * rng.standard_normal(len(t))
        out.append(Run.from_arrays(t, x, mass=MASS, sigma=5e-6, name=f"r{k}"))
    return out


@pytest.mark.few(1)
@pytest.mark.parametrize("effect", ["rolling_shutter", "clock_rate"])
def test_an_effect_more_never_fits_worse_because_levels_are_held_at_one(effect):
    """The linearised model promises levels of one, at the price of values that its motion does not reach."""
    runs, base = nearly_equal_runs(), ["coulomb", "stribeck", "viscous"]
    less, more = fit(base, runs).solution, fit([*base, effect], runs).solution
    assert more.chi2 < less.chi2 + 2.0
    assert more.tau > 1e-3
