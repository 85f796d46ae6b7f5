"""Write one page for every public name of the Python interface, and an index by stage."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from figure_pictures import draw_pictures, example_of
from page_text import keep_only, prose, table, write_page

import frictrack
from frictrack.present import plots


@dataclass(frozen=True)
class Group:
    """One stage: its title, a sentence, the module, and the names in it."""

    title: str
    words: str
    module: str
    names: tuple[str, ...]


def returns_figure(found: Any) -> bool:
    """Return whether a function draws a figure."""
    return callable(found) and inspect.signature(found).return_annotation == "Figure"


GROUPS = (
    Group(
        "Data in",
        "Open a film, make runs of arrays or tables, get sample data.",
        "frictrack",
        ("open_recording", "Run", "with_earlier_runs", "samples"),
    ),
    Group(
        "Measuring",
        "Track the target, convert pixels to metres, smooth and differentiate, compute the friction force.",
        "frictrack",
        (
            *("track", "learn_target", "align_track", "contact_sheet", "repair", "suspect_spans"),
            *("calibrate", "plane_map"),
            *("low_pass", "differentiate", "covariance", "KnownAcceleration", "FilterChoice", "cutoff_tradeoff"),
            *("free_section", "friction", "find_events", "budget"),
        ),
    ),
    Group(
        "Fitting",
        "Choose a model and fit it; intervals by profile likelihood and bootstrap; global searches; priors from other "
        "set-ups.",
        "frictrack",
        ("models", "fit", "profile", "bootstrap", "search", "Prior"),
    ),
    Group(
        "Diagnosing",
        "Compare models, find where one fails and what it lacks; effects of the library and your own; how a law "
        "depends on temperature, load or material.",
        "frictrack",
        ("compare", "compare_groups", "history", "diagnose", "effects", "effect", "trend"),
    ),
    Group(
        "Simulating",
        "Simulate runs of known truth.",
        "frictrack",
        ("simulate",),
    ),
    Group(
        "Records and results",
        "What the functions return. Columns are arrays with one value per frame, in SI units.",
        "frictrack",
        (
            *("Track", "Displacement", "Motion", "frictrack.records.Friction", "frictrack.records.Curve"),
            *("frictrack.records.ModelledMotion", "frictrack.records.CutoffTradeOff"),
            *("Fit", "GroupFits", "frictrack.fit.Profile", "frictrack.fit.Bootstrap", "Comparison"),
            *("ParameterByGroup", "CovariateTrends"),
            *("Diagnosis", "frictrack.diagnose.Candidate", "FrictrackError"),
        ),
    ),
    Group(
        "Figures",
        "Every function draws one matplotlib figure of what the interface returns.",
        "frictrack.present.plots",
        (*(name for name, found in sorted(vars(plots).items()) if returns_figure(found)), "svg", "png"),
    ),
)

_HEAD = """# Python

```python
import frictrack as ft
```

All public names, by stage. The examples of these pages are run by the tests. Names are imported when they are first
used, so that `import frictrack` takes milliseconds.

"""


def write_python_api(folder: Path) -> None:
    """Write the index and the page of every name into a folder.

    Parameters
    ----------
    folder
        Folder of the generated pages.

    """
    draw_pictures(folder / "api" / "pictures")
    pages = {name: page for group in GROUPS for full in full_names(group) for name, page in pages_of(full).items()}
    for name, page in pages.items():
        write_page(folder / "api" / f"{name}.md", page)
    keep_only(folder / "api", pages)
    write_page(folder / "python.md", _index())


def full_names(group: Group) -> list[str]:
    """Return the names of a group with their modules."""
    return [name if name.startswith("frictrack.") else f"{group.module}.{name}" for name in group.names]


def resolve(full: str) -> Any:
    """Return the object of a full name."""
    module, _, name = full.rpartition(".")
    return getattr(import_module(module), name)


def pages_of(full: str) -> dict[str, str]:
    """Return the pages of a name: its own, and for a module those of the public names in it."""
    found = resolve(full)
    if not inspect.ismodule(found):
        return {full: _object_page(full, found)}
    members = public_members(found)
    pages = {f"{full}.{name}": _object_page(f"{full}.{name}", getattr(found, name)) for name in members}
    return {full: _module_page(full, members)} | pages


def public_members(module: Any) -> list[str]:
    """Return the public functions and classes of a module, those of typing and constants left out."""
    names = getattr(module, "__all__", None) or [
        name for name, one in vars(module).items() if str(getattr(one, "__module__", "")).startswith(module.__name__)
    ]
    return [name for name in names if not name.startswith("_") and _is_documented(getattr(module, name))]


def _is_documented(found: Any) -> bool:
    plain_object = inspect.isfunction(found) or inspect.isclass(found)
    return plain_object and str(found.__module__).startswith("frictrack")


def _object_page(full: str, found: Any) -> str:
    """Return the page of a function or class."""
    module, _, name = full.rpartition(".")
    if inspect.isclass(found):
        directive, options = "autoclass", "\n   :members:" * (not issubclass(found, Exception))
    else:
        directive, options = "autofunction", ""
    picture = example_of(name) if module == plots.__name__ else ""
    body = f".. currentmodule:: {module}\n\n.. {directive}:: {name}{options}"
    return f"# {full}\n\n```{{eval-rst}}\n{body}\n```\n{picture}"


def _module_page(full: str, members: list[str]) -> str:
    """Return the page of a module: its docstring and a table of its members."""
    names = [f"{full}.{name}" for name in members]
    return (
        f"# {full}\n\n```{{eval-rst}}\n.. automodule:: {full}\n```\n\n{_summary(names, '')}\n{_hidden_toctree(names)}"
    )


def _hidden_toctree(entries: list[str]) -> str:
    """Return the tree of pages that a table already links."""
    lines = "\n".join(entries)
    return f"```{{toctree}}\n:hidden:\n\n{lines}\n```\n"


def _summary(names: list[str], folder: str) -> str:
    rows = [[f"[`{_short(name)}`]({folder}{name}.md)", prose(first_line(resolve(name)))] for name in names]
    return table(["name", "what it is"], rows)


def _short(full: str) -> str:
    """Return how the name is called in code: ``ft.fit`` of "frictrack.fit"."""
    parts = full.split(".")
    return full.replace("frictrack.", "ft.", 1) if len(parts) <= 3 else full


def first_line(found: Any) -> str:
    """Return the summary line of a docstring."""
    return " ".join((inspect.getdoc(found) or "").split("\n\n")[0].split())


def _index() -> str:
    return _HEAD + "\n".join(_sections())


def _sections() -> Iterator[str]:
    for group in GROUPS:
        names = full_names(group)
        tree = _hidden_toctree([f"api/{name}" for name in names])
        yield f"## {group.title}\n\n{group.words}\n\n{_summary(names, 'api/')}\n{tree}"


def public_names() -> list[str]:
    """Return the public names that need a page: those of ``frictrack``, without its version."""
    return [f"frictrack.{name}" for name in frictrack.__all__ if name != "__version__"]
