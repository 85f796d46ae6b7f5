"""Rows of all runs in one call are those of every run by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, EARLIER, Spec, study

from frictrack import effects, models
from frictrack.effects import LIBRARY
from frictrack.fit import fit
from frictrack.fit.linearised import linearise
from frictrack.fit.pieces.whitening import Whitening
from frictrack.fit.separable import ProjectedProblem, SeparableModel, are_stackable

LAW = ["coulomb", "stribeck", "viscous"]
SPECS = (Spec(3.0, 1, 0.06), Spec(5.0, 1, 0.08), Spec(4.0, 2, 0.06), Spec(-4.0, 1, 0.06))
ALONE = {"coulomb", "stribeck", "viscous", "drive_error", "target_rotation", "measured_load"}


@pytest.fixture(scope="module")
def linearised():
    law = {name: BASE[name] for name in LAW}
    runs, _ = study(models.of(law), law, specs=SPECS, sigma=1e-5, scatter=0.02, rng=np.random.default_rng(2))
    pasts = [EARLIER[:i] for i in (0, 1, 2, 1)]
    runs = [replace(run, clamp_x=-0.1, earlier=past) for run, past in zip(runs, pasts, strict=True)]
    return linearise(fit(LAW, runs).solution)


def with_effect(linearised, name):
    """A layout with one more effect, and values somewhere inside the bounds, levels away from one."""
    old = linearised.solution.problem.layout
    layout = replace(old, model=old.model + effects.get(name))
    low, high = (np.clip(b, -2.0, 2.0) for b in layout.bounds)
    p = low + (high - low) * np.random.default_rng(0).uniform(0.3, 0.7, len(low))
    known = dict(zip(old.names, linearised.solution.p, strict=True))
    p = np.array([known.get(n, v) for n, v in zip(layout.names, p, strict=True)])
    p[layout.levels] = 1 + 0.1 * np.arange(len(layout.levels))
    return layout, p


def test_runs_of_other_loads_and_directions_are_joined(linearised):
    assert [len(stack.members) for stack in linearised.stacks] == [len(linearised.pieces)]
    assert len({b.path.load for b in linearised.blocks}) > 1
    assert len({len(b.path.t) for b in linearised.blocks}) > 1


@pytest.mark.few(8)
@pytest.mark.parametrize("name", sorted(set(LIBRARY) - ALONE))
def test_joined_rows_and_derivatives_are_those_of_every_run(linearised, name):
    layout, p = with_effect(linearised, name)
    made = []
    for stacks in ((), linearised.stacks):
        separable = SeparableModel(layout, linearised.blocks, stacks)
        problem = ProjectedProblem(separable, separable.data)
        state = problem.at(p)
        slopes = problem.tangent(state, separable.free).rows
        levels = len(layout.levels)
        made.append((state.rows, slopes[:-levels], slopes[-levels:], state.misfit))
    (rows, slopes, levels, misfit), (joined, joined_slopes, joined_levels, joined_misfit) = made
    np.testing.assert_allclose(joined, rows, atol=1e-10 * np.abs(rows).max())
    np.testing.assert_allclose(joined_slopes, slopes, atol=1e-5 * np.abs(slopes).max(initial=1e-300))
    np.testing.assert_allclose(joined_levels, levels, atol=1e-8 * np.abs(levels).max())
    assert joined_misfit == pytest.approx(misfit, rel=1e-9)


def test_a_path_with_another_interval_or_a_drive_is_not_joined(linearised):
    one, other = (b.path for b in linearised.blocks[:2])
    assert are_stackable(one, other)
    assert not are_stackable(one, replace(other, t=2 * other.t))
    assert not are_stackable(one, replace(other, drive_at=np.sin))
    assert not are_stackable(one, replace(other, pixel_pitch=1e-3))


def test_noise_of_one_series_does_not_reach_the_next():
    t, rng = np.linspace(0.0, 1.0, 40), np.random.default_rng(3)
    parts = [Whitening.of(t[:n], np.full(n, 1e-3), (2e-3, 0.05)) for n in (40, 25)]
    errors = [rng.normal(size=(len(w.size), 2)) for w in parts]
    apart = np.concatenate([w.whitened(e) for w, e in zip(parts, errors, strict=True)])
    np.testing.assert_allclose(Whitening.joined(parts).whitened(np.concatenate(errors)), apart, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["patch", "texture"])
def test_normal_equations_are_those_of_differences_of_the_residual(linearised, name):
    """Kaufman's normal matrix is J'J up to a second-order term; its gradient is exact: half the fall of the misfit."""
    layout, p = with_effect(linearised, name)
    separable = SeparableModel(layout, linearised.blocks, linearised.stacks)
    problem = ProjectedProblem(separable, separable.data)
    state = problem.at(p)
    free = sorted({i for g in separable.groups for i in g.nonlinear_slots}) + problem.levels
    gradient = problem.tangent(state, free[: len(free) - len(problem.levels)]).gradient
    for position, i in enumerate(free):
        h = 1e-5 * max(abs(p[i]), 1e-3)
        low, high = (problem.at(p + sign * h * np.eye(len(p))[i]).misfit for sign in (-1, 1))
        slope = -0.5 * (high - low) / (2 * h)
        assert gradient[position] == pytest.approx(slope, rel=1e-3, abs=1e-4 * np.abs(gradient).max())
