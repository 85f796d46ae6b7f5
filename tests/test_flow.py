"""The flow: every step rests on what is up to date, nothing is done twice, every model tried is kept."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from conftest import F_C, F_V, slide
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as ndimage_shift

from frictrack.base.errors import FrictrackError
from frictrack.flow import FitRequest, Session, open_study, pipeline, tried_models
from frictrack.records import Filtered
from frictrack.results.verdicts import VERDICTS


@dataclass
class Found:
    """What a comparison or a diagnosis looks like from outside."""

    content: dict[str, Any]
    complete: bool = True

    def summary(self) -> dict[str, Any]:
        return self.content

    @property
    def figures(self) -> dict[str, dict[str, np.ndarray]]:
        return {"residual": {"t": np.arange(3.0)}}


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Compare and diagnose stand in for the real ones; what was asked of them is listed."""
    calls: list[str] = []

    def errors(fits: list[Any]) -> dict[str, Any]:
        calls.append(f"compare {len(fits)}")
        return {"models": [{"name": "+".join(f.model.names), "errors": f.errors} for f in fits], "fails_at": []}

    def diagnose(fit: Any, *, rng: int, progress: Any, **beside: Any) -> Found:
        calls.append("diagnose")
        return Found({"verdict": "complete", "missing": [], "candidates": [], "seed": rng})

    # by their modules: `frictrack.compare` and `frictrack.diagnose` are the functions
    monkeypatch.setattr(import_module("frictrack.diagnose.compare"), "compare", lambda fits: Found(errors(fits)))
    monkeypatch.setattr(import_module("frictrack.diagnose"), "diagnose", diagnose)
    return calls


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The stages that were made, in order."""
    names: list[str] = []
    original = pipeline.RunPipeline._compute

    def spy(work: pipeline.RunPipeline, name: str) -> Any:
        result = original(work, name)
        names.append(f"{work.run.name} {name}")
        return result

    monkeypatch.setattr(pipeline.RunPipeline, "_compute", spy)
    return names


def session(path: Path) -> Session:
    return Session(open_study(path))


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_run_goes_through_its_stages_once(new_study_file: Path, made: list[str]) -> None:
    session(new_study_file).bring_up_to("friction")
    of_one = [m.split()[1] for m in made if m.startswith("slow ")]
    assert of_one == ["displacement", "sensors", "filtered", "motion", "friction"]
    assert len(made) == 15
    made.clear()
    session(new_study_file).bring_up_to("friction")
    assert made == []


def test_the_layout_is_that_of_the_design(study_file: Path) -> None:
    session(study_file).fit()
    output = study_file.parent / "study_results"
    with h5py.File(output / "slow.h5") as run:
        for group, columns in {
            "displacement": ("t", "x", "y", "angle", "sigma_x", "sigma_y", "valid"),
            "filtered": ("t", "x", "y"),
            "motion": ("t", "x", "v", "a", "a_y", "sigma_x", "sigma_v", "sigma_a", "sigma_a_y"),
            "friction": ("t", "F", "sigma_F", "free"),
        }.items():
            assert set(columns) <= set(run[group])
            assert {"settings", "version", "input_hash"} <= set(run[group].attrs)
        assert run["motion/v"].attrs["unit"] == "m/s"
    with h5py.File(output / "study.h5") as study:
        assert list(study["models"]) == ["1_coulomb+viscous"]
        assert bool(study["models/1_coulomb+viscous"].attrs["current"])
        assert study["runs/fast/motion/v"].shape == (500,)
    assert {p.name for p in output.glob("*.h5")} == {"fast.h5", "middle.h5", "slow.h5", "study.h5"}


def test_the_fit_finds_what_made_the_tables(study_file: Path) -> None:
    parameters = session(study_file).fit()["parameters"]
    for name, truth in {"coulomb.F_c": F_C, "viscous.F_v": F_V}.items():
        assert abs(parameters[name]["value"] - truth) < 4 * parameters[name]["std"]


def test_only_what_depends_on_a_changed_setting_is_made_again(study_file: Path, made: list[str]) -> None:
    session(study_file).bring_up_to("friction")
    made.clear()
    edit(study_file, 'table = "fast.csv"', 'table = "fast.csv"\ncutoff = 150')
    session(study_file).bring_up_to("friction")
    assert made == ["fast filtered", "fast motion", "fast friction"]
    made.clear()
    edit(study_file, "0.350 +/- 0.002 kg", "0.360 kg")
    session(study_file).bring_up_to("friction")
    assert made == ["slow friction", "middle friction", "fast friction"]


def test_a_changed_table_is_read_again(study_file: Path, made: list[str]) -> None:
    session(study_file).bring_up_to("motion")
    made.clear()
    t = np.arange(400) / 4000
    x = slide(t, 2.5) + 1e-5 * np.random.default_rng(2).normal(size=len(t))
    np.savetxt(study_file.parent / "slow.csv", np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")
    works = session(study_file).bring_up_to("motion")
    assert made == ["slow displacement", "slow sensors", "slow filtered", "slow motion"]
    assert len(works[0].get("motion")) == 400


def test_another_version_makes_everything_again(
    study_file: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    session(study_file).bring_up_to("motion")
    made.clear()
    monkeypatch.setattr("frictrack.flow.pipeline.__version__", "99.0")
    session(study_file).bring_up_to("motion")
    assert len(made) == 12


def test_a_failing_stage_keeps_what_was_done(
    new_study_file: Path, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(displacement: Any, *how: Any, **more: Any) -> Filtered:
        raise FrictrackError("displacement: expected a moving target")

    with monkeypatch.context() as patch:
        patch.setattr("frictrack.measure.motion.low_pass", broken)
        with pytest.raises(FrictrackError, match=r'run "slow", filtered: displacement: expected a moving target'):
            session(new_study_file).bring_up_to("motion")
    assert made == ["slow displacement", "middle displacement", "fast displacement", "slow sensors"]
    made.clear()
    session(new_study_file).bring_up_to("motion")
    assert made[0] == "slow filtered"


def test_a_damaged_result_is_said(study_file: Path) -> None:
    session(study_file).bring_up_to("motion")
    (study_file.parent / "study_results" / "slow.h5").write_bytes(b"no HDF5")
    with pytest.raises(FrictrackError, match=r"slow\.h5 is damaged or is not HDF5; delete it and run again"):
        session(study_file).bring_up_to("motion")


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The models that were searched for, in order."""
    names: list[str] = []
    original = tried_models.TriedModels._fitted

    def spy(models: Any, request: FitRequest, **how: Any) -> Any:
        names.append("+".join(request.model(models.study.effects).names))
        return original(models, request, **how)

    monkeypatch.setattr(tried_models.TriedModels, "_fitted", spy)
    return names


