"""Prepare results as data of linked plots. Each row is a frame, so one selection holds in all plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictrack import plots
from frictrack.plots import modelled_force, residual_unit, residuals
from frictrack.plots.style import BAND_SIGMAS, BLUE, GREEN, ORANGE, PURPLE, RUN_STYLES, SKY, VERMILLION
from frictrack.records import Array, Track
from frictrack.results import ModelResults, Results, RunResults

BAND, FREE, MEASURED = "#e0e0e0", "rgba(0,158,115,.12)", "#333333"
GHOST = VERMILLION  # of a motion that is only previewed
TARGET = "target"
TRACKS = (ORANGE, SKY, GREEN, PURPLE)


@dataclass
class PlotData:
    """Plots over columns of the same `rows`, which may come from several runs one after the other."""

    rows: int = 0
    columns: dict[str, Array] = field(default_factory=dict)
    plots: list[dict[str, Any]] = field(default_factory=list)
    runs: list[dict[str, Any]] = field(default_factory=list)

    def packed(self) -> tuple[dict[str, Any], bytes]:
        """Where every column lies, and all of them as Float32: good for drawing, the numbers stay here."""
        places, parts, at = {}, [], 0
        for key, column in self.columns.items():
            part = np.asarray(column, dtype="<f4")
            places[key], at = [at, len(part)], at + len(part)
            parts.append(part.tobytes())
        scene = {"rows": self.rows, "columns": places, "plots": self.plots, "runs": self.runs, "keep": True}
        return scene, b"".join(parts)

    def place(self, row: int) -> tuple[str, int]:
        """Run and frame of a row."""
        run = next(r for r in self.runs if r["first"] <= row < r["first"] + r["count"])
        return run["name"], row - run["first"] + run["frame"]


def plot(title: str, x: tuple[str, str], y: str, *layers: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """One plot: `x` is (column, label), `y` a label."""
    return {
        "id": title,
        "title": title,
        "x": {"column": x[0], "label": x[1]},
        "y": {"label": y},
        "layers": list(layers),
        **more,
    }


def line(y: str, colour: str, label: str = "", **more: Any) -> dict[str, Any]:
    """A line through the values of a column, broken where they are not known."""
    return {"kind": "line", "y": y, "colour": colour, "label": label, **more}


def dots(y: str, colour: str = MEASURED, label: str = "", **more: Any) -> dict[str, Any]:
    """A point for every row."""
    return {"kind": "dots", "y": y, "colour": colour, "label": label, **more}


def band(low: str, high: str, colour: str = BAND, label: str = "", **more: Any) -> dict[str, Any]:
    """The area between two columns."""
    return {"kind": "band", "low": low, "high": high, "colour": colour, "label": label, **more}


def span(begin: float, end: float, colour: str, label: str = "", **more: Any) -> dict[str, Any]:
    """A shade from one value of x to another, or with `foot` a bar in that line at the foot."""
    return {"kind": "span", "from": begin, "to": end, "colour": colour, "label": label, **more}


def _add_band(columns: dict[str, Array], name: str, middle: Array, sigma: Array) -> dict[str, Any]:
    """Columns of a band around a curve, and its layer."""
    columns[f"{name}_low"], columns[f"{name}_high"] = middle - BAND_SIGMAS * sigma, middle + BAND_SIGMAS * sigma
    return band(f"{name}_low", f"{name}_high", label=f"± {BAND_SIGMAS:g} std")


# --- the tabs


def tracked(run: RunResults) -> PlotData:
    """How well the target was followed: place, standard deviation and match score of every frame."""
    track = run.track
    if track is None:
        return PlotData()
    columns = {"t": 1e3 * track.t, "sigma": 1e3 * track.sigma_px, "score": track.score}
    columns |= places(run)
    time = ("t", "time / ms")
    shown = [
        plot("Place in the picture", time, "x / px", line(on_film(TARGET, "x", run), MEASURED), brush="x"),
        plot("Height in the picture", time, "y / px", line(on_film(TARGET, "y", run), MEASURED), brush="x"),
        plot("Standard deviation of the place", time, "sigma / 0.001 px", dots("sigma", BLUE)),
        plot("Match score", time, "score", dots("score", GREEN)),
    ]
    return PlotData(len(track), columns, shown, [_run(run, 0, len(track))])


def tracks(run: RunResults) -> dict[str, Track]:
    """The target and all that was tracked beside it."""
    beside = {name: track for name, track in run.tracks.items() if name != "backward"}
    return {TARGET: run.track, **beside} if run.track is not None else {}


def on_film(name: str, axis: str, run: RunResults) -> str:
    """The column that says where something was in every frame of a run's own film, px."""
    return f"{name}_{axis}:{run.name}"


