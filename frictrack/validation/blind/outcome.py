"""Diagnose one blind study and compare it with the truth and with effects that fit as well; count many outcomes.

Shares of correct diagnoses have Wilson intervals.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from scipy.stats import binomtest, norm

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution, refine
from frictrack.fit.linearised import LinearisedModel, linearise, measured_series
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.penalties import penalty_residual
from frictrack.fit.stepwise import remove_effect, scan_effect, simulate_trial, try_effect
from frictrack.flow import Session, open_study
from frictrack.records import Array, Mask
from frictrack.simulate import Trajectory
from frictrack.validation.blind.ideal_detector import MIN_SCATTER, MIN_SPEED, limits_over_ideal
from frictrack.validation.blind.truth import RunTruth, Truth, effect_named
from frictrack.validation.blind.truth_sampling import KINDS

MAX_CHI2_EXCESS = 10.0  # expected excess below which these runs cannot distinguish two effects
NOTHING = "nothing"  # stands among the equivalents of an effect that the law and the other effects imitate
SCREEN_SHARE, SCREEN_CHI2 = 0.3, 60.0  # share of the rise, and chi-squared, below which a linearised rival is refined


def equivalent_effects(truth: Truth, base: Solution) -> dict[str, tuple[str, ...]]:
    """Find for each hidden effect the library effects that can replace it, the others staying.

    `base`: fitted base law. Its pieces and layout are used; its data are replaced by the true motion. Returns for each
    hidden effect the names of equivalent effects, itself first; `NOTHING` where it is not needed: the other hidden
    effects and the law, fitted again, leave no more without it.
    """
    full = solution_at_truth(truth, base)
    return {name: (name, *_equal_in_fit(full, name)) for name in truth.hidden}


def _equal_in_fit(full: Solution, name: str) -> list[str]:
    """Names of effects that explain the data without noise as well as the hidden one does."""
    reduced = remove_effect(full, name)
    if reduced.objective - full.objective < MAX_CHI2_EXCESS:
        return [NOTHING]
    fits = replacements(full, name, reduced=reduced)
    return [other for other, fitted in fits.items() if fitted.objective - full.objective < MAX_CHI2_EXCESS]


def replacements(
    full: Solution, name: str, max_chi2: float = np.inf, reduced: Solution | None = None
) -> dict[str, Solution]:
    """Fit every effect of the library in place of a hidden one to data without noise.

    `full`: solution at the truth; see `solution_at_truth`; `max_chi2`: chi-squared that an effect may leave along the
    true motion; those that leave more are not simulated. Returns the best fit by effect; only effects that are not far
    worse along the true motion. The objective of a fit less that of `full` is the chi-squared by which these runs
    separate the two effects in the mean.
    """
    reduced = reduced or remove_effect(full, name)
    linearised, levels = linearise(reduced), penalty_residual(full.problem.layout, full.p, full.tau)
    screen = min(SCREEN_SHARE * (reduced.objective - full.objective) + SCREEN_CHI2, max_chi2) + float(levels @ levels)
    model, out = reduced.problem.model, dict[str, Solution]()
    for effect in effects.LIBRARY.values():
        fits_in = not effect.replaces and (not effect.modifies or effect.changed(model.effects))
        if fits_in and effect.name not in model and effect.name != name:
            with suppress(FrictrackError):
                fitted = _replacement(linearised, effect, full.tau, screen)
                out |= {} if fitted is None else {effect.name: fitted}
    return out


def _replacement(linearised: LinearisedModel, effect: Effect, tau: float, screen: float) -> Solution | None:
    """The fit with another effect instead of the true one; None if it leaves more than `screen` along the motion."""
    data = measured_series(linearised)
    scans = scan_effect(linearised, effect, data)
    if not scans:
        return None
    trial = try_effect(linearised, effect, scans, data.coordinates[:, 0])
    if trial.misfit > screen:
        return None
    extended = simulate_trial(linearised, trial)
    return refine(extended.problem, extended.p, extended.starts, tau=tau)


def solution_at_truth(truth: Truth, base: Solution) -> Solution:
    """Fit the true law to the true motion, from the true parameters; only rounding errors remain.

    `base`: fitted base law of the study. Returns the refined solution with all hidden effects.
    """
    trajectories = [truth.trajectory(run) for run in truth.runs]
    pieces = [replace(p, y=(trajectories[p.run].x + trajectories[p.run].shift)[p.frames]) for p in base.problem.pieces]
    base_layout = base.problem.layout
    model = base_layout.model
    for name in truth.hidden:
        model = model + effect_named(name)
    absent = frozenset((n, i) for i, run in enumerate(truth.runs) for n in truth.hidden if n not in run.values)
    layout = replace(base_layout, model=model, absent=absent)
    problem = base.problem.rebuild(base_layout, pieces).rebuild(layout, pieces)
    starts = [np.array([s.x[i], s.v[i]]) for s, i in ((trajectories[p.run], p.frames[0]) for p in pieces)]
    return refine(problem, _true_parameters(truth, layout), starts, tau=max(truth.scatter, MIN_SCATTER))


def _true_parameters(truth: Truth, layout: ParameterLayout) -> Array:
    """True parameters in the order of the layout, (P,)."""
    out = []
    for slot in layout.slots:
        run = truth.runs[slot.run or 0]
        if slot.effect == "level":
            out.append(run.level)
        elif slot.effect in truth.law:
            out.append(truth.law[slot.effect][slot.parameter])
        else:
            chosen = truth.runs if slot.run is None else (run,)  # the first run that has it
            out.append(next(r.values[slot.effect] for r in chosen if slot.effect in r.values)[slot.parameter])
    return np.array(out)


@dataclass(frozen=True)
class Outcome:
    """Result of one study, with the truth.

    Attributes
    ----------
    name, kind, hidden, size, film
        Study: its name, kind, hidden effects, their sizes over the ideal limit, and whether it has films.
    verdict
        Verdict of the diagnosis; "failed" if it raised an error.
    named
        Effects named as missing, in order.
    group
        The first named effect and those that the diagnosis cannot distinguish from it.
    sets
        Sets of effects that the diagnosis says explain the runs equally: those named first.
    equivalents
        For each hidden effect those that fit as well; "alike" in JSON.
    noted
        Faults that tracking or calibration found and corrected.
    reduced_chi2, heldout
        After adding the named effects: reduced chi-squared, and held-out error over the true noise.
    z
        (Estimate - truth) / stated standard deviation, where exactly the hidden effects were named.
    overlap
        F1 score of the frames where the model fails.
    limits
        Detection limits over those of the ideal detector, where nothing is hidden.
    seconds
        CPU time of the diagnosis, s.
    fault
        Error message of a failed study.

    """

    name: str
    kind: str
    hidden: tuple[str, ...]
    size: tuple[float, ...]
    film: bool = False
    verdict: str = ""
    named: tuple[str, ...] = ()
    group: tuple[str, ...] = ()
    sets: tuple[tuple[str, ...], ...] = ()
    equivalents: dict[str, tuple[str, ...]] = field(default_factory=dict)
    noted: tuple[str, ...] = ()
    reduced_chi2: float | None = None
    heldout: float | None = None
    z: dict[str, float] = field(default_factory=dict)
    overlap: float | None = None
    limits: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    fault: str = ""


def read_outcome(raw: dict[str, Any]) -> Outcome:
    """Read an outcome from its JSON."""
    return TypeAdapter(Outcome).validate_python(
        {"equivalents" if key == "alike" else key: value for key, value in raw.items()}
    )


def judge_study(name: str, truth: Truth, folder: Path, seed: int = 0) -> Outcome:
    """Diagnose a study, add the named effects, and compare with the truth.

    Returns the result; an error becomes an outcome with the verdict "failed".
    """
    blank = Outcome(name, truth.kind, truth.hidden, truth.size, truth.film)
    try:
        return _diagnose(truth, folder, seed, blank)
    except FrictrackError as e:
        return replace(blank, verdict="failed", fault=str(e))
    except Exception as e:  # noqa: BLE001 - an internal error fails this study only
        return replace(blank, verdict="failed", fault=f"{type(e).__name__}: {e}")


def _diagnose(truth: Truth, folder: Path, seed: int, blank: Outcome) -> Outcome:
    session = Session(open_study(folder / "study.toml"))
    session.fit()
    begin = time.process_time()
    diagnosis = session.diagnose(seed)
    seconds = time.process_time() - begin
    named, rivals = tuple(diagnosis["missing"]), dict[str, Sequence[str] | None]()
    for one in diagnosis["candidates"]:
        rivals.setdefault(one["effect"], one["indistinguishable_from"])
    fit: Fit = session.models.fit(session.models.current()[0])
    low_pass_half_width = {run.name: 0.5 / run.motion.cutoff for run in fit.runs if np.isfinite(run.motion.cutoff)}
    out = replace(
        blank,
        verdict=diagnosis["verdict"],
        named=named,
        group=(*named[:1], *(rivals.get(named[0]) or () if named else ())),
        sets=_stated_sets(diagnosis, rivals),
        equivalents=_equivalents_of_hidden(truth, fit, named),
        noted=_faults_in_notes(session),
        overlap=overlap(truth, diagnosis["fails_at"], low_pass_half_width),
        limits=limits_over_ideal(truth, diagnosis["detection_limits"]) if truth.kind == "none" and not named else {},
        seconds=seconds,
    )
    noise = (_tracking_error(session, truth) or diagnosis["noise_um"]) if truth.film else 1e6 * truth.noise
    for name in named:
        after = session.add(name)
    errors = after["error_after"] if named else session.fit()["errors"]
    return replace(
        out,
        reduced_chi2=errors["reduced_chi2"],
        heldout=errors["heldout_rms_um"] / noise,
        z=parameter_deviations(truth, named, after["parameters"]) if named else {},
    )


def _tracking_error(session: Session, truth: Truth) -> float | None:
    """True rms error of the tracked displacement in the fitted frames, um, without a straight line per film.

    A camera shake is removed by the fixed reference. None if frames are lost, because frames no longer correspond.
    """
    squares = []
    for run, work in zip(truth.runs, session.runs, strict=True):
        trajectory, displacement = truth.trajectory(run), work.get("displacement")
        if len(displacement.x) != len(trajectory.x):
            return None
        drawn = trajectory.x if "camera_shake" in run.values else trajectory.x + trajectory.shift
        kept = displacement.valid & work.get("friction").free
        off, t = (displacement.x - drawn)[kept], trajectory.t[kept] - trajectory.t[kept].mean()
        off = off - off.mean()
        squares.append((off - t * (t @ off) / (t @ t)) ** 2)
    return 1e6 * float(np.sqrt(np.mean(np.concatenate(squares))))


def _stated_sets(diagnosis: dict[str, Any], rivals: Mapping[str, Sequence[str] | None]) -> tuple[tuple[str, ...], ...]:
    """The effects named, these with one of them exchanged for a rival, and the alternative sets."""
    if not (named := diagnosis["missing"]):
        return ()
    exchanged = [[rival if n == name else n for n in named] for name in named for rival in rivals.get(name) or []]
    others = [one["effects"] for one in diagnosis["alternatives"]]
    return tuple(dict.fromkeys(tuple(sorted(one)) for one in [named, *exchanged, *others]))


def _equivalents_of_hidden(truth: Truth, fit: Fit, named: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Equivalents of the hidden effects; none where a law without one of these cannot be followed from the truth."""
    retimed = truth.film and "dropped_frame" in truth.hidden  # frames do not correspond to the truth
    found = len(truth.hidden) > 1 and set(named) == set(truth.hidden)  # they decide nothing
    if truth.hidden and truth.kind != "foreign" and not retimed and not found:
        with suppress(FrictrackError):
            return equivalent_effects(truth, fit.solution)
    return {}


