"""Write the reference of the study file from its schema: every key with type, unit, default and meaning."""

from __future__ import annotations

import re
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from numpydoc.docscrape import ClassDoc
from page_text import code, prose, table, write_page

from frictrack.study import schema
from frictrack.study.schema import (
    COLUMNS,
    POINT_COLUMNS,
    SCALE,
    SENSOR_COLUMNS,
    CameraTable,
    CostsTable,
    EffectTable,
    Keys,
    MotionTable,
    RunTable,
    SearchTable,
    StudyTable,
)

SECTIONS: dict[str, type[Keys]] = {
    "[study]": StudyTable,
    "[camera]": CameraTable,
    "[motion]": MotionTable,
    "[[run]]": RunTable,
    "[[effect]]": EffectTable,
    "[costs]": CostsTable,
    "[search]": SearchTable,
}
# Types of the schema: what a study file writes, the unit, and an example.
TYPES = {
    "str": ("text", "", ""),
    "int": ("whole number", "", "30"),
    "Mass": ('number, text with unit, or "fit"', "kg", '"350 +/- 1 g"'),
    "FrameRate": ("number or text with unit, above 0", "Hz", "4000"),
    "Frequency": ("number or text with unit, above 0", "Hz", "4000"),
    "FrameLimit": ("whole number of at least 30; inf: any", "", "1000"),
    "Cost": ("number above 0; inf: not possible", "", "5"),
    "CostOfChange": ("number of at least 0; inf: not possible", "", "5"),
    "Speeds": ("[slowest, fastest]", "m/s", "[2, 8]"),
    "Masses": ("list of numbers or texts with unit", "kg", '["0.35 kg", "0.70 kg"]'),
    "Radius": ("number or text with unit; with its error", "m", '"0.40 +/- 0.01 m"'),
    "Place": ("number or text with unit", "m", '"-12 mm"'),
    "Length": ("number or text with unit, above 0", "m", '"0.30 m"'),
    "Pause": ("number or text with unit, above 0", "s", '"5 min"'),
    "Load": ("number or text with unit, above 0", "N", '"3.4 N"'),
    "Energy": ("number or text with unit, above 0", "J", '"2 J"'),
    "Scatter": ("number or text with unit, at least 0", "N", '"0.05 N"'),
    "Angle": ("number or text with unit, within 90 degrees; with its error", "rad", '"22 +/- 0.1 deg"'),
    "Rolling": ('"disc", "ball", "hollow ball", "ring", or I/(m r^2) from 0 to 1', "", '"ball"'),
    "Times": ("start and end, numbers or texts with unit", "s", '["0.01 s", "0.2 s"]'),
    "Pair": ("two numbers", "px", "[412, 230]"),
    "Specification": ("text with unit", "N or m", '"0.004 N"'),
    "Scale": ("number, text with unit, or table", "m/px", '"0.5 mm/px"'),
    "File": ("path of a file", "", '"lens.yml"'),
    "PriorFile": ("path of a prior file", "", '"course_a.prior.toml"'),
    "Factor": ("number above 0", "", "2"),
    "Conditions": (
        "table of numbers or texts by name",
        "",
        '{temperature = "20 degC", material = "steel on brass"}',
    ),
    "Share": ('number of at least 0, or "10 %"', "", '"10 %"'),
    "Source": ("path or address", "", '"strike_01.avi"'),
    "Target": (schema.TARGETS, "px", "[410, 232, 96, 64]"),
    "Targets": ("table of targets by name", "px", "{rod = [300, 20, 40, 60]}"),
    "Areas": ("list of polygons or rectangles", "px", "[[600, 0, 24, 400]]"),
    "Repairs": ("list of tables", "frames, px", '[{from = 120, to = 160, how = "interpolate"}]'),
    "Reference": ('"auto", "none" or a rectangle [x, y, width, height]', "px", "[8, 80, 64, 32]"),
    "Axis": ('"track" or a vector [dx, dy]', "px", '"track"'),
    "Drive": ("path, force, or table", "N", '"drive.csv"'),
    "Sensor": ("path or table", "", '"acc.csv"'),
}
# The same for keys whose annotation says less than what they take.
KEYS = {
    "table": ("path or address", "", '"run_01.csv"'),
    "causal": ("true or false", "", "true"),
    "filter": ("name of a filter", "", '"papers"'),
    "order": ("whole number", "", "4"),
    "window": ("odd number", "frames", "31"),
    "cutoff": ("number or text with unit, above 0", "Hz", '"120 Hz"'),
    "drift": ("text with unit", "N or m", '"0.01 N"'),
    "exclude": ("list of polygons or rectangles", "px", "[[[430, 240], [450, 240], [450, 260]]]"),
    "model": ("text or list of texts", "", '["coulomb", "viscous"]'),
    "columns": ("table of headers by short name", "", '{t = "Time (ms)", x = "x (mm)"}'),
    "effect": ("text", "", '"vibration"'),
    "functions": ("list of texts", "", '["z^2*exp(-z)"]'),
    "fix": ("table of numbers or false", "SI", "{frequency = 60}"),
    "bounds": ("table of pairs", "SI", "{amplitude = [0, 2]}"),
    "prior": ("table of pairs", "SI", "{frequency = [60, 0.5]}"),
    "tie": ("table of texts", "", '{frequency = "2*vibration:2.frequency"}'),
    "follows_level": ("true or false", "", "true"),
    "per_run": ("list of names, or table of true or false", "", '["amplitude"]'),
    "formula": ("text", "N or m", '"F * s * exp(-((x - x_c)/w)^2)"'),
    "units": ("table of units by name", "", '{F = "N", x_c = "m", w = "m"}'),
}

