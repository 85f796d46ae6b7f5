"""Tracks in the own files of Tracker, Kinovea, DeepLabCut, movement, SLEAP, DICe and pyidi, as tables of a study."""

from __future__ import annotations

import gzip
import pickle
import shutil
import zipfile
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.flow import hash_path, open_study, run_pipeline, survey_recording
from frictrack.flow.new_study import expand_folders
from frictrack.study import find_recordings, open_table, read_table
from frictrack.study.track_formats import video_projects

DATA = Path(__file__).parent / "data" / "tracks"
N = np.arange(24)
X, Y = 100 + 5.0 * N + 0.05 * N**2, 50 + 0.1 * N  # px, of the first point in the files of tests/data/tracks
SEEN = N != 7  # where its likelihood is at least 0.6
ACCELERATION = 3.0  # m/s^2

# What Tracker 6 saves: TrackerPanel.Loader, VideoClip.Loader, StepperClipControl, ImageCoordSystem.Loader, PointMass.
TRK = """<?xml version="1.0" encoding="UTF-8"?>
<object class="org.opensourcephysics.cabrillo.tracker.TrackerPanel">
    <property name="semantic_version" type="string">6.1.6</property>
    <property name="width" type="double">640.0</property>
    <property name="videoclip" type="object">
    <object class="org.opensourcephysics.media.core.VideoClip">
        <property name="video_framecount" type="int">60</property>
        <property name="startframe" type="int">10</property>
        <property name="stepsize" type="int">2</property>
        <property name="stepcount" type="int">20</property>
        <property name="starttime" type="double">500.0</property>
    </object>
    </property>
    <property name="clipcontrol" type="object">
    <object class="org.opensourcephysics.media.core.StepperClipControl">
        <property name="rate" type="double">1.0</property>
        <property name="delta_t" type="double">4.166666666666667</property>
    </object>
    </property>
    <property name="coords" type="object">
    <object class="org.opensourcephysics.media.core.ImageCoordSystem">
        <property name="fixedorigin" type="boolean">{fixed}</property>
        <property name="fixedangle" type="boolean">{fixed}</property>
        <property name="fixedscale" type="boolean">{fixed}</property>
        <property name="framedata" type="array" class="[Lorg.opensourcephysics.media.core.ImageCoordSystem$FrameData;">
{coords}        </property>
    </object>
    </property>
    <property name="length_unit" type="string">{unit}</property>
    <property name="tracks" type="collection" class="java.util.ArrayList">
        <property name="item" type="object">
        <object class="org.opensourcephysics.cabrillo.tracker.CoordAxes">
            <property name="name" type="string">axes</property>
        </object>
        </property>
{masses}    </property>
</object>
"""
TRK_MASS = """        <property name="item" type="object">
        <object class="{kind}">
            <property name="mass" type="double">1.0</property>
            <property name="name" type="string">{name}</property>
            <property name="framedata" type="array" class="[L{kind}$FrameData;">
{points}            </property>
            <property name="keyFrames" type="array" class="[I">
                <property name="array" type="string">{{0}}</property>
            </property>
        </object>
        </property>
"""
MASS = "org.opensourcephysics.cabrillo.tracker.PointMass"
OBJECT = '<property name="[{n}]" type="object"><object class="{kind}$FrameData">{values}</object></property>\n'
COORDS = {"xorigin": 300.0, "yorigin": 200.0, "angle": 12.0, "xscale": 2500.0, "yscale": 2500.0}

# What Kinovea 2023 and later save: MetadataSerializer, CalibrationHelper.WriteXml, DrawingTrack.WriteXml.
KVA = """<?xml version="1.0" encoding="utf-8"?>
<KinoveaVideoAnalysis>
  <FormatVersion>{version}</FormatVersion>
  <Producer>Kinovea.2023.1.2</Producer>
  <OriginalFilename>slide</OriginalFilename>
  <ImageSize>640;480</ImageSize>
  <AverageTimeStampsPerFrame>512</AverageTimeStampsPerFrame>
  <CaptureFramerate>240</CaptureFramerate>
  <UserFramerate>30</UserFramerate>
  <FirstTimeStamp>0</FirstTimeStamp>
  <TimeOrigin>1024</TimeOrigin>
{calibration}  <Tracks>
{tracks}  </Tracks>
</KinoveaVideoAnalysis>
"""
KVA_TRACK = """    <Track id="1" name="{name}">
      <TimePosition>1024</TimePosition>
      <TrackPointList Count="3">
{points}      </TrackPointList>
      <MainLabel Text="{name}"><SpacePosition>0;0</SpacePosition></MainLabel>
    </Track>
"""


