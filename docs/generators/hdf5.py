"""Write the reference of the results files from the declarations in the code: SCHEMA.md, and a page of it.

    python docs/generators/hdf5.py        writes frictrack/flow/store/SCHEMA.md

h5py and HDF5 tools can list a file, but not what a field means; the meaning stands only in the declarations, so this
module stays ours.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from page_text import write_page

from frictrack.base.files import replace_text
from frictrack.flow import store
from frictrack.flow.stages import FILM, POINTS, TABLE
from frictrack.flow.store import Provenance
from frictrack.records import Curve, ModelledMotion

PAGE = Path(store.__file__).parent / "SCHEMA.md"
MODEL_MEMBERS = {
    "current": ("bool", "whether this is the current model"),
    "equation": ("text", "the printed model"),
    "summary": ("JSON text", "what `frictrack fit --json` prints: parameters, deviations, errors, free runs"),
    "state": ("group", "what restores the fit without a new search"),
    "curves": ("group", "a group per run, `<number>_<run>`: measurement and model, table below"),
    "motion": ("group", "a group per run: the motion by the model, table below"),
    "convergence": ("group", "of a global search: a group per group of runs, or `all`, with one value per generation"),
    "certainty": ("group", "profiles and bootstrap, if they were asked for: `summary`, JSON text"),
    "diagnosis": (
        "group",
        "`summary` (JSON of `frictrack diagnose`) and `figures`, its curves",
    ),
}
STUDY_GROUPS = {
    "runs": "a link per run to its file",
    "models": "a group per model in the order tried, `<number>_<name>`; `study_model` and `study_search` are the study "
    "file's (JSON)",
    "comparison": "`summary`: JSON of `frictrack compare`",
    "diagnosis": "a link to the diagnosis of the current model",
    "findings": "`warnings`: the implausible numbers, as in the JSON of `frictrack run`",
    "papers": "a group like a model's: the papers' route, force domain and SGA or the study file's search",
}
_COMMENT = re.compile(r"^    (\w+): .*?  # (.*)$", re.MULTILINE)
_KINDS = {"f": "float64", "b": "bool", "i": "int64", "U": "text"}
_TYPES = {"float": "float64", "int": "int64", "bool": "bool", "str": "text", "tuple": "JSON text", "dict": "group"}

_HEAD = """# What is in a results folder

Made by `python docs/generators/hdf5.py` from the declarations in the code; schema {schema}. Do not edit.

`<run>.h5` holds a run, one group per stage. `study.h5` holds the models tried and links to the runs. Both are plain
HDF5 in the format of its version 1.8, which h5py, MATLAB, HDFView and `h5dump` open without frictrack. All numbers
are in SI units, pixels and grey values apart; NaN means "not measured in this frame".

## How values are written

- A column is a dataset, (n,): one value per frame, with the attribute `unit`. It is compressed (gzip, shuffled) and
  carries HDF5's own Fletcher32 checksum. `bool` is HDF5's enum of FALSE and TRUE; text is UTF-8 of fixed length.
- A single number or text is an attribute of the group; `<name>_unit` is its unit. A list is an attribute in JSON.
  An unknown value or column is an empty attribute. A text above 16000 characters is a dataset.
- The file itself has the attributes `schema` ({schema}) and `version` (of frictrack, last to write).
- A file is never changed in place. The new file replaces it in one step: a reader keeps the version that it opened, and
  opens the file again to see the new one. Reading needs no lock; frictrack locks the folder
  (`.frictrack/lock`) to write.

## Marks for viewers

Viewers that know the NeXus standard (silx view, h5web, NeXpy) draw a curve at a double click. frictrack writes these
marks and never reads them; a file written before they existed gets them when its groups are written again.

- A group with one value per frame has `NX_class` = NXdata, `signal` (the column that is drawn), `axes` (`t`) and, if
  another column belongs into the same plot, `auxiliary_signals`.
- `default` leads from the root to one curve. In a run it is the measured displacement, in `study.h5` the measured and
  the modelled displacement of the first run by the current model.
- A column with a unit has it twice: `unit`, and `units` as NeXus calls it.

## Checksums

- The file: its first {room} bytes are text, which HDF5 skips (a user block). The second line is the SHA-256 of the
  first line and of all after byte {start}; `(head -n 1 v3.h5; tail -c +{after} v3.h5) | sha256sum` prints the same.
  The bytes between are HDF5's superblock, which has a checksum of HDF5's own.
- The mark in the first line shows that this user wrote the file: HMAC-SHA256 of all after byte {start} under a secret
  in the user's data folder. A file without the mark (of a colleague, or of schema 1) is equally valid. HDF5 may crash
  or never return on malicious bytes, so frictrack reads such a file in a separate process first.
- `frictrack verify PATH...` checks the file, the provenance of the results, and the recordings.

A file of schema 1 has no checksum; it is read as it is, and gets one when something is written into it. In schema 2
every group and dataset had a checksum of its own besides, the attribute `sha256`.

## Provenance of a group

Every group that a stage, a fit, a comparison or a diagnosis wrote has these attributes:

"""
_READ = """
## Reading it

