"""Compare the data with the priors of a fit: what comes from the priors, and whether the data contradict them.

The estimate p of a linear model with prior mean m and covariance C has covariance V, the inverse of the sum of both
precisions. If the prior is true, p - m is normal with covariance C - V. With the estimate d of the data alone and its
covariance D, this gives the same chi-squared: (p - m)' (C - V)^-1 (p - m) = (d - m)' (C + D)^-1 (d - m). Directions in
which the data say nothing are left out. Errors that noise does not cover (a missing force, slow errors of the tracking)
are added.

References
----------
Box, G. E. P. (1980). Sampling and Bayes' inference in scientific modelling and robustness. J. R. Stat. Soc. A 143, 383.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import chi2

from frictrack.fit.least_squares import Solution, white_noise_covariance
from frictrack.fit.parameters import prior_departure, prior_jacobian, prior_residual
from frictrack.fit.uncertainty.reported_values import reported_slots, reported_values_and_jacobian
from frictrack.number_format import format_plus_minus
from frictrack.records import Array

MIN_INFORMATION = 1e-3  # of the data relative to the prior; directions with less are left to the prior
ALPHA_CONTRADICTION = 0.01
MAX_NAMED = 3  # parameters in the remark


@dataclass(frozen=True)
class PriorParameter:
    """One parameter with a prior: mean and standard deviation before, and what the data alone say.

    `data` and `data_std` are None where the data do not determine the parameter. `p` is the p-value of its own
    disagreement.
    """

    mean: float
    std: float
    unit: str
    data: float | None
    data_std: float | None
    p: float | None


@dataclass(frozen=True)
class PriorAgreement:
    """How far data and priors disagree.

    Attributes
    ----------
    chi2, dof, p
        Disagreement, directions in which the data say something, and p-value; p is None without such directions.
    parameters
        Parameters with a prior, by address.
    shares
        Share of the precision of every reported parameter that comes from the priors, 0 to 1, by address.

    """

    chi2: float
    dof: int
    p: float | None
    parameters: dict[str, PriorParameter] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)

    @property
    def contradicted(self) -> bool:
        """Whether the data contradict the priors, at `ALPHA_CONTRADICTION`."""
        return self.p is not None and self.p < ALPHA_CONTRADICTION

    def summary(self) -> dict[str, Any]:
        """Return the JSON of the agreement."""
        parameters = {name: vars(one) for name, one in self.parameters.items()}
        head = {"chi2": self.chi2, "dof": self.dof, "p": self.p, "contradicted": self.contradicted}
        return head | {"parameters": parameters}

    def remarks(self) -> Iterator[str]:
        """Yield what a reader must know of the priors."""
        if self.contradicted and self.p is not None:
            known = {n: q for n, q in self.parameters.items() if q.p is not None}
            worst = sorted(known, key=lambda n: known[n].p or 0.0)[:MAX_NAMED]
            named = [n for n in worst if (known[n].p or 0.0) < ALPHA_CONTRADICTION] or worst[:1]
            text = ", ".join(_contrast(n, known[n]) for n in named)
            yield (
                f"the runs contradict the prior: {text} (p = {self.p:.2g}); the values are a compromise of both and "
                "their standard deviations are too small. Fit without the prior, or widen it with prior_scale"
            )
        elif self.p is None:
            yield "the runs say nothing of the parameters with a prior; their values are those of the prior"


def _contrast(name: str, one: PriorParameter) -> str:
    """Return what the runs say of a parameter against its prior."""
    unit = "" if one.unit == "1" else f" {one.unit}"
    before = f"{format_plus_minus(one.mean, one.std)}{unit}"
    if one.data is None:
        return f"{name} against {before}"
    return f"{name} {format_plus_minus(one.data, one.data_std)}{unit} against {before}"


def prior_agreement(solution: Solution, covariance: Array) -> PriorAgreement | None:
    """Compare the data with the priors of a fit; None for a fit without priors.

    Parameters
    ----------
    solution
        The fit.
    covariance
        Covariance (P, P) of its unknowns with all known errors.

    """
    layout, p = solution.problem.layout, solution.p
    if not layout.priors:
        return None
    noise, _ = white_noise_covariance(solution)
    rows = prior_jacobian(layout, p)
    explained = rows @ noise @ rows.T  # covariance of the estimate in standard deviations of the prior
    size, vectors = np.linalg.eigh((explained + explained.T) / 2)
    informed = 1 - size > MIN_INFORMATION
    gain = np.clip(1 - size[informed], MIN_INFORMATION, 1.0)
    to_informed = vectors[:, informed].T
    more = _other_errors(explained, rows @ covariance @ rows.T)
    expected = np.diag(gain) + to_informed @ more @ to_informed.T
    seen = to_informed @ prior_residual(layout, p)
    total = float(seen @ np.linalg.solve(expected, seen)) if informed.any() else 0.0
    dof = int(np.count_nonzero(informed))
    p_value = float(chi2.sf(total, dof)) if dof else None
    alone = _DataAlone(vectors[:, informed], vectors[:, ~informed], gain, expected, seen)
    parameters = dict(_parameters(solution, alone))
    return PriorAgreement(total, dof, p_value, parameters, _shares(solution, noise, rows, alone))


@dataclass(frozen=True)
class _DataAlone:
    """The priors' space, in independent standard deviations: directions that the data see, and those they do not."""

    informed: Array  # (m, d)
    blind: Array  # (m, m - d)
    gain: Array  # (d,), share of the precision that the data have
    expected: Array  # (d, d), covariance of the estimate about the mean if the prior is true
    seen: Array  # (d,), the estimate less the mean


