"""The next experiment parts what it promises to part, with about the evidence that it promises.

Truth is made apart from the code under test: the new run is simulated with the hidden effect, its noise and its level,
and everything is fitted again. The predictions by hand use closed forms.
"""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from runs import BASE, FPS, MASS, PITCH, Spec, measured, study

from frictrack import effects
from frictrack.cli import output
from frictrack.diagnose import diagnose
from frictrack.diagnose.effect_description import describe_effect
from frictrack.diagnose.experiments import candidate_runs, fitted_setup
from frictrack.diagnose.experiments.candidates import candidate_experiments
from frictrack.diagnose.experiments.forecast import (
    EvidenceForecast,
    FittedExplanation,
    ModelDiscrimination,
    PresentRun,
    explain_by_axes,
    make_explanation,
)
from frictrack.diagnose.experiments.proposals import (
    compare_all,
    describe_separation,
    direct_checks,
    plan_for_candidates,
    plan_for_unexplained,
    propose_experiments,
    rate_runs,
)
from frictrack.diagnose.experiments.virtual_runs import (
    RunDesign,
    expected_scatter,
    extend_layout,
    max_frames_of_film,
    simulate_run,
)
from frictrack.diagnose.model_selection import information_criterion
from frictrack.effects import models
from frictrack.effects.ranges import ACCELEROMETER_STD, LEVEL_STD_RAD
from frictrack.fit import LeastSquaresProblem, add_effect, fit, refine
from frictrack.fit.stepwise import refine_to_end
from frictrack.present import plots
from frictrack.records import GRAVITY
from frictrack.results import to_builtins
from frictrack.results.verdicts import next_experiments
from frictrack.settings.costs import Costs
from frictrack.simulate import Conditions, simulate

LAW = ["coulomb", "viscous"]
SIGMA = 1e-5
SCATTER = 0.02  # of the friction level, where runs can tell it
KEYS = (
    {"cost", "settings"}
    | {"what", "separates", "expected_delta_bic", "expected_interval", "expected_if_true", "groups", "tells"}
    | {
        "kind",
        "key",
    }
)


def law_with(name, values):
    return {n: BASE[n] for n in LAW} | {name: values}


def runs_with(name, values, speeds, *, seed=1, duration=0.12):
    law, scatter = law_with(name, values), SCATTER if len(speeds) > 3 else 0.0
    specs = tuple(Spec(v, 1, duration) for v in speeds)
    return study(models.of(law), law, specs=specs, sigma=SIGMA, scatter=scatter, rng=np.random.default_rng(seed))[0]


def explained(runs, *names):
    """The bare law, and what each effect makes of it."""
    bare = fit(LAW, runs).solution
    return bare, {n: refine_to_end(add_effect(bare, effects.get(n))) for n in names}


def explanations(runs, *names):
    bare, grown = explained(runs, *names)
    return [make_explanation(n, s, bare) for n, s in grown.items()]


def separating_runs(among):
    """Candidate runs that separate the explanations, the one with most evidence first."""
    rated = rate_runs(compare_all(among), candidate_experiments(among[0].solution))
    return sorted((o for o in rated if o.separated_pairs()), key=lambda o: -o.weakest().expected)


def take(design, law, scatter, *, seed=9):
    """The planned run as the truth would have it: same start, mass, tilt, rate and zoom, its own noise and level."""
    rng = np.random.default_rng(seed)
    fps, mass = FPS * design.rate, MASS * design.mass
    t = np.arange(int(0.4 * fps)) / fps
    own = {k: dict(q) for k, q in law.items()}
    for q in own.values():
        if "phase" in q and "period" not in q:
            q["phase"] = rng.uniform(-np.pi, np.pi)
    load = design.mass * np.cos(design.tilt) * (1 + scatter * rng.standard_normal())
    held = Conditions(mass, load, design.mass, PITCH * design.pitch, design.tilt)
    slide = simulate(models.of(own), own, held, t, design.start)
    gone = (np.sign(design.start[1]) * slide.v < 0.02) | (slide.x < design.course[0]) | (slide.x > design.course[1])
    n = int(np.argmax(gone)) or len(t)
    y, kept = (slide.x + slide.shift)[:n], t[:n]
    known = {"mass": mass, "name": "new", "pitch": PITCH * design.pitch, "incline": design.tilt}
    return measured(kept, y, sigma=SIGMA * design.pitch, rng=rng, **known)


