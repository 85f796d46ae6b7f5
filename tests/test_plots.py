"""Figures show the numbers they were given, with units, and leave nothing behind."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from frictrack.present import plots
from frictrack.present.plots import style
from frictrack.present.plots.style import RC_PARAMS
from frictrack.records import Curve, Displacement, Filtered, Friction, Motion, Track
from frictrack.results import ModelResults, RecordingInfo, Results, RunResults

MASS, FORCE, NOISE = 0.5, 2.0, 10e-6  # kg, N, m
FPS, N, GUARD = 1000.0, 200, 10


def run_results(name: str = "v1", v0: float = 1.0, *, film: bool = False, force: bool = True) -> RunResults:
    """A slide under constant friction: closed forms in every record."""
    t = np.arange(N) / FPS
    s = np.sign(v0)
    a = -s * FORCE / MASS
    x, v = v0 * t + a * t**2 / 2, v0 + a * t
    one, nan = np.ones(N), np.full(N, np.nan)
    free = np.ones(N, dtype=bool)
    free[:20] = False
    track = Track(
        t,
        100 + 1e3 * x,
        20 * one,
        nan,
        0.01 * one,
        0.01 * one,
        0.99 * one,
        np.full(N, ""),
        target=(70.0, 5.0, 60.0, 30.0),
    )
    picture = np.random.default_rng(0).integers(0, 255, (50, 320)).astype(np.uint8)
    return RunResults(
        name=name,
        source=f"{name}.avi" if film else f"{name}.csv",
        displacement=Displacement(t, x, nan, nan, NOISE * one, nan, np.ones(N, dtype=bool)),
        filtered=Filtered(t, x, nan, NOISE * one, nan, 120.0, reason="cut-off 120 Hz by maximum likelihood"),
        motion=Motion(t, x, v, a * one, nan, NOISE * one, 0.01 * one, 0.5 * one, nan, GUARD, 120.0),
        friction=Friction(t, s * FORCE * one, 0.25 * one, free, "from here to there") if force else None,
        film=RecordingInfo(t, f"{name}.avi", FPS, N, 8, "ab" * 32, picture) if film else None,
        track=track if film else None,
        settings={"name": name, "mass": (MASS, 0.002), "fps": FPS, "note": "oiled <twice>"},
        hashes={"displacement": "cd" * 32, "friction": "ef" * 32},
    )


def curve(run: RunResults, size: float = NOISE, role: str = "fit") -> Curve:
    """A model that misses the measured displacement by a square wave of the given size, m."""
    at = run.friction.free if run.friction is not None else np.ones(N, dtype=bool)
    n = int(at.sum())
    missed = size * np.where(np.arange(n) % 2, 1.0, -1.0)
    x, force = run.displacement.x[at], FORCE * np.sign(run.motion.v[at])
    return Curve(
        run.motion.t[at], x, np.full(n, NOISE), x - missed, run.motion.v[at], run.motion.a[at], force, run.name, role,
        {"coulomb": force},
    )  # fmt: skip


def errors(rms: float, heldout: float) -> dict:
    return {
        "rms_displacement_um": rms, "rms_acceleration": 0.4, "sse_acceleration": 12.0, "relative_force_error": 0.05,
        "heldout_rms_um": heldout, "heldout_rms_N": None, "heldout": "run", "reduced_chi2": (rms / 10) ** 2,
    }  # fmt: skip


def parameter(value, std, unit, reason=None, at_bound=False) -> dict:
    return {"value": value, "std": std, "unit": unit, "at_bound": at_bound, "reason": reason}


def candidate(effect: str, p: float, delta_bic: float, rivals=(), acts_on="force") -> dict:
    return {
        "effect": effect, "acts_on": acts_on, "p": p, "delta_bic": delta_bic,
        "parameters": {"period": parameter(0.03, 1e-5, "m"), "phase[v1]": parameter(0.3, 0.1, "rad")},
        "heldout_rms_before_um": 21.2, "heldout_rms_after_um": 10.2, "heldout": "run",
        "indistinguishable_from": list(rivals),
        "words": {"what": f"What {effect} is.", "looks_like": "ripples", "confirm": "Give a `reference`."},
    }  # fmt: skip


def diagnosis(verdict: str, candidates=(), missing=(), **more) -> dict:
    return {
        "model": ["coulomb", "viscous"], "verdict": verdict, "missing": list(missing), "noise_um": 10.0,
        "reduced_chi2": 3.0, "p_lack_of_fit": 0.001, "fails_at": [], "candidates": list(candidates),
        "unexplained": None, "next_experiment": [],
        "detection_limits": {
            "texture": {"value": 0.15, "unit": "N", "at": {"period": 0.01}, "power": 0.95, "reason": None},
            "slope": {"value": None, "unit": "N", "at": {}, "power": 0.95, "reason": "the fitted law absorbs it"},
        },
        "remarks": ["a remark"],
    } | more  # fmt: skip


def model(name: str, rms: float, runs, *, found=None, current=True, effects=("coulomb", "viscous")) -> ModelResults:
    rows = [
        {"run": r.name, "role": "fit", "level": 1.0, "noise_um": 10.0, "segments": 1, "errors": errors(rms, rms)}
        for r in runs
    ]
    summary = {
        "model": list(effects), "domain": "displacement", "search": "varpro",
        "parameters": {
            "coulomb.F_c": parameter(8.0123, 0.021, "N"),
            "stribeck.F_s": parameter(None, None, "N", "the slowest speed seen is 2 m/s: film a run that stops"),
            "viscous.F_v": parameter(0.0, 0.01, "N s/m", at_bound=True),
        },
        "friction_scatter": {"value": 0.021, "std": 0.008}, "correlations": [["coulomb.F_c", "viscous.F_v", -0.97]],
        "errors": errors(rms, 1.1 * rms), "per_run": rows,
    }  # fmt: skip
    grid = np.geomspace(0.005, 0.2, 50)
    figures = {"texture": {"period": grid, "rise": np.exp(-(np.log(grid / 0.03) ** 2)), "limit": 0.1 + grid}}
    return ModelResults(
        name, "F = F_c L s + F_v v", summary, tuple(curve(r, rms * 1e-6) for r in runs), current, found, figures
    )


def results(*, film: bool = False, runs: int = 2) -> Results:
    """A study in which texture was missing, was added, and nothing more is seen."""
    slides = tuple(run_results(f"v{i + 1}", (-1.0) ** i * (1 + i / 10), film=film) for i in range(runs))
    found = diagnosis("missing", [candidate("texture", 0.001, 812.0), candidate("lens", 0.4, -12.0)], ["texture"])
    found["fails_at"] = [{"run": "v1", "t": [0.05, 0.07], "x": [0.1, 0.2], "v": [0.5, 0.6], "share_of_error": 0.41}]
    last = diagnosis("complete", p_lack_of_fit=0.3)
    tried = (
        model("1_tustin", 36.0, slides, found=found, current=False),
        model("2_tustin+texture", 10.0, slides, found=last, effects=("coulomb", "viscous", "texture")),
    )
    return Results(
        "a study", Path("study.toml"), Path("results"), "0.1.0", slides, tried, None, last, tried[-1].figures
    )


def labels(figure) -> list[str]:
    return [text for ax in figure.axes if ax.axison for text in (ax.get_xlabel(), ax.get_ylabel()) if text]


def drawn(figure) -> list[str]:
    """All words of a figure."""
    return [t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_text()]


def all_figures() -> dict:
    r = results(film=True)
    first, last = r.models
    return {
        "film": plots.film(r.runs[0]),
        "motion": plots.motion(r.runs[0]),
        "friction": plots.friction(r.runs),
        "fit": plots.fit(last, r.runs),
        "failing": plots.failing(first, r.runs, first.diagnosis["fails_at"], last),
        "candidates": plots.candidates(first.diagnosis),
        "scan": plots.scan("texture", first.figures["texture"]),
        "history": plots.history(r.models),
        "limits": plots.limits(r.diagnosis, r.figures),
        "routes": plots.routes(last, last, r.runs[0]),
        "unexplained": plots.unexplained({"axis": "x", "curve": [[0.0, 1.0], [0.1, -1.0]]}),
    }


def settings() -> dict:
    """Those of matplotlib that a figure may depend on."""
    return {key: mpl.rcParams[key] for key in mpl.rcParams if key != "backend"}


def test_every_figure_has_units_a_title_and_leaves_no_state():
    before = settings()
    figures = all_figures()
    assert settings() == before
    for name, figure in figures.items():
        assert figure.get_suptitle(), name
        for label in labels(figure):
            unitless = label.startswith(("evidence", "fall of chi"))
            assert unitless or " / " in label, (name, label)
        svg = plots.svg(figure)
        ET.fromstring(svg)
        assert svg.startswith("<svg")
        assert plots.png(figure).startswith(b"\x89PNG")
    assert settings() == before


def test_same_figure_gives_same_svg():
    r = results()
    assert plots.svg(plots.history(r.models)) == plots.svg(plots.history(r.models))


def test_looks_of_eighteen_runs_differ():
    looks = [(look["color"], look["linestyle"]) for look in style.RUN_STYLES]
    assert len(set(looks)) == len(looks) == 18


def test_film_shows_rectangle_and_path():
    run = run_results(film=True)
    ax = plots.film(run).axes[0]
    path = ax.lines[-1]
    np.testing.assert_allclose(path.get_xdata(), 100 + 1e3 * run.displacement.x)
    corners = [(69.5, 4.5), (129.5, 4.5), (129.5, 34.5), (69.5, 34.5), (69.5, 4.5)]
    assert [[tuple(c) for c in p.get_xy()] for p in ax.patches] == 2 * [corners]
    with pytest.raises(ValueError, match='expected a run with a film and a track but "v1" is a table'):
        plots.film(run_results())


def test_motion_shades_the_free_section_and_hatches_smeared_ends():
    run = run_results()
    figure = plots.motion(run)
    assert figure.get_suptitle() == "v1 slows from 0.920 to 0.204 m/s"
    assert labels(figure) == [
        "displacement x / m", "velocity v / (m/s)", "time t / ms", "acceleration a / (m/s²)",
    ]  # fmt: skip
    spans = {bool(p.get_hatch()): [] for p in figure.axes[0].patches}
    for p in figure.axes[0].patches:
        spans[bool(p.get_hatch())].append((p.get_x(), p.get_x() + p.get_width()))
    assert spans[False] == [(20.0, 199.0)]
    assert spans[True] == [(0.0, GUARD), (199.0 - GUARD, 199.0)]


def test_a_push_does_not_dwarf_the_slide():
    run = run_results()
    a = run.motion.a.copy()
    a[GUARD : GUARD + 5] = 3000.0
    low, high = plots.motion(replace(run, motion=replace(run.motion, a=a))).axes[2].get_ylim()
    assert low < -FORCE / MASS < 0 < high < 100


def test_the_axis_of_the_velocity_holds_what_the_title_says():
    run = run_results(v0=1.0)  # slows until the last frame, which the filter smears
    run = replace(run, friction=replace(run.friction, free=np.ones(N, dtype=bool)))
    for figure in (plots.motion(run), plots.motions([run])):
        low, high = figure.axes[1].get_ylim()
        assert low < run.motion.v.min() < run.motion.v.max() < high


def test_motions_share_a_page_and_say_how_many_are_left_out():
    runs = [run_results(f"v{k}") for k in range(20)]
    figure = plots.motions(runs)
    assert len([ax for ax in figure.axes if ax.axison]) == 3 * 8
    assert figure.get_suptitle() == "20 runs with a highest speed of 1.0 m/s; the first 8 are drawn"
    assert plots.motions(runs[:1]).get_suptitle() == "1 run with a highest speed of 1.0 m/s"


def test_budgets_of_several_runs_have_a_mark_per_run_and_source():
    def one(mass):
        rows = [("pixel noise", 0.01), ("mass", mass), ("scale", None), ("total", 0.05)]
        return {"rows": [{"source": s, "mean_N": n, "frame_N": n} for s, n in rows], "says": []}

    figure = plots.budgets({"v1": one(0.02), "v2": one(0.03)})
    left = figure.axes[0]
    assert [t.get_text() for t in left.get_yticklabels()] == ["pixel noise", "mass", "scale", "total"]
    assert [line.get_xdata().tolist() for line in left.lines] == [[0.01, 0.02, 0.05], [0.01, 0.03, 0.05]]
    assert drawn(figure).count("not known") == 2
    assert figure.get_suptitle() == "Standard deviation of the mean force 0.050 N; largest source: mass"


def test_friction_leaves_out_what_the_filter_smears():
    run = run_results()
    figure = plots.friction([run])
    shown = figure.axes[0].lines[0].get_ydata()
    rows = np.flatnonzero(np.isfinite(shown))
    assert (rows[0], rows[-1]) == (20 + GUARD, N - GUARD - 1)
    np.testing.assert_array_equal(shown[rows], FORCE)
    assert figure.get_suptitle() == "Friction between 2.0 and 2.0 N at speeds from 0.24 to 0.88 m/s"
    with pytest.raises(ValueError, match="expected a run with a friction force but got none"):
        plots.friction([run_results(force=False)])


@pytest.mark.parametrize(("verdict", "word"), [("complete", "is complete"), ("missing", "fails"), (None, "Tustin:")])
def test_fit_says_whether_the_model_holds(verdict, word):
    run = run_results()
    m = model("1_tustin", 36.0, [run], found=verdict and diagnosis(verdict))
    figure = plots.fit(m, [run])
    assert word in figure.get_suptitle()
    assert "residual 36.0 µm, noise 10.0 µm" in figure.get_suptitle()
    force, left = figure.axes
    np.testing.assert_array_equal(force.lines[-1].get_ydata(), FORCE)
    np.testing.assert_allclose(np.abs(left.lines[0].get_ydata()), 36.0)
    measured, modelled = force.lines
    assert measured.get_linestyle() != modelled.get_linestyle()


def test_a_model_of_measured_forces_leaves_a_force():
    run = run_results()
    m = model("1_tustin", 36.0, [run], found=diagnosis("missing"))
    c = m.curves[0]
    low = Curve(c.t, c.x, c.sigma_x, c.x_model, c.v_model, c.a_model, c.F_model - 0.75, "v1")
    summary = m.summary | {"errors": m.summary["errors"] | {"rms_displacement_um": None}}
    m = replace(m, summary=summary, curves=(low,))
    figure = plots.fit(m, [run])
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), 0.75)
    assert "residual / N" in labels(figure)
    assert figure.get_suptitle() == "Tustin fails: force error 5.0 %"


def test_loops_are_drawn_about_the_middle_of_the_travel():
    run = run_results()
    m = model("1_tustin", 36.0, [run])
    left, right = plots.loops(m, [run]).axes
    x, v = m.curves[0].x, m.curves[0].v_model
    assert x.min() > 0.01  # m: all of the travel lies on one side of the origin
    assert (left.get_xlabel(), right.get_xlabel()) == ("displacement x from the middle / mm", "velocity v / (mm/s)")
    measured, modelled, *_ = left.lines
    np.testing.assert_allclose(measured.get_xdata(), 1e3 * (x - (x.min() + x.max()) / 2), atol=1e-9)
    np.testing.assert_array_equal(modelled.get_xdata(), measured.get_xdata())
    np.testing.assert_allclose(measured.get_ydata(), FORCE)
    np.testing.assert_allclose(right.lines[0].get_xdata(), 1e3 * v)


def test_segments_of_a_run_share_a_panel():
    run = run_results()
    m = model("1_tustin", 36.0, [run])
    c = m.curves[0]
    cut = [
        Curve(
            *(getattr(c, k)[part] for k in ("t", "x", "sigma_x", "x_model", "v_model", "a_model", "F_model")), run="v1"
        )
        for part in (slice(0, 80), slice(80, None))
    ]
    assert len(plots.fit(replace(m, curves=tuple(cut)), [run]).axes) == 2


def test_many_runs_show_those_that_fit_worst():
    runs = [run_results(f"v{i}") for i in range(20)]
    m = model("1_tustin", 10.0, runs)
    curves = tuple(curve(r, (30 if i >= 12 else 10) * 1e-6) for i, r in enumerate(runs))
    figure = plots.failing(replace(m, curves=curves), runs, [])
    titles = [ax.get_title(loc="left").split(":")[0] for ax in figure.axes]
    assert titles == [f"v{i}" for i in range(12, 20)]


def test_failing_span_is_marked_with_its_share():
    r = results()
    first = r.models[0]
    figure = plots.failing(first, r.runs, first.diagnosis["fails_at"])
    label = next(t for t in figure.axes[0].texts if t.get_text() == "41 %")
    assert label.get_position()[0] == pytest.approx(60.0)  # middle of 50 to 70 ms
    assert figure.get_suptitle() == "Tustin fails most in v1 from 50.0 to 70.0 ms: 41 % of the error"
    assert plots.failing(first, r.runs, []).get_suptitle() == "Tustin: residual up to 36.0 µm, noise 10.0 µm"


def bars(figure) -> dict:
    ax = figure.axes[0]
    names = [t.get_text() for t in ax.get_yticklabels()]
    return {name: p for name, p in zip(names, ax.patches, strict=True)}


def test_candidates_that_pass_are_filled():
    found = [candidate("texture", 0.001, 812.0), candidate("patch", 0.2, 300.0), candidate("lens", 0.001, -12.0)]
    figure = plots.candidates(diagnosis("missing", found, ["texture"]))
    shown = bars(figure)
    assert [name for name, bar in shown.items() if not bar.get_hatch()] == ["texture"]
    assert shown["texture"].get_width() == pytest.approx(812.0)
    assert figure.get_suptitle() == "texture explains most"
    assert figure.axes[0].get_xscale() == "linear"


def test_colours_of_candidates_say_what_they_mean_and_a_common_p_is_said_once():
    found = [
        candidate("lens", 0.001, 900.0) | {"heldout_rms_after_um": 15.0},
        candidate("texture", 0.001, 812.0, ["patch"]),
        candidate("patch", 0.001, 811.0) | {"heldout_rms_after_um": 10.3},
    ]
    figure = plots.candidates(diagnosis("missing", [found[1], found[0], found[2]], ["texture"]))
    shown = {name: bar.get_facecolor() for name, bar in bars(figure).items()}
    assert list(shown) == ["texture", "patch", "lens"]  # found, its rival, the others
    assert len(set(shown.values())) == 3
    words = drawn(figure)
    assert sum("p at most 1/1000" in text for text in words) == 1
    assert " +812, held-out error 10.2 µm" in words
    found[0]["p"] = 0.002
    assert sum(" p " in text for text in drawn(plots.candidates(diagnosis("missing", found, ["texture"])))) == 3


def test_candidates_far_apart_get_a_logarithmic_axis():
    found = [candidate("texture", 0.001, 81200.0), candidate("patch", 0.001, 30.0)]
    assert plots.candidates(diagnosis("missing", found, ["texture"])).axes[0].get_xscale() == "log"


def test_rivals_are_named_in_the_title_and_have_their_colour():
    found = [candidate("a", 0.001, 90.0, ["b"]), candidate("b", 0.001, 89.0, ["a"]), candidate("c", 0.3, 2.0, ["a"])]
    figure = plots.candidates(diagnosis("ambiguous", found, ["a"]))
    assert figure.get_suptitle() == "a explains most, but b cannot be distinguished from it"
    assert bars(figure)["b"].get_facecolor() == mpl.colors.to_rgba(style.ORANGE)
    assert "predicts the same data" in drawn(figure)


def test_no_candidate_passes():
    figure = plots.candidates(diagnosis("complete", [candidate("lens", 0.9, -5.0)]))
    assert figure.get_suptitle() == "No candidate is significant for the whole search"


def test_scan_marks_the_best_setting_over_all_others():
    places, widths = np.meshgrid(np.linspace(0, 0.5, 11), np.geomspace(0.01, 0.1, 6))
    rise = np.exp(-(((places - 0.2) / 0.05) ** 2)) * np.exp(-(np.log(widths / 0.04) ** 2))
    curves = {"x_c": places.ravel(), "w": widths.ravel(), "rise": rise.ravel(), "limit": rise.ravel()}
    assert plots.has_scan(curves) == "x_c"
    figure = plots.scan("patch", curves)
    ax = figure.axes[0]
    marker = ax.lines[-1]
    assert marker.get_xdata()[0] == pytest.approx(200.0)  # mm
    np.testing.assert_allclose(ax.lines[0].get_ydata(), rise.max(axis=0))
    assert ax.get_xlabel() == "place / mm"
    assert figure.get_suptitle() == "patch fits best at a place near 200 mm"


def test_nothing_scanned_is_said():
    assert plots.has_scan({"limit": np.ones(1), "rise": np.ones(1)}) is None
    with pytest.raises(ValueError, match='expected the scan of an effect but "drag" has no setting'):
        plots.scan("drag", {"limit": np.ones(1), "rise": np.ones(1)})


def test_history_falls_to_the_noise():
    figure = plots.history(results().models)
    ax = figure.axes[0]
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [39.6, 11.0])
    np.testing.assert_allclose(ax.lines[-1].get_ydata(), 10.0)
    assert figure.get_suptitle() == "Held-out error falls from 39.6 to 11.0 µm, noise 10.0 µm"
    assert [t.get_text() for t in ax.get_xticklabels()] == ["Tustin", "+ texture"]


def test_limits_show_what_depends_on_a_setting():
    r = results()
    assert plots.has_limits(r.diagnosis, r.figures) == ["texture"]
    ax = plots.limits(r.diagnosis, r.figures).axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("period / mm", "size / mN")
    with pytest.raises(ValueError, match="expected the curve of a detection limit"):
        plots.limits(r.diagnosis, {})


@pytest.mark.parametrize(
    ("written", "label"),
    [("m/s", "q / (m/s)"), ("N s^2/m^2", "q / (N s²/m²)"), ("µm", "q / µm"), ("1", "q")],
)
def test_axis_labels_are_quantity_over_unit(written, label):
    assert style.axis_label("q", written) == label


@pytest.mark.parametrize(
    ("group", "name"),
    [("1_tustin", "Tustin"), ("2_tustin+texture", "Tustin + texture"), ("3_atm1:2", "ATM1:2"),
     ("1_coulomb+viscous", "Coulomb + viscous"), ("4_stribeck-model", "Stribeck model")],
)  # fmt: skip
def test_model_names_in_words(group, name):
    assert plots.plain_name(group) == name


def decoded(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.slow
def test_ticks_drawn_in_rows_look_as_matplotlib_draws_them():
    again = all_figures()
    for name, figure in all_figures().items():
        fast, usual = decoded(plots.png(figure, dpi=90)), BytesIO()
        with mpl.rc_context(RC_PARAMS):
            again[name].savefig(usual, format="png", dpi=90)
        assert np.array_equal(fast, decoded(usual.getvalue())), name


# --- legends, limits and shared axes


@pytest.mark.parametrize("count", [1, 5, 12])
def test_a_legend_is_as_wide_as_its_figure_at_most(count):
    figure = style.new_figure(3.0, "", width=6.0)
    ax = figure.subplots()
    for k in range(count):
        ax.plot([], [], label=f"a curve with a long name {k}")
    style.legend_below(figure)
    plots.png(figure, dpi=72)
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1
    assert len(figure.legends[0].get_texts()) == count


def test_runs_of_different_lengths_have_their_own_time_axes():
    long, short = run_results("long", 1.0), run_results("short", 1.0)
    short = replace(short, motion=replace(short.motion, t=short.motion.t / 4), friction=None)
    figure = plots.motions([long, short])
    ends = {
        ax.get_title(loc="left") or ax.get_title(): ax.get_xlim()[1] for ax in figure.axes if ax.get_title(loc="left")
    }
    assert ends["long"] == pytest.approx(1e3 * long.motion.t[-1])
    assert ends["short"] == pytest.approx(1e3 * short.motion.t[-1])


def test_the_force_of_the_model_is_left_out_where_the_filter_smears_it():
    run = run_results("v1", 1.0)
    one = replace(curve(run, 1e-6), F_filtered=np.where(np.arange(len(curve(run, 1e-6).t)) < 10, 50.0, 1.0))
    tried = replace(model("1_tustin", 10.0, [run]), curves=(one,))
    force = plots.modelled_force(tried, one, run)
    assert np.nanmax(force) == 1.0
    assert np.nanmax(plots.modelled_force(tried, one)) == 50.0


@pytest.mark.parametrize("ends", [(0.0096, 0.0152), (3.3e-4, 7.3e-4), (0.9, 4.4), (0.001, 900.0)])
def test_a_logarithmic_axis_has_at_least_two_ticks_and_not_too_many(ends):
    ax = Figure(figsize=(4, 2)).subplots()
    ax.plot(ends, [0, 1], "o")
    style.log_axis(ax, "x")
    low, high = ax.get_xlim()
    assert 2 <= sum(low <= tick <= high for tick in ax.get_xticks()) <= 8
