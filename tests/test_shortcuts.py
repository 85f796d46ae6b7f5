"""What saves time in a diagnosis gives what the long way gives."""

from __future__ import annotations

import numpy as np
import pytest
from runs import measured
from test_series import swing

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.diagnose.experiments.forecast import compress_response
from frictrack.diagnose.experiments.virtual_runs import LinearisedRun, RunDesign, extend_layout, simulate_run
from frictrack.fit import LeastSquaresProblem, fit, refine
from frictrack.fit.least_squares import (
    displacement_response,
    fit_with_scatter,
    predicted_objective,
    refit_with_scatter,
)
from frictrack.fit.linearised import candidate_grids, linearise
from frictrack.fit.observations import keep_compared_frames, weight_by_noise
from frictrack.simulate.dynamics.collocation import _invert_3x3

MEMORYLESS = [e for e in effects.LIBRARY.values() if e.acts_on == "force" and not e.memory and not e.modifies]


@pytest.fixture(scope="module")
def cell():
    """A long swing whose friction was measured, averaged over blocks."""
    return weight_by_noise(fit("coulomb,viscous", [swing(n=12_000, hertz=2.0)]).solution)[0]


@pytest.fixture(scope="module")
def slide():
    t = np.arange(300) / 2000
    noise = 1e-5 * np.random.default_rng(1).standard_normal(300)
    runs = [measured(t, v * t - 2.0 * t**2 + noise, sigma=1e-5, name=str(v)) for v in (1.5, 2.0, 2.5)]
    return fit("coulomb,viscous", runs).solution


def test_an_effect_without_memory_is_the_same_at_the_compared_frames(cell):
    (strip,) = linearise(cell).pieces
    assert strip.compared_path is not None
    assert len(strip.compared_path.t) * 2 <= len(strip.path.t)
    compared = 0
    for effect in MEMORYLESS:
        for family in candidate_grids(linearise(cell), effect)[:1]:
            point = family.point(len(family.values) // 2)
            whole = effect.columns(strip.path, point)[strip.response.piece.at]
            np.testing.assert_array_equal(effect.columns(strip.compared_path, point), whole)
            compared += 1
    assert compared > 10


def test_a_compact_law_leaves_and_answers_what_the_whole_one_does(cell):
    short = keep_compared_frames(cell)
    assert len(short.problem.pieces[0].path.t) == len(cell.problem.pieces[0].t)
    np.testing.assert_allclose(short.residual, cell.residual, rtol=0, atol=1e-12)
    np.testing.assert_allclose(short.jac, cell.jac, rtol=1e-12)


def test_a_law_that_remembers_keeps_its_whole_path():
    solution = weight_by_noise(fit("coulomb,viscous,presliding", [swing(n=6000)]).solution)[0]
    assert keep_compared_frames(solution) is solution


def test_a_law_continued_is_the_law_refined_again(slide):
    whole = fit_with_scatter(slide.problem, slide.p, slide.starts, 0.05)
    assert refit_with_scatter(slide, 0.05).objective == pytest.approx(whole.objective, rel=1e-9)


def test_a_step_promises_what_it_brings_where_the_law_is_linear(slide):
    off = slide.p * 1.01
    promised, state = predicted_objective(slide.problem, off, slide.starts, tau=slide.tau)
    taken = refine(slide.problem, off, slide.starts, tau=slide.tau, max_steps=1)
    assert promised < state.objective
    assert promised == pytest.approx(taken.objective, abs=0.02 * (state.objective - taken.objective))


def test_few_rows_hold_all_of_a_linear_answer(slide):
    response = slide.responses[0]
    few, step = compress_response(response), np.arange(1.0, response.jac.shape[1] + 1)
    for change in (0 * step, step, -3 * step):
        whole = response.r - response.jac @ change
        short = few.r - few.jac @ change
        assert short @ short == pytest.approx(whole @ whole, rel=1e-10)
    assert len(few.r) <= len(step) + 1


def test_a_rival_follows_a_planned_run_without_being_simulated(slide):
    design = RunDesign((0.0, 3.0), (0.0, 0.2))
    piece, start = simulate_run(slide, design).piece, np.array(design.start)
    layout, p = extend_layout(slide, slide.problem.layout.span, design.phase)
    rival, simulated = LinearisedRun(layout, piece, start), LeastSquaresProblem(layout.model, layout, [piece])
    assert np.abs(rival.respond(p).r).max() < 1e-6
    for share in (1e-4, 1e-3):  # the error is of second order in the difference
        other = p * (1 + share)
        ours, theirs = rival.respond(other), simulated.evaluate(other, [start])[0]
        size = np.abs(theirs.r).max()
        assert size > 10 * share
        assert np.abs(ours.r - theirs.r).max() < 30 * share * size
        assert ours.r_full @ ours.r_full <= theirs.r_full @ theirs.r_full


def test_matrices_of_panels_are_inverted():
    a = np.eye(3) + 0.3 * np.random.default_rng(2).standard_normal((50, 3, 3))
    inverse = _invert_3x3(np.ascontiguousarray(a.transpose(1, 2, 0))).transpose(2, 0, 1)
    np.testing.assert_allclose(inverse @ a, np.broadcast_to(np.eye(3), a.shape), atol=1e-10)
    a[7] = 0.0
    with pytest.raises(FrictrackError, match="the linear system is singular"):
        _invert_3x3(np.ascontiguousarray(a.transpose(1, 2, 0)))


def test_waves_from_the_edges_of_panels_are_traced_as_from_the_nodes(slide):
    piece, f = linearise(slide).pieces[0], np.linspace(5.0, 300.0, 75)  # at 2000 frames per second
    whole = displacement_response(piece.response, np.sin(2 * np.pi * piece.response.piece.panels.t[:, None] * f)).T
    error = np.linalg.norm(
        piece.data_of(np.sin(2 * np.pi * piece.path.t * f[:, None]), is_measurement=False) - whole, axis=1
    )
    error /= np.linalg.norm(whole, axis=1)
    radians = 2 * np.pi * f / 2000.0  # between two frames; a cubic errs by the fourth power
    assert np.all(error < 1e-5 + 0.04 * radians**4)
