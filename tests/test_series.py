"""Runs whose friction a load cell measured: through the whole loop without a mass, against truths made elsewhere.

Motions and forces are closed forms or brute force; the tribometer's strokes are a measurement of others (see
frictrack/samples/data). N = 5 N there, gross slip at a friction coefficient near 0.47, and a slope of 40 to 48 N/mm
after every reversal.
"""

import json
import re
import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from frictrack import effects, samples
from frictrack.base.errors import FrictrackError
from frictrack.diagnose.compare import compare
from frictrack.effects import models
from frictrack.fit import fit, restore, state
from frictrack.fit.observations import friction_pieces
from frictrack.fit.observations.measured_friction import block_covariance
from frictrack.flow import Session, open_study, tried_models
from frictrack.present import export, plots, report
from frictrack.records import Displacement, Motion, Run
from frictrack.results import to_builtins

DATA = samples.DATA / "tribometer"
COLUMNS = {"t": "Time [s]", "x": "Position [mm]", "friction": "-Friction [uN]"}
LAW = {"coulomb.F_c": 8.0, "stribeck.F_s": 11.0, "stribeck.v_s": 0.05, "viscous.F_v": 2.0}
FPS = 1000.0


def tustin_force(v, level=1.0):
    return level * np.sign(v) * (8.0 + 3.0 * np.exp(-np.abs(v) / 0.05)) + 2.0 * v


def given(t, x, v, force, **known):
    """A run whose motion and friction are told."""
    n, nan = len(t), np.full(len(t), np.nan)
    displacement = Displacement(t, x, nan, nan, np.full(n, 1e-6), nan, np.ones(n, bool))
    motion = Motion(t, x, v, 0 * t, nan, np.full(n, 1e-6), np.full(n, 1e-4), np.full(n, 1e-2), nan)
    return Run(displacement, motion, friction_N=force, **known)


def swing(seed=0, *, noise=0.02, hertz=0.5, level=1.0, n=3000, **known):
    """A mass swung to and fro under Tustin's law."""
    t = np.arange(n) / FPS
    w = 2 * np.pi * hertz
    v = 0.1 * w * np.cos(w * t)
    force = tustin_force(v, level) + noise * np.random.default_rng(seed).standard_normal(n)
    return given(t, 0.1 * np.sin(w * t), v, force, **({"name": "swing"} | known))


def numbers(result):
    told = {name: e for name, e in result.parameters.items() if name in LAW}
    return np.array([told[n].value for n in LAW]), np.array([told[n].std for n in LAW])


class TestLaw:
    def test_is_found_without_a_mass_within_its_own_deviations(self):
        z = []
        for seed in range(20):
            value, std = numbers(fit("tustin", [swing(seed)]))
            z.append((value - list(LAW.values())) / std)
        assert np.abs(z).max() < 4.5
        assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3  # 20 of each, and they go together

    def test_errors_are_in_newtons_and_those_of_a_picture_are_null(self):
        errors = fit("tustin", [swing()]).errors
        for name in ("rms_displacement_um", "rms_acceleration", "sse_acceleration", "heldout_rms_um"):
            assert errors[name] is None
        for name in ("rms_N", "noise_N", "heldout_rms_N"):
            assert errors[name] == pytest.approx(0.02, rel=0.05)
        assert errors["heldout"] == "frames"
        assert errors["reduced_chi2"] == pytest.approx(1.0, abs=0.1)
        force = swing().friction_N
        assert errors["relative_force_error"] == pytest.approx(0.02 * np.sqrt(3000 / np.sum(force**2)), rel=0.05)

    def test_nothing_depends_on_a_mass_that_is_given(self):
        without, weighed = fit("tustin", [swing()]), fit("tustin", [swing(mass=0.3)], domain="force")
        assert numbers(weighed)[0] == pytest.approx(numbers(without)[0], rel=1e-6)

    def test_gaps_of_the_cell_are_left_out(self):
        run = swing()
        force = run.friction_N.copy()
        force[700:720] = np.nan
        force[1600] = np.nan
        result = fit("tustin", [replace(run, friction_N=force)])
        assert result.solution.problem.n_frames == fit("tustin", [run]).solution.problem.n_frames - 21
        assert numbers(result)[0] == pytest.approx(list(LAW.values()), rel=0.05)

    def test_curves_are_the_model_beside_the_measurement(self):
        run = swing()
        (curve,) = fit("tustin", [run]).curves
        assert pytest.approx(tustin_force(run.motion.v[np.isin(run.motion.t, curve.t)]), abs=0.02) == curve.F_model
        assert sum(curve.parts.values()) == pytest.approx(curve.F_model)


