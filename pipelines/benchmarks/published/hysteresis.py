"""Score the Bouc-Wen benchmark: the rms error of a free run over the whole published test record.

The oscillator has a mass of 2 kg; its equations and the mass are published with the benchmark. Only the training record
is fitted; the test record begins as a run whose first state is found from its first part, which is scored too.

A sweep is made from the published equations in place of the published one, whose record is not part of the data: 40 N
from 20 to 50 Hz at 10 Hz/min, from rest. The same integration gives the multisine record to 0.24 um. No published
figure belongs to this record.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from derivatives.signals import Array
from scipy.io import loadmat

import frictrack as ft
from frictrack.records import Displacement, Run
from frictrack.simulate import Conditions, Start, simulate_displacement

RATE = 750.0  # Hz
MASS_KG = 2.0
LAW = "viscous,spring,bouc_wen"
N_TRAIN = 2000  # samples of the training record that are fitted, of 40 960
SIGMA_M = 1e-8  # the records are free of noise; a deviation well below the goal
C, K = 10.0, 5e4  # N s/m and N/m; these and the next as published
ALPHA, BETA, GAMMA, DELTA = 5e4, 1e3, 0.8, -1.1
SWEEP_N, SWEEP_HZ, SWEEP_S = 40.0, (20.0, 1.0 / 6.0), 180.0  # amplitude; first frequency and Hz per s; duration
SWEEP_TOLERANCE_M, STEPS_PER_SAMPLE = 1e-8, 20
TRAIN, PREDICTED = "train_data.csv", "NARX_multisine.csv"
TEST_INPUT, TEST_OUTPUT = "uval_multisine.mat", "yval_multisine.mat"


def score(folder: Path) -> dict[str, Any]:
    """Rms of the free run beside that of the stored prediction of a NARX model."""
    position, force = np.loadtxt(folder / TRAIN, delimiter=",", skiprows=1).T
    x, u = _only(folder / TEST_OUTPUT), _only(folder / TEST_INPUT)
    predicted = np.atleast_2d(np.genfromtxt(folder / PREDICTED, delimiter=",").T)[-1][-len(x) :]
    published = 1e6 * float(np.sqrt(np.nanmean((predicted - x[-len(predicted) :]) ** 2)))
    rows = []
    for law in ("viscous,spring", LAW):
        begin = time.process_time()
        train = recorded(position[:N_TRAIN], force[:N_TRAIN], "train")
        found = ft.fit(law, [train, recorded(x, u, "test", role="validation")])
        rows.append(
            {
                "what": f"{law}: free run over {len(x)} samples of the multisine test",
                "published": published,
                "ours": found.errors["free_run_rms_um"],
                "unit": "um",
                "cpu_s": time.process_time() - begin,
                "parameters": {name: [e.value, e.std] for name, e in found.parameters.items()},
            }
        )
    return {"rows": [*rows, sweep_score(found)]}


def sweep_score(found: ft.Fit, duration: float = SWEEP_S) -> dict[str, Any]:
    """Rms of a free run from rest over the sweep; its CPU time includes that of the record."""
    begin, t = time.process_time(), np.arange(round(duration * RATE)) / RATE
    values, _ = found.solution.problem.layout.values(found.solution.p, 0)
    ours = simulate_displacement(
        found.model, values, Conditions(mass=MASS_KG, drive=sweep), t, Start(0.0, 0.0), SWEEP_TOLERANCE_M
    )
    return {
        "what": f"{LAW}: free run over {len(t)} samples of a sweep made from the published equations",
        "published": None,
        "ours": 1e6 * float(np.sqrt(np.mean((ours - published_motion(sweep, len(t))) ** 2))),
        "unit": "um",
        "cpu_s": time.process_time() - begin,
    }


def sweep(t: Array) -> Array:
    """Force of the sweep (n,), N, at times t (n,), s."""
    first, rate = SWEEP_HZ
    return np.asarray(SWEEP_N * np.sin(2 * np.pi * (first * t + rate * t**2 / 2)))


def published_motion(force: Callable[[Array], Array], n: int) -> Array:
    """Position (n,), m, of the published oscillator under a force from rest, by Runge-Kutta steps of order 4.

    m x'' + c x' + k x + z = u,   z' = alpha x' - beta (gamma |x'| z + delta x' |z|)

    """
    h = 1.0 / (RATE * STEPS_PER_SAMPLE)
    u = force(np.arange(2 * STEPS_PER_SAMPLE * n + 1) * h / 2).tolist()
    out, (x, v, z) = np.empty(n), (0.0, 0.0, 0.0)

    def rates(x: float, v: float, z: float, u: float) -> tuple[float, float, float]:
        hysteresis = ALPHA * v - BETA * (GAMMA * abs(v) * z + DELTA * v * abs(z))
        return v, (u - K * x - C * v - z) / MASS_KG, hysteresis

    for i in range(STEPS_PER_SAMPLE * n):
        if i % STEPS_PER_SAMPLE == 0:
            out[i // STEPS_PER_SAMPLE] = x
        before, middle, after = u[2 * i : 2 * i + 3]
        a = rates(x, v, z, before)
        b = rates(x + h / 2 * a[0], v + h / 2 * a[1], z + h / 2 * a[2], middle)
        c = rates(x + h / 2 * b[0], v + h / 2 * b[1], z + h / 2 * b[2], middle)
        d = rates(x + h * c[0], v + h * c[1], z + h * c[2], after)
        x, v, z = (q + h / 6 * (a[j] + 2 * b[j] + 2 * c[j] + d[j]) for j, q in enumerate((x, v, z)))
    return out


def recorded(x: Array, u: Array, name: str, **known: Any) -> Run:
    """A record of position x (n,), m, under the force u (n,), N."""
    nan = np.full(len(x), np.nan)
    t, sigma = np.arange(len(x)) / RATE, np.full(len(x), SIGMA_M)
    seen = Displacement(t, x, nan, nan, sigma, nan, np.ones(len(x), dtype=bool))
    motion = ft.differentiate(ft.low_pass(seen, method="kalman"))
    return Run(seen, motion, mass=MASS_KG, drive=u, name=name, **known)


def _only(file: Path) -> Array:
    """The one signal of a MATLAB file (n,)."""
    return np.asarray(next(value for name, value in loadmat(file).items() if not name.startswith("_"))).ravel()
