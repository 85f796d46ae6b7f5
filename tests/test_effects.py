"""Every effect of the library keeps one contract, and its formula is the one of the table, written out again."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from itertools import pairwise, product
from types import SimpleNamespace

import numpy as np
import pytest
from runs import (
    BASE,
    EARLIER,
    FACTORS,
    FOUR,
    FPS,
    HIDDEN,
    KNOWN,
    LAWS,
    MASS,
    MOVED,
    PER_RUN_PHASE,
    PITCH,
    REMEMBERED,
    SHIFTS,
    TIMED,
    TOLD,
    Slider,
    Spec,
    angle,
    drive,
    force,
    integrate,
    lift,
    measured,
    picture,
    plain_motion,
    sine,
    study,
    tone,
)  # fmt: skip
from scipy.integrate import quad
from scipy.interpolate import make_interp_spline

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import LIBRARY, Path, Span, models
from frictrack.fit import fit, restore, state
from frictrack.flow import store
from frictrack.flow.store import GroupContent
from frictrack.records import GRAVITY
from frictrack.simulate import Conditions, simulate

SPAN = Span(duration=0.15, x_min=-0.02, x_max=0.6, v_min=0.05, v_max=6.0, fps=4000.0)
ALL = [*LIBRARY.values(), effects.atm2(1), effects.atm2(2)]
ATM2 = {
    **{"f_c": 3.0, "f_s": 9.0, "f_v": 1.0, "v_s": 0.5},
    **{"sliding_frequency_1": 30.0, "sliding_phase_1": 1.0, "viscous_frequency_1": 50.0, "viscous_phase_1": 2.0},
}
SETTINGS = BASE | HIDDEN | TOLD | {"atm2:1": ATM2}
PLAIN = [name for name in LIBRARY if name not in (*REMEMBERED, *TIMED)]
# What carries an effect's columns from run to run (design, section 1): L the load, M the mass, D the drive, - nothing.
SCALING = {
    **{"coulomb": "L", "stribeck": "L", "viscous": "-", "drag": "-", "vibration": "-", "texture": "L", "patch": "L"},
    **{"spring": "--", "collision": "-", "asymmetry": "L-", "slope": "M", "lens": "-", "peak_locking": "-"},
    **{"camera_shake": "-", "atm2:1": "LL-", "atm2:2": "LL-", "decaying_vibration": "-", "thermal": "L", "drift": "L"},
    **{"drive_error": "D", "drive_delay": "D", "drive_offset": "-", "dropped_frame": "-", "timebase": "-"},
    **{"target_rotation": "--"},
    **{"flash_weakening": "L", "log_velocity": "L", "power_law_viscosity": "-", "eddy_brake": "-"},
    **{"hydrodynamic_hump": "L"},
    **{"adhesion": "-", "rolling_shutter": "-", "out_of_plane": "-", "run_in": "L", "heating": "L"},
}


def path_of(n=40, *, s=1.0, load=1.0, mass_ratio=1.0):
    """A motion that begins at rest and reaches every place and time of `SPAN`."""
    t = np.linspace(0, SPAN.duration, n)
    x = np.linspace(SPAN.x_min, SPAN.x_max, n)[:: int(s)]
    known = {"drive": drive(t), "drive_at": drive, "lift": lift(t), "angle": angle(t)}
    known |= {"clamp_x": -0.1, "earlier": (EARLIER,), "mass": MASS, **KNOWN["gravity"]}
    return Path(t, x, s * np.linspace(0, SPAN.v_max, n), np.full(n, s), load, mass_ratio, PITCH, **known)


def values_tried(parameter):
    """A few values of a non-linear parameter: its scan, its bounds, or its fixed value and either side of zero."""
    if parameter.scan is not None:
        grid = parameter.scan(SPAN)
        return grid[[0, len(grid) // 2, -1]]
    if parameter.role == "phase":
        return np.array([-np.pi, 0.3, np.pi])
    return np.array([b for b in (*parameter.bounds, parameter.fixed) if b is not None and np.isfinite(b)])


def settings_tried(effect):
    """Every combination of first, middle and last value of the non-linear parameters, at most 200."""
    names = [p.name for p in effect.nonlinear]
    every = list(product(*(values_tried(p) for p in effect.nonlinear)))
    return [dict(zip(names, point, strict=True)) for point in every[:: max(1, len(every) // 200)]]


def columns(effect, path, nonlinear):
    """The effect's columns; a modifier is given two columns to reshape."""
    if effect.modifies:
        return effect.columns(path, nonlinear, np.column_stack([np.ones_like(path.t), path.x]))
    return effect.columns(path, nonlinear)


