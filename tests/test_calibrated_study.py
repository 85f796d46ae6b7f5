"""Calibration as a study file asks for it: keys, files, staleness, and what the report says of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import tifffile
from film import block_film
from pinhole import checkers, homography, pictured
from test_outline import filmed
from test_plots import results

from frictrack.base.errors import FrictrackError
from frictrack.flow import run_pipeline
from frictrack.present import report
from frictrack.present.report import tables, texts
from frictrack.study import load, write_study

SHAPE = (128, 256)
HEAD = '[study]\nmass = "0.35 kg"\n'
RUN = '[[run]]\nname = "v3"\nvideo = "v3.tif"\n'


def study(folder, camera, run=""):
    (folder / "study.toml").write_text(f"{HEAD}[camera]\nfps = 4000\n{camera}\n{RUN}{run}")
    return load(folder)


def slide_film(path):
    """A block that slides right by 80 px."""
    film = block_film(60 + 100 * np.linspace(0, 1, 60) ** 0.8, size=(40, 60), shape=SHAPE)
    tifffile.imwrite(path, np.stack([film.frame(i) for i in range(60)]), photometric="minisblack")


@pytest.fixture
def folder(tmp_path):
    for name in ("v3.tif", "board.png", "more.png", "lens.yml"):
        (tmp_path / name).touch()
    return tmp_path


# ---- keys


def test_files_of_the_calibration_are_looked_up_beside_the_study(folder):
    run = study(folder, 'lens = "lens.yml"\nscale = {board = "board.png", squares = [9, 6], square = "10 mm"}').runs[0]
    assert run.lens == folder / "lens.yml"
    assert run.scale["board"] == folder / "board.png"
    several = 'scale = {board = ["board.png", "more.png"], squares = [9, 6], square = "10 mm", plane = 1}'
    assert study(folder, several).runs[0].scale["board"] == [folder / "board.png", folder / "more.png"]
    both = 'scale = ["0.5 mm/px", {target = "40 mm"}]'
    assert study(folder, both).runs[0].scale == ["0.5 mm/px", {"target": "40 mm"}]
    assert study(folder, 'scale = "0.5 mm/px"', 'axis = "track"').runs[0].axis == "track"
    assert study(folder, 'scale = "0.5 mm/px"', "axis = [1, 0.1]").runs[0].axis == (1, 0.1)


@pytest.mark.parametrize(
    ("camera", "run", "said"),
    [
        ('scale = {board = "bord.png", squares = [9, 6], square = 1}', "", 'there is none; did you mean "board.png"?'),
        ('scale = {targt = "40 mm"}', "", 'but got "targt"; did you mean "target"?'),
        ("scale = {}", "", 'expected "0.5 mm/px" or {points'),
        ("scale = true", "", 'expected "0.5 mm/px" or {points'),
        ('scale = 1\nlens = "lense.yml"', "", 'a file "lense.yml" but there is none; did you mean "lens.yml"?'),
        ("scale = 1", 'axis = "trak"', "expected the course axis as [dx, dy] px or \"track\" but got 'trak'"),
        ("scale = 1", "axis = [0, 0]", "expected the course axis as [dx, dy]"),
    ],
)  # fmt: skip
def test_keys_that_cannot_be(folder, camera, run, said):
    with pytest.raises(FrictrackError) as caught:
        study(folder, camera, run)
    assert said in str(caught.value)


def test_a_table_takes_no_scale_from_a_board(folder):
    """It has no pixels that a board could measure; a pitch it may have."""
    (folder / "t.csv").write_text("t_s,x_m\n0,0\n1,1\n")
    text = f'{HEAD}[camera]\nscale = {{target = "40 mm"}}\n[[run]]\ntable = "t.csv"\n'
    (folder / "study.toml").write_text(text)
    assert load(folder).runs[0].scale is None
    (folder / "study.toml").write_text(text.replace('{target = "40 mm"}', '["0.5 mm/px", {target = "40 mm"}]'))
    assert load(folder).runs[0].scale is not None


def test_init_shows_every_way(tmp_path):
    text = write_study(tmp_path / "study.toml", [tmp_path / "a.avi"], commented=True).read_text()
    for way in ("mm/px", "length =", "target =", "board =", "dictionary =", "plane =", "lens =", 'axis = "track"'):
        assert way in text


# ---- staleness


def test_a_changed_board_or_lens_makes_the_displacement_stale(folder):
    keys = {}

    def key(camera):
        found = study(folder, camera)
        return run_pipeline(found, found.runs[0])

    camera = 'lens = "lens.yml"\nscale = {board = ["board.png", "more.png"], squares = [9, 6], square = "10 mm"}'
    slide_film(folder / "v3.tif")
    before = key(camera)
    assert before.settings("displacement")["scale"]["board"] == ["board.png", "more.png"]
    assert before.settings("displacement")["lens"] == "lens.yml"
    keys["first"] = before.key("displacement")
    assert key(camera).key("displacement") == keys["first"]
    for name in ("more.png", "lens.yml"):
        (folder / name).write_text(f"another {name}")
        keys[name] = key(camera).key("displacement")
    assert len(set(keys.values())) == 3
    assert key(camera).key("track") == before.key("track")  # tracking is not done again


# ---- report


def with_scale(relative, pitch=1e-4):
    found = results(film=True)
    runs = [
        replace(r, displacement=replace(r.displacement, relative_scale_error=relative, pixel_pitch=pitch))
        for r in found.runs
    ]
    return replace(found, runs=tuple(runs))


def test_the_report_says_what_the_scale_does_to_forces(monkeypatch):
    monkeypatch.setattr("frictrack.present.plots.svg", lambda figure: "<svg></svg>")
    known = with_scale(0.004)
    assert "The scale has a standard deviation of 0.40 %" in texts.scale_line(known)
    assert "every ± includes it" in texts.scale_line(known)
    assert "common to all runs of one camera" in texts.scale_line(known)
    text = report.render(known)
    assert "± of the scale" in text
    assert "The scale has a standard deviation of 0.40 %" in text
    assert "The error of the scale is not given" in texts.scale_line(with_scale(0.0))
    assert "± of the scale" not in report.render(with_scale(0.0))


def test_parameters_that_go_with_the_scale():
    """Newtons, metres and m/s grow with it; N s/m does not, and what is fixed is."""
    found = {
        "coulomb.F_c": {"value": 8.0, "std": 0.02, "unit": "N"},
        "viscous.F_v": {"value": 2.0, "std": 0.02, "unit": "N s/m"},
        "stribeck.delta": {"value": 1.0, "std": 0.0, "unit": "1", "reason": "fixed"},
    }
    model = replace(results().models[0], summary={"parameters": found})
    rows = tables.parameter_table(model, 0.004).rows
    assert [row[2] for row in rows] == ["32 mN", "", ""]


def test_measured_friction_does_not_go_with_the_scale():
    known = with_scale(0.004)
    sensors = type("S", (), {"drive": None, "friction_N": np.ones(3)})()
    assert texts.scale_error(replace(known, runs=tuple(replace(r, sensors=sensors) for r in known.runs))) == 0.0


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        ("0.5 mm/px", "0.5 mm/px"),
        ({"points": [[0, 0], [1, 1]], "length": "100 mm"}, "ruler of 100 mm"),
        ({"points": [[0, 0]] * 5, "plane": [[0, 0]] * 5}, "5 points at known positions"),
        (["0.5 mm/px", {"target": "40 mm"}], "0.5 mm/px, checked against the target's size, 40 mm"),
        ({"board": ["a.png", "b.png"], "squares": [9, 6], "square": 1}, "board in a.png, b.png: 9 x 6 squares of 1"),
    ],
)  # fmt: skip
def test_the_record_says_how_the_scale_was_given(scale, said):
    found = results(film=True)
    runs = tuple(replace(r, settings=r.settings | {"scale": scale}) for r in found.runs)
    assert said in [str(cell) for row in texts.settings_table(replace(found, runs=runs)).rows for cell in row]


# ---- the whole way


def test_a_film_and_a_board_of_the_same_camera(folder):
    """The board lies in the plane, 0.625 mm per pixel and turned by nothing: that is what the displacement says."""
    slide_film(folder / "v3.tif")
    size = SHAPE[::-1]
    matrix = homography(np.eye(3), np.array([-0.03, -0.02, 0.5]), 800.0, size)
    cv2.imwrite(str(folder / "board.png"), pictured(checkers((6, 4)), 40, matrix, size))
    found = study(folder, 'scale = {board = "board.png", squares = [6, 4], square = "10 mm"}')
    d = run_pipeline(found, found.runs[0]).get("displacement")
    assert d.pixel_pitch == pytest.approx(0.5 / 800, rel=2e-3)
    assert np.ptp(d.x) == pytest.approx(100 * 0.5 / 800, rel=2e-3)
    assert any(note.startswith("scale by a checkerboard") for note in d.notes)


def test_a_film_whose_target_is_the_scale(folder):
    """A body of 60.37 px that is said to be 30 mm long."""
    film, _ = filmed(60.37, 40.0)
    tifffile.imwrite(folder / "v3.tif", np.stack(film.frames), photometric="minisblack")
    found = study(folder, 'scale = {target = "30 mm"}')
    d = run_pipeline(found, found.runs[0]).get("displacement")
    assert d.pixel_pitch == pytest.approx(0.030 / 60.37, rel=3 * d.relative_scale_error)
    assert d.relative_scale_error < 0.006
    assert any(note.startswith("scale by the target's size of 30 mm") for note in d.notes)
