"""A law as a prior for another set-up, held against closed forms: conjugate posterior, coverage, contradictions."""

from __future__ import annotations

import json

import numpy as np
import pytest

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.cli import main
from frictrack.effects import carries_over, get, known
from frictrack.fit import restore, state
from frictrack.flow import Session, open_study
from frictrack.settings.priors import Prior

MASS, F_C, F_V = 0.5, 3.0, 0.8
LAW = ["coulomb", "viscous"]
WIDER = 0.04  # as far as a stated deviation is wider than a known noise would make it


def slide(seed, n=400, sigma=1e-5, *, force=F_C, viscous=F_V, mass=MASS, v0=2.5):
    """Times and positions of a slide under Coulomb and viscous friction, in closed form."""
    t = np.arange(n) / 4000.0
    c, a = viscous / mass, force / mass
    x = (v0 + a / c) * (1 - np.exp(-c * t)) / c - a * t / c
    return t, x + sigma * np.random.default_rng(seed).standard_normal(n)


def run(seed, mass=MASS, **how):
    return ft.Run.from_arrays(*slide(seed, mass=mass, **how), mass=mass, name="r")


@pytest.fixture(scope="module")
def prior():
    """The law of set-up A, from one good run."""
    return ft.fit(LAW, [run(1)]).to_prior("A")


# --- the prior file


def test_a_prior_file_holds_the_prior(prior, tmp_path):
    read = Prior.read(prior.save(tmp_path / "a.prior.toml"))
    assert (read.names, read.units, read.loaded, read.study) == (prior.names, prior.units, (True, False), "A")
    np.testing.assert_allclose(read.covariance, prior.covariance, rtol=1e-9)
    assert read.load == pytest.approx(MASS * 9.80665)


def test_the_covariance_is_that_of_the_fit(prior):
    fit = ft.fit(LAW, [run(1)])
    np.testing.assert_allclose(prior.std, [fit.parameters[n].std for n in prior.names], rtol=1e-4)
    np.testing.assert_allclose(prior.correlation[0, 1], fit.estimates.correlations[0][2], atol=1e-3)


def test_values_and_covariance_scale_with_the_load(prior):
    other = prior.at_load(2 * prior.load)
    np.testing.assert_allclose(other.values, [2 * prior.values[0], prior.values[1]])
    np.testing.assert_allclose(other.std, [2 * prior.std[0], prior.std[1]])
    np.testing.assert_allclose(other.correlation, prior.correlation, atol=1e-12)
    with pytest.raises(FrictrackError, match="expected a known normal load"):
        prior.at_load(None)


