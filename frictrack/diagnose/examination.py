"""Examine a model: test it for lack of fit and for every effect that it may lack, with draws of the null hypothesis.

The null hypothesis is that the fitted model is complete (parametric bootstrap). A draw is white noise of the measured
level plus slow tracker errors, remaining camera shake and friction levels scattering by the fitted spread, all seen
through the linearised model. Noise level and spread are estimated again for every draw, as they were for the data, so
that both uncertainties enter every p-value.

References
----------
Efron & Tibshirani (1993), An Introduction to the Bootstrap, section 6.5.

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.fft import dct, idct

from frictrack import effects
from frictrack.base.distributions import chi2_isf
from frictrack.diagnose.model_selection import event_penalty, information_criterion, likelihood_gain
from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import (
    CandidateScan,
    Float32Array,
    LinearisedModel,
    ScannedSeries,
    linearise,
    measured_series,
)
from frictrack.fit.observations import MeasuredFrictionPiece
from frictrack.fit.pieces import Piece, Rows
from frictrack.fit.stepwise import EVENT_PARAMETERS, bic_penalty, can_choose_levels, scan_effects, ties_are_resolved
from frictrack.measure.motion import slow_spectrum
from frictrack.records import Array, Mask
from frictrack.sampling import DIFFERENCE_ORDER, FALLBACK_ORDER, difference_order, difference_variance

ALPHA = 0.01  # significance level of one diagnosis: half for lack of fit, half for candidates
N_DRAWS = 999
N_DRAWS_FEW = 399  # that decide most tests at a level of 0.005
MIN_DRAWS_BELOW_LEVEL = 2  # p-values that a level must leave below it; a small level takes more draws
TAU_GRID = np.geomspace(2e-4, 0.32, 13)  # spreads of friction levels at which a draw is estimated
COMMON_SCALE_QUANTILE = 0.99  # of each candidate's null distribution, subtracted for a common scale
TAIL_OF_DRAWS = 10  # one in so many draws, the largest, show how the tail falls off
LEAST_P = 1e-9  # that is stated; so far out no tail is known
LEFT_LEVEL_RATIO = 0.05  # of the level: a further cause, that no effect names, is that much less likely than chance
MIN_P_CLEAR = 0.05  # from which few draws show that p is not below a level of 0.005, but for one case in a million
MIN_CHI2_CLEAR = 10.0  # beyond all draws, from which more of them would not reach it: by chance, one in exp(5) would


@dataclass(frozen=True, eq=False)
class NullEnsemble:
    """Data (first column) and draws, ready to be scanned for any candidate.

    Parameters
    ----------
    law
        The linearised model.
    series
        Data and draws, grouped by their spread of friction levels.

    """

    law: LinearisedModel
    series: ScannedSeries

    @property
    def unbounded_projector(self) -> Array:
        """Projector of the model's residual at the data's own spread, as if no bound held an unknown, (L, L)."""
        own_group = next(i for i, columns in enumerate(self.series.groups) if columns.start == 0 < columns.stop)
        return self.law.unbounded_projector(float(self.series.taus[own_group]))

    def without_residuals(self) -> NullEnsemble:
        """Return the draws without their residuals, which take tens of megabytes and only tests of them need."""
        return NullEnsemble(self.law, replace(self.series, residuals=self.series.residuals[:, :1].copy()))


@dataclass(frozen=True)
class ScannedCandidate:
    """One candidate effect scanned over data and draws.

    Parameters
    ----------
    effect
        The effect.
    scans
        Its scans; one per run for events.
    statistic
        Best gain of chi-squared for data and draws, (D,).
    quantile
        Quantile of its own null distribution, which puts candidates on a common scale.

    """

    effect: Effect
    scans: list[CandidateScan]
    statistic: Array
    quantile: float

    @property
    def excess(self) -> Array:
        """Statistic above its own null quantile, (D,)."""
        return self.statistic - self.quantile


@dataclass(frozen=True, eq=False)
class Examination:
    """One model, tested for lack of fit and for every candidate, calibrated for the whole search.

    Parameters
    ----------
    solution
        The model.
    draws
        Data and draws of the null hypothesis that it is complete.
    level
        Significance level of each of the two tests: lack of fit, and all candidates together.
    p_lack_of_fit
        p-value of the lack-of-fit test.
    scanned
        The scanned candidates.
    null
        Largest excess of any candidate in every draw of the null hypothesis, (D - 1,).
    least_p
        Smallest p-value: that of a gain far beyond all draws.
    quantiles
        Quantile of every candidate's own null distribution.
    gains
        What every candidate gains in its scan.
    excluded
        Effects that could not be tried, with the reason.

    """

    solution: Solution
    draws: NullEnsemble
    level: float
    p_lack_of_fit: float
    scanned: Sequence[ScannedCandidate]
    null: Array
    least_p: float
    quantiles: Mapping[str, float]
    gains: Mapping[str, float]
    excluded: Mapping[str, str]

    @cached_property
    def p(self) -> dict[str, float]:
        """p-value of every candidate."""
        return {name: self.p_of_excess(name, gain) for name, gain in self.gains.items()}

    @property
    def leaves_misfit(self) -> bool:
        """Whether the misfit is significant."""
        return self.p_lack_of_fit < self.level

    @property
    def something_is_missing(self) -> bool:
        """Whether the misfit or the gain of any effect is significant."""
        return min(self.p_lack_of_fit, *self.p.values(), 1.0) < self.level

    def after_effects(self) -> Examination:
        """Return the same examination where effects were found, and nothing explains what they leave."""
        return replace(self, level=LEFT_LEVEL_RATIO * self.level)

    @property
    def critical(self) -> float:
        """Excess that a search exceeds by chance with probability `level`."""
        return float(np.quantile(self.null, 1 - self.level))

    def p_of_excess(self, name: str, gain: float) -> float:
        """p-value of a gain of chi-squared by an effect; one that was not scanned gains by chance what any does."""
        excess = gain - self.quantiles.get(name, max(self.quantiles.values(), default=0.0))
        p = p_value(self.null, excess)
        return min(p, self.least_p) if excess > self.null.max() + MIN_CHI2_CLEAR else p

    def p_of_gain(self, effect: Effect, gain: float) -> float:
        """Return the p-value of an effect: of its scan, or of what its fit gains if something is missing.

        A scan holds the shape of the law. Where that imitates what is missing (a Stribeck velocity far too large
        imitates drag), an effect explains nothing until both are fitted. Whether something is missing is decided by
        scans alone.

        Parameters
        ----------
        effect
            The effect.
        gain
            Likelihood ratio of the model with it, less the penalty for its events.

        """
        p = self.p.get(effect.title, 1.0)
        return min(p, self.p_of_excess(effect.title, gain)) if self.something_is_missing else p

    def confirms(self, fitted: Solution, effect: Effect) -> bool:
        """Whether a simulated fit confirms what the scan of an effect promised.

        It does if it lowers the BIC, or if its likelihood ratio reaches the critical value of the search. The second
        condition matters for small effects with many parameters, such as a wave with a phase in every run: there the
        penalty of BIC exceeds the critical value, and BIC alone would discard effects that the search detects at its
        stated level.

        Parameters
        ----------
        fitted
            The model with the effect.
        effect
            The effect.

        """
        if information_criterion(self.solution) > information_criterion(fitted):
            return True
        needed = self.quantiles.get(effect.title)
        if needed is None:
            return False
        gain = likelihood_gain(self.solution, fitted) - event_penalty(fitted.problem, fitted.problem.layout, effect)
        return gain > needed + self.critical - _loss_by_shared_amplitude(fitted, effect)


def examine(solution: Solution, own: Sequence[Effect], rng: np.random.Generator, level: float) -> Examination:
    """Test a model for every effect that it may lack.

    The effects are scanned over some of the draws, and over the others only where these do not decide whether the
    strongest effect is significant (sequential Monte Carlo).

    Parameters
    ----------
    solution
        The model.
    own
        Further effects to try.
    rng
        Random generator.
    level
        Significance level of the test for lack of fit, and of that of all candidates together.

    Returns
    -------
    Examination

    References
    ----------
    Besag, J. & Clifford, P. (1991). Sequential Monte Carlo p-values. Biometrika 78, 301-304.

    """
    library, excluded = list_candidates(solution, own)
    draws, scanned = draw_null_ensemble(solution, rng, count_draws(level)), list[ScannedCandidate]()
    for series in draws.series.divided(count_draws(level, N_DRAWS_FEW)):
        scanned = [
            _more_draws(scanned[i] if scanned else None, draws.law, *found)
            for i, found in enumerate(scan_effects(draws.law, library, series))
        ]
        null = np.max([s.excess[1:] for s in scanned], axis=0) if scanned else np.zeros(1)
        strongest = max((float(s.excess[0]) for s in scanned), default=0.0)
        if p_value(null, strongest) >= MIN_P_CLEAR or strongest > null.max() + MIN_CHI2_CLEAR:
            break
    return Examination(
        solution,
        draws.without_residuals(),
        level,
        p_lack_of_fit=lack_of_fit(draws),
        scanned=scanned,
        null=null,
        least_p=1 / draws.series.coordinates.shape[1],
        quantiles={s.effect.title: s.quantile for s in scanned},
        gains={s.effect.title: float(s.statistic[0]) for s in scanned},
        excluded=excluded,
    )


def _more_draws(
    before: ScannedCandidate | None, law: LinearisedModel, effect: Effect, scans: list[CandidateScan]
) -> ScannedCandidate:
    """A candidate with the draws of one more scan."""
    statistic = _statistic(law, scans)
    if before is not None:
        statistic, scans = np.append(before.statistic, statistic[1:]), before.scans
    return ScannedCandidate(effect, scans, statistic, float(np.quantile(statistic[1:], COMMON_SCALE_QUANTILE)))


def examine_again(
    solution: Solution, own: Sequence[Effect], rng: np.random.Generator, before: Examination
) -> Examination:
    """Test a model with the effects found: few draws show its lack of fit, if they decide (sequential Monte Carlo).

    What effects gain by chance is known from the examination of the smaller model. Where a misfit is left, none is
    scanned.

    Parameters
    ----------
    solution
        The model.
    own
        Further effects to try.
    rng
        Random generator.
    before
        Examination of the model without these effects.

    Returns
    -------
    Examination

    """
    draws = draw_null_ensemble(solution, rng, count_draws(before.level, N_DRAWS_FEW))
    p = lack_of_fit(draws)
    if before.level <= p < MIN_P_CLEAR:
        draws = draw_null_ensemble(solution, rng, count_draws(before.level))
        p = lack_of_fit(draws)
    gains: dict[str, float] = {}
    if p >= before.level:
        scanned = scan_effects(draws.law, list_candidates(solution, own)[0], measured_series(draws.law))
        gains = {effect.title: float(_statistic(draws.law, scans)[0]) for effect, scans in scanned}
    return replace(before, solution=solution, draws=draws.without_residuals(), p_lack_of_fit=p, scanned=[], gains=gains)


def lack_of_fit(draws: NullEnsemble) -> float:
    """Test the residuals for lack of fit against the measured noise.

    The residual of every piece is cosine-transformed. Energies are summed up to growing orders, and the order that
    deviates most is taken, in data and draws alike.

    Parameters
    ----------
    draws
        Data and draws of the null hypothesis.

    Returns
    -------
    float
        p-value; beyond all draws, that of an exponential tail through the largest of them.

    References
    ----------
    Fan (1996), J. Am. Stat. Assoc. 91, 674-688: adaptive Neyman test. Pickands (1975), Ann. Stat. 3, 119-131: tails.

    """
    longest = max(rows.stop - rows.start for rows in draws.law.rows)
    orders = [*[2**k for k in range(2, 20) if 2**k < longest], longest]
    sums = np.zeros((len(orders), draws.series.residuals.shape[1]))
    for rows in draws.law.rows:
        energy = dct(draws.series.residuals[rows], axis=0, norm="ortho") ** 2
        sums += np.stack([energy[:order].sum(axis=0) for order in orders])
    center, spread = sums[:, 1:].mean(axis=1), sums[:, 1:].std(axis=1)
    statistic = np.max((sums - center[:, None]) / spread[:, None], axis=0)
    null = np.sort(statistic[1:])
    if statistic[0] <= null[-1]:
        return p_value(null, float(statistic[0]))
    tail = null[-max(len(null) // TAIL_OF_DRAWS, 1) :]
    share, scale = len(tail) / len(null), max(float(np.mean(tail - tail[0])), 1e-12)
    beyond = share * np.exp((tail[0] - statistic[0]) / scale)
    return float(np.clip(beyond, LEAST_P, 1 / (len(null) + 1)))


def list_candidates(solution: Solution, own: Iterable[Effect] = ()) -> tuple[list[Effect], dict[str, str]]:
    """List the effects that could enter a model.

    An effect that replaces others, such as LuGre, is another model and no candidate; see `effects.laws_in_place_of`.

    Parameters
    ----------
    solution
        The fitted model.
    own
        Further effects to try, or library effects with settings of the study.

    Returns
    -------
    found : list of Effect
        Under the names that they would have in the model.
    excluded : dict of str
        Why other effects cannot enter, by name.

    """
    own = list(own)
    model, paths = solution.problem.model, [p.path for p in solution.problem.pieces]
    replaced = frozenset().union(*(e.replaces for e in model.effects))
    found, excluded = [], {}
    for kind in effects.known(own).values():
        if kind.name != kind.kind or kind.replaces or kind.kind in replaced:
            continue
        if (kind.name in model and not _can_occur_twice(kind)) or (kind.modifies and not kind.changed(model.effects)):
            continue
        if "friction" in kind.needs if solution.problem.simulates else kind.acts_on == "measurement":
            continue  # no instrument that would show it
        if "upright" in kind.needs:
            continue  # the law of runs on such a circle has it already
        if paths[0].steady and not kind.is_of_velocity:
            continue  # the remarks on points (v, F) say it of all at once
        effect = effects.get(model.next_instance(kind.name), own)
        if why := effect.lacks(paths) or _missing_tie(effect, model) or _needs_reversal(effect, solution):
            excluded[effect.name] = why
        else:
            found.append(effect)
    return [*found, *_freed(solution)], excluded


def _freed(solution: Solution) -> list[Effect]:
    """The effects of the model with one parameter freed: a fixed one, a stated incline, what all runs share.

    That is a place, or the size of friction that friction levels need not multiply: it may scatter by itself.
    """
    several = len(solution.problem.layout.run_names) > 1
    parts = solution.problem.model.effects if can_choose_levels(solution.problem.layout, solution.p) else ()
    return [
        *(e.freed(p.name) for e in parts if e.may_follow_level for p in e.linear if p.loaded == e.level_is_chosen),
        *(
            e.freed(p.name)
            for e in solution.problem.model.effects
            for p in e.parameters
            if (p.fixed is not None and p.known is None)
            or (e.same_cause_as and p.prior is not None)
            or (several and p.free and p.unit == "m" and not p.per_run and (p.signed or p.linear))
        ),
    ]


def _missing_tie(effect: Effect, model: Model) -> str:
    """Why an effect cannot enter alone: it is tied to one that the model lacks; "" if it can."""
    if ties_are_resolved(effect, model.effects):
        return ""
    return f"{effect.name} follows an effect that the model does not have"


def _needs_reversal(effect: Effect, solution: Solution) -> str:
    """Why an effect with memory is not identifiable: in one direction it equals a spring or running-in; "" if it is."""
    if effect.modifies or not (effect.memory and effect.turns):
        return ""
    problem = solution.problem
    one_way = [problem.simulates and not p.turns for p in problem.pieces]  # cut at every reversal
    directions = {
        (p.run, float(s))
        for p, is_one_way in zip(problem.pieces, one_way, strict=True)
        for s in np.sign(p.path.s[-1:] if is_one_way else p.v_hat)
    }
    if len({w for w in directions if w[1]}) > len({run for run, s in directions if s}):
        return ""
    return f"{effect.name} needs a run that reverses; let the mass swing to and fro"


def _can_occur_twice(effect: Effect) -> bool:
    """Whether a second effect of the kind is a different cause: another line, time or place."""
    in_place = any(p.signed and p.unit == "m" for p in effect.parameters) and effect.acts_on == "force"
    per_run = any(p.role == "phase" or p.per_run for p in effect.parameters)
    return (per_run or in_place) and any(p.scan is not None and p.free for p in effect.parameters)


def _statistic(law: LinearisedModel, scans: Sequence[CandidateScan]) -> Array:
    """Best gain of a candidate for every series, (D,). Events of single runs each pay a penalty."""
    tops = np.stack([s.max_gains for s in scans])
    if len(scans) == 1:
        return np.asarray(tops[0])
    left = tops - bic_penalty(EVENT_PARAMETERS, law.solution.problem.n_frames)
    return np.maximum(np.sum(np.maximum(left, 0.0), axis=0), left.max(axis=0))


def p_value(null: Array, value: float) -> float:
    """Share of the null values, this one included, that reach a value."""
    return float((1 + np.sum(null >= value)) / (len(null) + 1))


def _loss_by_shared_amplitude(fitted: Solution, effect: Effect) -> float:
    """Loss of likelihood by chance by one amplitude for all runs, where the scan had one for each run."""
    layout = fitted.problem.layout
    slots = [s for s in layout.slots if s.effect == effect.name]
    phased = any(s.parameter == "phase" and s.run is not None for s in slots)
    shared = any(s.parameter in ("amplitude", "depth") and s.run is None for s in slots)
    more = len(layout.run_names) - 1
    return float(chi2_isf(ALPHA, more)) if phased and shared and more else 0.0


def count_draws(level: float, at_least: int = N_DRAWS) -> int:
    """Number of draws of a test at a significance level: `at_least`, or more where these cannot show such a level.

    Examples
    --------
    >>> count_draws(0.005), count_draws(0.001)
    (999, 1999)

    """
    return max(at_least, int(np.ceil(MIN_DRAWS_BELOW_LEVEL / level)) - 1)


def draw_null_ensemble(solution: Solution, rng: np.random.Generator, draws: int = N_DRAWS) -> NullEnsemble:
    """Draw data of the null hypothesis that the fitted model is complete."""
    law = linearise(solution)
    fitted, basis = law.solution, law.basis
    data = np.empty((len(basis.u), 1 + draws), dtype=np.float32)
    data[:, 0] = fitted.random_effect_data()
    _fill_noise(law, data[:, 1:], rng)
    levels = fitted.problem.layout.levels
    if basis.random:
        scatter = fitted.tau * rng.standard_normal((len(levels), draws))
        for rows in law.rows:
            data[rows, 1:] += (fitted.jac[rows][:, levels] @ scatter).astype(np.float32)
    coordinates = law.coordinates(data)
    taus = np.append(TAU_GRID, fitted.tau) if basis.random else np.array([1.0])
    on_basis = law.basis_coordinates.T @ coordinates
    profile = np.stack([basis.misfit(on_basis, np.zeros(1 + draws), tau) + basis.logdet(tau) for tau in taus])
    best = np.argmin(profile, axis=0)
    # draws of one spread side by side, those of the data's own first
    order = np.concatenate([[0], 1 + np.argsort((best[1:] != best[0]) * (1 + best[1:]), kind="stable")])
    used = list(dict.fromkeys(best[order].tolist()))
    ends = np.cumsum([0, *[int(np.sum(best == t)) for t in used]]).tolist()
    groups = dict(zip(used, (slice(a, b) for a, b in pairwise(ends)), strict=True))
    spreads = [groups.get(t, slice(0, 0)) for t in range(len(taus))]
    coordinates, fits = coordinates[:, order], np.empty((basis.u.shape[1], 1 + draws), dtype=np.float32)
    for tau, columns in zip(taus, spreads, strict=True):
        fits[:, columns] = law.fitted_coordinates(coordinates[:, columns], tau)
    for rows in law.rows:  # piece by piece, because many runs leave no room for a second copy
        data[rows] = np.take(data[rows], order, axis=1) - basis.u[rows].astype(np.float32) @ fits
    projectors = [law.residual_projector(tau) for tau in taus]
    measured = fitted.random_effect_data()
    return NullEnsemble(law, ScannedSeries(measured, data, coordinates, taus, projectors, spreads, profile[:, order]))


def _fill_noise(law: LinearisedModel, out: Float32Array, rng: np.random.Generator) -> None:
    """Fill in noise (N, D) over its estimated level, run by run, with initial conditions projected out."""
    for rows in law.rows:
        out[rows] = rng.standard_normal(out[rows].shape, dtype=np.float32)
    for run in law.runs:
        members = [i for i, s in enumerate(law.pieces) if s.run == run]
        one = law.pieces[members[0]].response
        if one.piece.path.steady:
            assert isinstance(one.piece, MeasuredFrictionPiece)
            drawn = out[law.rows[members[0]]].astype(np.float64)
            level = one.piece.noise_levels(one.model_y, one.r, len(law.solution.p), drawn)
        else:
            level = _noise_level(
                [law.pieces[i].response.piece.frames for i in members], [out[law.rows[i]] for i in members]
            )
        for i in members:
            e = out[law.rows[i]]
            e /= level
            piece = law.pieces[i].response.piece
            if piece.locked and piece.path.pixel_pitch:
                e *= np.float32(np.sqrt(1 - piece.locked))
                e += peak_locking_errors(piece.y / piece.path.pixel_pitch, e.shape[1], rng) * np.float32(
                    np.sqrt(piece.locked)
                )
            if piece.step:
                share = min(piece.step**2 / 12.0 / float(np.mean(piece.sigma**2)), 1.0)
                e *= np.float32(np.sqrt(1 - share))
                e += _whitened(piece, rounding_errors(law.pieces[i].response.model_y, piece.step, e.shape[1], rng))
            if piece.systematic:
                e += _whitened(piece, piece.systematic * slow_errors(e.shape, rng))
            if piece.clock_error:
                moved = piece.clock_error * law.pieces[i].response.motion.v_edge[piece.at] * piece.t
                rates = rng.standard_normal((1, e.shape[1]), dtype=np.float32)
                e += _whitened(piece, moved[:, None].astype(np.float32) * rates)
            if piece.shake:
                frequency, rms = piece.shake
                e += _whitened(piece, rms * random_tones(piece.t * frequency, e.shape[1], rng))
            q = law.pieces[i].response.q.astype(np.float32)
            e -= q @ (q.T @ e)


def _whitened(piece: Piece, errors: Float32Array) -> Float32Array:
    return piece.whitened(errors.astype(np.float64)).astype(np.float32)


def slow_errors(shape: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
    """Slow errors of rms one, equally large in every octave from a few frames to the whole piece.

    `shape`: frames and draws, (n, D).
    """
    waves, size = np.zeros(shape, dtype=np.float32), slow_spectrum(shape[0]).astype(np.float32)
    waves[1 : 1 + len(size)] = size[:, None] * rng.standard_normal((len(size), shape[1]), dtype=np.float32)
    return idct(waves, axis=0, norm="ortho")


def peak_locking_errors(place: Array, draws: int, rng: np.random.Generator) -> Float32Array:
    """Peak-locking errors of rms one on average, periodic in the pixel.

    They change slowly where the target moves a whole number of pixels per frame, or stops.

    `place`: positions, px, (n,).
    """
    return (random_tones(place, draws, rng) + random_tones(2 * place, draws, rng)) / np.float32(np.sqrt(2))


def rounding_errors(place: Array, step: float, draws: int, rng: np.random.Generator) -> Float32Array:
    """Errors of positions rounded to multiples of a step, with random origin.

    While a mass moves less than a step per frame they are equal from frame to frame, so they are not white.

    `place`: positions, m, (n,); `step`: rounding step, m. Returns the errors, m.

    References
    ----------
    Widrow & Kollar (2008), Quantization Noise, section 20.

    """
    at = place[:, None] / step + rng.uniform(0.0, 1.0, (1, draws))
    return (step * (np.round(at) - at)).astype(np.float32)


def random_tones(cycles: Array, draws: int, rng: np.random.Generator) -> Float32Array:
    """Sinusoids of rms one on average and random phase, (n, D), at phases `cycles` (n,)."""
    waves = np.stack([np.cos(2 * np.pi * cycles), np.sin(2 * np.pi * cycles)], axis=1).astype(np.float32)
    return waves @ rng.standard_normal((2, draws), dtype=np.float32)


def _noise_level(frames: list[Rows], noise: list[Float32Array]) -> Array:
    """Level (D,) of white noise (n, D) in the pieces of a run, estimated like that of the data."""
    consecutive = {k: [_consecutive(f, k) for f in frames] for k in (DIFFERENCE_ORDER, FALLBACK_ORDER)}
    n_high, n_fallback = (sum(int(np.sum(w)) for w in consecutive[k]) for k in (DIFFERENCE_ORDER, FALLBACK_ORDER))
    order = difference_order(n_high, n_fallback)
    total = np.zeros(noise[0].shape[1])
    for e, rows in zip(noise, consecutive[order], strict=True):
        d = np.diff(e, order, axis=0)[rows]
        total += np.einsum("nd,nd->d", d, d)
    return np.asarray(
        np.sqrt(total / max(n_high if order == DIFFERENCE_ORDER else n_fallback, 1) / difference_variance(order))
    )


def _consecutive(frames: Rows, order: int) -> Mask:
    """Which differences of an order use only consecutive frames."""
    step = int(np.median(np.diff(frames)))  # of a series of which only every so many frames count
    return np.asarray(frames[order:] - frames[:-order] == order * step)