def _parameters(solution: Solution, alone: _DataAlone) -> Iterator[tuple[str, PriorParameter]]:
    """Yield the parameters with a prior."""
    layout = solution.problem.layout
    back = np.linalg.inv(layout.prior_whitening)
    informed, blind = back @ alone.informed, back @ alone.blind
    departure = prior_departure(layout, solution.p)
    units = {name: s.unit for name, s in zip(layout.names, layout.slots, strict=True)}
    data = informed @ (alone.seen / alone.gain)
    variance = (informed / alone.gain) @ alone.expected @ (informed / alone.gain).T - informed @ informed.T
    expected = np.einsum("id,de,ie->i", informed, alone.expected, informed)
    for i, q in enumerate(layout.priors):
        known = np.sum(blind[i] ** 2) < MIN_INFORMATION * q.std**2
        own = float(chi2.sf(departure[i] ** 2 / expected[i], 1)) if expected[i] > MIN_INFORMATION * q.std**2 else None
        value = q.mean + float(data[i]) if known else None
        deviation = float(np.sqrt(max(variance[i, i], 0.0))) if known else None
        yield q.address, PriorParameter(q.mean, q.std, units[q.address], value, deviation, own)


def _shares(solution: Solution, noise: Array, rows: Array, alone: _DataAlone) -> dict[str, float]:
    """Share of the precision of every reported parameter that is due to the priors: 1 - variance / variance without."""
    layout = solution.problem.layout
    _, jacobian = reported_values_and_jacobian(solution.problem, solution.p)
    towards = jacobian @ noise @ rows.T
    own = np.einsum("ai,ij,aj->a", jacobian, noise, jacobian)
    added = np.sum((towards @ alone.informed) ** 2 / alone.gain, axis=1)
    unseen = np.sum((towards @ alone.blind) ** 2, axis=1) > MIN_INFORMATION * np.maximum(own, 1e-300)
    share = np.where(unseen, 1.0, added / np.maximum(own + added, 1e-300))
    names = [layout.names[i] for i in reported_slots(layout)]
    return dict(zip(names, map(float, share), strict=True))


def _other_errors(explained: Array, total: Array) -> Array:
    """What errors of the data beyond white noise add to the covariance of the estimate, in units of the prior, (m, m).

    A factor that is common to all variances (Student's t, as the noise level is estimated) is applied to the share of
    the data alone: the standard deviations of the prior are known.
    """
    factor = np.linalg.cholesky(explained + 1e-12 * np.eye(len(explained)))
    ratio = np.linalg.solve(factor, np.linalg.solve(factor, total).T)
    wider = max(float(np.linalg.eigvalsh((ratio + ratio.T) / 2)[0]), 1.0)
    return _positive(total - wider * explained) + _positive((wider - 1) * (explained - explained @ explained))


def _positive(matrix: Array) -> Array:
    """Return the part of a symmetric matrix with positive eigenvalues."""
    size, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((vectors * np.maximum(size, 0.0)) @ vectors.T)