@pytest.mark.parametrize("effect", ALL, ids=lambda e: e.name)
def test_columns_are_finite_and_of_the_declared_shape_wherever_a_fit_may_look(effect):
    for s in (1.0, -1.0):
        path = path_of(s=s)
        before = {name: getattr(path, name).copy() for name in ("t", "x", "v", "s")}
        for nonlinear in settings_tried(effect):
            made = columns(effect, path, nonlinear)
            assert made.shape == (len(path.t), 2 if effect.modifies else len(effect.linear))
            assert np.all(np.isfinite(made)), nonlinear
        assert all(np.array_equal(getattr(path, name), value) for name, value in before.items())


@pytest.mark.parametrize("effect", ALL, ids=lambda e: e.name)
def test_an_effect_survives_pickle_and_copy(effect):
    bounded = effect.adjusted(**{p.name: {"bounds": (0.1, 0.9)} for p in effect.parameters})
    for one in (effect, bounded):
        for again in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
            assert [p.bounds for p in again.parameters] == [p.bounds for p in one.parameters]
            nonlinear = settings_tried(effect)[0]
            np.testing.assert_array_equal(columns(again, path_of(), nonlinear), columns(one, path_of(), nonlinear))


@pytest.mark.parametrize("effect", ALL, ids=lambda e: e.name)
def test_an_effect_declares_itself_in_full(effect):
    assert effect.acts_on in ("force", "measurement")
    assert effect.scales_with in ("load", "mass", "drive", "nothing")
    for words in (effect.what, effect.looks_like, effect.mistaken_for, effect.confirm, effect.source):
        assert len(words) > 4
    names = [p.name for p in effect.parameters]
    assert len(set(names)) == len(names) > 0
    for p in effect.parameters:
        assert p.unit
        assert p.bounds[0] < p.bounds[1]
        stem = p.name.split("_")[1] if effect.kind.startswith("atm2") and p.name[-1].isdigit() else p.name
        assert stem in effect.equation
        # A non-linear parameter can be started from: by a scan, at a phase or depth, or it is held.
        assert p.linear or p.scan is not None or p.role in ("phase", "depth") or p.fixed is not None
        if p.fixed is not None:
            assert p.bounds[0] <= p.fixed <= p.bounds[1]


@pytest.mark.parametrize("effect", ALL, ids=lambda e: e.name)
def test_scans_rise_or_fall_within_their_bounds_even_for_very_short_runs(effect):
    short = Span(duration=0.004, x_min=0.1, x_max=0.104, v_min=0.9, v_max=1.0, fps=4000.0)
    for span in (SPAN, short):
        for p in (p for p in effect.nonlinear if p.scan is not None):
            grid = p.scan(span)
            steps = np.diff(grid)
            assert len(grid) >= 2
            assert np.all(steps > 0) or np.all(steps < 0)
            assert np.all((grid >= p.bounds[0]) & (grid <= p.bounds[1]))


SCALED = [e for e in ALL if not e.modifies and e.kind not in ("beam_vibration", "gravity", *REMEMBERED, *TIMED)]


