"""Compute bounds: the Wiener filter that knows the spectrum, and the Cramer-Rao bound of a known law."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.polynomial import Polynomial

from .estimate import Estimate, Method
from .signals import Array, Signal

STEP = 1e-4  # of a parameter, for numerical derivatives
TIMES = {"at": 1e-6, "width": 1e-6, "x": 1e-6}  # steps of parameters whose own size says nothing, s and m


def wiener(truth: Signal, noise: float) -> Method:
    """Wiener filter with the true |X(f)| of what is left when a quintic of the true ends is subtracted.

    The quintic has the true values, slopes and curvatures at both ends, so that the periodic rest is smooth.
    Leakage of lines makes it a little pessimistic in mid-course, the true ends optimistic there.
    """
    n, span = len(truth.t), truth.t[-1] - truth.t[0]
    ends = hermite(truth)
    u = (truth.t - truth.t[0]) / span
    power = np.abs(np.fft.rfft(truth.x - ends(u))) ** 2
    gain = power / (power + n * noise**2)
    turn = 2j * np.pi * np.fft.rfftfreq(n, span / (n - 1))

    def estimate(_: Array, y: Array) -> Estimate:
        rest = gain * np.fft.rfft(y - ends(u))
        made = (np.fft.irfft(turn**k * rest, n) + ends.deriv(k)(u) / span**k for k in range(3))
        return Estimate(*made)

    return estimate


def hermite(truth: Signal) -> Polynomial:
    """Quintic of u = 0..1 with the values, slopes and curvatures of both ends."""
    span = truth.t[-1] - truth.t[0]
    basis = [Polynomial.basis(k) for k in range(6)]
    rows = [[b.deriv(k)(end) for b in basis] for end in (0.0, 1.0) for k in range(3)]
    wanted = [column[end] * span**k for end in (0, -1) for k, column in enumerate(truth[2:5])]
    return Polynomial(np.linalg.solve(np.array(rows), wanted))


def cramer_rao(truth: Signal, noise: float, known: Collection[str] = ()) -> tuple[Array, dict[str, float]]:
    """Deviations (3, n) of x, v, a of the true model fitted to x, and those of its parameters but the known."""
    assert truth.model is not None
    free = [name for name in truth.parameters if name not in known]
    columns = [_slope(truth, name) for name in free]
    jacobian = np.stack(columns, axis=-1)  # (3, n, parameters)
    scale = np.linalg.norm(jacobian[0], axis=0)
    jacobian /= scale
    covariance = noise**2 * np.linalg.inv(jacobian[0].T @ jacobian[0])
    deviations = np.sqrt(np.einsum("kni,ij,knj->kn", jacobian, covariance, jacobian))
    return deviations, dict(zip(free, np.sqrt(np.diag(covariance)) / scale, strict=True))


def _slope(truth: Signal, name: str) -> Array:
    """Derivatives (3, n) of x, v, a after one parameter."""
    value = truth.parameters[name]
    step = TIMES.get(name, STEP * abs(value))
    up, down = (truth.model(dict(truth.parameters) | {name: value + s}, truth.t) for s in (step, -step))
    return (np.array(up) - np.array(down)) / (2 * step)
