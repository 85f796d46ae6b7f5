"""Fit a friction model to runs: variable projection for the start, output-error Gauss-Newton for the result."""

# ruff: noqa: F401 - what is imported from here and not used is the interface

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, TypedDict, Unpack, overload

import numpy as np

from frictrack.base.arguments import checked
from frictrack.base.distributions import RNG
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.workers import one_thread
from frictrack.effects import Effect, check_ties, models
from frictrack.effects.models import Model
from frictrack.fit.covariates import CovariateTrend, CovariateTrends, ParameterEstimates, trend
from frictrack.fit.cutting import Reference, cut_into_pieces, guess_mass, piece_frames, pieces_of, reference_of
from frictrack.fit.global_search import Callback, fit_by_search, generation_limit, outcome_of
from frictrack.fit.least_squares import LeastSquaresProblem, refine
from frictrack.fit.observations import friction_pieces
from frictrack.fit.observations.acceleration import fit_accelerations, fit_starts
from frictrack.fit.observations.load_cell import (
    MeasuredFrictionProblem,
    check_effects,
    fit_measured_friction,
    reference_load,
    uses_measured_friction,
)
from frictrack.fit.parameters import (
    MASS_EFFECT,
    ParameterLayout,
    is_mass_unknown,
    mass_ratio,
    rescale_to_mass,
    with_mass,
    without_mass,
)
from frictrack.fit.pieces import Piece, spans_of
from frictrack.fit.prediction import predict_run
from frictrack.fit.priors import PRIOR_NEEDS_NOISE, apply_prior, with_known_gravity, with_stated_incline
from frictrack.fit.result import Fit, GroupFits, by_group, with_uncertainty
from frictrack.fit.routes import FitOutcome, Route, SearchedOptima, check_route
from frictrack.fit.stepwise import add_effect, remove_effect
from frictrack.fit.stepwise.growth import fit_displacement
from frictrack.fit.uncertainty import Bootstrap, UncertaintyAnalysis, analyse_uncertainty, bootstrap
from frictrack.fit.uncertainty.profile_likelihood import Profile, profile
from frictrack.records import Array, Run
from frictrack.search import Convergence, SearchMethod
from frictrack.settings.priors import Prior

_Unknowns = tuple[Array, list[Array], float]  # parameters (P,), starts of the pieces, scatter of the levels


class FitSettings(TypedDict, total=False):
    """Settings of `fit` by name, for type checkers."""

    domain: str | None
    search: str | SearchMethod
    rng: RNG
    reference_mass: float | None
    prior: Prior | None
    over: str
    callback: Callback | None


@overload
def fit(
    model: Model | str | Sequence[str | Effect],
    runs: Sequence[Run],
    *,
    per: None = None,
    **settings: Unpack[FitSettings],
) -> Fit: ...


@overload
def fit(
    model: Model | str | Sequence[str | Effect], runs: Sequence[Run], *, per: str, **settings: Unpack[FitSettings]
) -> GroupFits: ...


