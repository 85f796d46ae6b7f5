"""Uncertainty: profiles and bootstrap held against closed forms, brute force and repeated measurements; the words."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from repeats import few_or_many
from runs import MASS, SIX, Spec, measured, study
from scipy.fft import idct
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import t as student
from typer.testing import CliRunner

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.cli import study_commands  # noqa: F401 - registers the commands
from frictrack.cli.common import app
from frictrack.effects import models
from frictrack.fit import analyse_uncertainty, fit, with_uncertainty
from frictrack.fit.uncertainty import merge_uncertainty
from frictrack.fit.uncertainty.profile_likelihood import FixedQuantityProblem, ProfileSearch
from frictrack.fit.uncertainty.reported import parse_quantity
from frictrack.present import plots
from frictrack.present.report import tables, texts
from frictrack.results import ModelResults

Z = 1.959964
TRUTH = {"coulomb.F_c": 8.0, "stribeck.F_s": 14.0, "stribeck.v_s": 0.4, "viscous.F_v": 1.2}
ONE_SLIDE = (Spec(4.0),)
NEVER_SLOW = (Spec(5.0, 1, 0.05),)


def slide(seed=0, *, F_c=8.0, F_v=0.0, sigma=2e-5, n=300, name="run", noise=None):
    """A run under Coulomb and viscous friction alone, in closed form, all of it free."""
    t = np.arange(n) / 4000.0
    rng = np.random.default_rng(seed)
    v0, c, k = 4.0, F_c / MASS, F_v / MASS
    x = v0 * t - c * t**2 / 2 if k == 0 else (v0 + c / k) * (1 - np.exp(-k * t)) / k - c / k * t
    y = x if noise is None else x + noise(rng, n)
    run = measured(t, y, sigma=sigma if noise is None else 0.0, name=name, rng=rng)
    return replace(run, free=(0.0, float(t[-1])))


def frames(result):
    """Times, displacements and noise that a fit was given, in one piece."""
    (piece,) = result.solution.problem.pieces
    return piece.t, piece.y, piece.sigma


def left(columns, y, sigma):
    """Chi-squared that a least-squares fit of columns leaves."""
    a, b = np.column_stack(columns) / sigma[:, None], y / sigma
    return float(np.sum((b - a @ np.linalg.lstsq(a, b, rcond=None)[0]) ** 2))


# ---------------------------------------------------------------- profiles


def test_a_linear_law_has_the_interval_of_its_standard_deviation():
    fitted = fit("coulomb", [slide()])
    t, _, sigma = frames(fitted)
    columns = np.column_stack([np.ones_like(t), t, -(t**2) / 2 / MASS]) / sigma[:, None]
    std = np.sqrt(np.linalg.inv(columns.T @ columns)[2, 2])  # ordinary least squares: place, speed, F_c
    std *= student.ppf(0.975, len(t) / 2.91) / Z  # the noise is estimated too, from fifth differences
    found = ft.profile(fitted, "coulomb.F_c")
    estimate = fitted.parameters["coulomb.F_c"]
    assert estimate.std == pytest.approx(std, rel=1e-4)
    assert found.low == pytest.approx(estimate.value - Z * std, abs=2e-3 * std)
    assert found.high == pytest.approx(estimate.value + Z * std, abs=2e-3 * std)
    assert found.refinements <= 30


@pytest.mark.parametrize(("level", "z"), [(0.6827, 1.0), (0.99, 2.5758)])
def test_a_level_is_obeyed(level, z):
    fitted = fit("coulomb", [slide()])
    found = ft.profile(fitted, "coulomb.F_c", level=level)
    std = fitted.parameters["coulomb.F_c"].std
    assert (found.high - found.low) / 2 == pytest.approx(z * std, rel=3e-3)


def unsteady(rng, n, rms=2e-5):
    """White noise and errors as large in every octave, both of the same rms."""
    k = np.arange(1, n // 4)
    size = np.zeros(n)
    size[k] = np.sqrt(n / np.sum(1 / k) / k)
    return rms * (idct(size * rng.standard_normal(n), norm="ortho") + rng.standard_normal(n))


@pytest.mark.few(1)
@pytest.mark.parametrize(("repeats", "room"), few_or_many((8, 0.5), (60, 0.25)))
@pytest.mark.parametrize("told", [True, False])
def test_what_a_tracker_is_off_by_slowly_is_in_the_deviations(told, repeats, room):
    z = []
    for seed in range(repeats):
        run = slide(seed, noise=unsteady)
        if told:
            run = replace(run, displacement=replace(run.displacement, systematic=2e-5))
        found = fit(["coulomb"], [run]).parameters["coulomb.F_c"]
        z.append((found.value - 8.0) / found.std)
    if told:
        assert np.std(z) == pytest.approx(1.0, abs=room)
    else:
        assert np.std(z) > 2


def test_a_curved_profile_is_the_brute_force_one():
    # x = a + b (1 - exp(-k t))/k + c t with c = -F_c/F_v: linear beside k = F_v/m, so chi-squared(k) is a closed form
    fitted = fit("coulomb,viscous", [slide(2, F_c=6.0, F_v=2.0, sigma=3e-4)])
    t, y, sigma = frames(fitted)

    def chi2(F_v):
        k = F_v / MASS
        return left([np.ones_like(t), -np.expm1(-k * t) / k, t], y, sigma)

    best = minimize_scalar(chi2, bounds=(0.2, 6.0), method="bounded", options={"xatol": 1e-9})
    limit = student.ppf(0.975, len(t) / 2.91) ** 2
    low, high = (
        brentq(lambda F: chi2(F) - best.fun - limit, *ends) for ends in ((best.x - 4.0, best.x), (best.x, best.x + 4.0))
    )
    found = ft.profile(fitted, "viscous.F_v")
    assert found.value == pytest.approx(best.x, abs=1e-3)
    assert found.low == pytest.approx(low, abs=5e-3 * (high - low))
    assert found.high == pytest.approx(high, abs=5e-3 * (high - low))
    brute = np.array([chi2(v) - best.fun for v in found.values])
    assert found.rise == pytest.approx(brute * Z**2 / limit, abs=0.02)


def test_what_is_quoted_is_profiled_whichever_unknown_follows(monkeypatch):
    runs, _ = study(specs=ONE_SLIDE, sigma=5e-5)
    fitted = fit("tustin", runs)
    found = ft.profile(fitted, "stribeck.F_s")
    layout = fitted.solution.problem.layout
    for slot in (layout.index("stribeck", "F_s"), layout.index("coulomb", "F_c")):
        monkeypatch.setattr(
            sys.modules["frictrack.fit.uncertainty.profile_likelihood"], "pivot_of", lambda *_, slot=slot: slot
        )
        walk = ProfileSearch(
            fitted.solution, parse_quantity(layout, "stribeck.F_s"), fitted.estimates.covariance
        ).profile()
        assert (walk.low, walk.high) == pytest.approx((found.low, found.high), rel=3e-3)
    assert found.value == pytest.approx(fitted.parameters["stribeck.F_s"].value)
    # curved: longer above than below
    assert found.high - found.value > 1.1 * (found.value - found.low)


def test_a_length_quoted_as_a_ratio_is_the_brute_force_one():
    # a spring alone: x = -x_0 + A cos(w t) + B sin(w t)
    t = np.arange(260) / 4000.0
    w = np.sqrt(60.0 / MASS)
    run = measured(t, -0.3 + 0.3 * np.cos(w * t) + 6.0 / w * np.sin(w * t), sigma=1e-4)
    run = replace(run, free=(0.0, 0.06))
    fitted = fit("spring", [run])
    s, y, sigma = frames(fitted)

    def chi2(x_0):
        def at(k):
            w = np.sqrt(k / MASS)
            return left([np.cos(w * s), np.sin(w * s)], y + x_0, sigma)

        return minimize_scalar(at, bounds=(1.0, 300.0), method="bounded", options={"xatol": 1e-6}).fun

    found = ft.profile(fitted, "spring.x_0")
    least = chi2(found.value)
    assert [chi2(found.low) - least, chi2(found.high) - least] == pytest.approx([Z**2, Z**2], rel=0.03)


@pytest.mark.slow
def test_a_scattering_level_counts_as_its_standard_deviation_has_it():
    runs, _ = study(specs=SIX[:5], sigma=1e-5, scatter=0.03, rng=np.random.default_rng(4))
    fitted = fit("tustin", runs)
    for name in ("coulomb.F_c", "viscous.F_v"):
        found, estimate = ft.profile(fitted, name), fitted.parameters[name]
        ends = estimate.value - Z * estimate.std, estimate.value + Z * estimate.std
        assert (found.low, found.high) == pytest.approx(ends, abs=0.2 * estimate.std)


def test_profiles_of_a_law_that_nothing_bounds_do_not_crash():
    runs, _ = study(specs=NEVER_SLOW, sigma=5e-5, rng=np.random.default_rng(1))
    fitted = fit("tustin", runs)
    found = {name: ft.profile(fitted, name) for name in (*TRUTH, "stribeck.F_s - coulomb.F_c")}
    speed, rise = found["stribeck.v_s"], found["stribeck.F_s - coulomb.F_c"]
    assert (speed.low, speed.high) == (None, None)
    assert "misfit rises by" in speed.why_low
    assert rise.low is None
    assert "up to its bound 0 N" in rise.why_low
    for profile in found.values():
        assert np.all(np.diff(profile.values) > 0)
        assert np.all(profile.rise >= 0)
        json.dumps(profile.summary(), allow_nan=False)


def test_the_force_domain_has_profiles_of_its_own_deviations():
    runs, _ = study(specs=ONE_SLIDE, sigma=1e-5)
    fitted = fit("tustin", runs, domain="force")
    found, estimate = ft.profile(fitted, "viscous.F_v"), fitted.parameters["viscous.F_v"]
    assert (found.high - found.low) / 2 == pytest.approx(Z * estimate.std, rel=0.1)


@pytest.mark.parametrize(
    ("address", "level", "said"),
    [
        ("coulomb.F", 0.95, r"expected a free parameter of the law \(coulomb.F_c, .*\) but got coulomb.F"),
        ("stribeck.delta", 0.95, r"expected a free parameter of the law .* which is fixed"),
        ("coulomb.F_c", 95.0, "expected a level between 0 and 1, such as 0.95, but got 95"),
    ],
)
def test_what_cannot_be_profiled_is_refused(address, level, said):
    runs, _ = study(specs=ONE_SLIDE, sigma=1e-5)
    with pytest.raises(FrictrackError, match=said):
        ft.profile(fit("tustin", runs), address, level=level)


def test_a_pivot_keeps_off_its_bounds_and_a_law_outside_is_refused():
    runs, _ = study(specs=ONE_SLIDE, sigma=5e-5)
    fitted = fit("tustin", runs)
    layout = fitted.solution.problem.layout
    asked = parse_quantity(layout, "stribeck.F_s")
    inside = FixedQuantityProblem(fitted.solution.problem, asked, 15.0, layout.index("coulomb", "F_c"))
    law = inside.law(fitted.solution.p)
    assert law[layout.index("coulomb", "F_c")] + law[layout.index("stribeck", "F_s")] == pytest.approx(15.0)
    outside = FixedQuantityProblem(fitted.solution.problem, asked, 1.0, layout.index("coulomb", "F_c"))
    with pytest.raises(FrictrackError, match=r"no law within the bounds has stribeck\.F_s = 1"):
        outside.law(fitted.solution.p)


# ---------------------------------------------------------------- bootstrap


def test_draws_scatter_as_a_linear_law_must():
    fitted = fit("coulomb", [slide()])
    found = ft.bootstrap(fitted, 300, rng=1)
    estimate = fitted.parameters["coulomb.F_c"]
    assert found.std["coulomb.F_c"] == pytest.approx(estimate.std, rel=0.15)  # 300 draws: 4 %
    assert abs(found.bias["coulomb.F_c"]) < 4 * estimate.std / np.sqrt(300)
    for low, high in (found.intervals["coulomb.F_c"], found.percentiles["coulomb.F_c"]):
        assert (low, high) == pytest.approx(
            (estimate.value - Z * estimate.std, estimate.value + Z * estimate.std), abs=0.5 * estimate.std
        )
    assert (found.failed, found.correlated) == (0, [])


def test_draws_belong_to_their_seed():
    fitted = fit("coulomb", [slide()])
    a, b, c = (ft.bootstrap(fitted, 20, rng=seed) for seed in (3, 3, 4))
    assert np.array_equal(a.values, b.values)
    assert not np.array_equal(a.values, c.values)
    again = ft.bootstrap(fitted, 20, rng=np.random.default_rng(3))
    assert np.array_equal(a.values, again.values)


def red(rng, n, rho=0.9, sigma=2e-5):
    """Noise that is alike from frame to frame."""
    e = sigma * np.sqrt(1 - rho**2) * rng.standard_normal(n)
    out = np.zeros(n)
    for i in range(n):
        out[i] = e[i] + (rho * out[i - 1] if i else e[0] / np.sqrt(1 - rho**2) - e[0])
    return out


@pytest.mark.few(1)
@pytest.mark.parametrize(("repeats", "room"), few_or_many((2, 0.9), (20, 0.4)))
def test_correlated_noise_is_found_and_widens_the_deviations(repeats, room):
    fits = []
    for seed in range(repeats):
        runs = [slide(4 * seed + i, n=400, noise=red, name=f"r{i}") for i in range(4)]
        fits.append(fit("coulomb", runs))
    each = [f.parameters["coulomb.F_c"] for f in fits]
    z = [(e.value - 8.0) / e.std for e in each]
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=room)  # 2 to 6 if the noise is taken for white
    assert abs(np.mean(z)) < 2.7 / np.sqrt(repeats)
    noise = np.mean([f.solution.problem.pieces[0].noise[0] for f in fits])
    assert noise == pytest.approx(2e-5, rel=0.2)
    said = [line for line in fits[0].summary()["remarks"] if "not white" in line]
    assert len(said) == 1
    assert "frames" in said[0]


def waves(rng, n):
    """White noise and what a law misses: waves of a few periods, of another size and phase every time."""
    turns = np.outer([1.0, 2.0, 3.0], np.linspace(0.0, 2 * np.pi, n))
    size = 4e-5 * rng.standard_normal((2, 3))
    return size[0] @ np.cos(turns) + size[1] @ np.sin(turns) + 1e-5 * rng.standard_normal(n)


@pytest.mark.few(1)
@pytest.mark.parametrize(("repeats", "drawn"), few_or_many((20, 3), (30, 5)))
def test_a_correlated_residual_is_drawn_in_blocks(repeats, drawn):
    values, told, white = [], [], []
    for seed in range(repeats):
        fitted = fit("coulomb", [slide(seed, noise=waves)])
        values.append(fitted.parameters["coulomb.F_c"].value)
        if seed < drawn:
            found = ft.bootstrap(fitted, 60, rng=seed)
            assert found.correlated == ["run"]
            told.append(found.std["coulomb.F_c"])
            white.append(fitted.parameters["coulomb.F_c"].std)
    truth = np.std(values)
    assert 0.5 < np.mean(told) / truth < 1.5
    assert np.mean(white) < 0.5 * truth  # what white noise would say


@pytest.mark.slow
def test_levels_are_drawn_anew_and_their_scatter_is_found_again():
    runs = [slide(i, F_c=8.0 * level, n=160, name=f"r{i}") for i, level in enumerate((0.95, 1.02, 1.0, 1.06, 0.97))]
    fitted = fit("coulomb", runs)
    found = ft.bootstrap(fitted, 100)
    spread = fitted.solution.tau
    assert np.sqrt(np.mean(found.scatter**2)) == pytest.approx(spread, rel=0.3)
    assert np.std(found.scatter) > 0.2 * spread  # five runs: 35 %
    # a mean of five levels scatters by tau/sqrt(5)
    assert found.std["coulomb.F_c"] == pytest.approx(8.0 * spread / np.sqrt(5), rel=0.25)
    low, high = found.intervals["coulomb.F_c"]
    assert (high - low) / 2 > 2.2 * found.std["coulomb.F_c"]  # Student's t with 4 degrees has 2.78


def test_failed_draws_are_counted_and_said(monkeypatch):
    fitted = fit("coulomb", [slide()])
    module = sys.modules["frictrack.fit.uncertainty"]
    real, calls = module.fit_with_scatter, iter(range(1000))

    def sometimes(*args, **kwargs):
        if next(calls) % 5 == 0:
            raise FrictrackError("the motion cannot be integrated")
        return real(*args, **kwargs)

    monkeypatch.setattr(module, "fit_with_scatter", sometimes)
    seen = []
    found = ft.bootstrap(fitted, 40, progress=lambda done, total, what: seen.append((done, total, what)))
    assert (len(found.values), found.failed) == (32, 8)
    assert found.reasons == ["the motion cannot be integrated"]
    assert seen[-1] == (40, 40, "draws")
    monkeypatch.setattr(module, "fit_with_scatter", lambda *a, **k: (_ for _ in ()).throw(FrictrackError("no law")))
    with pytest.raises(FrictrackError, match="only 0 of 40 draws gave a law; the first failed because no law"):
        ft.bootstrap(fitted, 40)
    with pytest.raises(FrictrackError, match="expected at least 20 draws for a deviation but got 3"):
        ft.bootstrap(fitted, 3)


# ---------------------------------------------------------------- words


def test_static_friction_is_told_by_its_profile():
    runs, _ = study(specs=ONE_SLIDE, sigma=1e-5)
    told = fit("tustin", runs).parameters
    assert all(told[name].reason is None for name in TRUTH)
    runs, _ = study(specs=NEVER_SLOW, sigma=5e-5, rng=np.random.default_rng(1))
    fitted = fit("tustin", runs)
    for name in ("stribeck.F_s", "stribeck.v_s"):
        told = fitted.parameters[name]
        assert (told.value, told.std) == (None, None)
        assert re.search(r"the slowest speed seen is [\d.]+ m/s: film a run that slows to a stop", told.reason)


def test_a_decay_that_no_run_shows_is_null_with_the_reason():
    model, values = ["coulomb", "viscous", "vibration"], {"coulomb": {"F_c": 8.0}, "viscous": {"F_v": 1.2}}
    values |= {"vibration": {"amplitude": 1.5, "frequency": 41.0, "phase": 0.7}}
    runs, _ = study(models.of(model), values, (Spec(6.0),), sigma=1e-5, rng=np.random.default_rng(5))
    found = fit(["coulomb", "viscous", "decaying_vibration"], runs).parameters
    assert found["decaying_vibration.frequency"].value == pytest.approx(41.0, rel=0.05)
    told = found["decaying_vibration.tau"]
    assert told.value is None
    assert re.search(r"up to its bound [\d.]+ s the misfit rises by [\d.e-]+ only; ", told.reason)


def test_correlated_parameters_are_reported_with_the_run_that_separates_them():
    told = fit("coulomb,viscous,drag", [slide(F_v=1.2, sigma=1e-5)]).estimates.remarks
    assert "coulomb.F_c, viscous.F_v and drag.c are hard to distinguish (correlation up to" in told[0]
    assert "drag is mistaken for viscous friction, wear along the path" in told[0]
    assert "To separate them, film at twice the speed" in told[0]


def test_what_is_absorbed_exactly_is_said():
    found = fit("coulomb,slope", [slide()]).parameters
    for name, other in (("slope.F", "coulomb.F_c"), ("coulomb.F_c", "slope.F")):
        assert found[name].reason.startswith(f"these runs cannot tell it from {other}; film the same course in both")


def test_atm2_as_printed_is_said_to_be_nearly_unidentifiable_by_its_profile():
    values = {
        "atm2:1": {"f_c": 4.0, "f_s": 9.0, "f_v": 1.1, "v_s": 0.4, "sliding_frequency_1": 31.0, "sliding_phase_1": 0.7}
        | {"viscous_frequency_1": 47.0, "viscous_phase_1": 1.2}
    }
    runs, _ = study("atm2:1", values, ONE_SLIDE, sigma=1e-5, rng=np.random.default_rng(1))
    fitted = fit("atm2:1", runs)
    told = fitted.parameters["atm2:1.v_s"]
    assert told.value is None
    assert "misfit rises by" in told.reason
    assert any(
        "nearly unidentifiable from these runs: atm2:1.v_s is not determined" in r for r in fitted.estimates.remarks
    )
    clear, _ = study(specs=SIX, sigma=1e-6)
    assert not any("nearly unidentifiable" in r for r in fit("tustin", clear).estimates.remarks)


# ---------------------------------------------------------------- where a person meets it


@pytest.fixture(scope="module")
def sure():
    runs, _ = study(specs=ONE_SLIDE, sigma=5e-5, rng=np.random.default_rng(3))
    plain = fit("tustin", runs)
    found = analyse_uncertainty(plain, draws=20)
    return plain, found, with_uncertainty(plain, found)


def test_json_gains_intervals_where_they_were_asked_for(sure):
    plain, found, told = sure
    assert all("interval" not in p for p in plain.summary()["parameters"].values())
    summary = told.summary()
    speed = summary["parameters"]["stribeck.v_s"]
    assert list(speed) == ["value", "std", "unit", "at_bound", "reason", "interval"]
    assert speed["interval"] == [summary["profiles"]["stribeck.v_s"][end] for end in ("low", "high")]
    assert summary["bootstrap"]["draws"] == 20
    assert json.loads(json.dumps(merge_uncertainty(plain.summary(), found.summary()))) == json.loads(
        json.dumps(summary)
    )


def test_report_has_a_panel_per_profile_and_the_three_side_by_side(sure):
    *_, told = sure
    model = ModelResults("1_tustin", str(told.model), told.summary(), told.curves, True)
    figure = plots.profiles(model.summary)
    assert figure.get_suptitle() == "Every parameter is bounded on both sides"
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles == list(TRUTH)
    assert re.fullmatch(r"[\d.]+ to [\d.]+ N", figure.axes[0].get_xlabel())
    table = tables.interval_table(model)
    assert table.heads == ("parameter", "value ± std", "95 % by profile", "95 % by bootstrap", "std of the draws")
    assert [str(row[0]) for row in table.rows] == [f"<code>{name}</code>" for name in TRUTH]
    assert texts.bootstrap_sentence(model) == "Bootstrap of 20 draws from the fitted model, with white noise."
    said = texts.mark_addresses("coulomb.F_c and viscous.F_v are hard to distinguish")
    assert said == "<code>coulomb.F_c</code> and <code>viscous.F_v</code> are hard to distinguish"


def test_profiles_of_a_rejected_model_carry_the_wider_deviation_with_its_mark(sure):
    summary = sure[-1].summary()
    wider = {name: {**p, "std_misfit": 3 * (p["std"] or 0.0)} for name, p in summary["parameters"].items()}
    plain, marked = (plots.profiles(summary | more) for more in ({}, {"misfit": {"axis": "x"}, "parameters": wider}))
    assert len(marked.axes[0].lines) == len(plain.axes[0].lines) + 1
    assert not any("†" in text.get_text() for text in plain.legends[0].get_texts())
    assert any("†" in text.get_text() for text in marked.legends[0].get_texts())


def test_an_open_profile_is_drawn_and_said():
    runs, _ = study(specs=NEVER_SLOW, sigma=5e-5, rng=np.random.default_rng(1))
    fitted = fit("tustin", runs)
    summary = with_uncertainty(fitted, analyse_uncertainty(fitted)).summary()
    figure = plots.profiles(summary)
    assert figure.get_suptitle().startswith("Not bounded on both sides: ")
    assert "stribeck.v_s" in figure.get_suptitle()
    assert "any" in [ax.get_xlabel().split(" ")[0] for ax in figure.axes]
    assert summary["parameters"]["stribeck.v_s"]["interval"] == [None, None]


def test_command_line_keeps_profiles_and_draws_beside_the_model(tmp_path):
    run = slide(F_v=1.2)
    table = np.column_stack([run.displacement.t, run.displacement.x])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="t_s,x_m", comments="")
    text = '[study]\nmass = "0.35 kg"\nmodel = ["coulomb", "viscous"]\n[[run]]\nname = "a"\n'
    text += 'table = "a.csv"\nfree = [0.0, 0.0748]\n'
    (tmp_path / "study.toml").write_text(text)

    def told(*flags):
        done = CliRunner().invoke(app, ["fit", str(tmp_path / "study.toml"), "--json", *flags], catch_exceptions=False)
        return json.loads(done.stdout)

    assert "profiles" not in told()
    profiled = told("--profile")
    assert set(profiled["profiles"]) == {"coulomb.F_c", "viscous.F_v"}
    drawn = told("--bootstrap", "20")
    assert drawn["bootstrap"]["draws"] == 20
    assert drawn["profiles"] == profiled["profiles"]  # kept
    assert told()["parameters"]["viscous.F_v"]["interval"] == profiled["parameters"]["viscous.F_v"]["interval"]


# ---------------------------------------------------------------- coverage


def coverage(seeds, *, specs=ONE_SLIDE, sigma=1e-5, scatter=0.0, draws=0):
    """Share of seeds whose 95 % interval holds the truth, by way and address."""
    hits = {}
    for seed in seeds:
        runs, _ = study(specs=specs, sigma=sigma, scatter=scatter, rng=np.random.default_rng(10_000 + seed))
        fitted = fit("tustin", runs)
        drawn = ft.bootstrap(fitted, draws, rng=seed).intervals if draws else {}
        for name, truth in TRUTH.items():
            e, p = fitted.parameters[name], ft.profile(fitted, name)
            hits.setdefault(("std", name), []).append(abs(e.value - truth) < Z * e.std)
            hits.setdefault(("profile", name), []).append(not p.excludes(truth))
            if name in drawn:
                hits.setdefault(("bootstrap", name), []).append(drawn[name][0] <= truth <= drawn[name][1])
    return {key: float(np.mean(held)) for key, held in hits.items()}


@pytest.mark.slow
def test_intervals_cover_the_truth_in_a_few_seeds():
    found = coverage(range(12), sigma=5e-5)
    assert 0.8 <= np.mean(list(found.values())) <= 1.0


@pytest.mark.release
@pytest.mark.slow
@pytest.mark.parametrize(
    ("setting", "seeds", "draws"),
    [
        ({"sigma": 1e-5}, 300, 0),
        ({"sigma": 5e-5}, 300, 0),
        ({"sigma": 5e-5}, 200, 100),
        ({"specs": SIX[:5], "scatter": 0.03}, 300, 0),
        ({"specs": SIX[:5], "scatter": 0.03}, 100, 100),
    ],
    ids=["10 um", "50 um", "50 um drawn", "five runs", "five runs drawn"],
)
def test_stated_intervals_cover_95_percent(setting, seeds, draws):
    found = coverage(range(seeds), draws=draws, **setting)
    room = 3 * np.sqrt(0.95 * 0.05 / seeds)  # of the counting alone
    assert all(0.95 - room <= share <= 0.95 + room for share in found.values()), found
    assert np.mean(list(found.values())) == pytest.approx(0.95, abs=0.02 + room / 3)
