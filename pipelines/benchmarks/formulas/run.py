"""Diagnose sealed studies and score the formulas: right first, right in a stated group, values, time, calibration."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

import frictrack as ft
from formulas.causes import CAUSES, normalised
from formulas.comparison import compared
from formulas.studies import Sealed, draw
from frictrack.diagnose.formulas import FormulaSearch, unexplained_force
from frictrack.effects import definitions, read_settings

LAW = ["coulomb", "viscous"]
MAX_DEVIATIONS = 3.0
SAME_EFFECT = {  # effects of the library that are a cause
    "logarithm of speed": "log_velocity",
    "decay with speed": "stribeck",
    "fraction of speed": "flash_weakening",
}
BINS = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


def hidden_study(seed: int, *, full: bool, gplearn: str | None = None) -> dict[str, Any]:
    """Score one study with a cause; `full` diagnoses it, else formulas are searched in the residual of the fit.

    `gplearn` is a Python interpreter that has gplearn, which then searches as long in the same residual.
    """
    names = list(CAUSES)
    sealed = draw(seed, names[seed % len(names)])
    fit = ft.fit(LAW, sealed.runs)
    begin = time.process_time()
    verdict, missing, stated = "", [], {}
    if full:
        found = ft.diagnose(fit)
        verdict, missing, left = found.verdict, found.missing, found.unexplained
        stated = _stated(sealed, found)
    else:
        left = unexplained_force(FormulaSearch.of(fit.solution)).summary
    seconds = time.process_time() - begin
    formulas = (left or {}).get("formulas") or []
    return {
        "seed": seed,
        "cause": sealed.name,
        "values": sealed.values,
        "verdict": verdict,
        "missing": missing,
        "cpu_s": seconds,
        **({} if gplearn is None else {"compared": compared(sealed, fit, formulas, seconds, gplearn)}),
        **_judged(sealed, formulas),
        **stated,
        **(_values(sealed, fit, formulas[0]) if formulas and _is_right(sealed, formulas[0]) else {}),
        "formulas": [
            {k: f.get(k) for k in ("formula", "probability", "delta_bic", "equivalents")}
            | {"right": _is_right(sealed, f)}
            for f in formulas
        ],
    }


def _stated(sealed: Sealed, found: ft.Diagnosis) -> dict[str, Any]:
    """Whether the diagnosis states the right form, also as an effect of the library, or a wrong one without doubt."""
    effects = {
        *found.missing,
        *(r for c in found.candidates if c.effect in found.missing for r in c.indistinguishable_from),
    }
    left = found.unexplained or {}
    shown = left.get("formulas", []) if found.verdict == "unexplained" or left.get("rival") else []
    right = SAME_EFFECT.get(sealed.name) in effects or _judged(sealed, shown)["group"]
    return {"stated": right, "wrong_without_doubt": found.verdict == "missing" and not right}


def _is_right(sealed: Sealed, formula: dict[str, Any]) -> bool:
    return _is_form(sealed, formula["form"])


def _is_form(sealed: Sealed, form: str) -> bool:
    return normalised(form) == normalised(CAUSES[sealed.name].text)


def _judged(sealed: Sealed, formulas: Sequence[dict[str, Any]]) -> dict[str, Any]:
    right = [f["formula"] for f in formulas if _is_right(sealed, f)]
    first = bool(formulas) and formulas[0]["formula"] in right
    group = first or (bool(formulas) and any(_is_form(sealed, one) for one in formulas[0]["equivalents"]))
    size = 1 + len(formulas[0]["equivalents"]) if formulas else 0
    return {"first": first, "group": group, "listed": bool(right), "group_size": size}


def _values(sealed: Sealed, fit: Any, formula: dict[str, Any]) -> dict[str, Any]:
    """Deviation of the largest value from the truth, in standard deviations, after the formula was added and fitted."""
    (effect,) = definitions([read_settings(table) for table in tomllib.loads(formula["toml"])["effect"]])
    try:
        estimates = ft.fit(fit.model + effect, fit.runs).estimates.parameters
    except ft.FrictrackError as e:
        return {"deviations": None, "why": str(e)}
    own = {name.split(".", 1)[1]: e for name, e in estimates.items() if name.startswith("unexplained.")}
    scale = {"F": 1.0}
    if "mass" in CAUSES[sealed.name].text:
        scale["F"] = float(fit.runs[0].mass)  # load^2 = L mass over the mass of the reference
    own = {q: e for q, e in own.items() if e.value is not None and e.std}  # what the runs determine
    away = {q: (e.value * scale.get(q, 1.0) - sealed.values[q]) / (e.std * scale.get(q, 1.0)) for q, e in own.items()}
    worst = max((abs(z) for z in away.values()), default=float("inf"))
    return {"deviations": away, "within": bool(worst < MAX_DEVIATIONS)}


def empty_study(seed: int) -> dict[str, Any]:
    """Score one study without a cause: no effect and no formula may be stated."""
    fit = ft.fit(LAW, draw(seed, None).runs)
    begin = time.process_time()
    found = ft.diagnose(fit)
    formulas = (found.unexplained or {}).get("formulas") or []
    return {
        "seed": seed,
        "verdict": found.verdict,
        "effects": len(found.missing),
        "formulas": len(formulas),
        "cpu_s": time.process_time() - begin,
    }


def score(hidden: list[dict[str, Any]], empty: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all studies."""
    n = max(len(hidden), 1)
    valued = [one for one in hidden if "within" in one]
    return {
        "hidden": len(hidden),
        "first": sum(one["first"] for one in hidden) / n,
        "first_or_group": sum(one["group"] for one in hidden) / n,
        "stated": sum(one.get("stated", one["group"]) for one in hidden) / n,
        "wrong_without_doubt": sum(one.get("wrong_without_doubt", False) for one in hidden),
        "listed": sum(one["listed"] for one in hidden) / n,
        "group_size_median": float(np.median([one["group_size"] for one in hidden])) if hidden else None,
        "without_formula": sum(not one["formulas"] for one in hidden) / n,
        "values_within_3": f"{sum(one['within'] for one in valued)} of {len(valued)}",
        "cpu_s_median": float(np.median([one["cpu_s"] for one in hidden])) if hidden else None,
        "cpu_s_max": max((one["cpu_s"] for one in hidden), default=None),
        **_compared_score(hidden),
        "first_stated": sum(one["formulas"][0]["probability"] for one in hidden if one["formulas"]) / n,
        "calibration_first": calibration(hidden, first=True),
        "calibration": calibration(hidden),
        "empty": len(empty),
        "empty_with_formula": sum(one["formulas"] > 0 for one in empty),
        "empty_with_effect": sum(one["effects"] > 0 for one in empty),
    }


