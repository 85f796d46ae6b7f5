"""Scenes: films of known truth and a study file that does not tell it."""

import json
from itertools import islice

import numpy as np
import pytest
import tifffile

import frictrack as ft
from frictrack import samples
from frictrack.base.errors import FrictrackError
from frictrack.simulate.scene import film_scene, read_scene, render_scene

SCENE = """
name = "two short runs"
mass = 0.35
[camera]
fps = 4000
width = 260
height = 72
[target]
width = 60
height = 44
[law.coulomb]
F_c = 8.0
[law.viscous]
F_v = 1.2
[[run]]
name = "there"
v = 4.0
frames = 60
[[run]]
name = "back"
v = -4.0
frames = 60
mass = 0.7
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("scene")
    film_scene(read_scene(SCENE), out, rng=3)
    return out


def test_films_study_and_truth_stand_side_by_side_and_the_study_does_not_tell(folder):
    assert {p.name for p in folder.iterdir()} == {"there.avi", "back.avi", "study.toml", "truth.json"}
    text = (folder / "study.toml").read_text()
    assert 'mass = "0.7 kg"' in text
    assert "8.0" not in text
    assert "F_c" not in text


@pytest.mark.parametrize("name", ["there", "back"])
def test_the_tracked_block_is_where_the_truth_says(folder, name):
    truth = {r["name"]: np.array(r["x_m"]) for r in json.loads((folder / "truth.json").read_text())["runs"]}[name]
    track = ft.track(ft.open_recording(folder / f"{name}.avi", fps=4000))
    error = ft.calibrate(track, scale="0.5 mm/px").x - truth
    assert np.std(error) < 1.5e-6  # 3 mpx
    assert abs(np.mean(error)) < 3 * 0.5e-3  # the rectangle's centre is the block's to some px


def test_the_truth_is_the_closed_form_of_viscous_decay(folder):
    run = json.loads((folder / "truth.json").read_text())["runs"][0]
    x, t, m = np.array(run["x_m"]), np.arange(60) / 4000, 0.35
    tau, drift = m / 1.2, 8.0 / 1.2
    closed = (4.0 + drift) * tau * (1 - np.exp(-t / tau)) - drift * t
    assert np.max(np.abs(x - x[0] - closed)) < 1e-12


def test_every_nuisance_of_a_scene_is_filmed_and_recorded(tmp_path):
    nuisances = """
    prnu = 0.01
    drift = -1.5
    flicker = { amplitude = 0.05, frequency = 100 }
    shake_x = { amplitude = 0.3, frequency = 35 }
    [rod]
    x = 150
    [highlight]
    x = 90
    y = 30
    """
    text = SCENE.replace("height = 72\n", "height = 72\n" + nuisances).replace(
        "height = 44", "height = 44\nrotation = { amplitude = 0.15, frequency = 40 }"
    )
    scene = read_scene('format = "tif"\n' + text)
    scene = scene.model_copy(update={"runs": scene.runs[:1]})
    film_scene(scene, tmp_path)
    truth = json.loads((tmp_path / "truth.json").read_text())
    camera = truth["runs"][0]["camera"]
    assert (camera["prnu"], camera["drift"]) == (0.01, -1.5)
    assert camera["flicker"] == {"amplitude": 0.05, "frequency": 100.0, "phase": 0.0}
    assert camera["shake_x"]["amplitude"] == 0.3
    assert truth["target"]["rotation"]["amplitude"] == pytest.approx(0.15 * np.pi / 180)
    assert truth["target"]["rod"] == {"x": 150.0, "width": 14.0, "reflectance": 0.06}
    assert truth["target"]["highlight"] == {"x": 90.0, "y": 30.0, "radius": 14.0, "amplitude": 0.25}
    film = tifffile.imread(tmp_path / "there.tif").astype(float)
    assert film[:, :, 145:155].mean() < 20  # the rod is dark
    assert film[:, 30, 90].mean() > film[:, 30, 220].mean() + 30  # the highlight is bright
    t = np.arange(60) / 4000
    light = (1 + 0.05 * np.sin(2 * np.pi * 100 * t)) * (1 - 1.5 * t)
    seen = (film[:, 60:, 220:].mean(axis=(1, 2)) - 4) / light
    assert np.std(seen) < 0.004 * np.mean(seen)


@pytest.mark.slow
def test_what_the_runs_of_an_effect_must_tell_is_filmed_and_told(tmp_path):
    """Vertical motion, angle, clamp and drive; the truth holds the laws that follow them."""
    known = "clamp_x = -0.1\nbeam_length = 0.8\nlift = { amplitude = 1e-4, frequency = 60 }\n"
    law = "[law.measured_load]\ncoefficient = 1.0\n[law.target_rotation]\nalong = 0.0\nacross = 0.01\n"
    law += "[law.drive_error]\ne = 0.1\ntau = 0.0\n"
    text = known + SCENE.replace("height = 44", "height = 44\nrotation = { amplitude = 0.3, frequency = 40 }")
    text = text.replace("[law.viscous]", law + "[law.viscous]").replace("frames = 60", "frames = 60\npush = 0.004")
    scene = read_scene(text)
    scene = scene.model_copy(update={"runs": scene.runs[:1]})
    film_scene(scene, tmp_path, rng=3)
    study = (tmp_path / "study.toml").read_text()
    assert all(line in study for line in ('clamp_x = "-0.1 m"', 'beam_length = "0.8 m"', 'drive = "there_drive.csv"'))
    t, drive = np.loadtxt(tmp_path / "there_drive.csv", delimiter=",", skiprows=1).T
    np.testing.assert_allclose(drive[:17], 2 * 0.35 * 4.0 / 0.004 * np.sin(np.pi * t[:17] / 0.004) ** 2, atol=1e-6)
    truth = np.array(json.loads((tmp_path / "truth.json").read_text())["runs"][0]["x_m"])
    seen = ft.calibrate(ft.track(ft.open_recording(tmp_path / "there.avi", fps=4000)), scale="0.5 mm/px")
    swing = 1e-4 * np.sin(2 * np.pi * 60 * t)
    assert np.std(seen.y - swing) < 4e-6
    angle = -np.deg2rad(0.3) * np.sin(2 * np.pi * 40 * t)
    assert np.std(seen.angle - angle) < 5e-4
    assert np.std(seen.x - truth + 0.01 * np.sin(angle)) < 3e-6  # the followed point moves with the angle
    assert np.std(seen.x - truth) > 20e-6
    pushed = np.mean(np.diff(truth[20:30])) * 4000
    assert pushed == pytest.approx(
        1.1 * 4.0 - 0.0055 * 8.0 / 0.35 * 1.0 - 0.06, abs=0.15
    )  # the drive is a tenth larger


def test_what_was_slid_before_a_run_acts_in_it_and_the_study_tells_the_pause(tmp_path):
    """Two equal runs, the second 20 s after the first: what is still warm then lowers its friction from the start."""
    text = SCENE.replace("[law.viscous]", "[law.heating]\nk = 3.0\ntau = 10.0\n[law.viscous]")
    scene = read_scene(text)
    first = scene.runs[0].model_copy(update={"level": 1.0})
    runs = (first, first.model_copy(update={"name": "again", "pause": 20.0}))
    film_scene(scene.model_copy(update={"runs": runs}), tmp_path, rng=3)
    one, two = (np.array(r["x_m"]) for r in json.loads((tmp_path / "truth.json").read_text())["runs"])
    warm = 3.0 * np.sum(np.abs(np.diff(one))) * np.exp(-20.0 / 10.0)  # N
    gained = (np.diff(two, 2) - np.diff(one, 2))[0] * 4000**2
    assert gained == pytest.approx(warm / 0.35, rel=0.01)
    study = (tmp_path / "study.toml").read_text()
    assert study.count("pause") == 1
    assert 'pause = "20 s"' in study


def test_the_same_seed_makes_the_same_film(folder, tmp_path):
    film_scene(read_scene(SCENE), tmp_path, rng=3)
    assert (tmp_path / "there.avi").read_bytes() == (folder / "there.avi").read_bytes()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SCENE.replace("mass = 0.35", "mas = 0.35"), 'unknown key "mas"'),
        (SCENE.replace("v = 4.0", "speed = 4.0"), "expected the key v of number 1 of run but it is missing"),
        (SCENE.replace("v = 4.0", "speed = 4.0"), 'unknown key "speed" in number 1 of run'),
        (SCENE.replace("fps = 4000", "fsp = 4000"), 'unknown key "fsp" in camera'),
        (SCENE.replace("fps = 4000", 'fps = "4000"'), 'expected fps of camera as a number but got "4000"'),
        (SCENE.replace("fps = 4000", "exposure = 2"), "camera: expected an exposure between 0 and 1 frame interval"),
        (SCENE.replace("width = 60", "depth = 60"), 'unknown key "depth" in target'),
        (SCENE.replace("width = 60", "width = 0"), "target: expected a block larger than 1 x 1 px but got 0 x 44 px"),
        (SCENE + "[rod]\ny = 3", 'expected the key x of rod but it is missing; unknown key "y" in rod'),
        (SCENE.replace("fps = 4000", "flicker = 3"), "expected flicker of camera as a table .* but got 3"),
        (SCENE.replace("F_c = 8.0", "F_c = true"), "expected F_c of coulomb of law as a number but got true"),
        ("name = 'empty'", "expected the key law but it is missing; expected the key run but it is missing"),
        ("law = {}\nrun = []", "expected law as .*1 or more values but got {}"),
    ],
)
def test_a_wrong_scene_is_told_in_one_sentence(text, message):
    with pytest.raises(FrictrackError, match=message):
        read_scene(text)


def test_a_wrong_parameter_or_missing_file_is_told(tmp_path):
    with pytest.raises(FrictrackError, match="coulomb has F_c but not F_x"):
        film_scene(read_scene(SCENE.replace("F_c", "F_x")), tmp_path)
    with pytest.raises(FrictrackError, match=r"expected a scene file .*none\.toml but cannot read it"):
        render_scene(tmp_path / "none.toml", tmp_path)


@pytest.mark.slow
def test_the_sample_films_are_those_of_their_scene(tmp_path):
    render_scene(samples.films_folder() / "scene.toml", tmp_path)
    truth, stored = (json.loads((folder / "truth.json").read_text()) for folder in (tmp_path, samples.films_folder()))
    assert truth["law"] == stored["law"]
    for made, run in zip(truth["runs"], stored["runs"], strict=True):
        np.testing.assert_allclose(made["x_m"], run["x_m"], rtol=0, atol=1e-9)
    for run in truth["runs"]:
        films = [ft.open_recording(folder / f"{run['name']}.avi") for folder in (tmp_path, samples.films_folder())]
        for made, stored_frame in zip(*(islice(film.frames(), 5) for film in films), strict=True):
            assert np.abs(made - stored_frame).mean() < 0.5  # grey levels; JPEG coders differ in the last bit


def test_the_copied_samples_are_a_study(tmp_path):
    study = samples.copy_films(tmp_path / "films")
    assert sorted(path.name for path in study.parent.iterdir()) == [
        *("double_mass.avi", "fast.avi", "slow.avi", "study.toml", "to_a_stop.avi", "truth.json")
    ]
