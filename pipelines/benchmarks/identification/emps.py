"""Read the Electro-Mechanical Positioning System: records, published figures, and the authors' method.

A. Janot, M. Gautier, M. Brunot, Data Set and Reference Models of EMPS, Workshop on Nonlinear System Identification
Benchmarks, Eindhoven 2019. A motor drives a carriage through a screw; position q and command vir at 1 kHz, 24.8 s, one
record to fit and one with pulses to validate. The authors' columns of regression are those of frictrack's effects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as File
from typing import Any

import numpy as np
from derivatives.signals import Array
from scipy.interpolate import CubicSpline
from scipy.io import loadmat
from scipy.signal import butter, cheby1, filtfilt

from frictrack.effects import Path, models
from frictrack.effects.models import Model, Values

GAIN = 35.15065  # N per volt of the motor command
RATE = 1000.0  # Hz
FILES = {"train": "DATA_EMPS.mat", "validation": "DATA_EMPS_PULSES.mat"}
ORDER, CUTOFF = 2, 100.0  # of the Butterworth filter; forward and backward it is of the fourth order
DECIMATED_RATE_HZ = 100.0  # Hz, to which the force is thinned: one sample of ten
TRIM_SAMPLES = 1  # samples at either end, whose differences are one-sided
RIPPLE_DB, PASSBAND_SHARE = 0.05, 0.8  # dB and share of the new Nyquist frequency: the usual filter of a decimation

SYMMETRIC, ASYMMETRIC = "coulomb,viscous,slope", "coulomb,viscous,asymmetry"
PUBLISHED: dict[str, dict[str, float]] = {  # errors in percent; the second validation is the data's description's
    SYMMETRIC: {
        "M": 95.1089,
        "F_v": 203.5034,
        "F_c": 20.3935,
        "offset": -3.1648,
        "train": 4.0834,
        "validation": 5.9824,
    },
    ASYMMETRIC: {
        "M": 95.1540,
        "F_v+": 166.7061,
        "F_c+": 20.1440,
        "F_v-": 240.4236,
        "F_c-": 20.6277,
        "train": 3.1117,
        "validation": 5.39,
    },
}


@dataclass(frozen=True)
class Record:
    """Position q (n,), m, and drive (n,), N, which acts `late` s after its time; and what the chain makes of them."""

    q: Array
    drive: Array
    late: float = 0.0
    rate: float = RATE

    @property
    def t(self) -> Array:
        """Times (n,), s."""
        return np.arange(len(self.q)) / self.rate

    @cached_property
    def motion(self) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration (n,) after the filter, by central differences, when the drive acts."""
        low = min(CUTOFF, self.rate / 5)  # an extract of the data is slower
        x = _both_ways(*butter(ORDER, low, fs=self.rate), self.q)
        x = CubicSpline(self.t, x)(self.t + self.late) if self.late else x
        v = np.gradient(x, 1 / self.rate)
        return x, v, np.gradient(v, 1 / self.rate)

    @cached_property
    def path(self) -> Path:
        """The motion as effects see it."""
        x, v, _ = self.motion
        return Path(self.t, x, v, np.sign(v))

    def decimated(self, columns: Array) -> Array:
        """Columns (n, k) or (n,), trimmed, low-passed and thinned, as the drive is."""
        inside, step = columns[TRIM_SAMPLES : len(columns) - TRIM_SAMPLES], round(self.rate / DECIMATED_RATE_HZ)
        low = _both_ways(*cheby1(8, RIPPLE_DB, PASSBAND_SHARE / step), inside)
        return low[(len(low) - 1) % step :: step]  # so that the last sample is kept

    @cached_property
    def force(self) -> Array:
        """The measured drive (m,) that every law is held against."""
        return self.decimated(self.drive)

    @cached_property
    def inertia(self) -> Array:
        """Decimated acceleration (m,)."""
        return self.decimated(self.motion[2])

    def columns(self, model: Model, values: Values) -> Array:
        """Decimated columns of the mass and of every effect, (m, 1 + k)."""
        made = model.force_columns(self.path, values)
        return np.column_stack([self.inertia, self.decimated(np.concatenate(list(made.values()), axis=1))])

    def error(self, coefficients: Array, columns: Array) -> float:
        """Relative force error, percent."""
        return float(100 * np.linalg.norm(self.force - columns @ coefficients) / np.linalg.norm(self.force))


def _both_ways(b: Array, a: Array, columns: Array) -> Array:
    low: Array = filtfilt(b, a, columns, axis=0, padlen=3 * (len(b) - 1))
    return low


def records(folder: File) -> dict[str, Record]:
    """The two records of the data set."""
    found = {role: loadmat(folder / name) for role, name in FILES.items()}
    return {role: Record(d["qm"].ravel(), GAIN * d["vir"].ravel()) for role, d in found.items()}


def regressed(law: str, record: Record) -> Array:
    """The authors' fit: least squares of the decimated force on mass and effects, (1 + k,)."""
    columns = record.columns(models.parse(law), _nothing(models.parse(law)))
    return np.asarray(np.linalg.lstsq(columns, record.force, rcond=None)[0])


def _nothing(model: Model) -> Values:
    return {e.name: {} for e in model.effects}


def authors(data: Mapping[str, Record]) -> list[dict[str, Any]]:
    """Both published fits reproduced, beside what was printed."""
    rows = []
    for law, printed in PUBLISHED.items():
        found = regressed(law, data["train"])
        blank = _nothing(models.parse(law))
        errors = {role: r.error(found, r.columns(models.parse(law), blank)) for role, r in data.items()}
        rows.append({"model": law, "parameters": named(law, found), "errors": errors, "printed": printed})
    return rows


def named(law: str, found: Sequence[float] | Array) -> dict[str, float]:
    """Coefficients under the authors' names."""
    if law == SYMMETRIC:
        return dict(zip(("M", "F_c", "F_v", "offset"), map(float, found), strict=True))
    mass, dry, viscous, uneven, uneven_viscous = map(float, found)
    both = {"F_v+": viscous + uneven_viscous, "F_c+": dry + uneven}
    return {"M": mass} | both | {"F_v-": viscous - uneven_viscous, "F_c-": dry - uneven}