@checked
@one_thread()
def fit(  # noqa: PLR0913 - one door with named settings, all but two of them optional
    model: Model | str | Sequence[str | Effect],
    runs: Sequence[Run],
    *,
    domain: str | None = None,
    search: str | SearchMethod = "varpro",
    rng: RNG = 0,
    reference_mass: Annotated[float, "kg"] | None = None,
    prior: Prior | None = None,
    per: str | None = None,
    over: str = "all",
    callback: Callback | None = None,
) -> Fit | GroupFits:
    """Fit a model to runs, all together.

    Parameters
    ----------
    model : Model or str or sequence of str
        A model, the name of one such as ``"tustin"``, or a list of effects.
    runs : sequence of Run
        The runs. Those with the role "validation" are not fitted but predicted.
    domain : {"displacement", "force"}, optional
        What is compared: displacement, the default, or acceleration after low-pass and double difference, as in the
        papers. Where friction itself was measured, the default is "force", compared with that series without a mass.
    search : str or SearchMethod
        ``"varpro"`` (variable projection) or a global search: one of `frictrack.search.METHODS`, or one with settings,
        such as ``ft.search.MGA(generations=500)``. Ctrl-C ends a global search with the best values so far.
    rng : numpy.random.Generator or int or None
        Random numbers of a global search: a generator, a seed, or None for other numbers in every call.
    reference_mass : float, optional
        Mass at which forces are reported, kg; default that of the first run.
    prior : Prior, optional
        What is known of the law from another set-up, such as ``other_fit.to_prior()``.
    per : {"group"}, optional
        Fit every group of runs separately.
    over : {"all", "nonlinear"}
        What a global search varies: all parameters, or the non-linear ones with the coefficients solved for every
        trial.
    callback : callable, optional
        ``callback(generation, best, misfit)`` gets the best point of a global search by address after every
        generation. A true return value stops the search.

    Returns
    -------
    Fit or GroupFits
        The fit; with ``per="group"`` one per group.

    Raises
    ------
    FrictrackError
        If no run can be fitted; (usage) for an unknown domain or search.

    References
    ----------
    Golub, G. H. & Pereyra, V. (1973). The differentiation of pseudo-inverses and nonlinear least squares problems
    whose variables separate. SIAM J. Numer. Anal. 10, 413-432.

    Examples
    --------
    >>> import frictrack as ft
    >>> fit = ft.fit(["coulomb", "viscous", "patch"], ft.samples.runs()[:2])
    >>> estimate = fit.parameters["coulomb.F_c"]
    >>> round(estimate.value, 1), estimate.unit
    (0.9, 'N')

    """
    check_route(domain or "force", search if isinstance(search, str) else search.name, per, over)
    law = model if isinstance(model, Model) else models.parse(model)
    check_ties(law.effects)
    if not runs:
        raise UsageError("expected a list of runs, such as ft.samples.runs(), but got none")
    if uses_measured_friction(runs, domain):
        check_effects(law, runs)
        reference = Reference(1.0, reference_load(runs))
        law = law if prior is None else apply_prior(law, prior, reference.load)
        fit_group = partial(
            _fit_friction, law, route=Route.of("force", search, rng, over), reference=reference, callback=callback
        )
    else:
        mass = reference_mass if per is None else reference_mass or runs[0].mass  # the same for all groups
        route = Route.of(domain or "displacement", search, rng, over)
        fit_group = partial(_fit_motion, law, route=route, mass=mass, prior=prior, callback=callback)
    return fit_group(runs) if per is None else GroupFits({g: fit_group(own) for g, own in by_group(runs).items()})


def _runs_to_fit(runs: Sequence[Run]) -> tuple[list[Run], tuple[str, ...], float]:
    """The runs that are fitted, their names and their frame rate, 1/s."""
    fitted = [r for r in runs if r.role == "fit"]
    if not fitted:
        raise FrictrackError('expected at least one run to fit but all have role = "validation"')
    names = tuple(r.name for r in fitted)
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise UsageError(f"expected every run to have its own name but got {', '.join(twice)} twice")
    return fitted, names, float(1 / np.median(np.concatenate([np.diff(r.displacement.t) for r in fitted])))


def _fit_friction(
    law: Model, runs: Sequence[Run], route: Route, reference: Reference, callback: Callback | None
) -> Fit:
    """The fit of runs whose friction a load cell measured, in newtons at the load of the reference."""
    fitted, names, fps = _runs_to_fit(runs)
    pieces = friction_pieces(fitted, reference.load)
    if route.search == "varpro":
        found = FitOutcome(fit_measured_friction(law, pieces, names, fps))
    else:
        found = fit_by_search(MeasuredFrictionProblem.of(law, pieces, names, fps), fitted, route, callback)
    return _finish(found, runs, reference, route, (0,) * len(fitted))


