"""Read the tracks in HDF5 of DeepLabCut, movement or SLEAP, or the numbers of MATLAB, in a process of their own.

    python -c "from frictrack.study.track_formats.hdf5_contents import run; run()" FILE    # writes arrays as .npz

- DeepLabCut: a table of pandas (``DataFrame.to_hdf`` with ``format="table"``). The names of its columns are a pickle;
  only its texts are read, nothing in it is executed.
- movement: netCDF-4, ``position`` (time, space, keypoints, individuals) and ``confidence``; names in dimension scales.
- MATLAB 7.3: numeric variables, those of structures in groups; arrays are stored with their axes reversed. Files of
  earlier versions are read by SciPy.
- SLEAP: analysis file, ``tracks`` (individuals, space, keypoints, frames), ``node_names``, ``track_names``.

No other module of this package knows HDF5 or MATLAB: on malicious bytes their readers may crash or never return.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from frictrack.base.workers import limit_memory
from frictrack.study.table_layout import MAX_UNPACKED_BYTES

MAX_MEMORY_BYTES = 2 << 30
MAX_NAMES = 10_000
MAX_PICKLE_BYTES = 1 << 22
MATLAB_NUMBERS = (b"double", b"single", *(f"{u}int{n}".encode() for u in ("", "u") for n in (8, 16, 32, 64)))
DEEPLABCUT_KEY = "df_with_missing"
TRACK_DIMENSIONS = ("individual", "keypoint")  # movement 0.x writes the plural


def run() -> None:
    """Write the arrays of the file that the first argument names to the standard output; an error as a text."""
    limit_memory(MAX_MEMORY_BYTES)
    try:
        found = contents(Path(sys.argv[1]))
    except Exception as e:  # noqa: BLE001 - h5py fails in many ways on damaged files; the parent says which file it was
        found = {"error": np.array(str(e).splitlines()[0] if str(e) else type(e).__name__)}
    np.savez(sys.stdout.buffer, **found)


def contents(path: Path) -> dict[str, Any]:
    """Return the arrays of a file.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    dict of str to ndarray
        Of DeepLabCut "names" (k, levels), "frames" (n,) and "values" (n, k); of others "program", "source" (the program
        that tracked), "names" (m, 2) of individual and keypoint, "at" (n,), "in_seconds", "x", "y" and "confidence",
        (m, n), NaN where not known. Of MATLAB the numeric variables by their names.

    Raises
    ------
    ValueError
        If it is of another kind.

    """
    if path.suffix.lower() == ".mat" and not h5py.is_hdf5(path):
        return dict(_matlab_variables(path))
    with h5py.File(path, "r", locking=False) as file:
        if any("MATLAB_class" in one.attrs for one in file.values()):
            return _matlab(file)
        if DEEPLABCUT_KEY in file:
            return _deeplabcut(file)
        if "position" in file:
            return _movement(file)
        if "tracks" in file and "node_names" in file:
            return _sleap(file)
        raise ValueError(
            f"expected HDF5 of DeepLabCut ({DEEPLABCUT_KEY}), movement (position) or SLEAP (tracks, node_names) "
            f"but got {', '.join(list(file)[:5]) or 'an empty file'}"
        )


def _dataset(parent: h5py.Group, name: str) -> h5py.Dataset:
    """Return a dataset whose values lie in this file, and fit into the memory."""
    found = parent.get(name)
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"expected a dataset {name} but got none")
    if found.external or found.is_virtual or found.file.filename != parent.file.filename:
        raise ValueError(f"the values of {name} lie in another file")
    if found.size is None or found.size * found.dtype.itemsize > MAX_UNPACKED_BYTES:
        raise ValueError(f"{name} is too large: {found.shape}")
    return found


def _numbers(parent: h5py.Group, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.asarray(_dataset(parent, name)[()], dtype=float)


def _texts(parent: h5py.Group, name: str) -> list[str]:
    dataset = _dataset(parent, name)
    if dataset.ndim != 1 or dataset.size > MAX_NAMES:
        raise ValueError(f"expected at most {MAX_NAMES} names in {name} but got {dataset.shape}")
    return [str(h5py.check_string_dtype(dataset.dtype) and _text(one)) for one in dataset[()]]


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


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


def _matlab(file: h5py.File) -> dict[str, Any]:
    names: list[str] = []
    file.visititems(lambda name, one: names.append(name) if one.attrs.get("MATLAB_class") in MATLAB_NUMBERS else None)
    found = {name.replace("/", "."): np.squeeze(_numbers(file, name).T) for name in names[:MAX_NAMES]}
    return {name: values for name, values in found.items() if values.ndim <= 2}


def _deeplabcut(file: h5py.File) -> dict[str, Any]:
    group = file[DEEPLABCUT_KEY]
    if not isinstance(group, h5py.Group) or "table" not in group or group.file.filename != file.filename:
        raise ValueError('expected a table that pandas wrote with format="table"; use the .csv that DeepLabCut writes')
    table = _dataset(group, "table")
    names = _names_in_pickle(bytes(table.attrs["values_block_0_kind"]))
    rows = table[()]
    values = np.asarray(rows["values_block_0"], dtype=float).reshape(len(rows), -1)
    if values.shape[1] != len(names) or len({len(name) for name in names}) != 1:
        raise ValueError(f"{len(names)} names for {values.shape[1]} columns")
    frames = np.asarray(rows["index"], dtype=float)
    return {"names": np.array([name[1:] for name in names]), "frames": frames, "values": values}


class _Texts(pickle.Unpickler):
    """Reader of a pickle of lists, tuples and texts: it looks up no class and no function."""

    def find_class(self, module: str, name: str) -> Any:
        """Refuse whatever is not built in."""
        raise ValueError("expected names of columns but got global in their place")


def _names_in_pickle(stored: bytes) -> list[tuple[str, ...]]:
    """Return the list of tuples of texts that a pickle describes; nothing in it is executed, other content refused."""
    if len(stored) > MAX_PICKLE_BYTES:
        raise ValueError(f"{len(stored) / 1e6:.0f} MB of names")
    names = _Texts(BytesIO(stored)).load()
    if not isinstance(names, list) or not all(
        isinstance(name, tuple) and all(isinstance(text, str) for text in name) for name in names
    ):
        raise ValueError("expected the names of the columns as texts")
    return names


def _movement(file: h5py.File) -> dict[str, Any]:
    position, labels = _with_dimensions(file, "position")
    if not {"time", "space"} <= labels.keys():
        raise ValueError(f"expected position over time and space but got {', '.join(labels)}")
    confidence = np.full(position.shape[:1] + position.shape[2:], np.nan)
    if "confidence" in file:
        confidence, _ = _with_dimensions(file, "confidence")
    x, y = (_by_track(np.take(position, labels["space"].index(axis), axis=1)) for axis in "xy")
    individuals, keypoints = (labels.get(kind, [""]) for kind in TRACK_DIMENSIONS)
    names = np.array([(individual, keypoint) for keypoint in keypoints for individual in individuals])
    unit = _text(file.attrs.get("time_unit", "seconds" if "fps" in file.attrs else "frames"))
    source = _text(file.attrs.get("source_software", ""))
    found: dict[str, Any] = {"program": "movement", "source": source, "names": names}
    found |= {"at": _numbers(file, "time"), "in_seconds": unit == "seconds"}
    return found | {"x": x, "y": y, "confidence": _by_track(confidence)}


def _with_dimensions(file: h5py.File, name: str) -> tuple[np.ndarray[Any, Any], Mapping[str, list[str]]]:
    """Return values over time, (space,) (keypoint,) (individual), and the labels of each dimension."""
    dataset = _dataset(file, name)
    labels: dict[str, list[str]] = {}
    for dimension in dataset.dims:
        scale = dimension[0].name.strip("/") if len(dimension) else ""
        kind = next((one for one in TRACK_DIMENSIONS if scale.startswith(one)), scale)
        labels[kind] = [] if kind == "time" else _texts(file, scale)
    order = [kind for kind in ("time", "space", *TRACK_DIMENSIONS[::-1]) if kind in labels]
    if len(order) != dataset.ndim:
        raise ValueError(f"expected {name} over time, space, keypoints and individuals but got {', '.join(labels)}")
    return np.transpose(_numbers(file, name), [list(labels).index(kind) for kind in order]), labels


def _by_track(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return values (n, keypoints, individuals) as (m, n)."""
    return values.reshape(len(values), -1).T


def _sleap(file: h5py.File) -> dict[str, Any]:
    tracks, keypoints = _numbers(file, "tracks"), _texts(file, "node_names")
    individuals = _texts(file, "track_names") if file["track_names"].size else [""]
    if tracks.shape[:3] != (len(individuals), 2, len(keypoints)):
        raise ValueError(
            f"expected tracks of {len(individuals)} individuals with {len(keypoints)} nodes but got {tracks.shape}"
        )
    x, y = (tracks[:, axis].reshape(-1, tracks.shape[3]) for axis in (0, 1))
    names = np.array([(individual, keypoint) for individual in individuals for keypoint in keypoints])
    found: dict[str, Any] = {"program": "SLEAP", "source": "SLEAP", "names": names}
    found |= {"at": np.arange(tracks.shape[3], dtype=float), "in_seconds": False}
    return found | {"x": x, "y": y, "confidence": np.full(x.shape, np.nan)}