class TestNoise:
    """A cell's noise may be coloured: white deviations would be several times too small."""

    @staticmethod
    def drifting(seed):
        rng = np.random.default_rng(seed)
        t = np.arange(4000) / FPS
        v = 0.3 * np.cos(2 * np.pi * 2.5 * t)
        e = np.zeros(4000)
        for i, step in enumerate(rng.standard_normal(3999)):
            e[i + 1] = 0.95 * e[i] + step
        return given(t, np.cumsum(v) / FPS, v, 8 * np.sign(v) + 2 * v + 0.05 * e)

    def test_deviations_hold_under_coloured_noise(self):
        z, narrow = [], []
        for seed in range(40):
            result = fit("coulomb,viscous", [self.drifting(seed)])
            off = result.solution.p - [8.0, 2.0]
            z.append(off / np.sqrt(np.diag(block_covariance(result.solution))))
            jac = result.solution.jac
            narrow.append(off / np.sqrt(np.diag(np.linalg.inv(jac.T @ jac))))
        assert np.mean(np.abs(z) < 1.96) > 0.85
        assert np.mean(np.abs(narrow) < 1.96) < 0.6

    def test_over_how_long_the_residual_is_alike_is_told(self):
        row = fit("coulomb,viscous", [self.drifting(0)]).summary()["per_run"][0]
        assert 0.005 < row["correlated_s"] < 0.06  # exp(-1) after 20 frames
        assert fit("tustin", [swing()]).summary()["per_run"][0]["correlated_s"] == 0.0


def dahl(x, level, stiffness, exponent=1.0, start=1.0):
    """Dahl's friction by brute force: a thousandth of the breakaway length per step."""
    length, z = level / stiffness, start
    out = [z]
    for a, b in pairwise(x):
        steps = max(int(np.ceil(abs(b - a) / (1e-3 * length))), 1)
        d = (b - a) / steps
        for _ in range(steps if d else 0):
            z += d / length * max(1 - z * np.sign(d), 0.0) ** exponent
        out.append(z)
    return level * np.array(out)


def dwelling(noise=2e-3):
    """Slow strokes of 0.2 mm with a rest at either end, where friction keeps what it was: 2 N, 40 N/mm."""
    t = np.arange(2400) / 200.0
    phase = (t / 4.0) % 1.0
    x = 2e-4 * np.interp(phase, [0, 0.25, 0.5, 0.75, 1.0], [0, 1, 1, 0, 0])
    v = 2e-4 * np.interp(phase, [0, 0.25, 0.2501, 0.5, 0.5001, 0.75, 0.7501, 1.0], [1, 1, 0, 0, -1, -1, 0, 0])
    force = dahl(x, 2.0, 4e4, start=-1.0) + noise * np.random.default_rng(0).standard_normal(len(t))
    run = given(t, x, v, force)
    motion = replace(run.motion, sigma_x=np.full(len(t), 1e-8), sigma_v=np.full(len(t), 1e-6))
    return replace(run, motion=motion)


class TestMemory:
    def test_presliding_is_found_through_the_rests(self):
        run = dwelling()
        bare, full = fit("coulomb", [run]), fit("coulomb,presliding", [run])
        assert bare.errors["relative_force_error"] > 0.5
        assert full.errors["rms_N"] < 0.05 * bare.errors["rms_N"]
        assert full.parameters["coulomb.F_c"].value == pytest.approx(2.0, rel=0.01)
        assert full.parameters["presliding.stiffness"].value == pytest.approx(4e4, rel=0.02)

    def test_stuck_frames_are_not_compared_but_remembered(self):
        run = dwelling()
        (piece,) = friction_pieces([run], float("nan"))
        assert len(piece.path.t) == 2400
        assert len(piece.t) == pytest.approx(1200, abs=10)
        resting = np.setdiff1d(np.arange(1, 2400), piece.at)
        assert np.all(piece.path.v[resting] == 0)
        assert set(piece.path.s) == {-1.0, 1.0}
        assert np.all(np.diff(piece.path.s[resting][:190]) == 0)  # the side on which friction holds is kept

    def test_creep_at_rest_is_a_way_and_its_noise_is_none(self):
        run = dwelling()
        rest = slice(210, 390)
        shaking = 1e-7 * np.random.default_rng(1).standard_normal(180)
        v = run.motion.v.copy()
        v[rest] += shaking
        (still,) = friction_pieces([replace(run, motion=replace(run.motion, v=v))], float("nan"))
        assert np.all(still.path.v[rest] == 0)
        x = run.motion.x.copy()
        x[200:] += np.minimum(np.arange(2200) / 200, 1.0) * 1e-6
        (crept,) = friction_pieces([replace(run, motion=replace(run.motion, x=x))], float("nan"))
        assert crept.path.v[rest] == pytest.approx(np.full(180, 1e-6), rel=0.05)