# truth, its values, the rival that these runs cannot tell from it, speeds
AMBIGUOUS = [
    ("drag", {"c": 0.009}, "drift", (4.0, 4.2, 4.4, 4.1)),
    ("patch", {"F": 0.1, "x_c": 0.22, "w": 0.02}, "collision", (5.0,)),
]


@pytest.fixture(scope="module", params=AMBIGUOUS, ids=lambda p: f"{p[0]}-{p[2]}")
def pair(request):
    truth, values, rival, speeds = request.param
    runs = runs_with(truth, values, speeds, duration=0.12)
    return truth, rival, law_with(truth, values), runs, explanations(runs, truth, rival)


@pytest.mark.slow
def test_the_recommended_run_parts_the_pair_with_about_the_evidence_promised(pair):
    truth, rival, law, runs, among = pair
    _, before = explained(runs, truth, rival)
    assert abs(information_criterion(before[rival]) - information_criterion(before[truth])) < 25  # nobody could tell
    best = separating_runs(among)[0]
    _, after = explained([*runs, take(best.design, law, SCATTER if len(runs) > 3 else 0.0)], truth, rival)
    observed = information_criterion(after[rival]) - information_criterion(after[truth])
    expected = best.evidence[truth, rival].expected
    assert observed > 10
    spread = 4 * np.sqrt(expected)  # of a chi-squared of that non-centrality, two standard deviations
    assert expected / 2 - spread < observed < 2 * expected + spread


def test_the_interval_is_that_of_two_gaussian_models_of_uncertain_size():
    rng = np.random.default_rng(3)
    trace, std = rng.normal(size=400), 0.12  # of the size, relative
    for mean in (30.0, 300.0):
        shape = trace * np.sqrt(mean / (trace @ trace))
        size = 1 + std * rng.normal(size=(20_000, 1))
        noise = rng.normal(size=(20_000, 1)) * np.linalg.norm(shape)  # of the data along the trace
        observed = (size**2 * mean + 2 * size * noise)[:, 0]  # chi-squared of the rival minus that of the truth
        low, high = EvidenceForecast(mean, std).interval()
        assert np.mean((observed > low) & (observed < high)) == pytest.approx(0.95, abs=0.012)


def test_an_unknown_size_leaves_the_interval_open():
    low, high = EvidenceForecast(50.0, np.inf).interval()
    assert low == pytest.approx(50 - 1.96 * 2 * np.sqrt(50), rel=0.02)
    assert high is None


@pytest.mark.slow
@pytest.mark.parametrize("case", AMBIGUOUS, ids=lambda p: p[0])
def test_the_interval_holds_the_evidence_of_the_run_that_is_filmed(case):
    truth, values, rival, speeds = case
    inside = []
    for seed in range(12):
        runs = runs_with(truth, values, speeds, seed=seed)
        among = explanations(runs, truth, rival)
        best = separating_runs(among)[0]
        new = take(best.design, law_with(truth, values), SCATTER if len(runs) > 3 else 0.0, seed=100 + seed)
        _, found = explained([*runs, new], truth, rival)
        observed = information_criterion(found[rival]) - information_criterion(found[truth])
        low, high = best.evidence[truth, rival].interval()
        inside.append(observed > low and (high is None or observed < high))
    assert sum(inside) >= 9


def test_a_repeat_of_the_same_run_promises_what_one_more_run_adds_and_no_more():
    values = {"amplitude": 0.8, "frequency": 61.3, "phase": 0.7}
    runs = runs_with("vibration", values, (4.2, 4.6, 5.0, 5.5), duration=0.06)
    shake, vibration = explanations(runs, "camera_shake", "vibration")
    for pair in (ModelDiscrimination(shake, vibration), ModelDiscrimination(vibration, shake)):
        repeat = next(e for e in candidate_experiments(shake.solution) if e.key == "repeat")
        assert abs(pair.expected_delta_bic_now) < 1
        assert abs(pair.forecast_after(repeat).expected) < 1  # both have a phase of its own for it
        heavy = next(e for e in candidate_experiments(shake.solution) if e.key == "double mass")
        # a tie of the amplitudes is all that tells them apart: a rival with one per run pays for four more
        frames = sum(len(p.t) for p in shake.solution.problem.pieces)
        assert 10 < pair.forecast_after(heavy).expected < 4 * np.log(2 * frames)


