"""Curves, parameters, errors and error budgets of a study as pandas tables."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from frictrack.records import ModelledMotion, Track
from frictrack.results import ModelResults, Results, RunResults, to_builtins

SIGMA, MODEL = "sigma_", "_model"
MAX_TIME_DIFFERENCE_S = 1e-9  # between two records of the same frame
NOTHING: Mapping[str, str] = {}
MEANINGS = {
    "t": "time",
    "x_measured": "measured displacement along the course",
    "y_measured": "measured displacement across the course",
    "angle": "rotation of the target, counter-clockwise",
    "valid": "whether the frame was measured and is no outlier",
    "repaired": "0 as measured, 1 tracked again, 2 interpolated, 3 left out",
    "x": "smoothed displacement along the course",
    "v": "velocity",
    "a": "acceleration",
    "a_y": "acceleration across the course",
    "F": "friction force",
    "free": "whether the mass slides freely",
    "drive": "measured drive force",
    "a_sensor": "acceleration of the accelerometer",
    "friction_sensor": "measured friction force",
    "a_known": "acceleration of the accelerometer without gain and bias",
    "x_px": "position in the picture, to the right",
    "y_px": "position in the picture, downward",
    "angle_picture": "rotation of the target in the picture, clockwise",
    "score": "match score",
    "reason": "why the target was lost",
    "blow": "whether the frame belongs to an unresolved collision",
    "segment": "number of the segment",
}  # by name of a column without `SIGMA` and `MODEL`
_RENAMED_DISPLACEMENT = {name: f"{name}_measured" for name in ("x", "y", "sigma_x", "sigma_y")}
_RENAMED_SENSORS = {"a": "a_sensor", "friction_N": "friction_sensor", "known_a": "a_known"}
_RENAMED_TRACK = {"sigma_px": "sigma_x_px", "angle": "angle_picture", "sigma_angle": "sigma_angle_picture"}


@dataclass(frozen=True, eq=False)
class Column:
    """One column of a table.

    Attributes
    ----------
    name
        Its name, without unit.
    values
        One value per row, (n,).
    unit
        Unit of the values; empty for truth values and texts.

    """

    name: str
    values: NDArray[Any]
    unit: str

    @property
    def meaning(self) -> str:
        """What the column holds, in words."""
        return describe(self.name)


def describe(name: str) -> str:
    """Return what a column holds, in words.

    Examples
    --------
    >>> describe("sigma_v_model")
    'standard deviation of velocity by the current model'

    """
    bare = name.removeprefix(SIGMA).removesuffix(MODEL)
    by_model = " by the current model" if name.endswith(MODEL) else ""
    return ("standard deviation of " if name.startswith(SIGMA) else "") + MEANINGS[bare] + by_model


def curve_columns(run: RunResults, own: ModelledMotion | None) -> list[Column]:
    """Return time, displacement, motion and friction of one run, with the motion by the current model."""
    t = run.displacement.t
    found = [Column("t", t, "s"), Column("x_measured", run.displacement.x, "m")]
    for record in (run.motion, run.friction):
        found += _columns_of(record)
    if own is not None:
        rows = np.searchsorted(t, own.t - MAX_TIME_DIFFERENCE_S)
        for one in _columns_of(own):
            if one.unit:
                whole = np.full(len(t), np.nan)
                whole[rows] = one.values
                found.append(Column(one.name + MODEL, whole, one.unit))
    return _each_once(found)


def all_columns(run: RunResults, own: ModelledMotion | None) -> list[Column]:
    """Return all that is known of a run at the frames of its displacement: `curve_columns`, and how it was measured."""
    curves = curve_columns(run, own)
    measured = _columns_of(run.displacement, _RENAMED_DISPLACEMENT)
    return _each_once([curves[0], *measured, *_columns_of(run.sensors, _RENAMED_SENSORS), *curves[1:]])


def track_columns(track: Track) -> list[Column]:
    """Return time, position in the picture and quality of a target in every frame of the film."""
    return [Column("t", track.t, "s"), *_columns_of(track, _RENAMED_TRACK)]


def motion_columns(motion: ModelledMotion) -> list[Column]:
    """Return the motion of a run by one model, at the frames that were fitted or predicted."""
    return [Column("t", motion.t, "s"), *_columns_of(motion)]


def own_motion(results: Results) -> dict[str, ModelledMotion]:
    """Return the motion by the current model, by run."""
    return {motion.run: motion for motion in results.current.motion} if results.current else {}


def column_groups(results: Results) -> Iterator[tuple[str, dict[str, str], list[Column]]]:
    """Yield all columns of a study: their kind ("runs", "tracks" or "models"), what they belong to, and the columns."""
    own = own_motion(results)
    for run in results.runs:
        yield "runs", {"run": run.name}, all_columns(run, own.get(run.name))
        for name, track in run.all_tracks.items():
            yield "tracks", {"run": run.name, "target": name}, track_columns(track)
    for model in results.models:
        for one in model.motion:
            yield "models", {"model": model.name, "run": one.run}, motion_columns(one)


def run_attributes(run: RunResults) -> dict[str, Any]:
    """Return numbers and texts that describe a run; lists and dictionaries as JSON."""
    d = run.displacement
    found = {
        "run": run.name,
        "source": run.source,
        "role": run.role,
        "group": run.group,
        "mass_kg": run.mass,
        "cutoff_Hz": run.motion.cutoff,
        "guard_frames": run.motion.guard,
        "pixel_pitch_m": d.pixel_pitch,
        "relative_scale_error": d.relative_scale_error,
        "systematic_error_m": d.systematic,
        "resolution_m": d.resolution,
        "fps_Hz": run.film.fps if run.film else None,
        "film_sha256": run.film.hash if run.film else None,
        "free_section": run.friction.reason if run.friction else None,
        "events": as_json(run.events.events),
        "settings": as_json(run.settings),
        "stage_hashes": as_json(run.hashes),
        "notes": as_json(run.notes),
    }
    return {name: value for name, value in found.items() if value not in (None, "")}


def study_attributes(results: Results) -> dict[str, str]:
    """Return texts that describe a study."""
    about = {"title": results.name, "source": f"frictrack {results.version}", "study": results.path.name}
    about["notes"] = as_json([*results.notes, *results.warnings])
    return about | ({} if results.comparison is None else {"comparison": as_json(results.comparison)})


def model_attributes(model: ModelResults) -> dict[str, str]:
    """Return texts that describe a model: its equation and, if it was diagnosed, the diagnosis as JSON."""
    about = {"equation": model.equation}
    return about | ({} if model.diagnosis is None else {"diagnosis": as_json(model.diagnosis)})


def _columns_of(record: Any, renamed: Mapping[str, str] = NOTHING) -> Iterator[Column]:
    """Yield the columns of a record that were measured, without its time."""
    for f in fields(record) if record is not None else ():
        values = getattr(record, f.name)
        if f.metadata.get("column") and f.name != "t" and values is not None:
            yield Column(renamed.get(f.name, f.name), np.asarray(values), str(f.metadata["unit"]))


def _each_once(columns: Iterable[Column]) -> list[Column]:
    """Return columns without repeated names; the last one of a name is kept, at the place of the first."""
    return list({column.name: column for column in columns}.values())


def as_json(value: Any) -> str:
    """Return a value as JSON."""
    return json.dumps(to_builtins(value), ensure_ascii=False)


SUMMARIES = ("parameters", "errors", "budget")  # names of the tables of all runs together


def plain_tables(results: Results) -> dict[str, pd.DataFrame]:
    """Return the curves of every run with units in the headers, then the summaries, each by a name of its own."""
    own = own_motion(results)
    tables = {}
    for run in results.runs:
        columns = {_header(column): column.values for column in curve_columns(run, own.get(run.name))}
        tables[f"run {run.name}" if run.name in SUMMARIES else run.name] = pd.DataFrame(columns)
    return tables | summary_tables(results)


def summary_tables(results: Results) -> dict[str, pd.DataFrame]:
    """Return parameters and errors of all models, and the error budgets of the runs if there are any."""
    errors = pd.DataFrame([{"model": model.name, **model.summary["errors"]} for model in results.models])
    tables = {"parameters": parameters_table(results.models), "errors": errors}
    return tables | ({"budget": budget_table(results.runs)} if any(run.budget for run in results.runs) else {})


def _header(column: Column) -> str:
    """Return the header of a column, with its unit.

    Examples
    --------
    >>> import numpy as np
    >>> _header(Column("a", np.zeros(1), "m/s^2"))
    'a_ms2'

    """
    unit = re.sub(r"[/^]", "", column.unit)
    return f"{column.name}_{unit}" if unit else column.name


def parameters_table(models: Iterable[ModelResults]) -> pd.DataFrame:
    """Return the parameters of models, one row per model and parameter."""
    found = ((model.name, *item) for model in models for item in model.summary["parameters"].items())
    return pd.DataFrame([{"model": model, "parameter": name, **_flat(values)} for model, name, values in found])


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a parameter as cells: ``mu`` and ``mu_std``, ``interval_low`` and ``interval_high``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= {key if part == "value" else f"{key}_{part}": one for part, one in value.items()}
        elif key == "interval":
            flat |= dict(zip(("interval_low", "interval_high"), value or (None, None), strict=True))
        else:
            flat[key] = value if isinstance(value, (str, int, float, type(None))) else json.dumps(value)
    return flat


def budget_table(runs: Iterable[RunResults]) -> pd.DataFrame:
    """Return every source of error of the friction force of runs; an empty cell is unknown."""
    return pd.DataFrame([{"run": run.name, **row} for run in runs for row in run.budget.get("rows", ())])