class TestRuns:
    @staticmethod
    def study(**known):
        levels = [1.0, 1.03, 0.98, 1.01]
        return [
            swing(i, hertz=0.4 + 0.1 * i, level=level, name=f"r{i}", **known) for i, level in enumerate(levels)
        ], levels

    def test_share_the_law_and_keep_their_levels(self):
        runs, levels = self.study()
        summary = fit("tustin", runs).summary()
        found = np.array([row["level"] for row in summary["per_run"]])
        assert found / found.mean() == pytest.approx(np.array(levels) / np.mean(levels), abs=2e-3)
        assert summary["friction_scatter"]["value"] == pytest.approx(np.std(levels, ddof=1), rel=0.3)
        assert summary["errors"]["heldout"] == "run"
        assert summary["errors"]["heldout_rms_N"] == pytest.approx(0.02, rel=0.05)

    def test_the_load_goes_with_the_friction_and_mu_stands_beside(self):
        light, heavy = swing(name="light", normal_load=20.0), swing(1, level=2.0, name="heavy", normal_load=40.0)
        summary = fit("tustin", [light, heavy]).summary()
        assert [row["level"] for row in summary["per_run"]] == pytest.approx([1.0, 1.0], abs=2e-3)
        coulomb = summary["parameters"]["coulomb.F_c"]
        assert coulomb["value"] == pytest.approx(8.0, rel=0.02)
        assert coulomb["mu"]["value"] == pytest.approx(0.4, rel=0.02)
        assert "mu" not in summary["parameters"]["viscous.F_v"]
        assert "mu" not in fit("tustin", [swing()]).summary()["parameters"]["coulomb.F_c"]

    def test_a_validation_run_is_predicted(self):
        off = swing(3, level=1.2, name="off", role="validation")
        summary = fit("tustin", [swing(name="a"), swing(1, name="b"), off]).summary()
        rows = {row["run"]: row for row in summary["per_run"]}
        assert rows["off"]["role"] == "validation"
        dry = tustin_force(off.motion.v) - 2 * off.motion.v
        assert rows["off"]["errors"]["rms_N"] == pytest.approx(0.2 * np.sqrt(np.mean(dry**2)), rel=0.02)
        assert rows["a"]["errors"]["rms_N"] == pytest.approx(0.02, rel=0.05)

    def test_groups_are_fitted_apart_at_one_load(self):
        runs = [swing(name="a", group="low", normal_load=20.0), swing(1, name="b", group="high", normal_load=40.0)]
        result = fit("tustin", runs, per="group")
        summary = result.summary()
        assert summary["parameters"]["coulomb.F_c[low]"]["value"] == pytest.approx(8.0, rel=0.02)
        assert summary["parameters"]["coulomb.F_c[high]"]["value"] == pytest.approx(4.0, rel=0.02)  # at 20 N
        assert summary["errors"]["heldout_rms_um"] is None
        assert summary["errors"]["heldout_rms_N"] == pytest.approx(0.02, rel=0.05)
        again = restore(runs, state(result))
        assert again.errors["rms_N"] == pytest.approx(result.errors["rms_N"], rel=1e-12)

    def test_comes_back_from_its_state_as_it_was(self):
        runs, _ = self.study(normal_load=30.0)
        runs.append(swing(9, name="off", role="validation", normal_load=60.0))
        result = fit("tustin", runs)
        again = restore(runs, state(result))
        assert again.solution.p == pytest.approx(result.solution.p, rel=1e-12)
        assert to_builtins(again.summary()) == to_builtins(result.summary())


class TestSearch:
    def test_differential_evolution_over_the_nonlinear_numbers_finds_what_varpro_does(self):
        run = swing(n=1500)
        plain, found = fit("tustin", [run]), fit("tustin", [run], search="de", over="nonlinear")
        assert found.errors["rms_N"] == pytest.approx(plain.errors["rms_N"], rel=1e-3)
        assert numbers(found)[0] == pytest.approx(numbers(plain)[0], rel=0.02)
        best = found.summary()["optima"][0]
        assert best["misfit"] == pytest.approx(np.sum(found.solution.residual**2) * found.errors["noise_N"] ** 2)
        again = restore([run], state(found))
        assert again.summary()["optima"] == found.summary()["optima"]