def properties(values: dict[str, float]) -> str:
    return "".join(f'<property name="{key}" type="double">{value!r}</property>' for key, value in values.items())


def tracker_project(
    points: dict[str, dict[int, tuple[float, float]]], coords: dict[int, dict[str, float]], *, unit: str = "cm"
) -> str:
    """A project of Tracker with the px positions of each mass by frame."""
    masses = ""
    for name, marked in points.items():
        rows = (OBJECT.format(n=n, kind=MASS, values=properties({"x": x, "y": y})) for n, (x, y) in marked.items())
        masses += TRK_MASS.format(name=name, kind=MASS, points="".join(rows))
    kind = "org.opensourcephysics.media.core.ImageCoordSystem"
    frames = "".join(OBJECT.format(n=n, kind=kind, values=properties(one)) for n, one in coords.items())
    return TRK.format(fixed="true" if len(coords) == 1 else "false", coords=frames, unit=unit, masses=masses)


def kinovea_project(points: dict[str, np.ndarray], calibration: str = "", version: str = "2.1") -> str:
    """Annotations of Kinovea with points (x, y, time stamp) of each track."""
    tracks = ""
    for name, rows in points.items():
        shown = (f"        <TrackPoint>{x!r};{y!r};{int(t)}</TrackPoint>\n" for x, y, t in rows.tolist())
        tracks += KVA_TRACK.format(name=name, points="".join(shown))
    return KVA.format(version=version, calibration=calibration, tracks=tracks)


def unpacked(name: str, folder: Path) -> Path:
    """A sample file of tests/data/tracks."""
    path = folder / name
    packed = DATA / f"{name}.gz"
    path.write_bytes(gzip.decompress(packed.read_bytes()) if packed.exists() else (DATA / name).read_bytes())
    return path


def refused(path: Path, columns: dict[str, str] | None = None, **how) -> str:
    with pytest.raises(FrictrackError) as caught:
        read_table(path, columns or {}, **how)
    return str(caught.value)


def image_to_world(coords: dict[str, float], x: float, y: float) -> np.ndarray:
    """The inverse of the matrix of ImageCoordSystem.updateTransforms."""
    sx, sy, angle = coords["xscale"], coords["yscale"], np.radians(coords["angle"])
    cos, sin = np.cos(angle), np.sin(angle)
    to_image = np.array(
        [[sx * cos, -sx * sin, coords["xorigin"]], [-sy * sin, -sy * cos, coords["yorigin"]], [0, 0, 1]]
    )
    return np.linalg.solve(to_image, [x, y, 1.0])[:2]


# --- Tracker


def test_a_project_of_tracker_gives_world_coordinates_and_times(tmp_path) -> None:
    path = tmp_path / "run.trk"
    points = {n: (310.0 + 3.0 * n, 205.0 - 0.5 * n) for n in range(8, 54)}
    path.write_text(tracker_project({"slider": points}, {0: COORDS}))
    data = read_table(path)
    shown = list(range(10, 50, 2))  # 20 steps of 2 frames from frame 10 on
    truth = np.array([image_to_world(COORDS, *points[n]) for n in shown]) / 100  # its unit is cm
    np.testing.assert_allclose(data.t, 0.5 + (np.array(shown) - 10) / 240)
    np.testing.assert_allclose(np.c_[data.x, data.y], truth, atol=1e-15)
    pixels = read_table(path, {"x": "pixelx (px)"}, pixel=1e-3)
    np.testing.assert_allclose(pixels.x, [1e-3 * points[n][0] for n in shown])


