"""Only its own user reaches the page: host, origin and token of every request are checked."""

from __future__ import annotations

import base64
import http.client
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import CHROMIUM, TOKEN, Open, Server
from page_client import wait_for
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine

from frictrack.cli import main
from frictrack.workbench.server import RequestGuard, address_of

PATHS = ("/", "/api/events", "/api/state", "/api/frame?file=a.avi", "/static/tokens.css", "/none")


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("guarded")).start()
    yield server
    server.stop()


def ask(server: Server, path: str = "/", *, method: str = "GET", **headers: str) -> tuple[int, str, str]:
    """Status, body and Set-Cookie of the answer to one request with these headers."""
    link = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    try:
        link.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
        answer = link.getresponse()
        body = answer.read() if answer.status != 101 else b""
        return answer.status, body.decode(errors="replace"), answer.getheader("Set-Cookie") or ""
    finally:
        link.close()


def knock(server: Server, path: str = "/api/events", **headers: str) -> int:
    """Status of the answer to the handshake of a WebSocket."""
    key = base64.b64encode(os.urandom(16)).decode()
    wanted = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13", "Sec_WebSocket_Key": key}
    return ask(server, path, **wanted, **headers)[0]


@pytest.fixture(scope="module")
def cookie(bench: Server) -> str:
    status, body, held = ask(bench, f"/?token={TOKEN}")
    assert status == 200
    assert "refresh" in body
    assert TOKEN not in body + held
    assert "HttpOnly" in held
    assert "SameSite=Strict" in held
    return held.split(";")[0]


@pytest.mark.parametrize("path", PATHS)
def test_nothing_is_served_without_the_token(path: str, bench: Server) -> None:
    status, body, held = ask(bench, path)
    assert (status, held) == (403, "")
    assert body == "Expected the address with its token; copy it from the terminal where frictrack app was started."


