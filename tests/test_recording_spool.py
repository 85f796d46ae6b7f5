"""A compressed film is decoded once, ahead of its reader; after that every part of it is at hand."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.recording import Header, Recording, random_access, raw

N, H, W = 40, 24, 32


class Slow(Recording):
    """A film that counts what it decodes, and may fail or break off."""

    suffixes = ()

    def __init__(self, kind=np.uint8, fails_at=None, ends_at=N, pause=0.0):
        self.decoded, self._fails_at, self._ends_at, self._pause = [], fails_at, ends_at, pause
        self.truth = np.random.default_rng(1).integers(0, 255, (N, H, W)).astype(kind)
        super().__init__(Path("slow.test"), 4000)

    def _open(self):
        return Header(N, (H, W), 8 * self.truth.dtype.itemsize, notes=("a note",), exposure=1e-5)

    def _read(self, indices):
        for i in indices:
            if i == self._fails_at:
                raise RuntimeError("the decoder fell over")
            if i >= self._ends_at:
                return
            time.sleep(self._pause)
            self.decoded.append(i)
            yield self.truth[i]


@pytest.fixture(params=["memory", "disk"])
def place(request, monkeypatch):
    monkeypatch.setattr(raw, "MAX_MEMORY_BYTES", 1 << 30 if request.param == "memory" else 0)


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_decoded_once_and_read_at_random(kind):
    film = Slow(kind, pause=0.001)
    with random_access(film) as rec:
        assert (rec.direct, rec.fps, rec.n_frames, rec.notes) == (True, 4000, N, ("a note",))
        assert rec.exposure == 1e-5
        indices, corners = [30, 2, 17], [[0, 0], [5, 3], [W - 9, H - 7]]
        got = rec.cut(indices, corners, (7, 9))
        for box, i, (x, y) in zip(got, indices, corners, strict=True):
            np.testing.assert_array_equal(box, film.truth[i, y : y + 7, x : x + 9])
        assert got.dtype == kind
        np.testing.assert_array_equal(list(rec.frames()), film.truth)
        np.testing.assert_array_equal(rec.pick([3, 30]), film.truth[[3, 30]])
        np.testing.assert_array_equal(rec.frame(-1), film.truth[-1])
    assert film.decoded == list(range(N))


def test_a_direct_recording_is_its_own_spool():
    film = Slow()
    film.direct = True
    with random_access(film) as rec:
        assert rec is film
    assert film.decoded == []


@pytest.mark.usefixtures("place")
def test_the_reader_hears_of_a_fault():
    with random_access(Slow(fails_at=10)) as rec:
        assert len(rec.pick(range(10))) == 10
        with pytest.raises(RuntimeError, match="the decoder fell over"):
            rec.frame(10)
        with pytest.raises(RuntimeError, match="the decoder fell over"):
            rec.cut([10], [[0, 0]], (8, 8))


@pytest.mark.usefixtures("place")
def test_frames_that_are_missing_at_the_end():
    with random_access(Slow(ends_at=25)) as rec:
        assert len(list(rec.frames())) == 25
        with pytest.raises(FrictrackError, match=r"slow.test: frame 30 cannot be read, the file breaks off before it"):
            rec.frame(30)
        with pytest.raises(FrictrackError, match="frame 26 cannot be read"):
            rec.cut([3, 26], [[0, 0], [0, 0]], (8, 8))


def test_closing_ends_the_thread_and_removes_the_file(monkeypatch, tmp_path):
    monkeypatch.setattr(raw, "MAX_MEMORY_BYTES", 0)
    monkeypatch.setattr(raw.tempfile, "tempdir", str(tmp_path))
    film = Slow(pause=0.01)
    with random_access(film) as rec:
        rec.frame(0)
        assert isinstance(rec._decoded, np.memmap)
    assert not [t for t in threading.enumerate() if "decoder" in t.name]
    assert list(tmp_path.iterdir()) == []
    assert len(film.decoded) < N


def test_no_room_for_the_film(monkeypatch):
    monkeypatch.setattr(raw, "MAX_MEMORY_BYTES", 0)
    monkeypatch.setattr(raw.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1000}))
    with pytest.raises(FrictrackError, match=r"slow.test: expected 0.0 GB of room .* 0.0 GB are free; make room"):
        random_access(Slow()).__enter__()


@pytest.mark.parametrize(
    ("indices", "corners", "text"),
    [
        ([N], [[0, 0]], "expected a frame from 0 to 39 but got 40"),
        ([0], [[W - 7, 0]], "expected boxes inside the picture of 32x24 px but got 8x8 px at 25, 0"),
        ([0], [[0, -1]], "but got 8x8 px at 0, -1"),
        ([0, 1], [[0, 0]], "expected one corner per frame but got 1 for 2 frames"),
    ],
)
def test_boxes_outside_the_film(indices, corners, text):
    with pytest.raises(FrictrackError, match=text):
        Slow().cut(indices, corners, (8, 8))


def test_leaving_early_ends_the_decoder():
    film = Slow(pause=0.05)
    with random_access(film) as rec:
        rec.frame(0)
    assert len(film.decoded) < N


def test_python_may_end_while_a_film_is_decoded(tmp_path):
    """Somebody leaves with a film open: no abort of the process, nothing stays in the temporary folder."""
    code = """
import contextlib, sys
from frictrack.recording import open_recording, random_access, raw

raw.MAX_MEMORY_BYTES = 0
held = contextlib.ExitStack()
film = open_recording(sys.argv[1], fps=4000)
film.frames = lambda frames=film.frames: (frame for _ in range(1000) for frame in frames())  # it goes on
held.enter_context(random_access(film))
"""
    film = Path(__file__).resolve().parents[1] / "sample_videos" / "fast.avi"
    call, room = [sys.executable, "-c", code, film], os.environ | {"TMPDIR": str(tmp_path)}
    for _ in range(3):
        done = subprocess.run(call, capture_output=True, text=True, env=room, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        assert list(tmp_path.iterdir()) == []
