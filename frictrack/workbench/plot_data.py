"""Prepare results as data of linked plots. Each row is a frame, so one selection applies to all plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictrack import plots
from frictrack.plots import modelled_force, residual_unit, residuals
from frictrack.plots.style import BAND_SIGMAS, BLUE, GREEN, ORANGE, PURPLE, RUN_STYLES, SKY, VERMILION
from frictrack.records import Array, Track
from frictrack.results import ModelResults, Results, RunResults

BAND_COLOUR, FREE_COLOUR, MEASURED_COLOUR = "#e0e0e0", "rgba(0,158,115,.12)", "#333333"
PREVIEW_COLOUR = VERMILION
TARGET = "target"
TRACK_COLOURS = (ORANGE, SKY, GREEN, PURPLE)


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
        Name, first row, number of rows, colour and first frame of each run.

    """

    rows: int = 0
    columns: dict[str, Array] = field(default_factory=dict)
    plots: list[dict[str, Any]] = field(default_factory=list)
    runs: list[dict[str, Any]] = field(default_factory=list)

    def pack(self) -> tuple[dict[str, Any], bytes]:
        """Pack the columns for the browser.

        Returns
        -------
        scene : dict
            Plots, runs, and offset and length of each column.
        data : bytes
            All columns, one after the other, as little-endian Float32.

        """
        places, parts, at = {}, [], 0
        for key, column in self.columns.items():
            part = np.asarray(column, dtype="<f4")
            places[key], at = [at, len(part)], at + len(part)
            parts.append(part.tobytes())
        scene = {"rows": self.rows, "columns": places, "plots": self.plots, "runs": self.runs, "keep": True}
        return scene, b"".join(parts)

    def frame_of_row(self, row: int) -> tuple[str, int]:
        """Find the run and the frame of a row.

        Returns
        -------
        name : str
            Name of the run.
        frame : int
            Number of the frame in the run's film.

        """
        run = next(r for r in self.runs if r["first"] <= row < r["first"] + r["count"])
        return run["name"], row - run["first"] + run["frame"]


