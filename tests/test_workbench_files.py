"""Films, plots, downloads and uploads of the page over real HTTP."""

from __future__ import annotations

import io
import json
import shutil
import socket
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest
from conftest import Clients
from page_client import Client, wait_for

from frictrack.samples import films_folder
from frictrack.workbench.handlers import MAX_UPLOAD_BYTES


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two films and no study."""
    folder = tmp_path_factory.mktemp("films")
    for name in ("fast.avi", "slow.avi"):
        shutil.copy(films_folder() / name, folder)
    return folder


def picture_number(client: Client, **query: Any) -> bytes:
    status, found = client.get("/api/frame", **query)
    assert status == 200, found
    assert found.startswith(b"\xff\xd8\xff")
    return found


def test_a_deleted_film_is_one_sentence_and_a_changed_one_is_opened_again(films: Path, page: Clients) -> None:
    client = page(films)
    info = client.get("/api/film", file="fast.avi")[1]
    assert (info["frames"], info["width"], info["height"]) == (150, 512, 72)
    first = picture_number(client, file="fast.avi", n=3, v=info["version"])
    (films / "fast.avi").rename(films / "kept.avi")
    status, words = client.get("/api/frame", file="fast.avi", n=4)
    assert (status, "is gone" in words["error"]) == (404, True)
    shutil.copy(films / "slow.avi", films / "fast.avi")
    assert client.get("/api/film", file="fast.avi")[1]["version"] != info["version"]
    assert picture_number(client, file="fast.avi", n=3) != first
    (films / "kept.avi").replace(films / "fast.avi")


# --- films and plots


def test_a_folder_without_a_study_shows_what_lies_there(films: Path, page: Clients) -> None:
    state = page(films).state
    assert not state["exists"]
    assert {one["name"] for one in state["recordings"]} >= {"slow.avi", "fast.avi"}


def test_frames_are_kept_by_the_browser_for_one_version_of_the_film(films: Path, page: Clients) -> None:
    client = page(films)
    version = client.get("/api/film", file="slow.avi")[1]["version"]
    for given, kept in ((version, True), ("old", False), ("", False)):
        _, headers, body = client.ask("GET", f"/api/frame?file=slow.avi&n=0&v={given}")
        assert ("immutable" in headers["Cache-Control"]) is kept
        assert body.startswith(b"\xff\xd8\xff")
    last, beyond = (picture_number(client, file="slow.avi", n=n) for n in (199, 10_000))
    assert len(last) > 1000
    assert len(beyond) > 1000


def test_plots_are_packed(fitted: Path, page: Clients) -> None:
    client = page(fitted)
    for query in (
        {"view": "compare"},
        {"view": "motion", "run": "slow"},
        {"view": "motion", "run": "slow", "cutoff": 80},
    ):
        status, body = client.get("/api/plots", **query)
        assert status == 200, body
        (length,) = struct.unpack("<I", body[:4])
        scene = json.loads(body[4 : 4 + length])
        assert scene["plots"]
        assert max(at + n for at, n in scene["columns"].values()) * 4 == len(body) - 4 - length
    assert client.get("/api/plots", view="motion", run="slow", cutoff="nan")[0] == 400
    assert client.get("/api/plots", view="compare", model="none")[0] == 404


# --- downloads


def test_downloads(fitted: Path, page: Clients) -> None:
    client = page(fitted)
    (fitted.parent / "study_results" / ".slow_elsewhere-1_x.part.h5").write_bytes(b"half")
    for what, start in (("tables.zip", b"PK"), ("hdf5.zip", b"PK"), ("figures.zip", b"PK"), ("repeat.py", b'"""')):
        status, headers, body = client.ask("GET", f"/api/download?what={what}")
        assert (status, headers["Content-Disposition"]) == (200, f'attachment; filename="{what}"')
        assert body.startswith(start), what
        if what == "hdf5.zip":  # nothing that a killed writer left
            assert zipfile.ZipFile(io.BytesIO(body)).namelist() == ["fast.h5", "middle.h5", "slow.h5", "study.h5"]
    assert client.get("/api/figure", name="filters:fast")[1].lstrip().startswith(b"<?xml")


