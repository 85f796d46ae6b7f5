"""Write the reference of the scene file from the code that reads it: films of known truth."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

from numpydoc.docscrape import ClassDoc
from page_text import code, plain, prose, table, write_page

from frictrack import samples
from frictrack.simulate.rendering import Camera, Highlight, Oscillation, Rod
from frictrack.simulate.scene import RUN_KEYS, SCENE_KEYS, TARGET_KEYS

# Keys that no dataclass describes: meaning, unit and default.
TOP = {
    "name": ("name of the study", "", "scene"),
    "mass": ("mass at which the forces of the law are given", "kg", "0.35"),
    "scatter": ("relative standard deviation of dry friction from run to run", "", "0"),
    "format": ("suffix of the films", "", "avi"),
    "clamp_x": ("position of the clamp, for `beam_vibration`", "m", ""),
    "beam_length": ("free length of the beam, for `beam_vibration`", "m", ""),
    "lift": ("vertical motion of the mass, upward: amplitude (m), frequency (Hz), phase (rad)", "", ""),
    "law": ("a table `[law.EFFECT]` for every effect of the law: values of its parameters", "SI", ""),
    "camera": ("the table `[camera]`", "", ""),
    "target": ("the table `[target]`", "", ""),
    "rod": ("the table `[rod]`", "", ""),
    "highlight": ("the table `[highlight]`", "", ""),
    "run": ("a table `[[run]]` for every run", "", "required"),
}
RUN = {
    "name": ("name of the run and of its film", "", "required"),
    "v": ("speed at the start, or that a push would give without friction; negative toward -x", "m/s", "required"),
    "frames": ("number of frames", "", "required"),
    "push": ("duration of a push from rest; 0: the run starts in motion", "s", "0"),
    "mass": ("mass, where it differs", "kg", "that of the scene"),
    "width": ("width of the picture, where it differs", "px", "that of the camera"),
    "level": ("dry friction of this run over that of the law", "", "drawn with `scatter`"),
    "incline": ("angle by which the course rises toward +x", "rad", "0"),
    "pause": ("time since the end of the run before it, for `run_in` and `heating`", "s", "60"),
}
TARGET = {
    "width": ("length of the block along the course", "px", "90"),
    "height": ("height of the block", "px", "56"),
    "speckle": ("size of the speckles", "px", "4"),
    "rotation": ("rocking, clockwise in the picture: amplitude (degrees), frequency (Hz), phase (rad)", "", ""),
}

_HEAD = """# Scene file

A scene file (TOML) describes runs of known truth: the mass, the law that it obeys, and the camera that films it.
`frictrack render SCENE -o FOLDER` simulates the runs and writes their films, a study file and `truth.json`. Unknown
keys are refused.

"""


def write_scene_file(folder: Path) -> None:
    """Write the page of the scene file into a folder.

    Parameters
    ----------
    folder
        Folder of the generated pages.

    """
    write_page(folder / "scene_file.md", scene_file_page())


def scene_file_page() -> str:
    """Return the page as Markdown.

    Raises
    ------
    ValueError
        If a key of the code has no description here.

    """
    _check(SCENE_KEYS, TOP), _check(RUN_KEYS, RUN), _check(TARGET_KEYS, TARGET)
    parts = [
        _HEAD + _example(),
        "## Keys of the scene\n\n" + _table(TOP),
        "## [law.EFFECT]\n\nParameters by name, as the [gallery](../../gallery/index.md) lists them for every effect. "
        "`F_s` is the total static friction. The effect `camera_shake` shakes the camera.\n",
        "## [camera]\n\n" + _of_class(Camera),
        "## [target]\n\n" + _table(TARGET),
        "## [rod]\n\nA rod in front of the block.\n\n" + _of_class(Rod),
        "## [highlight]\n\nA bright spot on the window.\n\n" + _of_class(Highlight),
        "## [[run]]\n\n" + _table(RUN),
        "## Oscillations\n\n`flicker`, `shake_x`, `shake_y`, `lift` and `rotation` are tables of these numbers.\n\n"
        + _of_class(Oscillation),
    ]
    return "\n".join(parts)


def _check(keys: Iterable[str], described: dict[str, Any]) -> None:
    """Raise ValueError unless the code and this page know the same keys."""
    if different := set(keys) ^ described.keys():
        raise ValueError(f"expected a description of every key of a scene file, but {', '.join(different)} differ")


def _example() -> str:
    text = (samples.films_folder() / "scene.toml").read_text(encoding="utf-8").strip()
    return f"## The scene of the sample study\n\n```toml\n{text}\n```\n"


def _table(keys: dict[str, tuple[str, str, str]]) -> str:
    rows = [[code(key), prose(text), plain(unit), plain(default)] for key, (text, unit, default) in keys.items()]
    return table(["key", "meaning", "unit", "default"], rows)


def _of_class(kind: Any) -> str:
    """Return the table of a dataclass: its fields, what its docstring says of them, and their defaults."""
    doc = ClassDoc(kind, config={"show_class_members": False})
    said = {}
    for entry in [*doc["Parameters"], *doc["Attributes"]]:
        said |= dict.fromkeys(re.split(r"[,\s]+", entry.name), " ".join(entry.desc))
    rows = [[code(f.name), prose(said[f.name]), _default(f)] for f in fields(kind)]
    return table(["key", "meaning", "default"], rows)


def _default(f: Field[Any]) -> str:
    if f.default is MISSING:
        return "" if f.default_factory is not MISSING else "required"
    return "" if f.default is None else plain(str(f.default))
