"""The pages that are written by code: one for every effect, command, key and public name; nothing is left out."""

# ruff: noqa: E402 - the generators are found in a folder of the documentation

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import frictrack
from frictrack import effects
from frictrack.diagnose.compare import find_local_forces
from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.repeatability import WaveScan
from frictrack.diagnose.residual_curves import deconvolve_force
from frictrack.present import plots
from frictrack.study import schema

pytest.importorskip("numpydoc", reason="the documentation needs the extra docs")
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "generators"))

import command_line
import figure_pictures
import gallery
import gallery_fit
import gallery_runs
import gallery_separation
import json_meanings
import json_reference
import page_text
import python_api
import scene_file
import study_file

EXTERNAL = re.compile(r"""<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=["'](https?:)?//""")
LINK = re.compile(r"""<a\b[^>]*?\bhref=["']([^"'#?]+)""")


def test_every_public_name_has_a_page_and_an_example():
    pages = [page for group in python_api.GROUPS for full in python_api.full_names(group) for page in [full]]
    assert sorted(set(python_api.public_names()) - set(pages)) == []
    assert len(pages) == len(set(pages))
    functions = [name for name in python_api.public_names() if not inspect.ismodule(python_api.resolve(name))]
    without = [n for n in functions if ">>>" not in inspect.getdoc(python_api.resolve(n)) and n != _error_name()]
    assert without == []


def _error_name():
    return f"frictrack.{frictrack.FrictrackError.__name__}"


def test_every_figure_and_every_member_of_a_public_module_has_a_page():
    figures = python_api.full_names(next(g for g in python_api.GROUPS if g.title == "Figures"))
    drawn = {f"frictrack.present.plots.{n}" for n, found in vars(plots).items() if python_api.returns_figure(found)}
    assert drawn <= set(figures)
    assert {f"frictrack.effects.models.{n}" for n in ("tustin", "atm1", "of")} <= python_api.pages_of(
        "frictrack.effects.models"
    ).keys()


def test_the_pages_of_figures_show_the_code_that_draws_them():
    assert sorted(figure_pictures.CALLS.keys() - set(vars(plots))) == []
    page = python_api.pages_of("frictrack.present.plots.fit")["frictrack.present.plots.fit"]
    assert "plots.fit(fit, runs)\n```" in page
    assert "pictures/fit.png" in page


def test_the_page_of_the_command_line_has_every_option_of_every_command():
    page = command_line.command_line_page()
    for name, command in command_line.all_commands():
        section = page.partition(f"({name.replace(' ', '-')})=")[2].partition("\n(frictrack-")[0]
        wanted = [opt for param in command.params for opt in param.opts if opt.startswith("--")]
        assert [opt for opt in wanted if opt not in section] == [], name
        assert "\b" not in section
        assert f"```sh\n{name}" in section, name
    assert "{STUDY}" in page


@pytest.mark.parametrize("section", study_file.SECTIONS)
def test_every_key_of_the_study_file_is_described(section):
    kind = study_file.SECTIONS[section]
    described, page = study_file.described(kind), study_file.study_file_page()
    assert described.keys() - {""} == kind.model_fields.keys()
    for key in kind.model_fields:
        value, _, _ = study_file.value_of(kind, key)
        assert value
        assert f"\n`{key}` – *" in page


def test_the_types_of_the_schema_that_are_described_exist():
    assert [name for name in study_file.TYPES if not hasattr(schema, name) and name not in ("str", "int")] == []


def test_the_page_of_the_scene_file_has_all_keys_of_the_code():
    page = scene_file.scene_file_page()
    for key in ("mass", "target", "run", "clamp_x", "v", "pause", "speckle", "exposure", "reflectance", "frequency"):
        assert f"| `{key}` |" in page


def test_the_fields_of_a_json_object_are_listed_with_types_and_meanings():
    found = json_reference.fields_of({"fails_at": [{"run": "a", "p": None}, {"run": "b", "p": 0.1}], "errors": {}})
    assert found == {"fails_at[].run": {"text"}, "fails_at[].p": {"null", "number"}, "errors": {"errors of a fit"}}
    assert "p-value" in json_reference.json_page({"compare": {"fails_at": [{"p": 0.1}]}})
    with pytest.raises(KeyError, match="expected the meaning of the field"):
        json_meanings.meaning("something.unheard_of")


def test_every_effect_is_simulated_and_stands_in_a_group():
    listed = [name for names in gallery.GROUPS.values() for name in names]
    # gravity is in the law of every run on an upright circle
    without_film = ["cell_lag", "cell_delay", "cell_drift", "gravity"]
    assert sorted(listed) == sorted(gallery.all_effects()) == sorted([*gallery_runs.EXAMPLES, *without_film])
    assert {example.axis for example in gallery_runs.EXAMPLES.values()} == {"t", "x", "v"}


@pytest.fixture(scope="module")
def texture():
    return gallery_fit.fit_without("texture", gallery_runs.EXAMPLES["texture"])


