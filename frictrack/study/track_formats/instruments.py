"""Read what instruments and MATLAB write: LabVIEW texts (.lvm), LabVIEW binary files (.tdms), variables (.mat, .npz).

Every recording of a file becomes columns of one table: its times ``t (s)``, if the file states them, and its channels
with their units. Several recordings stand side by side, each with its name and a colon before its headers.

References
----------
National Instruments, Specification for the LabVIEW Measurement File (.lvm), https://www.ni.com/docs (version 2.0).

"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from frictrack.study.table_layout import TableFile, text_encoding
from frictrack.study.track_formats.picture_tracks import SECONDS, read_arrays

LABVIEW = "LabVIEW Measurement"  # first words of a text
_END_OF_HEADER = re.compile(r"^\*\*\*End_of_Header\*\*\*.*\n", re.MULTILINE)
_SEPARATOR = re.compile(r"^Separator(.)", re.MULTILINE)
_RATE = re.compile(r"(?:.*\.)?(?:fs|fps|f_s|sample_?rate|sampling_?rate|frame_?rate)", re.IGNORECASE)
MIN_VALUES = 2  # of a channel

Channels = dict[str, Any]
"""Values of every channel of a recording by its header, (n,)."""


def is_labview_text(path: Path) -> bool:
    """Return whether LabVIEW wrote a text."""
    with path.open(encoding=text_encoding(path), errors="replace") as file:
        return file.read(len(LABVIEW)) == LABVIEW


def read_labview_text(path: Path) -> TableFile:
    """Read a LabVIEW measurement file: one time column, one per channel, or none but the interval of its samples."""
    head, *parts = _END_OF_HEADER.split(path.read_text(encoding=text_encoding(path)))
    found = _SEPARATOR.search(head)
    separator = found[1] if found else "\t"
    said = _header(head, separator)
    recordings: dict[str, Channels] = {}
    for header, body in _segments(parts):
        recordings[f"segment {len(recordings) + 1}"] = _segment(said | _header(header, separator), body, separator)
    return _table("LabVIEW", recordings)


def _header(text: str, separator: str) -> dict[str, list[str]]:
    rows = (line.split(separator) for line in text.splitlines())
    return {key: [cell.strip() for cell in cells] for key, *cells in rows if key}


def _segments(parts: list[str]) -> Iterator[tuple[str, str]]:
    """Yield header and rows of every recording; its rows end at an empty line, and the next header follows."""
    header = parts[0] if parts else ""
    for part in parts[1:]:
        rows, _, following = re.sub(r"^[ \t,;]+$", "", part.lstrip("\n"), flags=re.MULTILINE).partition("\n\n")
        yield header, rows
        header = following


def _segment(said: Mapping[str, list[str]], body: str, separator: str) -> Channels:
    """Return the channels of one recording."""
    decimal = said.get("Decimal_Separator", ["."])[0]
    names = body.partition("\n")[0].split(separator)
    how: dict[str, Any] = {"header": None, "skiprows": 1, "names": range(len(names)), "index_col": False}
    frame = pd.read_csv(StringIO(body), sep=separator, decimal=decimal, **how)
    clocks = [i for i, name in enumerate(names) if name == "X_Value"]
    channels = [i for i, name in enumerate(names) if i not in clocks and name.strip() not in ("Comment", "")]
    units = dict(zip(channels, said.get("Y_Unit_Label", []), strict=False))
    found: Channels = {}
    if said.get("X_Columns", ["One"])[0] == "No":
        start, step = (float(said[key][0].replace(decimal, ".")) for key in ("X0", "Delta_X"))
        found[SECONDS] = start + step * np.arange(len(frame))
    elif clocks:
        found[SECONDS] = frame[clocks[0]].to_numpy()
    for i in channels:
        clock = next((c for c in reversed(clocks) if c < i), None)
        if clock not in (None, *clocks[:1]) and not np.array_equal(frame[clock], frame[clocks[0]]):
            found[f"t of {names[i]} (s)"] = frame[clock].to_numpy()
        found[_with_unit(names[i], units.get(i, ""))] = frame[i].to_numpy()
    return found


def read_tdms(path: Path) -> TableFile:
    """Read a LabVIEW binary file with npTDMS; the interval of a waveform gives its times."""
    import nptdms  # noqa: PLC0415 - optional

    nptdms.log.log_manager.set_level(logging.ERROR)  # what is damaged fails below, or is complete all the same
    groups = nptdms.TdmsFile.read(path).groups()
    return _table("LabVIEW", {group.name: _waveforms(group.channels()) for group in groups})


def _waveforms(channels: list[Any]) -> Channels:
    found: Channels = {}
    for channel in channels:
        said, values = channel.properties, channel[:]
        if "wf_increment" in said:
            times = said.get("wf_start_offset", 0.0) + said["wf_increment"] * np.arange(len(values))
            found.setdefault(SECONDS, times)
        found[_with_unit(channel.name, said.get("unit_string") or said.get("NI_UnitDescription", ""))] = values
    return found


def read_matlab(path: Path) -> TableFile:
    """Read the variables of a MATLAB file: vectors, columns of matrices, and those in structures."""
    return _table_of_variables("MATLAB", dict(read_arrays(path)))


def read_npz(path: Path) -> TableFile:
    """Read the arrays of a file of `numpy.savez`, as the variables of a MATLAB file."""
    with np.load(path, allow_pickle=False) as arrays:
        return _table_of_variables("NumPy", {name: arrays[name] for name in arrays.files})


def _table_of_variables(program: str, variables: dict[str, Any]) -> TableFile:
    texts = [list(map(str, variables.pop(name))) for name in list(variables) if variables[name].dtype.kind == "U"]
    vectors = {name: values for name, values in variables.items() if np.size(values) >= MIN_VALUES}
    recordings: dict[str, Channels] = {}
    for name, values in vectors.items():
        label, _, own = name.rpartition(".")
        named = next((text for text in texts if np.ndim(values) > 1 and len(text) == np.shape(values)[1]), None)
        headers = named or ([own] if np.ndim(values) == 1 else [f"{own} {i + 1}" for i in range(np.shape(values)[1])])
        columns = dict(zip(headers, np.atleast_2d(np.transpose(values)), strict=True))
        recordings.setdefault(label, {}).update(columns)
    rates = (np.ravel(value)[0] for name, value in variables.items() if np.size(value) == 1 and _RATE.fullmatch(name))
    return _table(program, recordings, next((float(rate) for rate in rates if rate > 0), None))


def _with_unit(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _table(program: str, recordings: Mapping[str, Channels], rate: float | None = None) -> TableFile:
    """Return the table of some recordings; a shorter one has empty cells at its end."""
    filled = {name: channels for name, channels in recordings.items() if channels}
    if not filled:
        raise ValueError("it holds no channel with numbers")
    cells = {
        f"{name}: {header}" if len(filled) > 1 and name else header: pd.Series(values)
        for name, channels in filled.items()
        for header, values in channels.items()
    }
    frame = pd.DataFrame(cells)
    if rate is not None and not cells.keys() & {SECONDS, "t"}:
        frame.insert(0, SECONDS, np.arange(len(frame)) / rate)
    return TableFile(frame, {"t": SECONDS} if SECONDS in frame else {}, program)