def test_a_fit_is_kept_and_rebuilt(study_file: Path, fitted: list[str]) -> None:
    first = session(study_file).fit()
    again = session(study_file)
    assert again.fit() == first
    assert fitted == ["coulomb+viscous"]
    rebuilt = again.models.fit("1_coulomb+viscous")
    assert rebuilt.summary()["parameters"]["coulomb.F_c"]["value"] == pytest.approx(
        first["parameters"]["coulomb.F_c"]["value"], rel=1e-6
    )


def test_models_are_appended_and_the_last_is_current(study_file: Path, called: list[str]) -> None:
    work = session(study_file)
    work.fit()
    added = work.add("drag")
    assert set(added) == {"effect", "error_before", "error_after", "parameters", "misfit"}
    assert "drag.c" in added["parameters"]
    assert added["error_before"] == tried_models.model_results(work.models.path, "1_coulomb+viscous").summary["errors"]
    session(study_file).remove("viscous")
    work = session(study_file)
    work.fit(model="coulomb,drag")
    work.fit(seed=3)
    assert work.models.groups == [
        "1_coulomb+viscous",
        "2_coulomb+viscous+drag",
        "3_coulomb+viscous+drag-viscous",
        "4_coulomb+drag",
        "5_coulomb+drag",
    ]
    assert [r.current for r in work.results().models] == [False, False, False, False, True]
    assert work.fit()["model"] == ["coulomb", "drag"]
    assert len(work.models.groups) == 5


