"""The Python interface: runs of arrays and DataFrames, printed results, DataFrames, figures, public names."""

from __future__ import annotations

import copy
import pickle
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pandas as pd
import pytest
from few_effects import use_few_effects

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.present import plots

T = np.arange(0, 0.2, 1 / 4000)
F_C, MASS = 2.0, 0.35
X = 3 * T - 0.5 * F_C / MASS * T**2  # a slide under Coulomb friction in closed form


def noisy(x=X, sigma=5e-6, seed=0):
    return x + sigma * np.random.default_rng(seed).standard_normal(len(x))


def test_arrays_give_the_law_that_made_them():
    runs = [ft.Run.from_arrays(T, noisy(seed=i), mass=MASS, name=f"run{i}") for i in range(2)]
    force = ft.fit("coulomb", runs).parameters["coulomb.F_c"]
    assert force.value == pytest.approx(F_C, abs=5 * force.std)
    assert force.std < 1e-3


def test_noise_is_estimated_or_given():
    assert ft.Run.from_arrays(T, noisy(), mass=MASS).displacement.sigma_x == pytest.approx(5e-6, rel=0.1)
    assert np.all(ft.Run.from_arrays(T, noisy(), mass=MASS, sigma=1e-6).displacement.sigma_x == 1e-6)


def test_a_text_with_a_unit_is_taken_wherever_a_number_is() -> None:
    said = {"normal_load": "9.8 N", "incline": "3 deg", "drive": "250 mN", "sigma": "1 um", "free": ("10 ms", "0.02 s")}
    run = ft.Run.from_arrays(T, noisy(), mass="350 g", **said)
    assert (run.normal_load, run.incline, run.free) == (9.8, pytest.approx(np.deg2rad(3)), (0.01, 0.02))
    assert np.all(run.drive == 0.25)
    assert np.all(run.displacement.sigma_x == 1e-6)
    with pytest.raises(FrictrackError, match="normal_load"):
        ft.Run.from_arrays(T, noisy(), mass=MASS, normal_load="9.8 kg")


def test_a_dataframe_in_other_units_is_the_same_run():
    x = noisy()
    frame = pd.DataFrame({"Time (ms)": 1e3 * T, "pos (mm)": -1e3 * x, "remark": "none"})
    run = ft.Run.from_dataframe(frame, mass="350 +/- 1 g", columns={"t": "Time (ms)", "x": "-pos (mm)"})
    np.testing.assert_allclose(run.displacement.x, ft.Run.from_arrays(T, x, mass=MASS).displacement.x, rtol=1e-12)
    assert (run.mass, run.sigma_mass) == (pytest.approx(0.35), pytest.approx(0.001))
    assert list(frame.columns) == ["Time (ms)", "pos (mm)", "remark"]


def test_a_load_cell_needs_no_mass():
    t = np.arange(0, 4, 1e-3)
    x = 0.01 * np.sin(2 * np.pi * t)
    run = ft.Run.from_arrays(t, x, friction=3.0 * np.sign(np.cos(2 * np.pi * t)))
    assert run.mass is None
    assert run.friction_N.shape == t.shape


def test_a_doubled_sample_is_left_out_of_all_columns():
    x = noisy()
    x[300:] = noisy()[299:-1]  # sample 300 repeats sample 299, and all later ones are late
    run = ft.Run.from_arrays(T, x, mass=MASS, drive=np.arange(len(T), dtype=float))
    assert len(run.displacement) == len(run.drive) == len(T) - 1
    assert run.drive[300] == 301.0
    assert "1 sample repeats the one before" in run.displacement.notes[0]


