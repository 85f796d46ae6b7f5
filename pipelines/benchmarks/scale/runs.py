"""Measure the cost of fit and diagnosis over the number of runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import frictrack as ft
from frictrack.records import Displacement

Say = Callable[[str], None]
COUNTS = (5, 10, 20, 40)
FRAMES, FPS, NOISE, SCATTER = 700, 4000.0, 10e-6, 0.03
MASS, F_C, F_V = 0.35, 1.2, 0.4  # kg, N, N s/m


def measure(say: Say) -> dict[str, Any]:
    """Processor time for every number of runs, and the exponents of the last doubling."""
    rows = []
    for n in COUNTS:
        runs = simulated_runs(n)
        start = time.process_time()
        fit = ft.fit(["coulomb", "viscous"], runs)
        between = time.process_time()
        found = ft.diagnose(fit)
        rows.append({"runs": n, "fit_s": between - start, "diagnose_s": time.process_time() - between})
        rows[-1]["verdict"] = found.verdict
        say(f"{n} runs: fit {rows[-1]['fit_s']:.2f} s, diagnosis {rows[-1]['diagnose_s']:.1f} s, {found.verdict}")
    steps = {
        key: float(np.log(rows[-1][key] / rows[0][key]) / np.log(COUNTS[-1] / COUNTS[0]))
        for key in ("fit_s", "diagnose_s")
    }
    say(f"exponent of the number of runs: fit {steps['fit_s']:.2f}, diagnosis {steps['diagnose_s']:.2f}")
    return {"frames": FRAMES, "rows": rows, "exponent": steps}


def simulated_runs(n: int) -> list[ft.Run]:
    """Slides under Coulomb and viscous friction in closed form, the level of each a little different."""
    rng = np.random.default_rng(0)
    t = np.arange(FRAMES) / FPS
    out = []
    for i, v in enumerate(np.linspace(2.0, 6.0, n)):
        f = F_C * (1 + SCATTER * rng.standard_normal())
        decay = F_V / MASS
        x = (v + f / F_V) / decay * (1 - np.exp(-decay * t)) - f / F_V * t
        x = x + NOISE * rng.standard_normal(FRAMES)
        nan = np.full(FRAMES, np.nan)
        sigma, valid = np.full(FRAMES, NOISE), np.ones(FRAMES, dtype=bool)
        displacement = Displacement(t=t, x=x, y=nan, angle=nan, sigma_x=sigma, sigma_y=nan, valid=valid)
        motion = ft.differentiate(ft.low_pass(displacement))
        out.append(ft.Run(displacement, motion, mass=MASS, name=f"r{i}"))
    return out