def _fit_motion(
    law: Model, runs: Sequence[Run], route: Route, mass: float | None, prior: Prior | None, callback: Callback | None
) -> Fit:
    """The fit of runs to their displacement, or to the acceleration computed from it."""
    fitted, names, fps = _runs_to_fit(runs)
    reference, mass_unknown = reference_of(fitted, mass), is_mass_unknown(fitted)
    if prior is not None:
        law = apply_prior(law, prior, None if mass_unknown else reference.load, route.domain)
    law = with_known_gravity(law, fitted)
    whole = pieces_of(fitted, reference, through_reversals=law.turns)
    guess = guess_mass([p for own in whole for p in own]) if mass_unknown else reference.mass
    if route.domain == "displacement":
        law = with_stated_incline(law, fitted, guess)
    if mass_unknown:
        law, whole = with_mass(law), [[p.in_mass_units(guess) for p in own] for own in whole]
    lengths = tuple(piece_frames(law, own, run) for own, run in zip(whole, fitted, strict=True))
    pieces = _cut(whole, lengths)
    if route.search != "varpro":
        found = fit_by_search(LeastSquaresProblem.of(law, pieces, names, fps), fitted, route, callback)
    elif route.domain == "force":
        found = fit_accelerations(fit_displacement(law, pieces, names, fps), fitted)
    else:
        found = FitOutcome(fit_displacement(law, pieces, names, fps))
    return _finish(_in_kilograms(found, fitted, route), runs, reference, route, lengths)


def _cut(whole: Sequence[list[Piece]], lengths: Sequence[int]) -> list[Piece]:
    """The pieces of all runs, cut to the frames per piece of each run."""
    return [p for own, n in zip(whole, lengths, strict=True) for p in cut_into_pieces(own, n)]


def _in_kilograms(found: FitOutcome, runs: Sequence[Run], route: Route) -> FitOutcome:
    """The same fit in units of the fitted mass, where the mass was unknown."""
    solution, layout = found.solution, found.solution.problem.layout
    q = mass_ratio(layout, solution.p)
    if q == 1.0:
        return found
    pieces = [p.in_mass_units(p.mass / q) for p in solution.problem.pieces]
    problem = LeastSquaresProblem(solution.problem.model, layout, pieces)
    searched = found.searched
    if searched is not None:
        searched = replace(searched, points=np.array([rescale_to_mass(layout, o, q) for o in searched.points]))
    where = rescale_to_mass(layout, solution.p, q), solution.starts, solution.tau
    return _outcome_at(problem, where, runs, route, searched)


def _outcome_at(
    problem: LeastSquaresProblem, where: _Unknowns, runs: Sequence[Run], route: Route, searched: SearchedOptima | None
) -> FitOutcome:
    """The outcome at known unknowns."""
    p, starts, tau = where
    if route.is_default:
        return FitOutcome(refine(problem, p, starts, tau=tau, max_steps=1))
    return outcome_of(fit_starts(problem, p, starts, tau), runs, route, searched)


def _finish(
    found: FitOutcome, runs: Sequence[Run], reference: Reference, route: Route, lengths: tuple[int, ...]
) -> Fit:
    """The result of a fit, with predictions of the validation runs."""
    if MASS_EFFECT.name in found.solution.problem.model:
        reference = Reference(found.solution.problem.pieces[0].mass, reference.load)
    validation = tuple(r for r in runs if r.role == "validation")
    return Fit(
        found=found,
        runs=tuple(r for r in runs if r.role == "fit"),
        validation=validation,
        predictions=tuple(predict_run(found.solution, r, reference) for r in validation),
        reference=reference,
        route=route,
        lengths=lengths,
    )