def test_rows_of_arrays_that_another_program_made_are_left_out_with_a_warning():
    x = noisy()
    with pytest.warns(UserWarning, match=r'run "run": the positions lie on straight lines between every 4 rows'):
        run = ft.Run.from_arrays(T, np.interp(T, T[::4], x[::4]), mass=MASS)
    assert len(run.displacement) == len(T[::4])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(x=X[:-1]), "expected x of shape (800,), as t has 800 values, but got (799,)"),
        (dict(x=np.where(T[7] == T, np.nan, X)), "expected finite x but got nan in row 7; leave the row out"),
        (dict(t=T[:0], x=T[:0]), "expected positions at several times but got none"),
        (dict(t=T[::-1]), "expected rising time but got t[1] = 0.1995 s after t[0] = 0.19975 s"),
        (dict(x=["a"] * 800), "expected numbers in x but got list"),
        (dict(sigma=np.ones(3)), "expected sigma of shape (800,), as t has 800 values, but got (3,)"),
        (dict(mass=None), "expected a mass but got none"),
        (dict(mass="350 mm"), "mm"),
        (dict(mass=-1), "expected mass above 0 kg but got -1"),
        (dict(mass="1e-310 kg"), "expected mass as a quantity in kg but got 1e-310"),
        (
            dict(x=0 * X),
            "expected a moving target but x is 0 m in all 800 valid frames; check which target was tracked",
        ),
        (dict(x=0 * X + 0.3), "expected a moving target but x is 0.3 m in all 800 valid frames"),
        (dict(x=X + 1e6), "expected positions within 100000 m of their origin but all lie 1e+06 m away; subtract"),
        (dict(rôle="x"), "rôle"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_bad_arrays_are_named_at_once(arguments, message):
    with pytest.raises((FrictrackError, TypeError)) as caught:
        ft.Run.from_arrays(**{"t": T, "x": X, "mass": MASS, "name": "slow"} | arguments)
    assert message in str(caught.value)


@pytest.mark.parametrize("masses", [(MASS,), (MASS, MASS, 2 * MASS, 2 * MASS)])
def test_positions_without_noise_give_every_parameter_and_one_sentence(masses):
    """A slide under Coulomb and viscous friction in closed form; dry friction is that of the load."""
    runs = []
    for i, mass in enumerate(masses):
        stop, rate = F_C / MASS * mass / 0.4, 0.4 / mass
        x = (3 + i + stop) / rate * (1 - np.exp(-rate * T)) - stop * T
        runs.append(ft.Run.from_arrays(T, x, mass=mass, name=f"run{i}"))
    fit = ft.fit("coulomb,viscous", runs)
    assert {name: e.value for name, e in fit.parameters.items()} == pytest.approx(
        {"coulomb.F_c": F_C, "viscous.F_v": 0.4}, rel=1e-6
    )
    assert all(e.std > 0 for e in fit.parameters.values())
    assert fit.parameters["viscous.F_v"].std > 1e-9
    assert "have no noise, as if they were computed" in fit.summary()["remarks"][0]


def test_noise_of_a_nanometre_is_noise():
    fit = ft.fit("coulomb", [ft.Run.from_arrays(T, noisy(sigma=1e-9), mass=MASS)])
    assert not any("no noise" in remark for remark in fit.summary()["remarks"])


def test_a_missing_column_names_those_that_are_there():
    with pytest.raises(FrictrackError, match='expected a column "t_s" but got time, x_m'):
        ft.Run.from_dataframe(pd.DataFrame({"time": T, "x_m": X}), mass=MASS)


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (dict(mass=350), '"350 g"'),
        (dict(t=1e3 * T), "ms"),
        (dict(x=1e3 * X), "m/s"),
        (dict(x=T**2, incline="25 deg"), 'the sign is wrong: give incline = "-25 deg"'),
    ],
)
def test_values_that_cannot_be_right_are_warned_of(arguments, meant):
    with pytest.warns(UserWarning, match=meant):
        ft.Run.from_arrays(**{"t": T, "x": noisy(), "mass": MASS} | arguments)


def test_a_usual_run_gives_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ft.Run.from_arrays(T, noisy(), mass=MASS)


@pytest.fixture(scope="module")
def slides():
    """Two slides under Coulomb friction, one of them with a drag that the model lacks."""
    t = T[:400]
    v, x = [4.0], [0.0]
    for _ in range(len(t) - 1):
        v.append(v[-1] - (F_C + 0.05 * v[-1] ** 2) / MASS / 4000)
        x.append(x[-1] + 0.5 * (v[-1] + v[-2]) / 4000)
    positions = {"coulomb": X[:400], "drag": np.array(x)}
    return [ft.Run.from_arrays(t, noisy(one), mass=MASS, name=name) for name, one in positions.items()]


