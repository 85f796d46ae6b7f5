"""Propose pairs of effects: which two together may explain what neither does alone.

With the linearised model every effect spans its columns at its own best setting, and how they change with that
setting. What two effects gain together follows from the products of these columns, so all pairs take milliseconds; the
best are fitted along the measured motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised import CandidateGrid, LinearisedModel, candidate_grids, measured_series, products_of_grids
from frictrack.fit.stepwise import CandidateTrial, effect_for_scan, try_together
from frictrack.records import Array

RELATIVE_STEP = 1e-3  # of a setting, over which the change of columns is taken
MIN_SQUARE_LEFT = 1e-9  # of a column that the model and the others of a pair leave; less is rounding


def gains_of_pairs(law: LinearisedModel, trials: Sequence[CandidateTrial]) -> dict[tuple[str, str], float]:
    """Compute what every two effects gain together in linear approximation.

    Parameters
    ----------
    law
        The model, linearised.
    trials
        Effects added to it one by one, each fitted along the measured motion.

    Returns
    -------
    dict
        Fall of chi-squared by the names of both effects.

    """
    own, series = [_grids_at(law, t) for t in trials], measured_series(law)
    products = products_of_grids(law, [grid for grids in own for grid in grids], series)
    projector = law.residual_projector(law.solution.tau)
    projected = products.coordinates @ projector
    gram = products.gram + projected @ products.coordinates.T
    data = products.data + projected @ series.coordinates[:, 0]
    absorbed = np.diag(gram) < MIN_SQUARE_LEFT * (np.diag(products.gram) + np.sum(products.coordinates**2, axis=1))
    gram[absorbed], gram[:, absorbed], data[absorbed] = 0.0, 0.0, 0.0
    rows = iter(products.rows)
    spans = {
        t.effect.title: np.hstack([_directions(gram, data, next(rows)) for _ in grids])
        for t, grids in zip(trials, own, strict=True)
        if grids
    }
    same = {t.effect.title: t.effect.name for t in trials}
    pairs = [(one, other) for one, other in combinations(spans, 2) if same[one] != same[other]]
    return {pair: _gain(gram, data, np.hstack([spans[name] for name in pair])) for pair in pairs}


def try_pair(law: LinearisedModel, first: CandidateTrial, second: CandidateTrial) -> CandidateTrial:
    """Fit a model with two more effects along the measured motion, from the values that each has alone."""
    values = {(s.effect, s.parameter, s.run): x for s, x in zip(first.layout.slots, first.p, strict=True)}
    name = second.effect.name
    values |= {
        (s.effect, s.parameter, s.run): x
        for s, x in zip(second.layout.slots, second.p, strict=True)
        if s.effect == name
    }
    effects = [next(e for e in t.layout.model.effects if e.name == t.effect.name) for t in (first, second)]
    return try_together(law, effects, values, first.layout.absent | second.layout.absent)


def _grids_at(law: LinearisedModel, trial: CandidateTrial) -> list[CandidateGrid]:
    """The grids of an effect reduced to its setting in a trial and one step from there for every scanned parameter."""
    grids = []
    for grid in candidate_grids(law, effect_for_scan(law.solution, trial.effect)):
        run = law.pieces[grid.members[0]].run
        if (trial.effect.name, run) in trial.layout.absent and trial.effect.single:
            continue
        values, _ = trial.layout.values(trial.p, run)
        at = np.array([values[trial.effect.name][name] for name in grid.names])
        low, high = grid.values.min(axis=0, initial=np.inf), grid.values.max(axis=0, initial=-np.inf)
        steps = np.diag(RELATIVE_STEP * np.maximum(np.abs(at), 0.1 * (high - low)))
        points = np.vstack([at, at + steps]) if len(at) else at[None]
        grids.append(replace(grid, values=points, shape=(len(points),)))
    return grids


def _directions(gram: Array, data: Array, rows: NDArray[np.int_]) -> Array:
    """Directions (C, m) of one grid: its columns at the first point, and their changes to the other points."""
    count = len(gram)
    first = np.zeros((count, rows.shape[1]))
    first[rows[0], np.arange(rows.shape[1])] = 1.0
    coefficients = _solve(first.T @ gram @ first, first.T @ data)
    changes = []
    for other in rows[1:]:
        change = np.zeros(count)
        change[other] += coefficients
        change[rows[0]] -= coefficients
        changes.append(change)
    return np.column_stack([first, *changes])


def _solve(gram: Array, data: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    size = np.where(size > 0, size, 1.0)
    unit = gram / size[:, None] / size
    return np.asarray(np.linalg.pinv(unit, rcond=MIN_SQUARE_LEFT, hermitian=True) @ (data / size) / size)


def _gain(gram: Array, data: Array, directions: Array) -> float:
    own = directions.T @ data
    return float(own @ _solve(directions.T @ gram @ directions, own))
