"""Score the Bouc-Wen benchmark: the rms error of a free run over the whole published test record.

The oscillator has a mass of 2 kg; its equations and the mass are published with the benchmark. Only the training record
is fitted; the test record begins as a run whose first state is found from its first part, which is scored too.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from derivatives.signals import Array
from scipy.io import loadmat

import frictrack as ft
from frictrack.records import Displacement, Run

RATE = 750.0  # Hz
MASS_KG = 2.0
LAW = "viscous,spring,bouc_wen"
N_TRAIN = 2000  # samples of the training record that are fitted, of 40 960
SIGMA_M = 1e-8  # the records are free of noise; a deviation well below the goal
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
    return {"rows": rows}


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