def _compared_score(hidden: list[dict[str, Any]]) -> dict[str, Any]:
    """Share of studies in which each search has the right form and the right force along the runs."""
    both = [one["compared"] for one in hidden if "compared" in one]
    return {
        f"{tool}_{key}": f"{sum(bool(one.get(tool, {}).get(key)) for one in both)} of {len(both)}"
        for tool in ("frictrack", "gplearn")
        for key in ("form", "values")
        if both
    }


def calibration(hidden: list[dict[str, Any]], *, first: bool = False) -> list[dict[str, Any]]:
    """Of all formulas stated with a probability, or of the first ones, the share that is right, by probability."""
    stated = [
        (f["probability"], f["right"])
        for one in hidden
        for f in one["formulas"][: 1 if first else None]
        if f["probability"] is not None
    ]
    out = []
    for low, high in pairwise(BINS):
        inside = [(p, right) for p, right in stated if low <= p < high or (p == high == 1)]
        if inside:
            mean, share = np.mean(inside, axis=0)
            out.append({"from": low, "to": high, "n": len(inside), "stated": float(mean), "right": float(share)})
    return out


def overview(result: dict[str, Any]) -> str:
    """The figures as lines of text."""
    tables = {"calibration_first": "calibration of the first formula", "calibration": "calibration of all formulas"}
    lines = [f"{key}: {value:.3g}" if isinstance(value, float) else f"{key}: {value}"
             for key, value in result.items() if key not in tables]  # fmt: skip
    for key, title in tables.items():
        lines.append(f"{title}:")
        for row in result[key]:
            where = f"({row['from']:g} to {row['to']:g})"
            lines.append(f"  stated {row['stated']:.2f} {where}: right {row['right']:.2f} of {row['n']}")
    return "\n".join(lines)


def all_studies(
    n: int, n_empty: int, seed: int, tell: Callable[[str], None], *, full: bool, gplearn: str | None = None
) -> dict[str, Any]:
    """Score `n` studies with a cause and `n_empty` without; one line for each is told."""
    hidden, empty = [], []
    for k in range(seed, seed + n):
        hidden.append(one := hidden_study(k, full=full, gplearn=gplearn))
        mark = "first" if one["first"] else "group" if one["group"] else "listed" if one["listed"] else "no"
        first = one["formulas"][0] if one["formulas"] else {"formula": "-", "probability": None}
        mark = f"{mark} of {one['group_size']}"
        tell(
            f"{k} {one['cause']}: {mark}; {one['verdict']} {'+'.join(one['missing'])}; {first['formula']}"
            f" p={first['probability']}; {one['cpu_s']:.1f} s; within {one.get('within')}"
        )
    for k in range(seed, seed + n_empty):
        empty.append(one := empty_study(k))
        tell(
            f"{k} nothing: {one['verdict']}, {one['formulas']} formulas, {one['effects']} effects, {one['cpu_s']:.1f} s"
        )
    return {"score": score(hidden, empty), "hidden": hidden, "empty": empty}
