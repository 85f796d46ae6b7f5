"""Prepare results as data of linked plots. Each row is a frame, so one selection applies to all plots."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictrack.present import plots
from frictrack.present.plots import modelled_force, residual_unit, residuals
from frictrack.present.plots.style import BAND_SIGMAS, axis_label, masked, unsmeared_frames
from frictrack.records import Array, Friction, Mask, Track
from frictrack.results import BACKWARD, ModelResults, Results, RunResults

HEADER_BYTES = 4  # the length of the scene, uint32
ALIGNMENT = 4  # bytes of a Float32
MODEL_COLUMNS = ("left", "other", "noise_low", "noise_high", "F_model", "F_other")  # what a model gives


@dataclass
class PlotData:
    """Plots over common columns; the rows may come from several runs, one after the other.

    Attributes
    ----------
    rows : int
        Number of rows.
    columns : dict
        Columns by name, (rows,) each; columns of film positions may be longer.
    plots : list of dict
        The plots; see `plot`.
    runs : list of dict
        Name, first row, number of rows, index of the colour, first frame and tracked targets of each run.
    extra : dict
        Further keys of the scene.

    """

    rows: int = 0
    columns: dict[str, Array] = field(default_factory=dict)
    plots: list[dict[str, Any]] = field(default_factory=list)
    runs: list[dict[str, Any]] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)

    def layout(self) -> tuple[dict[str, Any], bytes]:
        """Split into a description and numbers."""
        places, parts, at = {}, [], 0
        for key, column in self.columns.items():
            part = np.asarray(column, dtype="<f4")
            places[key], at = [at, len(part)], at + len(part)
            parts.append(part.tobytes())
        scene = {"rows": self.rows, "columns": places, "plots": self.plots, "runs": self.runs, **self.extra}
        return scene, b"".join(parts)

    def pack(self) -> bytes:
        r"""Pack scene and columns for `parsePacked` in the browser.

        Returns
        -------
        bytes
            Length of the scene (uint32), the scene as JSON padded with spaces to four bytes, then the columns.

        Examples
        --------
        >>> PlotData(1, {"t": np.zeros(1)}).pack()[-4:]
        b'\x00\x00\x00\x00'

        """
        scene, data = self.layout()
        text = json.dumps(scene, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % ALIGNMENT)
        return len(text).to_bytes(HEADER_BYTES, "little") + text + data


def axis(column: str, name: str, unit: str) -> dict[str, str]:
    """Describe an axis."""
    return {"column": column, "name": name, "unit": unit, "label": axis_label(name, unit)}


def plot(
    title: str,
    x: Mapping[str, str],
    y: tuple[str, str],
    *layers: Mapping[str, Any],
    **more: Any,
) -> dict[str, Any]:
    """Describe one plot; its layers are drawn from bottom to top.

    `brush` "x": a selection takes all values of y. `focus`: range of x that sets the range of y. `handles`: spans with
    ends to drag, each with `name` and `span`.
    """
    return {"id": title, "title": title, "x": dict(x), "y": axis("", *y), "layers": list(layers), **more}


def line(y: str, colour: str, name: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a line through the values of a column, with gaps at NaN; the legend hides it by `name`.

    `by_run`: in the colours of the runs. `halo`: each run's colour around the line. `dash`, `width`: of the line.
    `loose`: does not set the range of the axes. `candidate`: column of a candidate that is drawn over it. `about`: what
    the legend says of it.
    """
    return {"kind": "line", "y": y, "colour": colour, "name": name, "label": label, **more}