def test_coordinates_that_change_hold_from_their_frame_on(tmp_path) -> None:
    path = tmp_path / "run.trk"
    turned = COORDS | {"angle": -30.0, "xorigin": 50.0}
    points = {n: (310.0 + 3.0 * n, 205.0) for n in range(10, 50, 2)}
    path.write_text(tracker_project({"slider": points}, {0: COORDS, 21: turned}))
    truth = [image_to_world(COORDS if n < 21 else turned, *points[n])[0] / 100 for n in points]
    np.testing.assert_allclose(read_table(path).x, truth, atol=1e-15)


def test_one_of_several_masses_is_chosen_and_frames_without_a_mark_are_missing(tmp_path) -> None:
    path = tmp_path / "run.trk"
    marked = {n: (300.0 + n, 200.0) for n in range(10, 50, 2) if n != 20}
    masses = {"-A": {10: (1.0, 2.0), 48: (3.0, 4.0)}, "mass (2)": marked}
    path.write_text(tracker_project(masses, {0: COORDS | {"angle": 0.0}}, unit="m"))
    said = refused(path)
    assert "expected the name of a track, as Tracker has 2; choose one in its [[run]] with columns = {x = " in said
    assert '"-A x (m)"};' in said
    assert len(read_table(path, {"x": "-A x (m)"}).t) == len(read_table(path, {"x": "--A x (m)"}).t) == 2
    data = read_table(path, {"x": "mass (2) x (m)"})
    np.testing.assert_allclose(data.x, [n / 2500 for n in marked])
    np.testing.assert_allclose(data.t, [0.5 + (n - 10) / 240 for n in marked])
    assert "-A x (m)" in open_table(path).frame.columns


def test_a_film_without_calibration_has_positions_in_px(tmp_path) -> None:
    path = tmp_path / "run.trk"
    plain = {"xorigin": 320.0, "yorigin": 240.0, "angle": 0.0, "xscale": 1.0, "yscale": 1.0}
    path.write_text(tracker_project({"a": {10: (330.0, 240.0), 12: (350.0, 238.0)}}, {0: plain}, unit="m"))
    assert 'expected the scale of "x (px)" in px but got none; give scale = "0.5 mm/px" in [camera]' in refused(path)
    data = read_table(path, pixel=1e-3)
    np.testing.assert_allclose(np.c_[data.x, data.y], [[0.01, 0.0], [0.03, 0.002]])


def test_a_zipped_project_of_tracker_is_opened(tmp_path, monkeypatch) -> None:
    text = tracker_project({"a": {10: (330.0, 240.0), 12: (350.0, 238.0)}}, {0: COORDS})
    (tmp_path / "run.trk").write_text(text)
    with zipfile.ZipFile(tmp_path / "run.trz", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("videos/film.mp4", b"0")
        packed.writestr("run.trk", text)
    np.testing.assert_array_equal(read_table(tmp_path / "run.trz").x, read_table(tmp_path / "run.trk").x)
    monkeypatch.setattr(video_projects, "MAX_UNPACKED_BYTES", 1000)
    assert "cannot read it (unclosed token" in refused(tmp_path / "run.trz")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('name="delta_t"', 'name="other"'), "it states no duration of a frame"),
        (('<property name="width"', '<property name="referenceframe">b</property><property name="width"'), 'track "b"'),
        (("PointMass", "DynamicParticle"), "it holds no track with positions"),
        (("2500.0", "0.0"), "expected a scale other than 0 px"),
        (("</object>", ""), "mismatched tag"),
        (("?>", '?><!DOCTYPE a [<!ENTITY b "c">]>'), "it defines entities"),
    ],
)
def test_a_project_of_tracker_that_cannot_be_used_is_refused(tmp_path, change, said) -> None:
    path = tmp_path / "run.trk"
    text = tracker_project({"a": {10: (330.0, 240.0), 12: (350.0, 238.0)}}, {0: COORDS})
    for encoding in ("utf-8", "utf-16"):
        path.write_text(text.replace(*change).replace('"UTF-8"', f'"{encoding}"'), encoding=encoding)
        assert said in refused(path)
        assert "run.trk: expected tracks of Tracker but cannot read it" in refused(path)


# --- Kinovea


