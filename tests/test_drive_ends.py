"""A drive that ends within a run, at a time between two frames or at a place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from frictrack import FrictrackError
from frictrack.flow import Session, open_study

MASS, COULOMB, VISCOUS, DRIVE, ENDS = 0.5, 0.4, 0.15, 1.1, 0.4213


def pulled(folder, until):
    """A study of SciPy's motion of a mass that is pulled up to a time, or to the place where it is then."""

    def integrate(drive, span, start):
        law = lambda t, y: (y[1], (drive - COULOMB - VISCOUS * y[1]) / MASS)  # noqa: E731
        return solve_ivp(law, span, start, rtol=1e-11, atol=1e-13, dense_output=True)

    driven = integrate(DRIVE, (0, ENDS), [0.0, 1e-9])
    free = integrate(0.0, (ENDS, 0.9), driven.y[:, -1])
    t = np.arange(0, 0.9, 0.002)
    x = np.where(t < ENDS, driven.sol(t)[0], free.sol(t)[0]) + 2e-5 * np.random.default_rng(0).normal(size=len(t))
    np.savetxt(folder / "pulled.csv", np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")
    where = until or f"{1e3 * driven.y[0, -1]:.4f} mm"
    (folder / "study.toml").write_text(
        f'[study]\nmass = "{MASS} kg"\nmodel = ["coulomb", "viscous"]\n[[run]]\ntable = "pulled.csv"\n'
        f'drive = {{force = "{DRIVE} N", until = "{where}"}}\n'
    )
    return Session(open_study(folder / "study.toml"))


@pytest.mark.few(1)
@pytest.mark.parametrize("until", [f"{ENDS} s", ""], ids=["time", "place"])
def test_the_law_is_found_within_two_deviations(tmp_path, until):
    found = pulled(tmp_path, until).fit()
    assert found["misfit"] is None
    for name, true in (("coulomb.F_c", COULOMB), ("viscous.F_v", VISCOUS)):
        assert abs(found["parameters"][name]["value"] - true) < 2 * found["parameters"][name]["std"]


def test_a_place_beyond_the_way_is_refused(tmp_path):
    with pytest.raises(FrictrackError, match=r"expected until at a place that the mass passes, .* but got 3 m"):
        pulled(tmp_path, "3 m").fit()


def test_a_mass_is_no_end(tmp_path):
    with pytest.raises(FrictrackError, match='expected until as "release", a place like "30 cm" or a time'):
        pulled(tmp_path, "3 kg")
