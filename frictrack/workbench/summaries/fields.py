"""Describe mass, frame rate and scale: the text in the study file, the value as it was read, warnings and errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_number, format_plus_minus
from frictrack.base.units import lacks_unit
from frictrack.flow import start_study, table_needs_mass
from frictrack.measure.calibration import parse_scale
from frictrack.measure.plausibility import EnteredValues, implausible_entries
from frictrack.results.verdicts import CHECK_FIRST
from frictrack.study import RunTable, Study, needs_film, read_frame_rate, to_si
from frictrack.workbench.summaries.snapshot import Snapshot, file_version, surveyed_source

KEYS = ("mass", "fps", "scale")
NAMES = {"mass": "Mass", "fps": "Frame rate", "scale": "Scale"}
TABLE_OF_KEY = {"mass": "study", "fps": "camera", "scale": "camera"}  # where the value for all runs stands
EXAMPLES = {"mass": "0.350 kg", "fps": "4000", "scale": "0.5 mm/px"}
MAX_TEXT = 200  # characters of a typed value
_MASS_NEEDED: dict[Any, bool] = {}  # whether a table needs a mass, by its version and columns


class Field(TypedDict):
    """One input field.

    Attributes
    ----------
    key
        "mass", "fps" or "scale".
    text
        The value as it stands in the study file; "" if it is absent or was drawn on the film.
    echo
        The value as it was read, with its unit.
    source
        "study" (for all runs), "run", "film" (stated by the recording), "drawn", or "none".
    warning, error
        A sentence; a value with an error cannot be used.
    needed
        Whether nothing can be measured before it is given.

    """

    key: str
    text: str
    echo: str | None
    source: str
    warning: str | None
    error: str | None
    needed: bool


@dataclass(frozen=True)
class _Reading:
    """A value as it was read: its echo, or why it cannot be used."""

    echo: str | None = None
    warning: str | None = None
    error: str | None = None


def study_fields(snapshot: Snapshot) -> dict[str, Field]:
    """Describe the values that hold for all runs that have no own.

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    return {key: _questioned(snapshot, _study_field(snapshot, key)) for key in KEYS}


def run_fields(snapshot: Snapshot, run: RunTable) -> dict[str, Field]:
    """Describe the values of one run: its own, or those that it inherits.

    Parameters
    ----------
    snapshot
        The study as its files are.
    run
        One of its runs.

    """
    return {key: _questioned(snapshot, _run_field(snapshot, run, key), run.name) for key in KEYS}


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
        raise FrictrackError("; ".join(errors), usage=True)
    if "fps" in typed:
        rate = read_frame_rate(typed["fps"])
        typed["fps"] = int(rate) if rate == int(rate) else rate
    start_study(path, [path.parent / name for name in recordings], typed, allow_incomplete=True)


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
    if key in KEYS and table in ("study", "camera", "run") and value is not None:
        error = _read_typed(key, value).error
        if error:
            raise FrictrackError(error, usage=True)


