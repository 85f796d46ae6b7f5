"""Write the reference of the scene file from the code that reads it: films of known truth."""

from __future__ import annotations

import re
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

from numpydoc.docscrape import ClassDoc
from page_text import code, plain, prose, table, write_page
from pydantic_core import PydanticUndefined

from frictrack import samples
from frictrack.simulate.rendering import Camera, Highlight, Oscillation, Rod
from frictrack.simulate.scene import Block, Scene, SceneRun

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
    """Return the page as Markdown."""
    parts = [
        _HEAD + _example(),
        "## Keys of the scene\n\n" + _of_class(Scene),
        "## [law.EFFECT]\n\nParameters by name, as the [gallery](../../gallery/index.md) lists them for every effect. "
        "`F_s` is the total static friction. The effect `camera_shake` shakes the camera.\n",
        "## [camera]\n\n" + _of_class(Camera),
        "## [target]\n\n" + _of_class(Block),
        "## [rod]\n\nA rod in front of the block.\n\n" + _of_class(Rod),
        "## [highlight]\n\nA bright spot on the window.\n\n" + _of_class(Highlight),
        "## [[run]]\n\n" + _of_class(SceneRun),
        "## Oscillations\n\n`flicker`, `shake_x`, `shake_y`, `lift` and `rotation` are tables of these numbers.\n\n"
        + _of_class(Oscillation),
    ]
    return "\n".join(parts)


def _example() -> str:
    text = (samples.films_folder() / "scene.toml").read_text(encoding="utf-8").strip()
    return f"## The scene of the sample study\n\n```toml\n{text}\n```\n"


def _of_class(kind: Any) -> str:
    """Return the table of a class: its keys, what its docstring says of them, and their defaults."""
    doc = ClassDoc(kind, config={"show_class_members": False})
    said = {}
    for entry in [*doc["Parameters"], *doc["Attributes"]]:
        said |= dict.fromkeys(re.split(r"[,\s]+", entry.name), " ".join(entry.desc))
    if is_dataclass(kind):
        known = {f.name: (f.name, f.default) for f in fields(kind)}
    else:
        known = {name: (f.alias or name, f.default) for name, f in kind.model_fields.items()}
    rows = [[code(name), prose(said[key]), _default(default)] for key, (name, default) in known.items()]
    return table(["key", "meaning", "default"], rows)


def _default(value: Any) -> str:
    if value in (MISSING, PydanticUndefined):
        return "required"
    return plain(str(value)) if isinstance(value, str | float | int) else ""
