"""Many studies at once: films measured side by side, studies concluded as their films are there."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from frictrack.batch.work import Begun, Done, begin, conclude, in_words, measure, undone
from frictrack.errors import FrictrackError
from frictrack.workers import WorkerPool

LOOK = 0.5  # s between two looks at what is under way


@dataclass
class State:
    """How far a campaign is, for who watches."""

    studies: int
    kept: int = 0  # studies that were finished before
    done: list[str] = field(default_factory=list)  # studies that came to an end, failed ones too
    runs: int = 0  # of the studies that were done now
    failures: list[dict[str, str]] = field(default_factory=list)  # study, run, reason
    under_way: dict[str, float] = field(default_factory=dict)  # what is worked on, and since when
    began: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """Time since the beginning."""
        return time.monotonic() - self.began

    @property
    def left(self) -> float | None:
        """Seconds until the end, as fast as it went so far; None before the first study is done."""
        todo = self.studies - self.kept - len(self.done)
        return self.seconds * todo / len(self.done) if self.done else None


Watch = Callable[[State], None]


@dataclass
class _Case:
    """One study under way."""

    path: Path
    films: int = 0  # being measured
    failed: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Piece:
    """A piece of work on a study; of one of its films, where there is a name."""

    case: _Case
    of: Callable[..., Any]
    told: tuple[Any, ...]
    run: str = ""


class Campaign:
    """Studies, and who works on them."""

    def __init__(self, studies: Sequence[Path], seed: int, pool: WorkerPool, state: State) -> None:
        self.seed = seed
        self.pool = pool
        self.state = state
        self._later = deque(studies)
        self._next: deque[_Piece] = deque()  # what goes on comes before what begins
        self._going: dict[Future[Any], _Piece] = {}

    def worked(self, watch: Watch) -> Iterator[Done]:
        """Every study as it is done. `watch` is told a few times a second."""
        while self._fill() or self._going:
            watch(self.state)
            ended, _ = wait(self._going, timeout=LOOK, return_when=FIRST_COMPLETED)
            for future in ended:
                piece = self._going.pop(future)
                self.state.under_way.pop(_title(piece), None)
                done = self._ended(piece, future)
                if done is not None:
                    self._count(done)
                    yield done
        watch(self.state)

    def _fill(self) -> bool:
        """Give as many pieces away as there is room for; whether any is left or under way."""
        room = self.pool.capacity()
        while len(self._going) < room and (self._next or self._later):
            piece = self._next.popleft() if self._next else self._first(self._later.popleft())
            self._going[self.pool.submit(piece.of, *piece.told)] = piece
            self.state.under_way[_title(piece)] = time.monotonic()
        return bool(self._next or self._later)

    def _first(self, path: Path) -> _Piece:
        return _Piece(_Case(path), begin, (path, self.seed))

    def _ended(self, piece: _Piece, future: Future[Any]) -> Done | None:
        """What a piece of work leads to; the study, where that was its last one."""
        case = piece.case
        died = _death(future)
        if piece.of is measure:
            reason = in_words(died) if died is not None else future.result()
            case.films -= 1
            if reason is not None:
                case.failed[piece.run] = reason
            self._go_on(case)
            return None
        if died is not None:
            return undone(case.path, case.failed, in_words(died))
        found = future.result()
        if isinstance(found, Begun):
            case.failed |= found.failed
            case.films = len(found.others)
            self._next += [_Piece(case, measure, (case.path, run, dict(case.failed)), run) for run in found.others]
            self._go_on(case)
            return None
        return found if isinstance(found, Done) else None

    def _go_on(self, case: _Case) -> None:
        """Conclude a study once its films are there."""
        if case.films == 0:
            self._next.append(_Piece(case, conclude, (case.path, self.seed, dict(case.failed))))

    def _count(self, done: Done) -> None:
        self.state.done.append(done.study)
        self.state.runs += sum(1 for row in done.rows if row.get("run"))
        self.state.failures += [{"study": done.study, **failure} for failure in done.failures]


def _death(future: Future[Any]) -> BaseException | None:
    """Why a piece of work has no result; None where it has one."""
    if future.cancelled():
        return FrictrackError(
            "whoever worked on it gave it up, as a cluster does that is shut down; run the batch again"
        )
    return future.exception()


def _title(piece: _Piece) -> str:
    """A piece of work as a person reads it."""
    name = str(piece.case.path)
    return f"{name}, {piece.run}" if piece.run else name