@pytest.fixture(scope="module")
def fit(slides):
    return ft.fit("coulomb", slides)


@pytest.fixture(scope="module")
def diagnosis(fit):
    with pytest.MonkeyPatch.context() as patched:
        use_few_effects(patched)
        return ft.diagnose(fit, quick=True)


def test_every_result_prints_in_a_few_lines(slides, fit, diagnosis):
    shown = {
        'Run "drag": 400 frames, 0 to 0.09975 s': slides[1],
        "Motion: 400 frames": slides[0].motion,
        "Displacement: 400 frames": slides[0].displacement,
        "Fit of 2 runs: F = ": fit,
        "Comparison of 1 model, the last one coulomb; it fails in ": ft.compare(fit),
        "Diagnosis of coulomb: ": diagnosis,
        f"Candidate {diagnosis.best.effect}: p = ": diagnosis.best,
    }
    for begins, result in shown.items():
        assert repr(result).startswith(f"<{begins}")
        assert len(repr(result)) < 600


def test_results_turn_into_dataframes(slides, fit, diagnosis):
    table = fit.to_dataframe()
    assert table.loc["coulomb.F_c", ["value", "unit"]].tolist() == [fit.parameters["coulomb.F_c"].value, "N"]
    motion = slides[0].to_dataframe()
    np.testing.assert_array_equal(motion["x_measured"], slides[0].displacement.x)
    np.testing.assert_array_equal(motion["a"], slides[0].motion.a)
    assert motion.attrs["units"]["a"] == "m/s^2"
    assert set(motion.attrs["units"]) == set(motion.columns)
    assert ft.compare(fit).to_dataframe()["model"].tolist() == ["coulomb"]
    assert diagnosis.to_dataframe().index.tolist() == [c.effect for c in diagnosis.candidates]


def test_results_turn_into_datasets(slides, fit, diagnosis):
    motion = slides[0].to_xarray()
    np.testing.assert_array_equal(motion["x_measured"], slides[0].displacement.x)
    assert motion["a"].attrs["units"] == "m/s^2"
    assert fit.to_xarray()["std"].sel(parameter="coulomb.F_c") == fit.to_dataframe().loc["coulomb.F_c", "std"]
    assert ft.compare(fit).to_xarray().sizes == {"name": 1}
    assert diagnosis.to_xarray()["effect"].values.tolist() == [c.effect for c in diagnosis.candidates]


@pytest.fixture(scope="module")
def results(slides, fit, diagnosis):
    """Public results, with what may hold functions: a drive, a plausibility check, a friction series, a scale."""
    push = np.full(len(T), 0.5)
    driven = [ft.Run.from_arrays(T, noisy(), mass=MASS, drive=push, name="driven")]
    pulled = [ft.Run.from_arrays(T, noisy(), friction=np.full(len(T), F_C), name="pulled")]
    scales = [
        "0.5 mm/px",
        {"points": [[0, 0], [200, 0]], "length": "100 mm"},
        {"points": [[0, 0], [100, 0], [100, 90], [0, 100]], "plane": [[0, 0], [1, 0], [1, 1], [0, 1]]},
    ]
    return {
        "patch": ft.fit("coulomb,patch", slides[:1]),
        "drive": ft.fit("coulomb,drive_error", driven),
        "measured friction": ft.fit("coulomb", pulled),
        "acceleration": ft.fit("coulomb", slides[:1], domain="force"),
        "groups": ft.fit("coulomb", [replace(slides[0], group="a")], per="group"),
        "comparison": ft.compare(fit),
        "diagnosis": diagnosis,
        "profile": ft.profile(fit, "coulomb.F_c"),
        "prior": fit.to_prior(),
        "runs": slides,
        "friction": ft.friction(slides[0]),
        "events": ft.find_events(slides[0]),
        **{f"scale {i}": ft.plane_map(scale) for i, scale in enumerate(scales)},
    }


def shown(results):
    """What is printed of results, and the numbers of scales."""
    at = np.array([[10.0, 20.0]])
    return {k: r(at).tolist() if k.startswith("scale") else repr(r) for k, r in results.items()}


