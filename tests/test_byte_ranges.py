"""Remote films of which only the needed parts are fetched."""

from __future__ import annotations

import errno
import hashlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from camera_films import write_cine, write_photron
from film import block_film
from range_server import RangeServer, serving

import frictrack as ft
from frictrack.base import remote
from frictrack.base.errors import FrictrackError
from frictrack.base.files import CACHE_VARIABLE, write_at
from frictrack.base.remote import RemoteFile
from frictrack.flow import Session, open_study
from frictrack.recording import byte_ranges
from frictrack.recording.byte_ranges import RangedFile, find_ranges


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RangeServer]:
    (tmp_path / "served").mkdir()
    with serving(tmp_path / "served") as one:
        yield one


def noise(bits: int, n: int = 6, shape: tuple[int, int] = (200, 320)) -> np.ndarray:
    kind = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(bits).integers(0, 1 << min(bits, 12), (n, *shape)).astype(kind)


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("write", [write_photron, write_cine])
def test_a_remote_film_is_the_same_film(server: RangeServer, write: Callable[..., Path], bits: int) -> None:
    stamps = {"stamps": np.arange(6) / 5000} if write is write_cine else {"depth": 12 if bits == 16 else bits}
    path = write(server.folder, noise(bits), bits, **stamps)
    here, there = ft.open_recording(path), ft.open_recording(RemoteFile(server.url(path.name)))
    assert isinstance(there.path, RangedFile)
    assert (there.shape, there.n_frames, there.bit_depth, there.fps) == (
        here.shape,
        here.n_frames,
        here.bit_depth,
        here.fps,
    )
    np.testing.assert_array_equal(there.t, here.t)
    indices, corners = np.array([4, 0, 5, 2]), np.array([[3, 5], [301, 180], [7, 0], [160, 100]])
    np.testing.assert_array_equal(there.cut(indices, corners, (20, 19)), here.cut(indices, corners, (20, 19)))
    for ours, theirs in zip(here.frames(), there.frames(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert there.sampled_hash == here.sampled_hash


def test_only_what_is_needed_is_fetched_and_only_once(server: RangeServer) -> None:
    path = write_cine(server.folder, noise(16, n=40, shape=(512, 1024)), 16)
    size = path.stat().st_size
    film = ft.open_recording(RemoteFile(server.url(path.name)))
    assert server.sent < 0.003 * size
    film.frame(20)
    assert server.sent < 0.03 * size
    corners = np.full((40, 2), 240)
    first = film.cut(np.arange(40), corners, (20, 30))
    assert server.sent < 0.12 * size  # 20 of 512 rows, and up to two blocks around them
    before, asked = server.sent, server.requests
    again = ft.open_recording(RemoteFile(server.url(path.name)))
    np.testing.assert_array_equal(again.cut(np.arange(40), corners, (20, 30)), first)
    assert (server.sent, server.requests) == (before, asked)


def test_a_photron_film_is_named_by_either_file(server: RangeServer) -> None:
    write_photron(server.folder, noise(8), 8)
    names = ("film.cih", "film.mraw")
    hashes = [ft.open_recording(RemoteFile(server.url(name))).hash for name in names]
    assert hashes[0] == hashes[1]
    assert hashes[0].startswith("store:")
    (server.folder / "film.cih").unlink()
    with pytest.raises(FrictrackError, match=r"film.mraw: expected its header film.cihx or film.cih beside it"):
        ft.open_recording(RemoteFile(server.url("film.mraw")))


def test_the_store_says_what_the_content_is(server: RangeServer) -> None:
    path = write_cine(server.folder, noise(8), 8)
    url = server.url(path.name)
    film = ft.open_recording(RemoteFile(url))
    etag = hashlib.md5(path.read_bytes()).hexdigest()
    assert film.hash == f"etag:{etag} {path.stat().st_size} {url}"
    write_cine(server.folder, noise(8) ^ 1, 8)
    with pytest.raises(FrictrackError, match="was replaced while it was read; run again"):
        film.hash  # noqa: B018
    changed = ft.open_recording(RemoteFile(url))
    np.testing.assert_array_equal(changed.frame(3), noise(8)[3] ^ 1)
    path.unlink()
    with pytest.raises(FrictrackError, match="it is not there any more"):
        changed.hash  # noqa: B018


def test_without_such_a_statement_the_whole_film_is_fetched(server: RangeServer) -> None:
    server.etags = False
    path = write_cine(server.folder, noise(8), 8)
    film = ft.open_recording(RemoteFile(server.url(path.name)))
    assert isinstance(film.path, Path)
    assert server.sent == path.stat().st_size
    assert film.hash == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("says", "identity"),
    [
        ({"ChecksumSHA256": "q1w2=", "ETag": '"a"'}, "sha256:q1w2= 4"),
        ({"VersionId": "null", "ETag": '"a-2"'}, "etag:a-2 4 memory://lab/v3.cine"),
        ({"VersionId": "v7", "ETag": '"a-2"'}, "version:v7 4 memory://lab/v3.cine"),
        ({"ETag": 'W/"a"'}, ""),
        ({}, ""),
    ],
)
def test_the_strongest_statement_is_taken(monkeypatch: pytest.MonkeyPatch, says: dict[str, Any], identity: str) -> None:
    monkeypatch.setattr(remote, "PROTOCOLS", ("memory",))
    held = fsspec.filesystem("memory")
    monkeypatch.setattr(type(held), "info", lambda self, path, **more: {"size": 4, "type": "file"} | says)
    found = find_ranges(RemoteFile("memory://lab/v3.cine"))
    assert (found.identity if found else "") == identity


def test_a_part_that_breaks_off_is_no_part(server: RangeServer) -> None:
    path = write_cine(server.folder, noise(8), 8)
    film = ft.open_recording(RemoteFile(server.url(path.name)))
    server.cut_short = True
    with pytest.raises(FrictrackError, match="cannot be read: 74483 bytes read on a total of 74484"):
        film.frame(5)
    server.cut_short = False
    np.testing.assert_array_equal(film.frame(5), noise(8)[5])


def test_a_cache_without_space(server: RangeServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """What could not be written is fetched again when there is space."""
    path = write_cine(server.folder, noise(8), 8)
    film = ft.open_recording(RemoteFile(server.url(path.name)))

    def full(file: Any, at: int, part: bytes, real: Any = byte_ranges.write_at) -> None:
        real(file, at, part[: len(part) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as now:
        now.setattr(byte_ranges, "write_at", full)
        with pytest.raises(FrictrackError, match="No space left on device"):
            film.frame(5)
    np.testing.assert_array_equal(film.frame(5), noise(8)[5])


def test_a_film_in_parts_counts_without_its_holes(
    server: RangeServer, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "MAX_CACHE_BYTES", 200e3)
    for name in "abc":
        path = write_cine(server.folder, noise(16, n=8), 16)  # 1 MB
        path.rename(server.folder / f"{name}.cine")
        ft.open_recording(RemoteFile(server.url(f"{name}.cine")))
    assert sorted(path.name[0] for path in cache.rglob("*.parts")) == ["a", "b", "c"]
    ft.open_recording(RemoteFile(server.url("a.cine"))).pick(range(8))
    os.utime(next(cache.rglob("a.cine*")), (1, 1))
    ft.open_recording(RemoteFile(server.url("b.cine")))
    assert sorted(path.name[0] for path in cache.rglob("*.parts")) == ["b", "c"]


def test_a_write_that_takes_only_a_part_goes_on() -> None:
    class Slow(io.RawIOBase):
        content = bytearray(b".........")

        def seek(self, offset: int, whence: int = 0) -> int:
            self.at = offset
            return offset

        def write(self, part: Any) -> int:
            taken = bytes(part[:3])
            self.content[self.at : self.at + len(taken)] = taken
            self.at += len(taken)
            return len(taken)

    file = Slow()
    write_at(file, 1, np.arange(0x30, 0x37, dtype=np.uint8))
    assert file.content == b".0123456."


@pytest.mark.slow
def test_tracking_a_small_target_fetches_a_small_part(tmp_path: Path, server: RangeServer) -> None:
    n, shape = 150, (512, 1024)
    x = 300.0 + 2.0 * np.arange(n) - 0.004 * np.arange(n) ** 2
    drawn = block_film(x, size=(40, 60), shape=shape)
    write_photron(server.folder, np.stack(list(drawn.frames())), 8)
    folder = tmp_path / "study"
    folder.mkdir()

    def track(film: str) -> Any:
        path = folder / "study.toml"
        target = "target = [270, 236, 60, 40]"
        path.write_text(f'[study]\nmass = 0.5\n[camera]\nscale = "1 mm/px"\n[[run]]\nvideo = "{film}"\n{target}\n')
        return Session(open_study(path)).runs[0].get("track")

    there = track(server.url("film.cih"))
    share = server.sent / (server.folder / "film.mraw").stat().st_size
    here = track(str(server.folder / "film.cih"))
    np.testing.assert_array_equal(there.x_px, here.x_px)
    np.testing.assert_array_equal(there.y_px, here.y_px)
    assert there.found.all()
    assert share < 0.3
