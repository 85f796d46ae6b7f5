"""Find what else than a missing effect may be at fault: repaired frames, a run or its mass, a bound, another sensor.

Leaving rows out of a linear least-squares fit is exact and cheap when the whitened Jacobian is at hand: the remaining
rows are fitted again, with the start of every piece free. Nonlinear parameters move along their tangents only.

Where one run is at fault, the model explains all others without it. Dry friction decelerates all masses alike, so a
wrong mass shows only in the forces that do not grow with the load. What it leaves is small, and fits no effect. Often
it may be one of several runs; all are named.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from frictrack.base.errors import result_or_none
from frictrack.base.number_format import format_number, join_words
from frictrack.diagnose.examination import Examination, draw_null_ensemble, lack_of_fit
from frictrack.diagnose.model_selection import MAX_BIC_EQUAL, MIN_CHI2_SEPARATED, information_criterion
from frictrack.diagnose.power import Undetermined
from frictrack.diagnose.search import FinishedSearch, RefinedCandidate
from frictrack.effects import Effect
from frictrack.fit import Fit
from frictrack.fit.least_squares import PieceResponse, Solution, fit_with_scatter, white_noise_covariance
from frictrack.fit.pieces import Piece
from frictrack.fit.stepwise import bic_penalty, remove_effect
from frictrack.fit.uncertainty import MIN_RATIO
from frictrack.records import Mask, Run
from frictrack.settings.repairs import TRACKED_AGAIN

MIN_EXCESS_SIGMAS = 4.0  # of chi-squared above its expectation, for a misfit to stand without the repaired frames
MAX_SHARE_LEFT = 0.5  # of the misfit, up to which it rests on the repaired frames
ADVICE = 'look at them in the film, or repair them with how = "leave_out", and diagnose again'
MIN_RUNS = 3  # two others show that they agree
MAX_RUNS, MAX_FRAMES = 8, 20_000  # of all runs together
MAX_ODD = 2  # runs of which another mass is tried: without the wrong one the others agree best, within their noise
N_DRAWS = 199
MIN_P_EXPLAINED = 0.05  # of the lack of fit
MIN_GAP = 3.0  # between the sizes of an effect in a few runs and in the others, over how far those of either differ
MASS_STEP = 1e-4  # relative change of a mass, to see what it changes
MASS_RATIOS = (-2.5, 2.5)  # logarithm of another mass of a run over the stated one: its decimal point may be wrong
TOLERANCE: Any = {"xatol": 0.002}  # of that logarithm
MIN_SHARE_OF_FALL = 0.5  # of what the effects found explain, that a model must explain beyond its bounds
Repaired = Sequence[NDArray[np.int8] | None]  # codes of the frames of every run; None where no frame was repaired


def rests_on_repairs(runs: Sequence[Run], verdict: str, search: FinishedSearch) -> str | None:
    """Return a sentence if the verdict would change without the frames that were tracked again.

    For every effect found, the fall of chi-squared without these frames is compared with what the search demands of it;
    for a misfit that nothing explains, the misfit that is left.

    `search`: the search that led to it. None if no frame was tracked again, or if the verdict stands without
    them.
    """
    first = search.first
    if verdict not in ("missing", "ambiguous", "unexplained") or not first.solution.problem.simulates:
        return None
    repaired = [run.motion.repaired for run in runs]
    counts: Counter[str] = Counter()
    for response in first.solution.responses:
        counts[runs[response.piece.run].name] += int(np.count_nonzero(~_kept(response, repaired)))
    if not counts.total():
        return None
    if verdict == "unexplained":
        change = _misfit_without(first.solution, search.last.solution, repaired)
    else:
        change = _effects_without(first, search.found, repaired)
    frames = " and ".join(f'{n} frame{"s" * (n > 1)} of run "{name}"' for name, n in counts.items() if n)
    return change and f"this verdict rests on {frames} that were tracked again: without them {change}; {ADVICE}"


def _kept(response: PieceResponse, repaired: Repaired) -> Mask:
    """Frames of a piece that were not tracked again."""
    codes = repaired[response.piece.run]
    n = len(response.r_full)
    return np.ones(n, np.bool_) if codes is None else np.asarray(codes[response.piece.frames] != TRACKED_AGAIN)


def _effects_without(first: Examination, found: Sequence[RefinedCandidate], repaired: Repaired) -> str | None:
    """Name the first effect whose evidence is too small without the repaired frames."""
    before = first.solution
    for t in found:
        if t.solution is None or t.objection:
            continue
        if set(t.law.problem.model.names) - set(before.problem.model.names) != {t.effect.name}:
            before = first.solution  # the review has removed an effect that was found before
        gain = before.chi2 - t.law.chi2
        left = chi2_without(before, repaired) - chi2_without(t.law, repaired)
        quantile = first.quantiles.get(t.effect.title)
        needed = max(gain - t.delta_bic, 0.0 if quantile is None else quantile + first.critical)
        if left < min(needed, gain):
            return (
                f"chi-squared falls by {format_number(max(left, 0.0), 2)} with {t.effect.title} instead of "
                f"{format_number(gain, 2)}, and {format_number(needed, 2)} is needed"
            )
        before = t.law
    return None


def _misfit_without(first: Solution, last: Solution, repaired: Repaired) -> str | None:
    """Say that the misfit is insignificant without the repaired frames: of the model, or with the effects found."""
    for solution, words in ((first, "the model agrees with the data"), (last, "the effects found explain the misfit")):
        n_kept = sum(int(np.count_nonzero(_kept(r, repaired))) for r in solution.responses)
        left, excess = chi2_without(solution, repaired) - n_kept, solution.chi2 - solution.problem.n_frames
        if left <= min(MAX_SHARE_LEFT * excess, MIN_EXCESS_SIGMAS * float(np.sqrt(2.0 * n_kept))):
            return words
    return None


def chi2_without(solution: Solution, repaired: Repaired) -> float:
    """Chi-squared of a model fitted again, in linear approximation, without the frames that were tracked again."""
    residuals, rows = [], []
    for response in solution.responses:
        kept = _kept(response, repaired)
        q, _ = np.linalg.qr(response.q[kept])  # what another start explains
        jac = np.zeros((int(np.count_nonzero(kept)), len(solution.p)))
        jac[:, response.active] = response.jac[kept]
        residuals.append(response.r_full[kept] - q @ (q.T @ response.r_full[kept]))
        rows.append(jac - q @ (q.T @ jac))
    residual, jac = np.concatenate(residuals), np.vstack(rows)
    scale = np.linalg.norm(jac, axis=0)
    jac /= np.where(scale > 0, scale, 1.0)
    step = np.linalg.lstsq(jac, residual, rcond=1e-8)[0]
    return float(np.sum((residual - jac @ step) ** 2))


def suspect_run_remarks(last: Solution, runs: Sequence[Run], rng: np.random.Generator) -> list[str]:
    """Name the run that disagrees with all others, or the runs of which one does.

    `last`: the model with the effects found. Returns at most one sentence. Empty where it leaves no significant misfit,
    for fewer than three runs, or where many runs or frames would make it slow.
    """
    odd = [run.name for run in _odd_runs(last, runs, rng)]
    if not odd or len(odd) == sum(run.role != "validation" for run in runs) or _explains(last, rng):
        return []
    check = (
        f"check {'its' if len(odd) == 1 else 'their'} mass, frame rate and scale, and whether the surface was the same"
    )
    return [f"without {' or '.join(odd)} the model with the effects found explains all other runs: {check}"]


def _odd_runs(law: Solution, runs: Sequence[Run], rng: np.random.Generator) -> list[Run]:
    """The runs without each of which the model explains all others, best first; none where many would make it slow."""
    fitted = [run for run in runs if run.role != "validation"]
    frames = sum(len(run.motion) for run in fitted)
    if not (MIN_RUNS <= len(fitted) <= MAX_RUNS and frames <= MAX_FRAMES and law.problem.simulates):
        return []
    others = [(found, run) for run in fitted if _may_be_odd(law, run.name) and (found := _refit(law, [run]))]
    odd = [(found.chi2 - found.problem.n_frames, run) for found, run in others if _explains(found, rng)]
    return [run for _, run in sorted(odd, key=lambda one: one[0])]


def _run_of(law: Solution, piece: Piece) -> str:
    return law.problem.layout.run_names[piece.run]


def _refit(law: Solution, odd: Sequence[Run], mass_ratio: float | None = None) -> Solution | None:
    """A model fitted again from where it is, with some runs left out, or with so many times their mass."""
    names, pieces, starts = [run.name for run in odd], law.problem.pieces, law.starts
    if mass_ratio is None:
        kept = [i for i, piece in enumerate(pieces) if _run_of(law, piece) not in names]
        pieces, starts = [pieces[i] for i in kept], [starts[i] for i in kept]
    else:
        pieces = _with_masses(law, odd, mass_ratio)
    return result_or_none(
        fit_with_scatter, law.problem.rebuild(law.problem.layout, pieces), law.p, starts, law.tau or 0.03
    )


def _with_masses(law: Solution, odd: Sequence[Run], ratio: float) -> list[Piece]:
    """The pieces of all runs, of which some have so many times their mass."""
    loads = {run.name: (replace(run, mass=(run.mass or 0.0) * ratio).load or 1.0) / (run.load or 1.0) for run in odd}
    return [p.of_mass(ratio, loads[name]) if (name := _run_of(law, p)) in loads else p for p in law.problem.pieces]


def _groups_of_masses(law: Solution, runs: Sequence[Run], rng: np.random.Generator) -> list[list[Run]]:
    """Runs of which other masses may explain all: each that is odd, else those on one side of the widest gap.

    In linear approximation, each run has a mass of its own: where that leaves much of the misfit, no mass explains it.
    """
    fitted = [run for run in runs if run.role != "validation"]
    few = MIN_RUNS < len(fitted) <= MAX_RUNS and sum(len(run.motion) for run in fitted) <= MAX_FRAMES
    odd = _odd_runs(law, runs, rng)
    if odd or not few or not law.problem.simulates or any(run.mass is None for run in fitted):
        return [[run] for run in odd[:MAX_ODD]]
    residual, columns = np.concatenate([r.r for r in law.responses]), []
    for run in fitted:
        near = law.problem.rebuild(law.problem.layout, _with_masses(law, [run], 1.0 + MASS_STEP))
        moved = np.concatenate([r.r for r in near.evaluate(law.p, law.starts)])
        columns.append((residual - moved) / MASS_STEP)
    rows = np.column_stack([law.stacked([r.jac for r in law.responses]), *columns])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    step = np.linalg.lstsq(rows / scale, residual, rcond=1e-8)[0]
    if not _nearly_noise(float(np.sum((residual - rows / scale @ step) ** 2)) - len(residual), law):
        return []
    masses = (step / scale)[-len(fitted) :]
    order = np.argsort(masses)
    lighter = int(np.argmax(np.diff(masses[order]))) + 1
    fewer = order[lighter:] if 2 * lighter > len(order) else order[:lighter]
    return [[fitted[i] for i in sorted(fewer)]]


def _nearly_noise(excess: float, law: Solution) -> bool:
    """Whether a linear approximation leaves so little of the misfit of a model that a refit may explain all of it.

    Its errors are of second order: a refit brings a misfit from half way, in logarithms, to noise.
    """
    n = law.problem.n_frames
    return bool(excess <= np.sqrt(max(law.chi2 - n, 0.0) * np.sqrt(2.0 * n)))


def doubted_mass(fitted: Fit, search: FinishedSearch) -> list[Undetermined]:
    """Return the runs of which another mass explains all runs, with decisively more evidence than the effects found.

    It may stand in place of all of them, or of one. Where only sizes or clocks of single runs were found, which take
    up what a mass does, it need not be decisive; where such sizes agree but in a few runs, nothing is fitted again.
    """
    last, rng, n = search.last.solution, search.generators[0], search.first.solution.problem.n_frames
    if not search.something_is_missing:
        return []
    for ratio, names in map(partial(_runs_of_other_size, last), _sizes_per_run(last, search.found)):
        if names:
            lacks = [t.effect.name for t in search.found if t.effect.name not in fitted.model.names]
            return [_doubt(names, ratio, 1.0, lacks)]

    def misfit(log_ratio: float, law: Solution, odd: Sequence[Run]) -> float:
        found = _refit(law, odd, float(np.exp(log_ratio)))
        return np.inf if found is None else information_criterion(found)

    less = [t.effect.name for t in search.found if len(search.found) > 1 and not t.effect.frees]
    titles = join_words([t.effect.title for t in search.found])
    is_of_runs = bool(titles) and all(t.effect.frees or t.effect.clock is not None for t in search.found)
    decisive = -MAX_BIC_EQUAL if is_of_runs else MIN_CHI2_SEPARATED
    best = information_criterion(last) - bic_penalty(1, n) - decisive
    laws = chain([search.first.solution], (result_or_none(remove_effect, last, name) for name in less))
    for law in filter(None, laws):
        doubted = None
        for odd in _groups_of_masses(law, fitted.runs, rng):
            least = minimize_scalar(misfit, args=(law, odd), bounds=MASS_RATIOS, method="bounded", options=TOLERANCE)
            ratio = float(np.exp(least.x))
            found = _refit(law, odd, ratio) if least.fun < best else None
            if found is not None and _explains(found, rng):
                lacks = [name for name in law.problem.model.names if name not in fitted.model.names]
                names = [run.name for run in odd]
                best, doubted = least.fun, _doubt(names, ratio, _friction_ratio(found, names), lacks)
        if doubted is not None:
            return [replace(doubted, why=f"{doubted.why}; as well as with {titles}") if is_of_runs else doubted]
    return []


def _sizes_per_run(law: Solution, found: Sequence[RefinedCandidate]) -> Iterator[list[int]]:
    """Positions of sizes that runs have of their own, of effects that do not go with the load; levels may be such."""
    layout = law.problem.layout
    for effect in (t.effect for t in found if t.effect.scales_with == "nothing" and len(t.effect.linear) == 1):
        yield [i for i in layout.sizes(effect) if layout.slots[i].parameter == effect.frees]
    added = [t.effect.name for t in found if not t.effect.frees]
    loaded = [e for e in law.problem.model.effects if e.name not in added and any(p.loaded for p in e.parameters)]
    if all(e.level_is_chosen for e in loaded):
        yield layout.levels


def _runs_of_other_size(law: Solution, own: Sequence[int]) -> tuple[float, list[str]]:
    """The mean of sizes in most runs over that in a few, and these, where a wide gap is between.

    A force that does not go with the load is so many times too small where the stated mass is.
    """
    slots, values = law.problem.layout.slots, law.p[list(own)]
    if len(own) < MIN_RUNS or np.min(values) * np.max(values) <= 0:
        return 1.0, []
    order, logs = np.argsort(np.abs(values)), np.sort(np.log(np.abs(values)))
    cut = int(np.argmax(np.diff(logs))) + 1
    doubt = np.sqrt(white_noise_covariance(law)[0][own, own]) / np.abs(values)
    least = MIN_GAP * max(np.ptp(logs[:cut]), np.ptp(logs[cut:]), np.max(doubt))
    if logs[cut] - logs[cut - 1] < max(np.log(MIN_RATIO), least):
        return 1.0, []
    few, side = (order[:cut], 1) if 2 * cut < len(own) else (order[cut:], -1)
    ratio = float(np.exp(side * (np.mean(logs[cut:]) - np.mean(logs[:cut]))))
    return ratio, [law.problem.layout.run_names[slots[own[i]].run or 0] for i in sorted(few)]


def _friction_ratio(found: Solution, odd: Sequence[str]) -> float:
    """Dry friction over the load in some runs, over that in the others."""
    layout = found.problem.layout
    logs = dict(zip(layout.run_names, np.log(found.p[layout.levels]), strict=False))
    own = [logs.pop(name, 0.0) for name in odd]
    return float(np.exp(np.mean(own) - np.mean([*logs.values()] or [0.0])))


def _doubt(odd: Sequence[str], mass_ratio: float, friction: float, lacks: Sequence[str]) -> Undetermined:
    """What to measure again of runs: their mass or, where their dry friction then differs from others', their clock."""
    run, its = join_words(odd), "its" if len(odd) == 1 else "their"
    mass, other = (f"{float(f'{ratio:.3g}'):g}" for ratio in (mass_ratio, 1 / mass_ratio))
    others = "" if len(odd) == 1 else f", or {other} times that of the others,"
    missing = f"only {join_words(lacks)} {'are' if len(lacks) > 1 else 'is'}" if lacks else "no effect is"
    rest = f"the model explains all runs, and {missing} missing"
    if max(friction, 1 / friction) < MIN_RATIO:
        why = f"with {mass} times {its} stated mass{others} {rest}"
        return Undetermined(f"the mass of {run}", why, f"weigh what slid in {run} again")
    why = f"with {friction:.3g} times the dry friction of the others and {mass} times {its} mass {rest}"
    rate = f"a frame rate that is {friction**0.5:.3g} times too high does this"
    return Undetermined(f"the frame rate, mass and surface of {run}", f"{why}; {rate}", f"check them in {run}")