@pytest.mark.parametrize("kind", ["line", "scale", "plane", "none"])
def test_annotations_of_kinovea_give_calibrated_coordinates_and_times(tmp_path, kind) -> None:
    world = np.array([[0.0, 0.0], [10.0, 1.0], [25.0, -2.0]])  # x, y up
    if kind == "plane":  # seen in perspective: the picture of a point (x, y) of the rectangle, y down from its top
        view = np.array([[4.0, 0.5, 100.0], [-0.3, 5.0, 60.0], [0.001, 0.002, 1.0]])
        size, origin, offset = (80.0, 50.0), np.array([20.0, 30.0]), np.array([1.0, -2.0])
        corners = np.array([[0.0, 0.0], [size[0], 0.0], size, [0.0, size[1]]])
        seen = "".join(
            f"<{name}>{x!r};{y!r}</{name}>"
            for name, (x, y) in zip("ABCD", through(view, corners).tolist(), strict=True)
        )
        inner = f"<Size>80;50</Size><Quadrilateral>{seen}</Quadrilateral><Origin>20;30</Origin><Offset>1;-2</Offset>"
        calibration, unit = f"<CalibrationPlane>{inner}</CalibrationPlane>", "Centimeters"
        pixels = through(view, origin + (world - offset) * [1, -1])
    elif kind == "line":  # 20 cm from (100, 400) to (180, 340), which is +x: 100 px, so 5 px/cm
        inner = "<Length>20</Length><Segment><A>100;400</A><B>180;340</B></Segment><Origin>0;20</Origin>"
        calibration, unit = f"<CalibrationLine>{inner}<Axis>LineHorizontal</Axis></CalibrationLine>", "Centimeters"
        along, up = np.array([0.8, -0.6]), np.array([-0.6, -0.8])
        pixels = np.array([100.0, 400.0]) + 5 * (world[:, :1] * along + world[:, 1:] * up)
    elif kind == "scale":  # until 0.8.22
        calibration, unit = (
            "<CalibrationLine><Origin>50;60</Origin><Scale>0.25</Scale></CalibrationLine>",
            "Centimeters",
        )
        pixels = np.array([50.0, 60.0]) + world * [4, -4]
    else:
        calibration, unit, pixels = "", "Pixels", np.array([320.0, 240.0]) + world * [1, -1]
    abbreviation = {"Centimeters": "cm", "Pixels": "px"}[unit]
    text = f'<Calibration>{calibration}<Unit Abbreviation="{abbreviation}">{unit}</Unit></Calibration>'
    path = tmp_path / ("run.xml" if kind == "scale" else "run.kva")
    path.write_text(kinovea_project({"hand": np.c_[pixels, [1024, 1536, 2560]]}, text))
    data = read_table(path, pixel=0.01)
    np.testing.assert_allclose(np.c_[data.x, data.y], world / 100, atol=1e-12)
    np.testing.assert_allclose(data.t, np.array([0, 1, 3]) / 240)
    assert open_table(path).columns["x"] == f"x ({abbreviation})"


