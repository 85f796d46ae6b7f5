"""Estimate the transfer from the drive of the EMPS to its acceleration, and what a joint with a spring would change.

The authors suppose that the pulses excite a flexibility. A mass behind a spring and a damper makes a resonance in
F/(M a): its apparent mass is M (1 - mu + mu G), G = (2 zeta w s + w^2)/(s^2 + 2 zeta w s + w^2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from derivatives.signals import Array
from identification.emps import RATE, Record
from scipy.signal import butter, csd, filtfilt, welch

WINDOW = 1000  # samples of a spectral estimate: one period of the pulses
BAND_HZ = (10.0, 150.0)  # in which the drive moves the position above its noise
SPRING_HZ = np.arange(15.0, 141.0, 1.0)  # frequencies tried for a joint
DAMPING_RATIOS = (0.01, 0.03, 0.1, 0.3)
DIRECTION_CUTOFF_HZ = 60.0  # Hz, of the velocity whose sign is the direction
N_DELAYS = 161
MAX_DELAY_S = 2e-3
FLOOR_BAND_HZ = (280.0, 400.0)  # in which an encoder shows nothing but its resolution


@dataclass(frozen=True)
class Transfer:
    """M a over the force that accelerates (k,), at frequencies (k,) in Hz, with its relative deviation (k,)."""

    frequency: Array
    ratio: Array
    deviation: Array
    coherence: Array


def transfer(record: Record, friction: Array, mass: float) -> Transfer:
    """Transfer of the record, without its friction (n,) in N."""
    force, setup = record.drive - friction, {"fs": RATE, "nperseg": WINDOW, "detrend": "linear"}
    f, cross = csd(force, record.q, **setup)
    _, power = welch(force, **setup)
    _, seen = welch(record.q, **setup)
    inside = (f >= BAND_HZ[0]) & (f <= BAND_HZ[1])
    f, cross, power, seen = (q[inside] for q in (f, cross, power, seen))
    coherence = np.abs(cross) ** 2 / (power * seen)
    n_windows = 2 * len(record.q) / WINDOW - 1
    deviation = np.sqrt((1 - coherence) / (2 * coherence * n_windows))
    return Transfer(f, -((2 * np.pi * f) ** 2) * cross / power * mass, np.hypot(deviation, 0.003), coherence)


def friction_of(record: Record, coefficients: Array) -> Array:
    """Friction (n,), N: level, viscous term, both uneven, along the measured motion."""
    v = np.gradient(record.q, 1 / RATE)
    slow = np.gradient(filtfilt(*butter(2, DIRECTION_CUTOFF_HZ, fs=RATE), record.q), 1 / RATE)
    columns = np.column_stack([np.sign(slow), v, np.ones_like(v), np.abs(slow)])
    return np.asarray(columns @ coefficients)


def joint_search(seen: Transfer) -> dict[str, Any]:
    """Delay of the drive, and the best joint: its frequency, damping and share of the mass, with deviations."""
    s = 2j * np.pi * seen.frequency
    weight = 1 / (seen.deviation * np.abs(seen.ratio))
    inverse = 1 / seen.ratio  # F/(M a): linear in the share of the mass

    def misfit(delay: float, resonance: Array | None) -> tuple[float, Array, Array]:
        columns = [np.exp(s * delay)] if resonance is None else [np.exp(s * delay), np.exp(s * delay) * (resonance - 1)]
        rows = np.column_stack(columns) * (weight * np.abs(seen.ratio) ** 2)[:, None]
        target = inverse * weight * np.abs(seen.ratio) ** 2
        a, b = np.vstack([rows.real, rows.imag]), np.concatenate([target.real, target.imag])
        found, *_ = np.linalg.lstsq(a, b, rcond=None)
        return float(np.sum((b - a @ found) ** 2)), found, np.linalg.inv(a.T @ a)

    delays = np.linspace(0.0, MAX_DELAY_S, N_DELAYS)
    alone = [misfit(delay, None)[0] for delay in delays]
    delay = float(delays[int(np.argmin(alone))])
    spread = min(alone) / (2 * len(s) - 2)  # of the weighted misfit, per degree of freedom
    tried = []
    for frequency in SPRING_HZ:
        for damping in DAMPING_RATIOS:
            w = 2 * np.pi * frequency
            resonance = (2 * damping * w * s + w**2) / (s**2 + 2 * damping * w * s + w**2)
            chi2, found, covariance = misfit(delay, resonance)
            share, deviation = found[1] / found[0], np.sqrt(spread * covariance[1, 1]) / found[0]
            tried.append((chi2, frequency, damping, share, deviation))
    chi2, frequency, damping, share, deviation = min(tried)
    gain = np.abs(seen.ratio)
    good = (seen.frequency >= 20) & (seen.frequency <= 90) & (seen.coherence > 0.9)
    return {
        "delay_ms": 1e3 * delay,
        "gain_20_to_90_Hz": [float(gain[good].min()), float(gain[good].max())],
        "best_joint": {
            "frequency_Hz": float(frequency),
            "damping_ratio": damping,
            "share_of_mass": float(share),
            "share_std": float(deviation),
            "misfit_over_that_of_a_delay_alone": chi2 / min(alone),
        },
        "largest_share_of_mass_lightly_damped": max(abs(t[3]) + 2 * t[4] for t in tried if t[2] <= 0.03),
    }


def noise_floor(record: Record) -> float:
    """Rms of the position where only the resolution of an encoder can be seen, m per root Hz."""
    f, power = welch(record.q, fs=RATE, nperseg=WINDOW, detrend="linear")
    inside = (f >= FLOOR_BAND_HZ[0]) & (f <= FLOOR_BAND_HZ[1])
    return float(np.sqrt(np.median(power[inside])))
