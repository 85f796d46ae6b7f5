"""Draw the verdict on a model in one figure: where it fails, the force that it lacks, and how the error falls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.base.number_format import format_number
from frictrack.present.plots import model as of_models
from frictrack.present.plots import style
from frictrack.present.plots.evidence import at_reference_load, draw_missing_force, draw_runs, force_title, worst_runs
from frictrack.present.plots.inputs import AnyModel, Summarised, as_model
from frictrack.present.plots.style import axis_label, motion_label, new_figure, styled
from frictrack.records import Array
from frictrack.results import ModelResults, Results
from frictrack.results.candidates import joined_name, plain_name
from frictrack.results.verdicts import describe_verdict

DRAWN_AXES = ("x", "v", "t")
REJECTED = ("missing", "ambiguous", "unexplained")
Figures = Mapping[str, Mapping[str, Array]]


@dataclass(frozen=True)
class Residuals:
    """Residual of one model along the motion of all runs.

    Attributes
    ----------
    name : str
        The model, or what was added to it.
    rows : dict of Array
        Columns (n,): run (index), t (time since release, s), x (m), v (speed, m/s), values and sigma (residual and its
        noise, um or N) and force (that added effects exert against the motion, N), if there is any.
    rms : float
        Root mean square of the fit, um or N; the drawn rows may be thinned out.

    """

    name: str
    rows: dict[str, Array]
    rms: float


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
    errors: list[of_models.HeldOutError]
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
        return is_rejected(self.diagnosis)


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
    diagnosis, unit, name = shown.diagnosis or {}, of_models.residual_unit(current), plain_name(shown.name)
    figures, runs = shown.figures if diagnosis else {}, {run.name: run for run in results.runs}
    before = _stored(figures, "before", name, unit, shown) or _of_model(shown, runs, figures)
    later = None if shown is current else _of_model(current, runs, figures, shown.summary["model"])
    errors = of_models.errors_of_models(results.models, unit)
    tried = _errors_tried(diagnosis, unit) if shown is current else []
    if tried and errors:  # the errors of a diagnosis are compared with each other: frames may be held out differently
        errors = [*errors[:-1], replace(tried[0], label=errors[-1].label), *tried[1:]]
    noise = of_models.noise_um(current) if unit == "µm" else diagnosis.get("noise_N")
    return VerdictData(name, diagnosis, figures, before, later or _tried(diagnosis, figures, unit), errors, noise, unit)


def data_of_diagnosis(found: Summarised, better: AnyModel | None = None) -> VerdictData:
    """Select the data of a diagnosis, and of a later fit if there is one."""
    diagnosis, figures = found.summary(), found.figures
    noise, unit = (diagnosis["noise_um"], "µm") if diagnosis.get("noise_N") is None else (diagnosis["noise_N"], "N")
    name, errors = joined_name(diagnosis["model"]), _errors_tried(diagnosis, unit)
    before, after = _stored(figures, "before", name, unit), _tried(diagnosis, figures, unit)
    if better is not None:
        later = as_model(better)
        after = _of_model(later, {}, figures, diagnosis["model"])
        errors = errors[:1] + of_models.errors_of_models([later], unit)
    return VerdictData(name, diagnosis, figures, before, after, errors, noise, unit)


def _tried(diagnosis: Mapping[str, Any], figures: Figures, unit: str) -> Residuals | None:
    """Residual with the effects that a diagnosis found, as it tried them."""
    return _stored(figures, "after", f"with {_named(diagnosis.get('missing') or [])}, as tried", unit)


def _rms(model: ModelResults | None, unit: str, values: Array) -> float:
    """Root mean square of the residual: of the fit, if it is known, else of some values."""
    key = "rms_displacement_um" if unit == "µm" else "rms_N"
    found = None if model is None else model.summary["errors"].get(key)
    return float(np.sqrt(np.mean(values**2))) if found is None else float(found)


def _stored(figures: Figures, which: str, name: str, unit: str, model: ModelResults | None = None) -> Residuals | None:
    """Residual as the diagnosis stores it: "before" of its model, "after" with the effects that it found."""
    kept = figures.get("residual", {})
    if which not in kept:
        return None
    factor = 1e6 if unit == "µm" else 1.0
    rows = {key: kept[key] for key in ("run", *DRAWN_AXES)}
    rows |= {"values": factor * kept[which], "sigma": factor * kept["sigma"]}
    if which == "after" and np.any(kept["F"]):  # an effect on the measurement adds none
        rows["force"] = kept["F"]
    return Residuals(name, rows, _rms(model, unit, rows["values"]))


def _named(effects: Sequence[str]) -> str:
    """Some effects in a legend, where long names have no room."""
    return " + ".join(effects) if 0 < len(effects) <= of_models.MAX_STEPS_NAMED else f"{len(effects) or 'some'} effects"


def _of_model(
    model: ModelResults, runs: Mapping[str, Any], figures: Figures, before: Sequence[str] | None = None
) -> Residuals | None:
    """Residual of a stored model, which may add effects to those `before`.

    Its clock is shifted so that runs begin where they begin in the diagnosis.
    """
    fitted = [row["run"] for row in model.summary["per_run"] if row["role"] == "fit"]
    added = [] if before is None else [name for name in model.summary["model"] if name not in before]
    kept = figures.get("residual", figures.get("residual_force", {}))
    parts = []
    for k, name in enumerate(fitted):
        curves = [c for c in model.curves if c.run == name]
        # of a run that is not known only the name matters, for a residual of displacement
        found = of_models.residuals(model, runs.get(name, SimpleNamespace(name=name, friction=None)))
        begins = float(np.min(kept["t"][kept["run"] == k], initial=np.inf)) if "t" in kept else 0.0
        shift = (begins if np.isfinite(begins) else 0.0) - min((float(c.t[0]) for c in curves), default=0.0)
        for curve, part in zip(curves, found, strict=len(found) == len(curves)):
            against = np.where(curve.v_model < 0, -1.0, 1.0)
            force = against * sum((curve.parts[e] for e in added if e in curve.parts), np.zeros(len(curve.t)))
            parts.append((np.full(len(curve.t), float(k)), curve.t + shift, curve.x, np.abs(curve.v_model),
                          part.values, part.sigma, force))  # fmt: skip
    if not parts:
        return None
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    rows = dict(zip(("run", "t", "x", "v", "values", "sigma", "force"), columns, strict=True))
    if not np.any(rows["force"]):
        rows.pop("force")
    name = f"with {_named(added)}" if added else plain_name(model.name)
    return Residuals(name, rows, _rms(model, of_models.residual_unit(model), rows["values"]))


def _errors_tried(diagnosis: Mapping[str, Any], unit: str) -> list[of_models.HeldOutError]:
    """Held-out errors of the diagnosed model and of the effects found on top of it, one after another."""
    key = "um" if unit == "µm" else "N"
    best: Mapping[str, Any] = next(iter(diagnosis.get("candidates") or []), {})
    bare = best.get(f"heldout_rms_before_{key}")
    if bare is None:
        return []
    found = [row for row in diagnosis.get("importance") or [] if row.get(f"heldout_rms_after_{key}") is not None]
    if not found and best.get(f"heldout_rms_after_{key}") is not None:
        found = [best]
    after = [of_models.HeldOutError(f"+ {row['effect']}", row[f"heldout_rms_after_{key}"], tried=True) for row in found]
    return [of_models.HeldOutError(joined_name(diagnosis["model"]), bare), *after]


HEIGHT_IN = 3.3
MAX_RUNS_DRAWN = 8  # one by one; of more runs the worst residuals, and of the force only the common part
MAX_LIMITS = 8
ERRORS_WIDTH_IN = 3.3  # of the panel of errors
BEFORE, AFTER = style.VERMILION, style.BLUE
FAILS_STYLE: dict[str, Any] = {"fc": style.ORANGE, "alpha": 0.22, "lw": 0, "label": "fails here"}


@styled
def verdict(found: Results | Summarised, better: AnyModel | None = None, *, title: bool = True) -> Figure:
    """Draw where a model fails, the force that it lacks, and the held-out error of each model tried.

    The residual is drawn over the axis over which the misfit repeats: position, speed or time. Failing spans are
    shaded. The missing force has a band of two standard deviations; the force that the named effects add lies over it.
    Where nothing is missing, detection limits take its place.

    Parameters
    ----------
    found : Results or Diagnosis
        A study, or the diagnosis of a fit.
    better : ModelResults or Fit, optional
        A later model, if `found` is a diagnosis. Without it the effects found are drawn as the diagnosis tried them.
    title : bool
        Whether the figure has a headline.

    Raises
    ------
    ValueError
        If a study has no fitted model.

    """
    data = data_of_study(found) if isinstance(found, Results) else data_of_diagnosis(found, better)
    figure = new_figure(HEIGHT_IN + 0.3 * title, _headline(data) if title else "")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1.15, 1.15, 0.8])
    _draw_residuals(left, data)
    _draw_force(middle, data)
    if data.before is not None and "residual_force" in data.figures:
        middle.set_xlim(left.get_xlim())
    if data.errors:
        of_models.draw_held_out(right, data.errors, data.noise, data.unit, ERRORS_WIDTH_IN)
        right.set_title(_errors_title(data))
    else:
        _say(right, "No held-out error was computed")
    style.legend_below(figure, handlelength=1.8, columnspacing=1.4)
    return figure


def _headline(data: VerdictData) -> str:
    if not data.diagnosis:
        return f"{data.name}, not yet diagnosed"
    said, before, after = describe_verdict(data.diagnosis, data.name), data.before, data.after
    if before is None or after is None or data.diagnosis["verdict"] != "missing":
        return said
    errors = f"{format_number(before.rms)} to {format_number(after.rms)} {data.unit}"
    return f"{said}: with it the residual falls from {errors}"


# ---- residual before and after


def _draw_residuals(ax: Axes, data: VerdictData) -> None:
    """Draw the residuals over their noise band."""
    if data.before is None:
        _say(ax, "No residual is stored; diagnose again")
        return
    shown = worst_runs(data.before.rows, "values", "sigma", MAX_RUNS_DRAWN)
    for whole, colour in ((data.before, BEFORE if data.fails else AFTER), (data.after, AFTER)):
        if whole is not None:
            label = whole.name + (_how_many(whole) if whole is data.before else "")
            _draw_lines(ax, whole.rows, data.axis, "values", shown, color=colour, lw=0.9, alpha=0.85, label=label)
    band = style.BAND_SIGMAS * float(np.median(data.before.rows["sigma"]))
    ax.axhspan(-band, band, color=style.NOISE_COLOUR, lw=0, zorder=0.6, label=f"noise, {style.BAND_LABEL}")
    ax.axhline(0, color="#666666", lw=0.7, zorder=1)
    _shade_spans(ax, data)
    ax.set(xlabel=motion_label(data.axis), ylabel=axis_label("residual", data.unit), title=_residual_title(data))
    ax.margins(x=0.01)


def _draw_lines(ax: Axes, rows: Mapping[str, Array], axis: str, column: str, shown: Array, **look: Any) -> None:
    """Draw a column of some runs in one look, as a bitmap if the points are many."""
    kept = np.isin(rows["run"], shown)
    look["rasterized"] = np.count_nonzero(kept) > 4 * style.MAX_POINTS
    draw_runs(ax, rows, axis, column, dict.fromkeys(np.unique(rows["run"][kept]), look))


def _residual_title(data: VerdictData) -> str:
    before, after = data.before, data.after
    assert before is not None
    size = f"{format_number(before.rms)} {data.unit}"
    if after is not None:
        return f"Residual: {size} before, {format_number(after.rms)} after"
    if not data.diagnosis or data.noise is None:
        return f"Residual: {size}"
    return f"Residual: {size}, noise {format_number(data.noise)} {data.unit}"


def _how_many(residuals: Residuals) -> str:
    """How many runs are drawn, if not all."""
    n = len(np.unique(residuals.rows["run"]))
    return f", {MAX_RUNS_DRAWN} worst of {n} runs" if n > MAX_RUNS_DRAWN else ""


def _shade_spans(ax: Axes, data: VerdictData) -> None:
    """Shade the union of the failing spans of all runs."""
    for low, high in _spans(data):
        ax.axvspan(low, high, zorder=0.4, **FAILS_STYLE)


def _spans(data: VerdictData) -> list[tuple[float, float]]:
    """Union of the failing spans along the axis."""
    found = data.diagnosis.get("fails_at") or []
    if data.axis == "t":
        return []  # spans have the clock of each recording
    ends = sorted(sorted(map(abs, s["v"]) if data.axis == "v" else s["x"]) for s in found)
    out: list[tuple[float, float]] = []
    for low, high in ends:
        if out and low <= out[-1][1]:
            out[-1] = (out[-1][0], max(high, out[-1][1]))
        else:
            out.append((low, high))
    return out


# ---- the missing force


def _draw_force(ax: Axes, data: VerdictData) -> None:
    """Draw the missing force or, where nothing is missing, what would be seen."""
    if "residual_force" in data.figures:
        _draw_missing_force(ax, data)
    elif data.diagnosis.get("detection_limits") and not data.fails:
        _draw_limits(ax, data.diagnosis["detection_limits"])
    else:
        _say(ax, "The missing force is not computed yet")


def _draw_missing_force(ax: Axes, data: VerdictData) -> None:
    whole, after = at_reference_load(data.figures["residual_force"]), data.after
    runs = np.unique(whole["run"])
    look: dict[str, Any] = {"color": "#8C8C8C", "lw": 1.0, "alpha": 0.9, "label": "missing force, each run"}
    looks = dict.fromkeys(runs, look) if len(runs) <= MAX_RUNS_DRAWN else {}
    common = data.figures.get(f"common_{data.axis}") if len(runs) > 1 else None
    label = draw_missing_force(ax, whole, data.axis, common, looks)
    if after is not None and "force" in after.rows:
        names = np.unique(after.rows["run"])
        shown = names[np.unique(np.linspace(0, len(names) - 1, MAX_RUNS_DRAWN).astype(int))]  # spread over all
        per_load = style.axis_scale(whole["F"], "N")[0] / _load_of(whole, after.rows["run"])
        rows = after.rows | {"force": per_load * after.rows["force"]}
        effects = after.name.removeprefix("with ").removesuffix(", as tried")
        look = {"color": AFTER, "lw": 1.5, "ls": (0, (4, 1.2)), "zorder": 5}
        look["label"] = f"force of {effects}{', each run' if len(names) > 1 else ''}"
        _draw_lines(ax, rows, data.axis, "force", shown, **look)
    _shade_spans(ax, data)
    ax.set(ylabel=label, title=force_title(data.diagnosis.get("repeats") or []))


def _load_of(whole: Mapping[str, Array], run: Array) -> Array:
    """Load by which the force of every row is divided, (n,)."""
    if "load" not in whole:
        return np.ones(len(run))
    by_run = {k: whole["load"][whole["run"] == k][0] for k in np.unique(whole["run"])}
    return np.array([by_run.get(k, 1.0) for k in run])


def _draw_limits(ax: Axes, limits: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw the smallest force of each effect that these runs would show, the best seen on top."""
    known = sorted((one["value"], name) for name, one in limits.items() if one["unit"] == "N" and one["value"])
    if not known:
        _say(ax, "No force is detectable in these runs")
        return
    shown = known[:MAX_LIMITS]
    sizes = [value for value, _ in shown]
    factor, unit = style.axis_scale(np.array(sizes), "N")
    ax.plot([factor * s for s in sizes], range(len(shown)), "o", ms=7, color=AFTER)
    for k, size in enumerate(sizes):
        style.note(ax, format_number(factor * size, 2), (factor * size, k), (7, 0), va="center")
    style.name_rows(ax, [name.replace("_", " ") for _, name in shown])
    style.log_axis(ax, "x")
    ax.set_xlim(0.6 * factor * min(sizes), 4.0 * factor * max(sizes))
    ax.grid(axis="y", color="#E4E7EA", lw=0.8)
    ax.set_xlabel(axis_label("smallest force that would be detected", unit))
    ax.set_title("What these runs would have shown")


# ---- the held-out errors


def _errors_title(data: VerdictData) -> str:
    first, last = data.errors[0].value, data.errors[-1].value
    if len(data.errors) == 1:
        return "Error and noise"
    if last >= first:
        return "Error does not fall"
    return "Error falls to the noise" if data.noise is not None and last < 1.2 * data.noise else "Error falls"


# ---- common to the panels


def _say(ax: Axes, words: str) -> None:
    """Write a sentence instead of a panel."""
    ax.set_axis_off()
    ax.text(0.5, 0.5, words, ha="center", va="center", transform=ax.transAxes, color="#666666")
