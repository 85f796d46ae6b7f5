"""The report needs nothing outside itself, says the verdict in words, and rounds to what is known."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from test_plots import candidate, diagnosis, model, parameter, results

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import upper_first
from frictrack.cli import output
from frictrack.fit.penalties import SCATTER_BOUNDS
from frictrack.present import report
from frictrack.present.report import tables, texts
from frictrack.present.report.texts import next_steps
from frictrack.workbench.summaries import _measured_part

MINUS = "\N{MINUS SIGN}"


class Page(HTMLParser):
    """What a browser would fetch, the ids, and the words on the page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.ids: Counter[str] = Counter()
        self.tags: Counter[str] = Counter()
        self.words = ""
        self._silent = False
        self.feed(text)
        self.words = " ".join(self.words.split())

    def handle_starttag(self, tag, attrs):
        self.tags[tag] += 1
        self._silent = tag in ("style", "script")
        for key, value in attrs:
            if key in ("src", "href", "xlink:href", "data", "action", "poster", "srcset"):
                self.fetched.append(value)
            if key == "id":
                self.ids[value] += 1

    def handle_data(self, data):
        self.words += "" if self._silent else data


@pytest.fixture(scope="module")
def text() -> str:
    return report.render(results(film=True))


@pytest.fixture(scope="module")
def page(text) -> Page:
    return Page(text)


@pytest.fixture
def quick(monkeypatch):
    """Figures are made but not written out: where only the words matter."""
    monkeypatch.setattr("frictrack.present.plots.svg", lambda figure: "<svg></svg>")


def test_page_fetches_nothing_from_outside(text, page):
    assert page.fetched
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in page.fetched)
    assert not re.search(r"@import|url\((?!#)|<script [^>]*src|<link|<iframe|fetch\(|XMLHttpRequest|import\(", text)
    assert page.tags["img"] == 2  # first frames
    assert page.tags["svg"] >= 7


def test_ids_are_unique_and_inner_links_lead_somewhere(page):
    assert [name for name, n in page.ids.items() if n > 1] == []
    assert {a[1:] for a in page.fetched if a.startswith("#")} <= set(page.ids)


def test_every_section_is_there(page):
    for section in (
        "film", "motion", "friction", "model", "missing", "history", "parameters", "limits", "findings", "record",
    ):  # fmt: skip
        assert section in page.ids


def test_verdict_comes_first_and_tells_the_story(page):
    assert "Tustin + texture is complete: no further effect is detectable in these runs" in page.words
    assert "2 runs were fitted with Coulomb friction, viscous friction and texture." in page.words
    assert "Tustin lacked texture (what texture is; p at most 1/1000, delta BIC +812)" in page.words
    assert "the held-out error falls from 39.6 to 11.0 µm" in page.words
    assert "the residual is 10.0 µm, the noise 10.0 µm, lack of fit: p 0.30" in page.words
    assert page.words.index("Tustin + texture is complete") < page.words.index("Film and track")


def test_one_line_says_what_no_fit_can_show(page):
    assert "Forces are proportional to the mass, the scale and the square of the frame rate" in page.words


def test_parameters_are_rounded_and_explained(page):
    assert "8.01 ± 0.02 N" in page.words
    assert "not determined" in page.words
    assert "the slowest speed seen is 2 m/s: film a run that stops" in page.words
    assert "at its bound" in page.words
    assert "scatters between runs by 2.1 ± 0.8 %" in page.words


def test_a_scatter_at_its_lower_bound_is_said_in_words(quick):
    r = results()
    at_bound = {"value": SCATTER_BOUNDS[0], "std": 0.4 * SCATTER_BOUNDS[0]}
    m = replace(r.current, summary={**r.current.summary, "friction_scatter": at_bound}, current=True)
    words = Page(report.render(replace(r, models=(m,)))).words
    assert words.lower().count("no scatter of dry friction between runs is seen") == 2  # folded line and section
    assert "scatters between runs" not in words


