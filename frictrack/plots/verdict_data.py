"""Select what the figure of a verdict shows: the model that fails, what repairs it, and the axis that matters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from frictrack.plots.held_out import MAX_STEPS_NAMED, HeldOutError, errors_of_models
from frictrack.plots.inputs import AnyModel, as_model
from frictrack.plots.model import noise_um, residual_unit, residuals
from frictrack.plots.style import joined_name, plain_name
from frictrack.records import Array
from frictrack.results import ModelResults, Results

DRAWN_AXES = ("x", "v", "t")
REJECTED = ("missing", "ambiguous", "unexplained")
Figures = Mapping[str, Mapping[str, Array]]


class DiagnosisLike(Protocol):
    """A diagnosis: its JSON, and its curves."""

    figures: dict[str, dict[str, Array]]

    def summary(self) -> dict[str, Any]:
        """Return the JSON."""
        ...


@dataclass(frozen=True)
class Residuals:
    """Residual of one model along the motion of all runs.

    Attributes
    ----------
    name : str
        The model, or what was added to it.
    along : dict of Array
        Run (index), time since release s, position m and speed m/s, all (n,), by "run", "t", "x" and "v".
    values, sigma : Array
        (n,) residual and its noise, um or N.
    force : Array or None
        (n,) force that the added effects exert against the motion, N.
    quoted : float or None
        Root mean square of the fit, um or N; the drawn values are thinned out.

    """

    name: str
    along: Mapping[str, Array]
    values: Array
    sigma: Array
    force: Array | None = None
    quoted: float | None = None

    @property
    def rms(self) -> float:
        """Root mean square, um or N."""
        return float(np.sqrt(np.mean(self.values**2))) if self.quoted is None else self.quoted

    def of_runs(self, runs: Array) -> Residuals:
        """Return the rows of some runs."""
        rows = np.isin(self.along["run"], runs)
        along = {name: self.along[name][rows] for name in ("run", *DRAWN_AXES)}
        return replace(self, along=along, values=self.values[rows], sigma=self.sigma[rows], force=None)


@dataclass(frozen=True)
class VerdictData:
    """What the figure of a verdict shows.

    Attributes
    ----------
    name : str
        The model that was diagnosed.
    diagnosis : mapping
        Its diagnosis as JSON; empty before one was made.
    figures : mapping
        Curves of the diagnosis.
    before, after : Residuals or None
        Residuals of the model, and with what it lacked.
    errors : list of HeldOutError
        Held-out errors in the order in which models were tried.
    noise : float or None
        Noise of a frame, um or N.
    unit : str
        Unit of residuals and errors, "µm" or "N".

    """

    name: str
    diagnosis: Mapping[str, Any]
    figures: Figures
    before: Residuals | None
    after: Residuals | None
    errors: list[HeldOutError]
    noise: float | None
    unit: str

    @property
    def axis(self) -> str:
        """The axis that matters: the one over which the misfit repeats, wholly or mostly, "x", "v" or "t"."""
        for repeat in self.diagnosis.get("repeats") or []:
            if (repeat["holds"] or repeat.get("mostly")) and repeat["axis"] in DRAWN_AXES:
                return str(repeat["axis"])
        return "t" if self.fails else "v"

    @property
    def fails(self) -> bool:
        """Whether the diagnosis rejects the model."""
        return self.diagnosis.get("verdict") in REJECTED


def failed_model(results: Results) -> ModelResults | None:
    """Select the model whose failure the report shows first.

    Parameters
    ----------
    results : Results
        The study.

    Returns
    -------
    ModelResults or None
        The current model if it was rejected, else the first rejected one that it extends; None if there is none.

    """
    current = results.current
    if current is None or is_rejected(current.diagnosis):
        return current
    own = set(current.summary["model"])
    return next((m for m in results.models if is_rejected(m.diagnosis) and set(m.summary["model"]) < own), None)


def is_rejected(diagnosis: Mapping[str, Any] | None) -> bool:
    """Whether a diagnosis says that a model lacks something.

    Parameters
    ----------
    diagnosis : mapping or None
        The JSON of a diagnosis; None before one was made.

    Examples
    --------
    >>> is_rejected({"verdict": "missing"}), is_rejected({"verdict": "complete"}), is_rejected(None)
    (True, False, False)

    """
    return bool(diagnosis) and diagnosis is not None and diagnosis["verdict"] in REJECTED


def data_of_study(results: Results) -> VerdictData:
    """Select the data of a study: the model that failed, the current one, and all models tried."""
    current = results.current
    if current is None:
        raise ValueError("expected a study with a fitted model but got none")
    shown = failed_model(results) or current
    diagnosis, unit = shown.diagnosis or {}, residual_unit(current)
    figures = shown.figures if diagnosis else {}
    before = _stored(figures, plain_name(shown.name), unit)
    before = _of_model(shown, results, figures) if before is None else replace(before, quoted=_rms(shown, unit))
    after = None if shown is current else _of_model(current, results, figures, shown)
    errors = errors_of_models(results.models, unit)
    tried = _errors_tried(diagnosis, unit) if shown is current else []
    if tried and errors:  # the errors of a diagnosis are compared with each other: frames may be held out differently
        errors = [*errors[:-1], replace(tried[0], label=errors[-1].label), *tried[1:]]
    return VerdictData(
        plain_name(shown.name), diagnosis, figures, before, after or _tried(figures, diagnosis, unit), errors,
        noise_um(current) if unit == "µm" else diagnosis.get("noise_N"), unit,
    )  # fmt: skip


def _rms(model: ModelResults, unit: str) -> float | None:
    found: float | None = model.summary["errors"].get("rms_displacement_um" if unit == "µm" else "rms_N")
    return found


def data_of_diagnosis(found: DiagnosisLike, better: AnyModel | None = None) -> VerdictData:
    """Select the data of a diagnosis, and of a later fit if there is one."""
    diagnosis, figures = found.summary(), found.figures
    unit = "N" if diagnosis.get("noise_N") is not None else "µm"
    name = joined_name(diagnosis["model"])
    errors = _errors_tried(diagnosis, unit)
    after = _tried(figures, diagnosis, unit)
    if better is not None:
        later = as_model(better)
        errors = [*errors[:1], *errors_of_models([later], unit)]
        after = _residuals_of(later, {}, figures, _added(diagnosis["model"], later))
    noise = diagnosis["noise_um"] if unit == "µm" else diagnosis["noise_N"]
    return VerdictData(name, diagnosis, figures, _stored(figures, name, unit), after, errors, noise, unit)


def _factor(unit: str) -> float:
    return 1e6 if unit == "µm" else 1.0


def _stored(figures: Figures, name: str, unit: str) -> Residuals | None:
    """Residual of the diagnosed model, as the diagnosis stores it."""
    kept = figures.get("residual")
    if kept is None:
        return None
    return Residuals(name, kept, _factor(unit) * kept["before"], _factor(unit) * kept["sigma"])


def _tried(figures: Figures, diagnosis: Mapping[str, Any], unit: str) -> Residuals | None:
    """Residual with the effects found, as the diagnosis tried them."""
    kept = figures.get("residual", {})
    if "after" not in kept:
        return None
    force = kept["F"] if np.any(kept["F"]) else None  # an effect on the measurement adds none
    name = f"with {_named(diagnosis.get('missing') or [])}, as tried"
    return Residuals(name, kept, _factor(unit) * kept["after"], _factor(unit) * kept["sigma"], force)


def _named(effects: Sequence[str]) -> str:
    """Some effects in a legend, where long names have no room."""
    return " + ".join(effects) if 0 < len(effects) <= MAX_STEPS_NAMED else f"{len(effects) or 'some'} effects"


def _of_model(
    model: ModelResults, results: Results, figures: Figures, base: ModelResults | None = None
) -> Residuals | None:
    by_name = {run.name: run for run in results.runs}
    return _residuals_of(model, by_name, figures, [] if base is None else _added(base.summary["model"], model))


def _added(effects: Sequence[str], model: ModelResults) -> list[str]:
    return [name for name in model.summary["model"] if name not in effects]


def _residuals_of(
    model: ModelResults, runs: Mapping[str, Any], figures: Figures, added: Sequence[str]
) -> Residuals | None:
    """Residual of a stored model. Its clock is shifted so that runs begin where they begin in the diagnosis."""
    fitted = [row["run"] for row in model.summary["per_run"] if row["role"] == "fit"]
    kept = figures.get("residual", figures.get("residual_force", {}))
    rows = []
    for k, name in enumerate(fitted):
        curves = [c for c in model.curves if c.run == name]
        parts = residuals(model, runs.get(name, _Named(name)))
        begins = float(np.min(kept["t"][kept["run"] == k], initial=np.inf)) if "t" in kept else 0.0
        shift = (begins if np.isfinite(begins) else 0.0) - min((float(c.t[0]) for c in curves), default=0.0)
        for curve, part in zip(curves, parts, strict=len(parts) == len(curves)):
            against = np.where(curve.v_model < 0, -1.0, 1.0)
            force = against * sum((curve.parts[e] for e in added if e in curve.parts), np.zeros(len(curve.t)))
            rows.append((np.full(len(curve.t), float(k)), curve.t + shift, curve.x, np.abs(curve.v_model),
                         part.values, part.sigma, force))  # fmt: skip
    if not rows:
        return None
    run, t, x, v, values, sigma, force = (np.concatenate(column) for column in zip(*rows, strict=True))
    name = f"with {_named(added)}" if added else plain_name(model.name)
    along = {"run": run, "t": t, "x": x, "v": v}
    quoted = _rms(model, residual_unit(model))
    return Residuals(name, along, values, sigma, force if np.any(force) else None, quoted)


@dataclass(frozen=True)
class _Named:
    """A run of which only the name matters, for a residual of displacement."""

    name: str
    friction: None = None


def _errors_tried(diagnosis: Mapping[str, Any], unit: str) -> list[HeldOutError]:
    """Held-out errors of the diagnosed model and of the effects found on top of it, one after another."""
    key = "um" if unit == "µm" else "N"
    best: Mapping[str, Any] = next(iter(diagnosis.get("candidates") or []), {})
    bare = best.get(f"heldout_rms_before_{key}")
    if bare is None:
        return []
    found = [row for row in diagnosis.get("importance") or [] if row.get(f"heldout_rms_after_{key}") is not None]
    after = [HeldOutError(f"+ {row['effect']}", row[f"heldout_rms_after_{key}"], tried=True) for row in found]
    if not after and best.get(f"heldout_rms_after_{key}") is not None:
        after = [HeldOutError(f"+ {best['effect']}", best[f"heldout_rms_after_{key}"], tried=True)]
    return [HeldOutError(joined_name(diagnosis["model"]), bare), *after]