def places(run: RunResults) -> dict[str, Array]:
    """Where the target and all beside it are in every frame of the run's own film, px."""
    found = {name: {"x": track.x_px, "y": track.y_px} for name, track in tracks(run).items()}
    return {on_film(name, axis, run): q for name, place in found.items() for axis, q in place.items()}


def first_frame(run: RunResults) -> int:
    """Number of the film's frame with which the motion of a run begins."""
    if run.track is None:
        return 0
    return int(np.searchsorted(run.track.t, run.motion.t[0] - 0.5 * np.median(np.diff(run.track.t))))


def motion(run: RunResults, other: Array | None = None, label: str = "") -> PlotData:
    """Displacement, velocity, acceleration and friction of one run with their bands; the free section has handles.

    `other` (3, n) is x, v and a smoothed otherwise, which lie over v and a as ghosts; the axes stay.
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
    columns |= places(run)
    ghosts: dict[str, list[dict[str, Any]]] = {"v": [], "a": []}
    if other is not None:
        columns |= {"v_ghost": other[1], "a_ghost": other[2]}
        ghosts = {q: [line(f"{q}_ghost", GHOST, label, dash=[6, 3], width=2, loose=True)] for q in ghosts}
    time = ("t", "time / ms")
    free = _free(run)
    shade = [span(*free, FREE)] if free else []
    named = [span(*free, FREE, "free section")] if free else []
    near = {"focus": list(free)} if free else {}  # the push would flatten all that comes after
    grip = {"handles": [{"name": "free", "span": list(free)}]} if free else {}
    shown = [
        plot("Displacement", time, "x / mm", *named, line("x", MEASURED), brush="x", **grip),
        plot("Velocity", time, "v / (m/s)", *shade, bands[0], line("v", MEASURED), *ghosts["v"], brush="x"),
        plot(
            "Acceleration", time, "a / (m/s²)", *shade, bands[1], line("a", MEASURED), *ghosts["a"], brush="x", **near
        ),
        plot("Measured minus smoothed", time, "x / µm", around, dots("raw", BLUE)),
    ]
    if f is not None:
        columns["F"] = f.F
        layer = _add_band(columns, "F", f.F, f.sigma_F)
        shown.insert(3, plot("Friction force", time, "F / N", *shade, layer, line("F", MEASURED), brush="x", **near))
    return PlotData(len(m), columns, shown, [_run(run, 0, len(m), frame=first_frame(run))])


def _free(run: RunResults) -> tuple[float, float] | None:
    """First and last time of the free section, ms."""
    if run.friction is None or not run.friction.free.any():
        return None
    t = 1e3 * run.friction.t[run.friction.free]
    return float(t[0]), float(t[-1])


def compared(results: Results, model: ModelResults, ghost: ModelResults | None = None) -> PlotData:
    """Measured minus modelled against time, place and velocity, and the forces of both; failing spans are shaded.

    `ghost` is another model, whose residual and force lie behind.
    """
    runs = [run for run in results.runs if any(curve.run == run.name for curve in model.curves)]
    firsts = np.cumsum([0, *(len(run.motion) for run in runs)])
    parts = [_rows(run, model, ghost) for run in runs]
    columns = {key: np.concatenate([part[key] for part in parts]) for key in (parts[0] if parts else {})}
    columns |= {key: place for run in runs for key, place in places(run).items()}
    unit = residual_unit(model)
    left = f"measured minus modelled / {unit}"
    now = dots("left", by_run=True, main=True)
    behind = [dots("ghost", "#bbbbbb", label=_called(ghost))] if ghost is not None else []
    noise = band("noise_low", "noise_high", label="noise")
    looks = [
        _run(run, int(firsts[i]), len(run.motion), RUN_STYLES[i % len(RUN_STYLES)]["color"], frame=first_frame(run))
        for i, run in enumerate(runs)
    ]
    order = {look["name"]: (i, look["colour"]) for i, look in enumerate(looks)}
    marks = [
        span(1e3 * s["t"][0], 1e3 * s["t"][1], order[s["run"]][1], foot=order[s["run"]][0])
        for s in _fails(results, model)
        if s["run"] in order
    ]
    forces = [
        line("F", MEASURED, "measured", width=1),
        line("F_model", VERMILLION, "model", width=2),
        *([line("F_ghost", GREEN, _called(ghost), dash=[5, 3])] if ghost is not None else []),
    ]
    loops = [dots("F", by_run=True), dots("F_model", VERMILLION, "model")]
    shown = [
        plot("Residual against time", ("t", "time / ms"), left, *marks, noise, *behind, now),
        plot("Residual against place", ("x", "displacement / mm"), left, *behind, now),
        plot("Residual against velocity", ("v", "velocity / (m/s)"), left, *behind, now),
        plot("Force against time", ("t", "time / ms"), "F / N", *forces, brush="x"),
        plot("Force against velocity", ("v", "velocity / (m/s)"), "F / N", *loops),
    ]
    return PlotData(int(firsts[-1]), columns, shown, looks)


def _called(model: ModelResults) -> str:
    """A model's name with its number; one that was only attempted has none."""
    return plots.plain_name(model.name) if model.name.startswith("0_") else plots.numbered_name(model.name)