def test_findings_hashes_and_versions_are_kept(page):
    for told in ("from here to there", "cut-off 120 Hz", "a remark", "cdcdcdcdcd", "ababababab", "frictrack 0.1.0"):
        assert told in page.words
    assert "the fitted law absorbs it" in page.words


def test_names_cannot_break_the_page(quick):
    r = results()
    text = report.render(replace(r, name="<script>alert(1)</script>"))
    assert "alert(1)</script>" not in text
    assert text.count("<script>") == 1  # that of the page
    assert "oiled &lt;twice&gt;" in text


def with_diagnosis(found):
    r = results()
    m = replace(r.models[0], diagnosis=found, current=True)
    return replace(r, models=(m,), diagnosis=found)


def test_missing_says_what_it_is_and_how_to_confirm():
    found = diagnosis("missing", [candidate("texture", 0.001, 812.0)], ["texture"])
    verdict = texts.study_verdict(with_diagnosis(found))
    told = " ".join(verdict.sentences)
    steps = " ".join(next_steps(with_diagnosis(found)))
    assert verdict.headline == "Tustin lacks texture"
    assert "Missing: <b>texture</b> (what texture is; p at most 1/1000, delta BIC +812" in told
    assert "the held-out error falls from 21.2 to 10.2 µm" in told
    assert "<code>frictrack add study.toml texture</code>" in steps
    assert "To confirm <b>texture</b>: give a <code>reference</code>." in steps


def test_ambiguous_with_a_formula_says_how_to_add_either():
    found = diagnosis("ambiguous", [candidate("patch", 0.001, 300.0)], ["patch"])
    found["unexplained"] = {"rival": "a formula of place", "axis": "x", "formulas": []}
    steps = " ".join(next_steps(with_diagnosis(found)))
    assert "<b>patch</b> explains: <code>frictrack add study.toml patch</code>" in steps
    assert "a formula of place explains: <code>frictrack add study.toml formula:1</code>" in steps


def test_ambiguous_names_the_group_and_what_would_settle_it(quick):
    best = candidate("vibration", 0.001, 300.0, ["camera_shake"])
    found = diagnosis("ambiguous", [best, candidate("camera_shake", 0.001, 299.0, ["vibration"])], ["vibration"])
    found["next_experiment"] = [{"what": "Film a fixed mark.", "separates": ["vibration", "camera_shake"]}]
    verdict = texts.study_verdict(with_diagnosis(found))
    told = " ".join(verdict.sentences)
    assert verdict.headline == "Tustin lacks vibration or camera_shake: these runs cannot distinguish them"
    assert "<b>camera_shake</b> would predict the same data" in told
    page = Page(report.render(with_diagnosis(found)))
    assert "To settle it: film a fixed mark. See next experiments." in page.words
    assert "predicts the same data as vibration" in page.words


def test_unexplained_shows_where_it_repeats(quick):
    curve = {"axis": "x", "curve": [[0.0, 1.0], [0.1, -1.0]], "formulas": []}
    found = diagnosis("unexplained", [candidate("lens", 0.4, 3.0)], unexplained=curve)
    page = Page(report.render(with_diagnosis(found)))
    assert "Tustin lacks something that no effect of the library explains" in page.words
    assert "The remaining misfit repeats best with place." in page.words
    assert "not significant" in page.words


def test_complete_at_once():
    verdict = texts.study_verdict(with_diagnosis(diagnosis("complete")))
    assert verdict.headline == "Tustin is complete: no further effect is detectable in these runs"
    assert "detection limits" in " ".join(verdict.sentences)


def test_measured_only_is_a_report_too(quick):
    r = results()
    page = Page(report.render(replace(r, models=(), diagnosis=None, figures={})))
    assert "Measured, not yet fitted" in page.words
    assert "motion" in page.ids
    assert "parameters" not in page.ids


def test_runs_without_mass_have_no_force(quick):
    r = results()
    page = Page(report.render(replace(r, runs=tuple(replace(run, friction=None) for run in r.runs))))
    assert "friction" not in page.ids