_HEAD = """# Study file

A study file says what was filmed, what is known of it, and which model is fitted first. It is a
TOML file; `frictrack init FOLDER` writes one with comments. Paths are relative to the file. A number without a unit is
in the unit of the table below; a text may have another unit and an uncertainty: `"350 g"`,
`"0.350 +/- 0.002 kg"`. Unknown keys are refused, and all faults of a file are reported at once.

"""
_EXAMPLE = """## A short example

```toml
[study]
name = "steel on brass"
mass = "350 +/- 1 g"

[camera]
fps = 4000
scale = "0.500 +/- 0.002 mm/px"

[[run]]
video = "strike_01.avi"

[[run]]
video = "strike_02.avi"
mass = "700 +/- 1 g"
```
"""


def write_study_file(folder: Path) -> None:
    """Write the page of the study file into a folder.

    Parameters
    ----------
    folder
        Folder of the generated pages.

    """
    write_page(folder / "study_file.md", study_file_page())


def study_file_page() -> str:
    """Return the page as Markdown."""
    return _HEAD + "\n".join([_EXAMPLE, *map(_section, SECTIONS), _scale(), _tables()])


def _section(name: str) -> str:
    """Return the section of one table: its keys as a list of definitions."""
    kind = SECTIONS[name]
    entries = "\n".join(_entry(kind, key) for key in described(kind) if key)  # as the docstring orders them
    return f"## {name}\n\n{prose(described(kind)[''])}\n\n{entries}"


def _entry(kind: type[Keys], key: str) -> str:
    """Return one key: its name, what it takes, its meaning, its default and an example."""
    value, unit, example = value_of(kind, key)
    taken = f"{value}; {unit}" if unit else value
    default = _default(kind, key)
    said = [
        prose(described(kind)[key]),
        f"Default {code(default)}." if default else "",
        f"Example: {code(f'{key} = {example}')}." if example else "",
        "Required." if kind.model_fields[key].is_required() else "",
    ]
    return f"{code(key)} – *{prose(taken)}*\n: {' '.join(filter(None, said))}\n"


def value_of(kind: type[Keys], key: str) -> tuple[str, str, str]:
    """Return what a key takes: its value in words, its unit, and an example.

    Raises
    ------
    KeyError
        If the schema has a type that is not described in `TYPES`.

    Examples
    --------
    >>> value_of(RunTable, "fps")
    ('number or text with unit, above 0', 'Hz', '4000')
    >>> value_of(RunTable, "role")[0]
    '"fit" or "validation"'

    """
    if key in KEYS:
        return KEYS[key]
    words = _literals(kind.model_fields[key].annotation)
    if words:
        return " or ".join(f'"{word}"' for word in words), "", f'"{words[-1]}"'
    own = next(base for base in kind.__mro__ if key in getattr(base, "__annotations__", {}))  # or what it inherits from
    name = re.split(r"\W+", str(own.__annotations__[key]).removeprefix("Annotated["))[0]
    return TYPES[name]


def _literals(annotation: Any) -> list[str]:
    """Words of a key that takes nothing but these."""
    parts = [part for part in get_args(annotation) if part is not NoneType]
    nested = [_literals(part) for part in parts if get_args(part)]
    if parts and all(isinstance(part, str) for part in parts):
        return parts
    return nested[0] if len(nested) == len(parts) == 1 else []


def _default(kind: type[Keys], key: str) -> str:
    found = kind.model_fields[key]
    plainly = found.is_required() or found.default in (None, "", (), {})
    return "" if plainly else f'"{found.default}"' if isinstance(found.default, str) else str(found.default)


def described(kind: type[Keys]) -> dict[str, str]:
    """Return what the docstring of a section says of every key; "" is the section itself."""
    doc = ClassDoc(kind, config={"show_class_members": False})
    out = {"": " ".join(doc["Summary"])}
    for entry in doc["Attributes"]:
        out |= dict.fromkeys(entry.name.replace(",", " ").split(), " ".join(entry.desc))
    return out


def _scale() -> str:
    """Return the section on the forms of `scale`, from the comments that a new study file has."""
    keys = ", ".join(f"`{key}`" for key in SCALE)
    template = (Path(schema.__file__).parent / "first_keys.toml").read_text()
    lines = template.partition("# <scale>")[2].partition("\n# scale = ")[0].replace("\n# ", "\n")
    return f"## Forms of scale\n\n```text\n{lines}\n```\n\nKeys of the table: {keys}.\n"


def _tables() -> str:
    """Return the section on the headers of tables."""
    rows = [
        [code(key), code(header), prose(unit)]
        for key, (header, unit) in (COLUMNS | SENSOR_COLUMNS | POINT_COLUMNS).items()
    ]
    return (
        "## Columns of tables\n\nA table of a run needs `t_s` and `x_m` or `friction_N`; points (v, F) at "
        "constant speeds need `v` and `friction` or `mu` in `columns`; the others are optional. "
        "`columns` maps a short name to the header that your table has.\n\n"
        + table(["short name", "header", "unit"], rows)
    )