def missing_fields(snapshot: Snapshot) -> list[str]:
    """Return the names of the fields that must be filled in before Run.

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    if snapshot.study is None:
        return []
    return [NAMES[key] for key in KEYS if any(_is_missing(run, key) for run in snapshot.study.runs)]


# --- one field


def _questioned(snapshot: Snapshot, field: Field, run: str | None = None) -> Field:
    """Return a field with what the measured motion says against its value: in full where that is the likeliest."""
    every = snapshot.results.implausible if snapshot.results and not (field["warning"] or field["error"]) else ()
    found = [one for one in every if field["key"] in one["check"] and run in (None, one["run"])]
    if not found:
        return field
    likeliest = next((str(one["words"]) for one in found if one["check"][0] == field["key"]), "")
    where = ", ".join(dict.fromkeys(NAMES[one["check"][0]].lower() for one in found if one["check"][0] in NAMES))
    return {**field, "warning": f"{CHECK_FIRST} {likeliest or f'see {where}'}."}


def _study_field(snapshot: Snapshot, key: str) -> Field:
    written = snapshot.raw.get(TABLE_OF_KEY[key], {}).get(key)
    needed = snapshot.study is not None and any(_is_missing(run, key) for run in snapshot.study.runs)
    if written is None:
        return _from_recordings(snapshot, key, needed=needed)
    return _field(key, written, "drawn" if _is_drawn(written) else "study", _read_written(key, written, snapshot.study))


def _run_field(snapshot: Snapshot, run: RunTable, key: str) -> Field:
    tables = snapshot.raw.get("run", [])
    index = [one.name for one in snapshot.study.runs].index(run.name) if snapshot.study else -1
    own = tables[index].get(key) if 0 <= index < len(tables) else None
    if own is not None:
        return _field(key, own, "drawn" if _is_drawn(own) else "run", _read_written(key, own, snapshot.study, run))
    inherited = snapshot.raw.get(TABLE_OF_KEY[key], {}).get(key)
    if inherited is not None:
        reading = _read_written(key, inherited, snapshot.study, run)
        return _field(key, "", "drawn" if _is_drawn(inherited) else "study", reading)
    stated = _stated_rate(run) if key == "fps" else None
    if stated:
        return _field(key, "", "film", _Reading(_echo("fps", stated)))
    return _field(key, "", "none", _Reading(), needed=_is_missing(run, key))


def _typed_field(key: str, typed: Any, run: str | None, snapshot: Snapshot | None) -> Field:
    text = "" if typed is None else str(typed).strip()
    if not text:
        needed = snapshot is None or snapshot.study is None or _is_needed_without(snapshot, key, run)
        return _field(key, "", "none", _Reading(), needed=needed)
    return _field(key, typed, "drawn" if _is_drawn(typed) else "run" if run else "study", _read_typed(key, typed))


def _is_needed_without(snapshot: Snapshot, key: str, run: str | None) -> bool:
    """Return whether a value must be given if the field is left empty."""
    assert snapshot.study is not None
    common = snapshot.raw.get(TABLE_OF_KEY[key], {}).get(key) if run else None
    runs = [one for one in snapshot.study.runs if run in (None, one.name)]
    return common is None and any(_needs(one, key) for one in runs)


def _from_recordings(snapshot: Snapshot, key: str, *, needed: bool) -> Field:
    """Return the field of a value that the study file does not give: the frame rate may be stated by the films."""
    rates = {_stated_rate(run) for run in snapshot.study.runs if run.video} if snapshot.study else set()
    rate = next(iter(rates)) if len(rates) == 1 else None
    if key == "fps" and rate:
        return _field(key, "", "film", _Reading(_echo("fps", rate)))
    return _field(key, "", "none", _Reading(), needed=needed)


def _field(key: str, written: Any, source: str, reading: _Reading, *, needed: bool = False) -> Field:
    text = "" if _is_drawn(written) else str(written)[:MAX_TEXT]
    return Field(
        key=key,
        text=text,
        echo=reading.echo,
        source=source,
        warning=reading.warning,
        error=reading.error,
        needed=needed,
    )


def _is_drawn(value: Any) -> bool:
    """Return whether a scale was drawn on the film, or is given by something else than a number."""
    return isinstance(value, dict | list)


# --- what is needed


def _needs(run: RunTable, key: str) -> bool:
    """Return whether a run cannot be measured without a value of its own or of all runs."""
    if run.video:
        return not (key == "fps" and _stated_rate(run))
    return key == "mass" and _table_needs_mass(run)


def _is_missing(run: RunTable, key: str) -> bool:
    return getattr(run, key) is None and _needs(run, key)


def _table_needs_mass(run: RunTable) -> bool:
    """Return whether the table of a run needs a mass; its headers are read once for each version of the file."""
    place = (str(run.table), file_version(run.table), run.columns.get("friction"), run.sensor is None)
    if place not in _MASS_NEEDED:
        try:
            _MASS_NEEDED[place] = table_needs_mass(run.model_copy(update={"mass": None}))
        except FrictrackError:  # its fault is shown with the recording
            _MASS_NEEDED[place] = True
    return _MASS_NEEDED[place]


def _stated_rate(run: RunTable) -> float | None:
    """Return the frame rate that the recording of a run states, 1/s."""
    seen = surveyed_source(run.source) if run.video else None
    return seen.fps if seen and seen.fps_source == "stated by the file" else None


# --- reading a value


def _read_written(key: str, written: Any, study: Study | None, run: RunTable | None = None) -> _Reading:
    """Read a value of the study file; what is implausible there is a warning, unless it was marked as checked."""
    reading = _read(key, written)
    runs = [run] if run else list(study.runs) if study else []
    checked = bool(runs) and all(one.plausible for one in runs)
    return _Reading(reading.echo, None if checked else reading.warning, reading.error)


def _read_typed(key: str, typed: Any) -> _Reading:
    """Read a typed value; a number that lacks its unit and is implausible must be typed with the unit."""
    reading = _read(key, typed)
    if reading.warning and key != "fps" and lacks_unit(typed):
        return _Reading(error=reading.warning)
    return reading


def _read(key: str, value: Any) -> _Reading:
    try:
        value = _number_or_text(value)
        return _Reading(_echo(key, value), _warning(key, value))
    except (FrictrackError, ValueError, TypeError) as e:
        return _Reading(error=str(e))


def _number_or_text(value: Any) -> Any:
    """Return a text without its outer spaces; everything else as it is."""
    return value.strip() if isinstance(value, str) else value


def _echo(key: str, value: Any) -> str:
    """Write a value as it was read. Raise an error if it cannot be read."""
    return _ECHOES[key](value)


def _echo_mass(value: Any) -> str:
    if value == "fit":
        return "fitted from the measured drive"
    mass, std = to_si(value, "kg", "mass", above=0.0)
    return f"{format_plus_minus(mass, std) if std else _plain(mass)} kg"


def _echo_rate(value: Any) -> str:
    return f"{read_frame_rate(value):g} /s"


def _echo_scale(value: Any) -> str:
    if needs_film(value):
        return "measured in the film"
    pitch, relative = parse_scale(value)
    if not math.isfinite(pitch):
        return "measured in the film"
    number = format_plus_minus(1e3 * pitch, 1e3 * pitch * relative) if relative else f"{1e3 * pitch:g}"
    return f"{number} mm/px"


def _plain(value: float) -> str:
    """Write a number with three digits, or as many as it has."""
    return max(f"{value:g}", format_number(value), key=len)


_ECHOES: dict[str, Callable[[Any], str]] = {"mass": _echo_mass, "fps": _echo_rate, "scale": _echo_scale}


def _warning(key: str, value: Any) -> str | None:
    """Return a sentence on a value that no laboratory has; None for all others."""
    found = implausible_entries(_entered(key, value))
    return str(found[0]) if found else None


def _entered(key: str, value: Any) -> EnteredValues:
    bare = frozenset({key}) if lacks_unit(value) else frozenset()
    if key == "mass":
        return EnteredValues(mass=None if value == "fit" else to_si(value, "kg", "mass")[0], bare=bare)
    if key == "fps":
        return EnteredValues(fps=read_frame_rate(value))
    pitch = math.nan if needs_film(value) else parse_scale(value)[0]
    return EnteredValues(pitch=pitch if math.isfinite(pitch) else None, bare=bare)
