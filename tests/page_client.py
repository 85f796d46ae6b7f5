"""A tab of the page without a browser: requests with the cookie, and the messages of the server."""

from __future__ import annotations

import asyncio
import http.client
import json
import time
from collections.abc import Callable
from typing import Any, TypeVar
from urllib.parse import urlencode

from browser import LIMIT_S, Server
from tornado.httpclient import HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

T = TypeVar("T")


class Client:
    """Requests to a server, and its messages through one WebSocket that is opened when it is first needed."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.cookie = self.ask("GET", f"/?token={server.token}")[1]["Set-Cookie"].split(";")[0]
        self.messages: list[dict[str, Any]] = []
        self._loop = asyncio.new_event_loop()
        self._socket: WebSocketClientConnection | None = None
        self._wanted: asyncio.Future[str | bytes | None] | None = None  # the next message

    def ask(self, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, Any, bytes]:
        """Status, headers and body of the answer to one request."""
        link = http.client.HTTPConnection("127.0.0.1", self.server.port, timeout=LIMIT_S)
        try:
            held = {"Cookie": self.cookie} if hasattr(self, "cookie") else {}
            link.request(method, path, body, {**held, **headers})
            answer = link.getresponse()
            return answer.status, answer.headers, answer.read()
        finally:
            link.close()

    def get(self, path: str, **query: Any) -> tuple[int, Any]:
        """Status and content of an answer: JSON, or bytes."""
        status, headers, body = self.ask("GET", f"{path}?{urlencode(query)}" if query else path)
        return status, json.loads(body) if headers["Content-Type"].startswith("application/json") else body

    def post(self, path: str, **told: Any) -> tuple[int, Any]:
        """Status and JSON of the answer to a command."""
        status, _, body = self.ask("POST", path, json.dumps(told).encode())
        return status, json.loads(body)

    def change(self, do: str, **arguments: Any) -> tuple[int, Any]:
        """Make a quick change at the revision of now."""
        return self.post("/api/do", do=do, arguments=arguments, seen=self.state["revision"])

    def work(self, do: str, **arguments: Any) -> tuple[int, Any]:
        """Start a job at the revision of now."""
        return self.post("/api/job", do=do, arguments=arguments, seen=self.state["revision"])

    @property
    def state(self) -> dict[str, Any]:
        status, found = self.get("/api/state")
        assert status == 200, found
        return found

    def listen(self) -> Client:
        """Open the WebSocket."""

        async def connect() -> WebSocketClientConnection:
            own = f"127.0.0.1:{self.server.port}"
            headers = {"Cookie": self.cookie, "Origin": f"http://{own}"}
            return await websocket_connect(HTTPRequest(f"ws://{own}/api/events", headers=headers))

        self._socket = self._loop.run_until_complete(connect())
        return self

    def send(self, message: str) -> None:
        assert self._socket is not None

        async def write() -> None:
            assert self._socket is not None
            await self._socket.write_message(message)

        self._loop.run_until_complete(write())

    async def _read(self, within: float) -> str | bytes | None:
        assert self._socket is not None
        if self._wanted is None:
            self._wanted = asyncio.ensure_future(self._socket.read_message())
        text = await asyncio.wait_for(asyncio.shield(self._wanted), within)
        self._wanted = None
        return text

    def hear(self, true: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """Wait for a message of which something holds; it may have come already."""
        assert self._socket is not None
        until = time.monotonic() + LIMIT_S
        at = 0
        while True:
            for message in self.messages[at:]:
                if true(message):
                    return message
            at = len(self.messages)
            left = until - time.monotonic()
            assert left > 0, f"no such message among {[m['type'] for m in self.messages]}"
            try:
                text = self._loop.run_until_complete(self._read(left))
            except TimeoutError:
                continue
            assert text is not None, "the server closed the connection"
            self.messages.append(json.loads(text))

    def hear_state(self, true: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
        """Wait for a state of which something holds."""
        return self.hear(lambda m: m["type"] == "state" and true(m["state"]))["state"]

    def hear_end(self) -> dict[str, Any]:
        """Wait until the running job has ended; return it."""
        return self.hear(lambda m: m["type"] == "job" and m["job"] is None and m["last_job"])["last_job"]

    def close(self) -> None:
        async def end() -> None:
            if self._socket is not None:
                self._socket.close()
            if self._wanted is not None:
                self._wanted.cancel()
            await asyncio.sleep(0.05)

        if self._socket is not None or self._wanted is not None:  # one that never listened ends beside a browser, too
            self._loop.run_until_complete(end())
        self._loop.close()


def wait_for(true: Callable[[], T]) -> T:
    """Wait until something holds, and return it."""
    until = time.monotonic() + LIMIT_S
    while not (value := true()):
        assert time.monotonic() < until
        time.sleep(0.02)
    return value
