"""The search for what is missing: test, add the best, test again, until nothing is left or nothing helps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from frictrack.compare import failing_spans
from frictrack.diagnose.experiments import settling
from frictrack.diagnose.limits import detection_limit
from frictrack.diagnose.null import Ensemble, ensemble
from frictrack.diagnose.rivals import NEAR, SAME, information, separation
from frictrack.diagnose.tests import ALPHA, Scanned, Tests, candidates, run_tests
from frictrack.diagnose.unexplained import unexplained_force
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit import Fit, series
from frictrack.fit.force import linear_estimates
from frictrack.fit.groups import GroupFits
from frictrack.fit.heldout import heldout_rms
from frictrack.fit.simulated.growth import grow, settled
from frictrack.fit.simulated.solve import Solution
from frictrack.fit.sure.estimate import Estimates, estimates
from frictrack.records import Array

MOST_ROUNDS = 4  # effects looked for one after the other
BEHIND, FAR_BEHIND = 0.7, 0.2  # of the best candidate's rise that another must reach to be refined
HELD_OUT = 3  # candidates whose held-out error is computed

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Candidate:
    """One effect tried on top of the model, refined, with its evidence."""

    effect: str
    acts_on: str
    parameters: dict[str, Any]
    p: float
    delta_bic: float
    heldout_before: float | None = None  # m
    heldout_after: float | None = None
    heldout: str | None = None
    indistinguishable_from: tuple[str, ...] = ()
    words: dict[str, str] = field(default_factory=dict)
    unit: str = "um"  # of the held-out errors: um of displacement, or N where friction was measured

    @property
    def helps(self) -> bool:
        """Whether the held-out error falls with it."""
        return self.heldout_after is None or self.heldout_before is None or self.heldout_after < self.heldout_before

    def summary(self) -> dict[str, Any]:
        """Entry of the JSON of `frictrack diagnose`."""
        held = {"before": self.heldout_before, "after": self.heldout_after}
        factor = 1e6 if self.unit == "um" else 1.0
        return {
            "effect": self.effect,
            "acts_on": self.acts_on,
            "parameters": self.parameters,
            "p": self.p,
            "delta_bic": self.delta_bic,
            **{f"heldout_rms_{when}_um": None for when in held},
            **{f"heldout_rms_{when}_{self.unit}": None if e is None else e * factor for when, e in held.items()},
            "heldout": self.heldout,
            "indistinguishable_from": list(self.indistinguishable_from),
            "words": self.words,
        }


@dataclass(frozen=True)
class Diagnosis:
    """What is missing in a fitted model, how sure, and what these runs could have shown."""

    model: list[str]
    verdict: str
    missing: list[str]
    noise_um: float | None
    reduced_chi2: float
    p_lack_of_fit: float
    fails_at: list[dict[str, Any]]
    candidates: list[Candidate]
    unexplained: dict[str, Any] | None
    detection_limits: dict[str, dict[str, Any]]
    remarks: list[str]
    figures: dict[str, dict[str, Array]]
    noise_N: float | None = None  # where friction was measured
    next_experiment: list[dict[str, Any]] = field(default_factory=list)

    @property
    def best(self) -> Candidate | None:
        """The candidate with the strongest evidence."""
        return self.candidates[0] if self.candidates else None

    def summary(self) -> dict[str, Any]:
        """The JSON of `frictrack diagnose`."""
        return {
            "model": self.model,
            "verdict": self.verdict,
            "missing": self.missing,
            "noise_um": self.noise_um,
            **({} if self.noise_N is None else {"noise_N": self.noise_N}),
            "reduced_chi2": self.reduced_chi2,
            "p_lack_of_fit": self.p_lack_of_fit,
            "fails_at": self.fails_at,
            "candidates": [c.summary() for c in self.candidates],
            "unexplained": self.unexplained,
            "next_experiment": self.next_experiment,
            "detection_limits": self.detection_limits,
            "remarks": self.remarks,
        }


@dataclass(frozen=True)
class _Tried:
    """A candidate refined on top of the current solution."""

    scanned: Scanned
    solution: Solution
    delta_bic: float
    p: float


@dataclass(frozen=True)
class _Round:
    """One test of one model: the draws, the tests, and the candidates refined, best first."""

    solution: Solution
    draws: Ensemble
    tests: Tests
    tried: list[_Tried]
    barred: dict[str, str]  # effects that could not be tried, and why

    @property
    def passing(self) -> list[_Tried]:
        return [t for t in self.tried if t.p < ALPHA / 2 and t.delta_bic > 0]


def diagnose(fit: Fit, *, own: Sequence[Effect] = (), seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """Search the library, and effects of your `own`, for what the fitted model lacks.

    `own` may also hold effects of the library with bounds, priors or fixed values. p-values hold for the whole search
    (999 draws, `seed`). Effects are added one after the other while the best passes; what an added effect makes
    needless is not added. Validation runs are not looked at.
    """
    tell = progress or (lambda done, total, what: None)
    rng = np.random.default_rng(seed)
    if isinstance(fit, GroupFits):
        raise FrictrackError("expected one fit of all runs to diagnose but got one per group; fit without --per first")
    # the tests work on the displacement, whatever domain or search the fit used
    start = fit.solution if fit.route.plain or fit.measured else settled(fit.solution)
    first = _round(start, own, rng, lambda what: tell(0, MOST_ROUNDS, what))
    found: list[_Tried] = []
    last = first
    while last.passing and len(found) < MOST_ROUNDS:
        found.append(replace(last.passing[0], solution=settled(last.passing[0].solution)))
        tell(len(found), MOST_ROUNDS, f"added {found[-1].scanned.effect.name}, testing again")
        last = _round(found[-1].solution, own, rng, lambda what: tell(len(found), MOST_ROUNDS, what))
    tell(MOST_ROUNDS, MOST_ROUNDS, "diagnosed")
    return _conclude(fit, first, last, found)


def _round(solution: Solution, own: Sequence[Effect], rng: np.random.Generator, tell: Callable[[str], None]) -> _Round:
    tell("drawing what nothing missing looks like")
    draws = ensemble(solution, rng)
    tell("trying every effect of the library")
    library, barred = candidates(solution, own)
    tests = run_tests(solution, draws, library)
    bare = information(solution)
    tried = []
    for s in _worth_refining(tests):
        tell(f"refining {s.effect.name}")
        try:
            grown = grow(solution, s.effect)
        except FrictrackError:
            continue
        tried.append(_Tried(s, grown, bare - information(grown), tests.p[s.effect.name]))
    tried.sort(key=lambda t: (-(t.p < ALPHA / 2), -t.delta_bic))
    return _Round(solution, draws, tests, tried, barred)


def _worth_refining(tests: Tests) -> list[Scanned]:
    """Candidates that stand out by themselves and are not far behind the best; the best two in any case."""
    order = sorted(tests.scanned, key=lambda s: -s.excess[0])
    top = order[0].statistic[0] if order else 0.0
    near = [s for s in order if tests.p[s.effect.name] < 0.05 and s.statistic[0] > _behind(s.effect) * top - NEAR]
    return near if len(near) >= 2 else order[:2]


def _behind(effect: Effect) -> float:
    """Share of the best rise that a candidate must reach: more where every run brings its own unknowns.

    The scan bends the law only to first order, so that it says too little of a strong effect.
    """
    return BEHIND if any(p.per_run for p in effect.parameters) else FAR_BEHIND


def _unrefined(first: _Round) -> list[Candidate]:
    """Candidates that pass by themselves but are far behind the best: as the scan saw them."""
    done = {t.scanned.effect.name for t in first.tried}
    price = float(np.log(first.solution.problem.n_frames))
    out = []
    for s in first.tests.scanned:
        if s.effect.name in done or first.tests.p[s.effect.name] >= 0.05:
            continue
        count = s.scans[0].family.size + sum(p.scan is not None for p in s.effect.nonlinear)
        out.append(
            Candidate(
                effect=s.effect.name,
                acts_on=s.effect.acts_on,
                parameters={},
                p=first.tests.p[s.effect.name],
                delta_bic=float(s.statistic[0] - price * count),
                words={"what": s.effect.what, "looks_like": s.effect.looks_like, "confirm": s.effect.confirm},
            )
        )
    return sorted(out, key=lambda c: -c.delta_bic)


def _conclude(fit: Fit, first: _Round, last: _Round, found: list[_Tried]) -> Diagnosis:
    rivals = {t.scanned.effect.name: _rivals(first, t) for t in first.passing[:3]}
    listed = [_candidate(first, t, rivals.get(t.scanned.effect.name, ()), k) for k, t in enumerate(first.tried)]
    chosen = [t.scanned.effect.name for t in found[:1]]
    listed = sorted(listed + _unrefined(first), key=lambda c: (c.effect not in chosen, c.p >= ALPHA / 2, -c.delta_bic))
    leftover = last.tests.p_lack_of_fit < ALPHA / 2
    clean = first.tests.p_lack_of_fit >= ALPHA / 2 and not first.passing
    if clean:
        verdict = "complete"
    elif leftover or not found or not listed[0].helps:
        verdict = "unexplained"
    else:
        verdict = "ambiguous" if rivals[found[0].scanned.effect.name] else "missing"
    limits, curves = _limits(first)
    noise = float(np.sqrt(np.mean(np.concatenate([r.piece.sigma for r in fit.solution.responses]) ** 2)))
    return Diagnosis(
        model=fit.model.names,
        verdict=verdict,
        missing=[t.scanned.effect.name for t in found],
        noise_um=None if fit.measured else 1e6 * noise,
        noise_N=noise if fit.measured else None,
        reduced_chi2=fit.reduced_chi2,
        p_lack_of_fit=first.tests.p_lack_of_fit,
        fails_at=[] if clean else _fails_at(fit, found),
        candidates=listed,
        unexplained=unexplained_force(last.solution) if verdict == "unexplained" else None,
        detection_limits=limits,
        remarks=_remarks(fit, first.barred),
        figures=curves,
        next_experiment=_next(first, found, rivals),
    )


def _next(first: _Round, found: list[_Tried], rivals: dict[str, tuple[str, ...]]) -> list[dict[str, Any]]:
    """What to film or measure next, where candidates are not told apart well enough."""
    best = [t.scanned.effect.name for t in found[:1]]
    order = sorted(first.passing, key=lambda t: t.scanned.effect.name not in best)
    passing = [(t.scanned.effect.name, t.solution, t.delta_bic) for t in order]
    return settling(first.solution, passing, rivals.get(best[0], ()) if best else ())


def _fails_at(fit: Fit, found: list[_Tried]) -> list[dict[str, Any]]:
    """Where the model fails: where the missing force acts, or, if none is known, where the residual stands out."""
    if found and found[0].scanned.effect.acts_on == "force":
        return failing_spans(found[0].solution, fit.runs, found[0].scanned.effect.name)
    return failing_spans(fit.solution, fit.runs)


def _rivals(first: _Round, best: _Tried) -> tuple[str, ...]:
    """Effects whose best fit to what `best` predicts differs by less than an expected chi-squared of `SAME`.

    One that needs decisively more parameters for it (an amplitude in every run) is no equal explanation.
    """
    out = []
    for other in first.tried:
        behind = other.solution.objective - best.solution.objective
        if other is best or behind > NEAR or best.delta_bic - other.delta_bic > 2 * SAME:
            continue
        if separation(best.solution, other.solution) < SAME:
            out.append(other.scanned.effect.name)
    return tuple(out)


def _candidate(first: _Round, tried: _Tried, rivals: tuple[str, ...], place: int) -> Candidate:
    effect = tried.scanned.effect
    before = after = how = None
    if tried.p < ALPHA / 2 and place < HELD_OUT:
        hold = series.heldout_rms if series.is_series(tried.solution.problem) else heldout_rms
        after, how = hold(tried.solution)
        before, _ = hold(first.solution, how)
    parameters = {
        name.split(".", 1)[1]: {"value": e.value, "std": e.std, "unit": e.unit}
        for name, e in _known(tried.solution).parameters.items()
        if name.rsplit(".", 1)[0] == effect.name
    }
    words = {"what": effect.what, "looks_like": effect.looks_like, "confirm": effect.confirm}
    return Candidate(
        effect=effect.name,
        acts_on=effect.acts_on,
        parameters=parameters,
        p=tried.p,
        delta_bic=float(tried.delta_bic),
        heldout_before=before,
        heldout_after=after,
        heldout=how,
        indistinguishable_from=rivals,
        words=words,
        unit="N" if series.is_series(tried.solution.problem) else "um",
    )


def _known(solution: Solution) -> Estimates:
    """Parameters with deviations, of a measured friction from blocks of its residual."""
    if series.is_series(solution.problem):
        return linear_estimates(solution, series.covariance(solution))
    return estimates(solution, profile=False)


def _limits(first: _Round) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
    limits, curves = {}, {}
    for s in first.tests.scanned:
        limits[s.effect.name], curve = detection_limit(s, first.draws, first.tests.critical)
        if len(s.scans) == 1:
            curve["rise"] = s.scans[0].rises
        curves[s.effect.name] = curve
    return limits, curves


def _remarks(fit: Fit, barred: dict[str, str]) -> list[str]:
    out = [f"not tried: {'; '.join(barred.values())}"] if barred else []
    if fit.measured:
        return out + series.remarks(fit.solution, fit.runs)
    if len(fit.runs) == 1:
        out.append("one run alone: slope, a cable and Coulomb friction cannot be told apart")
    if any(run.has_incline for run in fit.runs):
        out.append(
            "on an incline Coulomb friction and gravity act alike while the mass slides one way: with a nominal scale, "
            "mass or angle only changes of the force along the run mean anything"
        )
    out.append(
        "a constant error of scale, frame rate or mass is absorbed exactly: "
        "forces go with mass and scale, and with fps^2"
    )
    return out
