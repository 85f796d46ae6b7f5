"""Read what the page shows of a study from its files; describe mass, frame rate and scale as they were typed."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from frictrack import flow
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.number_format import format_number, format_plus_minus
from frictrack.base.units import lacks_unit, parse_quantity
from frictrack.measure.calibration import parse_scale
from frictrack.measure.plausibility import EnteredValues, implausible_entries
from frictrack.results import ModelResults, Results
from frictrack.results.verdicts import CHECK_FIRST
from frictrack.study import RunTable, Study, find_recordings, needs_film, read_frame_rate, read_toml
from frictrack.workbench.films import file_version

MAX_RECORDINGS = 1000  # surveyed recordings that are kept


@dataclass(frozen=True)
class Snapshot:
    """What the files of a study said at one moment.

    Attributes
    ----------
    path
        The study file, which need not exist.
    study, results
        The study and its stored results. None without a study file, or if it could not be read so far.
    raw
        The tables of the study file as they are written; empty if it cannot be read.
    changes
        The command history, oldest first.
    tests
        JSON of the tests that were made of its models, as in that of `frictrack history`.
    recordings
        Recordings in the folder of the study file.
    attempted
        The current model with one more effect, by effect, as far as it was fitted for a comparison.
    error
        Why the study file or the results cannot be read; None if they can.

    """

    path: Path
    study: Study | None = None
    results: Results | None = None
    raw: dict[str, Any] = field(default_factory=dict)
    changes: tuple[flow.Change, ...] = ()
    tests: Mapping[str, Any] = field(default_factory=dict)
    recordings: tuple[flow.Surveyed, ...] = ()
    attempted: Mapping[str, ModelResults] = field(default_factory=dict)
    error: str | None = None


class SnapshotReader:
    """Read snapshots of one study file; what has not changed is read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._results = flow.ResultsReader(with_budgets=False)
        self._last = Snapshot(path)

    def read(self) -> Snapshot:
        """Read the files as they are now; nothing is raised: after an error, what was read last stays."""
        recordings = tuple(_survey(path) for path in _recordings(self.path.parent))
        if not self.path.exists():
            vanished = self._last.study is not None or self._last.error is not None
            gone = f"expected the study file {self.path} but it is gone; put it back, or open the sample study"
            self._last = Snapshot(self.path, recordings=recordings, error=gone if vanished else None)
            return replace(self._last)
        try:
            raw = read_toml(self.path.name, self.path.read_text(encoding="utf-8"))
            study = flow.open_study(self.path, allow_incomplete=True)
            history = flow.CommandHistory(study.output)
            results = self._results.read(study)
            names = [candidate["effect"] for candidate in (results.diagnosis or {}).get("candidates", [])]
            attempted = self._results.attempts(study, names)
            changes, tests = tuple(history.changes), flow.SignificanceBudget(study.output).summary()
            self._last = Snapshot(self.path, study, results, raw, changes, tests, recordings, attempted)
        except (FrictrackError, OSError, UnicodeDecodeError) as e:
            return replace(self._last, recordings=recordings, error=str(e))
        return self._last


def _recordings(folder: Path) -> list[Path]:
    try:
        return find_recordings(folder)
    except (FrictrackError, OSError):
        return []


def _survey(path: Path) -> flow.Surveyed:
    """Look at a recording, unless it was looked at before and has not changed."""
    try:
        state = path.stat()
    except OSError as e:
        return flow.Surveyed(path, problem=e.strerror or str(e))
    pictures = len(os.listdir(path)) if path.is_dir() else 0
    return _surveyed(path, state.st_mtime_ns, state.st_size, pictures)


@lru_cache(maxsize=MAX_RECORDINGS)
def _surveyed(path: Path, *_: int) -> flow.Surveyed:
    try:
        return flow.survey_recording(path)
    except (FrictrackError, OSError) as e:
        return flow.Surveyed(path, problem=str(e))


def surveyed_source(path: Any) -> flow.Surveyed | None:
    """Return what is known of the recording of a run; None for one at an address, or one that is gone."""
    return _survey(path) if isinstance(path, Path) and path.exists() else None


def source_version(path: Any) -> str:
    """Return a text that changes when the recording of a run does; "" for one at an address, or one that is gone."""
    return file_version(path) if isinstance(path, Path) and path.exists() else ""


def list_recordings(snapshot: Snapshot) -> list[dict[str, Any]]:
    """List the recordings in the folder of the study file; `skipped` says why one cannot be used."""
    runs = snapshot.study.runs if snapshot.study else ()
    tables = [each.get("table") if isinstance(each, dict) else each for r in runs for each in (r.drive, r.sensor)]
    used = {path.resolve() for path in (*(run.source for run in runs), *tables) if isinstance(path, Path)}
    return [
        {
            "name": seen.path.name,
            "kind": "table" if seen.is_table else "film",
            "words": seen.words,
            "frames": seen.n_frames or None,
            "width": seen.shape[1] or None,
            "height": seen.shape[0] or None,
            "fps": seen.fps,
            "in_study": seen.path.resolve() in used,
            "skipped": _why_skipped(seen.problem, seen.columns_to_confirm),
        }
        for seen in snapshot.recordings
    ]


