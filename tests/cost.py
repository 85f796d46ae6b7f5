"""What a piece of work costs, in loops of this process: a slow or busy machine says the same."""

from __future__ import annotations

import gc
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def within(loops: float) -> Iterator[None]:
    """The work takes at most the CPU time of so many loops of 10^6 steps (about 0.02 s each)."""
    gc.disable()  # the garbage of other tests is not its own
    try:
        start = time.thread_time()
        yield
        end = time.thread_time()
        sum(i for i in range(1_000_000))
        assert end - start < loops * (time.thread_time() - end)
    finally:
        gc.enable()