@pytest.mark.slow
def test_an_outdated_report_is_refused_unless_it_is_asked_for_as_it_is(fitted: Path, page: Clients) -> None:
    report = fitted.parent / "study_results/report.html"
    report.write_text("<!doctype html><title>of an earlier model</title>")
    client = page(fitted)
    reason = client.state["report"]["outdated"]
    assert reason
    status, refused = client.get("/api/download", what="report.html")
    assert (status, reason.rstrip(".") in refused["error"]) == (409, True)
    status, body = client.get("/api/download", what="report.html", anyway=1)
    assert (status, body) == (200, report.read_bytes())


@pytest.mark.slow
def test_a_candidate_is_fitted_when_its_curve_is_asked_for(fitted: Path, page: Clients) -> None:
    client = page(fitted)
    assert client.get("/api/candidate", name="drag") == (202, {"pending": True})
    wait_for(lambda: client.get("/api/candidate", name="drag")[0] != 202)
    status, body = client.get("/api/candidate", name="drag")
    assert status == 200, body
    scene = json.loads(body[4 : 4 + struct.unpack("<I", body[:4])[0]])
    assert scene["columns"].keys() >= {"with", "F_with"}
    assert scene["errors"]["words"]
    assert len(client.state["models"]) == 1  # nothing of the study has changed
    wait_for(lambda: client.get("/api/candidate", name="textur")[0] != 202)
    status, refused = client.get("/api/candidate", name="textur")
    assert (status, 'did you mean "texture"' in refused["error"]) == (409, True)


# --- uploads


def store(client: Client, name: str, content: bytes) -> tuple[int, Any]:
    status, _, body = client.ask("POST", f"/api/upload?name={name}", content)
    return status, json.loads(body)


def left_over(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if ".part" in path.name]


@pytest.mark.parametrize("name", ["../a.avi", "/etc/a.avi", "..\\a.avi", "C:\\a.avi", "%2e%2e%2fa.avi"])
def test_an_upload_stays_in_the_folder(name: str, shared: Client) -> None:
    client = shared
    assert store(client, name, b"film") == (200, {"name": "a.avi"})
    folder = Path(client.state["folder"])
    assert (folder / "a.avi").read_bytes() == b"film"
    assert store(client, name, b"film") == (200, {"name": "a.avi"})  # the same content once more
    status, words = store(client, name, b"another")
    assert (status, "exists with different content" in words["error"]) == (409, True)
    assert (folder / "a.avi").read_bytes() == b"film"
    assert left_over(folder) == []


@pytest.mark.parametrize("name", ["", "..", ".hidden.avi", "a%0a.avi", "x" * 250, "study_results"])
def test_an_upload_without_a_usable_name_is_refused(name: str, shared: Client) -> None:
    client = shared
    status, words = store(client, name, b"film")
    assert (status, "expected the file name of a recording" in words["error"]) == (400, True)
    assert left_over(Path(client.state["folder"])) == []


def test_an_upload_of_several_parts_is_stored_whole(study_file: Path, page: Clients) -> None:
    client = page(study_file)
    content = bytes(range(256)) * 20_000
    assert store(client, "long.csv", content)[0] == 200
    assert (study_file.parent / "long.csv").read_bytes() == content


def test_half_an_upload_leaves_nothing(study_file: Path, page: Clients) -> None:
    client = page(study_file)
    with socket.create_connection(("127.0.0.1", client.server.port)) as link:
        head = f"POST /api/upload?name=half.avi HTTP/1.1\r\nHost: 127.0.0.1:{client.server.port}\r\n"
        link.sendall(f"{head}Cookie: {client.cookie}\r\nContent-Length: 5000000\r\n\r\n".encode() + bytes(2_000_000))
        wait_for(lambda: left_over(study_file.parent))
    wait_for(lambda: not left_over(study_file.parent))
    assert not (study_file.parent / "half.avi").exists()


@pytest.mark.slow
def test_too_large_an_upload_is_refused_before_it_is_sent(study_file: Path, page: Clients) -> None:
    client = page(study_file)
    with socket.create_connection(("127.0.0.1", client.server.port)) as link:
        head = f"POST /api/upload?name=big.avi HTTP/1.1\r\nHost: 127.0.0.1:{client.server.port}\r\n"
        link.sendall(f"{head}Cookie: {client.cookie}\r\nContent-Length: {MAX_UPLOAD_BYTES + 1}\r\n\r\n".encode())
        answer = link.recv(65536)
    assert b" 400 " in answer
    assert left_over(study_file.parent) == []