def test_every_result_survives_pickle_and_copy(results):
    for again in (pickle.loads(pickle.dumps(results)), copy.deepcopy(results)):
        assert shown(again) == shown(results)
        assert again["patch"].summary() == results["patch"].summary()


def test_results_survive_another_process(results):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(repr, results["patch"]).result() == repr(results["patch"])
        assert pool.submit(copy.copy, results["patch"]).result().equation == results["patch"].equation


def test_results_survive_joblib(results, tmp_path):
    joblib = pytest.importorskip("joblib")
    joblib.dump(results, tmp_path / "results.joblib")
    assert shown(joblib.load(tmp_path / "results.joblib")) == shown(results)


def test_fits_of_groups_are_shown_like_one_fit(slides):
    grouped = [replace(run, group=group) for run, group in zip(slides, "ab", strict=True)]
    fits = ft.fit("coulomb", grouped, per="group")
    assert fits.to_dataframe().loc[("b", "coulomb.F_c"), "value"] == fits.fits["b"].parameters["coulomb.F_c"].value
    assert len(fits.plot().axes) == len(ft.fit("coulomb", grouped).plot().axes)


def test_every_figure_takes_runs_fits_and_diagnoses(slides, fit, diagnosis):
    better = ft.fit("coulomb,drag", slides)
    spans = ft.compare(fit).fails_at
    figures = [
        slides[0].plot(),
        fit.plot(),
        diagnosis.plot(),
        plots.limits(diagnosis),
        plots.failing(fit, slides, spans, better),
        plots.modelled(better, slides),
        plots.friction(slides),
        plots.loops(fit, slides),
        plots.routes(fit, better, slides[0]),
        ft.compare([fit, better]).plot(),
    ]
    assert all(figure.axes for figure in figures)
    history = plots.history([fit, better])
    np.testing.assert_allclose(
        history.axes[0].lines[0].get_ydata(), [one.errors["heldout_rms_um"] for one in (fit, better)]
    )


def test_a_record_draws_its_columns_in_their_units(slides):
    figure = slides[1].motion.plot()
    assert [ax.get_ylabel() for ax in figure.axes] == ["x / mm", "v / (m/s)", "a / (m/s²)"]
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), 1e3 * slides[1].motion.x)


def test_a_notebook_shows_text_and_figure(slides):
    page = slides[0]._repr_html_()
    assert "&lt;Run &quot;coulomb&quot;: 400 frames" in page
    assert 'src="data:image/png;base64,' in page


def test_the_package_lists_its_public_names():
    assert dir(ft) == sorted(ft.__all__)
    assert set(ft.__all__) == set(ft._MODULE_OF)
    assert all(getattr(ft, name) is not None for name in dir(ft))


def test_seed_is_the_older_name_of_rng():
    fitted = ft.fit("coulomb", [ft.Run.from_arrays(T, noisy(), mass=MASS)])
    with pytest.warns(DeprecationWarning, match=r"seed is deprecated in bootstrap\(\); use rng"):
        old = ft.bootstrap(fitted, 20, seed=3)
    new = ft.bootstrap(fitted, 20, rng=3)
    drawn = ft.bootstrap(fitted, 20, rng=np.random.default_rng(3))
    assert old.intervals == new.intervals == drawn.intervals
    with pytest.raises(ft.FrictrackError, match="expected rng or seed"):
        ft.bootstrap(fitted, 20, rng=3, seed=3)


