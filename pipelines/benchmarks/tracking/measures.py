"""Compute the figures of the table from tracked and true positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs

from .conditions import FPS, SCALE

Array = NDArray[np.float64]
LOST_PX = 1.0  # px from the truth: lost
SMOOTHER, ORDER = 61, 4  # frames (15.25 ms) and order of the Savitzky-Golay smoother


class Judged(NamedTuple):
    """One tracker on one film."""

    error: Array  # (n,) px, constant removed; NaN where lost
    lost: int  # frames more than 1 px off, or given up
    silent: int  # frames more than 1 px off that it did not give up
    worst: float  # px, largest error of the frames that it did not give up
    locking: tuple[float, float]  # px^2, square of the amplitude tied to the sub-pixel position, and what noise gives
    acceleration: tuple[float, float]  # m/s^2, rms behind the smoother, and that of white noise at the bound
    z: float  # rms of error / stated standard deviation
    bound: float  # px
    seconds: float  # CPU


def judge(found: Array, x: Array, bound: float, seconds: float, sigma: Array | None = None) -> Judged:
    """Displacements found (n,) px, NaN where given up, against the true positions x (n,) px."""
    error = found - (x - x[0])
    worst = float(np.nanmax(np.abs(error))) if np.any(np.isfinite(error)) else np.nan
    near = np.abs(error) <= LOST_PX  # False for NaN
    silent = int(np.sum(np.isfinite(error) & ~near))
    kept = np.where(near, error, np.nan)
    if near.any():
        kept = kept - np.nanmean(kept)
    z = np.nan if sigma is None or not near.any() else float(np.sqrt(np.nanmean((kept / sigma) ** 2)))
    white = bound * SCALE * float(np.linalg.norm(_second_derivative()))
    return Judged(kept, int(np.sum(~near)), silent, worst, locking(kept, x), (_rough(kept), white), z, bound, seconds)


def locking(error: Array, x: Array) -> tuple[float, float]:
    """Squared amplitude of two harmonics of the error along the sub-pixel position, and its mean under noise, px^2.

    The amplitude is that of all four terms together: for one sine its own amplitude.
    """
    seen = np.isfinite(error)
    if seen.sum() < 20 or np.ptp(x[seen]) < 2:  # too little to tell
        return np.nan, np.nan
    phase = 2 * np.pi * x[seen]
    design = np.stack([np.ones(seen.sum()), *(f(k * phase) for k in (1, 2) for f in (np.cos, np.sin))], axis=1)
    terms, *_ = np.linalg.lstsq(design, error[seen], rcond=None)
    left = error[seen] - design @ terms
    noise = np.var(left, ddof=5) * np.diag(np.linalg.inv(design.T @ design))
    return float(np.sum(terms[1:] ** 2)), float(np.sum(noise[1:]))


def _second_derivative() -> Array:
    return savgol_coeffs(SMOOTHER, ORDER, deriv=2, delta=1 / FPS)


def _rough(error: Array) -> float:
    """Rms of the second derivative of the smoothed error where all frames under the smoother are kept, m/s^2."""
    if len(error) < SMOOTHER:
        return np.nan
    a = np.convolve(error * SCALE, _second_derivative(), mode="valid")
    return float(np.sqrt(np.nanmean(a**2))) if np.any(np.isfinite(a)) else np.nan


def pool(films: Sequence[Judged]) -> dict[str, Any]:
    """Figures of one tracker over films of one condition; positions in mpx."""
    errors = np.concatenate([f.error for f in films])
    bound = _rms([f.bound for f in films])
    rms = _rms(errors)
    above, floor = (_rms(np.sqrt([f.locking[k] for f in films])) ** 2 for k in (0, 1))
    rough, white = (_rms([f.acceleration[k] for f in films]) for k in (0, 1))
    return {
        "frames": len(errors),
        "bound_mpx": 1e3 * bound,
        "rms_mpx": 1e3 * rms,
        "rms_over_bound": rms / bound,
        "locking_mpx": 1e3 * float(np.sqrt(max(above - floor, 0.0))),
        "locking_noise_mpx": 1e3 * float(np.sqrt(floor)),
        "worst_px": float(np.nanmax([f.worst for f in films], initial=0.0)),
        "lost": sum(f.lost for f in films),
        "silent": sum(f.silent for f in films),
        "frames_per_s": len(errors) / sum(f.seconds for f in films),
        "acceleration_m_s2": rough,
        "acceleration_over_white": rough / white,
        "z_rms": _rms([f.z for f in films]),
    }


def _rms(values: Any) -> float:
    finite = np.asarray(values)[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else np.nan