@pytest.mark.parametrize("effect", SCALED, ids=lambda e: e.name)
def test_load_mass_and_drive_scale_what_the_design_says(effect):
    nonlinear = settings_tried(effect)[-1]
    path = path_of()
    plain = effect.columns(path, nonlinear)
    doubled = {"drive": 1.7 * path.drive, "drive_at": lambda t: 1.7 * drive(t)}
    for change, letter in (({"load": 1.7}, "L"), ({"mass_ratio": 1.7}, "M"), (doubled, "D")):
        factor = np.array([1.7 if mark == letter else 1.0 for mark in SCALING[effect.name]])
        np.testing.assert_allclose(effect.columns(replace(path, **change), nonlinear), plain * factor, rtol=1e-12)


def test_the_mass_ratio_of_a_beam_is_quoted_at_the_reference_mass():
    q, beam = TOLD["beam_vibration"], LIBRARY["beam_vibration"]
    twice = beam.columns(path_of(mass_ratio=2.0), q)
    np.testing.assert_allclose(twice, beam.columns(path_of(), q | {"r": 2 * q["r"]}), rtol=1e-12)
    np.testing.assert_allclose(twice, beam.columns(path_of(mass_ratio=2.0, load=3.0), q), rtol=1e-12)


@pytest.mark.parametrize("s", [1.0, -1.0])
@pytest.mark.parametrize("name", [n for n in (*LAWS, *SHIFTS) if n != "beam_vibration"])
def test_formula_is_the_one_of_the_table(name, s):
    effect, q = effects.get(name), SETTINGS[name]
    path = path_of(s=s, load=1.3, mass_ratio=2.0)
    path = path if name == "gravity" else replace(path, curvature=0.0, lowest=np.nan)  # a straight course
    coefficients = np.array([q[p.name] for p in effect.linear])
    made = effect.columns(path, {p.name: q[p.name] for p in effect.nonlinear}) @ coefficients
    slider = Slider(load=1.3, mass_ratio=2.0, pitch=PITCH, slid=np.abs(path.x - path.x[0]))
    if name in SHIFTS:
        truth = SHIFTS[name](q, path.x, path.t, slider)
    else:
        truth = LAWS[name](q, path.x, path.v, path.t, s, slider)
    np.testing.assert_allclose(made, truth, rtol=1e-12, atol=1e-11 * np.max(np.abs(truth)))


def test_atm2_of_order_two_sums_its_sines():
    q = ATM2 | {"sliding_frequency_2": 55.0, "sliding_phase_2": 0.2, "viscous_frequency_2": 8.0, "viscous_phase_2": 1.0}
    path = path_of()
    f_c, f_s, f_v = effects.atm2(2).columns(path, q).T
    s_c = sine(q, "sliding_frequency_1", path.t, "sliding_phase_1")
    s_c += sine(q, "sliding_frequency_2", path.t, "sliding_phase_2")
    s_v = sine(q, "viscous_frequency_1", path.t, "viscous_phase_1")
    s_v += sine(q, "viscous_frequency_2", path.t, "viscous_phase_2")
    hook = np.exp(-path.v / q["v_s"])
    np.testing.assert_allclose(3 * f_c + 9 * f_s + f_v, s_c * 3 + (9 - s_c * 3) * hook + s_v * path.v, rtol=1e-12)


def test_load_modulation_multiplies_what_it_is_given():
    path, q = path_of(), HIDDEN["load_modulation"]
    inner = np.column_stack([path.v, path.x, np.ones_like(path.t)])
    made = LIBRARY["load_modulation"].columns(path, q, inner)
    np.testing.assert_allclose(made, inner * (1 + 0.1 * sine(q, "frequency", path.t))[:, None], rtol=1e-14)


@pytest.mark.parametrize("name", FACTORS)
def test_a_modifier_multiplies_by_the_factor_of_the_table(name):
    path, q = path_of(load=1.3, mass_ratio=2.0), SETTINGS[name]  # twice the mass shows the sign of an exponent
    inner = np.column_stack([path.v, 1 + path.x])
    factor = FACTORS[name](q, path.t, Slider(load=1.3, mass_ratio=2.0)) + 0 * path.t
    np.testing.assert_allclose(LIBRARY[name].columns(path, q, inner), inner * factor[:, None], rtol=1e-12)