def _why_skipped(problem: str, columns: Sequence[str]) -> str | None:
    if problem:
        return problem
    return f"expected headers with units but got none; name them in the study file: {columns[0]}" if columns else None


KEYS = ("mass", "fps", "scale")
NAMES = {"mass": "Mass", "fps": "Frame rate", "scale": "Scale"}
TABLE_OF_KEY = {"mass": "study", "fps": "camera", "scale": "camera"}  # where the value for all runs stands
EXAMPLES = {"mass": "0.350 kg", "fps": "4000", "scale": "0.5 mm/px"}
MAX_TEXT = 200  # characters of a typed value
NOTHING_READ: Mapping[str, Any] = {"echo": None, "warning": None, "error": None}

Field = dict[str, Any]  # of the page; see `study_fields`


def study_fields(snapshot: Snapshot, run: RunTable | None = None) -> dict[str, Field]:
    """Describe the values that hold for all runs that have no own, or those of one run: its own or the common ones.

    Parameters
    ----------
    snapshot
        The study as its files are.
    run
        The run; None for all runs.

    Returns
    -------
    dict of dict
        By key: text (as it stands in the study file; "" if absent or drawn on the film), echo (as it was read, with its
        unit), source ("study", "run", "film" where the recording states it, "drawn" or "none"), warning and
        error (sentences; a value with an error cannot be used), needed (nothing can be measured before it is given).

    """
    return {key: _questioned(snapshot, _field_of(snapshot, key, run), run) for key in KEYS}


def check_fields(
    fields: Mapping[str, Any], run: str | None = None, snapshot: Snapshot | None = None
) -> dict[str, Field]:
    """Read values that were typed; nothing is written.

    A number whose missing unit makes it implausible is an error: it is accepted once its unit is typed.

    Parameters
    ----------
    fields
        Typed text or number by "mass", "fps" or "scale".
    run
        Name of the run; None for all runs.
    snapshot
        The study, to tell whether the value is needed.

    """
    return {key: _typed_field(key, fields[key], run, snapshot) for key in KEYS if key in fields}


def new_study(path: Path, recordings: Sequence[str], fields: Mapping[str, Any]) -> None:
    """Write the study file of some recordings; mass, frame rate and scale may still be missing.

    Parameters
    ----------
    path
        Path of the new study file.
    recordings
        Names of recordings in its folder.
    fields
        Typed texts of "mass", "fps" and "scale"; empty ones are left out.

    Raises
    ------
    FrictrackError
        If a value or a recording cannot be used; nothing is written then.

    """
    typed = {key: value for key, value in fields.items() if key in KEYS and value not in (None, "")}
    if errors := [field["error"] for field in check_fields(typed).values() if field["error"]]:
        raise UsageError("; ".join(errors))
    if "fps" in typed:
        rate = read_frame_rate(typed["fps"])
        typed["fps"] = int(rate) if rate == int(rate) else rate
    flow.start_study(path, [path.parent / name for name in recordings], typed, allow_incomplete=True)


def refuse_implausible(table: str, key: str, value: Any) -> None:
    """Raise an error for a typed mass, frame rate or scale that must not be written into the study file.

    Parameters
    ----------
    table, key, value
        As `frictrack.flow.Session.apply` takes them for "edit". Other keys pass, and so does None, which removes a key.

    Raises
    ------
    FrictrackError
        What was expected, what came, what to type instead.

    """
    is_typed = key in KEYS and table in ("study", "camera", "run") and value is not None
    if is_typed and (error := _read_typed(key, value)["error"]):
        raise UsageError(error)


def missing_fields(snapshot: Snapshot) -> list[str]:
    """Return the names of the fields that must be filled in before Run."""
    if snapshot.study is None:
        return []
    return [NAMES[key] for key in KEYS if any(_is_missing(run, key) for run in snapshot.study.runs)]


# --- one field


def _field_of(snapshot: Snapshot, key: str, run: RunTable | None = None) -> Field:
    """The field of one run, or of all: its own value, that of all runs, or what the recordings state."""
    study_runs = list(snapshot.study.runs) if snapshot.study else []
    runs = study_runs if run is None else [run]
    own = common = snapshot.raw.get(TABLE_OF_KEY[key], {}).get(key)
    if run is not None:
        tables = dict(zip((one.name for one in study_runs), snapshot.raw.get("run", []), strict=False))
        own = tables.get(run.name, {}).get(key)
    written = common if own is None else own
    if written is not None:
        source = "run" if run is not None and own is not None else "study"
        reading = _read(key, written)
        if runs and all(one.plausible for one in runs):  # marked as checked in the study file
            reading["warning"] = None
        return _field(key, written, source, reading, text="" if own is None else None)
    rates = {_stated_rate(one) for one in runs if one.video}
    rate = rates.pop() if len(rates) == 1 else None
    if key == "fps" and rate:
        return _field(key, "", "film", _read("fps", rate))
    return _field(key, needed=any(_is_missing(one, key) for one in runs))


