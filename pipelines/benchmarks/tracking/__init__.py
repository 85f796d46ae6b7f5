"""Tracking benchmark: `python pipelines/benchmarks/tracking --help`; `from tracking import condition` for its films."""

from .conditions import CONDITIONS, NUISANCES, Condition, condition

__all__ = ["CONDITIONS", "NUISANCES", "Condition", "condition"]