@pytest.mark.parametrize(
    "effect", [e for e in ALL if any(p.role == "phase" for p in e.parameters)], ids=lambda e: e.name
)
def test_amplitude_and_phase_are_a_sine_and_a_cosine(effect):
    phases = [p.name for p in effect.parameters if p.role == "phase"]
    q = settings_tried(effect)[len(settings_tried(effect)) // 2]
    path = path_of()

    def at(phase):
        return columns(effect, path, q | dict.fromkeys(phases, phase))

    still = columns(effect, path, q | {"depth": 0.0}) if effect.modifies else at(0.0) / 2 + at(np.pi) / 2
    a, b = 0.6, -1.1
    mixed = a * (at(0.0) - still) + b * (at(np.pi / 2) - still)
    one = np.hypot(a, b) * (at(np.arctan2(b, a)) - still)
    np.testing.assert_allclose(one, mixed, atol=1e-12 * np.max(np.abs(mixed)))


CONTAINING = [(e, name) for e in ALL for name in e.special_cases]


@pytest.mark.parametrize(("effect", "name"), CONTAINING, ids=lambda q: q if isinstance(q, str) else q.name)
def test_an_effect_equals_each_of_its_special_cases(effect, name):
    simple = LIBRARY[name]
    common = settings_tried(simple)[len(settings_tried(simple)) // 2]
    assert len(simple.nonlinear) < len(effect.nonlinear)
    assert (simple.acts_on, simple.scales_with) == (effect.acts_on, effect.scales_with)
    for s in (1.0, -1.0):
        path = path_of(s=s, load=1.3, mass_ratio=2.0)
        made = effect.columns(path, common | effect.special_cases[name])
        np.testing.assert_allclose(made, simple.columns(path, common), rtol=1e-14, atol=1e-15)


def test_dry_friction_keeps_its_side_where_the_velocity_passes_zero():
    v = np.array([-1e-9, 0.0, 1e-9])
    path = Path(np.zeros(3), np.zeros(3), v, np.ones(3))
    np.testing.assert_allclose(LIBRARY["coulomb"].columns(path, {})[:, 0], 1.0)
    np.testing.assert_allclose(LIBRARY["stribeck"].columns(path, {"v_s": 0.1, "delta": 1.0})[:, 0], 1.0, rtol=1e-7)


def test_get_finds_kinds_instances_and_orders():
    assert effects.get("texture") is LIBRARY["texture"]
    second = effects.get("vibration:2")
    assert (second.name, second.kind) == ("vibration:2", "vibration")
    assert [p.name for p in second.parameters] == [p.name for p in LIBRARY["vibration"].parameters]
    assert effects.get("atm2").name == "atm2:2"
    assert len(effects.get("atm2:2").parameters) == 12  # first paper: 12 parameters at order 2
    assert effects.get("atm2:3").kind == "atm2:3"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("textur", 'expected the name of an effect but got "textur"; did you mean "texture"?'),
        ("atm3", 'did you mean "atm2"?'),
        ("zzz", "known are coulomb, stribeck, viscous"),
        ("vibration:x", 'expected a number up to 99 after the colon but got "vibration:x"'),
        ("vibration:0", "expected a number up to 99 after the colon"),
    ],
)
def test_a_wrong_name_is_answered_with_the_nearest_right_one(name, said):
    with pytest.raises(FrictrackError) as caught:
        effects.get(name)
    assert said in str(caught.value)
    assert caught.value.usage


def test_catalogue_lists_every_effect_with_the_keys_of_the_contract():
    entries = effects.catalogue()
    assert [e["name"] for e in entries] == [*LIBRARY, "atm2:2"]
    keys = {"name", "acts_on", "equation", "parameters", "looks_like", "mistaken_for"}
    for entry in entries:
        assert keys <= entry.keys()
        for p in entry["parameters"]:
            assert p.keys() == {"name", "unit", "linear", "bounds", "per_run"}
            assert all(b is None or np.isfinite(b) for b in p["bounds"])


