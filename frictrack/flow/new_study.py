"""Make a study of recordings: look at them, check the numbers that the user typed, write the study file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_plus_minus
from frictrack.base.units import lacks_unit, parse_quantity
from frictrack.flow.new_study import FROM_FILE, Surveyed, expand_folders, survey_recording
from frictrack.flow.opening import check_inputs, open_study
from frictrack.flow.stages import run_pipeline
from frictrack.measure.calibration import parse_scale
from frictrack.measure.plausibility import EnteredValues, describe_shift, implausible_entries, shifted_swings
from frictrack.study import NewRun, Study, list_files, refuse_existing, write_study

FILL_IN = "FILL IN: "  # before the explanation of a key that must be given
LEFT_OPEN = {"units": "with the units of the file in the brackets", "track": "with the name of the track"}
_KEY = re.compile(r'\b(mass|scale|fps) = (?="?[\d.])')


def check_entered(keys: Mapping[str, Any]) -> None:
    """Refuse implausible numbers of the command line before anything is written.

    Parameters
    ----------
    keys
        mass, scale and fps as they were typed; None if not given.

    Raises
    ------
    FrictrackError
        (usage) With all of them, each with what was read and what to type instead.

    """
    found = [_as_option(str(one)) for one in implausible_entries(read_keys(keys))]
    if found:
        raise FrictrackError("; ".join(found), usage=True)


def read_keys(keys: Mapping[str, Any]) -> EnteredValues:
    """Read the numbers that a user typed.

    Parameters
    ----------
    keys
        mass, scale and fps as they were typed; None if not given.

    Raises
    ------
    FrictrackError
        (usage) If one of them is no such quantity.

    """
    try:
        return _entered_values(keys)
    except FrictrackError as e:
        raise FrictrackError(str(e), usage=True) from e


def _entered_values(keys: Mapping[str, Any]) -> EnteredValues:
    mass, scale, fps = (keys.get(key) for key in ("mass", "scale", "fps"))
    bare = {key for key, value in (("mass", mass), ("scale", scale)) if lacks_unit(value)}
    pitch = float("nan") if scale is None else parse_scale(scale)[0]
    return EnteredValues(
        mass=None if mass in (None, "fit") else _kilograms(mass)[0],
        pitch=pitch if isfinite(pitch) else None,
        fps=fps,
        bare=frozenset(bare),
    )


def _kilograms(mass: Any) -> tuple[float, float]:
    value, std = parse_quantity(mass, "kg", "mass")
    if not value > 0:
        raise FrictrackError(f"expected a mass above 0 kg but got {mass}")
    return value, std


def _as_option(words: str) -> str:
    """Return a finding on a key of the study file as one on an option of the command line."""
    checked = 'if it is right, set plausible = "checked"'
    return _KEY.sub(r"--\1 ", words).replace(checked, f"{checked} in a study file, which `frictrack init` writes")


def describe_keys(keys: Mapping[str, Any]) -> str:
    """Describe the numbers of the command line as they were read.

    Parameters
    ----------
    keys
        mass, scale and fps as they were typed; None if not given.

    Examples
    --------
    >>> describe_keys({"mass": "350g", "scale": "0.5mm/px", "fps": 4000.0})
    'mass 0.350 kg, scale 0.500 mm/px, 4000 fps'

    """
    mass, scale, fps = (keys.get(key) for key in ("mass", "scale", "fps"))
    parts = []
    if mass is not None and mass != "fit":
        parts.append(f"mass {_number(*_kilograms(mass))} kg")
    if scale is not None:
        pitch, relative = parse_scale(scale)
        parts.append(f"scale {_number(1e3 * pitch, 1e3 * pitch * relative)} mm/px")
    if fps is not None:
        parts.append(f"{fps:g} fps")
    return ", ".join(parts)


def _number(value: float, std: float) -> str:
    """Format a number with three digits or as many as it has, and its standard deviation if there is one."""
    if std:
        return format_plus_minus(value, std)
    return max(f"{value:g}", f"{value:#.3g}".rstrip("."), key=len)


def start_study(
    path: Path,
    recordings: Sequence[Path],
    keys: Mapping[str, Any],
    tell: Callable[[str], None] = lambda line: None,
    *,
    allow_incomplete: bool = False,
) -> Study:
    """Write the study file of some recordings and open it; it is removed again if a recording cannot be used.

    Parameters
    ----------
    path
        Path of the new study file.
    recordings
        Films and tables, and folders of them.
    keys
        Known keys of ``[study]`` and ``[camera]``: mass, model, fps, scale.
    tell
        Called with one line about each recording.
    allow_incomplete
        Mass, scale and frame rate may still be missing.

    Raises
    ------
    FrictrackError
        (usage) If the study file exists or a recording is missing; otherwise what is wrong with each recording.

    """
    paths = expand_folders(recordings)
    refuse_existing(path)
    read_keys(keys)
    found = [survey_recording(one) for one in paths]
    for one in found:
        if one.is_usable:
            tell(f"{one.path}: {one.words}")
    faults = [f"{one.path.name}: {one.problem or _to_confirm(one)}" for one in found if not one.is_usable]
    if faults:
        raise FrictrackError("; ".join(faults))
    write_study(path, [new for one in found for new in _new_runs(one, keys)], keys)
    try:
        study = open_study(path, allow_incomplete=allow_incomplete)
        if not allow_incomplete:
            check_inputs([run_pipeline(study, run) for run in study.runs])
    except FrictrackError:
        path.unlink()
        raise
    return study


def _to_confirm(one: Surveyed) -> str:
    return (
        f"{one.words}; `frictrack init {one.path.parent}` writes a study file, in which its columns are to be named: "
        f"{one.columns_to_confirm[0]}, {LEFT_OPEN[one.left_open]}"
    )


def _new_runs(one: Surveyed, keys: Mapping[str, Any]) -> list[NewRun]:
    """Return the entries of its runs: the frame rate of its name, if nothing else tells it, and columns of a table."""
    rate = {"fps": _whole(one.fps)} if one.fps and one.fps_source != FROM_FILE and not keys.get("fps") else {}
    if one.columns_to_confirm:
        return [NewRun(one.path, rate, f"FILL IN the {one.left_open}: {line}") for line in one.columns_to_confirm]
    return [NewRun(one.path, rate | ({"columns": columns} if columns else {})) for columns in one.runs]


def _whole(rate: float | None) -> float | None:
    """Return a whole number as an integer, which a study file shows without a fraction."""
    return int(rate) if rate is not None and rate == int(rate) else rate


def propose_study(folder: Path, keys: Mapping[str, Any]) -> dict[str, Any]:
    """Write a commented study file for what a folder holds: JSON of `frictrack init`.

    Parameters
    ----------
    folder
        Folder with recordings.
    keys
        Known keys of ``[study]`` and ``[camera]``: mass, fps, scale.

    Returns
    -------
    dict
        "study" and "output", the path of the file; "runs", names of the recordings in it; "found" and "skipped", what
        each file holds or why it was left out; "fill_in", the keys that the user must give.

    Raises
    ------
    FrictrackError
        (usage) If there is no such folder, or the study file exists; otherwise if it has no recordings.

    """
    if not folder.is_dir():
        raise FrictrackError(f"expected a folder with recordings but got {folder}", usage=True)
    refuse_existing(folder / "study.toml")
    seen = [survey_recording(path) for path in list_files(folder)]
    found = [one for one in seen if not one.problem]
    skipped = [{"file": one.path.name, "reason": one.problem} for one in seen if one.problem]
    if not found:
        reasons = "".join(f"; {one['file']}: {one['reason']}" for one in skipped)
        raise FrictrackError(f"expected films or tables in {folder} but found none{reasons}")
    swings = {one.path.name: one.positions for one in found if one.positions is not None}
    shifts = {name: f"; {describe_shift(shift, first)}" for name, first, shift in shifted_swings(swings)}
    rates = {one.fps for one in found if not one.is_table}
    common = {"fps": _whole(next(iter(rates)))} if len(rates) == 1 and None not in rates and not keys.get("fps") else {}
    known = {key: value for key, value in (*keys.items(), *common.items()) if value is not None}
    remarks = _remarks(found, known)
    path = write_study(
        folder / "study.toml",
        [new for one in found for new in _new_runs(one, known)],
        known,
        commented=True,
        remarks=remarks,
    )
    return {
        "study": str(path),
        "runs": [one.path.name for one in found],
        "found": [{"file": one.path.name, "words": one.words + shifts.get(one.path.name, "")} for one in found],
        "skipped": skipped,
        "fill_in": [key for key, words in remarks.items() if words.startswith("FILL IN")]
        + [f"columns of {one.path.name}" for one in found if one.columns_to_confirm],
        "output": str(path),
    }


def _remarks(found: Sequence[Surveyed], known: Mapping[str, Any]) -> dict[str, str]:
    """Return words before the explanation of a key: that it is to be filled in, or where its value comes from."""
    films = [one for one in found if not one.is_table]
    needed = {*(("scale",) if films else ()), *(key for one in found for key in one.camera_keys)}
    needed |= {"mass"} if any(one.needs_mass for one in found) else set()
    remarks = {key: FILL_IN for key in ("mass", "scale", "fps") if key not in known and key in needed}
    unknown = ", ".join(one.path.name for one in films if one.fps is None)
    if unknown and "fps" not in known:
        remarks["fps"] = f"{FILL_IN}(not stated by {unknown}; an .avi or .mp4 often states the speed of showing) "
    elif films and known.get("fps") == films[0].fps:
        remarks["fps"] = f"{films[0].fps_source}: "
    return remarks
