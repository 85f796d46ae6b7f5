"""Measure large studies: many runs, a long record of measured friction, a long record with a measured drive."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scale.runs import simulated_runs
from scipy.integrate import solve_ivp

import frictrack as ft
from frictrack.records import Array, Displacement, Motion, Run

MODEL = ("coulomb", "viscous")
RUNS = 200
NOISE_M = 10e-6
MASS_KG, F_C, F_V = 0.35, 1.2, 0.4  # N, N s/m
FRICTION_SAMPLES, DRIVE_SAMPLES, RATE_HZ = 50_000, 40_000, 1000.0
STRIBECK_SPEED, NOISE_N, CORRELATION = 0.05, 0.02, 0.9  # m/s, N, of neighbouring samples


def measure(say: Callable[[str], None]) -> dict[str, Any]:
    """CPU seconds and largest memory of every large study, each in a process of its own."""
    out = {}
    for name in STUDIES:
        done = subprocess.run(
            [sys.executable, "-m", "speed.large", name],
            capture_output=True,
            text=True,
            check=False,
            cwd=Path(__file__).resolve().parents[1],
        )
        out[name] = json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else {"failed": done.stderr[-300:]}
        say(f"{name}: {out[name]}")
    return out


def many_runs() -> list[Run]:
    """Slides under Coulomb and viscous friction in closed form; the level of each differs a little."""
    return simulated_runs(RUNS)


def measured_friction() -> list[Run]:
    """A mass moved to and fro with slowly changing stroke, and a load cell with correlated noise."""
    rng = np.random.default_rng(0)
    t = np.arange(FRICTION_SAMPLES) / RATE_HZ
    w, stroke = 2 * np.pi * 0.5, 0.05 * (1 + 0.5 * np.sin(2 * np.pi * t / 17))
    x = stroke * np.sin(w * t)
    v = np.gradient(x, t)
    force = np.sign(v) * (8.0 + 3.0 * np.exp(-np.abs(v) / STRIBECK_SPEED)) + 2.0 * v
    noise = np.zeros(len(t))
    kick = NOISE_N * np.sqrt(1 - CORRELATION**2) * rng.standard_normal(len(t))
    for i in range(1, len(t)):
        noise[i] = CORRELATION * noise[i - 1] + kick[i]
    nan = np.full(len(t), np.nan)
    motion = Motion(t, x, v, 0 * t, nan, 0 * t + 1e-6, 0 * t + 1e-4, 0 * t + 1e-2, nan)
    return [Run(_displacement(t, x, 1e-6), motion, friction_N=force + noise, name="load cell")]


def measured_drive() -> list[Run]:
    """A mass driven to and fro by a measured force of several sinusoids; the motion by SciPy's integrator."""
    rng = np.random.default_rng(0)
    t = np.arange(DRIVE_SAMPLES) / RATE_HZ

    def force(s: Any) -> Any:
        return 6.0 * np.sin(2 * np.pi * 0.4 * s) + 3.0 * np.sin(2 * np.pi * 1.1 * s + 0.3)

    def law(s: float, state: Array) -> list[float]:
        return [state[1], (force(s) - F_C * np.tanh(state[1] / 1e-3) - 4 * F_V * state[1]) / (4 * MASS_KG)]

    x = solve_ivp(law, (0.0, t[-1]), [0.0, 0.05], method="LSODA", t_eval=t, rtol=1e-8, atol=1e-10).y[0]
    displacement = _displacement(t, x + NOISE_M * rng.standard_normal(len(t)), NOISE_M)
    motion = ft.differentiate(ft.low_pass(displacement))
    return [Run(displacement, motion, mass=4 * MASS_KG, name="driven", drive=force(t))]


def _displacement(t: Array, x: Array, sigma: float) -> Displacement:
    nan = np.full(len(t), np.nan)
    return Displacement(t, x, nan, nan, np.full(len(t), sigma), nan, np.ones(len(t), dtype=bool))


STUDIES: dict[str, Callable[[], list[Run]]] = {
    "200 runs x 700 frames": many_runs,
    "50 000 samples of measured friction": measured_friction,
    "40 000 samples with a drive": measured_drive,
}


def main() -> None:
    """Fit and diagnose one large study; print CPU seconds and largest memory as JSON."""
    runs = STUDIES[sys.argv[1]]()
    start = time.process_time()
    fit = ft.fit(list(MODEL), runs)
    fitted = time.process_time()
    found = ft.diagnose(fit)
    end = time.process_time()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    figures = {"fit_s": fitted - start, "diagnose_s": end - fitted, "total_s": end - start, "peak_MB": peak}
    print(json.dumps(figures | {"verdict": found.verdict, "named": list(found.missing)}))


if __name__ == "__main__":
    main()
