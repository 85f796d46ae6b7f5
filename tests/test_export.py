"""Every format, read by its own library, holds the values and units of the HDF5 files exactly."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from conftest import slide
from tracker_program import read_project, world_positions

from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study, read_results
from frictrack.present import export
from frictrack.present.export import FORMATS, ExportedFiles, export_results
from frictrack.present.export.tables import (
    all_columns,
    describe,
    motion_columns,
    own_motion,
    sheet_names,
    track_columns,
)
from frictrack.present.export.tracker_project import PIXEL_CENTRE, tracker_axes
from frictrack.records import Displacement, Track
from frictrack.results import Results
from frictrack.samples import films_folder
from frictrack.study import read_table

STUDY = """
[study]
name = "a film & a table"
mass = "0.35 kg"
model = ["coulomb", "viscous"]

[[run]]
name = "film"
video = "films/fast.avi"
fps = 4000
scale = "0.5 mm/px"
targets = { edge = [40, 20, 12, 24] }

[[run]]
name = "table"
table = "table.csv"
"""
# Columns of the exported tables, and where they are in the HDF5 file of a run.
STORED = {
    "t": "displacement/t",
    "x_measured": "displacement/x",
    "sigma_x_measured": "displacement/sigma_x",
    "valid": "displacement/valid",
    "x": "motion/x",
    "v": "motion/v",
    "a": "motion/a",
    "sigma_a": "motion/sigma_a",
    "F": "friction/F",
    "sigma_F": "friction/sigma_F",
    "free": "friction/free",
}
CURVES = {"t_s": "t", "x_measured_m": "x_measured", "v_ms": "v", "a_ms2": "a", "F_N": "F", "sigma_F_N": "sigma_F"}
STORED_TRACK = {"t": "t", "x_px": "x_px", "y_px": "y_px", "sigma_x_px": "sigma_px", "score": "score"}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Results of a film with two targets and of a table, with a fitted model."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "films").mkdir()
    shutil.copy(films_folder() / "fast.avi", folder / "films")
    t = np.arange(400) / 4000
    x = slide(t, 2.0) + 1e-5 * np.random.default_rng(2).normal(size=len(t))
    np.savetxt(folder / "table.csv", np.c_[t, x], delimiter=",", header="t_s,x_m", comments="")
    (folder / "study.toml").write_text(STUDY)
    session = Session(open_study(folder / "study.toml"))
    session.fit()
    for run in session.runs:
        for stage in run.stages:
            run.get(stage)
    return read_results(open_study(folder / "study.toml"))


def stored(results: Results, run: str, name: str) -> tuple[np.ndarray, str]:
    """A dataset of the HDF5 file of a run, and its unit."""
    with h5py.File(results.output / f"{run}.h5", locking=False) as file:
        return file[name][()], file[name].attrs["unit"]


def stored_model(results: Results) -> tuple[str, dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """Name and summary of the model in study.h5, and its motion by run."""
    with h5py.File(results.output / "study.h5", locking=False) as file:
        ((name, model),) = file["models"].items()
        summary = model.attrs["summary"] if "summary" in model.attrs else model["summary"].asstr()[()]
        motion = {run: {k: item[()] for k, item in group.items()} for run, group in model["motion"].items()}
        return name, json.loads(summary), motion


def exact(cell: str) -> float:
    """A number of a text table; some versions of pandas round the last digit."""
    return float(cell or "nan")


@cache
def exported(results: Results, to: str) -> ExportedFiles:
    """The files of a format, written once for all tests."""
    return export_results(results, to)


def files(results: Results, to: str) -> dict[str, Path]:
    return {path.name: path for path in exported(results, to).files}


# --- the table of formats


@pytest.mark.parametrize(
    "to", [pytest.param(to, marks=[pytest.mark.slow] if to in ("svg", "pdf") else []) for to in FORMATS]
)
def test_every_format_writes_into_the_results_and_says_what_it_loses(results: Results, to: str) -> None:
    found = exported(results, to)
    assert list(found.files)
    assert all(path.is_file() and results.output in path.parents for path in found.files)
    assert set(FORMATS[to].lost) <= set(found.lost)
    assert len(set(found.files)) == len(found.files)
    page = (Path(__file__).parents[1] / "docs/how-to/export.md").read_text(encoding="utf-8")
    assert f"| `{to}` |" in page


def test_an_unknown_format_is_refused(results: Results) -> None:
    with pytest.raises(FrictrackError, match=r"expected one of the formats csv, xlsx, .*pdf but got 'doc'"):
        export_results(results, "doc")


@pytest.mark.parametrize(
    ("to", "library", "extra"), [("netcdf", "h5netcdf", "xarray"), ("parquet", "pyarrow", "parquet")]
)
def test_a_missing_library_is_named(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str, library: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(FrictrackError, match=rf'needs {library}; pip install "frictrack\[{extra}\]"'):
        export_results(replace(results, output=tmp_path), to)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_every_column_has_a_meaning(results: Results) -> None:
    own = own_motion(results)
    for run in results.runs:
        assert all(column.meaning for column in all_columns(run, own[run.name]))
    assert all(column.meaning for column in track_columns(results.runs[0].tracks["edge"]))
    assert all(column.meaning for motion in results.models[0].motion for column in motion_columns(motion))
    assert describe("sigma_F_model") == "standard deviation of friction force by the current model"


@pytest.mark.parametrize("to", [to for to in FORMATS if to not in ("svg", "pdf")])
def test_runs_without_force_and_model_are_exported(results: Results, tmp_path: Path, to: str) -> None:
    runs = tuple(replace(run, friction=None, budget={}, settings={}) for run in results.runs)
    bare = replace(results, runs=runs, models=(), output=tmp_path)
    assert all(path.stat().st_size for path in export.write(bare, to))


# --- tables


@pytest.mark.parametrize("run", ["film", "table"])
def test_csv_and_excel_hold_the_curves_with_units_in_the_header(results: Results, run: str) -> None:
    text = pd.read_csv(files(results, "csv")[f"{run}.csv"], converters=dict.fromkeys(CURVES, exact))
    sheet = pd.read_excel(files(results, "xlsx")["study.xlsx"], sheet_name=run)
    for header, name in CURVES.items():
        np.testing.assert_array_equal(text[header], stored(results, run, STORED[name])[0])
        np.testing.assert_allclose(sheet[header], stored(results, run, STORED[name])[0], rtol=1e-15)
    parameters = pd.read_csv(files(results, "csv")["parameters.csv"], converters={"value": exact, "std": exact})
    _, summary, _ = stored_model(results)
    for row in parameters.to_dict("records"):
        truth = summary["parameters"][row["parameter"]]
        assert (row["value"], row["std"], row["unit"]) == (truth["value"], truth["std"], truth["unit"])


def test_names_of_sheets_are_never_two_times_the_same() -> None:
    names = [*("a long name of a run, number " + str(i) for i in (100, 101)), "Run", "run"]
    sheets = sheet_names([*names, "x" * 31 + "1", "x" * 31 + "2"])
    assert len({sheet.lower() for sheet in sheets.values()}) == 6
    assert max(map(len, sheets.values())) == 31


def test_parquet_is_read_by_pyarrow_pandas_and_duckdb(results: Results) -> None:
    pq, duckdb = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("duckdb")
    written = files(results, "parquet")
    curves, frame = pq.read_table(written["curves.parquet"]), pd.read_parquet(written["curves.parquet"])
    for run in ("film", "table"):
        rows = frame[frame["run"] == run]
        for name, place in STORED.items():
            values, unit = stored(results, run, place)
            np.testing.assert_array_equal(rows[name].to_numpy(dtype=values.dtype), values)
            assert curves.schema.field(name).metadata[b"unit"].decode() == unit
            assert frame.attrs["units"][name] == unit
    assert curves.schema.metadata[b"frictrack_version"].decode() == results.version
    sql = f"SELECT run, max(v) FROM '{written['curves.parquet']}' GROUP BY run ORDER BY run"
    found = duckdb.sql(sql).fetchall()
    assert found == [(run, stored(results, run, "motion/v")[0].max()) for run in ("film", "table")]
    tracks = pd.read_parquet(written["tracks.parquet"])
    for target, group in (("target", "track"), ("edge", "tracks/edge")):
        rows = tracks[tracks["target"] == target]
        for name, place in STORED_TRACK.items():
            np.testing.assert_array_equal(rows[name], stored(results, "film", f"{group}/{place}")[0])
    _, summary, motion = stored_model(results)
    models = pd.read_parquet(written["motion.parquet"])
    for run, columns in motion.items():
        np.testing.assert_array_equal(models[models["run"] == run]["F"], columns["F"])
    parameters = duckdb.sql(f"SELECT parameter, value, std FROM '{written['parameters.parquet']}'").fetchall()
    assert parameters == [(k, p["value"], p["std"]) for k, p in summary["parameters"].items()]


# --- xarray and MATLAB


def test_netcdf_is_read_by_xarray(results: Results) -> None:
    xr = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    path = files(results, "netcdf")["study.nc"]
    name, summary, motion = stored_model(results)
    with xr.open_datatree(path) as tree:
        for run in ("film", "table"):
            data = tree[f"runs/{run}"]
            assert list(data.coords) == ["t"]
            for column, place in STORED.items():
                values, unit = stored(results, run, place)
                np.testing.assert_array_equal(data[column], values)
                assert data[column].dtype == values.dtype
                assert data[column].attrs.get("units", "") == unit
                assert data[column].attrs["long_name"]
            assert data["v"].attrs["ancillary_variables"] == "sigma_v"
            with h5py.File(results.output / f"{run}.h5", locking=False) as file:
                hashes = {stage: group.attrs["key"] for stage, group in file.items() if "key" in group.attrs}
            assert json.loads(data.attrs["stage_hashes"]) == hashes
            assert json.loads(data.attrs["settings"])["name"] == run
            model = tree[f"models/{name}/{run}"]
            for column in ("t", "x", "v", "F", "sigma_F", "blow", "segment"):
                np.testing.assert_array_equal(model[column], motion[run][column])
        for target, group in (("target", "track"), ("edge", "tracks/edge")):
            track = tree[f"tracks/film/{target}"]
            for column, place in STORED_TRACK.items():
                values, unit = stored(results, "film", f"{group}/{place}")
                np.testing.assert_array_equal(track[column], values)
                assert track[column].attrs["units"] == unit
            with h5py.File(results.output / "film.h5", locking=False) as file:
                assert track["reason"].values.tolist() == file[f"{group}/reason"].asstr()[()].tolist()
        parameters = tree[f"models/{name}"]
        for one, truth in summary["parameters"].items():
            row = parameters.to_dataset().sel(parameter=one)
            assert (row["value"], row["std"], row["unit"]) == (truth["value"], truth["std"], truth["unit"])
        assert tree.attrs["source"] == f"frictrack {results.version}"
        assert tree.attrs["Conventions"] == "CF-1.11"
    with xr.open_dataset(path, group="runs/table") as data:
        assert data["F"].attrs["units"] == "N"


def test_mat_is_read_by_scipy(results: Results) -> None:
    from scipy.io import loadmat, whosmat  # noqa: PLC0415

    path = files(results, "mat")["study.mat"]
    assert whosmat(path) == [("study", (1, 1), "struct")]
    study = loadmat(path, simplify_cells=True)["study"]
    assert [run["name"] for run in study["runs"]] == ["film", "table"]
    for run in study["runs"]:
        for column, place in STORED.items():
            values, unit = stored(results, run["name"], place)
            np.testing.assert_array_equal(run[column], values)
            assert (run["units"][column] if unit else "") == unit
        assert run["attributes"]["mass_kg"] == 0.35
    edge = next(track for track in study["runs"][0]["tracks"] if track["name"] == "edge")
    for column, place in STORED_TRACK.items():
        np.testing.assert_array_equal(edge[column], stored(results, "film", f"tracks/edge/{place}")[0])
    name, summary, motion = stored_model(results)
    model = study["models"]
    assert model["name"] == name
    found = {p["name"]: (p["value"], p["std"], p["unit"]) for p in model["parameters"]}
    assert found == {k: (p["value"], p["std"], p["unit"]) for k, p in summary["parameters"].items()}
    assert model["errors"]["rms_displacement_um"] == summary["errors"]["rms_displacement_um"]
    for one in model["motion"]:
        np.testing.assert_array_equal(one["v"], motion[one["run"]]["v"])
    columns = loadmat(path)["study"]["runs"][0, 0]["v"][0, 0]
    assert columns.shape == (len(stored(results, "film", "motion/v")[0]), 1)


# --- Tracker


@pytest.mark.parametrize("run", ["film", "table"])
def test_a_text_of_tracker_is_read_again_as_the_table_of_a_run(results: Results, run: str) -> None:
    path = files(results, "txt")[f"{run}.txt"]
    title, header, *_ = path.read_text().split("\n")
    assert (title.strip(), header.split("\t")[:2]) == (run, ["t", "x"])
    (t, _), (x, _), (valid, _) = (stored(results, run, f"displacement/{name}") for name in ("t", "x", "valid"))
    numbers = np.loadtxt(path, skiprows=2)
    np.testing.assert_array_equal(numbers[:, :2], np.c_[t, x][valid])
    data = read_table(path)  # pandas may round the last digit
    np.testing.assert_allclose(data.t, t[valid], rtol=1e-15, atol=1e-18)
    assert data.x is not None
    np.testing.assert_allclose(data.x, x[valid], rtol=1e-15, atol=1e-18)


def test_tracker_opens_the_film_with_its_scale_and_its_targets(results: Results) -> None:
    written = files(results, "trk")
    assert list(written) == ["film.trk"]
    assert "table, which has no film (--to txt writes it)" in exported(results, "trk").lost
    project = read_project(written["film.trk"].read_text(encoding="utf-8"))
    assert project["class"] == "org.opensourcephysics.cabrillo.tracker.TrackerPanel"
    clip = project["videoclip"]
    assert (written["film.trk"].parent / clip["video"]["path"]).resolve() == films(results)
    assert (clip["video_framecount"], clip["startframe"], clip["stepsize"], clip["stepcount"]) == (150, 0, 1, 150)
    assert project["clipcontrol"]["delta_t"] == 0.25  # ms, of 4000 frames per second
    assert (project["length_unit"], project["mass_unit"]) == ("m", "kg")
    axes, target, edge = project["tracks"]
    assert axes["class"].endswith(".CoordAxes")
    assert (target["name"], edge["name"], target["mass"]) == ("target", "edge", 0.35)
    for one, group in ((target, "track"), (edge, "tracks/edge")):
        (x, _), (y, _) = (stored(results, "film", f"{group}/{name}") for name in ("x_px", "y_px"))
        frames = [i for i, place in enumerate(one["framedata"]) if place is not None]
        assert frames == np.flatnonzero(np.isfinite(x)).tolist()
        points = np.array([[one["framedata"][i][k] for k in "xy"] for i in frames])
        np.testing.assert_array_equal(points, np.c_[x, y][frames] + PIXEL_CENTRE)
    points = np.array([[place["x"], place["y"]] for place in target["framedata"] if place is not None])
    (t, _), (x, _), (y, _) = (stored(results, "film", f"displacement/{name}") for name in "txy")
    world = world_positions(project["coords"], points[: len(t)])
    np.testing.assert_allclose(world, np.c_[x, y], atol=1e-12)
    assert project["coords"]["framedata"][0]["xscale"] == pytest.approx(2000, rel=1e-12)


def test_a_project_of_tracker_is_read_again_as_the_table_of_a_run(results: Results) -> None:
    path = files(results, "trk")["film.trk"]
    (t, _), (x, _), (y, _), (valid, _) = (
        stored(results, "film", f"displacement/{name}") for name in ("t", "x", "y", "valid")
    )
    data = read_table(path, {"x": "target x (m)"})
    assert data.x is not None
    assert data.y is not None
    np.testing.assert_allclose(data.t, t[valid], rtol=1e-12)
    np.testing.assert_allclose(np.c_[data.x, data.y], np.c_[x, y][valid], atol=1e-12)


def films(results: Results) -> Path:
    return (results.path.parent / "films/fast.avi").resolve()


def test_texts_with_characters_of_xml_reach_tracker(results: Results, tmp_path: Path) -> None:
    strange = replace(results.runs[0], source="films & tapes/<1>.avi")
    found = export_results(replace(results, runs=(strange,), output=tmp_path), "trk")
    project = read_project(found.files[0].read_text(encoding="utf-8"))
    assert project["description"] == "films & tapes/<1>.avi, tracked by frictrack"
    assert "video" not in project["videoclip"]
    assert "film of film: Tracker does not open films & tapes/<1>.avi" in found.lost


def moved(angle: float, pitch: float, *, mirrored: bool = False, bend: float = 0.0) -> tuple[Track, Displacement]:
    """A target that moves along a course that is turned in the picture, and its displacement, in closed form."""
    t = np.arange(50) / 1000
    x, y = 0.2 * np.sqrt(t), 1e-3 * np.sin(400 * t)
    side = -y if mirrored else y
    right, up = np.cos(angle) * x - np.sin(angle) * side, np.sin(angle) * x + np.cos(angle) * side
    nan, ones = np.full(50, np.nan), np.ones(50)
    px, py = 100 + right / pitch, 200 - up / pitch + bend * x**2
    track = Track(t, px, py, 0 * t, 0.01 * ones, 0.01 * ones, ones, np.full(50, ""))
    return track, Displacement(t[3:], x[3:], y[3:], nan[3:], nan[3:], nan[3:], ones[3:] > 0, pixel_pitch=pitch)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("angle", [0.0, 0.5, -2.0, np.pi])
def test_axes_of_tracker_give_the_displacement(angle: float, mirrored: bool) -> None:
    track, displacement = moved(angle, 5e-4, mirrored=mirrored)
    axes = tracker_axes(track, displacement)
    assert axes is not None
    assert (axes.is_mirrored, axes.difference < 1e-12) == (mirrored, True)
    frame = {"xorigin": axes.origin[0], "yorigin": axes.origin[1], "angle": axes.angle}
    coords = {"framedata": [frame | {"xscale": axes.scale, "yscale": axes.scale}]}
    points = np.c_[track.x_px, track.y_px][3:] + PIXEL_CENTRE
    y = -displacement.y if mirrored else displacement.y
    np.testing.assert_allclose(world_positions(coords, points), np.c_[displacement.x, y], atol=1e-12)


def test_tracker_counts_pixels_from_the_corner_of_the_picture() -> None:
    """The mass is at x = y = 0 in the middle of pixel (100, 200), which is half a pixel further from the corner."""
    axes = tracker_axes(*moved(0.5, 5e-4))
    assert axes is not None
    assert axes.origin == pytest.approx((100.5, 200.5), abs=1e-6)


def test_axes_say_how_far_off_they_are_and_need_motion() -> None:
    axes = tracker_axes(*moved(0.3, 5e-4, bend=2000.0))
    assert axes is not None
    assert 1e-4 < axes.difference < 1e-2
    track, displacement = moved(0.0, 1.0)
    assert tracker_axes(track, displacement) is None


def test_what_tracker_cannot_hold_is_named(results: Results, tmp_path: Path) -> None:
    run = results.runs[0]
    assert run.film is not None
    assert run.track is not None
    t, x = run.film.t.copy(), run.track.x_px.copy()
    t[80:] += 1e-4
    x[100] = 300.0
    repaired = np.zeros(len(x), dtype=np.int8)
    repaired[100] = 2
    changed = replace(run, film=replace(run.film, t=t), track=replace(run.track, x_px=x, repaired=repaired))
    changed = replace(changed, settings={})
    found = export_results(replace(results, runs=(changed,), output=tmp_path), "trk")
    assert "uneven times of the frames of film, up to 0.1 ms from one frame rate" in found.lost
    assert "1 interpolated positions of film, which are left out" in found.lost
    assert "mass of film, which is unknown; Tracker shows 1 kg" in found.lost
    assert any(line.startswith("corrections of lens, perspective, shake or rotation in film") for line in found.lost)
    project = read_project(found.files[0].read_text(encoding="utf-8"))
    assert project["tracks"][1]["framedata"][100] is None


def test_tables_alone_have_no_project(results: Results, tmp_path: Path) -> None:
    with pytest.raises(FrictrackError, match="expected a run with a film for --to trk but all runs are tables"):
        export_results(replace(results, runs=results.runs[1:], output=tmp_path), "trk")


# --- figures


@pytest.mark.few(1)
@pytest.mark.parametrize("form", ["svg", "pdf"])
def test_figures_are_the_same_bytes_again_and_have_their_data(results: Results, form: str) -> None:
    first = {name: path.read_bytes() for name, path in files(results, form).items()}
    one_run = replace(results, runs=results.runs[:1], models=())
    again = {path.name: path.read_bytes() for path in export.write(one_run, form) if "film" in path.name}
    assert len(again) > 2
    assert again.items() <= first.items()
    figures = {name for name in first if name.endswith(form)}
    assert {Path(name).with_suffix(".csv").name for name in figures} == first.keys() - figures
    assert {f"{name}.{form}" for name in ("motion film", "film film", "history", "friction", "verdict")} <= figures
    for name in figures:
        assert first[name].startswith(b"<?xml" if form == "svg" else b"%PDF")
        assert b"CreationDate" not in first[name]
    data = pd.read_csv(results.output / "figures/motion film.csv", converters={"x": exact, "y": exact})
    x, t = stored(results, "film", "motion/x")[0], stored(results, "film", "motion/t")[0]
    shown = data[(data["y_axis"] == "displacement x / m") & (data["kind"] == "line")]
    np.testing.assert_array_equal(shown["y"], x)
    np.testing.assert_allclose(shown["x"], 1e3 * t, rtol=1e-15)
    assert set(shown["x_axis"]) == {"time t / ms"}
    history = pd.read_csv(results.output / "figures/history.csv")
    _, summary, _ = stored_model(results)
    assert history[history["kind"] == "line"]["y"].tolist() == [summary["errors"]["heldout_rms_um"]]
