"""The server of the page over real HTTP: every address, its errors, messages after changes, files that vanish."""

from __future__ import annotations

import asyncio
import json
import shutil
import socket
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from browser import Server
from conftest import Clients
from page_client import Client
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application
from tornado.websocket import websocket_connect

from frictrack.flow import Session, open_study
from frictrack.workbench import handlers
from frictrack.workbench.live_study import to_json

ROUTES = ("/api/state", "/api/effects", "/api/film?run=slow", "/api/plots?view=compare", "/api/download?what=repeat.py")


# --- the page and the state


def test_the_page_its_modules_and_the_headers_of_every_answer(shared: Client) -> None:
    client = shared
    for path in ("/", "/static/vendor/preact-htm.js", *ROUTES[:2], "/api/film?run=slow", "/static/none.js"):
        status, headers, _ = client.ask("GET", path)
        assert status == {"/api/film?run=slow": 404, "/static/none.js": 404}.get(path, 200), path
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        assert "unsafe-eval" not in headers["Content-Security-Policy"]
        assert "script" not in headers["Content-Security-Policy"]
    _, headers, _ = client.ask("GET", "/static/vendor/preact-htm.js")
    assert headers["Cache-Control"] == "no-cache"
    again = client.ask("GET", "/static/vendor/preact-htm.js", If_None_Match="x")
    assert again[0] == 200
    assert client.ask("GET", "/static/vendor/preact-htm.js", **{"If-None-Match": headers["ETag"]})[0] == 304
    assert client.get("/static/../server.py")[0] in (403, 404)


def test_the_state_of_a_study(fitted: Path, page: Clients) -> None:
    state = page(fitted).state
    assert [run["name"] for run in state["runs"]] == ["slow", "middle", "fast"]
    assert (state["revision"], state["exists"], state["error"]) == (1, True, None)
    assert (state["job"], state["last_job"]) == (None, None)
    assert [model["current"] for model in state["models"]] == [True]


@pytest.mark.slow
def test_effects_and_numbers_as_they_are_typed(study_file: Path, page: Clients) -> None:
    study_file.write_text(study_file.read_text() + '\n[search]\nmethod = "mga"\ngenerations = 77\n', encoding="utf-8")
    client = page(study_file)
    found = client.get("/api/effects")[1]
    assert "texture" in [one["name"] for one in found["effects"]]
    assert found["searches"]["search"] == "mga"
    assert found["searches"]["known"]["mga"]["generations"] == {"default": 77, "choices": None}
    assert found["searches"]["known"]["ga"]["generations"] == {"default": None, "choices": None}
    status, found = client.post("/api/check", fields={"mass": "350 g"})
    assert (status, found["fields"]["mass"]["echo"]) == (200, "0.350 kg")
    assert "350 g" not in study_file.read_text()


def test_numbers_that_are_not_finite_are_null() -> None:
    assert json.loads(to_json({"a": [float("inf"), 1.5], "b": float("nan")})) == {"a": [None, 1.5], "b": None}


# --- errors


@pytest.mark.parametrize(
    ("path", "told", "status", "words"),
    [
        ("/api/do", {"do": "restart"}, 400, "expected one of the changes"),
        ("/api/do", {"do": "edit", "arguments": {"tabel": 1}}, 400, "expected other arguments of edit"),
        ("/api/do", {"do": "edit", "arguments": 3}, 400, "expected arguments as a JSON object"),
        ("/api/do", {"do": "undo", "seen": 7}, 409, "changed meanwhile"),
        ("/api/do", {"do": "undo", "seen": "x"}, 400, "expected the revision"),
        ("/api/job", {"do": "rm"}, 400, "expected one of the jobs"),
        ("/api/job", {"do": []}, 400, "expected one of the jobs"),
        ("/api/job", {"do": {"a": 1}}, 400, "expected one of the jobs"),
        ("/api/do", {"do": {"a": 1}}, 400, "expected one of the changes"),
        ("/api/job", {"do": "attempt", "arguments": {"effect": "drag", "path": "/etc/x"}}, 400, "but got path"),
        ("/api/job", {"do": "fit", "seen": 9}, 409, "changed meanwhile"),
        ("/api/study", {"recordings": []}, 400, "expected the names of recordings"),
        ("/api/study", {"recordings": ["../a.csv"]}, 400, "expected the name of a recording in the folder"),
        ("/api/sample", {}, 409, "expected an empty folder"),
    ],
)
def test_a_refused_command_is_one_sentence(
    path: str, told: dict[str, Any], status: int, words: str, shared: Client
) -> None:
    found = shared.post(path, **told)
    assert found[0] == status, found
    assert words in found[1]["error"]
    assert "\n" not in found[1]["error"]