def _faults_in_notes(session: Session) -> tuple[str, ...]:
    """Faults that notes of tracking and calibration report."""
    stages = [(work, name) for work in session.runs for name in ("track", "displacement") if name in work.stages]
    words = " ".join(note for work, name in stages for note in work.get(name).notes)
    return tuple(name for name, e in effects.LIBRARY.items() if any(phrase in words for phrase in e.noted_as))


def parameter_deviations(truth: Truth, named: tuple[str, ...], parameters: dict[str, Any]) -> dict[str, float]:
    """(Estimate - truth) / stated standard deviation of all parameters that the runs share.

    `parameters`: JSON `parameters` of the fit: value and std by address ("effect.parameter"). Returns the deviation by
    address; empty unless exactly the hidden effects were named.
    """
    if set(named) != set(truth.hidden):
        return {}
    own = {name: next(r.values[name] for r in truth.runs if name in r.values) for name in truth.hidden}
    law = truth.law | own
    quoted = {f"{name}.{key}": value for name, values in law.items() for key, value in values.items()}
    out = {}
    for name, values in law.items():
        effect = effect_named(name)
        true = values | (effect.quote(values, quoted) if effect.quote else {})
        for p in effect.parameters:
            estimate = parameters.get(f"{name}.{p.name}")
            if estimate is None or p.per_run or not estimate["std"] or estimate["value"] is None:
                continue
            error = estimate["value"] - true[p.name]
            if p.role == "phase":
                error = float(np.angle(np.exp(1j * error)))
            out[f"{name}.{p.name}"] = error / estimate["std"]
    return out


