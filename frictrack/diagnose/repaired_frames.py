"""Say whether a verdict rests on frames that the user had tracked again: refit the linearised models without them.

Leaving rows out of a linear least-squares fit is exact and cheap when the whitened Jacobian is at hand: the remaining
rows are fitted again, with the start of every piece free. Nonlinear parameters move along their tangents only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.diagnose.examination import Examination
from frictrack.diagnose.refined_candidates import RefinedCandidate
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.number_format import format_number
from frictrack.records import Array, Mask, Run
from frictrack.repairs import TRACKED_AGAIN

MIN_EXCESS_SIGMAS = 4.0  # of chi-squared above its expectation, for a misfit to stand without the repaired frames
MAX_SHARE_LEFT = 0.5  # of the misfit, up to which it rests on the repaired frames
Codes = NDArray[np.int8]
ADVICE = 'look at them in the film, or repair them with how = "leave_out", and diagnose again'


@dataclass(frozen=True)
class _Counts:
    """Frames tracked again that a model was compared with, by run."""

    by_run: dict[str, int]

    @property
    def words(self) -> str:
        parts = [f'{count} frame{"s" * (count > 1)} of run "{name}"' for name, count in self.by_run.items()]
        return " and ".join(parts)


def rests_on_repairs(
    runs: Sequence[Run], verdict: str, first: Examination, last: Solution, found: Sequence[RefinedCandidate]
) -> str | None:
    """Return a sentence if the verdict would change without the frames that were tracked again.

    Parameters
    ----------
    runs
        The fitted runs.
    verdict
        The verdict.
    first
        Examination of the model that is diagnosed.
    last
        The model with all effects found.
    found
        The effects found, in order.

    Returns
    -------
    str or None
        None if no frame was tracked again, or if the verdict stands without them.

    Notes
    -----
    For every effect found, the fall of chi-squared without these frames is compared with what the search demands of it;
    for a misfit that nothing explains, the misfit that is left.

    """
    repaired = [run.motion.repaired for run in runs]
    if verdict not in ("missing", "ambiguous", "unexplained") or not first.solution.problem.simulates:
        return None
    counts = _counts(runs, repaired, first.solution)
    if not counts.by_run:
        return None
    if verdict == "unexplained":
        return _misfit_rests(first.solution, last, repaired, counts)
    return _effects_rest(first, found, repaired, counts)


def _counts(runs: Sequence[Run], repaired: Sequence[Codes | None], solution: Solution) -> _Counts:
    """Count the repaired frames that the model was compared with."""
    by_run: dict[str, int] = {}
    for response in solution.responses:
        count = int(np.count_nonzero(~_kept(response, repaired)))
        if count:
            name = runs[response.piece.run].name
            by_run[name] = by_run.get(name, 0) + count
    return _Counts(by_run)


def _kept(response: PieceResponse, repaired: Sequence[Codes | None]) -> Mask:
    """Frames of a piece that were not tracked again."""
    codes = repaired[response.piece.run]
    n = len(response.r_full)
    return np.ones(n, np.bool_) if codes is None else np.asarray(codes[response.piece.frames] != TRACKED_AGAIN)


def _effects_rest(
    first: Examination, found: Sequence[RefinedCandidate], repaired: Sequence[Codes | None], counts: _Counts
) -> str | None:
    """Name the first effect whose evidence is too small without the repaired frames."""
    demanded = {name: quantile + first.tests.critical for name, quantile in first.tests.quantiles.items()}
    before = first.solution
    for t in found:
        if t.solution is None or t.objection:
            continue
        if set(t.law.problem.model.names) - set(before.problem.model.names) != {t.effect.name}:
            before = first.solution  # the review has removed an effect that was found before
        gain = before.chi2 - t.law.chi2
        left = chi2_without(before, repaired) - chi2_without(t.law, repaired)
        needed = max(gain - t.delta_bic, demanded.get(t.effect.title, 0.0))
        if left < min(needed, gain):
            return (
                f"this verdict rests on {counts.words} that were tracked again: without them chi-squared falls by "
                f"{format_number(max(left, 0.0), 2)} with {t.effect.title} instead of {format_number(gain, 2)}, and "
                f"{format_number(needed, 2)} is needed; {ADVICE}"
            )
        before = t.law
    return None


def _misfit_rests(first: Solution, last: Solution, repaired: Sequence[Codes | None], counts: _Counts) -> str | None:
    """Say that the misfit is insignificant without the repaired frames: of the model, or with the effects found."""
    if _is_misfit_gone(first, repaired):
        without = "the model agrees with the data"
    elif last is not first and _is_misfit_gone(last, repaired):
        without = "the effects found explain the misfit"
    else:
        return None
    return f"this verdict rests on {counts.words} that were tracked again: without them {without}; {ADVICE}"


def _is_misfit_gone(solution: Solution, repaired: Sequence[Codes | None]) -> bool:
    """Whether most of the misfit, and what is significant of it, goes with the repaired frames."""
    n_kept = sum(int(np.count_nonzero(_kept(r, repaired))) for r in solution.responses)
    left, excess = chi2_without(solution, repaired) - n_kept, solution.chi2 - solution.problem.n_frames
    return left <= min(MAX_SHARE_LEFT * excess, MIN_EXCESS_SIGMAS * float(np.sqrt(2.0 * n_kept)))


def chi2_without(solution: Solution, repaired: Sequence[Codes | None]) -> float:
    """Chi-squared of a model fitted again, in linear approximation, without the frames that were tracked again.

    Parameters
    ----------
    solution
        The fit.
    repaired
        Codes of the frames of every run; None where no frame was repaired.

    """
    parts = [_without_start(response, _kept(response, repaired)) for response in solution.responses]
    jac = np.zeros((sum(len(r) for r, _ in parts), len(solution.p)))
    at = 0
    for response, (r, own) in zip(solution.responses, parts, strict=True):
        jac[at : at + len(r), response.active] = own
        at += len(r)
    residual = np.concatenate([r for r, _ in parts])
    scale = np.linalg.norm(jac, axis=0)
    step = np.linalg.lstsq(jac / np.where(scale > 0, scale, 1.0), residual, rcond=1e-8)[0]
    return float(np.sum((residual - jac @ (step / np.where(scale > 0, scale, 1.0))) ** 2))


def _without_start(response: PieceResponse, kept: Mask) -> tuple[Array, Array]:
    """Residual and sensitivities of the kept frames of a piece, with what another start explains projected out."""
    q, _ = np.linalg.qr(response.q[kept])
    r, jac = response.r_full[kept], response.jac[kept]
    return r - q @ (q.T @ r), jac - q @ (q.T @ jac)
