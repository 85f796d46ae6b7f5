"""Test the diagnosis blindly: write studies of known, sealed truth, diagnose them, and count what was right.

    from frictrack.validation.blind import make, score
    make(Path("blind"), n=42)           # studies and their sealed truth
    score(Path("blind"))                # shares of effects named first, false alarms, misses, ... with intervals

A study is drawn at random and a hidden effect is scaled to a size that an ideal detector can just see
(`truth_sampling`, `ideal_detector`), its tables or films are written (`benchmark`), and each diagnosis becomes an
`Outcome`. Effects that fit as well as the hidden one (`equivalent_effects`) count as correct within a group.
"""
# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

from frictrack.validation.blind.benchmark import make, score
