"""From a rendered film to its displacement: camera shake, faults of the time base, and what is said of them."""

from __future__ import annotations

import json
import shutil

import h5py
import numpy as np
import pytest
import tifffile

from frictrack import recording
from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study, stages
from frictrack.flow.track_quality import correct_times
from frictrack.records import Track
from frictrack.sampling import Slip
from frictrack.simulate.scene import film_scene, read_scene

SCENE = """
name = "one slide"
mass = 0.35
format = "tif"
[law.coulomb]
F_c = 8.0
[camera]
fps = 4000
width = 320
height = 96
{camera}
[target]
width = 60
height = 44
[[run]]
name = "v3"
v = 3.0
frames = 120
"""
SHAKE = "shake_x = {amplitude = 0.5, frequency = 87}\nshake_y = {amplitude = 0.3, frequency = 61}"


def filmed(folder, camera=""):
    """A film, rendered once for all tests, and its true displacement, m."""
    once = folder.parent / f"film_{len(camera)}"
    if not once.exists():
        film_scene(read_scene(SCENE.format(camera=camera)), once)
    shutil.copytree(once, folder, dirs_exist_ok=True)
    return np.array(json.loads((folder / "truth.json").read_text())["runs"][0]["x_m"])


def refilmed(folder, frames):
    """The same film with its frames in another order."""
    pictures = tifffile.imread(folder / "v3.tif")[frames]
    tifffile.imwrite(folder / "v3.tif", pictures, photometric="minisblack")


def worked(folder, keys=""):
    """The run of the study with further keys."""
    path = folder / "study.toml"
    path.write_text(path.read_text().split("# further\n")[0] + f"# further\n{keys}\n")
    return Session(open_study(path)).runs[0]


def error_um(displacement, x):
    """Rms of displacement minus truth, whatever the origin."""
    off = (displacement.x - x)[displacement.valid]
    return 1e6 * float(np.std(off))


def said(displacement, words):
    return [note for note in displacement.notes if words in note]


# ---- the targets of several films


@pytest.mark.slow
def test_films_with_other_rectangles_are_not_said_to_depend_on_the_direction(tmp_path):
    """With areas drawn, the second film follows a point one pixel aside, which is moved after it was checked."""
    filmed(tmp_path)
    path = tmp_path / "study.toml"
    head, run = path.read_text().split("[[run]]\n")
    x, y = (int(at) for at in Session(open_study(path)).runs[0].get("track").target[:2])
    twice = [
        run.replace('"v3"', f'"{name}"') + f"target = [{x + off}, {y}, 50, 36]\nobstacles = [[300, 80, 10, 10]]\n"
        for name, off in (("a", 0), ("b", 1))
    ]
    path.write_text("[[run]]\n".join([head, *twice]))
    notes = [work.get("displacement").notes for work in Session(open_study(path)).runs]
    assert not [note for own in notes for note in own if "tracked backward" in note]
    assert [note for note in notes[1] if note.startswith("tracked point moved by (-1.0")]


# ---- the fixed reference


def test_camera_shake_is_found_and_taken_out(tmp_path):
    """Shake of 175 um is left as less than the noise of the target adds: 1.1 um where a still film has 0.9."""
    x = filmed(tmp_path, SHAKE)
    work = worked(tmp_path)
    d = work.get("displacement")
    with_shake = worked(tmp_path, 'reference = "none"').get("displacement")
    assert error_um(with_shake, x) > 100
    assert error_um(d, x) < 1.6
    assert np.nanmedian(d.sigma_x) > np.nanmedian(with_shake.sigma_x)
    (note,) = said(d, "camera shake")
    assert note.startswith("camera shake of 0.3")
    assert "strongest at 8" in note
    assert 'reference = "none"' in note
    assert not said(with_shake, "shake")
    with h5py.File(work.path) as file:
        assert {"reference", "backward"} >= set(file["tracks"])


@pytest.mark.slow
def test_a_still_film_is_as_it_was(tmp_path):
    x = filmed(tmp_path)
    d = worked(tmp_path).get("displacement")
    without = worked(tmp_path, 'reference = "none"').get("displacement")
    assert error_um(d, x) == pytest.approx(error_um(without, x), rel=0.01)
    np.testing.assert_allclose(d.sigma_x, without.sigma_x)
    assert said(d, "no camera shake: the fixed reference [")
    named = worked(tmp_path, "reference = [264, 10, 48, 40]").get("displacement")
    assert said(named, "no camera shake: the fixed reference [264, 10, 48, 40]")