def overlap(truth: Truth, spans: list[dict[str, Any]], low_pass_half_width: Mapping[str, float]) -> float | None:
    """F1 score over all frames of where the hidden effect acts and where the model is said to fail.

    `spans`: `fails_at` of the diagnosis: run and first and last time t (s) of each span; `low_pass_half_width`: half
    width of the low-pass of each run, s: it widens a collision by that much. Returns 0 to 1; None unless exactly one
    local effect, such as a patch or a collision, is hidden.
    """
    if len(truth.hidden) != 1 or effect_named(truth.hidden[0]).acts_within is None:
        return None
    effect = effect_named(truth.hidden[0])
    n_both = n_reported = n_true = 0
    for run in truth.runs:
        trajectory = truth.trajectory(run)
        t, acts = trajectory.t, acting(effect, run, trajectory, low_pass_half_width.get(run.name, 0.0))
        ends = [s["t"] for s in spans if s["run"] == run.name]
        within = [(t >= first - 1e-9) & (t <= last + 1e-9) for first, last in ends]
        reported = np.any([np.zeros(len(t), np.bool_), *within], axis=0)
        n_both += int((acts & reported).sum())
        n_reported += int(reported.sum())
        n_true += int(acts.sum())
    return 2 * n_both / max(n_reported + n_true, 1)


