"""Recordings by address."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import fsspec
import numpy as np
import pytest

from frictrack import remote
from frictrack.batch.file_states import are_unchanged, file_states
from frictrack.content_hash import CACHE_VARIABLE
from frictrack.errors import FrictrackError
from frictrack.flow import Session, open_study
from frictrack.remote import RemoteFile


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def elsewhere() -> Iterator[fsspec.AbstractFileSystem]:
    held = fsspec.filesystem("memory")
    yield held
    held.rm("/", recursive=True)


def table(fall: float = 1.2) -> bytes:
    t = np.arange(160) / 1000.0
    x = 2.0 * t - fall * t**2 + 5e-6 * np.random.default_rng(0).standard_normal(len(t))
    return ("t_s,x_m\n" + "\n".join(f"{a:.6f},{b:.9f}" for a, b in zip(t, x, strict=True))).encode()


def study(folder: Path, url: str) -> Path:
    path = folder / "study.toml"
    path.write_text(f'[study]\nmass = 0.5\nmodel = ["coulomb"]\n[[run]]\ntable = "{url}"\n')
    return path


def test_a_study_of_an_address_is_fetched_once_and_again_when_it_changes(
    tmp_path: Path, elsewhere: fsspec.AbstractFileSystem, cache: Path
) -> None:
    elsewhere.pipe("/lab/v3.csv", table())
    opened = open_study(study(tmp_path, "memory://lab/v3.csv"))
    assert opened.runs[0].name == "v3"
    found = Session(opened).fit()
    assert found["parameters"]["coulomb.F_c"]["value"] == pytest.approx(1.2, rel=0.02)  # 2 * fall * mass
    assert [path.name for path in cache.rglob("*.csv")] == ["v3.csv"]
    before = file_states(opened)
    assert Session(open_study(opened.path)).runs[0].is_current("displacement")
    assert are_unchanged({"memory://lab/v3.csv": before["memory://lab/v3.csv"]})
    elsewhere.pipe("/lab/v3.csv", table(1.5) + b"\n")
    assert not are_unchanged({"memory://lab/v3.csv": before["memory://lab/v3.csv"]})
    again = Session(open_study(opened.path)).fit()
    assert again["parameters"]["coulomb.F_c"]["value"] == pytest.approx(1.5, rel=0.02)


def test_a_header_is_fetched_with_its_frames(elsewhere: fsspec.AbstractFileSystem) -> None:
    elsewhere.pipe({"/lab/a.cih": b"header", "/lab/a.mraw": b"frames"})
    found = RemoteFile("memory://lab/a.cih").fetch()
    assert found.with_suffix(".mraw").read_bytes() == b"frames"


def test_over_http(tmp_path: Path) -> None:
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / "v3.csv").write_bytes(table())

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "served")))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        url = f"http://127.0.0.1:{server.server_port}/v3.csv"
        assert RemoteFile(url).fetch().read_bytes() == table()
        assert RemoteFile(url).state()
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("memory://lab/nothing.csv", "cannot be fetched"),
        ("nosuch://lab/a.csv", "Protocol not known"),
    ],
)
def test_what_does_not_answer_is_said(tmp_path: Path, url: str, why: str) -> None:
    with pytest.raises(FrictrackError, match=f"{url}.*{why}"):
        Session(open_study(study(tmp_path, url))).fit()
    assert RemoteFile(url).state() == []


def test_room_is_made_by_what_was_not_used_for_longest(
    cache: Path, elsewhere: fsspec.AbstractFileSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "MAX_CACHE_BYTES", 25.0)
    for i, name in enumerate(("old", "middle", "new")):
        elsewhere.pipe(f"/lab/{name}", b"0123456789")
        os.utime(RemoteFile(f"memory://lab/{name}").fetch(), (1e9 + i, 1e9 + i))
    elsewhere.pipe("/lab/last", b"0123456789")
    RemoteFile("memory://lab/last").fetch()
    assert {path.name for path in cache.rglob("*") if path.is_file()} == {"cache", "middle", "new", "last"}
    assert RemoteFile("memory://lab/old").fetch().read_bytes() == b"0123456789"  # fetched again
