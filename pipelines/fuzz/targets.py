"""Define what is fuzzed: per reader valid inputs to start from and the function that reads the bytes.

A function may return or raise one `FrictrackError` of one line; anything else is a finding.
"""

from __future__ import annotations

import re
import resource
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import h5py
import numpy as np
import seeds
from seeds import CAMERAS, ROOT

from frictrack import effects
from frictrack.base import __version__
from frictrack.base.errors import FrictrackError
from frictrack.base.remote import PROTOCOLS, RemoteFile, cache_folder, locate, only_listed
from frictrack.base.units import is_coherent, parse_quantity
from frictrack.effects import CONSTANTS, FUNCTIONS, VARIABLES
from frictrack.flow import open_study, run_pipeline, store
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.crate.payload import METADATA, unpack
from frictrack.flow.crate.reproducing import find_inputs, read_crate, set_up_study
from frictrack.flow.opening import check_study
from frictrack.flow.stages import FILM
from frictrack.flow.store.integrity import header_of
from frictrack.measure.calibration import parse_scale
from frictrack.measure.calibration.lens import read_lens
from frictrack.measure.sensors import SensorRecord
from frictrack.recording import open_recording, random_access
from frictrack.simulate.scene import read_scene
from frictrack.study import load, open_table, parse, propose_columns, read_sensor_table, read_table, with_key
from frictrack.study.table_layout import TrackColumns

MEMORY = 2048  # MB, beyond what the libraries take when they are loaded
MAX_ERROR_LENGTH = 12_000  # characters of an error
Use = Callable[[bytes, Path], None]


@dataclass(frozen=True)
class Target:
    """One kind of input: `seeds` are valid ones, `use` is given the bytes and an empty folder of its own."""

    name: str
    seeds: Callable[[], list[bytes]]
    use: Use
    longest: int = 4096  # bytes of an input


def excused(target: Target, data: bytes, folder: Path) -> str:
    """What the library says of an input; "" where it takes it. Any other exception goes up."""
    try:
        target.use(data, folder)
    except FrictrackError as error:
        said = str(error)
        if not said.isprintable() or not 0 < len(said) <= MAX_ERROR_LENGTH:
            raise AssertionError(f"expected one line of an error but got {said[:2000]!r}") from error
        return said
    return ""