def test_a_rival_far_from_its_fit_leaves_what_the_simulated_one_leaves():
    law = {"coulomb": {"F_c": 1.2}, "viscous": {"F_v": 0.4}}
    specs = tuple(Spec(v, 1, 0.125) for v in (2.0, 3.0, 3.5))
    runs, _ = study(models.of(law), law, specs=specs, sigma=SIGMA)
    bare = fit(["coulomb"], runs).solution
    viscous, drift = (make_explanation(n, add_effect(bare, effects.get(n)), bare) for n in ("viscous", "drift"))
    pair = ModelDiscrimination(viscous, drift)
    half = next(e for e in candidate_experiments(bare) if e.key == "half mass")
    expected = simulated_objective(pair, half)
    assert expected > 1e4  # the friction levels of the present runs change by tens of per cent
    assert pair.forecast_after(half).expected == pytest.approx(expected, rel=0.01)


def simulated_objective(pair, design):
    """What the rival leaves of the present runs and a planned one, all of them simulated (same number of unknowns)."""
    rival, truth = pair.fitted_rival, pair.truth.solution
    piece = simulate_run(truth, design).piece
    layout, p = extend_layout(rival, truth.problem.layout.span, design.phase)
    problem = LeastSquaresProblem(layout.model, layout, [*rival.problem.pieces, piece])
    starts = [*rival.starts, np.array(design.start)]
    return refine(problem, p, starts, tau=expected_scatter(truth, len(layout.run_names)), max_steps=100).objective


def test_a_present_run_does_not_tell_the_scale_of_its_friction_level():
    runs = runs_with("drag", {"c": 0.05}, (3.0, 4.0, 4.4))
    solution = fit(LAW, runs).solution
    layout, p = solution.problem.layout, solution.p.copy()
    p[layout.levels] *= 1.25
    p[layout.index("coulomb", "F_c")] /= 1.25
    present = [PresentRun(r, solution, layout) for r in solution.responses]
    for run, fitted in zip(present, solution.responses, strict=True):
        np.testing.assert_allclose(run.at(p).r, fitted.r, rtol=0, atol=1e-6)
    one, step = present[0].at(p), 1e-6
    for k, i in enumerate(one.active):  # slopes by differences
        moved = present[0].at(p + step * np.eye(len(p))[i])
        np.testing.assert_allclose(
            (one.r - moved.r) / step, one.jac[:, k], rtol=1e-4, atol=1e-4 * np.abs(one.jac).max()
        )


def test_the_planned_run_is_the_one_that_the_law_makes():
    runs = runs_with("drag", {"c": 0.05}, (4.0, 4.2, 4.4))
    bare = fit(LAW, runs).solution
    design = RunDesign((0.0, 3.0), (0.0, 0.3), mass=2.0)
    piece = simulate_run(bare, design).piece
    f_c, f_v = (bare.p[bare.problem.layout.index(*a)] for a in (("coulomb", "F_c"), ("viscous", "F_v")))
    m, load = 2 * MASS, 2 * f_c  # m v' = -2 F_c - F_v v, by hand
    v = (3.0 + load / f_v) * np.exp(-f_v * piece.t / m) - load / f_v
    x = (3.0 + load / f_v) * m / f_v * (1 - np.exp(-f_v * piece.t / m)) - load / f_v * piece.t
    assert np.max(np.abs(piece.y - x)) < 1e-9
    assert piece.y[-1] <= 0.3
    assert v.min() > 0
    tilted = simulate_run(bare, replace(design, mass=1.0, tilt=np.deg2rad(5.0))).piece
    a = np.gradient(np.gradient(tilted.y, tilted.t), tilted.t)[5]
    lean = GRAVITY * np.sin(np.deg2rad(5.0)) + (f_c * np.cos(np.deg2rad(5.0)) + f_v * 3.0) / MASS
    assert a == pytest.approx(-lean, rel=0.01)


def test_the_menu_keeps_within_what_the_set_up_has_shown():
    runs = runs_with("drag", {"c": 0.05}, (3.0, 6.0))
    entries = {e.key: e for e in candidate_experiments(fit(LAW, runs).solution)}
    assert entries["slower"].start[1] == pytest.approx(1.5, rel=0.01)
    assert entries["faster"].start[1] == 8.0  # not nine
    assert entries["reversed"].start[1] < 0
    assert "no run has had so far" in entries["reversed"].words
    assert entries["to a stop"].start[1] ** 2 / 2 / 24.0 < 0.6  # it stops on the course: (8 + 1.2 v)/m and more
    assert {"half mass", "double mass", "tilt +1", "tilt -1", "frame rate", "zoom", "longer"} <= entries.keys()


