"""Tables that can be read and make no sense: the whole chain up to the fit ends, or says why it cannot, in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study

RNG = np.random.default_rng(0)
T = np.arange(300) / 4000
X = 2 * T - 1.5 * T**2 + 1e-5 * RNG.normal(size=300)
SPIKE = np.where(np.arange(300) == 100, 1e308, X)
SAID = {
    "two rows": (T[:2], X[:2], "at least 8 valid frames"),
    "constant": (T, 0 * X + 3, "expected a moving target"),
    "denormal x": (T, X * 1e-300, "expected a moving target"),
    "huge x": (T, X * 1e300, "expected numbers below 1e+12"),
    "one spike": (T, SPIKE, "expected numbers below 1e+12"),
    "tiny t": (T * 1e-300, X, "expected rows 1e-09 s apart or more but got 2.5e-304 s"),
    "huge t": (T * 1e300, X, "expected numbers below 1e+12"),
    "uneven": (np.sort(RNG.random(300)), X, "expected at least 8 free frames"),
    "one gap": (np.r_[T[:150], T[150:] + 1e6], X, "expected few missing frames"),
    "noise": (T, RNG.normal(size=300), "expected a sliding target"),
    "a step": (T, (T > 0.03) * 1.0, "free frames"),
    "alternating": (T, (-1.0) ** np.arange(300) * 1e11, ""),
    "rows counted": (T, np.arange(300.0), ""),
    "ten rows": (T[:10], X[:10], ""),
    "eight rows": (T[:8], 2 * T[:8], ""),
}


@pytest.mark.few(3)
@pytest.mark.parametrize("name", SAID)
def test_the_chain_ends_or_says_why_not(tmp_path: Path, name: str) -> None:
    t, x, said = SAID[name]
    lines = [f"{a!r},{b!r}" for a, b in zip(t.tolist(), x.tolist(), strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t_s,x_m", *lines]))
    (tmp_path / "study.toml").write_text(
        '[study]\nmass = 0.35\nmodel = ["coulomb", "viscous"]\n[[run]]\ntable = "a.csv"\n'
    )
    refused = ""
    try:
        Session(open_study(tmp_path / "study.toml")).fit()
    except FrictrackError as e:
        refused = str(e)
    assert refused.isprintable()
    assert said in refused