def residual(results: Results, model: ModelResults, ghost: ModelResults | None = None) -> PlotData:
    """What the model leaves over against time, place and velocity, on what an attempt would leave."""
    scene = compared(results, model, ghost)
    scene.plots = [one for one in scene.plots if one["title"].startswith("Residual")]
    return scene


def _fails(results: Results, model: ModelResults) -> Sequence[Mapping[str, Any]]:
    summary = model.diagnosis or (results.comparison if model.current else None) or {}
    return [s for s in summary.get("fails_at", []) if s.get("t")]


def _rows(run: RunResults, model: ModelResults, ghost: ModelResults | None) -> dict[str, Array]:
    """Columns of one run, a row per frame, NaN where nothing was fitted."""
    m, f = run.motion, run.friction
    rows: dict[str, Array] = {"t": 1e3 * m.t, "x": 1e3 * m.x, "v": m.v}
    rows["F"] = np.full(len(m), np.nan) if f is None else np.where(f.free, f.F, np.nan)
    rows["left"], rows["F_model"], noise = _model_curves(run, model)
    rows["ghost"], rows["F_ghost"], _ = _model_curves(run, ghost)
    rows["noise_low"], rows["noise_high"] = -BAND_SIGMAS * noise, BAND_SIGMAS * noise
    return rows


def _model_curves(run: RunResults, model: ModelResults | None) -> tuple[Array, Array, Array]:
    """What a model leaves over of a run, its force, and the noise, at every frame."""
    left, modelled, noise = np.full((3, len(run.motion)), np.nan)
    for part in residuals(model, run) if model else ():
        at = _at(run.motion.t, 1e-3 * part.t)
        left[at], noise[at] = part.values, part.sigma
    for curve in model.curves if model else ():
        if model and curve.run == run.name:
            modelled[_at(run.motion.t, curve.t)] = modelled_force(model, curve)
    return left, modelled, noise


def _at(t: Array, some: Array) -> Any:
    """Rows of some of the times."""
    return np.clip(np.searchsorted(t, some - 1e-9), 0, len(t) - 1)


def _run(run: RunResults, first: int, count: int, colour: str = MEASURED, frame: int = 0) -> dict[str, Any]:
    """What the page is given of a run: its rows, and the number of the film's frame that the first of them is."""
    return {"name": run.name, "first": first, "count": count, "colour": colour, "frame": frame}
