"""Choose runs greedily: each is the one after which the fewest pairs of effects are inseparable."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from frictrack.diagnose import ALPHA, MIN_CHI2_SEPARATED, noncentrality
from frictrack.distributions import chi2_isf
from frictrack.effects import Span
from frictrack.plan.causes import Cause, list_causes
from frictrack.plan.experiment_setup import Experiment, ExperimentSetup, candidate_runs
from frictrack.plan.normal_matrices import NormalMatrices, reduce_against_rival, reduce_without_rival, sum_runs
from frictrack.plan.traces import PlannedRun, effect_trace, planned_size, simulate_runs
from frictrack.records import Array
from frictrack.threads import one_thread

MAX_RUNS = 8  # of a plan
MIN_PROGRESS_PAIRS = 0.5  # progress in pairs for which a run is worth filming though it separates none
N_INDEPENDENT_FORMS = 1000  # independent tests in a search of the library, approximately
DEGREES_OF_FREEDOM = 2  # coefficients per test

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class EvidenceTables:
    """Normal matrices of every candidate run for every effect.

    Parameters
    ----------
    runs
        The simulated runs, R of them.
    causes
        The effects, D of them.
    sizes
        Planned size of each effect, (D,).
    without_rival
        Matrices of each run without a rival.
    rivals
        Matrices of each run against each effect: ``rivals[run][cause]``.
    raw_chi2
        Chi-squared of every trace before anything is fitted to it, (R, D): what a mark at rest in the picture shows.

    """

    runs: list[PlannedRun]
    causes: list[Cause]
    sizes: Array
    without_rival: list[NormalMatrices]
    rivals: list[list[NormalMatrices]]
    raw_chi2: Array

    @property
    def names(self) -> list[str]:
        """Names of the effects."""
        return [c.effect.name for c in self.causes]

    def evidence(self, chosen: list[int], *, reference: bool) -> Array:
        """Expected chi-squared that separates each true effect from each rival.

        Parameters
        ----------
        chosen
            Indices of runs.
        reference
            Whether a mark at rest is filmed too.

        Returns
        -------
        ndarray, shape (D, D + 1)
            Row: the true effect; column: the rival, the last one none.

        """
        d = len(self.causes)
        if not chosen:
            return np.zeros((d, d + 1))
        unexplained = [sum_runs([self.rivals[r][b] for r in chosen]).unexplained_chi2() for b in range(d)]
        bare = sum_runs([self.without_rival[r] for r in chosen]).unexplained_chi2()
        out = np.column_stack([*unexplained, bare])
        for k in (i for i, c in enumerate(self.causes) if reference and c.effect.moves_picture):
            out[k] += self.raw_chi2[chosen, k].sum()
            out[:, k] = np.where(np.arange(d) == k, out[:, k], bare)
        out[np.arange(d), np.arange(d)] = np.inf
        return np.maximum(out, 0.0)


@dataclass(frozen=True)
class PlanStep:
    """One chosen run (None: the mark at rest), and what is separated and detected once it is filmed."""

    experiment: Experiment | None  # None: the reference
    evidence: Array
    separated: list[tuple[str, str]]
    detected: list[str]  # effects detected from this run on
    n_pairs_left: int
    cost: float = 1.0


@dataclass(frozen=True)
class RunPlan:
    """The chosen runs in order, with the tables that they were chosen from."""

    setup: ExperimentSetup
    tables: EvidenceTables
    steps: list[PlanStep]
    excluded: dict[str, str]
    n_pairs_before: int  # pairs that are open before the first of them

    @property
    def evidence(self) -> Array:
        """Expected chi-squared with all of them, (D, D + 1)."""
        return self.steps[-1].evidence if self.steps else self.tables.evidence([], reference=False)

    @property
    def runs(self) -> list[PlannedRun]:
        """The completed and the chosen runs."""
        keys = {e.key for e in self.setup.completed} | {s.experiment.key for s in self.steps if s.experiment}
        return [r for r in self.tables.runs if r.experiment.key in keys]


def tabulate_evidence(setup: ExperimentSetup, notify: Progress) -> tuple[EvidenceTables, dict[str, str]]:
    """Simulate every candidate run and reduce it against every effect.

    Parameters
    ----------
    setup
        The experimental setup.
    notify
        Called with runs done, their total and the current step.

    Returns
    -------
    tables : EvidenceTables
    excluded : dict of str
        Effects left out, with the reason.

    """
    runs = simulate_runs(setup, [*setup.completed, *candidate_runs(setup)])
    causes, excluded = list_causes(setup.law, span_of_runs(runs))
    sizes = np.array([planned_size(runs, c) for c in causes])
    without_rival, rivals, raw_chi2 = [], [], []
    for number, run in enumerate(runs):
        notify(number, len(runs), f"simulating {run.experiment.key}")
        traces = np.column_stack([effect_trace(run, c, s, number) for c, s in zip(causes, sizes, strict=True)])
        without_rival.append(reduce_without_rival(run, traces, setup.scatter))
        rivals.append([reduce_against_rival(run, c, traces, setup.scatter) for c in causes])
        raw_chi2.append(np.sum(traces**2, axis=0))
    return EvidenceTables(runs, causes, sizes, without_rival, rivals, np.array(raw_chi2)), excluded


def span_of_runs(runs: list[PlannedRun]) -> Span:
    """Range of time, place and speed of the simulated runs."""
    speeds = np.concatenate([np.abs(r.piece.v_hat) for r in runs])
    first = runs[0].experiment.design.course
    return Span(
        duration=max(float(r.piece.t[-1]) for r in runs),
        x_min=first[0],
        x_max=first[1],
        v_min=float(speeds.min()),
        v_max=float(speeds.max()),
        fps=runs[0].problem.layout.spans[0].fps,
    )


@one_thread()
def choose_runs(setup: ExperimentSetup, notify: Progress = lambda done, total, what: None) -> RunPlan:
    """Choose runs until no pair is inseparable, nothing helps, or there are `MAX_RUNS` runs.

    Parameters
    ----------
    setup
        The experimental setup.
    notify
        Called with steps done, their total and the current step.

    Returns
    -------
    RunPlan

    Raises
    ------
    FrictrackError
        If every candidate run is too short.

    """
    tables, excluded = tabulate_evidence(setup, notify)
    done = {e.key for e in setup.completed}
    chosen = [i for i, r in enumerate(tables.runs) if r.experiment.key in done]
    rest = [i for i in range(len(tables.runs)) if i not in chosen]
    reference = False
    evidence = tables.evidence(chosen, reference=False)
    n_pairs_before = len(_unseparated_pairs(evidence))
    steps: list[PlanStep] = []

    def cost_of(option: int) -> float:
        """Cost of a run after the last one chosen; of a mark at rest for -1."""
        if option < 0:
            return setup.costs.check
        last = setup.settings(tables.runs[chosen[-1]].experiment.design) if chosen else None
        return setup.costs.of_run(setup.settings(tables.runs[option].experiment.design), last)

    while len(steps) < MAX_RUNS and _score(evidence)[0]:
        notify(len(steps), MAX_RUNS, "choosing runs")
        options = [(i, tables.evidence([*chosen, i], reference=reference)) for i in rest]
        if chosen and not reference:
            options.append((-1, tables.evidence(chosen, reference=True)))
        options = [o for o in options if np.isfinite(cost_of(o[0]))]
        if not options:
            break
        best, found = max(options, key=lambda o: _gain_per_cost(evidence, o[1], cost_of(o[0])))
        if _score(found)[0] >= _score(evidence)[0] and _score(found)[1] > _score(evidence)[1] - MIN_PROGRESS_PAIRS:
            break
        new = sorted(_unseparated_pairs(evidence) - _unseparated_pairs(found))
        names = tables.names
        experiment = tables.runs[best].experiment if best >= 0 else None
        detected = [names[k] for k in sorted(_undetected(evidence) - _undetected(found))]
        steps.append(
            PlanStep(
                experiment,
                found,
                [(names[a], names[b]) for a, b in new],
                detected,
                len(_unseparated_pairs(found)),
                cost_of(best),
            )
        )
        evidence, reference = found, reference or best < 0
        if best >= 0:
            chosen.append(best)
            rest.remove(best)
    while steps and not steps[-1].separated and not steps[-1].detected:  # it only came near
        steps.pop()
    notify(MAX_RUNS, MAX_RUNS, "planned")
    return RunPlan(setup, tables, steps, excluded, n_pairs_before)


def _gain_per_cost(before: Array, after: Array, cost: float) -> tuple[float, float]:
    """Pairs separated and effects detected, then progress toward that, over the cost."""
    (n_before, far_before), (n_after, far_after) = _score(before), _score(after)
    return (n_before - n_after) / cost, (far_before - far_after) / cost


def _unseparated_pairs(evidence: Array) -> set[tuple[int, int]]:
    """Pairs of effects that are not separated, whichever of the two is true."""
    square = np.minimum(evidence[:, :-1], evidence[:, :-1].T)
    return {(int(a), int(b)) for a, b in np.argwhere(square < MIN_CHI2_SEPARATED) if a < b}


def _undetected(evidence: Array) -> set[int]:
    """Effects that are not detected."""
    return {int(k) for k in np.flatnonzero(evidence[:, -1] < detection_threshold())}


@cache
def detection_threshold(forms: int = N_INDEPENDENT_FORMS) -> float:
    """Expected rise of chi-squared that is detected in 95 of 100 repeats, in a search of so many independent forms."""
    return noncentrality(float(chi2_isf(ALPHA / 2 / forms, DEGREES_OF_FREEDOM)), DEGREES_OF_FREEDOM)


def _score(evidence: Array) -> tuple[int, float]:
    """Number of pairs inseparable and effects undetected, and how far these are from their thresholds."""
    square = np.minimum(evidence[:, :-1], evidence[:, :-1].T)
    unseparated = np.maximum(MIN_CHI2_SEPARATED - square, 0.0) / MIN_CHI2_SEPARATED
    undetected = np.maximum(detection_threshold() - evidence[:, -1], 0.0) / detection_threshold()
    return len(_unseparated_pairs(evidence)) + len(_undetected(evidence)), float(
        np.sum(np.triu(unseparated, 1)) + np.sum(undetected)
    )


def unseparated_pairs(evidence: Array) -> Iterator[tuple[int, int]]:
    """Pairs of effects that are not separated, in order."""
    yield from sorted(_unseparated_pairs(evidence))