def acting(effect: Effect, run: RunTruth, trajectory: Trajectory, low_pass_half_width: float) -> Mask:
    """Frames (n,) of a run in which a local effect acts while the mass moves."""
    values = run.values.get(effect.name)
    if values is None or effect.acts_within is None:
        return np.zeros(len(trajectory.t), dtype=bool)
    acts = effect.acts_within(trajectory.t, trajectory.x, values, low_pass_half_width)
    return np.asarray(acts & (np.abs(trajectory.v) > MIN_SPEED))


PARAMETER_CONFIDENCE = 0.99  # level of the intervals that should contain the true parameters
REDUCED_CHI2_RANGE = (0.9, 1.1)  # within which a fit explains the data
HELDOUT_TOLERANCE = 0.05  # relative difference of the held-out error from the noise
Criterion = Callable[[Outcome], bool]
VERDICTS_WITHOUT_NAMES = ("complete", "undetermined")


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Confidence interval of a share (Wilson 1927, J. Am. Stat. Assoc. 22); (0, 1) if there are no cases.

    Examples
    --------
    >>> [round(edge, 4) for edge in wilson(95, 100)]
    [0.8882, 0.9785]

    """
    if not of:
        return 0.0, 1.0
    interval = binomtest(hits, of).proportion_ci(confidence_level=0.95, method="wilson")
    return float(interval.low), float(interval.high)


def count_with_interval(hits: int, of: int) -> dict[str, Any]:
    """Share of hits with its 95 % Wilson interval, as JSON."""
    return {"hits": hits, "of": of, "share": hits / of if of else None, "interval": list(wilson(hits, of))}


def _share(rows: Sequence[Outcome], criterion: Criterion) -> dict[str, Any]:
    return count_with_interval(sum(map(criterion, rows)), len(rows))


# --- criteria of one study


def is_named_first(row: Outcome) -> bool:
    """Whether the hidden effect is named first; a fault that was found and corrected during tracking counts."""
    return is_named_in_record(row) or (bool(row.group) and row.group[0] == row.hidden[0])


def is_named_in_record(row: Outcome) -> bool:
    """Whether tracking or calibration found the hidden fault, and nothing else is named."""
    return row.hidden[0] in row.noted and not row.named


def is_in_group(row: Outcome) -> bool:
    """Whether the hidden effect is first, or in a first group no larger than the set of its equivalents."""
    return is_named_first(row) or (row.hidden[0] in row.group and len(row.group) <= len(_equivalent_set(row)))


def _equivalent_set(row: Outcome) -> tuple[str, ...]:
    """Equivalents of the first hidden effect, itself included."""
    return row.equivalents.get(row.hidden[0], row.hidden[:1])


def are_all_named(row: Outcome) -> bool:
    """Whether as many named effects are the hidden ones or equivalents of them."""
    return _holds_all(row, row.named)


def are_all_stated(row: Outcome) -> bool:
    """Whether one of the sets stated as equal, with what tracking found, holds all hidden effects or equivalents."""
    return any(_holds_all(row, {*one, *row.noted}) for one in row.sets)


def is_wrong_without_doubt(row: Outcome) -> bool:
    """Whether the effects named without a rival are not exactly the hidden ones, or equivalents of them."""
    left = [h for h in row.hidden if h not in row.noted]
    exact = any(
        set(order) >= set(_needed(row, left)) and _fit(row, row.named, order)
        for order in permutations(row.hidden, len(row.named))
    )
    return row.verdict == "missing" and not exact


def _holds_all(row: Outcome, names: Iterable[str]) -> bool:
    """Whether a different name stands for each hidden effect that is needed."""
    needed = _needed(row, row.hidden)
    return any(_fit(row, order, needed) for order in permutations(names, len(needed)))


def _needed(row: Outcome, hidden: Sequence[str]) -> list[str]:
    """Hidden effects that the law and the other hidden ones do not imitate."""
    return [h for h in hidden if NOTHING not in row.equivalents.get(h, ())]


def _fit(row: Outcome, names: Sequence[str], hidden: Sequence[str]) -> bool:
    """Whether each name is the hidden effect at its place or an equivalent of it."""
    return all(name in {h, *row.equivalents.get(h, ())} for name, h in zip(names, hidden, strict=True))


def is_reproduced(row: Outcome) -> bool:
    """Whether a foreign effect is called unexplained, or the named effects leave only noise."""
    good = row.reduced_chi2 is not None and row.reduced_chi2 <= REDUCED_CHI2_RANGE[1]
    return row.verdict == "unexplained" or (good and row.verdict in ("missing", "ambiguous"))


def is_fault(name: str) -> bool:
    """Whether an effect is a fault of the measurement; `NOTHING`, in place of an effect, is none."""
    return name != NOTHING and effect_named(name).acts_on == "measurement"


def can_show(row: Outcome) -> bool:
    """Whether the data can reveal a measurement fault: no force is equivalent, or the background of a film shows it."""
    first = effect_named(row.hidden[0])
    if row.film and first.film_fault and first.noted_as:
        return True
    return len(row.hidden) == 1 and is_fault(row.hidden[0]) and all(is_fault(n) for n in _equivalent_set(row))


def is_called_fault(row: Outcome) -> bool:
    """Whether the diagnosis, tracking or calibration attributes a measurement fault to the measurement."""
    return row.hidden[0] in row.noted or (bool(row.group) and is_fault(row.group[0].split(":")[0]))


def _within_noise(row: Outcome) -> bool:
    return row.heldout is not None and abs(row.heldout - 1) <= HELDOUT_TOLERANCE


def _within_chi2(row: Outcome) -> bool:
    return row.reduced_chi2 is not None and REDUCED_CHI2_RANGE[0] <= row.reduced_chi2 <= REDUCED_CHI2_RANGE[1]


# --- all studies


def tally(rows: Sequence[Outcome]) -> dict[str, Any]:
    """Compute all figures of the benchmark.

    Returns JSON: number of studies, then shares by kind of study, errors after adding the named effects, overlap of
    failing spans, detection limits, confusion table, CPU time and failed studies. A share of no studies is null.
    """
    kind = {k: [r for r in rows if r.kind == k] for k in KINDS}
    one = kind["one"]
    criterion = [r for r in one + kind["fault"] if is_named_first(r)]
    local = [r.overlap for r in one if r.overlap is not None]
    edge = float(norm.isf((1 - PARAMETER_CONFIDENCE) / 2))
    z = [abs(v) <= edge for r in criterion for v in r.z.values()]
    return {
        "studies": len(rows),
        "one": {
            "named_first": _share(one, is_named_first),
            "in_group": _share(one, is_in_group),
            "first_where_alone": _share([r for r in one if len(_equivalent_set(r)) == 1], is_named_first),
            "missed": _share(one, lambda r: r.verdict in VERDICTS_WITHOUT_NAMES and not is_named_in_record(r)),
            "more_than_hidden": _share(one, lambda r: len(r.named) > 1),
            "median_group": _median([len(r.group) for r in one if r.group]),
            "median_set": _median([len(_equivalent_set(r)) for r in one]),
        },
        "none": {
            "false_alarms": _share(kind["none"], lambda r: r.verdict not in VERDICTS_WITHOUT_NAMES),
            "undetermined": _share(kind["none"], lambda r: r.verdict == "undetermined"),
        },
        **{
            name: {
                word: _share(kind[name], are_all_named),
                f"{word}_by_name": _share(kind[name], lambda r: set(r.hidden) <= set(r.named)),
                f"{word}_stated": _share(kind[name], are_all_stated),
                "wrong_without_doubt": _share(kind[name], is_wrong_without_doubt),
            }
            for name, word in (("two", "both"), ("three", "all"))
        },
        "foreign": {
            "unexplained_or_reproduced": _share(kind["foreign"], is_reproduced),
            "unexplained": _share(kind["foreign"], lambda r: r.verdict == "unexplained"),
        },
        "fault": {"called": _share([r for r in one + kind["fault"] if can_show(r)], is_called_fault)},
        "after": {
            "reduced_chi2": _share(criterion, _within_chi2),
            "heldout": _share(criterion, _within_noise),
            "parameters": count_with_interval(sum(z), len(z)),
        },
        "where": {"mean_f1": float(np.mean(local)) if local else None, "of": len(local)},
        "limits": limits(kind["none"]),
        "confusion": confusion(one + kind["fault"]),
        "seconds": seconds(rows),
        "failed": [{"study": r.name, "reason": r.fault} for r in rows if r.verdict == "failed"],
    }  # fmt: skip


def limits(rows: Sequence[Outcome]) -> dict[str, dict[str, float]]:
    """Median and largest ratio of stated to ideal detection limits, by effect."""
    out = {}
    for name in sorted({n for r in rows for n in r.limits}):
        ratios = [r.limits[name] for r in rows if name in r.limits]
        out[name] = {"median": float(np.median(ratios)), "largest": float(np.max(ratios)), "of": len(ratios)}
    return out


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def seconds(rows: Sequence[Outcome]) -> dict[str, float | None]:
    """Median and largest CPU time of a diagnosis, s."""
    times = [r.seconds for r in rows if r.verdict != "failed"]
    return {"median": _median(times), "largest": max(times, default=None)}


def confusion(rows: Sequence[Outcome]) -> dict[str, dict[str, int]]:
    """Count of what was named first (or of the verdict), by hidden effect."""
    names = sorted({r.hidden[0] for r in rows})
    return {n: dict(Counter(r.group[0] if r.group else r.verdict for r in rows if r.hidden[0] == n)) for n in names}