```python
import h5py

with h5py.File("{run}.h5") as run:
    t, v = run["motion/t"][:], run["motion/v"][:]
    print(run["motion/v"].attrs["unit"], run["motion"].attrs["cutoff"], run["motion"].attrs["settings"])
```

```matlab
t = h5read('{run}.h5', '/motion/t');
v = h5read('{run}.h5', '/motion/v');
unit = h5readatt('{run}.h5', '/motion/v', 'unit');
cutoff = h5readatt('{run}.h5', '/motion', 'cutoff');
model = jsondecode(h5readatt('study.h5', '/comparison', 'summary'));
info = h5info('study.h5', '/models');            % names of the models: {{info.Groups.Name}}
```

In HDFView: *File, Open As Read-Only*; the columns are in the tree, units and provenance under *Object Attribute Info*.
If a viewer changes a file, its checksum is wrong, and frictrack reports it.

```sh
h5ls -r {run}.h5
h5dump -d /motion/v {run}.h5
```
"""


def schema_page() -> str:
    """Return the page as Markdown."""
    head = _HEAD.format(
        schema=store.SCHEMA, room=store.HEADER_BYTES, start=store.CHECKSUM_START, after=store.CHECKSUM_START + 1
    )
    provenance = ((f.name, "text", _field_comments(Provenance).get(f.name, "")) for f in fields(Provenance))
    parts = [head + _table(("attribute", "type", "what"), provenance), "\n## A run: `<run>.h5`\n"]
    parts += [_stage_section(name) for name in {**FILM, **TABLE}]
    parts += [
        "\n## The study: `study.h5`\n\n",
        _table(("group", "what"), ((f"`/{k}`", v) for k, v in STUDY_GROUPS.items())),
    ]
    model = ((f"`{name}`", *description) for name, description in MODEL_MEMBERS.items())
    parts += ["\n### `/models/<number>_<name>`\n\n", _table(("name", "type", "what"), model)]
    parts += [_record_section("`curves/<number>_<run>`", Curve), _record_section("`motion/<run>`", ModelledMotion)]
    return "".join(parts) + _READ.format(run="v3")


def _stage_section(name: str) -> str:
    """Describe one stage: what it is computed from, for a film, a table or both, and its record."""
    tables = (("film", FILM), ("table", TABLE), ("table of points (v, F)", POINTS))
    chains = {kind: chain[name] for kind, chain in tables if name in chain}
    made: dict[str, list[str]] = {}
    for kind, stage in chains.items():
        groups = [f"`/{one}`" for one in stage.inputs]
        keys = [f"`{key}`" for key in stage.settings]
        made.setdefault(", ".join(groups + (["the keys " + ", ".join(keys)] if keys else [])), []).append(kind)
    words = "; ".join(f"of a {' or a '.join(kinds)}: made from {what}" for what, kinds in made.items())
    words = f"O{words[1:]}.\n"
    kind = next(iter(chains.values())).kind
    if kind is dict:
        return f"\n### `/{name}`\n\n{words}A group per further target, `/{name}/<name>`, like `/track`.\n"
    return _record_section(f"`/{name}`", kind, words)


def _record_section(title: str, kind: Any, words: str = "") -> str:
    """Describe a record: its datasets, then its attributes."""
    says = _field_comments(kind)
    rows = sorted(
        (_field_row(f) for f in fields(kind)), key=lambda row: ("dataset", "attribute", "group").index(row[1])
    )
    doc = " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())
    head = ("name", "is a", "type", "unit", "what")
    body = _table(head, ((f"`{name}`", *rest, says.get(name, "")) for name, *rest in rows))
    return f"\n### {title}\n\n{doc}\n{words}\n{body}"


def _field_row(f: Field[Any]) -> tuple[str, str, str, str]:
    """Return name, kind of object, type with shape, and unit of a field."""
    unit, annotation = f.metadata.get("unit") or "", str(f.type)
    or_empty = " or empty" if annotation.endswith("| None") else ""
    if f.metadata.get("column"):
        return f.name, "dataset", f"{_KINDS[np.dtype(f.metadata['kind']).kind]} (n,){or_empty}", unit
    if annotation.startswith(("Array", "NDArray")):
        return f.name, "dataset", f"array (h, w){or_empty}" if f.name == "picture" else f"float64 (n,){or_empty}", unit
    what = _TYPES[re.split(r"\W", annotation)[0]]
    return f.name, "group" if what == "group" else "attribute", what + or_empty, unit


def _field_comments(kind: Any) -> dict[str, str]:
    """Return the comments beside the fields in the source code."""
    assert is_dataclass(kind)
    return dict(_COMMENT.findall(inspect.getsource(kind)))  # type: ignore[arg-type]


def _table(head: tuple[str, ...], rows: Iterable[Iterable[str]]) -> str:
    def lines() -> Iterator[str]:
        yield "| " + " | ".join(head) + " |"
        yield "|" + "---|" * len(head)
        for row in rows:
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"

    return "\n".join(lines()) + "\n"


def write_hdf5(folder: Path) -> None:
    """Write the page into a folder of generated pages."""
    write_page(folder / "hdf5.md", schema_page())


if __name__ == "__main__":
    replace_text(PAGE, schema_page())