def test_adjusted_changes_only_what_is_named():
    free = LIBRARY["stribeck"].adjusted(delta={"fixed": None})
    assert free.parameter("delta").fixed is None
    assert free.parameter("v_s") == LIBRARY["stribeck"].parameter("v_s")
    assert LIBRARY["stribeck"].parameter("delta").fixed == 1.0


def test_quoted_values_follow_from_the_fitted_ones():
    assert LIBRARY["stribeck"].quote({"F_s": 6.0}, {"coulomb.F_c": 8.0}) == {"F_s": 14.0}
    assert LIBRARY["spring"].quote({"k": 4.0, "x_0": 2.0}, {}) == {"x_0": 0.5}


# ---------------------------------------------------------------- against the simulator and an independent integrator


def test_every_effect_of_the_library_has_a_truth_here_or_among_those_with_memory():
    truths = {*LAWS, *SHIFTS, *MOVED, *FACTORS}
    assert truths >= set(PLAIN)
    assert (BASE | HIDDEN | TOLD).keys() >= set(PLAIN)


def sliding(name, speed, frames=400):
    """Tustin with one effect more: values, what the run tells, slide and the independent one's slider."""
    values = BASE | {name: (BASE | HIDDEN | TOLD)[name]}
    known = KNOWN.get(name, {})
    t, start = np.arange(frames) / FPS, (0.0 if speed > 0 else 0.4, speed)
    slide = simulate(models.of(values), values, Conditions(MASS, pixel_pitch=PITCH, **known), t, start)
    return values, known, slide, Slider(push=known.get("drive", lambda tau: 0.0))


@pytest.mark.few(6)
@pytest.mark.parametrize("speed", [4.0, -4.0, 2.2])
@pytest.mark.parametrize("name", [n for n in TOLD if n not in MOVED])
def test_the_simulator_agrees_with_runge_kutta(name, speed):
    values, _, slide, slider = sliding(name, speed)
    truth = integrate(values, slider, slide.t, (0.0 if speed > 0 else 0.4, speed))
    assert np.max(np.abs(slide.x - truth)) < 1e-11


@pytest.mark.few(24)
@pytest.mark.parametrize("speed", [4.0, -4.0])
@pytest.mark.parametrize("name", PLAIN)
def test_columns_agree_with_the_simulator(name, speed):
    """N and m to 1e-9 of the largest: columns at the frames, the simulator's own, and the law written out again."""
    values, known, slide, _ = sliding(name, speed, 240)
    t, x, v, s = slide.t, slide.x, slide.v, np.sign(speed)
    model, path = models.of(values), Conditions(MASS, pixel_pitch=PITCH, **known).path(x, v, t, s)
    law = force(values, x, v, t, s, Slider(slid=np.abs(x - x[0]), turns=turned(slide, values)))
    close = {"rtol": 0, "atol": 1e-9 * np.max(np.abs(law))}
    np.testing.assert_allclose(slide.F, law, **close)
    np.testing.assert_allclose(model.force(path, values), slide.F, **close)
    push = drive(t) if "drive" in known else 0.0
    np.testing.assert_allclose(MASS * slide.a, push - law, **close)
    shift = picture(values, x, t, v=v) + np.zeros(len(t))
    close = {"rtol": 0, "atol": 1e-9 * max(np.max(np.abs(shift)), 1e-9)}
    np.testing.assert_allclose(slide.shift, shift, **close)
    blocks = model.measurement_columns(path, values)
    np.testing.assert_allclose(sum(b @ model.coefficients(n, values) for n, b in blocks.items()), shift, **close)


def turned(slide, values):
    """Cycles of the beam since release, by Gauss and Kronrod between the frames."""
    if "beam_vibration" not in values:
        return 0.0
    place = make_interp_spline(slide.t, slide.x, k=7)
    parts = [quad(lambda at: tone(values, place(at), Slider()), *ends, epsabs=1e-13)[0] for ends in pairwise(slide.t)]
    return np.concatenate([[0.0], np.cumsum(parts)])


