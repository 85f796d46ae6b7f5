"""Convert runs, fits and diagnoses to what figures are drawn from; read back the data that a figure shows."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from frictrack.base.errors import result_or_none
from frictrack.measure.friction import find_events, friction
from frictrack.records import Array, Filtered, Friction, Run
from frictrack.results import ModelResults, RunResults

if TYPE_CHECKING:
    import pandas as pd


class FitLike(Protocol):
    """What can be converted to the results of a model: a fit."""

    def to_results(self) -> ModelResults:
        """Return the results of the model."""
        ...


class Summarised(Protocol):
    """What has a JSON summary and curves: a diagnosis."""

    figures: dict[str, dict[str, Array]]

    def summary(self) -> dict[str, Any]:
        """Return the JSON."""
        ...


AnyRun = RunResults | Run
AnyModel = ModelResults | FitLike | Mapping[str, Any]
AnySummary = Mapping[str, Any] | Summarised


def as_run(run: AnyRun) -> RunResults:
    """Convert a run to the results of a run: its events are found, its friction force is computed.

    Parameters
    ----------
    run : RunResults or Run
        Stored results are returned as they are.

    """
    if isinstance(run, RunResults):
        return run
    weighed = None if run.mass is None else (run.mass, run.sigma_mass)
    more: dict[str, Any] = {"events": find_events(run), "friction": _friction_of(run)}
    more |= {"role": run.role, "group": run.group}
    more["settings"] = {"mass": weighed, "columns": {"v": "v"} if run.steady else {}}
    return RunResults(run.name, "", run.displacement, _smoothed(run), run.motion, **more)


def as_runs(runs: Sequence[AnyRun]) -> list[RunResults]:
    """Convert runs; see `as_run`."""
    return [as_run(run) for run in runs]


def as_model(model: AnyModel) -> ModelResults:
    """Convert a fit, or the errors of one in a comparison, to the results of a model."""
    if isinstance(model, Mapping):
        return ModelResults(model["name"], "+".join(model["model"]), dict(model), ())
    return model if isinstance(model, ModelResults) else model.to_results()


def as_summary(found: AnySummary) -> Mapping[str, Any]:
    """Convert a diagnosis to its JSON; JSON is returned as it is."""
    return found if isinstance(found, Mapping) else found.summary()


def _smoothed(run: Run) -> Filtered:
    """The smoothed displacement that the motion of a run was made from, as if a filter had been asked for."""
    measured, motion = run.displacement, run.motion
    sigma = np.where(measured.known, measured.sigma_x, np.inf)
    how = json.loads(motion.filter)["method"] if motion.filter else "smoothed as given"
    return Filtered(
        motion.t, motion.x, measured.y, sigma, measured.sigma_y, reason=how, asked=True, x_measured=measured.x
    )


def _friction_of(run: Run) -> Friction | None:
    """Friction force of a run; None without a mass, or if it has no free section."""
    if run.mass is None and run.friction_N is None:
        return None
    return result_or_none(friction, run)


COLUMNS = ("panel", "title", "x_axis", "y_axis", "number", "curve", "kind", "x", "y", "label")
Drawn = tuple[str, str, Array]  # name and kind of a curve, and its points (n, 2)
_SPANS = {"x": "colspan", "y": "rowspan"}


def plotted_data(figure: Figure) -> pd.DataFrame:
    """Return the data of a figure, one row per point.

    Parameters
    ----------
    figure : Figure
        The figure.

    Returns
    -------
    DataFrame
        `panel` counts the panels from 1 and `number` the curves in it. `curve` is the name in the legend, if there is
        one, and `kind` is "line", "points", "band" (the outline of the area) or "bar" (its end). `x` and `y` are as
        drawn, in the units of the axes, whose labels are `x_axis` and `y_axis`; `label` is the name that stands at an
        axis of names. Pictures, and marks over the whole panel, are left out.

    Examples
    --------
    >>> figure = Figure()
    >>> line = figure.subplots().plot([0, 1], [2.0, 3.0], label="measured")
    >>> plotted_data(figure)[["curve", "x", "y"]].values.tolist()
    [['measured', 0.0, 2.0], ['measured', 1.0, 3.0]]

    """
    import pandas as pd  # noqa: PLC0415 - slow to load

    tables = [pd.DataFrame(columns=list(COLUMNS))]
    for number, ax in enumerate(figure.axes, 1):
        about = {"panel": number, "title": _title(ax), "x_axis": _label(ax, "x"), "y_axis": _label(ax, "y")}
        texts = [_names_at(axis) for axis in (ax.xaxis, ax.yaxis)]
        for k, (name, kind, points) in enumerate(_drawn(ax), 1):
            labels = [_point_label(texts, point) for point in points.tolist()] if any(texts) else ""
            curve = {"number": k, "curve": name, "kind": kind, "x": points[:, 0], "y": points[:, 1], "label": labels}
            tables.append(pd.DataFrame(about | curve))
    return pd.concat(tables[1:] or tables, ignore_index=True)


def _drawn(ax: Axes) -> Iterator[Drawn]:
    """Yield what is drawn in one panel, in the coordinates of its data."""
    for line in ax.lines:
        if line.get_transform() == ax.transData:
            kind = "points" if line.get_linestyle() == "None" else "line"
            yield _name(line), kind, np.asarray(line.get_xydata(), dtype=np.float64)
    for area in ax.collections:
        if isinstance(area, PathCollection):
            yield _name(area), "points", np.ma.filled(np.ma.asarray(area.get_offsets()), np.nan)
        elif isinstance(area, PolyCollection) and area.get_transform() == ax.transData:
            for path in area.get_paths():
                yield _name(area), "band", np.asarray(path.vertices, dtype=np.float64)
    for bars in ax.containers:
        if isinstance(bars, BarContainer):
            yield _bars(bars)


def _bars(bars: BarContainer) -> Drawn:
    """Return the ends of bars."""
    boxes = [bar.get_bbox() for bar in bars.patches]
    if bars.orientation == "horizontal":
        points = [(box.x1, (box.y0 + box.y1) / 2) for box in boxes]
    else:
        points = [((box.x0 + box.x1) / 2, box.y1) for box in boxes]
    return _name(bars), "bar", np.reshape(np.array(points, dtype=np.float64), (-1, 2))


def _names_at(axis: Axis) -> dict[float, str]:
    """Return the names at an axis by place; empty for an axis of numbers."""
    places = axis.get_ticklocs() if isinstance(axis.get_major_locator(), FixedLocator) else ()
    texts = [" ".join(text.split()) for text in axis.get_major_formatter().format_ticks(list(places))]
    return {place: text for place, text in zip(places, texts, strict=True) if any(map(str.isalpha, text))}


def _point_label(names: Sequence[dict[float, str]], point: Sequence[float]) -> str:
    """Return the name at which a point stands; `names` are those of the axes."""
    near = (
        text for texts, at in zip(names, point, strict=True) for place, text in texts.items() if abs(place - at) < 0.5
    )
    return next(near, "")


def _title(ax: Axes) -> str:
    return ax.get_title(loc="left") or ax.get_title()


def _label(ax: Axes, which: str) -> str:
    """Return the label of an axis; panels in one row or column may have it once."""
    texts = [getattr(one, f"get_{which}label")() for one in (ax, *_in_line(ax, which))]
    return " ".join(next((text for text in texts if text), "").split())


def _in_line(ax: Axes, which: str) -> Iterator[Axes]:
    """Yield the panels of the same grid below and above a panel ("x"), or beside it ("y")."""
    own = ax.get_subplotspec()
    for other in ax.figure.axes if own is not None else ():
        spec = other.get_subplotspec()
        in_grid = spec is not None and own is not None and spec.get_gridspec() is own.get_gridspec()
        if in_grid and getattr(spec, _SPANS[which]) == getattr(own, _SPANS[which]):
            yield other


def _name(artist: Any) -> str:
    label = str(artist.get_label())
    return "" if label.startswith("_") else label