def plot(title: str, x: tuple[str, str], y: str, *layers: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Describe one plot.

    Parameters
    ----------
    title : str
        Title, which is also its id.
    x : tuple of str
        Column and label of the x axis.
    y : str
        Label of the y axis.
    *layers : mapping
        What is drawn, from bottom to top: `line`, `dots`, `band`, `span`.
    **more
        Further keys that `linked.js` knows, such as `brush`, `focus` and `handles`.

    """
    return {
        "id": title,
        "title": title,
        "x": {"column": x[0], "label": x[1]},
        "y": {"label": y},
        "layers": list(layers),
        **more,
    }


def line(y: str, colour: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a line through the values of a column, with gaps at NaN.

    Parameters
    ----------
    y : str
        Name of the column.
    colour : str
        CSS colour.
    label : str
        Text in the legend; "" for none.
    **more
        Further keys that `linked.js` knows, such as `dash` and `width`.

    """
    return {"kind": "line", "y": y, "colour": colour, "label": label, **more}


def dots(y: str, colour: str = MEASURED_COLOUR, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a point for every row.

    Parameters
    ----------
    y : str
        Name of the column.
    colour : str
        CSS colour.
    label : str
        Text in the legend; "" for none.
    **more
        Further keys that `linked.js` knows, such as `by_run` and `main`.

    """
    return {"kind": "dots", "y": y, "colour": colour, "label": label, **more}


def band(low: str, high: str, colour: str = BAND_COLOUR, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: the area between two columns.

    Parameters
    ----------
    low, high : str
        Names of the columns.
    colour : str
        CSS colour.
    label : str
        Text in the legend; "" for none.
    **more
        Further keys that `linked.js` knows.

    """
    return {"kind": "band", "low": low, "high": high, "colour": colour, "label": label, **more}


def span(begin: float, end: float, colour: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a shaded span of x.

    Parameters
    ----------
    begin, end : float
        Ends of the span, in the unit of the x axis.
    colour : str
        CSS colour.
    label : str
        Text in the legend; "" for none.
    **more
        With `foot`, the span is a bar in that line at the bottom of the plot.

    """
    return {"kind": "span", "from": begin, "to": end, "colour": colour, "label": label, **more}


def _add_band(columns: dict[str, Array], name: str, middle: Array, sigma: Array) -> dict[str, Any]:
    """Add the columns of a band around a curve and return its layer."""
    columns[f"{name}_low"], columns[f"{name}_high"] = middle - BAND_SIGMAS * sigma, middle + BAND_SIGMAS * sigma
    return band(f"{name}_low", f"{name}_high", label=f"± {BAND_SIGMAS:g} std")


# --- the tabs


def track_plots(run: RunResults) -> PlotData:
    """Prepare plots of the track: position, standard deviation and match score of every frame.

    Parameters
    ----------
    run : RunResults
        A run. Without a track there are no plots.

    """
    track = run.track
    if track is None:
        return PlotData()
    columns = {"t": 1e3 * track.t, "sigma": 1e3 * track.sigma_px, "score": track.score}
    columns |= target_positions(run)
    time = ("t", "time / ms")
    shown = [
        plot(
            "Horizontal position in the picture",
            time,
            "x / px",
            line(position_column(TARGET, "x", run), MEASURED_COLOUR),
            brush="x",
        ),
        plot(
            "Vertical position in the picture",
            time,
            "y / px",
            line(position_column(TARGET, "y", run), MEASURED_COLOUR),
            brush="x",
        ),
        plot("Standard deviation of the position", time, "sigma / 0.001 px", dots("sigma", BLUE)),
        plot("Match score", time, "score", dots("score", GREEN)),
    ]
    return PlotData(len(track), columns, shown, [_run_entry(run, 0, len(track))])


def all_tracks(run: RunResults) -> dict[str, Track]:
    """Select the tracks of a run.

    Returns
    -------
    dict
        Track of the target and of everything else that was tracked, by name; without the backward track. Empty if
        the run has no film.

    """
    others = {name: track for name, track in run.tracks.items() if name != "backward"}
    return {TARGET: run.track, **others} if run.track is not None else {}


def position_column(name: str, axis: str, run: RunResults) -> str:
    """Name the column with the position of a target in every frame of a run's film, px.

    Parameters
    ----------
    name : str
        Name of the track.
    axis : str
        "x" or "y".
    run : RunResults
        The run.

    """
    return f"{name}_{axis}:{run.name}"


def target_positions(run: RunResults) -> dict[str, Array]:
    """Collect the positions of all tracked targets.

    Returns
    -------
    dict
        Positions (frames,) in px by name of the column, see `position_column`.

    """
    found = {name: {"x": track.x_px, "y": track.y_px} for name, track in all_tracks(run).items()}
    return {position_column(name, axis, run): q for name, place in found.items() for axis, q in place.items()}


def first_frame(run: RunResults) -> int:
    """Number of the film's frame at which the motion of a run begins; 0 without a film."""
    if run.track is None:
        return 0
    return int(np.searchsorted(run.track.t, run.motion.t[0] - 0.5 * np.median(np.diff(run.track.t))))


def motion_plots(run: RunResults, other: Array | None = None, label: str = "") -> PlotData:
    """Prepare plots of displacement, velocity, acceleration and friction force; the free section has handles to drag.

    Parameters
    ----------
    run : RunResults
        The run, n frames.
    other : Array, optional
        (3, n) displacement, velocity and acceleration by another cut-off, drawn over v and a.
    label : str
        Name of the other motion.

    """
    m, d, f = run.motion, run.displacement, run.friction
    columns: dict[str, Array] = {
        "t": 1e3 * m.t,
        "x": 1e3 * m.x,
        "v": m.v,
        "a": m.a,
        "raw": 1e6 * (d.x - m.x),
    }
    bands = [_add_band(columns, name, columns[name], sigma) for name, sigma in (("v", m.sigma_v), ("a", m.sigma_a))]
    around = _add_band(columns, "raw", np.zeros(len(m)), 1e6 * d.sigma_x)
    columns |= target_positions(run)
    previews: dict[str, list[dict[str, Any]]] = {"v": [], "a": []}
    if other is not None:
        columns |= {"v_other": other[1], "a_other": other[2]}
        previews = {q: [line(f"{q}_other", PREVIEW_COLOUR, label, dash=[6, 3], width=2, loose=True)] for q in previews}
    time = ("t", "time / ms")
    free = _free(run)
    shade = [span(*free, FREE_COLOUR)] if free else []
    named = [span(*free, FREE_COLOUR, "free section")] if free else []
    near = {"focus": list(free)} if free else {}  # the push is much larger than what follows
    grip = {"handles": [{"name": "free", "span": list(free)}]} if free else {}
    shown = [
        plot("Displacement", time, "x / mm", *named, line("x", MEASURED_COLOUR), brush="x", **grip),
        plot("Velocity", time, "v / (m/s)", *shade, bands[0], line("v", MEASURED_COLOUR), *previews["v"], brush="x"),
        plot(
            "Acceleration",
            time,
            "a / (m/s²)",
            *shade,
            bands[1],
            line("a", MEASURED_COLOUR),
            *previews["a"],
            brush="x",
            **near,
        ),
        plot("Measured minus smoothed", time, "x / µm", around, dots("raw", BLUE)),
    ]
    if f is not None:
        columns["F"] = f.F
        layer = _add_band(columns, "F", f.F, f.sigma_F)
        shown.insert(
            3, plot("Friction force", time, "F / N", *shade, layer, line("F", MEASURED_COLOUR), brush="x", **near)
        )
    return PlotData(len(m), columns, shown, [_run_entry(run, 0, len(m), frame=first_frame(run))])


def _free(run: RunResults) -> tuple[float, float] | None:
    """Start and end of the free section, ms."""
    if run.friction is None or not run.friction.free.any():
        return None
    t = 1e3 * run.friction.t[run.friction.free]
    return float(t[0]), float(t[-1])


def comparison_plots(results: Results, model: ModelResults, other: ModelResults | None = None) -> PlotData:
    """Prepare plots of the residual over time, place and velocity, and of both forces; failing spans are marked.

    Parameters
    ----------
    results : Results
        The study.
    model : ModelResults
        The model.
    other : ModelResults, optional
        Another model, drawn in the background.

    """
    runs = [run for run in results.runs if any(curve.run == run.name for curve in model.curves)]
    firsts = np.cumsum([0, *(len(run.motion) for run in runs)])
    parts = [_run_columns(run, model, other) for run in runs]
    columns = {key: np.concatenate([part[key] for part in parts]) for key in (parts[0] if parts else {})}
    columns |= {key: place for run in runs for key, place in target_positions(run).items()}
    unit = residual_unit(model)
    left = f"measured minus modelled / {unit}"
    now = dots("left", by_run=True, main=True)
    behind = [dots("other", "#bbbbbb", label=_model_label(other))] if other is not None else []
    noise = band("noise_low", "noise_high", label="noise")
    looks = [
        _run_entry(
            run, int(firsts[i]), len(run.motion), RUN_STYLES[i % len(RUN_STYLES)]["color"], frame=first_frame(run)
        )
        for i, run in enumerate(runs)
    ]
    order = {look["name"]: (i, look["colour"]) for i, look in enumerate(looks)}
    marks = [
        span(1e3 * s["t"][0], 1e3 * s["t"][1], order[s["run"]][1], foot=order[s["run"]][0])
        for s in _failing_spans(results, model)
        if s["run"] in order
    ]
    forces = [
        line("F", MEASURED_COLOUR, "measured", width=1),
        line("F_model", VERMILION, "model", width=2),
        *([line("F_other", GREEN, _model_label(other), dash=[5, 3])] if other is not None else []),
    ]
    loops = [dots("F", by_run=True), dots("F_model", VERMILION, "model")]
    shown = [
        plot("Residual against time", ("t", "time / ms"), left, *marks, noise, *behind, now),
        plot("Residual against place", ("x", "displacement / mm"), left, *behind, now),
        plot("Residual against velocity", ("v", "velocity / (m/s)"), left, *behind, now),
        plot("Force against time", ("t", "time / ms"), "F / N", *forces, brush="x"),
        plot("Force against velocity", ("v", "velocity / (m/s)"), "F / N", *loops),
    ]
    return PlotData(int(firsts[-1]), columns, shown, looks)


def _model_label(model: ModelResults) -> str:
    """Name of a model with its number; a model that was only tried has no number."""
    return plots.plain_name(model.name) if model.name.startswith("0_") else plots.numbered_name(model.name)


def residual_plots(results: Results, model: ModelResults, other: ModelResults | None = None) -> PlotData:
    """Prepare plots of the residual only; for the arguments see `comparison_plots`."""
    scene = comparison_plots(results, model, other)
    scene.plots = [one for one in scene.plots if one["title"].startswith("Residual")]
    return scene


def _failing_spans(results: Results, model: ModelResults) -> Sequence[Mapping[str, Any]]:
    summary = model.diagnosis or (results.comparison if model.current else None) or {}
    return [s for s in summary.get("fails_at", []) if s.get("t")]


def _run_columns(run: RunResults, model: ModelResults, other: ModelResults | None) -> dict[str, Array]:
    """Columns of one run, one row per frame, NaN where nothing was fitted."""
    m, f = run.motion, run.friction
    rows: dict[str, Array] = {"t": 1e3 * m.t, "x": 1e3 * m.x, "v": m.v}
    rows["F"] = np.full(len(m), np.nan) if f is None else np.where(f.free, f.F, np.nan)
    rows["left"], rows["F_model"], noise = _model_curves(run, model)
    rows["other"], rows["F_other"], _ = _model_curves(run, other)
    rows["noise_low"], rows["noise_high"] = -BAND_SIGMAS * noise, BAND_SIGMAS * noise
    return rows


def _model_curves(run: RunResults, model: ModelResults | None) -> tuple[Array, Array, Array]:
    """Residual, force of the model, and noise at every frame, (n,) each; NaN where nothing was fitted."""
    left, modelled, noise = np.full((3, len(run.motion)), np.nan)
    for part in residuals(model, run) if model else ():
        at = _row_indices(run.motion.t, 1e-3 * part.t)
        left[at], noise[at] = part.values, part.sigma
    for curve in model.curves if model else ():
        if model and curve.run == run.name:
            modelled[_row_indices(run.motion.t, curve.t)] = modelled_force(model, curve)
    return left, modelled, noise


def _row_indices(t: Array, some: Array) -> Any:
    """Indices of some of the times."""
    return np.clip(np.searchsorted(t, some - 1e-9), 0, len(t) - 1)


def _run_entry(
    run: RunResults, first: int, count: int, colour: str = MEASURED_COLOUR, frame: int = 0
) -> dict[str, Any]:
    """Description of a run for the browser: its rows, and the frame number of the first row."""
    return {"name": run.name, "first": first, "count": count, "colour": colour, "frame": frame}