@pytest.mark.slow
def test_a_reference_that_the_target_passes_over_does_not_move_with_it(tmp_path):
    x = filmed(tmp_path)
    work = worked(tmp_path, "reference = [220, 10, 48, 40]")
    d = work.get("displacement")
    reference = work.get("tracks")["reference"]
    assert reference.reason[-1] == stages.REASON_COVERED
    assert 80 < reference.found.sum() < 119
    assert said(d, f"the target passes over the fixed reference in {120 - reference.found.sum()} frames")
    assert said(d, "no camera shake")
    assert error_um(d, x) < 1.6
    assert d.valid.all()


# ---- faults of the time base that no stamp tells of


def test_missing_and_doubled_frames_are_told_by_the_motion(tmp_path):
    x = filmed(tmp_path)
    frames = [i for i in range(120) if i not in (40, 80, 81)]
    frames.insert(20, 19)  # frame 20 of the film is frame 19 once more
    refilmed(tmp_path, frames)
    d = worked(tmp_path, 'reference = "none"').get("displacement")
    shown = np.rint(d.t * 4000).astype(int)
    assert shown.tolist() == [i for i in range(120) if i not in (40, 80, 81)]
    assert error_um(d, x[shown]) < 1.5
    assert said(d, "1 frame is doubled, found from the motion: frame 20; left out")
    assert said(d, "3 frames are missing, found from the motion: before frames 41, 80; left as gaps in time")
    assert len(worked(tmp_path, 'reference = "none"').get("motion")) == 117


@pytest.mark.few(1)
@pytest.mark.parametrize("pattern", ["three in a row", "16 scattered", "all"])
def test_pictures_shown_more_than_once(tmp_path, pattern):
    x = filmed(tmp_path)
    rng = np.random.default_rng(3)
    again = {
        "three in a row": [50, 50, 50],
        "16 scattered": 2 + rng.choice(110, 16, replace=False),
        "all": np.arange(60),
    }
    last = 60 if pattern == "all" else 120
    refilmed(tmp_path, np.sort(np.r_[np.arange(last), again[pattern]]))
    d = worked(tmp_path, 'reference = "none"').get("displacement")
    shown = np.rint(d.t * 4000).astype(int)
    assert shown[d.valid].tolist() == list(range(last))
    assert error_um(d, x[shown]) < 1.6
    assert said(d, "frames are doubled, found from the motion")
    assert bool(said(d, "the film was stretched by repeating frames")) == (pattern == "all")


@pytest.mark.slow
def test_missing_frames_of_a_shaking_film(tmp_path):
    """The shake is told on the true time base: its tones go through the gap."""
    x = filmed(tmp_path, SHAKE)
    refilmed(tmp_path, [i for i in range(120) if i not in (60, 61)])
    d = worked(tmp_path).get("displacement")
    shown = np.rint(d.t * 4000).astype(int)
    assert shown.tolist() == [i for i in range(120) if i not in (60, 61)]
    assert error_um(d, x[shown]) < 2.0
    assert said(d, "2 frames are missing, found from the motion: before frame 60")


def test_a_sound_film_keeps_its_times(tmp_path):
    x = filmed(tmp_path)
    d = worked(tmp_path, 'reference = "none"').get("displacement")
    assert len(d) == len(x)
    assert not said(d, "found from the motion")


def test_the_cameras_own_stamps_are_believed(tmp_path, monkeypatch):
    filmed(tmp_path)
    refilmed(tmp_path, [i for i in range(120) if i != 40])
    work = worked(tmp_path, 'reference = "none"')
    work.recording.clocked = True
    assert len(work.get("displacement")) == 119
    np.testing.assert_allclose(np.diff(work.get("displacement").t), 1 / 4000)
    assert said(work.get("displacement"), "before frame 40; the film's time stamps disagree and are used")


def test_times_are_moved_and_frames_left_out():
    n = 12
    one = np.ones(n)
    track = Track(np.arange(n) / 1000, np.arange(n) * 1.0, one, one, one, one, one, np.full(n, ""))
    made = correct_times(track, (Slip(3, 2), Slip(6, -1), Slip(9, 0)))
    np.testing.assert_allclose(1000 * made.t, [0, 1, 2, 5, 6, 7, 8, 9, 10, 11, 12])
    assert made.x_px[[5, 6]].tolist() == [5, 7]  # frame 6 was put in
    assert np.flatnonzero(~made.found).tolist() == [8]
    assert made.reason[8] == "the frame before once more"
    assert correct_times(track, ()) is track