def test_predicted_runs_are_marked(quick):
    r = results()
    m = r.models[-1]
    rows = [m.summary["per_run"][0], m.summary["per_run"][1] | {"role": "validation"}]
    m = replace(m, summary=m.summary | {"per_run": rows})
    page = Page(report.render(replace(r, models=(r.models[0], m))))
    assert "predicted, not fitted" in page.words


def test_papers_route_stands_beside_the_default(quick):
    r = results()
    papers = model("papers", 12.0, r.runs, effects=("coulomb", "viscous"))
    papers = replace(papers, summary=papers.summary | {"domain": "force", "search": "sga"})
    page = Page(report.render(replace(r, papers=papers)))
    assert "papers" in page.ids
    assert "displacement domain, varpro" in page.words
    assert "force domain, sga" in page.words


def test_errors_of_every_model_stand_in_the_unit_of_their_column():
    errors = {"rms_displacement_um": 12.34, "free_run_relative": 0.012, "relative_force_error": 0.0341}
    first, last = model("1_coulomb", 20.0, [], current=False), model("2_tustin", 10.0, [], found=diagnosis("missing"))
    tried = [
        replace(first, summary=first.summary | {"errors": {"rms_displacement_um": 20.0}}),
        replace(last, summary=last.summary | {"errors": errors}),
    ]
    made = tables.history_table(tried)
    units = ("displacement, rms / µm", "free run, relative / %", "filtered force error / %")
    assert made.heads == ("model", *units, "verdict")
    assert made.rows == (
        ("1. Coulomb", "20.0", "–", "–", ""),
        ("2. Tustin (current)", "12.3", "1.20", "3.41", "missing"),
    )


def test_parameters_of_single_runs_stand_with_their_run():
    r = results()
    m = r.models[-1]
    own = {f"vibration.phase[{run.name}]": parameter(k + 0.5, 0.1, "rad") for k, run in enumerate(r.runs)}
    m = replace(m, summary=m.summary | {"parameters": m.summary["parameters"] | own})
    assert "vibration.phase" not in " ".join(str(row[0]) for row in tables.parameter_table(m).rows)
    shown = tables.run_table(m)
    assert shown.heads[-1] == "vibration.phase"
    assert [row[-1] for row in shown.rows] == ["0.50 ± 0.10 rad", "1.50 ± 0.10 rad"]


def test_write_replaces_the_report_whole(tmp_path, quick):
    path = report.write(results(), tmp_path / "out" / "report.html")
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no Chromium here: apt-get install chromium")
def test_it_is_printed_to_a_pdf_of_several_pages(text, tmp_path):
    page = tmp_path / "a report.html"
    page.write_text(text, encoding="utf-8")
    sheet = report.print_pdf(page)
    assert sheet == tmp_path / "a report.pdf"
    content = sheet.read_bytes()
    assert content.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type\s*/Page\b", content)) > 5
    assert sorted(tmp_path.iterdir()) == [page, sheet]


def test_without_a_browser_the_way_to_a_pdf_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(FrictrackError, match=r"expected Chromium, Chrome or Edge.*open .*report\.html in any browser"):
        report.print_pdf(tmp_path / "report.html")


