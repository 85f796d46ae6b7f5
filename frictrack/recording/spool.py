"""Decode a compressed recording once, in a thread, into a store with random access."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import RawIOBase
from pathlib import Path
from threading import Condition, Thread
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.files import write_at
from frictrack.recording.base import Frame, Recording, RecordingView
from frictrack.recording.raw import BoxReader, PixelLayout, picture_bytes

KEPT_FRAMES, LOOK_BACK_FRAMES = (
    400,
    16,
)  # frames kept where each is wanted once, and how many of them may still be looked back at
MAX_MEMORY_BYTES = 512 << 20  # of decoded film; a longer film goes to a temporary file


@contextmanager
def random_access(recording: Recording, *, once: bool = False) -> Iterator[Recording]:
    """Provide random access to a recording.

    A `direct` recording is returned as it is; others are decoded once, in a thread, into memory or a temporary file.
    The
    spool's `cut`, `frame`, `frames` and `pick` wait for their frames and raise the errors of the decoder. Leaving the
    context ends the thread and frees memory and disk.

    Parameters
    ----------
    recording : Recording
        Open recording.
    once : bool
        Whether frames are read once, in their order. Then only the last few hundred are kept, if these fit into memory:
        allocating memory for a whole film costs a quarter of its decoding.

    Yields
    ------
    Recording
        Recording with random access.

    Raises
    ------
    FrictrackError
        Where the disk has no room for the decoded film.

    """
    if recording.direct:
        yield recording
        return
    spool = Spool(recording, _store(recording, once))
    try:
        yield spool
    finally:
        spool.close()


class Spool(RecordingView):
    """Decoded frames of another recording, with random access; created by `random_access`."""

    def __init__(self, source: Recording, store: _MemoryStore | _DiskStore) -> None:
        super().__init__(source)
        self._store = store
        self._passed = 0  # frames before this one will not be asked for again
        self._ready, self._done, self._stop = 0, False, False
        self._wanted = source.n_frames  # the first frame that a reader waits for
        self._fault: BaseException | None = None
        self._condition = Condition()
        self._decoder = Thread(target=self._decode, name="frictrack decoder", daemon=True)
        atexit.register(self.close)  # a thread that still decodes when Python ends would abort the process
        self._decoder.start()

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """Wait for the frames and cut boxes out of them; see `Recording.cut`."""
        indices, corners = self._boxes(indices, corners, size)
        if len(indices) and not self._wait(int(indices.max()), int(indices.min())):
            raise FrictrackError(self._breaks_off(int(indices.max())))
        return self._store.cut(indices, corners, size)

    def close(self) -> None:
        """Stop the decoder and free the memory; it may be called again."""
        atexit.unregister(self.close)
        if self._stop:
            return
        with self._condition:
            self._stop = True
            self._condition.notify_all()
        self._decoder.join()
        self._store.close()

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        corner = np.zeros((1, 2), np.int64)
        for index in indices:
            if not self._wait(index):
                return
            yield self._store.cut(np.array([index]), corner, self.shape)[0]

    def _wait(self, index: int, first: int | None = None) -> bool:
        """Wait for a frame, `first` being the first one wanted; False where the film breaks off before it."""
        first = index if first is None else first
        if self._store.kept is not None:
            if first < self._ready - self._store.kept:
                raise ValueError(f"frame {first} was given up after frame {self._ready}")
            with self._condition:
                self._passed = max(self._passed, first - LOOK_BACK_FRAMES)
                self._condition.notify_all()
        if index < self._ready:
            return True

        def is_ready() -> bool:
            self._wanted = min(self._wanted, index)
            return index < self._ready or self._done

        with self._condition:
            self._condition.wait_for(is_ready)
        if index >= self._ready and self._fault is not None:
            raise self._fault
        return index < self._ready

    def _decode(self) -> None:
        """Decode all frames; runs in the thread."""
        try:
            for i, frame in enumerate(self._source.frames()):
                if not self._wait_for_room(i):
                    break
                self._store.write(i, frame)
                self._announce(i + 1)
        except BaseException as fault:  # noqa: BLE001 - it is raised again where the frame is asked for
            self._fault = fault
        finally:
            with self._condition:
                self._done = True
                self._condition.notify_all()

    def _wait_for_room(self, i: int) -> bool:
        """Wait until frame `i` may replace an older one; False where no reader is left."""
        if self._store.kept is not None:
            kept = self._store.kept
            with self._condition:
                self._condition.wait_for(lambda: self._stop or i - kept < self._passed)
        return not self._stop

    def _announce(self, ready: int) -> None:
        """Tell readers that the frames before `ready` are decoded."""
        with self._condition:
            self._ready = ready
            if ready > self._wanted:  # a reader that is woken for every frame takes time from the decoder
                self._wanted = self._source.n_frames
                self._condition.notify_all()


class _MemoryStore:
    """Decoded frames in memory: all, or the last ones (`kept`)."""

    def __init__(self, n: int, shape: tuple[int, int], kind: Any, kept: int | None = None) -> None:
        self._frames: Frame = np.empty((kept or n, *shape), kind)
        self.kept = kept

    def write(self, i: int, frame: Frame) -> None:
        self._frames[i % len(self._frames)] = frame

    def cut(self, indices: NDArray[np.int64], corners: NDArray[np.int64], size: tuple[int, int]) -> Frame:
        out: Frame = np.empty((len(indices), *size), self._frames.dtype)
        h, w = size
        for target, i, (x, y) in zip(out, indices.tolist(), corners.tolist(), strict=True):
            target[...] = self._frames[i % len(self._frames), y : y + h, x : x + w]
        return out

    def close(self) -> None:
        self._frames = self._frames[:0].copy()


class _DiskStore:
    """Decoded frames in a temporary file."""

    kept: ClassVar[int | None] = None

    def __init__(self, n: int, shape: tuple[int, int], bits: int) -> None:
        self._frame = picture_bytes(shape, bits)
        # Not every system can unlink an open file: it has a name and is deleted in `close`.
        self._file = tempfile.NamedTemporaryFile(prefix="frictrack-", suffix=".film", buffering=0, delete=False)  # noqa: SIM115
        self._file.truncate(n * self._frame)
        path = Path(self._file.name)
        layout = PixelLayout(path, range(0, n * self._frame, self._frame), bits, "=")
        self._cutter = BoxReader(shape, layout)

    def write(self, i: int, frame: Frame) -> None:
        write_at(cast(RawIOBase, self._file), i * self._frame, np.ascontiguousarray(frame).data)

    def cut(self, indices: NDArray[np.int64], corners: NDArray[np.int64], size: tuple[int, int]) -> Frame:
        return self._cutter.cut(indices, corners, size)

    def close(self) -> None:
        del self._cutter
        self._file.close()
        Path(self._file.name).unlink(missing_ok=True)


def _store(source: Recording, once: bool = False) -> _MemoryStore | _DiskStore:
    """Choose the store by the size of the decoded film."""
    bits = 8 if source.bit_depth <= 8 else 16
    kind = np.uint8 if bits == 8 else np.uint16
    frame = picture_bytes(source.shape, bits)
    total = source.n_frames * frame
    if once and source.n_frames > KEPT_FRAMES and KEPT_FRAMES * frame <= MAX_MEMORY_BYTES:
        return _MemoryStore(source.n_frames, source.shape, kind, KEPT_FRAMES)
    if total <= MAX_MEMORY_BYTES:
        return _MemoryStore(source.n_frames, source.shape, kind)
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if total > free:
        raise FrictrackError(
            f"{source.path.name}: expected {total / 1e9:.1f} GB of room for the decoded film in "
            f"{tempfile.gettempdir()} but {free / 1e9:.1f} GB are free; make room or set TMPDIR to another disk"
        )
    return _DiskStore(source.n_frames, source.shape, bits)