def test_a_level_tells_a_slope_by_its_own_accuracy():
    runs = runs_with("slope", {"F": 1.2}, (4.0, -4.0, 4.4, -4.4))
    slope, asymmetry = explanations(runs, "slope", "asymmetry")
    found = {check.key: (if_one, if_other) for check, if_one, if_other in direct_checks(slope, asymmetry)}
    value = slope.solution.p[slope.solution.problem.layout.index("slope", "F")]
    signal = (value / (MASS * GRAVITY * LEVEL_STD_RAD)) ** 2
    assert found["level"][0] == pytest.approx(signal)
    assert found["level"][1] == pytest.approx(slope.gain * signal / (slope.gain + signal))
    told = propose_experiments([slope, asymmetry])
    assert told[0]["key"] == "level"
    assert "level" in told[0]["what"]


def test_an_accelerometer_tells_a_force_from_a_fault_of_the_picture():
    runs = runs_with("vibration", {"amplitude": 0.8, "frequency": 61.3, "phase": 0.7}, (4.2,))
    vibration, shake = explanations(runs, "vibration", "camera_shake")
    found = {check.key: if_one for check, if_one, _ in direct_checks(vibration, shake)}
    frames = len(vibration.solution.problem.pieces[0].t)
    amplitude = vibration.solution.p[vibration.solution.problem.layout.index("vibration", "amplitude")]
    assert found["accelerometer"] == pytest.approx(frames / 2 * (amplitude / MASS / ACCELEROMETER_STD) ** 2, rel=0.1)


def test_a_pair_that_no_run_parts_is_told_what_else_does():
    runs = runs_with("slope", {"F": 1.2}, (4.0, 4.2))
    bare, grown = explained(runs, "slope", "spring")
    assert plan_for_candidates(bare, [], ()) == []  # nothing passes, nothing to part
    one = FittedExplanation("spring", grown["spring"], 0.0, grown["spring"])
    told = propose_experiments([one, replace(one, effect="spring")])
    assert [(step["kind"], step["separates"], step["expected_delta_bic"]) for step in told] == [("none", [], 0.0)]
    pair = [make_explanation(n, s, bare) for n, s in grown.items()]
    told = propose_experiments(pair)  # in one direction neither has brought anything: a cable pulls like a slope
    assert told[-1]["kind"] == "none"
    assert told[-1]["what"].startswith("No candidate run separates slope and spring")
    assert "lay a level on the course, and take the cable off" in told[-1]["what"]


def test_the_diagnosis_tells_it_in_json_best_first():
    values = {"amplitude": 0.8, "frequency": 61.3, "phase": 0.7}
    found = diagnose(fit(LAW, runs_with("vibration", values, (4.0,), duration=0.04)))
    assert found.verdict == "ambiguous"
    steps = json.loads(json.dumps(to_builtins(found.summary()), allow_nan=False))["next_experiment"]
    assert steps
    for step in steps:
        assert step.keys() == KEYS
        assert step["expected_delta_bic"] >= 10 or step["kind"] == "none"
        assert {n for g in step["groups"] for n in g} == set(step["separates"])
    group = {found.best.effect, *found.best.indistinguishable_from}
    assert set(steps[0]["separates"]) <= group | {c.effect for c in found.candidates}
    assert any(step["key"] == "reference" for step in steps)


def test_what_no_effect_explains_gets_a_run_that_tells_its_axis():
    joint = effects.formula("joint", "F*s*tanh((x - x_c)/w)", bounds={"x_c": (0.0, 1.0), "w": (0.001, 0.1)})
    law = {n: BASE[n] for n in LAW} | {"joint": {"F": 0.3, "x_c": 0.15, "w": 0.01}}
    specs = tuple(Spec(v, 1, 0.06) for v in (4.0, 4.1))
    runs, _ = study(models.of([*LAW, joint]), law, specs=specs, sigma=SIGMA)
    told = plan_for_unexplained(fit(LAW, runs).solution)
    assert told[0]["kind"] == "film"
    assert "place" in told[0]["separates"]
    assert told[0]["expected_if_true"]["place"] > 10
    assert "what depends on the place comes again at the same place" in told[0]["what"]
    bare = fit(
        LAW, study(models.of([*LAW, joint]), law, specs=(Spec(3.5, 1, 0.06), Spec(4.5, 1, 0.06)), sigma=SIGMA)[0]
    )
    left = {e.name: e.solution.objective for e in explain_by_axes(bare.solution)}
    assert left["place"] < left["speed"] < bare.solution.objective  # neither curve repeats what the model has