def test_removing_what_was_added_gives_the_same_model_as_before() -> None:
    spec = FitRequest("tustin").edited("+texture").edited("-viscous")
    assert spec.name == "tustin+texture-viscous"
    assert spec.model().names == ["coulomb", "stribeck", "texture"]
    assert spec.edited("-texture") == FitRequest("tustin", ("-viscous",))


def test_a_model_changed_in_the_study_file_becomes_current(study_file: Path, called: list[str]) -> None:
    session(study_file).add("drag")
    edit(study_file, 'model = ["coulomb", "viscous"]', 'model = ["coulomb"]')
    work = session(study_file)
    assert work.fit()["model"] == ["coulomb"]
    assert work.models.groups[-1] == "3_coulomb"
    assert session(study_file).add("viscous")["effect"] == "viscous"
    assert session(study_file).fit()["model"] == ["coulomb", "viscous"]


def test_the_study_files_model_comes_first_where_another_is_asked_for(study_file: Path) -> None:
    work = session(study_file)
    assert work.fit(model="coulomb")["model"] == ["coulomb"]
    assert work.models.groups == ["1_coulomb+viscous", "2_coulomb"]


def test_a_changed_mass_fits_all_models_again(study_file: Path, called: list[str], fitted: list[str]) -> None:
    session(study_file).add("drag")
    edit(study_file, "0.350 +/- 0.002 kg", "0.700 kg")
    fitted.clear()
    work = session(study_file)
    models = work.history()["models"]
    assert fitted == ["coulomb+viscous", "coulomb+viscous+drag"]
    assert len(models) == 2
    first = tried_models.model_results(work.models.path, "1_coulomb+viscous")
    doubled = first.summary["parameters"]["coulomb.F_c"]["value"]
    assert doubled == pytest.approx(2 * F_C, rel=0.05)


def test_comparison_and_diagnosis_are_kept_until_the_model_changes(study_file: Path, called: list[str]) -> None:
    assert session(study_file).diagnose()["verdict"] == "complete"
    session(study_file).diagnose()
    session(study_file).compare()
    session(study_file).compare()
    assert called == ["diagnose", "compare 1"]
    assert session(study_file).diagnose(seed=5)["seed"] == 5
    session(study_file).add("drag")
    with h5py.File(study_file.parent / "study_results" / "study.h5") as study:
        assert "diagnosis" not in study
        assert "comparison" not in study
    session(study_file).compare()
    session(study_file).diagnose()
    assert called[2:] == ["diagnose", "compare 1", "diagnose"]  # the errors of the others are stored
    with h5py.File(study_file.parent / "study_results" / "study.h5") as study:
        assert study["diagnosis"] == study["models/2_coulomb+viscous+drag/diagnosis"]
        assert "summary" in study["models/1_coulomb+viscous/diagnosis"].attrs
        assert study["comparison"].attrs["settings"] == "{}"


@pytest.mark.usefixtures("few_evaluations")
def test_results_hold_all_a_report_needs(study_file: Path, called: list[str]) -> None:
    edit(study_file, 'name = "three tables"', 'name = "three tables"\noutput = "out"')
    results = session(study_file).results()
    assert (results.name, results.output.name) == ("three tables", "out")
    assert [run.name for run in results.runs] == ["slow", "middle", "fast"]
    assert results.runs[0].source == "slow.csv"
    assert results.runs[0].settings["mass"] == pytest.approx([0.35, 0.002])
    assert results.runs[0].film is None
    assert results.current is not None
    assert results.current.diagnosis == results.diagnosis
    assert [c.run for c in results.current.curves] == ["slow", "middle", "fast"]
    np.testing.assert_array_equal(results.figures["residual"]["t"], np.arange(3.0))