def _may_be_odd(last: Solution, run: str) -> bool:
    """Whether the other runs nearly agree without one, in linear approximation; a refit shows whether they do."""
    own = [r for r in last.responses if _run_of(last, r.piece) != run]
    left = chi2_without(replace(last, responses=own), [None] * len(last.problem.layout.run_names))
    return _nearly_noise(left - sum(len(r.r) for r in own), last)


def _explains(found: Solution, rng: np.random.Generator) -> bool:
    """Whether a model leaves no significant misfit."""
    return lack_of_fit(draw_null_ensemble(found, rng, N_DRAWS)) >= MIN_P_EXPLAINED


def remarks_on_named(
    model: Solution, law: Solution, found: Sequence[RefinedCandidate], runs: Sequence[Run]
) -> list[str]:
    """Return remarks on the effects found; `law` is the model with them."""
    named = [t.effect for t in found]
    return [*held_remarks(model, law), *camera_remarks(runs, named), *remarks_on_places(model, named)]


def held_remarks(model: Solution, grown: Solution) -> list[str]:
    """Return one remark if bounds hold parameters of a model that would explain much of the misfit beyond them.

    Linear coefficients are not named, because another sign of them is no law.

    `grown`: the model with the effects found.
    """
    slots = model.problem.layout.slots
    named = [i for i, held in enumerate(model.held) if held and not slots[i].linear]
    if not named:
        return []
    rows, right = model.penalised_rows_and_residual
    step = np.linalg.lstsq(rows, right, rcond=None)[0]  # of all unknowns, whatever their bounds
    fall = float(right @ right - np.sum((right - rows @ step) ** 2))
    if fall < MIN_SHARE_OF_FALL * (model.objective - grown.objective):
        return []
    names = " and ".join(f"{slots[i].effect}.{slots[i].parameter}" for i in named)
    values = " and ".join(f"{model.p[i]:.3g} {slots[i].unit}".removesuffix(" 1") for i in named)
    are, its_bound, it = ("is", "its bound", "it") if len(named) == 1 else ("are", "their bounds", "them")
    return [
        f"{names} {are} held by {its_bound}, {values}; beyond {it} the model alone would explain much of the misfit: "
        f"where such a value is possible, give {names} wider bounds and fit again"
    ]


