"""Store uploaded recordings in the folder of the study, in parts as they arrive."""

from __future__ import annotations

import asyncio
import filecmp
import re
import shutil
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import BinaryIO

from tornado.web import stream_request_body

from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.files import atomic_write
from frictrack.workbench import OutdatedError
from frictrack.workbench.handlers import Api

MAX_UPLOAD_BYTES = 2_000_000_000  # larger recordings are to be copied into the folder
MAX_NAME_BYTES = 200  # file systems allow 255
WRITE_BYTES = 1_000_000  # that are collected before they are written


class UploadFile:
    """A file that arrives in parts. It appears under its name when it is complete, or not at all.

    Parameters
    ----------
    folder : Path
        Folder of the study.
    name : str
        Name that the browser sent. Only its last part is used, so that the file stays in the folder.

    Raises
    ------
    FrictrackError
        If it is no valid file name.

    """

    def __init__(self, folder: Path, name: str) -> None:
        self.path = folder / stored_name(name)
        if self.path.is_symlink() or self.path.is_dir():
            raise FrictrackError(f'expected the file name of a recording but got "{name}"')
        self._stack = ExitStack()
        self._part = self._stack.enter_context(atomic_write(self.path))
        self._file: BinaryIO = self._part.open("wb")

    def write(self, part: bytes) -> None:
        """Write the next part."""
        self._file.write(part)

    def commit(self) -> str:
        """Give the complete file its name; return the name.

        Raises
        ------
        OutdatedError
            If another file of that name exists.

        """
        self._file.close()
        if self.path.exists():
            same = filecmp.cmp(self._part, self.path, shallow=False)
            self.discard()
            if not same:
                raise OutdatedError(f"{self.path.name} exists with different content; rename one of the files")
            return self.path.name
        self._stack.close()
        return self.path.name

    def discard(self) -> None:
        """Remove what has arrived."""
        self._file.close()
        error = InterruptedError("the upload was not completed")
        with suppress(InterruptedError, FrictrackError):
            self._stack.__exit__(InterruptedError, error, None)


def stored_name(name: str) -> str:
    r"""Name under which an uploaded file is stored.

    Parameters
    ----------
    name : str
        Name that the browser sent.

    Raises
    ------
    FrictrackError
        If it is no valid file name.

    Examples
    --------
    >>> stored_name("C:\\films\\fast.avi")
    'fast.avi'

    """
    last = Path(name.replace("\\", "/")).name
    fits = last.isprintable() and len(last.encode(errors="replace")) <= MAX_NAME_BYTES and not last.startswith(".")
    if not last or not fits:
        raise FrictrackError(f'expected the file name of a recording but got "{name}"')
    return last


@stream_request_body
class UploadHandler(Api):
    """A recording that is dropped on the page; it is written to the disk while it arrives."""

    async def prepare(self) -> None:
        """Check name and size before the first part."""
        self.file: UploadFile | None = None
        self._parts: list[bytes] = []
        self._held = 0
        if self.request.method != "POST":
            return
        self.request.connection.set_max_body_size(MAX_UPLOAD_BYTES + 1)  # type: ignore[union-attr]
        folder, length = self.live.path.parent, self.request.headers.get("Content-Length", "0")
        if not re.fullmatch(r"[0-9]{1,18}", length):
            raise UsageError(f'expected the number of bytes as Content-Length but got "{length[:40]}"')
        size = int(length)
        free = await asyncio.to_thread(lambda: shutil.disk_usage(folder).free)
        name = stored_name(self.get_query_argument("name", ""))
        if size > MAX_UPLOAD_BYTES:
            raise FrictrackError(f"{name} is larger than 2 GB; copy it into {folder} instead")
        if size > free:
            raise FrictrackError(
                f"{name} needs {size / 1e6:.0f} MB but the disk of {folder} has {free / 1e6:.0f} MB free"
            )
        self.file = await asyncio.to_thread(UploadFile, folder, name)

    async def data_received(self, chunk: bytes) -> None:
        """Write the next part; the connection waits for the disk."""
        self._parts.append(chunk)
        self._held += len(chunk)
        if self._held >= WRITE_BYTES:
            await self._flush()

    async def _flush(self) -> None:
        part, self._parts, self._held = b"".join(self._parts), [], 0
        if self.file is not None and part:
            await asyncio.to_thread(self.file.write, part)

    async def post(self) -> None:
        """Answer with the name of the stored file."""
        assert self.file is not None
        await self._flush()
        file, self.file = self.file, None
        name = await asyncio.to_thread(file.commit)
        self.live.look_now()
        self.answer({"name": name})

    def on_connection_close(self) -> None:
        """Remove what has arrived of a file that will not be completed."""
        self.on_finish()

    def on_finish(self) -> None:
        """Remove what has arrived if an error ended the request."""
        file, self.file = getattr(self, "file", None), None
        if file is not None:
            file.discard()
