"""Methods that laboratories use, each with its usual automatic choice and with the best choice for the known truth.

The oracle takes the setting of the least RMS error of acceleration on the very record, ends included.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.signal import butter, filtfilt, savgol_coeffs, savgol_filter

from .estimate import Array, Estimate, Method, lowest
from .signals import Signal

PAPERS = 100.0  # Hz, the cut-off of the papers
Family = Callable[..., Estimate]  # of t, y and one setting
Cost = Callable[[Estimate], float]


def butterworth(t: Array, y: Array, cutoff: float) -> Estimate:
    """Fourth order forward and backward, then central differences, twice."""
    interval = (t[-1] - t[0]) / (len(t) - 1)
    x = filtfilt(*butter(4, cutoff, fs=1 / interval), y)
    v = np.gradient(x, interval)
    return Estimate(x, v, np.gradient(v, interval))


def butterworth_detrended(t: Array, y: Array, cutoff: float) -> Estimate:
    """The same on what a cubic leaves."""
    trend = np.polynomial.Polynomial.fit(t, y, 3)
    made = butterworth(t, y - trend(t), cutoff)
    return Estimate(*(column + trend.deriv(k)(t) for k, column in enumerate(made[:3])))


def savitzky_golay(t: Array, y: Array, setting: tuple[int, int]) -> Estimate:
    """Local polynomial; setting = (frames, order); at the ends that of the outermost frames."""
    interval = (t[-1] - t[0]) / (len(t) - 1)
    return Estimate(*(savgol_filter(y, *setting, deriv=k, delta=interval) for k in range(3)))


def spline(t: Array, y: Array, lam: float | None = None) -> Estimate:
    """Cubic smoothing spline, by default of the lambda of least GCV; in frames, as its GCV hangs on the time unit."""
    interval = (t[-1] - t[0]) / (len(t) - 1)
    frame = np.arange(len(t), dtype=float)
    curve = make_smoothing_spline(frame, y, lam=lam)
    return Estimate(*(curve.derivative(k)(frame) / interval**k if k else curve(frame) for k in range(3)))


def cutoff_gcv(t: Array, y: Array) -> float:
    """Cut-off (Hz) of least generalised cross-validation; the trace is that of the gain 1 / (1 + (f/fc)^8)."""
    n, interval = len(t), (t[-1] - t[0]) / (len(t) - 1)
    f = np.abs(np.fft.fftfreq(n, interval))

    def cost(cutoff: float) -> float:
        trace = np.sum(1 / (1 + (f / cutoff) ** 8))
        return n * float(np.sum((y - butterworth(t, y, cutoff).x) ** 2)) / (n - trace) ** 2

    return lowest(cost, 10.0, 0.2 / interval)


def cutoff_winter(t: Array, y: Array) -> float:
    """Winter's residual analysis: where the residual is what the line through its upper half says at 0 Hz."""
    interval = (t[-1] - t[0]) / (len(t) - 1)
    cutoffs = np.linspace(10.0, 0.45 / interval, 150)
    residual = np.array([np.sqrt(np.mean((y - butterworth(t, y, f).x) ** 2)) for f in cutoffs])
    upper = cutoffs > 0.5 * cutoffs[-1]
    _, level = np.polyfit(cutoffs[upper], residual[upper], 1)
    return float(np.interp(-level, -residual, cutoffs))


@lru_cache(maxsize=64)
def windows(n: int) -> tuple[tuple[int, int, float], ...]:
    """Frames, order and trace of all Savitzky-Golay smoothers considered."""
    lengths = np.unique(np.geomspace(7, n // 2, 40).astype(int) // 2 * 2 + 1)
    return tuple((w, p, _trace(n, w, p)) for w, p in product(map(int, lengths), (3, 4, 5)) if w > p + 1)


def _trace(n: int, window: int, order: int) -> float:
    """Trace of the smoother: the weight of every frame in its own value."""
    q, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, window), order + 1))
    leverage = np.sum(q**2, axis=1)
    half = window // 2
    inside = (n - window + 1) * savgol_coeffs(window, order)[half]
    return float(inside + leverage[:half].sum() + leverage[half + 1 :].sum())


def window_gcv(t: Array, y: Array) -> tuple[int, int]:
    n = len(t)

    def cost(w: int, p: int, trace: float) -> float:
        return float(np.sum((y - savgol_filter(y, w, p)) ** 2)) / (n - trace) ** 2

    return min(windows(n), key=lambda s: cost(*s))[:2]


def automatic(family: Family, choose: Callable[[Array, Array], Any]) -> Method:
    """A family of smoothers with its setting chosen from the record."""
    return lambda t, y: family(t, y, choose(t, y))


def error(truth: Signal) -> Cost:
    return lambda estimate: float(np.mean((estimate.a - truth.a) ** 2))


def oracle_cutoff(family: Family, truth: Signal) -> Method:
    cost, top = error(truth), 0.2 / (truth.t[1] - truth.t[0])
    return automatic(family, lambda t, y: lowest(lambda f: cost(family(t, y, f)), 10.0, top))


def oracle_window(truth: Signal) -> Method:
    cost, settings = error(truth), [s[:2] for s in windows(len(truth.t))]
    return automatic(savitzky_golay, lambda t, y: min(settings, key=lambda s: cost(savitzky_golay(t, y, s))))


def methods(truth: Signal) -> dict[str, Method]:
    """By name; the oracles know the truth."""
    return {
        "Butterworth 100 Hz + differences": partial(butterworth, cutoff=PAPERS),
        "Butterworth oracle": oracle_cutoff(butterworth, truth),
        "Butterworth GCV": automatic(butterworth, cutoff_gcv),
        "Butterworth Winter": automatic(butterworth, cutoff_winter),
        "Butterworth detrended oracle": oracle_cutoff(butterworth_detrended, truth),
        "Savitzky-Golay oracle": oracle_window(truth),
        "Savitzky-Golay GCV": automatic(savitzky_golay, window_gcv),
        "SciPy smoothing spline GCV": spline,
    }
