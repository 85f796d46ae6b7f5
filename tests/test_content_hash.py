"""The hash of a recording covers every byte; results of earlier versions, which hashed some bytes, remain valid."""

from __future__ import annotations

import hashlib
import os
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile

from frictrack.base import content_hash
from frictrack.base.files import hash_file, hash_files
from frictrack.flow import Session, open_study, verify
from frictrack.recording import Recording, open_recording

N_FRAMES, SHAPE = 24, (64, 4000)  # 6 MB: more than was hashed of a file


@pytest.fixture
def film_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A bright block that slides over a dark, noisy course."""
    monkeypatch.setenv(content_hash.CACHE_VARIABLE, str(tmp_path / "cache"))
    rng = np.random.default_rng(4)
    block = rng.integers(120, 250, size=(24, 24), dtype=np.uint8)
    pictures = rng.integers(20, 30, size=(N_FRAMES, *SHAPE), dtype=np.uint8)
    for i, picture in enumerate(pictures):
        picture[20:44, 40 + 8 * i : 64 + 8 * i] = block
    tifffile.imwrite(tmp_path / "block.tif", pictures)
    head = '[study]\nmass = "350 g"\n[camera]\nfps = 1000\nscale = "1 mm/px"\n'
    path = tmp_path / "study.toml"
    path.write_text(f'{head}[[run]]\nvideo = "block.tif"\ntarget = [40, 20, 24, 24]\n')
    return path


def flip(path: Path, at: int) -> None:
    """Change one bit of one byte."""
    with path.open("r+b") as file:
        file.seek(at)
        byte = file.read(1)[0]
        file.seek(at)
        file.write(bytes([byte ^ 1 << at % 8]))


def is_tracked(study: Path) -> bool:
    return Session(open_study(study)).runs[0].is_current("track")


def test_the_hash_is_what_sha256sum_prints(tmp_path: Path) -> None:
    a, b = tmp_path / "a.tif", tmp_path / "b.tif"
    a.write_bytes(b"first"), b.write_bytes(b"second")
    printed = subprocess.run(["sha256sum", "a.tif", "b.tif"], cwd=tmp_path, capture_output=True, check=True).stdout
    assert hash_file(a) == hash_files([a]) == printed.split()[0].decode()
    assert hash_files([a, b]) == hashlib.sha256(printed).hexdigest()
    assert hash_files([b, a]) != hash_files([a, b])


@pytest.mark.slow
def test_a_flip_of_any_of_a_thousand_bytes_changes_the_hash(film_study: Path) -> None:
    film = film_study.parent / "block.tif"
    before, size = open_recording(film, fps=1000).hash, film.stat().st_size
    found = set()
    for at in np.random.default_rng(0).integers(0, size, size=1000).tolist():
        flip(film, at)
        found.add(hash_file(film))
        flip(film, at)
    assert before not in found
    assert hash_file(film) == before


def test_a_flip_in_the_pixels_is_found_by_run_and_verify(film_study: Path) -> None:
    Session(open_study(film_study)).bring_up_to("motion")
    film, results = film_study.parent / "block.tif", film_study.parent / "study_results" / "block.h5"
    assert is_tracked(film_study)
    flip(film, 2_000_000)  # neither in the first, the middle nor the last megabyte
    assert not is_tracked(film_study)
    found = verify([film_study])
    assert {(one["kind"], one["file"]) for one in found["faults"]} == {("changed", str(results))}
    assert any("block.tif as it was then" in one["what"] for one in found["faults"])
    flip(film, 2_000_000)
    assert is_tracked(film_study)
    assert verify([film_study])["sound"]


@pytest.mark.slow
def test_results_of_a_partly_hashed_film_remain_valid(film_study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as before:
        before.setattr(Recording, "read_hash", lambda self, *, reread=False: self.sampled_hash)
        Session(open_study(film_study)).bring_up_to("motion")
    assert is_tracked(film_study)
    found = verify([film_study])
    assert found["sound"]
    assert [Path(one).name for one in found["partly_hashed"]] == ["block.h5"]
    flip(film_study.parent / "block.tif", 300_000)  # in the first megabyte
    assert not is_tracked(film_study)
    Session(open_study(film_study)).bring_up_to("motion")
    assert verify([film_study])["partly_hashed"] == []


def test_a_large_file_is_read_once_per_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(content_hash.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(content_hash, "MIN_BYTES_KEPT", 10)
    read: list[bytes] = []
    digest = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda file, how: (read.append(b""), digest(file, how))[1])
    film = tmp_path / "film.raw"
    film.write_bytes(bytes(100))
    first = hash_file(film)
    hash_file(film)
    assert len(read) == 2  # changed a moment ago: its state could hide another change
    monkeypatch.setattr(content_hash, "MIN_AGE_S", -60.0)
    assert [hash_file(film) for _ in range(3)] == [first] * 3
    assert len(read) == 3
    assert hash_file(film, reread=True) == first
    assert len(read) == 4
    times = film.stat()
    time.sleep(0.02)
    flip(film, 50)
    os.utime(film, ns=(times.st_atime_ns, times.st_mtime_ns))  # as some copying programs do
    assert hash_file(film) != first


def test_a_damaged_cache_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(content_hash.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(content_hash, "MIN_BYTES_KEPT", 10)
    monkeypatch.setattr(content_hash, "MIN_AGE_S", -60.0)
    film = tmp_path / "film.raw"
    film.write_bytes(bytes(100))
    first = hash_file(film)
    (kept,) = (tmp_path / "cache" / "hashes").iterdir()
    for damage in ("", "[]", "{}", '{"state": 1}', kept.read_text().replace(first, "0" * 64).replace("100,", "101,")):
        kept.write_text(damage)
        assert hash_file(film) == first
    (tmp_path / "cache" / "hashes").rename(tmp_path / "cache" / "away")
    (tmp_path / "cache" / "hashes").write_text("a file where the folder should be")
    assert hash_file(film) == first