@pytest.mark.parametrize(
    ("path", "status", "words"),
    [
        ("/api/film?run=none", 404, "expected a run with a film"),
        ("/api/film?file=../study.toml", 400, "expected the name of a recording in the folder"),
        ("/api/film?file=none.avi", 404, "is gone"),
        ("/api/film?file=slow.csv", 400, "expected a film"),
        ("/api/frame?file=slow.avi&n=x", 400, "expected the number of a frame"),
        ("/api/frame?file=slow.avi&n=--5", 400, "expected the number of a frame"),
        (f"/api/frame?file=slow.avi&n={'9' * 5000}", 400, "expected the number of a frame"),
        ("/api/plots?view=compare", 404, "expected a fitted model"),
        ("/api/plots?view=motion&run=none", 404, "measured run"),
        ("/api/candidate?name=texture", 404, "expected a fitted model"),
        ("/api/sheet?run=..%2Fslow", 404, "expected a run"),
        ("/api/figure?name=scan:texture", 404, "expected a figure"),
        ("/api/download?what=study.toml", 400, "expected one of the files"),
        ("/api/download?what=report.html", 404, "does not exist"),
        ("/api/nothing", 404, "expected an address"),
    ],
)
def test_what_is_not_there_is_said_in_one_sentence(path: str, status: int, words: str, shared: Client) -> None:
    found = shared.get(path)
    assert found[0] == status, found
    assert words in found[1]["error"]


@pytest.mark.parametrize("path", ["/static/%00", "/static/a%00b", "/static/%ff", "/%00"])
def test_addresses_that_are_no_file_names(path: str, shared: Client) -> None:
    status, body = shared.get(path)
    assert status in (400, 404)
    assert "expected " in str(body).lower()


def send_raw(client: Client, head: str) -> bytes:
    """First part of the answer to a request with the cookie, without checks of its header."""
    own = f"127.0.0.1:{client.server.port}"
    with socket.create_connection(("127.0.0.1", client.server.port), timeout=20) as link:
        link.sendall(f"{head}\r\nHost: {own}\r\nCookie: {client.cookie}\r\n\r\n".encode())
        return link.recv(65536)


@pytest.mark.parametrize("length", ["abc", "", "0x10", "5, 6", "²", "9" * 5000])
@pytest.mark.parametrize("path", ["/api/do", "/api/upload?name=a.avi"])
def test_a_length_that_is_no_number_is_refused(path: str, length: str, shared: Client) -> None:
    assert b" 400 " in send_raw(shared, f"POST {path} HTTP/1.1\r\nContent-Length: {length}")


def test_an_origin_that_is_no_address_is_refused(shared: Client) -> None:
    assert b" 403 " in send_raw(shared, "GET /api/state HTTP/1.1\r\nOrigin: http://[")


def test_a_body_that_is_no_json_or_too_large_is_refused(shared: Client) -> None:
    client = shared
    assert client.ask("POST", "/api/do", b"\xff")[0] == 400
    assert client.ask("POST", "/api/do", b"[1]")[0] == 400
    with suppress(ConnectionError):  # it may be closed before the answer is read
        assert client.ask("POST", "/api/do", b" " * 5_000_000)[0] in (400, 413)
    assert client.get("/api/state")[0] == 200


def test_a_port_in_use_is_one_sentence(tmp_path: Path) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        held.listen()
        server = Server(tmp_path, port=held.getsockname()[1], log=tmp_path / "log.txt").start()
        assert server.process is not None
        assert server.process.wait(60) == 1
    text = (tmp_path / "log.txt").read_text()
    assert "choose another --port" in text
    assert "Traceback" not in text


# --- messages


@pytest.mark.slow
def test_a_change_by_the_command_line_reaches_two_tabs(study_file: Path, page: Clients) -> None:
    one = page(study_file).listen()
    two = page(study_file, one.server).listen()
    assert one.hear(lambda m: m["type"] == "hello")["server"] == one.state["server"]
    Session(open_study(study_file), author="cli").apply("edit", table="study", key="mass", value="0.4 kg")
    for client in (one, two):
        state = client.hear_state(lambda s: s["revision"] == 1)
        assert state["fields"]["mass"]["echo"] == "0.400 kg"