# ---------------------------------------------------------------- fitted and stored


@pytest.mark.few(4)
@pytest.mark.parametrize("name", [n for n in PLAIN if n not in BASE and n not in HIDDEN])
def test_parameters_come_back_and_outlive_the_store(name, tmp_path):
    """Those of the rest of the library do in test_fit; the fit is read back from HDF5 without a search."""
    values = BASE | {name: TOLD[name]}
    runs, _ = study(models.of(values), values, FOUR, sigma=1e-7)
    fitted = fit(list(values), runs)
    truth = {f"{e}.{p}": value for e, q in values.items() for p, value in q.items()}
    truth["stribeck.F_s"] += values["coulomb"]["F_c"]
    assert fitted.reduced_chi2 == pytest.approx(1.0, abs=0.2)
    for address, estimate in fitted.parameters.items():
        plain = address.split("[")[0]
        if plain.endswith("phase") and name in PER_RUN_PHASE:
            continue  # redrawn in every run
        assert estimate.std <= 0.02 * abs(truth[plain]), address
        off = abs(estimate.value - truth[plain])
        assert off <= max(2e-3 * abs(truth[plain]), 5 * estimate.std), (address, estimate, truth[plain])
    store.write(tmp_path / "study.h5", {"state": GroupContent(state(fitted))})
    again = restore(runs, store.read(tmp_path / "study.h5", "state"))
    assert again.parameters.keys() == fitted.parameters.keys()
    for address, estimate in fitted.parameters.items():
        assert again.parameters[address].value == pytest.approx(estimate.value, rel=1e-9), address


# ---------------------------------------------------------------- the way so far


def slow_and_back(n=2000):
    """Place (m) and velocity of a mass that goes out and comes back, at n times."""
    t = np.linspace(0.0, 0.3, n)
    return t, 0.1 + 0.3 * np.sin(2 * np.pi * t / 0.6), 0.3 * 2 * np.pi / 0.6 * np.cos(2 * np.pi * t / 0.6)


def beam_path(rows, **known):
    t, x, v = (q[rows] for q in slow_and_back())
    return Path(t, x, v, np.sign(v), clamp_x=-0.1, earlier=(EARLIER,), **known)


def test_a_beam_rings_on_along_the_way_before_the_path():
    q, beam = TOLD["beam_vibration"], LIBRARY["beam_vibration"]
    whole = beam.columns(beam_path(slice(None)), q)
    cut = slice(700, None)
    before = np.stack(slow_and_back())[:, :700]
    np.testing.assert_allclose(beam.columns(beam_path(cut, before=before), q), whole[cut], atol=1e-10)
    assert np.max(np.abs(beam.columns(beam_path(cut), q) - whole[cut])) > 0.1  # without it the phase is lost


def test_a_bare_beam_is_a_plain_vibration():
    q = TOLD["beam_vibration"] | {"r": 0.0}
    path = beam_path(slice(100, None))
    np.testing.assert_allclose(
        LIBRARY["beam_vibration"].columns(path, q), LIBRARY["vibration"].columns(path, q), atol=1e-11
    )


def test_a_known_length_of_the_beam_is_not_sought():
    length = LIBRARY["beam_vibration"].parameter("beam_length")
    np.testing.assert_array_equal(length.scan(replace(SPAN, clamp_x=-0.1, beam_length=0.9)), [0.9])
    assert length.scan(replace(SPAN, clamp_x=-0.1))[0] == pytest.approx(0.7)  # from the clamp to the farthest place


