"""Damaged files of every format: a clear sentence or a valid recording, in bounded memory and time, never a crash."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
from camera_films import write_cine, write_photron
from test_recording import write_folder, write_video
from test_recording_cameras import CAMERAS, grey

from frictrack.base.errors import FrictrackError
from frictrack.recording import open_recording, random_access

FORMS = ["cih", "cihx", "mraw12", "cine", "p10", "tif", "pages", "deflate", "bigtiff", "avi", "mp4", "mkv", "folder"]


def tiff(path: Path, film: np.ndarray, form: str) -> None:
    """A TIFF of one of four kinds."""
    if form == "tif":
        tifffile.imwrite(path, film, imagej=True, metadata={"finterval": 1e-3})
    elif form == "pages":
        tifffile.imwrite(path, film.astype(np.uint16), photometric="minisblack", contiguous=False)
    else:
        how = {"bigtiff": True} if form == "bigtiff" else {"compression": "deflate"}
        tifffile.imwrite(path, film, photometric="minisblack", **how)


def write(folder: Path, form: str) -> tuple[Path, Path]:
    """(what is opened, the file that is damaged)."""
    film, path = grey(8, (12, 32, 48)), folder / "film.tif"
    if form in ("cih", "mraw12"):
        head = write_photron(folder, film, 8) if form == "cih" else write_photron(folder, grey(12), 12)
        return head, head if form == "cih" else folder / "film.mraw"
    if form in ("cihx", "p10"):
        name = {"cihx": "ball_12bit", "p10": "p10"}[form]
        for file in CAMERAS.glob(f"{name}.*"):
            (folder / file.name).write_bytes(file.read_bytes())
        path = next(folder.glob("*.ci*"))
    elif form == "cine":
        path = write_cine(folder, film, 8, stamps=np.arange(12) / 5000)
    elif form == "folder":
        path = write_folder(folder / "film", film)
        return path, path / "img_0.png"
    elif form in ("avi", "mp4", "mkv"):
        codec = {"avi": "MJPG", "mp4": "mp4v", "mkv": "FFV1"}[form]
        path = write_video(folder / f"film.{form}", film, 100, codec)
    else:
        tiff(path, film, form)
    return path, path


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, or with bytes, numbers or a stretch overwritten; the head is hit more often than the rest."""
    data = bytearray(data)
    kind = rng.integers(5)
    if kind == 0:
        return bytes(data[: rng.integers(1, len(data))])
    head = len(data) if rng.random() < 0.3 else min(len(data), 2000)
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(0, head))
        if kind == 1:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 2:
            data[at : at + 4] = struct.pack("<I", int(rng.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 24])))
        elif kind == 3:
            data[at : at + 8] = struct.pack("<Q", int(rng.choice([0, 1 << 40, (1 << 63) - 1])))
        else:
            data[at : at + 16] = rng.bytes(16)
    return bytes(data[: len(data) if kind else None])


def use(path: Path) -> None:
    """Everything a tracker does with a recording."""
    rec = open_recording(path, fps=4000)
    assert rec.n_frames >= 1
    assert rec.t.shape == (rec.n_frames,)
    assert np.all(np.diff(rec.t) > 0)
    with random_access(rec) as film:
        frames = film.pick(range(min(rec.n_frames, 5)))
        assert all(f.shape == rec.shape for f in frames)
        film.frame(-1)
        film.cut([0, rec.n_frames - 1], [[0, 0], [2, 1]], (6, 5))
    assert rec.hash


def excused(path: Path) -> FrictrackError | None:
    """The one error that a damaged file may lead to."""
    try:
        use(path)
    except FrictrackError as error:
        return error
    return None


def fuzz(folder: Path, form: str, seeds: range) -> None:
    path, victim = write(folder, form)
    whole = victim.read_bytes()
    for seed in seeds:
        victim.write_bytes(damage(whole, np.random.default_rng(seed)))
        start = time.perf_counter()
        try:
            said = excused(path)
        except Exception as error:
            error.add_note(f"form {form}, seed {seed}")
            raise
        assert said is None or ("\n" not in str(said) and len(str(said)) < 400), str(said)
        assert time.perf_counter() - start < 30, f"form {form}, seed {seed} takes too long"


def in_another_process(folder: Path, form: str, seeds: range) -> None:
    """A crash of a decoder must not take the tests with it; memory is bounded by the system."""
    code = (
        "import re, resource, sys; from pathlib import Path\n"
        "resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_recording_damaged as t\n"
        f"t.fuzz(Path({str(folder)!r}), {form!r}, range({seeds.start}, {seeds.stop}))\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=600, check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout.split()[-1]) < 1 << 20  # kB


@pytest.mark.few(2)
@pytest.mark.parametrize("form", FORMS)
def test_damaged_files(tmp_path, form):
    in_another_process(tmp_path, form, range(40))


@pytest.mark.parametrize(("form", "seed"), [("bigtiff", 1040)])
def test_damage_that_was_found_once(tmp_path, form, seed):
    in_another_process(tmp_path, form, range(seed, seed + 1))


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_many_damaged_files(tmp_path, form):
    in_another_process(tmp_path, form, range(1000, 1600))


# ---- long recordings in little memory


@pytest.mark.skipif(sys.platform != "linux", reason="asks the system for the peak of this process alone")
@pytest.mark.parametrize("form", ["mraw", pytest.param("tif", marks=pytest.mark.slow)])
def test_twenty_gigabytes_in_bounded_memory(tmp_path, form):
    """A sparse file of 20 GB: every part can be read, resident memory stays below 1 GB (here far below)."""
    n, h, w = (20_000, 1000, 1000) if form == "mraw" else (2000, 2500, 4000)
    if form == "mraw":
        path = write_photron(tmp_path, np.zeros((1, h, w), np.uint8), 8, n=n)
        os.truncate(tmp_path / "film.mraw", n * h * w)
    else:
        path = tmp_path / "film.tif"
        tifffile.memmap(path, shape=(n, h, w), dtype=np.uint8, bigtiff=True, photometric="minisblack")
    code = (
        "import re, sys; import numpy as np; from frictrack.recording import open_recording\n"
        # The peak that the system tells of a process (ru_maxrss) is at first that of its parent.
        "peak = lambda: int(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])\n"
        f"rec = open_recording({str(path)!r}, 4000)\n"
        f"assert rec.direct and rec.n_frames == {n}, rec\n"
        "base = peak()\n"
        "every = np.arange(0, rec.n_frames, rec.n_frames // 500)\n"
        "for part in np.array_split(every, 40):\n"
        "    rec.cut(part, np.full((len(part), 2), 300), (53, 83))\n"
        "for part in np.array_split(every[::-1], 100)[::10]:\n"
        "    rec.cut(part, np.full((len(part), 2), 0), (400, 900))\n"
        "rec.frame(-1)\n"
        "print(base, peak())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    before, after = (int(v) / 1e6 for v in done.stdout.split())
    assert after < 0.6, f"{before} -> {after} GB resident"