# ---- what is done with the film


@pytest.mark.slow
def test_a_compressed_film_is_decoded_once(tmp_path, monkeypatch):
    filmed(tmp_path)
    text = (tmp_path / "study.toml").read_text()
    (tmp_path / "study.toml").write_text(text.replace("v3.tif", "v3.avi"))
    from frictrack.simulate.rendering import write_film  # noqa: PLC0415

    write_film(tifffile.imread(tmp_path / "v3.tif"), tmp_path / "v3.avi", 4000)
    passes = []
    read = recording.Video._read

    def counted(film, indices):
        listed = list(indices)
        passes.append(len(listed))
        return read(film, listed)

    monkeypatch.setattr(recording.Video, "_read", counted)
    Session(open_study(tmp_path / "study.toml")).measure("track", overlay=True)
    assert [n for n in passes if n > 1] == [120]
    assert (tmp_path / "study_results" / "v3_overlay.avi").stat().st_size > 10_000


def test_a_target_by_a_click_a_rectangle_and_a_picture(tmp_path):
    import cv2  # noqa: PLC0415

    filmed(tmp_path)
    found = worked(tmp_path).get("track")
    x, y, w, h = (int(v) for v in found.target)
    cv2.imwrite(str(tmp_path / "block.png"), tifffile.imread(tmp_path / "v3.tif")[30][:, : 2 * w])
    picture = tifffile.imread(tmp_path / "v3.tif")[0][y : y + h, x : x + w]
    cv2.imwrite(str(tmp_path / "block.png"), picture)
    keys = {}
    for text in (f"target = [{x + w // 2}, {y + h // 2}]", f"target = [{x}, {y}, {w}, {h}]", 'target = "block.png"'):
        work = worked(tmp_path, text)
        keys[text] = work.key("track")
        assert np.ptp(work.get("track").x_px) == pytest.approx(np.ptp(found.x_px), abs=0.05)
    cv2.imwrite(str(tmp_path / "block.png"), picture[2:])
    keys["another picture"] = worked(tmp_path, 'target = "block.png"').key("track")
    assert len(set(keys.values())) == 4


def test_further_targets_are_shown_and_stored(tmp_path):
    filmed(tmp_path)
    work = worked(tmp_path, "targets = {course = [240, 72, 64, 20]}")
    tracks = work.get("tracks")
    assert set(tracks) == {"course", "reference", "backward"}
    assert [t.name for t in stages.tracks_to_draw(tracks)] == ["course", "reference"]
    assert np.nanstd(tracks["course"].x_px) < 0.05


def test_a_board_that_is_none_is_said_before_the_film_is_gone_through(tmp_path, monkeypatch):
    import cv2  # noqa: PLC0415

    filmed(tmp_path)
    cv2.imwrite(str(tmp_path / "board.png"), np.full((96, 320), 128, np.uint8))
    text = (tmp_path / "study.toml").read_text()
    board = 'scale = {board = "board.png", squares = [6, 4], square = "10 mm"}'
    (tmp_path / "study.toml").write_text(text.replace('scale = "0.5 mm/px"', board))
    monkeypatch.setattr(recording.Tiff, "cut", lambda *given: pytest.fail("the film was gone through"))
    with pytest.raises(FrictrackError, match=r'run "v3", track: .*board\.png') as caught:
        worked(tmp_path).get("track")
    assert "Traceback" not in str(caught.value)


# ---- what is said of it


def test_the_row_of_a_film(tmp_path):
    filmed(tmp_path, SHAKE)
    path = tmp_path / "study.toml"
    (row,) = Session(open_study(path)).measure("track")["runs"]
    assert row["found"] == row["frames"] == 120
    assert row["lost"] == {}
    assert row["sigma_um"] == pytest.approx(500 * row["sigma_px"])
    assert 0.001 < row["sigma_px"] < 0.005
    assert row["forward_backward_px"] < row["sigma_px"]
    assert row["shake_Hz"] == pytest.approx(87, abs=3)
    assert row["shake_px"] == pytest.approx(np.hypot(0.5, 0.3) / np.sqrt(2), rel=0.1)
    assert 0.002 < row["noise_floor_px"] < 0.03
    assert len(row["reference"]) == 4
    assert (row["exposure_s"], row["blur_px"], row["overlay"]) == (None, None, None)
    assert {"what", "value", "verdict"} == set(row["timebase"][0])
    json.dumps(row, allow_nan=False)
