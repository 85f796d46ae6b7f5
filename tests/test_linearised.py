"""What a candidate stands beside: responses of many forces at once, laws along the measured motion, held-out errors.

The truth here is the one-by-one way: the exact linear response, least squares with the column written out, a law
simulated and refined, and a refit without the frames that are held out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, FPS, HIDDEN, Spec, measured, study

from frictrack import FrictrackError, effects, samples
from frictrack.effects import models
from frictrack.fit import add_effect, fit, reference_of, refine
from frictrack.fit.cutting import pieces_of
from frictrack.fit.least_squares import heldout_rms
from frictrack.fit.linearised import (
    candidate_grids,
    linearise,
    linearise_about_measurement,
    measured_series,
    scan_candidate,
)
from frictrack.fit.linearised.scan import _inverse_root
from frictrack.fit.penalties import jacobian_basis
from frictrack.fit.stepwise import (
    baseline_misfit,
    deepen_trials,
    misfit_left_by_other,
    scan_effects,
    simulate_trial,
    try_effect,
    try_effects,
)
from frictrack.search import EvaluationBudget
from frictrack.simulate import Conditions, simulate
from frictrack.simulate.dynamics import EdgeResponse

LAW = ["coulomb", "stribeck", "viscous"]
SPECS = (Spec(3.0, 1, 0.06), Spec(5.0, 1, 0.08), Spec(4.0, 2, 0.06), Spec(-4.0, 1, 0.06))


def solved(*hidden, sigma=1e-5, seed=2):
    law = {name: BASE[name] for name in LAW} | {name: HIDDEN[name] for name in hidden}
    runs, _ = study(models.of(law), law, specs=SPECS, sigma=sigma, scatter=0.02, rng=np.random.default_rng(seed))
    return fit(LAW, runs).solution


@pytest.fixture(scope="module")
def complete():
    return solved()


@pytest.fixture(scope="module")
def lacks_texture():
    return solved("texture", sigma=2e-6)


class TestRows:
    @pytest.mark.parametrize(("frequency", "accuracy"), [(20.0, 1e-5), (100.0, 1e-4), (400.0, 3e-3)])
    def test_a_force_moves_the_mass_as_the_exact_response_says(self, complete, frequency, accuracy):
        response = complete.responses[1]
        panels, many = response.linear.panels, EdgeResponse(response.linear)
        exact = response.linear.respond(np.sin(2 * np.pi * frequency * panels.t + 0.4)[:, None], np.zeros((2, 1)))[1]
        x = many(np.sin(2 * np.pi * frequency * panels.edges + 0.4)[None])[0]
        starts = many.starts.T
        left = [y - starts @ np.linalg.lstsq(starts, y, rcond=None)[0] for y in (x, exact[:, 0, 0])]
        assert np.linalg.norm(left[0] - left[1]) < accuracy * np.linalg.norm(left[1])

    def test_where_sums_would_lose_digits_the_panels_are_chained(self, complete):
        response = complete.responses[0]
        many = EdgeResponse(response.linear)
        g = np.cos(3e2 * response.linear.panels.edges)[None]
        swift = many(g)
        many.stiff = True
        np.testing.assert_allclose(many(g), swift, atol=1e-3 * np.abs(swift).max())


class TestTraced:
    def test_a_law_that_lacks_nothing_is_seen_as_it_is(self, complete):
        for a, b in zip(complete.responses, linearise_about_measurement(complete).responses, strict=True):
            np.testing.assert_allclose(b.r, a.r, atol=1e-5)

    def test_the_law_along_the_measured_motion_has_the_misfit_of_the_simulated_one(self, lacks_texture):
        law = linearise(lacks_texture)
        assert baseline_misfit(law) == pytest.approx(lacks_texture.objective, rel=0.01)
        series, texture = measured_series(law), effects.get("texture")
        scans = [scan_candidate(law, f, series) for f in candidate_grids(law, texture)]
        trial = try_effect(law, texture, scans, series.coordinates[:, 0])
        grown = simulate_trial(law, trial)
        assert lacks_texture.objective > 3 * grown.objective
        assert trial.misfit == pytest.approx(grown.objective, abs=2.0)
        there = dict(zip(trial.layout.names, trial.p, strict=True))
        assert there["texture.period"] == pytest.approx(HIDDEN["texture"]["period"], rel=0.01)
        assert there["texture.amplitude"] == pytest.approx(HIDDEN["texture"]["amplitude"], rel=0.1)


class TestTogether:
    def test_effects_far_behind_the_best_are_not_refined_to_their_end(self, lacks_texture):
        names, spent, found = ("spring", "texture", "drag", "patch"), [], []
        for together in (True, False):
            budget = EvaluationBudget()
            problem = lacks_texture.problem.with_budget(budget)
            law = linearise(replace(lacks_texture, problem=problem))
            series = measured_series(law)
            scanned = scan_effects(law, [effects.get(name) for name in names], series)
            data = series.coordinates[:, 0]
            trials = try_effects(law, scanned, data) if together else [try_effect(law, *s, data) for s in scanned]
            spent.append(budget.used)
            found.append({t.effect.name: t.misfit for t in trials})
        some, every = found
        assert spent[0] < 0.8 * spent[1]
        assert some["texture"] == pytest.approx(every["texture"], rel=1e-9)
        assert min(some, key=some.__getitem__) == "texture"
        assert max(some.values()) <= baseline_misfit(law)  # an effect of no size leaves what the model leaves


class TestScan:
    @pytest.mark.parametrize("name", ["drag", "vibration", "patch", "camera_shake", "friction_lag"])
    def test_gains_are_those_of_least_squares_with_the_columns_written_out(self, complete, name):
        law = linearise(complete)
        family = candidate_grids(law, effects.get(name))[0]
        found = scan_candidate(law, family, measured_series(law))
        g = len(found.gains) // 3
        rows = np.zeros((len(law.basis.u), family.size))
        for i, block in zip(family.members, family.block, strict=True):
            strip = law.pieces[i]
            raw = family.raw_columns(strip, family.values[g : g + 1])[0]
            mine = slice(block * family.k, (block + 1) * family.k)
            rows[law.rows[i], mine] = strip.data_of(raw, family.effect.acts_on == "measurement").T
        data, u = law.solution.random_effect_data(), law.basis.u
        shrink = law.basis.shrink(law.solution.tau)
        metric = np.eye(len(u)) - u @ shrink @ u.T  # what the law, its levels held, leaves of data
        gain = data @ metric @ rows @ np.linalg.pinv(rows.T @ metric @ rows, rcond=1e-9) @ rows.T @ metric @ data
        assert found.gains[g] == pytest.approx(gain, rel=0.02, abs=0.02)


class TestHeldOut:
    def test_one_step_says_what_a_refit_would(self, lacks_texture):
        grown = add_effect(lacks_texture, effects.get("texture"))
        for solution, accuracy in ((grown, 0.002), (lacks_texture, 0.02)):
            problem, odd = solution.problem, []
            pieces = []
            for p in problem.pieces:
                hidden = np.arange(len(p.t)) % 2 == 1
                pieces.append(replace(p, sigma=np.where(hidden, 1e9, 1.0) * p.sigma))
            refitted = refine(problem.rebuild(problem.layout, pieces), solution.p, solution.starts, tau=solution.tau)
            odd = np.concatenate([(r.piece.y - r.model_y)[1::2] for r in refitted.responses])
            assert heldout_rms(solution, "frames")[0] == pytest.approx(np.sqrt(np.mean(odd**2)), rel=accuracy)

    def test_the_right_effect_brings_it_down_to_the_noise(self, lacks_texture):
        before, how = heldout_rms(lacks_texture)
        after, _ = heldout_rms(add_effect(lacks_texture, effects.get("texture")), how)
        assert how in ("run", "frames")
        assert before > 1.5 * after
        assert after == pytest.approx(2e-6, rel=0.1)


def test_a_common_level_follows_what_no_data_see() -> None:
    """Coulomb friction times its level: only the products are seen, and the mean of the levels is a matter of words."""
    rng = np.random.default_rng(4)
    runs, frames, tau, shift = 7, 40, 0.05, 3.0
    member = np.repeat(np.arange(runs), frames)
    ways = np.where(np.arange(runs) < 5, 1.0, -1.0)
    deep = rng.uniform(0.5, 2.0, runs)[member]  # runs are not equally telling
    levels = (member[:, None] == np.arange(runs)) * deep[:, None] * 50.0
    jac = np.column_stack([levels.sum(axis=1), levels])
    basis = jacobian_basis(jac, list(range(1, runs + 1)))
    assert basis.n_levels == runs - 1
    slope = levels @ ways
    data = shift * slope + levels @ (tau * rng.standard_normal(runs)) + rng.standard_normal(len(member))
    rest = np.eye(len(member)) - basis.u @ basis.shrink(tau) @ basis.u.T
    found = (slope @ rest @ data) / (slope @ rest @ slope)
    covariance = np.eye(len(member)) + tau**2 * levels @ levels.T  # generalised least squares, written out
    both, inverse = np.column_stack([jac[:, 0], slope]), np.linalg.inv(covariance)
    assert found == pytest.approx(np.linalg.solve(both.T @ inverse @ both, both.T @ inverse @ data)[1], rel=1e-6)


class TestShortfall:
    def test_what_is_true_falls_short_of_itself_by_nothing_and_another_cause_by_what_it_cannot_be(self, lacks_texture):
        law = linearise(lacks_texture)
        series = measured_series(law)
        made = {}
        for name in ("texture", "patch"):
            effect = effects.get(name)
            made[name] = try_effect(
                law,
                effect,
                [scan_candidate(law, f, series) for f in candidate_grids(law, effect)],
                series.coordinates[:, 0],
            )
        own = misfit_left_by_other(law, made["texture"], made["texture"])
        other = misfit_left_by_other(law, made["texture"], made["patch"])
        assert abs(own) < 1.0
        assert other > 0.5 * (made["patch"].misfit - made["texture"].misfit) > 100


def test_a_law_that_leads_away_from_the_measured_motion_is_refused(complete):
    names = complete.problem.layout.names
    driving = np.where(np.array(names) == "viscous.F_v", -500.0, complete.p)  # grows by e in a frame
    with pytest.raises(FrictrackError, match="signs of incline"):
        linearise(replace(complete, p=driving))


def test_a_run_that_rested_before_it_was_pushed_begins_with_that_rest():
    t = np.arange(600) / 4000
    moving = np.maximum(t - 0.02, 0.0)
    x = 0.01 + 20.0 * moving**2
    run = measured(t, x, sigma=1e-6, rng=np.random.default_rng(3), drive=np.where(t > 0.02, 20.0, 0.0))
    first = pieces_of([run], reference_of([run]))[0][0]
    _, places, speeds = first.path.before
    assert speeds[0] == 0.0  # unbent: a state that follows the motion begins at nothing
    assert places[0] == pytest.approx(0.01, abs=2e-6)


def test_a_record_that_begins_with_its_push_begins_at_rest():
    t = np.arange(300) / 2000
    x = 0.01 + 40.0 * t**2
    run = measured(t, x, sigma=1e-5, rng=np.random.default_rng(4), drive=np.full(300, 40.0))
    first = pieces_of([run], reference_of([run]))[0][0]
    assert first.path.before[2, 0] == 0.0
    moving = measured(t, x + 2.0 * t, sigma=1e-5, rng=np.random.default_rng(4), drive=np.full(300, 40.0))
    first = pieces_of([moving], reference_of([moving]))[0][0]
    assert first.path.before[2, 0] == pytest.approx(2.0, abs=0.2)  # bent already


BLOWS = {  # speed m/s, mass over the first one, frames: impulse N s and moment s
    (4.0, 1.0, 645): (0.0076, 0.1425),
    (5.76, 1.0, 888): (0.0025, 0.1589),
    (7.52, 1.0, 466): None,
    (5.76, 0.5, 813): (0.0018, 0.1224),
    (-7.52, 1.0, 467): (-0.0084, 0.0593),
    (-5.76, 1.0, 900): (-0.0026, 0.1781),
    (-4.0, 1.0, 674): None,
}


@pytest.mark.slow
def test_events_that_hide_each_other_are_found_in_every_run_that_has_one():
    law = {"coulomb": {"F_c": 17.05}, "drag": {"c": 0.1514}}
    rng, runs = np.random.default_rng(8), []
    for i, ((speed, ratio, frames), blow) in enumerate(BLOWS.items()):
        struck = {"collision": {"J": blow[0], "time": blow[1], "width": 5.5e-4}} if blow else {}
        t, mass = np.arange(frames) / FPS, 0.731 * ratio
        held = Conditions(mass, ratio * (1 + 0.03 * rng.standard_normal()), ratio)
        slide = simulate(models.of(law | struck), law | struck, held, t, (0.0 if speed > 0 else 0.8, speed))
        runs.append(measured(t, slide.x, sigma=2.7e-5, mass=mass, name=f"r{i}", rng=rng, valid=np.ones(frames, bool)))
    beside_law = linearise(fit(["coulomb", "drag"], runs).solution)
    collision, series = effects.get("collision"), measured_series(beside_law)
    scans = [scan_candidate(beside_law, family, series) for family in candidate_grids(beside_law, collision)]
    (found,) = deepen_trials(beside_law, [try_effect(beside_law, collision, scans, series.coordinates[:, 0])])
    times = {n[len("collision.time") :]: p for n, p in zip(found.layout.names, found.p, strict=True) if ".time" in n}
    assert times == {f"[r{i}]": pytest.approx(b[1], abs=4e-3) for i, b in enumerate(BLOWS.values()) if b}


def test_a_direction_that_others_absorb_entirely_gains_nothing():
    """Neglected shares may leave a little less than nothing of it: the rest is whitened as if it were not there."""
    axes, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    left = np.stack([axes @ np.diag(size) @ axes.T for size in ([-1e-3, 0.2, 1.0], [1e-4, 0.2, 1.0])])
    root = _inverse_root(left)
    inverse = np.swapaxes(root, -1, -2) @ root
    np.testing.assert_allclose(inverse[0], axes @ np.diag([0.0, 5.0, 1.0]) @ axes.T, atol=1e-9)
    np.testing.assert_allclose(inverse[1] @ left[1], np.eye(3), atol=1e-9)


class TestTrials:
    @pytest.mark.slow
    @pytest.mark.parametrize("factor", [1, 3, 50])
    def test_a_trial_that_leads_astray_begins_at_the_model_without_the_effect(self, factor):
        model = fit(["coulomb", "viscous"], samples.runs()[1:2]).solution
        linearised, effect = linearise(model), effects.get("texture")
        series = measured_series(linearised)
        scans = [scan_candidate(linearised, grid, series) for grid in candidate_grids(linearised, effect)]
        trial = try_effect(linearised, effect, scans, series.coordinates[:, 0])
        astray = trial.p * [factor if name == "viscous.F_v" else 1 for name in trial.layout.names]
        assert simulate_trial(linearised, replace(trial, p=astray)).objective == pytest.approx(trial.misfit, rel=1e-3)
