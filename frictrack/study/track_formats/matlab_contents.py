"""Read the numbers in files of MATLAB, in a process of their own.

    python -c "from frictrack.study.track_formats.matlab_contents import run; run()" FILE    # writes arrays as .npz

MATLAB 7.3 writes HDF5: numeric variables, those of structures in groups; arrays are stored with their axes reversed.
Files of earlier versions are read by SciPy.

No other module of this package knows HDF5 or MATLAB: on malicious bytes their readers may crash or never return.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from frictrack.base.workers import limit_memory
from frictrack.study.table_layout import MAX_UNPACKED_BYTES

MAX_MEMORY_BYTES = 2 << 30
MAX_NAMES = 10_000
NUMBERS = (b"double", b"single", *(f"{u}int{n}".encode() for u in ("", "u") for n in (8, 16, 32, 64)))


def run() -> None:
    """Write the arrays of the file that the first argument names to the standard output; an error as a text."""
    limit_memory(MAX_MEMORY_BYTES)
    try:
        found = contents(Path(sys.argv[1]))
    except Exception as e:  # noqa: BLE001 - h5py fails in many ways on damaged files; the parent says which file it was
        found = {"error": np.array(str(e).splitlines()[0] if str(e) else type(e).__name__)}
    np.savez(sys.stdout.buffer, **found)


def contents(path: Path) -> dict[str, Any]:
    """Return the numeric variables of a file by their names; `ValueError` if it cannot be read."""
    if not h5py.is_hdf5(path):
        return dict(_matlab_variables(path))
    with h5py.File(path, "r", locking=False) as file:
        names: list[str] = []
        file.visititems(lambda name, one: names.append(name) if one.attrs.get("MATLAB_class") in NUMBERS else None)
        found = {name.replace("/", "."): np.squeeze(_numbers(file, name).T) for name in names[:MAX_NAMES]}
    return {name: values for name, values in found.items() if values.ndim <= 2}


def _numbers(file: h5py.File, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a variable whose values lie in this file, and fit into the memory."""
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"expected numbers in {name} but got none")
    if found.external or found.is_virtual:
        raise ValueError(f"the values of {name} lie in another file")
    if found.size is None or found.size * found.dtype.itemsize > MAX_UNPACKED_BYTES:
        raise ValueError(f"{name} is too large: {found.shape}")
    return np.asarray(found[()], dtype=float)


def _matlab_variables(path: Path) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    """Yield the numbers in a file of MATLAB 7.2 or earlier, by the path of their names."""
    import scipy.io  # noqa: PLC0415 - takes long to load

    size = 8 * sum(np.prod(shape, dtype=float) for _, shape, _ in scipy.io.whosmat(path))
    if size > MAX_UNPACKED_BYTES:
        raise ValueError(f"{size / 1e6:.0f} MB when unpacked")
    found = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    yield from _fields({name: value for name, value in found.items() if not name.startswith("__")}, "")


def _fields(values: Mapping[str, Any], before: str) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    for name, value in values.items():
        parts: Any = np.ravel(value) if isinstance(value, np.ndarray) and value.dtype == object else []
        if hasattr(value, "_fieldnames"):
            fields = {field: getattr(value, field) for field in value._fieldnames}
            # a signal of dSPACE: its name, unit, data
            named = str(fields.pop("Name", name)) if "Data" in fields else ""
            unit = f" ({fields['Unit']})" if fields.get("Unit") else ""
            signal = {f"{named}{unit}": fields["Data"]} if named and np.ndim(fields["Data"]) == 1 else {}
            yield from _fields(signal, before) if signal else _fields(fields, f"{before}{name}.")
        elif len(parts) and all(hasattr(part, "_fieldnames") for part in parts):  # an array of structures
            yield from _fields({f"{name}({i})": part for i, part in enumerate(parts, 1)}, before)
        elif len(parts) and all(isinstance(part, str) for part in parts):  # names of columns
            yield f"{before}{name}", np.array(parts, dtype=str)
        elif np.asarray(value).dtype.kind in "fiu" and np.ndim(value) <= 2:
            yield f"{before}{name}", np.asarray(value)
