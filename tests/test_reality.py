"""What a real record asks of a diagnosis: noise that no law can swallow, power, plausibility, honest deviations.

Truth comes from closed forms, from SciPy's integrator, and from records made by others; see each test.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, FPS, HIDDEN, SIX, Spec, measured, study
from scipy.integrate import solve_ivp
from scipy.signal import detrend
from test_series import FPS as CELL_FPS
from test_series import given, swing, tustin_force

from frictrack import effects
from frictrack.diagnose import diagnose
from frictrack.diagnose.residual_curves import residual_series
from frictrack.diagnose.search import subsample
from frictrack.effects import LIBRARY, Span, models
from frictrack.fit import fit, restore, state
from frictrack.fit.observations.measured_friction import friction_noise, strokes, weight_by_noise
from frictrack.fit.stepwise import physical_objection
from frictrack.measure.friction import join_swings, moving_sections
from frictrack.measure.motion import differentiate, low_pass
from frictrack.records import Displacement, Run
from frictrack.results.verdicts import certain_effects, describe_verdict, indistinguishable_effects
from frictrack.sampling import screened

TUSTIN = ["coulomb", "stribeck", "viscous"]
SPAN = Span(duration=0.1, x_min=0.0, x_max=0.4, v_min=1.0, v_max=4.0, fps=4000.0)


# --- noise of a measured friction


def ramp(force, *, noise=0.02, seconds=4.0, seed=0):
    """A speed ramp from 0 to 0.4 m/s: time, place and speed all go one way."""
    t = np.arange(round(seconds * CELL_FPS)) / CELL_FPS
    v = 0.4 * t / seconds
    e = noise * np.random.default_rng(seed).standard_normal(len(t))
    return given(t, 0.2 * t**2 / seconds, v, force(t, v) + e, name="ramp")


@pytest.mark.slow
def test_a_slow_misfit_of_one_record_is_no_noise():
    fitted = fit(["coulomb"], [ramp(lambda t, v: tustin_force(v))])
    noise = friction_noise(fitted.solution)
    assert noise.rms == pytest.approx(0.02, rel=0.05)
    assert (noise.correlation_frames, noise.stroke_count) == (1.0, 0)
    found = diagnose(fitted)
    assert found.verdict != "complete"
    assert found.noise_N == pytest.approx(0.02, rel=0.05)
    assert found.reduced_chi2 > 100
    assert found.fails_at
    assert any("drifting sensor would have to explain" in line for line in found.remarks)
    assert any("place, time and speed rise together" in line for line in found.remarks)


@pytest.fixture(scope="module")
def long_swing():
    """Thirty seconds of strokes under the law that is fitted, with white noise."""
    return fit(["coulomb", "stribeck", "viscous"], [swing(n=30_000)]).solution


def test_blocks_of_a_long_record_leave_a_true_law_no_misfit(long_swing):
    weighted, noise = weight_by_noise(long_swing)
    n = weighted.problem.n_frames
    assert n < 3100
    assert noise.correlation_frames == 1.0
    # within a block the Stribeck curve bends by up to the noise of its mean
    assert weighted.chi2 == pytest.approx(n, rel=5 * np.sqrt(2 / n))
    assert weighted.problem.layout.span.fps == pytest.approx(100.0)


def test_the_noise_of_a_weighted_record_is_that_of_all_its_frames(long_swing):
    weighted, noise = weight_by_noise(long_swing)
    again, same = weight_by_noise(weighted)
    assert again.problem.n_frames == weighted.problem.n_frames
    assert again.problem.layout.span.fps == weighted.problem.layout.span.fps
    assert same.rms == pytest.approx(noise.rms, rel=1e-6)
    np.testing.assert_allclose(again.residual, weighted.residual, atol=1e-3)


def test_a_long_record_says_which_lines_were_not_tested(long_swing):
    _, remarks = subsample(long_swing)
    assert any("lines above 20 Hz are not tested" in remark for remark in remarks)


def test_what_differs_from_stroke_to_stroke_is_noise():
    t = np.arange(12_000) / CELL_FPS
    w = 2 * np.pi * 1.0
    v = 0.1 * w * np.cos(w * t)
    rng = np.random.default_rng(4)
    drift = np.cumsum(rng.standard_normal(len(t))) * 0.004  # a cell that wanders
    shape = 0.5 * np.sin(40 * 0.1 * np.sin(w * t)) * np.sign(v)  # and a force that every stroke repeats
    force = 8.0 * np.sign(v) + shape + drift - drift.mean() + 0.02 * rng.standard_normal(len(t))
    noise = friction_noise(fit(["coulomb"], [given(t, 0.1 * np.sin(w * t), v, force)]).solution)
    assert noise.stroke_count >= 20
    assert noise.rms == pytest.approx(np.std(detrend(drift)), rel=0.5)  # not 0.35, which the shape alone leaves
    assert noise.correlation_frames > 100


def reciprocating(stroke, rate, seconds, seed, ripple=0.112):
    """A slide to and fro over a ripple of 6 mm, with a Stribeck law; noise 0.03 N."""
    t = np.arange(round(seconds * CELL_FPS)) / CELL_FPS
    x, v = stroke * np.sin(2 * np.pi * rate * t), 2 * np.pi * rate * stroke * np.cos(2 * np.pi * rate * t)
    law = 2.8 + 1.15 * np.exp(-np.abs(v) / 0.25) + 0.35 * np.abs(v) + ripple * np.sin(2 * np.pi * x / 0.006 + 0.7)
    noise = 0.03 * np.random.default_rng(seed).standard_normal(len(t))
    return given(t, x, v, np.sign(v) * law + noise, name=f"{rate:g} Hz")


def test_a_zero_that_moves_is_no_noise_but_an_effect() -> None:
    t, rng = np.arange(4000) / 500, np.random.default_rng(3)
    v = 0.2 * np.cos(2 * np.pi * t)
    friction = np.sign(v) + 0.3 * v + 0.02 * t + 0.01 * rng.normal(size=len(t))
    runs = [given(t, 0.2 / (2 * np.pi) * np.sin(2 * np.pi * t), v, friction)]
    found = diagnose(fit(["coulomb", "viscous"], runs), rng=1)
    assert (found.verdict, found.missing) == ("missing", ["cell_drift"])
    k = fit(["coulomb", "viscous", "cell_drift"], runs).parameters["cell_drift.k"]
    assert abs(k.value - 0.02) < 3 * k.std < 0.002


def test_a_force_that_two_strokes_repeat_at_their_places_is_no_noise():
    noise = friction_noise(fit(["coulomb", "viscous"], [reciprocating(0.03, 0.5, 4.0, 1)]).solution)
    assert noise.rms == pytest.approx(0.03, rel=0.05)  # 0.1 if strokes over the same speeds were compared
    assert noise.correlation_frames == 1.0


def test_the_force_drawn_for_an_effect_is_what_the_model_lacked():
    run = reciprocating(0.03, 1.5, 2.0, 2, ripple=0.0)
    poor, better = (fit(["coulomb", "viscous", *more], [run]) for more in ([], ["stribeck"]))
    drawn = residual_series(poor.solution, better.solution, ["stribeck"])
    law = 2.8 + 1.15 * np.exp(-drawn["v"] / 0.25) + 0.35 * drawn["v"]
    had = poor.parameters["coulomb.F_c"].value + poor.parameters["viscous.F_v"].value * drawn["v"]
    assert np.sqrt(np.mean((drawn["F"] - (law - had)) ** 2)) < 0.01  # N; Stribeck's own force is up to 1.15 N


@pytest.mark.slow
def test_a_law_and_a_ripple_are_both_found_in_records_of_a_load_cell():
    runs = [reciprocating(0.03, 0.5, 4.0, 1), reciprocating(0.03, 1.5, 2.0, 2), reciprocating(0.02, 4.0, 2.0, 3)]
    found = diagnose(fit(["coulomb", "viscous", "spring"], runs), quick=True).summary()
    assert len(found["missing"]) == 2  # and no third one, which explains only how blocks of frames were averaged
    assert "texture" in certain_effects(found)
    assert "stribeck" in indistinguishable_effects(found)  # flash weakening falls with the speed alike: BIC 0.5 apart
    assert describe_verdict(found, "The model").startswith("The model lacks texture, and ")


def test_strokes_are_told_from_the_noise_of_a_coordinate():
    x = np.sin(np.linspace(0, 6 * np.pi, 600)) + 0.01 * np.random.default_rng(0).standard_normal(600)
    found = strokes(x)
    assert len(found) == 7
    assert sum(map(len, found)) == 600


# --- verdicts that need power


def test_a_law_is_complete_only_where_a_tenth_of_the_friction_would_have_been_seen():
    loud = study("tustin", BASE, SIX, sigma=2e-3, rng=np.random.default_rng(1))[0]
    found = diagnose(fit(TUSTIN, loud))
    assert (found.verdict, found.missing, found.fails_at) == ("undetermined", [], [])
    entry = found.summary()["undetermined"][0]
    assert entry.keys() == {"what", "why", "settled_by", "limit_over_friction"}
    line = describe_verdict(found.summary(), "Tustin")
    assert line.startswith(f"Undetermined: these runs do not determine {entry['what']}")


def test_a_law_whose_runs_never_slow_is_undetermined():
    fast = [Spec(v, 1, 0.06) for v in (4.0, 5.0, 6.0, -5.0)]
    found = diagnose(fit(TUSTIN, study("tustin", BASE, fast, sigma=1e-5, rng=np.random.default_rng(2))[0]))
    assert found.verdict == "undetermined"
    gap = next(g for g in found.undetermined if "stribeck" in g.what)
    assert "film a run that slows to a stop" in gap.settled_by


@pytest.mark.slow
def test_a_bound_that_holds_a_parameter_hides_no_misfit():
    fast = [Spec(v, 1, 0.1) for v in (4.0, 5.0, 6.0, -5.0, 3.5)]
    law = {"coulomb": {"F_c": 8.0}, "viscous": {"F_v": 1.2}, "flash_weakening": {"dF": 4.0, "v_w": 8.0}}
    runs = study(models.of(law), law, fast, sigma=2e-6, rng=np.random.default_rng(2))[0]
    model = fit(TUSTIN, runs)  # its Stribeck velocity would have to be far above every speed
    held = [
        s.parameter for s, held in zip(model.solution.problem.layout.slots, model.solution.held, strict=True) if held
    ]
    assert held == ["v_s"]
    found = diagnose(model, quick=True)
    assert found.p_lack_of_fit < 0.005
    assert found.verdict in ("missing", "ambiguous")
    assert any("stribeck.v_s is held by its bound" in remark for remark in found.remarks)


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_rounded_positions_raise_no_alarm(seed):
    runs = []
    for run in study("tustin", BASE, SIX[::2], sigma=1e-6, rng=np.random.default_rng(seed))[0]:
        x = 1e-3 * np.round(run.displacement.x / 1e-3)
        seen = screened(replace(run.displacement, x=x))
        assert seen.resolution == pytest.approx(1e-3)
        runs.append(replace(run, displacement=seen, motion=differentiate(low_pass(seen))))
    found = diagnose(fit(TUSTIN, runs), quick=True)
    assert found.verdict in ("complete", "undetermined")
    assert found.p_lack_of_fit > 0.005


@pytest.mark.slow
def test_how_long_a_short_blow_lasts_leaves_no_verdict_open():
    t = np.arange(600) / FPS

    def rate(now, q):
        blow = 2e-2 * np.exp(-(((now - 0.05) / 2e-5) ** 2) / 2) / (2e-5 * np.sqrt(2 * np.pi))
        return [q[1], -(8.0 + 1.2 * q[1] + blow) / 0.35]

    def run(k):
        x = solve_ivp(rate, (0.0, t[-1]), [0.0, 5.0 + k], t_eval=t, max_step=2e-5, rtol=1e-9, atol=1e-12).y[0]
        return measured(t, x, sigma=2e-6, mass=0.35, name=f"r{k}", rng=np.random.default_rng(k))

    found = diagnose(fit("coulomb,viscous,collision", [run(k) for k in range(3)]))
    assert found.verdict == "complete"
    assert not any("width" in gap.what for gap in found.undetermined)


# --- plausible causes


@pytest.mark.parametrize(
    ("name", "values", "objection"),
    [
        ("vibration", {"amplitude": 1.0, "frequency": 5.0, "phase": 0.0}, "the record holds 0.5 periods of it"),
        ("vibration", {"amplitude": 1.0, "frequency": 50.0, "phase": 0.0}, ""),
        ("decaying_vibration", {"amplitude": 1.0, "frequency": 40.0, "tau": 0.005, "phase": 0.0}, "is a pulse"),
        ("camera_shake", {"amplitude": 0.05, "frequency": 50.0, "phase": 0.0}, "a picture error of 12 % of the span"),
        ("lens", {"k": 10.0, "x_c": 0.0}, "a picture error of 40 % of the span"),
        ("lens", {"k": 0.1, "x_c": 0.2}, ""),
        ("dropped_frame", {"frames": -0.56, "time": 0.05}, "-0.56 frames are lost, expected a whole number"),
        ("dropped_frame", {"frames": 0.97, "time": 0.05}, ""),
        ("texture", {"amplitude": 1.0, "period": 0.5, "phase": 0.0}, "the record holds 0.8 periods of it"),
        ("patch", {"F": 1.0, "x_c": 0.7, "w": 0.01}, "its centre 0.7 m lies off the course"),
        ("patch", {"F": 1.0, "x_c": 0.2, "w": 0.3}, "it is wider"),
        ("collision", {"J": 0.1, "time": 0.05, "width": 0.02}, "it would last 0.02 s"),
        ("collision", {"J": 0.1, "time": 0.05, "width": 0.0005}, ""),
        ("spring", {"k": 0.01, "x_0": 0.5}, "slack more than 40 m away"),
        ("spring", {"k": 30.0, "x_0": 5.0}, ""),
        ("timebase", {"k": 1.0}, "the clock would be off by 5 % at the end"),
        ("peak_locking", {"amplitude": 0.6, "phase": 0.0}, "0.6 px is more than interpolation does"),
        ("load_modulation", {"depth": 1.0, "frequency": 50.0, "phase": 0.0}, "would make the friction push"),
        ("friction_lag", {"tau": 0.2}, "is longer than"),
        ("drive_error", {"e": -0.8, "tau": 0.0}, "the drive would be 80 % wrong"),
    ],
)
def test_every_effect_says_what_of_it_is_not_plausible(name, values, objection):
    said = LIBRARY[name].plausible(values, SPAN)
    assert objection in said
    assert bool(said) == bool(objection)


def test_every_fault_of_the_picture_and_every_oscillation_says_what_is_plausible():
    for effect in LIBRARY.values():
        swings = any(p.role == "phase" for p in effect.parameters)
        assert effect.plausible is not None or not (swings or effect.acts_on == "measurement"), effect.name


def test_a_force_that_would_drive_the_mass_is_remarked_on():
    law = BASE | {"viscous": {"F_v": -0.6}}
    found = fit(TUSTIN, study("tustin", law, SIX, sigma=1e-5, rng=np.random.default_rng(3))[0])
    said = [line for line in found.summary()["remarks"] if "viscous.F_v" in line and "is negative" in line]
    assert len(said) == 1
    assert "an incline of the wrong sign" in said[0]
    plain = fit(TUSTIN, study("tustin", BASE, SIX, sigma=1e-5, rng=np.random.default_rng(3))[0])
    assert not any("is negative" in line for line in plain.summary()["remarks"])


@pytest.mark.slow
def test_a_hidden_effect_is_plausible_as_it_is_found():
    for name in ("texture", "vibration", "patch"):
        runs = study(models.tustin() + name, BASE | {name: HIDDEN[name]}, SIX, sigma=1e-5)[0]
        found = fit(models.tustin() + name, runs).solution
        effect = next(e for e in found.problem.model.effects if e.name == name)
        assert physical_objection(found.problem.layout, found.p, effect) == ""


# --- deviations that hold when the law does not


@pytest.mark.few(1)
@pytest.mark.parametrize("hidden", ["texture", "drag", "spring", "vibration", "patch"])
def test_deviations_hold_while_the_law_misses_an_effect(hidden):
    law = models.tustin() + hidden
    runs = study(law, BASE | {hidden: HIDDEN[hidden]}, SIX, sigma=1e-5, rng=np.random.default_rng(1))[0]
    fitted = fit(TUSTIN, runs)
    truth = {"coulomb.F_c": 8.0, "stribeck.F_s": 14.0, "stribeck.v_s": 0.4, "viscous.F_v": 1.2}
    assert fitted.misfit is not None
    away = {k: fitted.parameters[k].value - v for k, v in truth.items()}
    assert max(abs(d / fitted.parameters[k].std) for k, d in away.items()) > 2.5  # those of noise do not hold
    assert all(abs(d) < 4.0 * fitted.parameters[k].std_misfit for k, d in away.items())
    summary = fitted.summary()
    assert "the model is rejected" in summary["misfit"]["words"]
    assert summary["parameters"]["viscous.F_v"]["std_misfit"] > 10 * summary["parameters"]["viscous.F_v"]["std"]
    shown = fitted.parameters["coulomb.F_c"]
    assert f"({shown.std_misfit:.0e}"[1] in fitted.equation  # the equation quotes the wider one


def test_a_law_that_holds_has_one_kind_of_deviation():
    fitted = fit(TUSTIN, study("tustin", BASE, SIX, sigma=1e-5, rng=np.random.default_rng(1))[0])
    assert fitted.misfit is None
    assert fitted.summary()["misfit"] is None
    assert all("std_misfit" not in p for p in fitted.summary()["parameters"].values())


# --- masses that swing


def swinging(seed, begin, *, F_c=0.25, F_v=0.03, c=0.01, k=64.0, seconds=4.0, sigma=3e-5):
    """A pendulum with dry, viscous and quadratic friction, by SciPy with events at every reversal."""
    t = np.arange(round(seconds * 1000)) / 1000
    x, state, start = np.empty(len(t)), np.array(begin), 0.0
    while start < t[-1]:
        s = np.sign(state[1]) or -np.sign(np.sin(state[0]))

        def law(tau, z, s=s):
            return [z[1], -k * np.sin(z[0]) - F_c * s - F_v * z[1] - c * z[1] * abs(z[1])]

        def turns(tau, z, s=s, start=start):
            return z[1] if tau > start + 1e-6 else s

        turns.terminal = True
        part = solve_ivp(law, (start, t[-1]), state, events=turns, rtol=1e-10, atol=1e-12, dense_output=True)
        rows = (t >= start) & (t <= part.t[-1])
        x[rows] = part.sol(t[rows])[0]
        start, state = float(part.t[-1]), np.array([part.y[0, -1], 0.0])
    nan = np.full(len(t), np.nan)
    noisy = x + sigma * np.random.default_rng(seed).standard_normal(len(t))
    seen = Displacement(t, noisy, nan, nan, np.full(len(t), sigma), nan, np.ones(len(t), bool))
    return Run(seen, differentiate(low_pass(seen)), mass=1.0, name=f"swing {seed}")


@pytest.mark.slow
def test_a_swinging_mass_is_followed_through_its_reversals():
    gravity = effects.formula("gravity", "k*sin(x)", units={"k": "N"})
    runs = [swinging(0, (-1.2, 0.0)), swinging(1, (0.8, 0.0))]
    fitted = fit(models.of(["coulomb", "viscous", "drag"]) + gravity, runs)
    pieces = fitted.solution.problem.pieces
    assert [p.turns for p in pieces] == [True, True]
    assert min(len(p.t) for p in pieces) > 3500
    assert fitted.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    for name, true in {"coulomb.F_c": 0.25, "viscous.F_v": 0.03, "drag.c": 0.01, "gravity.k": 64.0}.items():
        found = fitted.parameters[name]
        assert abs(found.value - true) < 4 * found.std


@pytest.mark.slow
def test_what_a_pendulum_lacks_is_found_without_dry_friction_in_the_law():
    gravity = effects.formula("gravity", "k*sin(x)", units={"k": "N"})
    runs = [swinging(s, (-1.2, 0.0), c=0.0, seconds=1.5) for s in range(2)]
    found = diagnose(fit(models.of(["viscous"]) + gravity, runs), quick=True)
    assert found.missing == ["coulomb"]


@pytest.mark.slow
def test_a_swing_under_a_law_that_lets_it_rest_is_fitted_and_restored():
    """Without a spring the simulated mass runs out while the measured one swings on."""
    run = swinging(0, (-1.2, 0.0), seconds=3.0)
    fitted = fit(models.of(["coulomb", "viscous"]), [run])
    again = restore([run], state(fitted))
    assert again.solution.objective == pytest.approx(fitted.solution.objective, rel=1e-6)


@pytest.mark.slow
def test_the_force_that_a_swing_lacks_most_is_found_as_a_formula_instead_of_effects_that_leave_most_of_it():
    run = swinging(1, (-1.2, 0.0), seconds=1.5)
    found = diagnose(fit(models.of(["coulomb", "viscous"]), [run]))
    assert found.verdict == "unexplained"
    assert set(found.missing) <= {"spring"}  # what one formula beats by far is not completed by further effects
    formulas = found.unexplained["formulas"]
    first = formulas[0]  # forms of its second, small term may be alike
    assert sum(f["probability"] for f in formulas if f["form"].startswith("F_1_a * sin(2*pi*f_a*x)")) > 0.5
    assert first["reduced_chi2"] == pytest.approx(1.0, abs=0.1)
    best_single = min((f for f in formulas if f["variables"] == ["x"]), key=lambda f: f["unknowns"])
    assert best_single["form"] == "F_1 * sin(2*pi*f*x) + F_2 * cos(2*pi*f*x)"
    frequency = float(re.search(r"2 pi ([\d.]+) 1/m x", best_single["formula"])[1])
    assert frequency == pytest.approx(1 / (2 * np.pi), rel=0.01)


def test_a_blow_that_turns_a_mass_is_no_swing():
    run = swinging(0, (-1.2, 0.0))
    a = run.motion.a.copy()
    rows = [slice(0, 1000), slice(1000, 2000)]
    v = np.where(np.arange(len(a)) < 1000, 1.0, -1.0) * (0.1 + np.abs(run.motion.v))
    a[995:1005] = 100 * np.max(np.abs(a))
    struck = replace(run, motion=replace(run.motion, v=v, a=a))
    assert len(join_swings(struck, rows)) == 2


def test_a_swing_is_followed_through_its_reversals_until_it_ends():
    """Dry friction shifts the middle of every half swing by f/k; an encoder rounds so that slow motion is uncertain."""
    pull, friction, step = 64.9, 0.165, 1.57e-4  # over the mass: 1/s^2, m/s^2, m
    t, omega, shift = np.arange(5000) / 1000, np.sqrt(pull), friction / pull
    half = (omega * t // np.pi).astype(int)
    amplitude = 0.066 - shift * (2 * half + 1)
    x = amplitude * np.cos(omega * t) + shift * (-1.0) ** half
    run = Run.from_arrays(t, step * np.round(x / step), mass=1.0, name="swing")
    found = fit(["coulomb", "spring"], [run])
    assert sum(len(p.t) for p in found.solution.problem.pieces) > 0.9 * len(t)
    assert found.parameters["coulomb.F_c"].value == pytest.approx(friction, rel=0.01)
    assert found.parameters["spring.k"].value == pytest.approx(pull, rel=0.002)


def test_a_mass_that_sets_out_from_rest_is_not_taken_for_one_that_stops():
    t = np.arange(400) / 1000
    slope, friction = np.deg2rad(20.0), 1.0
    pull = 9.80665 * np.sin(slope) - friction
    nan = np.full(len(t), np.nan)
    runs = []
    for seed in range(2):
        x = 0.02 - pull * np.clip(t - 0.02, 0, None) ** 2 / 2 + 1e-4 * np.random.default_rng(seed).standard_normal(400)
        seen = Displacement(t, x, nan, nan, np.full(400, 1e-4), nan, np.ones(400, bool))
        motion = differentiate(low_pass(seen))
        runs.append(Run(seen, motion, mass=1.0, incline=slope, has_incline=True, name=f"r{seed}"))
    found = fit(["coulomb"], runs)
    assert min(len(p.t) for p in found.solution.problem.pieces) > 250
    assert abs(found.parameters["coulomb.F_c"].value - friction) < 4 * found.parameters["coulomb.F_c"].std


@pytest.mark.few(3)
@pytest.mark.parametrize("rest_frames", [5, 12, 60])
@pytest.mark.parametrize("seed", range(4))
def test_a_mass_that_comes_to_rest_at_the_end_of_the_record_does_not_swing(seed: int, rest_frames: int):
    deceleration, v_0, sigma = 9.0 + seed, 1.5, 10e-6
    stop = v_0 / deceleration
    t = np.arange(int(stop * 4000) + rest_frames) / 4000
    moving = np.minimum(t, stop)
    x = v_0 * moving - deceleration * moving**2 / 2
    nan = np.full(len(t), np.nan)
    noisy = x + sigma * np.random.default_rng(seed).standard_normal(len(t))
    seen = Displacement(t, noisy, nan, nan, np.full(len(t), sigma), nan, np.ones(len(t), bool))
    run = Run(seen, differentiate(low_pass(seen)), mass=0.2, name="stops")
    assert not any(slack for _, slack in join_swings(run, moving_sections(run)))
    assert abs(fit(models.of(["coulomb"]), [run]).parameters["coulomb.F_c"].value - 0.2 * deceleration) < 2e-3
