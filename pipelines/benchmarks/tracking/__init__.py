"""Benchmark of tracking: `python pipelines/benchmarks/tracking --help`; `tracking.condition` gives its films."""

from .conditions import CONDITIONS, NUISANCES, Condition, condition

__all__ = ["CONDITIONS", "NUISANCES", "Condition", "condition"]
