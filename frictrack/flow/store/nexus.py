"""Mark groups by the NeXus standard, so that a viewer (silx, h5web, NeXpy) draws the right curve at a double click.

A group with one row per frame becomes an NXdata: `signal` names the column that is drawn, `axes` that of the time. From
the root of the file on, `default` names the group that leads to the curve that tells most. The attributes are only for
viewers: nothing here is read back.

References
----------
NeXus manual, classes NXdata and NXroot, https://manual.nexusformat.org.

"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from frictrack.flow.store.checksums import drop_checksums, members

NX_CLASS = "NX_class"
ATTRIBUTES = frozenset({NX_CLASS, "default", "signal", "axes", "auxiliary_signals"})  # of a group that is marked
UNITS = "units"  # of a dataset
AXIS = "t"
# Of a run, the first one that is there is drawn. Not the friction force: outside of the free section, as during a push,
# it is no friction, and so large that nothing else is seen.
STAGES = ("displacement", "track")


def mark_data(group: h5py.Group, kind: Any) -> None:
    """Mark a group that holds a record with one row per frame as NXdata.

    Parameters
    ----------
    group
        The group with its datasets, before its checksum is written.
    kind
        Type of the record; its `signals` are the columns to draw. Those that were not measured are left out.

    """
    signals = [name for name in getattr(kind, "signals", ()) if isinstance(group.get(name), h5py.Dataset)]
    if AXIS not in group or not signals:
        return
    group.attrs.update({NX_CLASS: "NXdata", "signal": signals[0], "axes": _names(AXIS)})
    others = [name for name in signals[1:] if group[name].attrs[UNITS] == group[signals[0]].attrs[UNITS]]
    if others:  # they are drawn in one plot
        group.attrs["auxiliary_signals"] = _names(*others)


def mark_default(file: h5py.File) -> None:
    """Let `default` lead from the root of a file to a curve: the displacement of a run, or that of the current model.

    Checksums of the groups that change are removed. No link is followed: it might lead into another file.
    """
    file.attrs[NX_CLASS] = "NXroot"
    file.attrs.pop("default", None)
    inside: h5py.Group = file
    for name, kind in _path_to_curve(file):
        _set(file, inside, "default", name)
        inside = inside[name]
        _set(file, inside, NX_CLASS, kind)


def _set(file: h5py.File, group: h5py.Group, name: str, value: str) -> None:
    """Set an attribute of a group, and remove its checksum and those of its parents if it changes."""
    if str(group.attrs.get(name)) != value:
        drop_checksums(file, group.name)
        group.attrs[name] = value


def without_marks(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a group without those of NeXus."""
    is_marked = NX_CLASS in attributes
    return {name: value for name, value in attributes.items() if not (is_marked and name in ATTRIBUTES)}


def _path_to_curve(file: h5py.File) -> list[tuple[str, str]]:
    """Return the names of the groups that lead to the curve, each with its class; empty if there is no curve."""
    own = _subgroups(file)
    stage = next((name for name in STAGES if name in own and _is_data(own[name])), None)
    if stage is not None:
        return [(stage, "NXdata")]
    models = _subgroups(own.get("models"))
    model = next((name for name in reversed(models) if _is_current(models[name])), "")
    curves = _subgroups(_subgroups(models.get(model)).get("curves"))
    curve = next((name for name, group in curves.items() if _is_data(group)), "")
    kinds = ("NXentry", "NXsubentry", "NXcollection", "NXdata")
    return list(zip(("models", model, "curves", curve), kinds, strict=True)) if curve else []


def _subgroups(group: h5py.Group | None) -> dict[str, h5py.Group]:
    """Return the groups inside a group by name, without links."""
    return {} if group is None else {name: item for name, item in members(group) if isinstance(item, h5py.Group)}


def _is_current(model: h5py.Group) -> bool:
    current = model.attrs.get("current")
    return isinstance(current, np.bool_) and bool(current)


def _is_data(group: h5py.Group) -> bool:
    return str(group.attrs.get(NX_CLASS)) == "NXdata"


def _names(*names: str) -> Any:
    """Return names as NeXus lists them: an array of texts; their length is fixed, so that they lie in the attribute."""
    return np.array([name.encode() for name in names], dtype=h5py.string_dtype("utf-8", max(map(len, names))))
