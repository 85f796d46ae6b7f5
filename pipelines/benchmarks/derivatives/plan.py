"""The plan of a benchmark: signals, methods, noise levels and repeats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Plan(NamedTuple):
    """Settings of one run of the benchmark."""

    signals: Sequence[str]
    noises: Sequence[float]  # m
    seeds: int = 8
    words: Sequence[str] = ()  # methods are those whose name contains one of these, all without
    python: str | None = None  # of the environment with the peers; none without
    peer_seeds: int = 1
    peer_seconds: int = 45  # CPU time that one peer may take for one record, both passes

    def wants(self, title: str) -> bool:
        return not self.words or any(word.lower() in title.lower() for word in self.words)