def test_candidates_speak_of_the_numbers_of_this_study():
    runs = runs_with("patch", {"F": 1.5, "x_c": 0.21, "w": 0.02}, (4.0, 5.0))
    _, grown = explained(runs, "patch")
    told = describe_effect(effects.get("patch"), grown["patch"])["here"]
    assert told.startswith("From x = 0.17")
    assert "r0 in frame" in told
    assert "look at run" in told
    runs = runs_with("texture", {"amplitude": 0.8, "period": 0.03, "phase": 1.0}, (4.0, 5.0))
    _, grown = explained(runs, "texture")
    assert "one mark every 30.0 mm of the course" in describe_effect(effects.get("texture"), grown["texture"])["here"]
    assert "here" not in describe_effect(effects.get("texture"))


@pytest.mark.parametrize("name", sorted(set(effects.LIBRARY) - {"coulomb", "viscous", "lugre", "presliding"}))
def test_every_effect_of_the_library_has_words_of_its_own(name):
    effect = effects.get(name)
    assert effect.invariant
    assert effect.describe or name in ("stribeck", "measured_load")


STEPS = [
    {
        "what": "Film a run with half the mass: why",
        "separates": ["vibration", "camera_shake", "load_modulation"],
        "expected_delta_bic": 41.0,
        "expected_if_true": {"vibration": 41.0, "camera_shake": 300.0, "load_modulation": 55.0},
        "groups": [["vibration"], ["camera_shake", "load_modulation"]],
        "tells": describe_separation([["vibration"], ["camera_shake", "load_modulation"]]),
        "kind": "film",
        "key": "half mass",
    },
    {
        "what": "No candidate run separates slope and spring; lay a level on the course",
        "separates": [],
        "expected_delta_bic": 0.0,
        "expected_if_true": {},
        "groups": [["slope", "spring"]],
        "tells": "",
        "kind": "none",
        "key": "none",
    },
]


def test_terminal_and_report_say_the_same():
    out = io.StringIO()
    found = {"next_experiment": STEPS}
    output.next_experiment(Console(file=out, width=200), found)
    said = out.getvalue()
    assert "1. Film a run with half the mass: why" in said
    assert "separates vibration from camera_shake or load_modulation; expected delta BIC 41" in said
    assert "2. No candidate run separates slope and spring" in said
    assert describe_separation([["a"], ["b"], ["c"]]) == "a, b and c apart"
    assert [step.separates for step in next_experiments(found)] == [
        "vibration from camera_shake or load_modulation",
        "",
    ]
    assert next_experiments(None) == []
    drawn = plots.svg(plots.next_experiments(STEPS[:1]))
    assert "1. half mass" in drawn
    assert "if camera_shake is true" in drawn


def test_a_film_has_no_more_frames_than_the_camera_holds():
    values = {"c": 0.02}
    still_moving = runs_with("drag", values, (4.0, 7.0), duration=0.06)  # the first ends in the middle of the course
    solution = fit(LAW, still_moving).solution
    assert max_frames_of_film(solution) == len(still_moving[0].displacement.t)
    repeat = next(e for e in candidate_experiments(solution) if e.key == "repeat")
    slow = replace(repeat, start=(repeat.course[0], 4.0))
    assert len(simulate_run(solution, slow).piece.t) == max_frames_of_film(solution)
    assert len(simulate_run(solution, replace(slow, frames=np.inf)).piece.t) > max_frames_of_film(solution)
    assert {e.frames for e in candidate_experiments(solution, Costs(frames=150))} == {150}
    assert max_frames_of_film(solution, Costs(frames=np.inf)) == np.inf  # declared, whatever the runs show
    assert any("give frames in [costs]" in line for line in fitted_setup(fit(LAW, still_moving)).assumed)
    declared = fitted_setup(fit(LAW, still_moving), Costs(frames=150))
    assert not any("give frames" in line for line in declared.assumed)
    assert {e.frames for e in candidate_runs(declared)} == {150}
    alone = fit(LAW, still_moving[:1]).solution
    assert max_frames_of_film(alone) > max_frames_of_film(solution)  # nothing shows that it did not leave the picture