def _questioned(snapshot: Snapshot, field: Field, run: RunTable | None) -> Field:
    """Return a field with what the measured motion says against its value: in full where that is the likeliest."""
    every = snapshot.results.implausible if snapshot.results and not (field["warning"] or field["error"]) else ()
    found = [one for one in every if field["key"] in one["check"] and (run is None or one["run"] == run.name)]
    if not found:
        return field
    likeliest = next((str(one["words"]) for one in found if one["check"][0] == field["key"]), "")
    where = ", ".join(dict.fromkeys(NAMES[one["check"][0]].lower() for one in found if one["check"][0] in NAMES))
    return {**field, "warning": f"{CHECK_FIRST} {likeliest or f'see {where}'}."}


def _typed_field(key: str, typed: Any, run: str | None, snapshot: Snapshot | None) -> Field:
    if typed is not None and str(typed).strip():
        return _field(key, typed, "run" if run else "study", _read_typed(key, typed))
    if snapshot is None or snapshot.study is None:
        return _field(key, needed=True)
    common = snapshot.raw.get(TABLE_OF_KEY[key], {}).get(key) if run else None
    runs = [one for one in snapshot.study.runs if run in (None, one.name)]
    return _field(key, needed=common is None and any(_needs(one, key) for one in runs))


def _field(
    key: str,
    written: Any = "",
    source: str = "none",
    reading: Mapping[str, Any] = NOTHING_READ,
    *,
    text: str | None = None,
    needed: bool = False,
) -> Field:
    """One field; a scale that was drawn on the film, or is given by something else than a number, has no text."""
    drawn = isinstance(written, dict | list)
    text = ("" if drawn else str(written)[:MAX_TEXT]) if text is None else text
    return {"key": key, "text": text, "source": "drawn" if drawn else source, "needed": needed, **reading}


# --- what is needed


def _needs(run: RunTable, key: str) -> bool:
    """Return whether a run cannot be measured without a value of its own or of all runs."""
    if run.video:
        return not (key == "fps" and _stated_rate(run))
    seen = surveyed_source(run.source)
    is_measured = run.sensor is not None or run.is_of_points or "friction" in run.columns
    return key == "mass" and not is_measured and (seen is None or seen.needs_mass or "mass" in seen.stated)


def _is_missing(run: RunTable, key: str) -> bool:
    return getattr(run, key) is None and _needs(run, key)


def _stated_rate(run: RunTable) -> float | None:
    """Return the frame rate that the recording of a run states, 1/s."""
    seen = surveyed_source(run.source) if run.video else None
    return seen.fps if seen and seen.fps_source == "stated by the file" else None


# --- reading a value


def _read_typed(key: str, typed: Any) -> dict[str, Any]:
    """Read a typed value; a number that lacks its unit and is implausible must be typed with the unit."""
    reading = _read(key, typed)
    if reading["warning"] and key != "fps" and lacks_unit(typed):
        return {**NOTHING_READ, "error": reading["warning"]}
    return reading


def _read(key: str, value: Any) -> dict[str, Any]:
    """Read a value: its echo, a warning if no laboratory has it, or why it cannot be used."""
    value = value.strip() if isinstance(value, str) else value
    try:
        echo, entered = {"mass": _read_mass, "fps": _read_rate, "scale": _read_scale}[key](value)
    except (FrictrackError, ValueError, TypeError) as e:
        return {**NOTHING_READ, "error": str(e)}
    bare = frozenset({key}) if key != "fps" and lacks_unit(value) else frozenset()
    found = implausible_entries(EnteredValues(**entered, bare=bare))
    return {"echo": echo, "warning": str(found[0]) if found else None, "error": None}


def _read_mass(value: Any) -> tuple[str, dict[str, Any]]:
    if value == "fit":
        return "fitted from the measured drive", {}
    mass, std = parse_quantity(value, "kg", "mass", above=0.0)
    number = format_plus_minus(mass, std) if std else max(f"{mass:g}", format_number(mass), key=len)
    return f"{number} kg", {"mass": mass}


def _read_rate(value: Any) -> tuple[str, dict[str, Any]]:
    rate = read_frame_rate(value)
    return f"{rate:g} /s", {"fps": rate}


def _read_scale(value: Any) -> tuple[str, dict[str, Any]]:
    pitch, relative = (math.nan, 0.0) if needs_film(value) else parse_scale(value)
    if not math.isfinite(pitch):
        return "measured in the film", {}
    number = format_plus_minus(1e3 * pitch, 1e3 * pitch * relative) if relative else f"{1e3 * pitch:g}"
    return f"{number} mm/px", {"pitch": pitch}