def dots(y: str, colour: str, name: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a point for every row; `main`: its points are selected; for the others see `line`."""
    return line(y, colour, name, label, **more) | {"kind": "dots"}


def band(low: str, high: str, name: str, label: str = "", colour: str = "band") -> dict[str, Any]:
    """Describe a layer: the area between two columns."""
    return {"kind": "band", "low": low, "high": high, "colour": colour, "name": name, "label": label}


def span(begin: float, end: float, name: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a shaded span of x."""
    return {"kind": "span", "from": begin, "to": end, "name": name, "label": label, "colour": name, **more}


TARGET = "target"
TIME, PLACE, VELOCITY = axis("t", "time", "ms"), axis("x", "displacement", "mm"), axis("v", "velocity", "m/s")
RESIDUAL = "residual"
RESIDUAL_TITLES = ("Residual against time", "Residual against place", "Residual against velocity")
FORCE_TITLES = ("Force against time", "Force against velocity")
MOTION_TITLES = {"x": ("Displacement", "mm"), "v": ("Velocity", "m/s"), "a": ("Acceleration", "m/s²")}


def _add_band(columns: dict[str, Array], name: str, middle: Array, sigma: Array) -> dict[str, Any]:
    """Add the columns of a band around a curve and return its layer."""
    columns[f"{name}_low"], columns[f"{name}_high"] = middle - BAND_SIGMAS * sigma, middle + BAND_SIGMAS * sigma
    return band(f"{name}_low", f"{name}_high", "band", f"± {BAND_SIGMAS:g} std")


# --- the track


def track_plots(run: RunResults, index: int = 0) -> PlotData:
    """Prepare plots of the track: position, standard deviation and match score of every frame."""
    track = run.track
    if track is None:
        return PlotData(extra={"view": "track"})
    columns = {"t": 1e3 * track.t, "sigma": track.sigma_px, "score": track.score}
    columns |= target_positions(run)
    shown = []
    for word, name in (("Horizontal", "x"), ("Vertical", "y")):
        path = line(position_column(TARGET, name, run), "measured", "measured", "measured", by_run=True)
        shown.append(plot(f"{word} position in the picture", TIME, (name, "px"), path, brush="x"))
    shown += [
        plot("Standard deviation of the position", TIME, ("sigma", "px"), dots("sigma", "measured", "sigma")),
        plot("Match score", TIME, ("score", ""), dots("score", "measured", "score")),
    ]
    return PlotData(len(track), columns, shown, [_run_entry(run, 0, len(track), index)], {"view": "track"})


def all_tracks(run: RunResults) -> dict[str, Track]:
    """Select the tracks of a run."""
    others = {name: track for name, track in run.tracks.items() if name != BACKWARD}
    return {TARGET: run.track, **others} if run.track is not None else {}


def position_column(name: str, axis_name: str, run: RunResults) -> str:
    """Name the column with the position of a target in every frame of a run's film, px."""
    return f"{name}_{axis_name}:{run.name}"


def target_positions(run: RunResults) -> dict[str, Array]:
    """Collect the positions of all tracked targets."""
    found = {name: {"x": track.x_px, "y": track.y_px} for name, track in all_tracks(run).items()}
    return {position_column(name, a, run): q for name, place in found.items() for a, q in place.items()}


def first_frame(run: RunResults) -> int:
    """Number of the film's frame at which the motion of a run begins; 0 without a film."""
    if run.track is None:
        return 0
    return int(np.searchsorted(run.track.t, run.motion.t[0] - 0.5 * np.median(np.diff(run.track.t))))


# --- the motion


def motion_plots(run: RunResults, other: Array | None = None, label: str = "", index: int = 0) -> PlotData:
    """Prepare plots of displacement, velocity, acceleration and force; the free section has handles to drag."""
    m, d, f = run.motion, run.displacement, run.friction
    columns: dict[str, Array] = {"t": 1e3 * m.t, "x": 1e3 * m.x, "v": m.v, "a": m.a, "raw": 1e6 * (d.x - m.x)}
    sigmas: dict[str, Array] = {"v": m.sigma_v, "a": m.sigma_a}
    if f is not None:
        columns["F"], sigmas["F"] = f.F, f.sigma_F
    if other is not None:
        columns |= {"v_other": other[1], "a_other": other[2]}
    free, clean = _span_of(f), _span_of(f, m.guard)
    shade = [span(*free, "free", "free section")] if free else []
    grip: dict[str, Any] = {"handles": [{"name": "free", "span": list(free)}]} if free else {}
    near: dict[str, Any] = {"focus": list(clean)} if clean else {}  # the push, and what the filter smears, are larger
    shown = []
    for name, (title, unit) in (MOTION_TITLES | {"F": ("Friction force", "N")}).items():
        if name in columns:
            layers = [_add_band(columns, name, columns[name], sigmas[name])] if name in sigmas else []
            layers.append(line(name, "measured", "measured", "measured", by_run=True))
            if f"{name}_other" in columns:
                layers.append(line(f"{name}_other", "candidate", "preview", label, dash=[6, 3], width=2, loose=True))
            more = grip | (near if name in ("a", "F") else {})
            shown.append(plot(title, TIME, (name, unit), *shade, *layers, brush="x", **more))
    around = _add_band(columns, "raw", np.zeros(len(m)), 1e6 * d.sigma_x)
    shown.append(plot("Measured minus smoothed", TIME, ("x", "µm"), around, dots("raw", "measured", "raw")))
    columns |= target_positions(run)
    return PlotData(len(m), columns, shown, [_run_entry(run, 0, len(m), index, first_frame(run))], {"view": "motion"})


def _span_of(friction: Friction | None, guard: int = 0) -> tuple[float, float] | None:
    """Start and end of the free section without the frames that a filter smears, ms."""
    if friction is None or not friction.free.any():
        return None
    t = 1e3 * friction.t[unsmeared_frames(friction, guard)]
    return float(t[0]), float(t[-1])


# --- model and measurement


def comparison_plots(results: Results, model: ModelResults, other: ModelResults | None = None) -> PlotData:
    """Prepare plots of the residual and of both forces over time, place and velocity, and of the measured motion.

    Failing spans are marked.
    """
    return model_plots(results.runs, model, other, _failing_spans(results, model), _measured_again(results, model))


def _measured_again(results: Results, model: ModelResults) -> set[str]:
    """Runs that were measured again after a model was fitted: its curves belong to another scale or mass."""
    reasons = [part.reason for part in results.outdated_parts if (part.what, part.name) == ("model", model.name)]
    waiting = {part.name for part in results.outdated_parts if part.what in ("track", "motion")}
    current = [run for run in results.runs if reasons and run.name not in waiting]
    return {run.name for run in current if "mass was changed" in reasons[0] or not _is_fitted_to(model, run)}


def _is_fitted_to(model: ModelResults, run: RunResults) -> bool:
    """Whether a model was fitted to the displacement that a run has now."""
    x, t = run.displacement.x, run.displacement.t
    return all(np.allclose(c.x, x[_row_indices(t, c.t)], equal_nan=True) for c in model.curves if c.run == run.name)


def model_plots(
    all_runs: Sequence[RunResults],
    model: ModelResults,
    other: ModelResults | None = None,
    failing: Sequence[Mapping[str, Any]] = (),
    measured_again: Collection[str] = (),
) -> PlotData:
    """Prepare the same plots as `comparison_plots` from runs and a model."""
    runs = compared_runs(all_runs, model)
    parts = [_run_columns(run, model, other) for run in runs]
    for run, part in zip(runs, parts, strict=True):
        if run.name in measured_again:
            part |= {key: np.full(len(run.motion), np.nan) for key in MODEL_COLUMNS if key in part}
    columns = {key: np.concatenate([part[key] for part in parts]) for key in (parts[0] if parts else {})}
    columns |= {key: place for run in runs for key, place in target_positions(run).items()}
    entries, first = [], 0
    order = [run.name for run in all_runs]
    for run in runs:
        entries.append(_run_entry(run, first, len(run.motion), order.index(run.name), first_frame(run)))
        first += len(run.motion)
    spans = [(*s["t"], s["run"]) for s in failing if any(run.name == s["run"] for run in runs)]
    marks = [span(1e3 * a, 1e3 * b, "fails", "model fails", run=name, colour="warn") for a, b, name in spans]
    sparse = any(_unread(run).any() for run in runs)
    shown = [*_residual_plots(residual_unit(model), marks, other), *_force_plots(other, sparse), *_motion_plots()]
    return PlotData(first, columns, shown, entries, {"view": "compare", "model": model.name})


def compared_runs(runs: Sequence[RunResults], model: ModelResults) -> list[RunResults]:
    """Select the runs whose frames are the rows of the comparison, in their order."""
    return [run for run in runs if any(curve.run == run.name for curve in model.curves)]


def _residual_plots(unit: str, marks: list[dict[str, Any]], other: ModelResults | None) -> list[dict[str, Any]]:
    behind = [dots("other", "background-model", "background", model_label(other))] if other is not None else []
    more: dict[str, Any] = {"about": "Measured minus modelled", "by_run": True, "main": True, "candidate": "with"}
    layers = [band("noise_low", "noise_high", "noise", "noise"), *behind]
    layers.append(dots("left", "measured", "residual", RESIDUAL, **more))
    return [
        plot(title, x, (RESIDUAL, unit), *(marks if x is TIME else ()), *layers)
        for title, x in zip(RESIDUAL_TITLES, (TIME, PLACE, VELOCITY), strict=True)
    ]


def _force_plots(other: ModelResults | None, sparse: bool) -> list[dict[str, Any]]:
    """Plots of the forces; through points that have no neighbours a line cannot be drawn."""
    behind = [("F_other", "background-model", "background", model_label(other))] if other is not None else []
    over_time = [
        line("F", "measured", "measured", "measured", width=1, by_run=True),
        *(line(*look, dash=[5, 3]) for look in behind),
        line("F_model", "model", "model", "model", width=2, halo=True, candidate="F_with"),
    ]
    over_motion = [
        dots("F", "measured", "measured", "measured", by_run=True),
        *(dots(*look) for look in behind),
        dots("F_model", "model", "model", "model", candidate="F_with"),
    ]
    return [
        plot(FORCE_TITLES[0], TIME, ("F", "N"), *(over_motion if sparse else over_time), brush="x"),
        plot(FORCE_TITLES[1], VELOCITY, ("F", "N"), *over_motion),
        plot("Force against place", PLACE, ("F", "N"), *over_motion),
    ]


def _motion_plots() -> list[dict[str, Any]]:
    """Plots of the measured motion that is compared: displacement, velocity and acceleration against time."""
    return [
        plot(title, TIME, (name, unit), line(name, "measured", "measured", "measured", by_run=True), brush="x")
        for name, (title, unit) in MOTION_TITLES.items()
    ]


def candidate_columns(runs: Sequence[RunResults], model: ModelResults, tried: ModelResults) -> dict[str, Array]:
    """Prepare residual and force of a candidate, which are drawn over those of the current model."""
    parts = [_model_curves(run, tried)[:2] for run in compared_runs(runs, model)]
    left, force = (np.concatenate([part[k] for part in parts]) if parts else np.zeros(0) for k in (0, 1))
    return {"with": left, "F_with": force}


def model_label(model: ModelResults | None) -> str:
    """Name of a model with its number; a model that was only tried has no number, and None has no name."""
    if model is None:
        return ""
    is_tried = model.name.startswith("0_") or not model.name[:1].isdigit()
    return plots.plain_name(model.name) if is_tried else plots.numbered_name(model.name)


def _failing_spans(results: Results, model: ModelResults) -> Sequence[Mapping[str, Any]]:
    summary = model.diagnosis or (results.comparison if model.current else None) or {}
    return [s for s in summary.get("fails_at", []) if s.get("t")]


def _run_columns(run: RunResults, model: ModelResults, other: ModelResults | None) -> dict[str, Array]:
    """Columns of one run, one row per frame, NaN where nothing was fitted."""
    m, f = run.motion, run.friction
    rows: dict[str, Array] = {"t": 1e3 * m.t, "x": 1e3 * m.x, "v": m.v, "F": np.full(len(m), np.nan), "a": m.a}
    if f is not None:  # the push is much larger than what follows
        clean = unsmeared_frames(f, m.guard)
        rows |= {"F": masked(f.F, clean & ~_unread(run)), "a": masked(m.a, clean)}
    rows["left"], rows["F_model"], noise = _model_curves(run, model)
    if other is not None:
        rows["other"], rows["F_other"], _ = _model_curves(run, other)
    rows["noise_low"], rows["noise_high"] = -BAND_SIGMAS * noise, BAND_SIGMAS * noise
    return rows


def _model_curves(run: RunResults, model: ModelResults) -> tuple[Array, Array, Array]:
    """Residual, force of the model, and noise at every frame, (n,) each; NaN where nothing was fitted."""
    left, modelled, noise = np.full((3, len(run.motion)), np.nan)
    for part in residuals(model, run):
        at = _row_indices(run.motion.t, 1e-3 * part.t)
        left[at], noise[at] = part.values, part.sigma
    frames, unread = np.arange(len(noise)), _unread(run)
    if unread.any():  # the band goes on between two samples
        noise[unread] = np.interp(frames[unread], frames[~unread], noise[~unread])
    for curve in model.curves:
        if curve.run == run.name:
            modelled[_row_indices(run.motion.t, curve.t)] = modelled_force(model, curve)
    if run.friction is not None:
        modelled[run.friction.free & ~unsmeared_frames(run.friction, run.motion.guard)] = np.nan
    return left, modelled, noise


def _unread(run: RunResults) -> Mask:
    """Frames (n,) between the samples of a load cell."""
    cell = None if run.sensors is None else run.sensors.friction_N
    return np.zeros(len(run.motion), dtype=bool) if cell is None else np.isnan(cell)


def _row_indices(t: Array, some: Array) -> Any:
    """Indices of some of the times."""
    return np.clip(np.searchsorted(t, some - 1e-9), 0, len(t) - 1)


def _run_entry(run: RunResults, first: int, count: int, index: int, frame: int = 0) -> dict[str, Any]:
    """Description of a run for the browser: its rows, the frame of the first row, and its tracked targets."""
    tracks = [
        {"name": name, "x": position_column(name, "x", run), "y": position_column(name, "y", run)}
        | {"w": float(track.target[2]), "h": float(track.target[3])}
        for name, track in all_tracks(run).items()
        if track.target is not None
    ]
    return {"name": run.name, "first": first, "count": count, "index": index, "frame": frame, "tracks": tracks}
