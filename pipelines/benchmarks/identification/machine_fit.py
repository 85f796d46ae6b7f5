"""Fit mass and friction of the EMPS with frictrack, in the displacement domain, segment by segment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

import frictrack as ft
from frictrack import effects
from frictrack.effects import Effect, models
from frictrack.effects.models import Model
from frictrack.records import Displacement, Run

from .emps import Record

UNBOUNDED = (-np.inf, np.inf)  # dry friction that rises with the speed is a Stribeck rise below zero


def filmed(record: Record) -> Run:
    """The record as frictrack takes it: what moved it, and where it was; its mass is not known."""
    nan = np.full(len(record.q), np.nan)
    seen = Displacement(record.t, record.q, nan, nan, nan, nan, np.ones(len(nan), dtype=bool))
    motion = ft.differentiate(ft.low_pass(seen, method="kalman"))
    return Run(seen, motion, mass=None, name="emps", drive=record.drive)


def timed(run: Run, late: float) -> Run:
    """The run with its drive at the time at which it acts."""
    t = run.displacement.t
    assert run.drive is not None
    return replace(run, drive=CubicSpline(t, run.drive)(t - late))


def law_of(numbers: Mapping[str, Mapping[str, float]]) -> Model:
    """A model of the library with its non-linear numbers held, its dry friction free to rise or fall with the speed."""
    return models.of([_held(effects.get(name), own) for name, own in numbers.items()])


def _held(effect: Effect, own: Mapping[str, float]) -> Effect:
    changes: dict[str, dict[str, Any]] = {name: {"fixed": value} for name, value in own.items()}
    if effect.kind == "stribeck":
        changes["F_s"] = {"bounds": UNBOUNDED}
    return effect.adjusted(**changes)


def fitted(run: Run, numbers: Mapping[str, Mapping[str, float]]) -> ft.Fit:
    """Mass and coefficients of least displacement error."""
    found: ft.Fit = ft.fit(law_of(numbers), [run])
    return found


def scored(found: ft.Fit, record: Record) -> float:
    """Relative force error (percent) of a fit in the authors' measure."""
    law, layout = found.model, found.solution.problem.layout
    values, _ = layout.values(found.solution.p, 0)
    columns = record.columns(law, values)
    coefficients = [law.coefficients(e.name, values) for e in law.effects if e.acts_on == "force"]
    return record.error(np.concatenate([[found.reference.mass], *coefficients]), columns)


def figures(found: ft.Fit) -> dict[str, Any]:
    """Parameters, their deviations, and how the record was cut."""
    stated = {k: vars(e) for k, e in found.parameters.items() if e.reason != "fixed"}
    pieces = found.solution.problem.pieces
    return {"parameters": stated, "segments": len(pieces), "segment_s": max(float(p.t[-1] - p.t[0]) for p in pieces)}