def camera_remarks(runs: Sequence[Run], named: Sequence[Effect]) -> list[str]:
    """Return one remark if errors of a camera are named for tables, which any sensor may have measured."""
    names = [effect.title for effect in named if effect.of_camera]
    if not names or any(run.pixel_pitch is not None for run in runs):
        return []
    are, them = ("is an error", "it") if len(names) == 1 else ("are errors", "them")
    return [
        f"{' and '.join(names)} {are} of a camera, but these runs are tables: where no camera measured them, read "
        f"{them} as an error of the sensor that looks the same, of its scale, mount or clock, and check that first"
    ]


MAX_TURN_SPREAD = 0.1  # of the places where strokes turn from their ends, over the way between the ends
ONE_WAY = (
    "all runs move one way, so that {} may be friction that changes along the course, or a force that pulls there "
    "whatever the direction: a run the other way tells which"
)
SAME_TURNS = (
    "all strokes turn at the same two places, so that {} may depend on the way since the turn instead of the place: "
    "strokes of another length tell which"
)


def remarks_on_places(model: Solution, named: Sequence[Effect]) -> list[str]:
    """Return one remark if forces of the place are named and the runs do not show that they belong to it.

    Runs that move one way do not tell whether they turn round, strokes between the same two places not whether they
    depend on the way since the turn.
    """
    of_place = " and ".join(e.title for e in named if e.varies_with == "x" and e.acts_on == "force" and not e.needs)
    pieces = model.problem.pieces
    s, x = (np.concatenate([getattr(piece.path, name) for piece in pieces]) for name in ("s", "x"))
    turns = np.concatenate([piece.path.x[1:][np.diff(np.sign(piece.path.s)) != 0] for piece in pieces])
    off = np.abs(turns[:, None] - [x.min(), x.max()]) <= MAX_TURN_SPREAD * np.ptp(x)  # (turns, ends)
    one_way = not any(piece.turns for piece in pieces) and abs(np.sign(s).sum()) == np.count_nonzero(s)
    same = bool(np.all(off.any(axis=1)) and np.all(off.sum(axis=0) >= 2))
    said = ONE_WAY if one_way else SAME_TURNS if same else ""
    return [said.format(of_place)] if of_place and said else []
