"""Decode a compressed recording once, in a thread, into a store with random access."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from threading import Condition, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Frame, Recording, RecordingView

KEPT_FRAMES, LOOK_BACK_FRAMES = 400, 16  # frames kept where each is wanted once, and those that may be looked back at
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
    spool = Spool(recording, _room_for(recording, once))
    try:
        yield spool
    finally:
        spool.close()


class Spool(RecordingView):
    """Decoded frames of another recording, with random access; created by `random_access`."""

    def __init__(self, source: Recording, decoded: Frame) -> None:
        super().__init__(source)
        self._decoded = decoded  # (m, h, w): frame i is at i modulo m
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
        out: Frame = np.empty((len(indices), *size), self._decoded.dtype)
        for target, i, (x, y) in zip(out, indices.tolist(), corners.tolist(), strict=True):
            target[...] = self._decoded[i % len(self._decoded), y : y + size[0], x : x + size[1]]
        return out

    def close(self) -> None:
        """Stop the decoder and free the memory; it may be called again."""
        atexit.unregister(self.close)
        if self._stop:
            return
        with self._condition:
            self._stop = True
            self._condition.notify_all()
        self._decoder.join()
        self._decoded = self._decoded[:0].copy()  # which also deletes a temporary file

    @property
    def _rolls(self) -> bool:
        """Whether only the last frames are kept."""
        return 0 < len(self._decoded) < self.n_frames

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        for index in indices:
            if not self._wait(index):
                return
            yield np.array(self._decoded[index % len(self._decoded)])

    def _wait(self, index: int, first: int | None = None) -> bool:
        """Wait for a frame, `first` being the first one wanted; False where the film breaks off before it."""
        first = index if first is None else first
        if self._rolls:
            if first < self._ready - len(self._decoded):
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
                self._decoded[i % len(self._decoded)] = frame
                self._announce(i + 1)
        except BaseException as fault:  # noqa: BLE001 - it is raised again where the frame is asked for
            self._fault = fault
        finally:
            with self._condition:
                self._done = True
                self._condition.notify_all()

    def _wait_for_room(self, i: int) -> bool:
        """Wait until frame `i` may replace an older one; False where no reader is left."""
        if self._rolls:
            kept = len(self._decoded)
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


def _room_for(source: Recording, once: bool) -> Frame:
    """Room for the decoded frames: for all, or for the last ones; in memory, or for a long film in a temporary file."""
    kind = np.dtype(np.uint8 if source.bit_depth <= 8 else np.uint16)
    frame = source.shape[0] * source.shape[1] * kind.itemsize
    rolls = once and source.n_frames > KEPT_FRAMES and KEPT_FRAMES * frame <= MAX_MEMORY_BYTES
    shape = (KEPT_FRAMES if rolls else source.n_frames, *source.shape)
    if shape[0] * frame <= MAX_MEMORY_BYTES:
        return np.empty(shape, kind)
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if shape[0] * frame > free:
        raise FrictrackError(
            f"{source.path.name}: expected {shape[0] * frame / 1e9:.1f} GB of room for the decoded film in "
            f"{tempfile.gettempdir()} but {free / 1e9:.1f} GB are free; make room or set TMPDIR to another disk"
        )
    with tempfile.TemporaryFile(prefix="frictrack-", suffix=".film") as file:
        return np.memmap(file, kind, "w+", shape=shape)
