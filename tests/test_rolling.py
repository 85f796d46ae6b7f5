"""Bodies that roll without slipping: inertia of rotation is no friction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.records import GRAVITY

MASS, ANGLE = 0.2, np.deg2rad(5.0)


def rolls_down(inertia, resistance=0.0, **stated):
    """SciPy's motion of a body that rolls down: (m + I/r^2) x'' = m g sin - F."""

    def rates(t, y):
        return y[1], (MASS * GRAVITY * np.sin(ANGLE) - resistance) / (MASS * (1 + inertia))

    t = np.arange(0, 1.2, 0.004)
    x = solve_ivp(rates, (0, 1.2), [0.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-12).y[0]
    x += 2e-5 * np.random.default_rng(1).normal(size=len(t))
    return ft.Run.from_arrays(t, x, mass=MASS, incline=-ANGLE, **stated)


@pytest.mark.parametrize(("shape", "inertia"), [("disc", 0.5), ("ball", 0.4), ("ring", 1.0), (0.45, 0.45)])
def test_the_resistance_of_a_rolling_body_is_what_scipy_was_given(shape, inertia):
    fit = ft.fit(["coulomb"], [rolls_down(inertia, 0.01, rolling=shape)])
    found = fit.parameters["coulomb.F_c"]
    assert abs(found.value - 0.01) < 3 * found.std
    force = ft.friction(fit.runs[0])
    assert np.median(force.F[force.free]) == pytest.approx(0.01, abs=1e-3)


def test_a_disc_that_is_not_said_to_roll_is_suspected():
    """A third of tan(angle) is the mark of a disc."""
    fit = ft.fit(["coulomb"], [rolls_down(0.5)])
    mu = fit.parameters["coulomb.F_c"].value / (MASS * GRAVITY * np.cos(ANGLE))
    assert mu == pytest.approx(np.tan(ANGLE) / 3, rel=0.01)
    assert any('rolling = "disc"' in line for line in fit.summary()["remarks"])
    told = ft.fit(["coulomb"], [rolls_down(0.5, rolling="disc")])
    assert not any("rolling" in line for line in told.summary()["remarks"])


@pytest.mark.parametrize(("shape", "inertia"), [("disc", 0.5), ("ball", 0.4), ("ring", 1.0)])
def test_a_body_with_resistance_that_is_not_said_to_roll_is_suspected(shape, inertia):
    fit = ft.fit(["coulomb"], [rolls_down(inertia, 0.002 * MASS * GRAVITY * np.cos(ANGLE))])
    assert any(f'rolling = "{shape}"' in line for line in fit.summary()["remarks"])


def test_an_unknown_shape_is_refused():
    with pytest.raises(ft.FrictrackError, match=r"expected rolling to be disc, ball, .* but got 'cube'"):
        rolls_down(0.5, rolling="cube")
