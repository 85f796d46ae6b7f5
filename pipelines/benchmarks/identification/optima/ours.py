"""Run frictrack on the problems: variable projection, and the papers' searches over all or non-linear parameters."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np

from frictrack.effects import Path, Span, models
from frictrack.fit.global_search import PopulationMisfit, ReducedPopulationMisfit, search_settings
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.separable.common_amplitudes import ConstrainedVariableProjection, variable_projection
from frictrack.fit.separable.model import DataBlock, SeparableModel
from frictrack.fit.separable.varpro import VariableProjection
from frictrack.search import minimise

from .problems import FPS, NOISE, PROBLEMS, Array, Case, T, V, X

PATH = Path(t=T, x=X, v=V, s=np.ones(len(T)))
SPAN = Span(duration=float(T[-1]), x_min=0.0, x_max=float(X[-1]), v_min=float(V.min()), v_max=float(V.max()), fps=FPS)
FREQUENCY_RANGE_HZ = {"atm1": (5.0, 400.0), "atm2": (0.0, 200.0)}  # Hz


@cache
def layout(name: str) -> ParameterLayout:
    """The unknowns of a problem, within the box that every optimiser gets."""
    kind = PROBLEMS[name].model.split(":")[0]
    made = []
    for e in models.parse(PROBLEMS[name].model).effects:
        bounds: dict[str, Any] = {p.name: {"bounds": FREQUENCY_RANGE_HZ[kind]} for p in e.parameters if p.unit == "Hz"}
        bounds |= {p.name: {"bounds": (0.05, 3.0)} for p in e.parameters if p.name == "v_s"}
        made.append(e.adjusted(**bounds))
    return ParameterLayout(models.Model(tuple(made)), ("run",), (SPAN,))


def _block(friction: Array) -> DataBlock:
    """A friction series (n,), N, as data; forces map to it directly."""
    return DataBlock(0, PATH, friction / NOISE, lambda rows: rows / NOISE, np.zeros_like, friction)


@cache
def _search(name: str) -> VariableProjection | ConstrainedVariableProjection:
    return variable_projection(SeparableModel(layout(name), [_block(np.zeros(len(T)))]))


def varpro(name: str, case: Case, *, cold: bool = False) -> dict[str, Any]:
    """The default search; its tables belong to the slide and are kept unless `cold`."""
    if cold:
        _search.cache_clear()
    start = time.process_time()
    sse = _search(name)(case.data).misfit
    seconds = time.process_time() - start
    return {"sse": sse * NOISE**2, "seconds": seconds, "evaluations": 0}


def papers(name: str, case: Case, method: str, over: str, budget: int, **settings: Any) -> dict[str, Any]:
    """A global search over "all" parameters or the "nonlinear" ones until it succeeds or its budget is spent."""
    block = _block(case.data)
    misfit: PopulationMisfit | ReducedPopulationMisfit = (
        ReducedPopulationMisfit if over == "nonlinear" else PopulationMisfit
    )(layout(name), [block])
    box = _box(name, misfit)
    start = time.process_time()
    found = minimise(
        misfit,
        box,
        method=method,
        rng=np.random.default_rng(case.seed),
        max_evaluations=budget,
        callback=lambda _, __, best: best <= case.target,
        **(search_settings(method, len(box)) if over == "nonlinear" else {}) | settings,
    )
    seconds = time.process_time() - start
    return {"sse": found.cost, "seconds": seconds, "evaluations": found.evaluations}


def _box(name: str, misfit: PopulationMisfit | ReducedPopulationMisfit) -> Array:
    """The same box as the others': F_s is counted from F_c here."""
    law = layout(name)
    limits = {"F_c": (0, 40), "F_s": (0, 40), "F_v": (0, 20), "f_c": (0, 40), "f_s": (0, 80), "f_v": (0, 20)}
    out = []
    for slot in (law.slots[i] for i in misfit.searched):
        if slot.linear:
            out.append(limits.get(slot.parameter, (0, 20)))
        else:
            out.append(slot.bounds if np.isfinite(slot.bounds[0]) else (-np.pi, np.pi))
    return np.array(out, dtype=float)


def per_evaluation(name: str, population: int = 40) -> dict[str, float]:
    """CPU microseconds per law of a population: bare numpy, full space, non-linear parameters alone."""
    law, rng, case = PROBLEMS[name], np.random.default_rng(0), _case(name)
    low, high = law.box.T
    block = _block(case.data)
    out = {"bare": _timed(case.sse, low + (high - low) * rng.random((population, len(low))))}
    for over, misfit in (
        ("all", PopulationMisfit(layout(name), [block])),
        ("nonlinear", ReducedPopulationMisfit(layout(name), [block])),
    ):
        low, high = _box(name, misfit).T
        out[over] = _timed(misfit, low + (high - low) * rng.random((population, len(low))))
    return out


def _case(name: str) -> Case:
    from .problems import case  # noqa: PLC0415 - named like what it makes

    return case(name, 0)


def _timed(cost: Any, points: Array, repeats: int = 40) -> float:
    cost(points)
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        cost(points)
        best = min(best, time.process_time() - start)
    return 1e6 * best / len(points)