def state(result: Fit | GroupFits) -> dict[str, Any]:
    """Return what `restore` needs to rebuild a fit without searching: arrays, numbers and strings."""
    if isinstance(result, GroupFits):
        return {"groups": {name: state(f) for name, f in result.fits.items()}}
    layout, searched = result.solution.problem.layout, result.found.searched
    found: dict[str, Any] = {} if searched is None else {"optima": searched.points, "costs": searched.costs}
    if searched is not None and searched.convergence is not None:
        found |= {"searched": json.dumps(searched.summary), "convergence": searched.convergence}
    return found | {
        "law": without_mass(layout.model).to_toml(),
        "weighed": MASS_EFFECT.name not in layout.model,
        "absent": [list(pair) for pair in sorted(layout.absent)],
        "p": result.solution.p,
        "starts": np.array(result.solution.starts),
        "segment_frames": list(result.lengths),
        "frames": [len(piece.t) for piece in result.solution.problem.pieces],
        "tau": result.solution.tau,
        "reference_mass": result.reference.mass,
        "reference_load": result.reference.load,
        "measured": not result.solution.problem.simulates,
        "domain": result.domain,
        "search": result.search,
        "over": result.route.over,
        "seed": result.seed,
    }


@one_thread()
def restore(runs: Sequence[Run], saved: dict[str, Any]) -> Any:
    """Rebuild a fit from its `state` on the same runs.

    Parameters
    ----------
    runs : sequence of Run
        The runs of the fit.
    saved : dict
        Result of `state`.

    Returns
    -------
    Fit or GroupFits
        The same fit.

    """
    if "groups" in saved:
        groups = by_group(runs)
        return GroupFits({name: _restored(groups[name], s) for name, s in saved["groups"].items()})
    return _restored(runs, saved)


def _restored(runs: Sequence[Run], saved: dict[str, Any]) -> Fit:
    fitted, names, fps = _runs_to_fit(runs)
    law = _law(str(saved["law"]), bool(saved["weighed"]))
    route = Route(saved["domain"], saved["search"], int(saved["seed"]), saved.get("over", "all"))
    absent = frozenset((str(e), int(r)) for e, r in saved["absent"])
    p, tau = np.asarray(saved["p"]), float(saved["tau"])
    searched = _searched(saved)
    if saved.get("measured", False):
        reference, lengths = Reference(1.0, float(saved["reference_load"])), (0,) * len(fitted)
        first = MeasuredFrictionProblem.of(law, friction_pieces(fitted, reference.load), names, fps)
        problem = first.rebuild(replace(first.layout, absent=absent), first.pieces)
        starts = problem.first_starts()
    else:
        reference = reference_of(fitted, float(saved["reference_mass"]))
        lengths = tuple(int(n) for n in saved.get("segment_frames", [0] * len(fitted)))
        pieces = _cut(pieces_of(fitted, reference, through_reversals=law.turns), lengths)
        layout = ParameterLayout(law, names, spans_of(pieces, len(fitted), fps), absent)
        fine = max(e.fine for e in law.effects)
        cut = [q.refined(fine).part(0, int(n)) for q, n in zip(pieces, saved["frames"], strict=True)]
        problem, starts = LeastSquaresProblem(law, layout, cut), list(np.asarray(saved["starts"]))
    found = _outcome_at(problem, (p, starts, tau), fitted, route, searched)
    return _finish(found, runs, reference, route, lengths)


def _searched(saved: dict[str, Any]) -> SearchedOptima | None:
    """What a global search found, from the state of a fit."""
    if len(saved.get("optima", ())) == 0:
        return None
    of = saved.get("convergence")
    parts = of if of is None or isinstance(of, Convergence) else Convergence(**of)
    summary = json.loads(saved.get("searched", "{}"))
    return SearchedOptima(np.asarray(saved["optima"]), np.asarray(saved["costs"]), parts, summary)


def _law(text: str, weighed: bool) -> Model:
    """The model of a stored fit."""
    try:
        law = models.from_toml(text)
    except FrictrackError as e:
        raise FrictrackError(
            f"expected a stored fit of effects that are known here but got another one: {e}; one of your own in Python "
            "must be declared again with @frictrack.effect"
        ) from e
    return law if weighed else with_mass(law)
