"""Where the user looks, what a run does and what a word means, on the page of a finished study."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs

import numpy as np
import pytest
from browser import CHROMIUM, Open, Serve, Server
from test_plots import results

from frictrack.present.report.texts import study_verdict
from frictrack.results import OutdatedPart
from frictrack.workbench.job_process import ProgressFile
from frictrack.workbench.jobs import Job
from frictrack.workbench.plot_data import comparison_plots
from frictrack.workbench.summaries.models import value_text, verdict_of

browsed = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")


def test_progress_names_its_step_and_leaves_counts_of_runs_to_the_page(tmp_path):
    progress = ProgressFile(tmp_path / "progress.jsonl")
    progress(0, 0, "measuring 4 runs up to friction")
    progress(390, 400, "fast: follow")
    progress(1, 4, "runs")
    (tmp_path / "spec.json").write_text('{"do": "run", "told": {}, "study": "s", "at": 0.0}', encoding="utf-8")
    summary = Job(tmp_path).summary
    assert (summary["step"], summary["what"]) == ("Measure the runs", "fast: follow")
    progress(0, 0, "diagnosing 1_tustin")
    progress(1, 3, "refining every effect that may explain the misfit")
    assert Job(tmp_path).summary["step"] == "Find what is missing"


def test_an_old_model_is_not_drawn_over_runs_that_were_measured_again():
    study = results()
    assert study.current is not None
    before = comparison_plots(study, study.current).columns
    first = np.arange(len(before["t"])) < len(study.runs[0].motion)  # of v1, which has the new scale already
    new = replace(study.runs[0], displacement=replace(study.runs[0].displacement, x=10 * study.runs[0].displacement.x))
    old = (
        OutdatedPart("model", "2_tustin+texture", "scale was changed", "fit"),
        OutdatedPart("motion", "v2", "", "run"),
    )
    changed = replace(study, runs=(new, study.runs[1]), outdated_parts=old)
    after = comparison_plots(changed, study.current).columns
    for key in ("F_model", "left"):
        assert np.isfinite(before[key][first]).any()
        assert np.isnan(after[key][first]).all()
        np.testing.assert_array_equal(after[key][~first], before[key][~first])
    np.testing.assert_array_equal(after["F"], before["F"])
    only_model = replace(study, outdated_parts=old[:1])  # a bound was changed: nothing was measured again
    np.testing.assert_array_equal(comparison_plots(only_model, study.current).columns["F_model"], before["F_model"])


def test_errors_of_an_old_measurement_are_not_compared_with_new_ones():
    study = results()
    assert "held-out error falls" in " ".join(study_verdict(study).sentences)
    old = OutdatedPart("model", study.models[0].name, "v1 was measured again", "fit")
    assert "held-out error" not in " ".join(study_verdict(replace(study, outdated_parts=(old,))).sentences)


def test_every_model_has_its_own_verdict():
    study = results()
    told = [verdict_of(study, model) for model in study.models]
    assert [one and one["verdict"] for one in told] == ["missing", "complete"]
    assert told[0] is not None
    assert told[0]["title"] == "Tustin lacks texture"
    assert verdict_of(study, replace(study.models[0], diagnosis=None)) is None


def test_a_friction_parameter_has_its_coefficient():
    value = {"value": 1.2, "std": 0.1, "unit": "N", "mu": {"value": 0.35, "std": 0.03}}
    assert value_text(value).replace("\N{NO-BREAK SPACE}", " ") == "1.20 ± 0.10 N, µ = 0.35 ± 0.03"
    assert value_text(value | {"std_misfit": 0.3}).startswith("1.2 ± 0.3 N †, ")


@browsed
def test_three_films_that_wait_are_not_97_percent(tables: Server, tab: Open) -> None:
    page = tab().open(tables)
    told = page.page.evaluate(
        """async () => {
            const { progressOf, stateOf } = await import("/static/page/selectors.js");
            const runs = ["measured", "measured", "tracked", "new"].map((state, k) => ({ name: `r${k}`, state }));
            const outdated = [{ what: "motion", name: "r1" }], s = { study: { runs, outdated } };
            const job = { step: "Measure the runs", words: "Run", what: "r2: follow", done: 97, total: 100 };
            return [progressOf(s, job), stateOf(s, runs[1]), progressOf(s, { ...job, step: "Fit the model" })];
        }"""
    )
    assert told[0] == {"step": "Measure the runs: 1 of 4", "share": 0.25}  # r1 is measured again
    assert told[1] == "new"
    assert told[2] == {"step": "Fit the model", "share": 0.97}


@browsed
def test_numbers_are_written_for_people_and_typed_for_the_study_file(tables: Server, tab: Open) -> None:
    page = tab().open(tables)
    told = page.page.evaluate(
        """async () => {
            const { digits, typed } = await import("/static/page/format.js");
            return [digits(1.21e-5), digits(-2e6), digits(12345.6, 5), typed(12345.678), typed(0.02)];
        }"""
    )
    assert told == ["1.21 × 10⁻⁵", "\u22122.00 × 10⁶", "12\u202f346", "12345.7", "0.02"]


def ends(address: str) -> list[float]:
    """Ends of the ranges that an address zooms to."""
    asked = parse_qs(address[address.index("#") + 1 :])
    return [float(end) for axis in ("x", "y") for one in asked.get(axis, []) for end in one.split("@")[0].split(",")]


@browsed
def test_a_view_that_is_opened_again_has_its_plots_and_the_focus_as_before(
    measured_tables: Path, tmp_path: Path, serve: Serve, tab: Open
) -> None:
    server = serve(shutil.copytree(measured_tables, tmp_path, dirs_exist_ok=True))
    page = tab().open(server).to("Motion")
    large = page.page.get_by_role("button", name="Enlarge Velocity")
    large.focus()
    large.press("Enter")
    page.page.keyboard.press("4")
    page.page.get_by_role("tabpanel", name="Model").wait_for()
    page.page.keyboard.press("3")
    page.until(lambda: page.page.evaluate("document.activeElement.getAttribute('aria-label')") == "Enlarge Velocity")
    assert page.page.locator(".fp-plot:visible").count() == 1
    page.page.get_by_role("button", name="Enlarge Velocity").press("Enter")
    page.page.get_by_role("button", name="Move Velocity").press("ArrowLeft")
    page.until(lambda: "order=" in page.page.url)
    plot = page.page.get_by_role("application", name="Velocity: ")
    whole = page.page.evaluate(drawn := "document.querySelectorAll('.fp-base')[1].toDataURL()")
    plot.press("+")
    page.until(lambda: "x=" in page.page.url and "y=" in page.page.url)
    zoomed = page.page.evaluate(drawn)
    assert zoomed != whole
    page.page.keyboard.press("4")
    page.until(lambda: "tab=model" in page.page.url and "x=" not in page.page.url)  # each tab has its own
    page.page.keyboard.press("3")
    page.until(lambda: "tab=motion" in page.page.url and page.page.evaluate(drawn) == zoomed)
    other = tab()
    other.page.goto(f"{server.address}{page.page.url[page.page.url.index('#') :]}")
    shown = "[...document.querySelectorAll('.fp-move')].map((n) => n.getAttribute('aria-label').slice(5))"
    other.until(lambda: other.page.evaluate(shown) == page.page.evaluate(shown) != [])
    assert other.page.evaluate(shown).index("Velocity") < other.page.evaluate(shown).index("Displacement")
    plot = other.page.get_by_role("application", name="Velocity: ")
    plot.press("-")  # the address is what the plots show: now all data, to the rounding of the address
    other.until(lambda: "y=" in other.page.url and ends(other.page.url) != ends(page.page.url))
    page.page.get_by_role("application", name="Velocity: ").press("-")
    page.until(lambda: ends(page.page.url) == pytest.approx(ends(other.page.url), rel=1e-5, abs=1e-9))
    plot.press("0")
    other.until(lambda: "x=" not in other.page.url and other.page.evaluate(drawn) == whole)


@pytest.mark.slow
@browsed
def test_a_link_opens_the_same_run_frame_and_selection(sample: Server, tab: Open) -> None:
    page = tab()
    page.page.goto(f"{sample.address}#tab=film&run=slow&frame=40%40slow&select=30-49%40slow&hide=fast")
    page.page.get_by_role("tab", name="Film", selected=True).wait_for()
    page.sees("slow · frame 40 of")
    page.sees("20 frames selected: 20 in slow")
    page.to("Compare")
    page.sees("20 frames selected: 20 in slow")  # the same frames
    page.sees("slow · frame 40 of")
    page.until(lambda: "select=30-49" in page.page.url and "tab=compare" in page.page.url)
    hidden = page.page.locator(".fp-entry[aria-pressed=false]")
    assert hidden.all_inner_texts() == ["fast"]
    hidden.click()
    page.until(lambda: "hide=" not in page.page.url)


@pytest.mark.slow
@browsed
def test_a_plot_and_a_figure_are_shown_large_and_words_are_explained(sample: Server, tab: Open) -> None:
    page = tab().open(sample).to("Compare")
    page.page.locator(".fp-plot").first.hover()
    page.page.locator(".fp-plot .fp-enlarge").first.click()
    assert page.page.locator(".fp-plot:visible").count() == 1
    page.page.locator(".fp-plot .fp-enlarge").first.click()
    assert page.page.locator(".fp-plot:visible").count() > 3
    page.page.locator(".ui-sheet").first.click()
    page.page.get_by_role("dialog").wait_for()
    page.page.keyboard.press("Escape")
    title = page.page.locator(".ui-brief abbr").first.get_attribute("title")
    assert title is not None
    assert "degree of freedom" in title


@pytest.mark.slow
@browsed
def test_the_picture_of_the_film_is_adjusted_without_a_change_of_the_study(sample: Server, tab: Open) -> None:
    page = tab().open(sample).to("Film")
    before = sample.study_text
    picture = "document.querySelector('.fp-picture').toDataURL()"
    page.until(lambda: page.page.evaluate("!!document.querySelector('.fp-label')?.textContent"))
    seen = {page.page.evaluate(picture)}
    for act in (
        lambda: page.page.get_by_label("Contrast").fill("2"),
        lambda: page.page.get_by_label("Brightness").fill("1.5"),
        lambda: page.click("Show the path of the target"),
        lambda: page.click("Zoom in (Ctrl and the wheel)"),
    ):
        act()
        page.until(lambda: page.page.evaluate(picture) not in seen)
        seen.add(page.page.evaluate(picture))
    assert sample.study_text == before


@pytest.mark.slow
@browsed
def test_every_axis_has_two_ticks_at_least(sample: Server, tab: Open) -> None:
    page = tab().open(sample)
    worst = page.page.evaluate(
        """async () => {
            const { ticks } = await import("/static/plots/axis.js");
            let least = 9;
            for (let k = 0; k < 2000; k++) {
                const low = Math.sin(k) * 10 ** (k % 9 - 4), span = 10 ** ((k % 13) / 2 - 4);
                for (const n of [0.5, 1, 2, 5]) least = Math.min(least, ticks(low, low + span, n).values.length);
            }
            return least;
        }"""
    )
    assert worst >= 2


@browsed
def test_keys_of_the_study_and_settings_of_a_search_are_typed_on_the_page(tables: Server, tab: Open) -> None:
    page, asked = tab(), []
    page.page.route(
        "**/api/job", lambda route: (asked.append(route.request.post_data_json), route.fulfill(json={"job": None}))
    )
    page.open(tables).to("Model")
    page.fill("Functions of z for an unexplained force", "z^2*exp(-z); tanh(z)").hears("functions set.")
    assert 'functions = ["z^2*exp(-z)", "tanh(z)"]' in tables.study_text
    page.fill("Conditions, compared by frictrack batch", "temperature = 20 degC, oil = 3").hears("conditions set.")
    assert 'temperature = "20 degC"' in tables.study_text
    page.page.get_by_label("Search", exact=True).select_option("ga")
    page.fill("Population", "40").fill("Crossover", "0.8")
    page.fill("Generations", "25").click("Fit")
    page.until(lambda: len(asked) == 1)
    assert asked[0]["arguments"]["settings"] == {"population": "40", "generations": "25", "crossover": "0.8"}
    page.fill("Conditions, compared by frictrack batch", "nonsense").hears("Expected conditions like")
    page.faults.clear()