def test_a_tab_that_opens_knows_the_change_just_made(study_file: Path, page: Clients) -> None:
    client, session = page(study_file), Session(open_study(study_file), author="cli")
    for k in range(5):
        session.apply("edit", table="study", key="mass", value=f"0.4{k} kg")
        assert client.state["revision"] == k + 1


def test_two_tabs_do_not_overwrite_each_other(study_file: Path, page: Clients) -> None:
    client = page(study_file).listen()
    status, made = client.post(
        "/api/do", do="edit", arguments={"table": "study", "key": "mass", "value": "0.4 kg"}, seen=0
    )
    assert (status, made["revision"]) == (200, 1)
    status, refused = client.post("/api/do", do="undo", arguments={}, seen=0)
    assert (status, "changed meanwhile" in refused["error"]) == (409, True)
    assert client.post("/api/do", do="undo", arguments={}, seen=1)[1]["revision"] == 2
    assert client.hear_state(lambda s: s["revision"] == 2)["history"]["can_redo"]


def test_a_tab_that_does_not_read_costs_little_and_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handlers, "MAX_UNREAD_S", 0.3)
    tabs: list[Callable[[str], None]] = []
    live = SimpleNamespace(
        server="s", listen=lambda call: (tabs.append(call), lambda: call in tabs and tabs.remove(call))[1]
    )

    heard: list[Any] = []

    async def scenario() -> int:
        server = HTTPServer(Application([("/", handlers.EventsHandler, {"live": live})]))
        sockets = bind_sockets(0, "127.0.0.1")
        server.add_sockets(sockets)
        port = sockets[0].getsockname()[1]
        reads = await websocket_connect(f"ws://127.0.0.1:{port}/", on_message_callback=heard.append)
        stuck = socket.socket()
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.connect(("127.0.0.1", port))
        head = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        stuck.sendall(f"{head}Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n\r\n".encode())
        while len(tabs) < 2:
            await asyncio.sleep(0.01)
        tracemalloc.start()
        for i in range(60):
            for send in tuple(tabs):
                send(f'{{"type":"state","state":{i},"padding":"{i:01000000d}"}}')
            await asyncio.sleep(0.01)
            del heard[:-1]
        while len(tabs) > 1:
            await asyncio.sleep(0.01)
        held = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        while '"state":59,' not in heard[-1]:
            await asyncio.sleep(0.01)
        stuck.close()
        reads.close()
        server.stop()
        return held

    assert asyncio.run(asyncio.wait_for(scenario(), 20)) < 40_000_000  # all unread messages: 60 MB and more


def test_a_ping_is_answered(shared: Client) -> None:
    client = shared.listen()
    client.send('{"type":"ping"}')
    assert client.hear(lambda m: m["type"] == "pong")


# --- files that vanish


@pytest.mark.slow
def test_a_deleted_study_file_is_said_and_comes_back(study_file: Path, page: Clients) -> None:
    client = page(study_file).listen()
    assert client.state["exists"]
    text = study_file.read_text()
    study_file.unlink()
    state = client.hear_state(lambda s: not s["exists"])
    assert "is gone" in state["error"]
    status, refused = client.post("/api/job", do="fit", arguments={}, seen=0)
    assert (status, "is gone" in refused["error"]) == (404, True)
    study_file.write_text("[study")
    assert "study.toml" in client.hear_state(lambda s: s["exists"] and s["error"])["error"]
    study_file.write_text(text)
    client.messages.clear()
    assert client.hear_state(lambda s: s["exists"] and not s["error"])["runs"]


@pytest.mark.slow
def test_deleted_results_are_said_and_can_be_made_again(fitted: Path, page: Clients) -> None:
    client = page(fitted).listen()
    assert client.state["models"]
    shutil.rmtree(fitted.parent / "study_results")
    state = client.hear_state(lambda s: not s["models"])
    assert state["exists"]
    status, words = client.get("/api/plots", view="compare")
    assert (status, "press Run" in words["error"]) == (404, True)
    assert client.work("fit")[0] == 200
    assert client.hear_end()["state"] == "done"
    assert client.hear_state(lambda s: s["models"])["revision"] == 1