class TestRefused:
    @pytest.mark.parametrize(
        ("runs", "how", "said"),
        [
            (
                lambda: [swing(name="a"), replace(swing(name="film", mass=0.3), friction_N=None)],
                {"domain": "force"},
                "expected friction_N of all runs or of none but film of 2 runs has none; give these a study",
            ),
            (lambda: [swing()], {"model": "coulomb,lens"}, "friction itself was measured, but got lens, which acts"),
            (lambda: [swing()], {"model": "coulomb,drive_error"}, "drive_error needs a measured drive of every run"),
            (lambda: [swing()], {"domain": "displacement"}, "expected a mass for a fit of the displacement"),
            (lambda: [swing(), swing(1)], {}, "expected every run to have its own name but got swing twice"),
            (lambda: [swing(role="validation")], {}, "expected at least one run to fit but all have role"),
        ],
        ids=["mixed", "picture", "no drive", "no mass", "same name", "validation only"],
    )
    def test_in_one_sentence(self, runs, how, said):
        how = {"model": "coulomb"} | how
        with pytest.raises(FrictrackError) as caught:
            fit(runs=runs(), **how)
        assert said in str(caught.value)


@pytest.fixture(scope="module")
def strokes_study(tmp_path_factory):
    """A study of four strokes to and fro of the tribometer, its motion known."""
    folder = tmp_path_factory.mktemp("tribometer")
    shutil.copy(DATA / "strokes.txt", folder)
    (folder / "study.toml").write_text(STUDY)
    session = Session(open_study(folder / "study.toml"))
    session.bring_up_to("motion")
    return session


class TestTribometer:
    """Measured on these strokes: rms 1.59 N of 1.89 N under Coulomb, 0.32 N with Dahl's presliding, 0.18 N with its
    exponent free, which also brings F_c to the slip force: 2.352 +- 0.012 N, mu = 0.470."""

    @pytest.fixture(scope="class")
    @staticmethod
    def run(strokes_study):
        return strokes_study.models.runs[0]

    def test_units_and_sign_are_read_from_the_headers(self, run):
        assert np.ptp(run.displacement.x) == pytest.approx(0.228e-3, rel=0.01)
        assert np.abs(run.friction_N).max() == pytest.approx(2.56, rel=0.02)
        moving = np.abs(run.motion.v) > 1e-4
        assert np.mean((run.friction_N * run.motion.v)[moving]) > 0  # friction resists

    def test_no_law_of_the_velocity_explains_half_of_it(self, run):
        for law in ("coulomb", "coulomb,viscous", "tustin", "coulomb,drag,asymmetry"):
            assert fit(law, [run]).errors["relative_force_error"] > 0.75

    def test_presliding_does(self, run):
        bare, full = fit("coulomb,viscous", [run]), fit("coulomb,viscous,presliding", [run])
        assert full.errors["rms_N"] < 0.25 * bare.errors["rms_N"]
        assert full.errors["heldout_rms_N"] < 0.25 * bare.errors["heldout_rms_N"]
        assert full.parameters["presliding.stiffness"].value == pytest.approx(4.2e4, rel=0.1)

    def test_with_the_exponent_free_the_slip_force_is_found(self, run):
        law = effects.get("presliding").adjusted(exponent={"fixed": None, "scan": lambda span: np.linspace(0, 1, 5)})
        result = fit(models.of(["coulomb", law]), [run])
        assert result.errors["rms_N"] == pytest.approx(0.176, abs=0.01)
        coulomb = result.summary()["parameters"]["coulomb.F_c"]
        assert coulomb["mu"]["value"] == pytest.approx(0.470, abs=0.01)
        assert 0.001 < coulomb["mu"]["std"] < 0.02  # by blocks; white noise would say 1e-6
        assert result.parameters["presliding.stiffness"].value == pytest.approx(4.03e4, rel=0.02)

    def test_lugre_finds_the_same_memory(self, run):
        assert fit("lugre", [run]).errors["rms_N"] < 0.35

    def test_failing_spans_are_where_the_residual_is(self, run):
        result = fit("coulomb,viscous", [run])
        spans = compare(result).fails_at
        assert 0.6 < sum(s["share_of_error"] for s in spans) <= 1.0
        (curve,) = result.curves
        left = np.abs(np.interp(curve.t, run.motion.t, run.friction_N) - curve.F_model)
        inside = np.zeros(len(left), bool)
        for s in spans:
            inside |= (curve.t >= s["t"][0]) & (curve.t <= s["t"][1])
        assert left[inside].mean() > 2 * left[~inside].mean()