def test_the_rule_takes_the_pair_and_leaves_the_set_up():
    carried = {e: [p.name for p in get(e).parameters if carries_over(get(e), p)] for e in (*known(), "atm2:2")}
    assert {e: names for e, names in carried.items() if names} == {
        "coulomb": ["F_c"],
        "stribeck": ["F_s", "v_s", "delta"],
        "viscous": ["F_v"],
        "drag": ["c"],
        "asymmetry": ["dF", "dF_v"],
        "presliding": ["stiffness", "exponent"],
        "friction_lag": ["tau"],
        "lugre": ["F_c", "sigma_1", "sigma_0", "F_s", "v_s", "delta"],
        "flash_weakening": ["dF", "v_w"],
        "log_velocity": ["a", "v_0"],
        "power_law_viscosity": ["c", "n"],
        "elasto_plastic": ["stiffness", "share"],
        "maxwell_slip": ["stiffness", "spread"],
        "rate_state_ageing": ["F_0", "A", "B", "D_c", "v_0"],
        "rate_state_slip": ["F_0", "A", "B", "D_c", "v_0"],
        "eddy_brake": ["c", "v_0"],
        "hydrodynamic_hump": ["F", "v_s"],
        "atm2:2": ["f_c", "f_s", "f_v", "v_s"],
    }


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("format = 1", "format = 7", "expected format of prior as 1 but got 7"),
        ("std = ", "std = -", "expected std of number 1 of parameter as a number above 0"),
        ('unit = "N"', "unit = 3", "expected unit of number 1 of parameter as a text in quotes but got 3"),
        ('scales_with = "load"', 'scales_with = "moon"', 'as "nothing" or "load" but got "moon"'),
        ('"coulomb.F_c" = -0.9', '"coulomb.F_c" = -1.9', "expected coulomb.F_c of correlation of number 2"),
        ('"coulomb.F_c" = -0.9', '"coulomb.x" = -0.9', "expected correlations of viscous.F_v with parameters above it"),
        ('name = "viscous.F_v"', 'name = "coulomb.F_c"', "expected every parameter once"),
        (
            'name = "viscous.F_v"',
            'name = "../x"',
            "expected name of number 2 of parameter as a name of letters and digits",
        ),
        ("load = ", "lode = ", 'unknown key "lode" in prior'),
        ("[[parameter]]", "[[parameter", "is not valid TOML"),
        ("value = ", "value = nan #", "expected value of number 1 of parameter as a finite number"),
    ],
)
def test_a_damaged_prior_file_is_refused_in_one_sentence(prior, tmp_path, old, new, said):
    text = prior.to_toml()
    assert old in text
    (tmp_path / "a.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(FrictrackError) as caught:
        Prior.read(tmp_path / "a.toml")
    assert str(caught.value).startswith("a.toml")
    assert said in str(caught.value)


def test_bytes_that_are_no_prior_are_refused(tmp_path):
    for content in (b"\xff\xfe\x00", b"", b"x = 1", b"[prior]\nformat = 1\n", b"a" * 300_000):
        (tmp_path / "a.toml").write_bytes(content)
        with pytest.raises(FrictrackError):
            Prior.read(tmp_path / "a.toml")
    with pytest.raises(FrictrackError, match="cannot read it"):
        Prior.read(tmp_path / "b.toml")


def test_correlations_that_cannot_hold_together_are_refused():
    covariance = ((1.0, 0.9, 0.9), (0.9, 1.0, -0.9), (0.9, -0.9, 1.0))
    with pytest.raises(FrictrackError, match="positive definite"):
        Prior(("a.x", "a.y", "a.z"), (1.0, 1.0, 1.0), covariance, ("N",) * 3, (False,) * 3)


def test_widening_keeps_the_means(prior):
    wide = prior.inflated(scale=2.0, scatter=0.1)
    expected = 4 * np.array(prior.covariance) + np.diag((0.1 * np.array(prior.values)) ** 2)
    np.testing.assert_allclose(wide.covariance, expected)
    assert wide.values == prior.values
    with pytest.raises(FrictrackError, match="prior_scale above 0"):
        prior.inflated(scale=0.0)


# --- the fit


def conjugate(fit, prior):
    """The posterior of a normal prior and normal data, and their disagreement."""
    alone = fit.to_prior()
    d, m, D, C = (np.array(q) for q in (alone.values, prior.values, alone.covariance, prior.covariance))
    V = np.linalg.inv(np.linalg.inv(D) + np.linalg.inv(C))
    return (
        V @ (np.linalg.solve(D, d) + np.linalg.solve(C, m)),
        np.sqrt(np.diag(V)),
        (d - m) @ np.linalg.solve(C + D, d - m),
    )


@pytest.mark.parametrize("n", [250, 400, 800])
def test_the_fit_with_a_prior_is_the_conjugate_posterior(prior, n):
    data = [run(7, n=n)]
    value, std, disagreement = conjugate(ft.fit(LAW, data), prior)
    found = ft.fit(LAW, data, prior=prior)
    estimates = [found.parameters[name] for name in prior.names]
    assert np.all(np.abs([e.value for e in estimates] - value) < 0.02 * std)
    np.testing.assert_allclose([e.std for e in estimates], std, rtol=WIDER)
    if found.prior_agreement.dof == 2:
        assert found.prior_agreement.chi2 == pytest.approx(disagreement, rel=0.05, abs=0.02)


def test_what_the_data_say_alone_and_what_comes_from_the_prior(prior):
    data = [run(8, n=800)]
    alone, found = ft.fit(LAW, data), ft.fit(LAW, data, prior=prior)
    for name, one in found.prior_agreement.parameters.items():
        before, after = alone.parameters[name], found.parameters[name]
        assert one.data == pytest.approx(before.value, abs=0.05 * before.std)
        assert one.data_std == pytest.approx(before.std, rel=0.05)
        share = found.summary()["parameters"][name]["from_prior"]
        assert share == pytest.approx(1 - (after.std / before.std) ** 2, abs=0.05)


def test_only_the_parameters_of_the_law_are_shared_between_correlated_priors(prior):
    """Without the correlation the same marginal deviations would know the force at speed far worse."""
    marginal = Prior(prior.names, prior.values, tuple(map(tuple, np.diag(np.diag(prior.covariance)))), prior.units,
                     prior.loaded, prior.load)  # fmt: skip
    short = [run(9, n=60, sigma=5e-5)]
    direction = np.array([1.0, 2.5])  # the force at 2.5 m/s

    def spread(known):
        return direction @ np.array(ft.fit(LAW, short, prior=known).to_prior().covariance) @ direction

    assert spread(prior) < 0.2 * spread(marginal)


@pytest.mark.slow
def test_transfer_to_a_poor_record_reduces_the_error_and_its_intervals_cover(prior):
    errors, inside, n = [], 0, 60
    for seed in range(n):
        known = ft.fit(LAW, [run(1000 + seed)]).to_prior()  # another run of A each time
        poor = [run(2000 + seed, n=120, sigma=2e-5, mass=2 * MASS, force=2 * F_C)]
        alone, found = ft.fit(LAW, poor), ft.fit(LAW, poor, prior=known)
        e = found.parameters["coulomb.F_c"]
        errors.append((alone.parameters["coulomb.F_c"].value - 2 * F_C, e.value - 2 * F_C))
        inside += abs(e.value - 2 * F_C) < 1.96 * e.std
    before, after = np.sqrt(np.mean(np.square(errors), axis=0))
    assert after < 0.1 * before
    assert inside >= 0.95 * n - 2.6 * np.sqrt(0.95 * 0.05 * n)


@pytest.mark.slow
def test_p_of_a_true_prior_is_uniform(prior):
    p = [ft.fit(LAW, [run(3000 + i, n=600)], prior=ft.fit(LAW, [run(4000 + i)]).to_prior()).prior_agreement.p
         for i in range(60)]  # fmt: skip
    assert np.mean(p) == pytest.approx(0.5, abs=3.5 / np.sqrt(12 * len(p)))
    assert np.mean(np.array(p) < 0.1) < 0.25


def test_a_contradicted_prior_is_reported(prior):
    found = ft.fit(LAW, [run(5, n=800, force=1.2 * F_C)], prior=prior)
    assert found.prior_agreement.contradicted
    said = [line for line in found.summary()["remarks"] if "contradict the prior" in line]
    assert len(said) == 1
    assert "coulomb.F_c 3." in said[0]
    assert "N against 2.99" in said[0]
    assert "prior_scale" in said[0]
    wide = ft.fit(LAW, [run(5, n=800, force=1.2 * F_C)], prior=prior.inflated(scatter=0.3))
    assert not wide.prior_agreement.contradicted
    assert wide.parameters["coulomb.F_c"].value == pytest.approx(1.2 * F_C, abs=4 * wide.parameters["coulomb.F_c"].std)


def test_a_fit_with_a_prior_is_restored(prior):
    data = [run(6, n=300)]
    found = ft.fit(LAW, data, prior=prior)
    again = restore(data, state(found))
    assert again.summary()["prior"]["p"] == pytest.approx(found.summary()["prior"]["p"], rel=1e-6)
    assert "prior" not in ft.fit(LAW, data).summary()


def test_settings_of_the_new_study_win_and_other_parameters_wait(prior):
    fixed = ft.models.of(["coulomb", get("viscous").adjusted(F_v={"fixed": 0.7})])
    agreement = ft.fit(fixed, [run(6)], prior=prior).prior_agreement
    assert list(agreement.parameters) == ["coulomb.F_c"]
    with pytest.raises(FrictrackError, match="expected a model with a free parameter of the prior"):
        ft.fit("drag", [run(6)], prior=prior)
    with pytest.raises(FrictrackError, match='expected domain = "displacement" with a prior'):
        ft.fit(LAW, [run(6)], prior=prior, domain="force")


def test_a_load_cell_takes_a_prior_in_the_same_way():
    def cell(seed, load, mu=0.3, n=1500):
        t = np.arange(n) / 1000.0
        x = 0.01 * np.sin(2 * np.pi * t)
        noise = 0.05 * np.random.default_rng(seed).standard_normal(n)
        force = mu * load * np.sign(np.cos(2 * np.pi * t)) + noise
        return ft.Run.from_arrays(t, x, friction=force, normal_load=load, name="r")

    known = ft.fit("coulomb", [cell(1, 10.0)]).to_prior()
    assert known.load == 10.0
    data = [cell(2, 20.0, n=700)]
    value, std, _ = conjugate(ft.fit("coulomb", data), known.at_load(20.0))
    found = ft.fit("coulomb", data, prior=known).parameters["coulomb.F_c"]
    assert found.value == pytest.approx(value[0], abs=0.05 * std[0])
    assert found.std == pytest.approx(std[0], rel=0.05)


def test_the_error_of_scale_and_mass_is_in_the_prior():
    t, x = slide(1)
    known = [ft.fit(LAW, [ft.Run.from_arrays(t, x, mass=mass)]).to_prior() for mass in ("0.5 kg", "0.5 +/- 0.01 kg")]
    assert known[1].std[0] == pytest.approx(known[0].std[0], rel=1e-6)  # cancels in a value per load
    added = known[1].std[1] ** 2 - known[0].std[1] ** 2
    assert np.sqrt(added) == pytest.approx(0.02 * known[0].values[1], rel=1e-3)


# --- study file and command line


def write_study(folder, prior="", **how):
    folder.mkdir(exist_ok=True)
    np.savetxt(folder / "r.csv", np.column_stack(slide(**how)), delimiter=",", header="t_s,x_m", comments="")
    text = f'[study]\nmass = {MASS}\nmodel = ["coulomb", "viscous"]\n{prior}[[run]]\ntable = "r.csv"\n'
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def test_the_command_writes_the_file_and_says_what_is_in_it(tmp_path, capsys):
    a = write_study(tmp_path / "a", seed=1)
    with pytest.raises(SystemExit, match="0"):
        main(["export", str(a), "--to", "prior", "-o", str(tmp_path / "x.toml"), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["file"] == str(tmp_path / "x.toml")
    assert result["parameters"]["coulomb.F_c"]["scales_with"] == "load"
    assert Prior.read(result["file"]).study == "a"
    with pytest.raises(SystemExit, match="2"):
        main(["export", str(a), "-o", "x.toml"])


def test_a_law_goes_from_one_study_to_the_next(tmp_path):
    a, file = write_study(tmp_path / "a", seed=1), tmp_path / "b" / "a.prior.toml"
    b = write_study(tmp_path / "b", 'prior = "a.prior.toml"\n', seed=2, n=150, sigma=2e-5)
    exported = Session(open_study(a)).export_prior(file)
    assert set(exported["parameters"]) == {"coulomb.F_c", "viscous.F_v"}
    session = Session(open_study(b))
    first = session.fit()
    group, key = session.models.current_group, session.models.fit_key(session.models.current()[1])
    assert not session.models.is_outdated(group)
    with pytest.raises(FrictrackError, match='expected domain = "displacement" with a prior'):
        session.fit(domain="force")
    assert first["parameters"]["coulomb.F_c"]["from_prior"] > 0.9
    assert first["prior"]["parameters"]["coulomb.F_c"]["mean"] == exported["parameters"]["coulomb.F_c"]["value"]
    Prior.read(file).inflated(scale=3.0).save(file)
    session = Session(open_study(b))
    assert session.models.is_outdated(group)
    second = session.fit()
    assert session.models.fit_key(session.models.current()[1]) != key
    assert second["parameters"]["coulomb.F_c"]["std"] > 2 * first["parameters"]["coulomb.F_c"]["std"]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ('prior = "b.toml"\n', 'expected a file "b.toml" but there is none'),
        ('prior = "r.csv"\n', "r.csv"),
        ("prior_scale = 2\n", "expected prior = a file beside prior_scale"),
        ('prior = "a.toml"\nprior_scale = 0\n', "expected prior_scale above 0"),
        ('prior = "a.toml"\nprior_scatter = -0.1\n', 'expected prior_scatter as a number of at least 0, or "10 %"'),
    ],
)
def test_a_wrong_prior_is_told_before_work_begins(prior, tmp_path, keys, said):
    path = write_study(tmp_path / "a", keys, seed=1)
    prior.save(path.parent / "a.toml")
    with pytest.raises(FrictrackError) as caught:
        open_study(path)
    assert said in str(caught.value)


def test_a_prior_needs_a_known_mass(prior, tmp_path):
    path = write_study(tmp_path / "a", 'prior = "a.toml"\n', seed=1)
    prior.save(path.parent / "a.toml")
    path.write_text(path.read_text().replace(f"mass = {MASS}", 'mass = "fit"') + "drive = 2.0\n")
    with pytest.raises(FrictrackError, match='expected a known mass with a prior but got mass = "fit"'):
        open_study(path)


def test_the_keys_of_a_prior_widen_it(prior, tmp_path):
    path = write_study(tmp_path / "a", 'prior = "a.toml"\nprior_scale = 2\nprior_scatter = "10 %"\n', seed=1)
    prior.save(path.parent / "a.toml")
    np.testing.assert_allclose(open_study(path).prior.covariance, prior.inflated(2.0, 0.1).covariance, rtol=1e-9)