def through(view: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The picture of points of a plane."""
    found = np.c_[points, np.ones(len(points))] @ view.T
    return found[:, :2] / found[:, 2:]


@pytest.mark.parametrize(("axis", "end"), [("LineVertical", (100, 300)), ("ImageAxes", (160, 320))])
def test_a_line_of_kinovea_may_be_vertical_or_only_give_the_scale(tmp_path, axis, end) -> None:
    inner = f"<Length>20</Length><Segment><A>100;400</A><B>{end[0]};{end[1]}</B></Segment><Axis>{axis}</Axis>"
    unit = '<Unit Abbreviation="mm">Millimeters</Unit>'
    text = f"<Calibration><CalibrationLine>{inner}</CalibrationLine>{unit}</Calibration>"
    path = tmp_path / "run.kva"
    path.write_text(kinovea_project({"hand": np.array([[100.0, 400.0, 1024], [150.0, 390.0, 1536]])}, text))
    data = read_table(path)  # both lines have 100 px for 20 mm
    np.testing.assert_allclose(np.c_[data.x, data.y], [[0, 0], [10e-3, 2e-3]], atol=1e-15)


def test_annotations_of_kinovea_that_cannot_be_used_are_refused(tmp_path) -> None:
    path = tmp_path / "run.kva"
    points = {"a": np.array([[1.0, 2.0, 1024], [2.0, 2.0, 1536]]), "b": np.array([[1.0, 2.0, 1024], [2.0, 2.0, 1536]])}
    path.write_text(kinovea_project(points))
    assert 'columns = {x = "a x (px)"}' in refused(path)
    path.write_text(kinovea_project(points, version="1.5"))
    assert "expected annotations of Kinovea, format 2.0 or later, but got version 1.5" in refused(path)
    path.write_text(kinovea_project(points, "<Calibration><CameraCalibration/></Calibration>"))
    assert "it corrects the distortion of the lens; export a spreadsheet" in refused(path)
    path.write_text(kinovea_project(points, "<Calibration><CalibrationPlane/></Calibration>"))
    assert "expected 2 numbers separated by ; but got ''" in refused(path)
    path.write_text(kinovea_project({"a": points["a"]}).replace("CaptureFramerate", "Other"))
    assert "expected the frame rate of" in refused(path, pixel=1.0)
    np.testing.assert_allclose(read_table(path, pixel=1.0, fps=100).t, [0, 0.01])
    path.write_text("<html/>")
    assert "but got <html>" in refused(path)


# --- DeepLabCut, movement, SLEAP


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("name", "header", "program"),
    [
        ("dlc.csv", "slider x (px)", "DeepLabCut"),
        ("dlc.h5", "slider x (px)", "DeepLabCut"),
        ("dlc_multi.csv", "left slider x (px)", "DeepLabCut"),
        ("dlc_multi.h5", "left slider x (px)", "DeepLabCut"),
        ("movement.nc", "slider x (px)", "movement"),
        ("movement_frames.nc", "slider x (px)", "movement"),
        ("sleap.h5", "left x (px)", "SLEAP"),
    ],
)
def test_a_point_of_a_pose_file_is_chosen_by_its_name(tmp_path, name, header, program) -> None:
    path = unpacked(name, tmp_path)
    assert open_table(path).program == program
    assert f'columns = {{x = "{header}"}}' in refused(path)
    data = read_table(path, {"x": header}, pixel=1e-3, fps=240)
    seen = np.ones(len(N), dtype=bool) if program == "SLEAP" else SEEN  # SLEAP has another scale of scores
    np.testing.assert_allclose(data.t, N[seen] / 240)
    np.testing.assert_allclose(data.x, 1e-3 * X[seen])
    np.testing.assert_allclose(data.y, -1e-3 * Y[seen])  # up is positive
    noted = "1 of 24 frames have a likelihood below 0.6, the pcutoff of DeepLabCut; they count as missing"
    assert data.notes == (() if program == "SLEAP" else (noted,))


def test_positions_equal_those_that_pandas_and_xarray_read(tmp_path) -> None:
    xarray = pytest.importorskip("xarray")
    table = pd.read_csv(DATA / "dlc.csv", header=[0, 1, 2], index_col=0)
    found = open_table(DATA / "dlc.csv").frame["rod x (px)"]
    np.testing.assert_array_equal(found, table.xs("rod", axis=1, level=1).xs("x", axis=1, level=1).squeeze())
    with xarray.open_dataset(unpacked("movement.nc", tmp_path), engine="h5netcdf") as dataset:
        frame = open_table(tmp_path / "movement.nc").frame
        np.testing.assert_array_equal(frame["t (s)"], dataset.time)
        rod = dataset.position.sel(keypoints="rod", individuals="individual_0")
        np.testing.assert_array_equal(frame[["rod x (px)", "rod y (px)"]], rod)


def test_times_in_frames_need_the_frame_rate(tmp_path) -> None:
    path = unpacked("dlc.csv", tmp_path)
    said = refused(path, {"x": "rod x (px)"}, pixel=1e-3)
    assert 'expected the frame rate of "frame (frames)" in frames but got none; give fps = 240 in [camera]' in said
    (tmp_path / "t.csv").write_text("picture,x_m\n4,1\n5,2\n")  # of any table
    np.testing.assert_allclose(read_table(tmp_path / "t.csv", {"t": "picture (frames)"}, fps=100).t, [0.04, 0.05])


def test_nothing_in_a_pickle_of_names_is_executed(tmp_path) -> None:
    path, mark = unpacked("dlc.h5", tmp_path), tmp_path / "mark"

    class Attack:
        def __reduce__(self):
            return (Path.touch, (mark,))

    with h5py.File(path, "r+") as file:
        file["df_with_missing/table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps([Attack()], 0))
    assert "expected names of columns but got global in their place" in refused(path)
    assert not mark.exists()


def test_hdf5_that_is_damaged_or_of_others_is_refused_with_one_sentence(tmp_path) -> None:
    path = unpacked("movement.nc", tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert "movement.nc: expected tracks of DeepLabCut, movement or SLEAP but cannot read it (" in refused(path)
    with h5py.File(path, "w") as file:
        file["rates"] = np.ones(3)
    assert "(position) or SLEAP (tracks, node_names) but got rates" in refused(path)
    with h5py.File(path, "w") as file:
        file.create_dataset("tracks", (1 << 20, 2, 1, 1 << 20), dtype="f4", chunks=(1, 1, 1, 1024))
        file["node_names"], file["track_names"] = [b"a"], [b"b"]
    assert "tracks is too large" in refused(path)
    (tmp_path / "secret").write_bytes(bytes(80))
    with h5py.File(path, "w") as file:
        outside = [(str(tmp_path / "secret"), 0, 80)]
        file.create_dataset("tracks", (1, 2, 1, 5), dtype="f8", external=outside)
        file["node_names"], file["track_names"] = [b"a"], [b"b"]
    assert "the values of tracks lie in another file" in refused(path)
    path.write_bytes(b"CDF\x01" + bytes(100))
    assert "it is netCDF 3" in refused(path)


# --- DICe


def test_a_folder_of_dice_gives_each_subset_with_its_standard_deviation() -> None:
    path = DATA / "dice"
    first, second = (pd.read_csv(path / f"DICe_solution_{n}.txt") for n in ("000", "020"))
    data = read_table(path, {"x": "subset 6 x (px)"}, pixel=1.0, fps=1.0)
    assert len(data.t) == 19
    np.testing.assert_allclose(data.t, 20.0 * np.arange(19))  # the number in the name counts frames
    for i, rows in enumerate((first, second)):
        row = rows[rows.SUBSET_ID == 6].iloc[0]
        assert data.x[i] == row.COORDINATE_X + row.DISPLACEMENT_X
        assert data.y[i] == -(row.COORDINATE_Y + row.DISPLACEMENT_Y)
        assert data.sigma[i] == row.SIGMA


def test_the_subsets_of_dice_turn_as_the_pattern_did() -> None:
    cells = open_table(DATA / "dice").frame.to_numpy()
    places = (cells[:, 1::3] - 1j * cells[:, 2::3]).T  # x, y up, of each subset over the frames
    places = places[np.isfinite(places).all(axis=1)]
    arms = places - places.mean(axis=0)
    turns = [np.angle(np.sum(late * np.conj(early)), deg=True) for early, late in pairwise(arms.T)]
    np.testing.assert_allclose(np.abs(turns), 20.0, atol=0.1)


DICE_SUBSET = """***
*** Digital Image Correlation Engine (DICe), Copyright 2015 Sandia Corporation
*** Coordinates given with (0,0) as upper left corner of image, x positive right, y positive down
***
FRAME,COORDINATE_X,COORDINATE_Y,DISPLACEMENT_X,DISPLACEMENT_Y,ROTATION_Z,SIGMA,GAMMA,STATUS_FLAG
1,3.1900E+02,2.7800E+02,0.0000E+00,0.0000E+00,0.0000E+00,7.4934E-02,0.0000E+00,4.0000E+00
2,3.1900E+02,2.7800E+02,1.5000E+00,-1.0000E+00,-1.0898E-03,7.8699E-02,1.5571E-03,4.0000E+00
3,3.1900E+02,2.7800E+02,1.5000E+00,-1.0000E+00,0.0000E+00,-1.0000E+00,-1.0000E+00,8.0000E+00
4,3.1900E+02,2.7800E+02,6.0000E+00,-1.0000E+00,-1.0898E-03,8.0000E-02,1.5571E-03,4.0000E+00
"""  # the failed frame as Schema::record_failed_step leaves it


@pytest.mark.parametrize("text", [DICE_SUBSET, DICE_SUBSET.replace(",", " ")])
def test_frames_that_dice_could_not_match_are_missing(tmp_path, text) -> None:
    path = tmp_path / "DICe_solution_0.txt"
    path.write_text(text)
    data = read_table(path, pixel=1e-3, fps=100)
    np.testing.assert_allclose(data.t, [0.01, 0.02, 0.04])
    np.testing.assert_allclose(data.x, [0.319, 0.3205, 0.325])
    np.testing.assert_allclose(data.sigma, [7.4934e-5, 7.8699e-5, 8e-5])
    assert data.notes == ("DICe could not match 1 of 4 frames; they are missing",)


def test_solutions_of_dice_that_cannot_be_used_are_refused(tmp_path) -> None:
    path = tmp_path / "DICe_solution_0.txt"
    path.write_text(DICE_SUBSET.replace("DISPLACEMENT_X", "STRAIN"))
    assert "DICe_solution_0.txt lacks DISPLACEMENT_X; add them to the output_spec of DICe" in refused(path)
    shutil.copy(DATA / "dice" / "DICe_solution_000.txt", path)
    assert "it is the solution of one frame; name the folder of all frames instead" in refused(path)
    (tmp_path / "DICe_solution_1.txt").write_text(DICE_SUBSET)
    assert "expected solutions of one kind, by frame or by subset, but got both" in refused(tmp_path)
    (tmp_path / "empty").mkdir()
    assert "a folder without solutions of DICe" in refused(tmp_path / "empty")


def test_a_folder_of_dice_is_hashed_with_all_its_files(tmp_path) -> None:
    folder = shutil.copytree(DATA / "dice", tmp_path / "dice")
    before = hash_path(folder)
    last = folder / "DICe_solution_360.txt"
    last.write_text(last.read_text().replace("0", "1", 1))
    assert hash_path(folder) != before


# --- pyidi


def test_displacements_of_pyidi_are_rows_before_columns(tmp_path) -> None:
    path = tmp_path / "displacements.npy"
    found = np.zeros((2, 5, 2))
    found[1, :, 0], found[1, :, 1] = 0.1 * np.arange(5), np.arange(5)  # y, x as LucasKanade.get_displacements returns
    found[1, 3] = np.nan  # a point that was lost
    np.save(path, found)
    data = read_table(path, {"x": "point 1 x (px)"}, pixel=1e-3, fps=1000)
    np.testing.assert_allclose(data.t, [0, 0.001, 0.002, 0.004])
    np.testing.assert_allclose(data.x, [0, 1e-3, 2e-3, 4e-3])
    np.testing.assert_allclose(data.y, [0, -1e-4, -2e-4, -4e-4])


def test_pickles_are_never_opened(tmp_path) -> None:
    (tmp_path / "results.pkl").write_bytes(pickle.dumps(np.zeros((1, 5, 2))))
    said = refused(tmp_path / "results.pkl")
    assert "a pickle, which can run any code when it is opened, is never read; save with numpy.save(" in said
    np.save(tmp_path / "objects.npy", np.array([{}]))
    assert "objects.npy: expected tracks of pyidi but cannot read it (" in refused(tmp_path / "objects.npy")
    np.save(tmp_path / "flat.npy", np.zeros((5, 2)))
    assert "expected displacements (points, frames, 2) but got float64 (5, 2)" in refused(tmp_path / "flat.npy")


# --- in a study


def write_dice_study(folder: Path, sigma: float = 0.01) -> Path:
    """A study with one subset of DICe that slides to a stop: 240 frames/s, 0.5 mm/px."""
    t = np.arange(200) / 240
    x = (2.0 * t - ACCELERATION / 2 * t**2) / 0.5e-3
    rows = [f"{n},100,50,{u:.4E},0.0,{sigma},0.01,4" for n, u in enumerate(x)]
    names = "FRAME,COORDINATE_X,COORDINATE_Y,DISPLACEMENT_X,DISPLACEMENT_Y,SIGMA,GAMMA,STATUS_FLAG"
    (folder / "DICe_solution_0.txt").write_text("\n".join([names, *rows]) + "\n")
    path = folder / "study.toml"
    path.write_text(
        '[study]\nmass = "0.35 kg"\n[camera]\nfps = 240\nscale = "0.5 mm/px"\n'
        '[[run]]\nname = "a"\ntable = "DICe_solution_0.txt"\n'
    )
    return path


def test_standard_deviations_and_notes_reach_the_displacement(tmp_path) -> None:
    (run,) = open_study(write_dice_study(tmp_path)).runs
    found = open_study(tmp_path / "study.toml")
    displacement = run_pipeline(found, run).get("displacement")
    np.testing.assert_allclose(displacement.sigma_x, 0.01 * 0.5e-3)
    np.testing.assert_allclose(displacement.t, np.arange(200) / 240)
    fitted = np.polyfit(displacement.t, displacement.x, 2)
    np.testing.assert_allclose(2 * fitted[0], -ACCELERATION, rtol=1e-3)


def test_a_track_that_does_not_move_across_is_measured(tmp_path) -> None:
    path = write_dice_study(tmp_path)
    points = np.zeros((1, 200, 2))
    points[0, :, 1] = pd.read_csv(tmp_path / "DICe_solution_0.txt").DISPLACEMENT_X
    np.save(tmp_path / "d.npy", points)
    path.write_text(path.read_text().replace("DICe_solution_0.txt", "d.npy"))
    study = open_study(path)
    motion = run_pipeline(study, study.runs[0]).get("motion")
    assert np.median(motion.a) == pytest.approx(-ACCELERATION, rel=0.02)
    assert np.isnan(motion.a_y).all()


def test_a_study_is_begun_with_the_files_of_other_programs(tmp_path) -> None:
    (tmp_path / "a.trk").write_text(tracker_project({"m": {10: (1.0, 2.0), 12: (3.0, 4.0)}}, {0: COORDS}))
    (tmp_path / "b.kva").write_text(kinovea_project({"k": np.array([[1.0, 2.0, 1024], [2.0, 2.0, 1536]])}))
    unpacked("movement.nc", tmp_path)
    shutil.copytree(DATA / "dice", tmp_path / "dice")
    np.save(tmp_path / "c.npy", np.random.default_rng(1).normal(size=(1, 5, 2)))
    with h5py.File(tmp_path / "results.h5", "w") as file:  # of something else
        file["rates"] = np.ones(3)
    names = [path.name for path in find_recordings(tmp_path)]
    assert names == ["a.trk", "b.kva", "c.npy", "dice", "movement.nc"]
    assert expand_folders([tmp_path / "dice"]) == [tmp_path / "dice"]
    seen = {name: survey_recording(tmp_path / name) for name in names}
    assert all(one.is_table and not one.problem for one in seen.values())
    assert seen["a.trk"].words == "2 rows, 0.00833 s of a Tracker export"
    assert seen["c.npy"].camera_keys == ("scale", "fps")
    assert seen["dice"].columns_to_confirm == ['columns = {x = "subset 0 x (px)"}']
    assert seen["movement.nc"].camera_keys == ("scale",)


@pytest.mark.parametrize("name", ["run.trk", "run.kva", "run.trz", "dlc.csv", "DICe_solution_0.txt", "d.npy"])
def test_a_damaged_file_gives_one_sentence(tmp_path, name) -> None:
    path = tmp_path / name
    tracker = tracker_project({"a": {10: (330.0, 240.0), 12: (350.0, 238.0)}}, {0: COORDS})
    if name.endswith(".trz"):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
            packed.writestr("a.trk", tracker)
    elif name.endswith(".npy"):
        np.save(path, np.random.default_rng(1).normal(size=(1, 5, 2)))
    else:
        kinovea = kinovea_project({"k": np.array([[1.0, 2.0, 1024], [2.0, 2.0, 1536]])})
        texts = {"run.trk": tracker, "run.kva": kinovea, "dlc.csv": (DATA / "dlc.csv").read_text()}
        path.write_text(texts.get(name, DICE_SUBSET))
    content = path.read_bytes()
    rng = np.random.default_rng(2)
    for i in range(60):
        damaged = bytearray(content[: rng.integers(1, len(content))] if i % 2 else content)
        for place in rng.integers(0, len(damaged), size=3):
            damaged[place] = rng.integers(0, 256)
        path.write_bytes(damaged)
        with suppress(FrictrackError):  # any other error fails the test
            read_table(path, {"x": "slider x (px)"} if name == "dlc.csv" else {}, pixel=1e-3, fps=240)
