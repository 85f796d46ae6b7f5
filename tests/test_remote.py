"""Recordings by address."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, get_args

import fsspec
import numpy as np
import pytest
import tomlkit
from range_server import serving

from frictrack.base import remote
from frictrack.base.errors import FrictrackError
from frictrack.base.files import CACHE_VARIABLE
from frictrack.base.remote import RemoteFile
from frictrack.flow import Session, open_study
from frictrack.flow.batch.tasks import are_unchanged, file_states
from frictrack.recording.byte_ranges import find_ranges
from frictrack.study import parse
from frictrack.study.loading import TABLES


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[fsspec.AbstractFileSystem]:
    monkeypatch.setattr(remote, "PROTOCOLS", (*remote.PROTOCOLS, "memory"))
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


def test_a_file_of_the_web_is_fetched_again_when_it_changes(tmp_path: Path) -> None:
    (tmp_path / "v3.csv").write_bytes(table())
    with serving(tmp_path) as server:
        file = RemoteFile(server.url("v3.csv"))
        assert file.fetch().read_bytes() == file.fetch().read_bytes() == table()
        assert (server.requests, server.sent) == (1, len(table()))
        before = file.state()
        (tmp_path / "v3.csv").write_bytes(table(1.5))
        assert file.fetch().read_bytes() == table(1.5)
        assert file.state() != before


def test_what_does_not_answer_is_said(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        url = server.url("nothing.csv")
        with pytest.raises(FrictrackError, match=f"expected a recording at {url} but it cannot be fetched: 404"):
            Session(open_study(study(tmp_path, url))).fit()
        assert RemoteFile(url).state() == []


def test_addresses_of_this_machine_are_paths(tmp_path: Path) -> None:
    (tmp_path / "v 3.csv").write_bytes(table())
    opened = open_study(study(tmp_path, f"file://{tmp_path}/v%203.csv"))
    assert opened.runs[0].table == tmp_path / "v 3.csv"


COMMAND = "reference://lab/a.csv"
NO_FILES = (
    *(
        COMMAND,
        "ftp://127.0.0.1/a.csv",
        "memory://a.csv",
        "data://a,b",
        "HTTP://host/a.csv",
        "://a.csv",
        "x http://h/a",
    ),
    *("simplecache::http://h/a.csv", "zip://a.csv::http://h/a.zip", "http://h/a::reference://b", "https://h/"),
    *("http://[/a.csv", "https://h/a/..", "https://h/..\\a.csv", "python://a.csv", "ssh://h/a", "tcp://h/a"),
)


@pytest.mark.parametrize("text", NO_FILES)
def test_only_a_few_protocols_are_opened(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fsspec, "url_to_fs", lambda *_, **__: pytest.fail("it was opened"))
    for use in (remote.locate, RemoteFile):
        with pytest.raises(FrictrackError, match=r"^expected the address of a file \(file://, .*\) but got ") as raised:
            use(text)
        assert text in str(raised.value)
    assert not are_unchanged({text: []})


def files_in(value: Any) -> Iterator[str]:
    """All paths and addresses in a value."""
    if isinstance(value, Path | RemoteFile):
        yield str(value)
    elif isinstance(value, Mapping):
        yield from (file for part in value.values() for file in files_in(part))
    elif isinstance(value, tuple | list):
        yield from (file for part in value for file in files_in(part))
    elif hasattr(value, "__dict__"):
        yield from files_in(vars(value))


def types_in(annotation: Any) -> set[Any]:
    return {annotation}.union(*(types_in(part) for part in get_args(annotation)))


def test_every_key_of_a_study_file_is_read_by_one_function(tmp_path: Path) -> None:
    """A new key that names a file without `remote.locate` fails here."""
    (tmp_path / "a.csv").write_bytes(table())
    board = {"board": COMMAND, "squares": [3, 4], "square": "1 mm"}
    shapes = (COMMAND, [COMMAND], {"table": COMMAND}, board, [{**board, "board": [COMMAND]}], {"name": COMMAND})
    refusing = set()
    for name, keys in TABLES.items():
        for key, field in keys.model_fields.items():
            for value in shapes:
                raw: dict[str, Any] = {
                    "study": {"mass": 0.5},
                    "run": [{"table": "a.csv"}],
                    "effect": [{"effect": "wind"}],
                }
                given = raw.setdefault(name, [{"effect": "wind"}] if name == "effect" else {})
                (given[0] if isinstance(given, list) else given)[key] = value
                try:
                    read = parse(tmp_path / "study.toml", tomlkit.dumps(raw))
                except FrictrackError as e:
                    if "expected the address of a file" in str(e):
                        refusing.add(key)
                else:
                    assert not [file for file in files_in(read) if "lab" in file], (name, key)
            if types_in(field.annotation) & {Path, RemoteFile}:
                assert key in refusing, f"{key} of [{name}] takes {COMMAND}"
    assert refusing >= {"prior", "lens", "video", "table", "target", "targets", "scale", "drive", "sensor"}


@pytest.mark.parametrize("key", ["drive", "sensor", "lens", "target", "output"])
def test_addresses_where_none_can_be(tmp_path: Path, key: str) -> None:
    (tmp_path / "a.csv").write_bytes(table())
    path = study(tmp_path, "a.csv")
    text = path.read_text()
    line = f'{key} = "https://h/a.csv"\n'
    path.write_text(text.replace("[[run]]", f"{line}[[run]]") if key == "output" else text + line)
    with pytest.raises(FrictrackError, match=r"expected a (file|folder) of this machine but got .https://h/a\.csv"):
        open_study(path)


class BadServer(BaseHTTPRequestHandler):
    """Redirects to other protocols, and answers that do not end."""

    protocol_version = "HTTP/1.1"
    stopped = threading.Event()

    def do_HEAD(self) -> None:
        self.head(self.path.strip("/").split("/"))

    def head(self, words: list[str]) -> None:
        if words[0] == "redirect":
            self.send_response(302)
            self.send_header("Location", f"{words[1]}:///etc/passwd")
            self.send_header("Content-Length", "0")
        else:
            self.send_response(206 if "Range" in self.headers else 200)
            self.send_header("Connection", "close")
            if words[0] != "endless":
                self.send_header("Content-Length", "1000000000000")
                self.send_header("ETag", '"a"')
        self.end_headers()

    def do_GET(self) -> None:
        words = self.path.strip("/").split("/")
        self.head(words)
        if words[0] == "redirect":
            return
        self.close_connection = True
        with suppress(OSError):
            while not self.stopped.wait(0.05 if words[0] == "slow" else 0.0):
                self.wfile.write(b"x" if words[0] == "slow" else bytes(100_000))
                if words[0] == "silent":
                    self.stopped.wait(60)

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def bad(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(remote, "MAX_UNSTATED_BYTES", 1e6)
    monkeypatch.setattr(remote, "MAX_SILENCE_S", 0.2)
    monkeypatch.setattr(BadServer, "stopped", threading.Event())
    server = ThreadingHTTPServer(("127.0.0.1", 0), BadServer)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    BadServer.stopped.set()
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("redirect/file/a.csv", "file:///etc/passwd"),
        ("redirect/ftp/a.csv", "ftp:///etc/passwd"),
        ("redirect/data/a.csv", "data:/"),
        ("endless/a.csv", "expected at most 1 MB without a stated size but its server sends more"),
        ("silent/a.csv", "imeout"),
        ("slow/a.csv", "expected 1 kB/s but its server sent . bytes in 0 s"),
    ],
)
def test_a_web_server_that_means_harm(bad: str, cache: Path, path: str, why: str) -> None:
    began = time.monotonic()
    with pytest.raises(FrictrackError, match=f"expected a recording at {bad}/{path} but it cannot be fetched: .*{why}"):
        RemoteFile(f"{bad}/{path}").fetch()
    assert time.monotonic() - began < 5
    assert not [file for file in cache.rglob("*") if file.is_file()]


def test_a_web_server_that_sends_more_than_the_part_it_was_asked_for(bad: str) -> None:
    file = find_ranges(RemoteFile(f"{bad}/more/a.cine"))
    assert file is not None
    with file.open() as opened:
        assert opened.read(1000) == bytes(1000)


def test_room_is_made_by_what_was_not_used_for_longest(
    cache: Path, elsewhere: fsspec.AbstractFileSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote, "MAX_CACHE_BYTES", 25.0)
    for i, name in enumerate(("old", "middle", "new")):
        elsewhere.pipe(f"/lab/{name}", b"0123456789")
        os.utime(RemoteFile(f"memory://lab/{name}").fetch(), (1e9 + i, 1e9 + i))
    elsewhere.pipe("/lab/last", b"0123456789")
    RemoteFile("memory://lab/last").fetch()
    assert {path.name for path in cache.rglob("*") if path.is_file()} == {"middle", "new", "last"}
    assert RemoteFile("memory://lab/old").fetch().read_bytes() == b"0123456789"  # fetched again