@pytest.mark.few(6)
@pytest.mark.parametrize("effect", [e for e in ALL if e.nonlinear], ids=lambda e: e.name)
def test_individuals_end_to_end_each_begin_anew(effect):
    """A population's own non-linear values (n,), a depth's (n, 1), one individual after the other."""
    settings = settings_tried(effect)
    settings = [settings[k % len(settings)] for k in (0, len(settings) // 2, -1)]
    known = {"lift": lift, "angle": angle, "drive": drive}
    t = slow_and_back()[0][300:800]
    known = {name: series(t) for name, series in known.items()} | {"drive_at": drive, "pixel_pitch": PITCH}
    one = beam_path(slice(300, 800), before=np.stack(slow_and_back())[:, :300], travelled=0.2, begins=0.1, **known)
    alone = np.concatenate([columns(effect, one, q) for q in settings])
    tiled = {name: np.tile(getattr(one, name), 3) for name in ("t", "x", "v", "s", "lift", "angle", "drive")}
    long = replace(one, starts=(0, 500, 1000), **tiled)
    each = {p.name: np.repeat([q[p.name] for q in settings], 500) for p in effect.nonlinear}
    deep = {p.name: each[p.name][:, None] for p in effect.nonlinear if p.role == "depth"}
    np.testing.assert_allclose(columns(effect, long, each | deep), alone, atol=1e-9 * np.max(np.abs(alone)))


def test_the_distance_slid_is_counted_for_every_individual():
    t, x, v = (np.tile(q, 2) for q in slow_and_back(100))
    path = Path(t, x, v, np.sign(v), starts=(0, 100))
    np.testing.assert_allclose(path.distance, np.abs(x - 0.1))
    further = replace(path, travelled=0.5, begins=0.05)
    np.testing.assert_allclose(further.distance, 0.5 + np.abs(x - 0.05))


def test_friction_wears_on_through_a_reversal():
    """The distance slid does not shrink on the way back: a spring returns the mass."""
    values = {"coulomb": {"F_c": 0.5}, "spring": {"k": 80.0, "x_0": 0.0}, "thermal": {"dF": 0.3, "length": 0.2}}
    t = np.arange(1200) / FPS
    slide = simulate(models.of(values), values, Conditions(MASS), t, (0.0, 2.0))
    assert len(np.unique(np.sign(slide.v))) >= 2
    assert np.max(np.abs(slide.x - integrate(values, Slider(), t, (0.0, 2.0)))) < 1e-10
    slid = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(slide.x)))])
    moving = np.abs(slide.v) > 0.01
    truth = 80.0 * slide.x + np.sign(slide.v) * (0.5 - 0.3 * (1 - np.exp(-slid / 0.2)))
    np.testing.assert_allclose(slide.F[moving], truth[moving], atol=1e-4)  # the turn lies between two frames


# ---------------------------------------------------------------- what a run must tell


def test_contact_is_lost_where_the_mass_falls_faster_than_gravity():
    path = replace(path_of(), lift=np.linspace(-2.0, 1.0, 40) * GRAVITY)
    made = LIBRARY["measured_load"].columns(path, {"coefficient": 1.0}, np.full((40, 1), 3.0))[:, 0]
    np.testing.assert_allclose(made, 3.0 * np.maximum(np.linspace(-1.0, 2.0, 40), 0.0), atol=1e-12)
    inclined = replace(path, gravity=GRAVITY / 2)
    assert LIBRARY["measured_load"].columns(inclined, {"coefficient": 1.0}, np.ones((40, 1)))[-1, 0] == 3.0