def test_a_report_that_cannot_be_written_leaves_the_old_one(tmp_path, quick, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("the old one")

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(
        FrictrackError, match=r"cannot write .*report\.html: No space left on device; the old file is unchanged"
    ):
        report.write(results(), path)
    assert path.read_text() == "the old one"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_formulas_are_set():
    text = tables.mark_equation("F = (F_s - F_c) L s exp(-(|v|/v_s)^delta) + a sin(2 pi f t) <b>")
    assert "F<sub>s</sub> − F<sub>c</sub>" in text
    assert "exp(−(|v|/v<sub>s</sub>)<sup>δ</sup>)" in text
    assert "2 π f" in text
    assert "&lt;b&gt;" in text


def test_commands_in_words_are_set_as_code():
    assert tables.mark_code("give it as `reference` <now>") == "give it as <code>reference</code> &lt;now&gt;"


# ---- how well the films were measured


QUALITY = {
    "frames": 200, "found": 200, "lost": {}, "sigma_px": 0.002, "sigma_um": 1.0, "score": 0.999, "lowest_score": 0.99,
    "peak_locking_px": 0.0002, "peak_locking_std_px": 0.0003, "forward_backward_px": 1e-4,
    "forward_backward_sigmas": 0.05, "reference": [1, 2, 30, 40], "noise_floor_px": 0.01, "noise_floor_um": 5.0,
    "shake_px": 0.0, "shake_Hz": None, "exposure_s": 5e-5, "blur_px": 0.3,
    "timebase": [{"what": "frame rate, given", "value": "4000 fps", "verdict": "used"}],
}  # fmt: skip


def measured(**changes):
    found = results(film=True)
    runs = [replace(r, quality=QUALITY | (changes if k == 0 else {})) for k, r in enumerate(found.runs)]
    return replace(found, runs=tuple(runs))


def test_a_good_measurement_is_said_in_two_sentences():
    told = texts.measurement(measured().runs)
    assert [str(s) for s in told] == [
        "Position standard deviation per frame: 0.0020 px (1.0 µm); standard deviation of a fixed reference: 0.010 px.",
        "All measurement self-checks passed.",
    ]
    made = tables.measurement_table(measured().runs)
    assert made.heads[-2:] == ("blur / px", "exposure / µs")
    assert made.rows[0][-3:] == ("none", "0.30", "50.0")
    assert texts.measurement(results().runs) == []


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"found": 188}, "the target was lost in 12 of 200 frames"),
        ({"shake_px": 0.41, "shake_Hz": 87.0}, "camera shake of 0.41 px at 87.0 Hz was subtracted"),
        ({"peak_locking_px": 0.002}, "peak locking shifts positions by 0.0020 px"),
        ({"forward_backward_sigmas": 2.0}, "positions tracked backward differ by"),
        ({"blur_px": 1.4}, "the target moves 1.4 px during the exposure of a frame"),
        (
            {"timebase": [{"what": "frame rate, header", "value": "30 fps", "verdict": "disagrees"}]},
            "frame rate, header: 30 fps, disagrees",
        ),
    ],
)
def test_the_worst_of_a_measurement_is_said(changes, said, monkeypatch):
    monkeypatch.setattr("frictrack.present.plots.svg", lambda figure: "<svg></svg>")
    found = measured(**changes)
    assert said in texts.measurement(found.runs)[1]
    assert said in report.render(found)


def test_nothing_fixed_in_the_picture_is_said():
    found = measured()
    runs = [replace(r, quality=r.quality | {"noise_floor_px": None}) for r in found.runs]
    assert "no fixed reference was found" in texts.measurement(runs)[0]


def test_a_target_that_leaves_the_picture_fails_no_check():
    (run, *_) = measured(found=188).runs
    track = replace(run.track, x_px=np.where(np.arange(200) >= 188, np.nan, run.track.x_px))
    assert texts.failed_checks(replace(run, track=track)) == []


def test_lost_frames_have_one_wording_on_terminal_page_and_report():
    words = "the target was lost in 12 of 200 frames"
    found = measured(found=188)
    run = found.runs[0]
    track = replace(run.track, x_px=np.where(np.arange(200) < 12, np.nan, run.track.x_px))
    assert report.render(found).count(words) == 2  # the line of the section, and in it
    assert _measured_part(replace(run, track=track))["lost_words"] == f"{upper_first(words)}."
    out = Console(file=StringIO(), width=200)
    row = run.quality | {"run": "v1", "target": "found", "lost": {"low score": 12}, "notes": []}
    output.track(out, {"runs": [row | {"contact_sheet": "", "overlay": ""}]})
    assert f"{words}: 12 x low score" in out.file.getvalue()
