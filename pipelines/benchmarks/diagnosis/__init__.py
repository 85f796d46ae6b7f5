"""Benchmark of detection limits: the smallest missing effect that frictrack, an ideal detector and others name."""

from __future__ import annotations

from diagnosis import force, ours, run, sparse, studies

__all__ = ["force", "ours", "run", "sparse", "studies"]