STUDY = """
[study]
name = "tribometer"
model = ["coulomb", "viscous"]

[[run]]
name = "strokes"
table = "strokes.txt"
columns = {t = "Time [s]", x = "Position [mm]", friction = "-Friction [uN]"}
normal_load = "5 N"
"""


class TestFlow:
    @pytest.fixture(scope="class")
    @staticmethod
    def session(strokes_study):
        strokes_study.fit()
        strokes_study.add("presliding")
        return strokes_study

    def test_the_error_falls_as_memory_is_added(self, session):
        before, after = session.history()["models"]
        assert before["errors"]["rms_N"] == pytest.approx(1.52, abs=0.05)
        assert after["errors"]["rms_N"] == pytest.approx(0.31, abs=0.02)
        assert after["errors"]["heldout_rms_N"] < 0.25 * before["errors"]["heldout_rms_N"]
        json.dumps(session.compare())

    def test_a_second_session_finds_it_as_it_was(self, session):
        again = Session(open_study(session.study.path))
        assert again.fit() == session.fit()
        assert again.history() == session.history()

    def test_a_report_without_a_diagnosis_speaks_of_newtons_and_draws_loops(self, session, monkeypatch):
        monkeypatch.setattr(Session, "diagnose", lambda self, seed=0: None)
        results = session.results()
        assert results.papers is None
        assert results.notes == ()
        page = report.render(results)
        assert "A load cell measured the friction force" in page
        assert re.search("presliding.{1,4}error 1[67] % of the measured friction force", page)
        assert "friction force, rms" in page
        assert re.search(r"µ = 0\.6[01]", page)
        assert "displacement itself" not in page
        files = {path.stem: path.read_text() for path in export.write(results, "csv")}
        assert "rms_N" in files["errors"]

    def test_pictures_show_newtons(self, session):
        run = session.models.runs[0]
        results = tried_models.model_results(session.models.path, session.models.groups[-1])
        assert plots.noise_um(results) is None
        assert results.summary["errors"]["noise_N"] < 1e-3
        assert results.motion == ()
        assert len(results.curves[0]) < len(run.motion)

    def test_the_noise_of_a_displacement_with_few_digits_is_that_of_the_last_one(self, session):
        sigma = session.runs[0].get("displacement").sigma_x
        assert np.min(sigma) == pytest.approx(1e-7 / np.sqrt(12), rel=1e-6)
        assert np.max(sigma) < 1e-7  # where it moves the noise is larger: the stage does not run evenly

    def test_a_cell_with_its_own_clock_serves(self, tmp_path):
        t = np.arange(2000) / 500.0
        w = 2 * np.pi * 0.7
        x, v = 0.05 * np.sin(w * t), 0.05 * w * np.cos(w * t)
        rng = np.random.default_rng(0)
        head = {"delimiter": ",", "comments": ""}
        np.savetxt(tmp_path / "x.csv", np.c_[t, x + 1e-6 * rng.standard_normal(2000)], header="t_s,x_m", **head)
        force = tustin_force(v) + 0.02 * rng.standard_normal(2000)
        np.savetxt(tmp_path / "cell.csv", np.c_[t, force], header="t_s,friction_N", **head)
        (tmp_path / "study.toml").write_text(
            '[study]\nmodel = "tustin"\n[[run]]\nname = "a"\ntable = "x.csv"\n'
            'sensor = {table = "cell.csv", offset = "0 s"}\n'
        )
        found = Session(open_study(tmp_path / "study.toml")).fit()
        assert found["domain"] == "force"
        assert found["parameters"]["coulomb.F_c"]["value"] == pytest.approx(8.0, rel=0.03)
        assert found["parameters"]["stribeck.F_s"]["value"] == pytest.approx(11.0, rel=0.05)
        assert found["errors"]["rms_N"] < 0.1

    @pytest.mark.slow
    def test_the_report_and_the_export_stand(self, session):
        page = session.report().read_text()
        assert "µm noise" not in page
        assert "presliding" in page
        assert export.write(session.results(), "csv")