def bounded() -> None:
    """Refuse this process memory beyond the limit: a header that promises a huge film becomes a MemoryError."""
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = held + (MEMORY << 20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


# ---- recordings


def watched(path: Path) -> None:
    """Everything that a tracker does with a recording."""
    rec = open_recording(path, fps=4000)
    assert rec.t.shape == (rec.n_frames,)
    assert np.all(np.diff(rec.t) > 0)
    assert np.all(np.isfinite(rec.t))
    with random_access(rec) as film:
        assert all(f.shape == rec.shape for f in film.pick(range(min(rec.n_frames, 5))))
        film.frame(-1)
        film.cut([0, rec.n_frames - 1], [[0, 0], [2, 1]], (6, 5))
    assert rec.hash
    assert all(row.name and row.value for row in rec.timebase.rows)


def film(name: str) -> Use:
    """The recording is one file of that name."""

    def use(data: bytes, folder: Path) -> None:
        path = folder / name
        path.write_bytes(data)
        watched(path)

    return use


def photron(head: str) -> Use:
    """The header is fuzzed, the pixels beside it are there."""

    def use(data: bytes, folder: Path) -> None:
        (folder / head).write_bytes(data)
        (folder / "film.mraw").write_bytes(bytes(range(256)) * 200)
        watched(folder / head)

    return use


def pictures(data: bytes, folder: Path) -> None:
    """A folder in which one of the pictures is fuzzed; the first byte says which."""
    made = folder / "film"
    made.mkdir()
    odd = data[0] % 3 if data else 0
    for i in range(3):
        (made / f"img_{i}.png").write_bytes(data[1:] if i == odd else seeds.picture(".png"))
    watched(made)


# ---- texts


def study(data: bytes, folder: Path) -> None:
    """A study file beside recordings that are there."""
    for name in ("a.avi", "b.avi", "t.csv", "drive.csv"):
        (folder / name).touch()
    path = folder / "study.toml"
    path.write_bytes(data)
    study = check_study(load(path))
    assert study.output.resolve().is_relative_to(folder.resolve())
    for run in study.runs:
        assert (study.output / f"{run.name}.h5").resolve().parent == study.output.resolve()
    text = path.read_text(encoding="utf-8")
    parse(path, with_key(text, "run", "note", "seen", study.runs[0].name))


def address(data: bytes, folder: Path) -> None:
    """A path or an address; nothing is opened."""
    found = locate(data.decode("utf-8", "replace"), folder)
    if isinstance(found, RemoteFile):
        assert found.url.partition("://")[0] in PROTOCOLS
        assert "::" not in found.url
        assert Path(found.name).name == found.name
        assert cache_folder(found.url).parent == cache_folder("s3://lab/a").parent


def crate(data: bytes, folder: Path) -> None:
    """The zip file of a crate."""
    (folder / "crate.zip").write_bytes(data)
    unpack(folder / "crate.zip", folder / "crate")
    _set_up(folder)


def described_crate(data: bytes, folder: Path) -> None:
    """An unpacked crate: the first byte tells which of its files is fuzzed. The study file is always as described."""
    files = seeds.crate_files()
    chosen = [*files][data[0] % len(files)] if data else METADATA
    if chosen == "study.toml":
        old = files[chosen]
        for was, now in ((len(old), len(data[1:])), (sha256(old).hexdigest(), sha256(data[1:]).hexdigest())):
            files[METADATA] = files[METADATA].replace(f'"{was}"'.encode(), f'"{now}"'.encode(), 1)
    for place, content in (files | {chosen: data[1:]}).items():
        path = folder / "crate" / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    _set_up(folder)


def _set_up(folder: Path) -> None:
    """The study of a crate as `reproduce` opens it: it names only what the crate lists."""
    opened = read_crate(folder / "crate")
    known = find_inputs(opened, None, None)
    with only_listed(known):
        study = open_study(set_up_study(opened, folder / "again", known))
    for run in study.runs:
        for path in run_pipeline(study, run).input_files():
            assert isinstance(path, Path)
            assert path.resolve().is_relative_to((folder / "crate").resolve()) or path.is_dir()
            assert path.relative_to(study.folder).as_posix() in known or path.is_dir()


def scene(data: bytes, folder: Path) -> None:
    """A scene to render."""
    read_scene(data.decode("utf-8", "replace"))


def formula(data: bytes, folder: Path) -> None:
    """A user's formula, evaluated along a short run."""
    text = data.decode("utf-8", "replace")
    taken = (*VARIABLES, *CONSTANTS, *FUNCTIONS)
    own = [name for name in dict.fromkeys(re.findall(r"[A-Za-z]\w*", text, re.ASCII)) if name not in taken]
    made = effects.formula("own", text, bounds=dict.fromkeys(own, (0.1, 2.0)))
    t = np.linspace(0, 1, 7)
    path = effects.Path(t=t, x=0.1 * t, v=1 - t, s=np.ones(7), mass=0.3)
    columns = made.columns(path, {p.name: 0.7 for p in made.parameters if not p.linear})
    assert columns.shape[0] == len(t)
    assert np.all(np.isfinite(columns))


def unit(data: bytes, folder: Path) -> None:
    """A value with its unit and uncertainty."""
    text = data.decode("utf-8", "replace")
    is_coherent(text)
    value, std = parse_quantity(text, "kg", "mass")
    assert np.isfinite([value, std]).all()
    assert std >= 0


def scale(data: bytes, folder: Path) -> None:
    """A scale in words."""
    pitch, relative = parse_scale(data.decode("utf-8", "replace"))
    assert 0 < pitch < np.inf
    assert 0 <= relative < np.inf


def table(data: bytes, folder: Path) -> None:
    """A run as a CSV table."""
    path = folder / "table.csv"
    path.write_bytes(data)
    _sound(read_table(path))


def instrument(suffix: str) -> Use:
    """A run in the file of an instrument."""

    def use(data: bytes, folder: Path) -> None:
        path = folder / f"run{suffix}"
        path.write_bytes(data)
        table = open_table(path)
        for track in table.tracks or [TrackColumns(propose_columns(table.frame, table.columns))]:
            _sound(read_table(path, track.columns))

    return use


def workbook(data: bytes, folder: Path) -> None:
    """A run as an Excel table, of which the XML of the sheet is fuzzed."""
    path = folder / "table.xlsx"
    path.write_bytes(seeds.workbook_of(data))
    _sound(read_table(path))


def packed(data: bytes, folder: Path) -> None:
    """The same, of which the bytes of the archive are fuzzed."""
    path = folder / "table.xlsx"
    path.write_bytes(data)
    _sound(read_table(path))


def _sound(read: object) -> None:
    for name, values in vars(read).items():
        assert values is None or name == "notes" or np.all(np.isfinite(values)), name


def sensor(data: bytes, folder: Path) -> None:
    """A sensor's table and its curve."""
    path = folder / "sensor.csv"
    path.write_bytes(data)
    read = read_sensor_table(path, ("a", "friction"))
    values = read.a if read.a is not None else read.friction
    with np.errstate(all="ignore"):
        series = SensorRecord(read.t, values)
        series.average(np.linspace(read.t[0], read.t[-1], 5), series.interval)


def lens(data: bytes, folder: Path) -> None:
    """A lens that was calibrated before."""
    path = folder / "lens.yml"
    path.write_bytes(data)
    found = read_lens(path, (480, 640))
    found.project_rays(np.zeros((1, 2)))


# ---- results


def edited_results(data: bytes, folder: Path) -> None:
    """A sound HDF5 file of other contents than ours: every four bytes take away, replace or add something."""
    path = folder / "run.h5"
    path.write_bytes(seeds.results())
    with h5py.File(path, "r+") as file:
        for at in range(0, min(len(data), 40) - 3, 4):
            _edit(file, *data[at : at + 4])
    hdf5 = path.read_bytes()[store.HEADER_BYTES :]
    path.write_bytes(header_of(hdf5, __version__) + hdf5)  # who means harm seals it too
    _used(path)


def _edit(file: h5py.File, what: int, where: int, which: int, value: int) -> None:
    names: list[str] = []
    file.visit(names.append)
    place = file[names[where % len(names)]] if names else file
    group = place if isinstance(place, h5py.Group) else place.parent
    known = sorted({*place.attrs, *(group if what % 2 else ()), "schema", "new"})
    name, odd = known[which % len(known)], ODD_TABLES[value % len(ODD_TABLES)]
    if what % 3 == 0 and names:
        del file[place.name]
    elif what % 3 == 1:
        place.attrs[name] = odd
    else:
        if name in group:
            del group[name]
        group[name] = group if value == 255 else odd


def results(data: bytes, folder: Path) -> None:
    """The bytes of a file of results."""
    path = folder / "run.h5"
    path.write_bytes(data)
    _used(path)


def _used(path: Path) -> None:
    """A file of results, read and written to."""
    for name in store.names(path):
        store.provenance(path, name)
        store.read(path, name)
        if name in FILM and FILM[name].kind is not dict:
            store.read(path, name, FILM[name].kind)
    store.names(path, "models")
    store.write(
        path, {"models/2_new": store.GroupContent({"a": 1})}, attribute_updates={"models/2_new": {"current": True}}
    )
    assert store.read(path, "models/2_new")["a"] == 1


def log(data: bytes, folder: Path) -> None:
    """The log of a study."""
    (folder / "log.jsonl").write_bytes(data)
    history = CommandHistory(folder)
    history.undo_stacks()
    assert all(isinstance(change.text, str) for change in history.changes)


ODD_TABLES = (
    *(
        0,
        -1,
        2**63 - 1,
        1e308,
        np.nan,
        True,
        "",
        "[",
        "[[1, 2], 3]",
        '{"a": 1}',
        "x" * 20_000,
        "\ud800".encode("utf-8", "replace"),
    ),
    *(np.zeros(0), np.zeros((2, 3)), np.arange(5.0), np.full(5, np.nan), np.arange(5)[::-1], np.zeros(5, "c16")),
    *(np.array([b"a", b"\xff"]), h5py.Empty("f8"), np.zeros(3, [("a", "f8")]), np.datetime64("NaT").astype("i8")),
)  # what may stand in an HDF5 file
CSV = "t_s,x_m,sigma_m\n0,0,1e-5\n0.001,0.002,1e-5\n0.002,0.0039,1e-5\n"
GERMAN = "t_s;x_m\n0,000;0,001\n0,001;0,002\n0,002;0,003\n"
CLOCKED = "# logger 7\nt_s,a_m_s2,friction_N\n0,1,2\n0.001,,2.1\n0.002,1.2,2.0\n0.003,1.1,2.2\n"
STUDY = """[study]
name = "course A"
mass = "350 +/- 2 g"
model = ["coulomb", "magnet"]
output = "out"
[camera]
fps = 4000
scale = {points = [[0, 0], [200, 0]], length = "100 mm"}
[[run]]
name = "v3"
video = "a.avi"
target = [410, 232, 96, 64]
targets = {beam = [1, 2, 3, 4]}
free = ["10 ms", 0.2]
incline = "-22 deg"
drive = {table = "drive.csv", area = "3 cm^2", until = "release"}
[[run]]
table = "t.csv"
columns = {t = "Time (ms)", x = "-pos (mm)"}
[[effect]]
effect = "magnet"
formula = "F * exp(-((x - x_c)/w)^2)"
units = {F = "N", x_c = "m", w = "m"}
bounds = {w = [0.002, 0.05]}
[[effect]]
effect = "vibration"
fix = {frequency = 60}
per_run = ["phase"]
"""
LENS = """%YAML:1.0
---
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 800., 0., 320., 0., 800., 240., 0., 0., 1. ]
distortion_coefficients: [ -0.1, 0.01, 0., 0., 0. ]
image_width: 640
image_height: 480
"""
LINE = (
    '{"rev": 1, "at": "2026-01-01T00:00:00", "who": "cli", "do": "fit", "told": {"model": null}, "before": {"a": 1}, '
)
LOG = LINE + '"after": {}}\n{"rev": 2, "at": "", "who": "page", "do": "undo"}\n'
FORMULAS = ("F * s * exp(-((x - x_c)/w)^2)", "(a*sin(6.28*f*t) + b*cos(6.28*f*t)) * L", "k * max(x, 0) + c * g * mass")

TARGETS = {
    target.name: target
    for target in (
        Target("avi", lambda: [seeds.video(".avi", "MJPG"), seeds.video(".avi", "FFV1")], film("film.avi"), 1 << 15),
        Target("mp4", lambda: [seeds.video(".mp4", "mp4v")], film("film.mp4"), 1 << 15),
        Target("mkv", lambda: [seeds.video(".mkv", "FFV1")], film("film.mkv"), 1 << 15),
        Target("tiff", seeds.tiffs, film("film.tif"), 1 << 14),
        Target("cine", seeds.cines, film("film.cine"), 1 << 16),
        Target("cih", lambda: [p.read_bytes() for p in CAMERAS.glob("*.cih")], photron("film.cih")),
        Target("cihx", lambda: [p.read_bytes() for p in CAMERAS.glob("*.cihx")], photron("film.cihx")),
        Target("folder", lambda: [b"\0" + seeds.picture(s) for s in (".png", ".bmp", ".jpg", ".tif")], pictures),
        Target("study", lambda: seeds.texts(STUDY), study),
        Target(
            "address",
            lambda: seeds.texts("s3://lab/a.cine", "https://h:1/a/b.avi?c=1", "file:///a.csv", "a"),
            address,
            200,
        ),
        Target("crate", lambda: [seeds.crate()], crate, 1 << 14),
        Target(
            "described",
            lambda: [bytes([i]) + content for i, content in enumerate(seeds.crate_files().values())],
            described_crate,
        ),
        Target("scene", lambda: [(ROOT / "sample_videos/scene.toml").read_bytes()], scene),
        Target("formula", lambda: seeds.texts(*FORMULAS), formula, 600),
        Target("unit", lambda: seeds.texts("0.350 +/- 0.002 kg", "(350 ± 2) g", "1e3 +/- 1% mg^2/g"), unit, 200),
        Target("scale", lambda: seeds.texts("0.500 +/- 0.002 mm/px", "5e-4"), scale, 200),
        Target("table", lambda: seeds.texts(CSV, GERMAN), table),
        Target("labview", lambda: [seeds.labview()], instrument(".lvm")),
        Target("waveforms", lambda: [seeds.waveforms()], instrument(".tdms")),
        Target("matlab", lambda: [seeds.matlab()], instrument(".mat")),
        Target("sheet", lambda: [seeds.sheet()], workbook),
        Target("workbook", lambda: [seeds.workbook()], packed, 1 << 14),
        Target("sensor", lambda: seeds.texts(CLOCKED), sensor),
        Target("lens", lambda: seeds.texts(LENS, '{"K": [[800,0,320],[0,800,240],[0,0,1]], "D": [0,0,0,0]}'), lens),
        Target("store", lambda: [b"\0\1\2\3" * 4, bytes(range(40))], edited_results, 40),
        Target("hdf5", lambda: [seeds.results(), seeds.foreign()], results, 1 << 17),
        Target("log", lambda: seeds.texts(LOG), log),
    )
}
