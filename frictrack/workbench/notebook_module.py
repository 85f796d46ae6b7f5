"""Join the modules of the linked plots to one text, because a notebook widget is one module and one style sheet."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files

STATIC = files("frictrack.workbench").joinpath("static")
ENTRY = "widget.js"
IMPORT = re.compile(r'^import (\{[^}]+\}) from "\./([\w.]+)";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:class|function|const|let) (\w+))", re.MULTILINE)


@cache
def widget_module() -> str:
    """Text of the module: every imported module becomes a function that is called once and returns its exports.

    Returns
    -------
    str
        An ES module without imports.

    """
    joined: dict[str, str] = {}
    _add(ENTRY, joined)
    return "\n".join(joined.values())


def _add(name: str, joined: dict[str, str]) -> None:
    """Add a module after those that it imports."""
    text = STATIC.joinpath("plots", name).read_text(encoding="utf-8")
    for _, other in IMPORT.findall(text):
        if other not in joined:
            _add(other, joined)
    text = IMPORT.sub(lambda found: f"const {found[1].replace(' as ', ': ')} = {_variable(found[2])};\n", text)
    if name == ENTRY:
        joined[name] = text
        return
    exported = ", ".join(EXPORT.findall(text))
    body = EXPORT.sub("", text)
    joined[name] = f"const {_variable(name)} = (() => {{\n{body}return {{ {exported} }};\n}})();\n"


def _variable(name: str) -> str:
    return f"module_{name.removesuffix('.js')}"


@cache
def widget_style() -> str:
    """Style sheet of the widget; its design tokens hold within the widget only.

    Returns
    -------
    str
        CSS.

    """
    tokens = STATIC.joinpath("tokens.css").read_text(encoding="utf-8").replace(":root", ".fp-notebook")
    return tokens + STATIC.joinpath("plots", "plots.css").read_text(encoding="utf-8")