def test_the_load_is_measured_by_the_vertical_motion_of_the_film():
    """y is low-passed and differentiated as everywhere; up is positive."""
    values = BASE | {"measured_load": {"coefficient": 1.0}}
    made = []
    for i, speed in enumerate((3.0, 5.0, -4.0)):
        t = np.arange(480) / FPS
        slide = simulate(models.of(values), values, Conditions(MASS, lift=lift), t, (0.0, speed))
        rng = np.random.default_rng(i)
        run = measured(t, slide.x, sigma=2e-6, name=f"r{i}", rng=rng)
        y = -lift(t) / (2 * np.pi * 33.0) ** 2 + 2e-6 * rng.standard_normal(len(t))
        seen = replace(run.displacement, y=y, sigma_y=np.full(len(t), 2e-6))
        made.append(replace(run, displacement=seen, motion=plain_motion(seen)))
    found = fit([*BASE, "measured_load"], made)
    assert found.parameters["measured_load.coefficient"].value == pytest.approx(1.0, abs=0.03)
    assert found.reduced_chi2 < 1.5  # what noise of y is left in y'' is no friction


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("peak_locking", "peak_locking needs the pixel pitch of every run; give scale in [camera]"),
        ("drive_error", 'drive_error needs a measured drive of every run; give drive = "drive.csv"'),
        ("measured_load", "measured_load needs the vertical motion of every run; give a film, or a table with a"),
        ("target_rotation", "target_rotation needs the angle of the target of every run; give a film"),
        ("gravity", 'gravity needs a circle that stands upright of every run; give incline = "0 deg"'),
        ("beam_vibration", 'beam_vibration needs the place of the clamp of every run; give clamp_x = "20 mm"'),
    ],
)
def test_an_effect_says_what_its_runs_lack(name, said):
    runs, _ = study(specs=(Spec(4.0), Spec(-4.0)), sigma=1e-5)
    told, _ = study(models.of(BASE | {name: 0}), BASE | {name: SETTINGS[name]}, specs=(Spec(4.0),), sigma=1e-5)
    assert not LIBRARY[name].lacks([p.path for p in fit("coulomb,viscous", told).solution.problem.pieces])
    blind = [*told, replace(runs[1], displacement=replace(runs[1].displacement, pixel_pitch=None))]
    with pytest.raises(FrictrackError) as caught:
        fit(["coulomb", "viscous", name], blind)
    assert said in str(caught.value)


def test_only_those_effects_need_something():
    assert {e.name for e in ALL if e.needs} == {*KNOWN, "peak_locking", "cell_lag", "cell_delay", "cell_drift"}


def test_the_scan_of_a_beam_is_bounded_for_long_runs_and_whole_for_short_ones():
    beam = LIBRARY["beam_vibration"]
    counts = []
    for duration in (0.15, 1.0, 5.0):
        span = replace(SPAN, duration=duration, clamp_x=-0.1)
        counts.append([len(p.scan(span)) for p in beam.nonlinear if p.scan is not None])
    (_, *short), middle, long = counts
    assert short == [13, 3]
    assert np.prod(middle) <= 6000
    assert long[1:] == [4, 2]


def test_beams_that_differ_in_frequency_share_their_way():
    beam, one = LIBRARY["beam_vibration"], path_of()
    n, forms = len(one.t), [(40.0, 0.8, 0.9), (55.0, 0.8, 0.9), (40.0, 0.2, 1.4)]
    names = ("frequency", "r", "beam_length")
    series = {name: np.tile(getattr(one, name), 3) for name in ("t", "x", "v", "s")}
    before = np.stack([[-0.02, -0.01], [-0.03, -0.025], [0.1, 0.2]])
    long = replace(one, **series, before=before, starts=(0, n, 2 * n))
    values = {name: np.repeat([form[k] for form in forms], n) for k, name in enumerate(names)}
    made = beam.columns(long, values | {"phase": 0.3})
    single = replace(one, before=before)
    each = [beam.columns(single, dict(zip(names, form, strict=True)) | {"phase": 0.3}) for form in forms]
    np.testing.assert_allclose(made, np.concatenate(each), atol=1e-11)


@pytest.mark.parametrize(
    ("centre", "said"),
    [(0.20, ""), (0.05, "the course at smaller x"), (0.36, "the course at larger x")],
    ids=["middle", "begin", "end"],
)
def test_a_patch_at_an_end_of_the_course_may_be_a_joint(centre, said):
    values = {"x_c": centre, "w": 0.02}
    fitted = SimpleNamespace(value=values.get, passes=lambda place: "", course=(0.0, 0.4))
    words = LIBRARY["patch"].describe(fitted)
    assert said in words
    assert ("joint" in words) == bool(said)