def test_a_diagnosis_failing_leaves_the_fit(
    study_file: Path, called: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(fit: Any, *, rng: int, progress: Any, **beside: Any) -> Found:
        raise FrictrackError("expected frames to bootstrap")

    monkeypatch.setattr(import_module("frictrack.diagnose"), "diagnose", broken)
    with pytest.raises(FrictrackError, match="expected frames to bootstrap"):
        session(study_file).diagnose()
    assert session(study_file).models.groups == ["1_coulomb+viscous"]


def test_wrong_names_are_found_before_any_work(new_study_file: Path, made: list[str]) -> None:
    with pytest.raises(FrictrackError, match='but got "texure"; did you mean "texture"') as caught:
        session(new_study_file).add("texure")
    assert caught.value.usage
    with pytest.raises(FrictrackError, match="effect of the model"):
        session(new_study_file).remove("texture")
    with pytest.raises(FrictrackError, match='did you mean "drag"'):
        session(new_study_file).fit(model="coulomb,drga")
    edit(new_study_file, '["coulomb", "viscous"]', '"tustn"')
    with pytest.raises(FrictrackError, match=r'study\.toml: model: .*"tustn"') as caught:
        open_study(new_study_file)
    assert caught.value.usage


def test_effect_tables_fix_and_bound(study_file: Path) -> None:
    with study_file.open("a") as f:
        f.write('\n[[effect]]\neffect = "drag"\nfix = {c = 0.1}\n')
    drag = open_study(study_file).effects[0]
    assert drag.fix == {"c": 0.1}
    edit(study_file, "fix = {c", "fix = {k")
    edit(study_file, '"viscous"]', '"drag"]')
    with pytest.raises(FrictrackError, match=r'\[\[effect\]\] "drag": unknown parameter "k"'):
        open_study(study_file)
    edit(study_file, "fix = {k = 0.1}", 'tie = {c = "viscous.F_v"}')
    with pytest.raises(FrictrackError, match=r'"drag": tie: c follows viscous.F_v but the model is coulomb, drag; add'):
        open_study(study_file)


def test_a_wrong_scale_is_found_before_any_work(study_file: Path) -> None:
    edit(study_file, '[[run]]\nname = "slow"', '[[run]]\nscale = "3 mm/ells"\nname = "slow"')
    with pytest.raises(FrictrackError, match=r'run "slow": expected the scale .* unknown unit "mm/ells"') as caught:
        open_study(study_file)
    assert caught.value.usage


def test_a_drive_on_its_own_clock_reaches_the_run(study_file: Path) -> None:
    folder = study_file.parent
    np.savetxt(folder / "drive.csv", [[0, 0], [1, 10]], delimiter=",", header="t_s,drive_N", comments="")
    edit(study_file, 'table = "slow.csv"', 'table = "slow.csv"\ndrive = "drive.csv"')
    work = session(study_file).runs[0]
    np.testing.assert_allclose(work.to_run().drive, 10 * np.arange(500) / 4000)


def test_a_table_without_sigma_gets_its_white_noise(study_file: Path) -> None:
    sigma = session(study_file).runs[0].get("displacement").sigma_x
    np.testing.assert_allclose(sigma, 10e-6, rtol=0.15)


def test_restart_forgets_models_and_keeps_runs(study_file: Path, called: list[str], made: list[str]) -> None:
    work = session(study_file)
    work.add("drag")
    work.restart()
    made.clear()
    assert work.fit()["model"] == ["coulomb", "viscous"]
    assert work.models.groups == ["1_coulomb+viscous"]
    assert made == []


def test_the_key_of_a_fit_knows_roles(study_file: Path) -> None:
    work = session(study_file)
    before = work.models.fit_key(FitRequest("tustin"))
    edit(study_file, 'name = "fast"', 'name = "fast"\nrole = "validation"')
    assert session(study_file).models.fit_key(FitRequest("tustin")) != before
    assert work.models.fit_key(replace(FitRequest("tustin"), seed=1)) != before


@pytest.fixture
def film_study(tmp_path: Path) -> Path:
    """A block of smooth random texture that slides over another one, slowing down, as a multi-page TIFF."""
    rng = np.random.default_rng(4)
    ground = 100 + 40 * gaussian_filter(rng.normal(size=(48, 160)), 2) * 5
    block = 120 + 60 * gaussian_filter(rng.normal(size=(20, 24)), 1.5) * 4
    pictures = []
    for i in range(40):
        picture = ground.copy()
        at = 10 + 2.5 * i - 0.01 * i**2
        whole = int(at)
        picture[14:34, whole : whole + 25] = ndimage_shift(np.pad(block, ((0, 0), (0, 1)), "edge"), (0, at - whole))
        pictures.append(np.clip(picture + rng.normal(size=picture.shape), 0, 255).astype(np.uint8))
    tifffile.imwrite(tmp_path / "block.tif", np.stack(pictures))
    path = tmp_path / "study.toml"
    head = '[study]\nmass = "350 g"\n[camera]\nfps = 1000\nscale = "1 mm/px"\n'
    keys = "target = [10, 14, 24, 20]\nreference = [2, 36, 40, 12]\n"
    path.write_text(f'{head}[[run]]\nvideo = "block.tif"\n{keys}')
    return path


def test_a_film_goes_through_its_stages_once(film_study: Path, made: list[str]) -> None:
    rows = session(film_study).measure("track")["runs"]
    output = film_study.parent / "study_results"
    assert rows[0]["found"] == 40
    assert rows[0]["travel_px"] == pytest.approx(2.5 * 39 - 0.01 * 39**2, abs=0.5)
    assert rows[0]["target"] == "target = [10, 14, 24, 20]"
    assert (output / "block_track.png").stat().st_size > 10_000
    session(film_study).bring_up_to("motion")
    stages = ["recording", "track", "tracks", "displacement", "sensors", "filtered", "motion"]
    assert [m.split()[1] for m in made] == stages
    with h5py.File(output / "block.h5") as run:
        assert run["recording"].attrs["path"] == "block.tif"
        assert run["recording"].attrs["fps"] == 1000
        assert run["recording/picture"].shape == (48, 160)
        assert run["tracks/reference/x_px"].attrs["unit"] == "px"
        columns = {"t", "x_px", "y_px", "angle", "sigma_px", "sigma_y_px", "score", "reason"}
        assert columns <= set(run["track"])
    made.clear()
    edit(film_study, "1 mm/px", "2 mm/px")
    session(film_study).bring_up_to("motion")
    assert made == ["block displacement", "block sensors", "block filtered", "block motion"]
    made.clear()
    edit(film_study, "fps = 1000", "fps = 2000")
    session(film_study).bring_up_to("track")
    assert made == ["block recording", "block track"]


def test_nothing_is_said_of_runs_that_are_measured_already(study_file: Path) -> None:
    told: list[str] = []
    at_it = Session(open_study(study_file), lambda done, total, what: told.append(what))
    at_it.bring_up_to("friction")
    assert "runs" in told
    told.clear()
    at_it.bring_up_to("friction")
    assert told == []


@pytest.mark.usefixtures("few_evaluations")
def test_a_global_search_tells_its_progress_generation_by_generation(study_file: Path) -> None:
    told: list[tuple[int, int, str]] = []
    at_it = Session(open_study(study_file), lambda done, total, what: told.append((done, total, what)))
    at_it.fit(search="de", domain="force")
    generations = [(done, total) for done, total, what in told if what.startswith("de: misfit")]
    assert len(generations) > 3
    assert [done for done, _ in generations] == sorted(done for done, _ in generations)
    assert all(done < total for done, total in generations)


@pytest.mark.usefixtures("called")
def test_the_json_of_a_diagnosis_has_the_verdict_in_words(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = session(study_file).diagnose()
    assert found["headline"] == "Coulomb + viscous is complete: no further effect is detectable in these runs"
    monkeypatch.setitem(VERDICTS, "complete", "{model} lacks nothing")
    assert session(study_file).diagnose()["headline"] == "Coulomb + viscous lacks nothing"  # though it is stored
