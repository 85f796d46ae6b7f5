"""Benchmark of differentiation: `python pipelines/benchmarks/derivatives --help`; `from derivatives import signal`."""

from .signals import SIGNALS, Signal, signal

__all__ = ["SIGNALS", "Signal", "signal"]