@pytest.fixture(scope="module")
def one_fit():
    return ft.fit("coulomb", [ft.Run.from_arrays(T, noisy(), mass=MASS)])


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda fit: ft.fit("coulomb", fit.runs, bound=5), 'fit: unknown name "bound"; known are model, runs,'),
        (lambda fit: ft.fit("coulomb", fit.runs, prior="a.toml"), "expected prior to be a prior (from ft.Prior."),
        (lambda fit: ft.compare(5), "compare: expected fits to be a fit (from ft.fit) or a list of fits"),
        (
            lambda fit: fit.predict("a"),
            "Fit.predict: expected runs to be a run (from ft.Run.from_arrays) but got",
        ),
        (lambda fit: fit.conf_int(level=95), 'Fit.conf_int: unknown name "level"; known are alpha'),
        (lambda fit: ft.bootstrap(fit, "x"), 'bootstrap: expected draws to be a whole number but got "x"'),
        (
            lambda fitted: ft.low_pass(T),
            "expected displacement to be a displacement (from ft.calibrate) but got an array",
        ),
        (lambda fit: ft.friction(5, 5), "friction: expected 1 value without a name but got more"),
        (lambda fit: ft.trend([fit]), 'trend: expected a value for "at" but got none'),
        (lambda fit: ft.track("a.avi"), "expected recording to be a recording (from ft.open_recording)"),
        (lambda fit: ft.models.atm1(0), "expected n of at least 1"),
        (lambda fit: ft.FilterChoice(filter="papers"), 'FilterChoice: unknown name "filter"'),
        (
            lambda fitted: ft.Run.from_dataframe([1, 2], mass=0.3),
            "expected frame to be a pandas DataFrame but got [1, 2]",
        ),
        (
            lambda fitted: ft.Run.from_arrays(T, X, mass=0.3, inclin=1),
            'unknown setting "inclin" of a run; did you mean',
        ),
        (lambda fit: ft.Run.from_arrays(T, X, mass=0.3, incline=22), 'write "22 deg" for degrees'),
        (lambda fit: ft.Run.from_arrays(T, X, mass=0.3, sigma=-1e-6), "expected sigma above 0 but got -1e-06"),
        (
            lambda fitted: ft.Run.from_arrays(T, X, mass=0.3, sigma_drive=-1),
            "expected sigma_drive of at least 0 N but got",
        ),
        (lambda fit: ft.Run.from_arrays(T, X, mass=0.3, free=5), "expected free as (begin, end) in s but got 5"),
    ],
)
def test_a_wrong_call_is_refused_in_one_sentence(one_fit, call, said):
    with pytest.raises(ft.FrictrackError) as caught:
        call(one_fit)
    assert said in str(caught.value)


def test_texts_with_units_are_taken_where_numbers_are():
    settings = {"incline": ("3 deg", np.deg2rad(3)), "noise": ("1 um", 1e-6), "sigma_drive": ("5 mN", 5e-3)}
    for name, (text, number) in settings.items():
        assert getattr(ft.Run.from_arrays(T, X, mass="350 g", **{name: text}), name) == pytest.approx(number)
    run = ft.samples.runs()[1]
    again = ft.Run(run.displacement, run.motion, mass="350 +/- 2 g", free=("10 ms", "50 ms"))
    assert (again.mass, again.sigma_mass, *again.free) == pytest.approx((0.35, 0.002, 0.01, 0.05))
    assert np.array_equal(ft.low_pass(run.displacement, "120 Hz").x, ft.low_pass(run.displacement, 120.0).x)
    assert ft.fit("coulomb", [run], reference_mass="700 g").reference.mass == pytest.approx(0.7)
    assert ft.with_earlier_runs([run, run], [None, "1 min"])[1].earlier[0][0] == 60.0
    film = ft.samples.films_folder() / "fast.avi"
    assert np.array_equal(ft.open_recording(film, "4000 fps").timebase.t, ft.open_recording(film, 4000).timebase.t)
    assert ft.costs.Costs(masses=("350 g",)).masses == (0.35,)


def test_all_that_numpy_takes_for_a_seed_a_number_or_a_list_is_taken(one_fit: ft.Fit) -> None:
    run = one_fit.runs[0]
    for rng in (np.random.SeedSequence(3), np.random.PCG64(3), np.int64(3), [3, 4]):
        assert ft.diagnose(one_fit, rng=rng, quick=np.bool_(True)).verdict
    again = ft.Run.from_arrays(run.displacement.t, run.displacement.x, mass=np.array(0.35), sigma=1e-6)
    assert ft.fit("coulomb", (one for one in [again])).reduced_chi2 > 0


def test_public_functions_are_pickled():
    assert pickle.loads(pickle.dumps(ft.track)) is ft.track
