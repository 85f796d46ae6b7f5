"""Write small valid files of every kind that is read: the seeds of the fuzzing."""

from __future__ import annotations

import io
import json
import sys
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path

import cv2
import h5py
import numpy as np
import pandas as pd
import scipy.io
import tifffile
from nptdms import ChannelObject, TdmsWriter

from frictrack.flow import store
from frictrack.flow.crate.payload import METADATA, MOVED
from frictrack.records import Displacement, Track
from frictrack.results import RecordingInfo

ROOT = Path(__file__).resolve().parents[2]
CAMERAS = ROOT / "tests" / "data" / "cameras"
sys.path.insert(0, str(ROOT / "tests"))
from camera_films import write_cine  # noqa: E402

N, H, W = 6, 16, 24
Write = Callable[[Path], None]


def made(name: str, write: Write) -> bytes:
    """Bytes of the file that `write` makes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def film() -> np.ndarray:
    """A few small pictures in which something moves."""
    pictures = np.random.default_rng(0).integers(0, 60, (N, H, W)).astype(np.uint8)
    for i, picture in enumerate(pictures):
        picture[5:11, 2 + 2 * i : 9 + 2 * i] += 150
    return pictures


def video(suffix: str, codec: str) -> bytes:
    """A film in a container."""

    def write(path: Path) -> None:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 100, (W, H), False)
        for picture in film():
            writer.write(picture)
        writer.release()

    return made(f"film{suffix}", write)


def tiffs() -> list[bytes]:
    """Stacks of ImageJ, plain pages, BigTIFF, compressed pages."""
    kinds = (
        {"imagej": True, "metadata": {"finterval": 1e-3}},
        {"photometric": "minisblack", "contiguous": False},
        {"photometric": "minisblack", "bigtiff": True},
        {"photometric": "minisblack", "compression": "deflate"},
    )
    return [made("film.tif", lambda path, how=how: tifffile.imwrite(path, film(), **how)) for how in kinds]


def picture(suffix: str) -> bytes:
    """One encoded picture."""
    return bytes(cv2.imencode(suffix, film()[0])[1])


def cines() -> list[bytes]:
    """Phantom films of 8, 12 and 16 bit, with and without time stamps."""
    stamps = np.arange(N) / 5000

    def one(folder: Path, bits: int, **how: object) -> None:
        write_cine(folder, film().astype(np.uint16 if bits > 8 else np.uint8), bits, **how)

    hows = ((8, {"stamps": stamps}), (12, {"upward": False}), (16, {"stamps": stamps[: N - 2]}), (10, {}))
    return [made("film.cine", lambda path, b=bits, how=how: one(path.parent, b, **how)) for bits, how in hows]


def sheet() -> bytes:
    """The XML of the only sheet of a workbook."""
    with zipfile.ZipFile(io.BytesIO(workbook())) as book:
        return book.read("xl/worksheets/sheet1.xml")


@cache
def workbook() -> bytes:
    """A workbook of a short table."""
    table = pd.DataFrame({"t_s": np.arange(5) / 1000, "x_m": np.linspace(0, 1, 5)})
    return made("table.xlsx", lambda path: table.to_excel(path, index=False))


LABVIEW = """LabVIEW Measurement\t
Separator\tTab
Decimal_Separator\t.
X_Columns\tOne
***End_of_Header***\t
\t
Channels\t1
Y_Unit_Label\tmm
***End_of_Header***\t
X_Value\tLaser\tComment
0.000\t0.5
0.001\t1.5
0.002\t2.4
"""


def labview() -> bytes:
    """A short measurement of LabVIEW."""
    return LABVIEW.encode()


@cache
def waveforms() -> bytes:
    """The same as a binary file."""
    said = {"wf_increment": 1e-3, "unit_string": "mm"}

    def write(path: Path) -> None:
        with TdmsWriter(path) as writer:
            writer.write_segment([ChannelObject("g", "Laser", np.linspace(0.5, 2.4, 5), properties=said)])

    return made("run.tdms", write)


@cache
def matlab() -> bytes:
    """Two variables of MATLAB."""
    return made("run.mat", lambda path: scipy.io.savemat(path, {"t": np.arange(5) / 1000, "x": np.linspace(0, 1, 5)}))


def workbook_of(sheet: bytes) -> bytes:
    """The same with another sheet in its place."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(workbook())) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            new.writestr(name, sheet if name.endswith("sheet1.xml") else old.read(name))
    return out.getvalue()


@cache
def results() -> bytes:
    """A file of results: a track, its displacement, a model in words."""
    t = np.arange(5) / 4000
    x, ok = np.linspace(10, 20, 5), np.ones(5, dtype=bool)
    reason = np.array(["", "", "left the picture", "", ""])
    groups = {
        "recording": RecordingInfo(t, path="a.avi", fps=4000.0, n_frames=5, hash="ab", picture=film()[0]),
        "track": Track(t, x, x, x, x, x, x, reason, name="target", target=(1.0, 2.0, 3.0, 4.0), notes=("one",)),
        "displacement": Displacement(t, x, x, x, x, x, ok, pixel_pitch=1e-3),
        "models/1_tustin": {"current": True, "summary": "{}", "state": {"theta": x, "names": ["a", "b"], "tau": None}},
    }
    return made("run.h5", lambda path: store.write(path, {k: store.GroupContent(v) for k, v in groups.items()}))


def crate_files() -> dict[str, bytes]:
    """The files of a small crate: a study of one table, and the description of both."""
    files = {
        "study.toml": b'[study]\nmass = 0.5\n[[run]]\ntable = "/lab/t.csv"\n',
        "inputs/1/t.csv": b"t_s,x_m\n0,0\n1,2\n",
    }
    parts = [
        {"@id": place, "@type": "File", "contentSize": str(len(content)), "sha256": sha256(content).hexdigest()}
        for place, content in files.items()
    ]
    moved = {"@id": "#moved", "@type": "PropertyValue", "propertyID": MOVED, "name": "/lab/t.csv"}
    graph = [
        {"@id": "./", "@type": "Dataset", "mainEntity": {"@id": "study.toml"}, "mentions": {"@id": "#run"}},
        {
            "@id": "#run",
            "@type": "CreateAction",
            "instrument": {"@id": "#software"},
            "object": [{"@id": place} for place in (*files, "#moved")],
            "result": {"@id": "inputs/1/t.csv"},
        },
        {
            "@id": "#software",
            "name": "frictrack",
            "softwareVersion": "1",
            "softwareRequirements": [],
            "operatingSystem": "Linux",
            "processorRequirements": "x86_64",
        },
        moved | {"value": "inputs/1/t.csv"},
        *parts,
    ]
    return files | {METADATA: json.dumps({"@graph": graph}).encode()}


def crate() -> bytes:
    """The same as a zip file."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        for place, content in crate_files().items():
            file.writestr(place, content)
    return out.getvalue()


def foreign() -> bytes:
    """A file of another program that looks like results."""

    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file.attrs.update(schema=1, version="0")
            file["track/t"] = np.arange(4)
            file["track/x_px"] = h5py.SoftLink("/track/t")
            file["displacement"] = h5py.ExternalLink("other.h5", "/")

    return made("run.h5", write)


def texts(*found: str) -> list[bytes]:
    """Texts as bytes."""
    return [text.encode() for text in found]