@pytest.mark.few(6)
@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", ["evil.com", "evil.com:5006", "127.0.0.1.evil.com", "localhost.evil.com", "[", ""])
def test_a_foreign_host_is_refused_with_the_token_and_the_cookie(
    path: str, name: str, bench: Server, cookie: str
) -> None:
    joined = path + ("&" if "?" in path else "?") + f"token={TOKEN}"
    status, body, held = ask(bench, joined, Host=name, Origin=f"http://{name}", Cookie=cookie)
    assert status in (400, 403)  # what is no host at all is no request either
    assert held == ""
    if name == "evil.com":
        assert body.startswith('Expected the name of this machine as the host but got "evil.com"')


@pytest.mark.few(6)
@pytest.mark.parametrize("origin", ["http://evil.com", "null", "http://127.0.0.1:1", "file://"])
@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE", "OPTIONS", "HEAD"])
def test_a_request_of_another_page_is_refused(method: str, origin: str, bench: Server, cookie: str) -> None:
    status, body, _ = ask(bench, "/", method=method, Origin=origin, Cookie=cookie)
    assert status == 403
    assert method == "HEAD" or body == f'Expected a request from the page itself but got one from "{origin}".'


def test_a_websocket_needs_host_origin_and_cookie(bench: Server, cookie: str) -> None:
    own = f"127.0.0.1:{bench.port}"
    assert knock(bench, Host="evil.com", Origin="http://evil.com", Cookie=cookie) == 403
    assert knock(bench, f"/api/events?token={TOKEN}", Host="evil.com", Origin="http://evil.com") == 403
    assert knock(bench, Host=own, Origin="http://evil.com", Cookie=cookie) == 403
    assert knock(bench, Host=own, Origin=f"http://{own}") == 403
    assert knock(bench, "/api/events?token=wrong", Host=own, Origin=f"http://{own}") == 403
    assert knock(bench, Host=own, Origin=f"http://{own}", Cookie="frictrack=1") == 403
    assert knock(bench, Host=own, Origin=f"http://{own}", Cookie=cookie) == 101
    assert knock(bench, f"/api/events?token={TOKEN}", Host=own, Origin=f"http://{own}") == 101


@pytest.mark.parametrize("path", PATHS[2:])
def test_everything_is_served_with_the_cookie(path: str, bench: Server, cookie: str) -> None:
    status, body, _ = ask(bench, path, Cookie=cookie)
    assert status in (200, 404)
    assert "token:" not in body


def test_the_page_is_served_with_the_cookie_under_every_name_of_the_loopback(bench: Server, cookie: str) -> None:
    for name in ("127.0.0.1", "localhost", "[::1]"):
        status, body, _ = ask(bench, Host=f"{name}:{bench.port}", Cookie=cookie)
        assert (status, "<title>frictrack" in body) == (200, True)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
def test_the_token_does_not_stay_in_the_address(bench: Server, tab: Open) -> None:
    page = tab().page
    page.goto(bench.address)
    page.wait_for_url(bench.bare_address)
    page.goto(bench.bare_address)
    page.get_by_role("tab").first.wait_for()


def request(host: str, path: str = "/") -> HTTPServerRequest:
    start = RequestStartLine("GET", path, "HTTP/1.1")
    return HTTPServerRequest(start_line=start, headers=HTTPHeaders({"Host": host}))


@pytest.mark.parametrize(
    ("host", "name", "accepted"),
    [
        ("0.0.0.0", "192.168.1.5:5006", True),
        ("0.0.0.0", "[fe80::1]:5006", True),
        ("0.0.0.0", "evil.com:5006", False),
        ("0.0.0.0", "lab.example.org", True),
        ("127.0.0.1", "192.168.1.5:5006", False),
        ("127.0.0.1", "lab.example.org", True),
        ("127.0.0.1", "LOCALHOST.:5006", True),
    ],
)
def test_names_of_this_machine(host: str, name: str, accepted: bool) -> None:
    guard = RequestGuard("sesame", host, ("lab.example.org",))
    assert (guard.fault(request(name, "/?token=sesame")) == "") is accepted


def test_every_port_has_its_own_cookie() -> None:
    names = {RequestGuard("a").cookie(request(f"127.0.0.1:{port}")) for port in (5006, 5007)}
    assert len(names) == 2


def test_addresses_to_open() -> None:
    assert address_of("127.0.0.1", 5006, "a-b") == "http://127.0.0.1:5006/?token=a-b"
    assert address_of("::1", 80) == "http://[::1]:80/"


def test_a_token_is_made_where_none_is_given(tmp_path: Path) -> None:
    server = Server(tmp_path, token="").start()  # an empty variable
    try:
        assert ask(server)[0] == 403
        assert ask(server, "/?token=")[0] == 403
    finally:
        server.stop()


BROWSER = """#!/bin/sh
file="${1#file://}"
cp -p "$file" "$HOME/page"
ps -e -o args > "$HOME/commands"
echo "$1" > "$HOME/command.part" && mv "$HOME/command.part" "$HOME/command"
"""


@pytest.mark.skipif(os.name == "nt", reason="a browser that is a shell script")
def test_no_list_of_processes_shows_the_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "browser"
    script.write_text(BROWSER)
    script.chmod(0o700)
    monkeypatch.setenv("BROWSER", f"{script} %s")
    monkeypatch.setenv("HOME", str(tmp_path))
    server = Server(tmp_path, ("--browser",), token="").start()
    try:
        command = wait_for(lambda: (tmp_path / "command").exists() and (tmp_path / "command").read_text().strip())
        address = (tmp_path / "page").read_text().partition("url=")[2].partition('"')[0]
        token = address.partition("token=")[2]
        assert command.startswith("file://")
        assert stat.S_IMODE((tmp_path / "page").stat().st_mode) == 0o600
        assert len(token) >= 32
        assert token not in command + (tmp_path / "commands").read_text()
        assert address == server.bare_address + "?token=" + token
        assert ask(server, f"/?token={token}")[0] == 200
    finally:
        server.stop()


@pytest.mark.parametrize("way", ["variable", "file", "none"])
def test_the_token_is_read_from_a_file_or_the_environment(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "secret").write_text("sesame\n")
    served: dict[str, Any] = {}
    monkeypatch.setattr("frictrack.workbench.server.serve", lambda study, **more: served.update(more))
    monkeypatch.setenv("FRICTRACK_TOKEN", "sesame" if way == "variable" else "")
    words = ["--token-file", str(tmp_path / "secret")] if way == "file" else []
    with pytest.raises(SystemExit, match="0"):
        main(["app", str(tmp_path), *words])
    assert (served["token"] or None) == (None if way == "none" else "sesame")


@pytest.mark.few(1)
@pytest.mark.parametrize(("content", "said"), [(None, "cannot read"), (b"\xff", "is not a text"), (b" \n", "is empty")])
def test_a_file_without_a_token_is_one_sentence(
    content: bytes | None, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / "secret").write_bytes(content)
    with pytest.raises(SystemExit, match="2"):
        main(["app", str(tmp_path), "--no-browser", "--token-file", str(tmp_path / "secret")])
    assert said in capsys.readouterr().err
