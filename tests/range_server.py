"""A web server that sends parts of files and counts them, as object storage does."""

from __future__ import annotations

import hashlib
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


class RangeServer(ThreadingHTTPServer):
    """Serves a folder; `sent` counts the bytes of content, `requests` those for content."""

    daemon_threads = True

    def __init__(self, folder: Path, *, etags: bool = True) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.folder, self.etags = folder, etags
        self.sent, self.requests, self.cut_short = 0, 0, False
        self.lock = threading.Lock()

    def url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.server_port}/{name}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: RangeServer

    def do_HEAD(self) -> None:
        self._answer(send=False)

    def do_GET(self) -> None:
        self._answer(send=True)

    def _answer(self, *, send: bool) -> None:
        path = self.server.folder / self.path.lstrip("/")
        if not path.is_file():
            self.send_response(404)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        size, start = path.stat().st_size, 0
        stop = size
        part = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if part:
            start, stop = int(part[1]), min(size, int(part[2]) + 1)
        if self.server.cut_short and send:
            stop -= 1
        self.send_response(206 if part else 200)
        if part:
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        self.send_header("Content-Length", str(stop - start))
        self.send_header("Accept-Ranges", "bytes")
        if self.server.etags:
            self.send_header("ETag", f'"{_md5(path, path.stat().st_mtime_ns)}"')
        self.end_headers()
        if send:
            with path.open("rb") as file:
                file.seek(start)
                self.wfile.write(file.read(stop - start))
            with self.server.lock:
                self.server.sent += stop - start
                self.server.requests += 1

    def log_message(self, *args: object) -> None:
        pass


@cache
def _md5(path: Path, changed: int) -> str:
    return hashlib.md5(path.read_bytes()).hexdigest()


@contextmanager
def serving(folder: Path, *, etags: bool = True) -> Iterator[RangeServer]:
    """Serve a folder while the block runs."""
    server = RangeServer(folder, etags=etags)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