def test_what_a_fit_leaves_is_the_force_of_the_effect(texture):
    assert texture.fit.reduced_chi2 > 100
    for left, made in zip(texture.leftovers, texture.runs, strict=True):
        ripples = np.sin(2 * np.pi * left.x / 0.1 + 0.7) * np.sign(left.v)
        seen = np.isfinite(left.F)
        assert np.corrcoef(left.F[seen], ripples[seen])[0, 1] > 0.9, made.run.name


def test_the_effect_itself_explains_the_misfit_and_others_less(texture):
    assert texture.explained["texture"] > 0.98
    assert texture.lookalikes[0][1] < 0.9
    assert all(0 <= share <= 1 for _, share in texture.lookalikes)


@pytest.mark.slow
def test_a_wave_of_less_than_a_period_and_a_half_is_no_lookalike():
    found = gallery_fit.fit_without("drag", gallery_runs.EXAMPLES["drag"])
    assert found.explained["drag"] > 0.98
    assert found.explained["vibration"] < 0.9  # without the rule a slow one explains 99 %


@pytest.mark.slow
def test_a_lost_frame_leaves_a_misfit_and_does_not_end_the_run():
    found = gallery_fit.fit_without("dropped_frame", gallery_runs.EXAMPLES["dropped_frame"])
    assert found.fit.reduced_chi2 > 100  # it was 1.0: the run was fitted up to the lost frame alone
    assert found.explained["dropped_frame"] > 0.98


@pytest.mark.slow
def test_a_pair_that_one_run_cannot_distinguish_is_separated_by_the_planned_one():
    found = gallery_separation.separating_run("vibration", "camera_shake")
    assert found is not None
    assert found.is_separated
    assert "reference" in found.best
    assert found.before < 1
    assert gallery_separation.separating_run("coulomb", "thermal") is None


@pytest.mark.slow
def test_the_page_of_an_effect_holds_what_the_definition_says(texture):
    page = gallery.effect_page("texture", texture)
    effect = effects.get("texture")
    assert effect.equation in page
    for p in effect.parameters:
        assert f"| `{p.name}` | {p.unit} |" in page
    assert "period = 0.1 m" in page
    linked = re.findall(r"\]\((\w+)\.md\)", page)
    assert linked
    assert set(linked) <= {gallery.page_name(name) for name in gallery.all_effects()}


@pytest.mark.slow
def test_a_page_is_made_again_only_if_its_effect_changed(texture, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(gallery, "all_effects", lambda: ["texture"])
    monkeypatch.setattr(gallery, "fit_without", lambda name, example: made.append(name) or texture)
    (tmp_path / "gone.md").write_text("# gone")
    gallery.make_gallery(tmp_path)
    gallery.make_gallery(tmp_path)
    assert made == ["texture"]
    assert [path.name for path in tmp_path.glob("*.md")] == ["texture.md"]
    assert (tmp_path / "texture.png").read_bytes().startswith(b"\x89PNG")
    assert "texture_small.png" in (tmp_path / "cards.txt").read_text()
    (tmp_path / "texture_small.png").unlink()
    gallery.make_gallery(tmp_path)
    assert made == ["texture", "texture"]


def test_texts_are_escaped_but_not_the_code_in_them():
    assert page_text.plain("F_s [N]") == "F\\_s \\[N\\]"
    assert page_text.prose("the key `F_s` of [study]") == "the key `F_s` of \\[study\\]"


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    pytest.importorskip("pydata_sphinx_theme", reason="the documentation needs the extra docs")
    out = tmp_path_factory.mktemp("html")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", str(ROOT / "docs"), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return out


@pytest.mark.release
@pytest.mark.slow
def test_the_documentation_builds_without_warnings_and_loads_nothing_from_outside(built):
    pages = list(built.rglob("*.html"))
    assert len(pages) > 150
    loading = {str(page.relative_to(built)): EXTERNAL.findall(page.read_text()) for page in pages}
    assert {page for page, found in loading.items() if found} == set()


@pytest.mark.release
@pytest.mark.slow
def test_the_links_inside_the_documentation_lead_somewhere(built):
    broken = []
    for page in built.rglob("*.html"):
        for target in LINK.findall(page.read_text()):
            if not re.match(r"[a-z]+:", target) and not (page.parent / target).exists():
                broken.append((str(page.relative_to(built)), target))
    assert broken == []


@pytest.mark.slow
def test_a_broad_missing_force_is_centred_as_the_gallery_shows_it():
    """Beside many local forces the model may move far away; the curve then had ten times the size of the force."""
    made = gallery_runs.simulate_example("measured_load", gallery_runs.EXAMPLES["measured_load"])
    fit = frictrack.fit("tustin", [one.run for one in made])
    local = find_local_forces(fit.solution)
    pieces, _ = deconvolve_force(
        local, WaveScan(local.model), compress_residual(local.solution, about_measurement=True)
    )
    for piece in pieces:
        truth, curve = made[piece.run].truth, fit.curves[piece.run]
        missing = np.interp(piece.t, curve.t, np.interp(curve.t, truth.t, truth.F) - curve.F_model)
        assert np.sqrt(np.mean(piece.F**2)) < 1.8 * np.std(missing)
