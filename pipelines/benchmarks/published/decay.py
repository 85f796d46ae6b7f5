"""Score decays of a pendulum: the rms error of the angle in one free run through every reversal.

The angle stands for the position and 1 kg for the inertia, so that forces are angular accelerations. The weight of the
arm is a formula of the angle.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

import frictrack as ft
from frictrack.records import Displacement, Run

# Standard deviations of the angle, rad: for `free` that of encoder steps of 0.157 mrad, for `id` of the size that the
# laws leave.
SIGMA_RAD = {"id": 1e-3, "free": 4.5e-5}
DURATION_S = {"id": 9.2, "free": 4.0}  # of a record, before the arm comes to rest: a stop without a drive ends a fit
RATE = 1000.0  # Hz
VISCOUS, COULOMB, QUADRATIC = "viscous", "coulomb", "coulomb,viscous,drag"
# Rms errors in mrad of other least squares: of four decays `id` (three are at hand here), and of 6 s of `free`.
KNOWN = {
    ("id", VISCOUS): 13.3,
    ("id", QUADRATIC): 8.4,
    ("free", VISCOUS): 3.19,
    ("free", COULOMB): 1.07,
}
LAWS = {"id": (VISCOUS, QUADRATIC), "free": (VISCOUS, COULOMB, "coulomb,viscous")}


def score(folder: Path) -> dict[str, Any]:
    """Errors of the laws on the decays from large angles, `id`, and on the end of one, `free`."""
    weight = ft.effects.formula("weight", "a*sin(x) + b*cos(x)", units={"a": "N", "b": "N"})
    rows = []
    for kind, laws in LAWS.items():
        runs = [recorded(file, kind) for file in sorted(folder.glob(f"{kind}*.csv"))]
        for law in laws:
            begin = time.process_time()
            found = ft.fit(ft.models.parse(law) + weight, runs)
            rows.append(
                {
                    "what": f"{law} and the weight, {len(runs)} records {kind}",
                    "published": KNOWN.get((kind, law)),
                    "ours": 1e-3 * found.errors["free_run_rms_um"],
                    "unit": "mrad",
                    "cpu_s": time.process_time() - begin,
                    "parameters": {name: [e.value, e.std] for name, e in found.parameters.items()},
                }
            )
    return {"rows": rows}


def recorded(file: Path, kind: str) -> Run:
    """A decay, free from its first sample until it is about to rest."""
    _, x = np.loadtxt(file, delimiter=",", skiprows=1).T
    t, nan = np.arange(len(x)) / RATE, np.full(len(x), np.nan)
    seen = Displacement(t, x, nan, nan, np.full(len(x), SIGMA_RAD[kind]), nan, np.ones(len(x), dtype=bool))
    motion = ft.differentiate(ft.low_pass(seen, method="kalman"))
    return Run(seen, motion, mass=1.0, name=file.stem, free=(0.0, min(float(t[-1]), DURATION_S[kind])))
