"""Mark equations and names of the study file in plain text with HTML tags."""

from __future__ import annotations

import re

from markupsafe import Markup, escape

from frictrack.number_format import MINUS

GREEK = (("delta", "δ"), ("pi", "π"), ("omega", "ω"), ("tau", "τ"))
TICKS = re.compile(r"`([^`]+)`")
NAME = re.compile(r"(?<![A-Za-z_])([A-Za-z]+)_([A-Za-z0-9]+)")
POWER = re.compile(r"\^([A-Za-z0-9]+)")


def mark_equation(text: str) -> Markup:
    """Set the subscripts, powers and Greek letters of an equation in plain text as HTML.

    Parameters
    ----------
    text : str
        Plain text; it is escaped.

    Examples
    --------
    >>> str(mark_equation("F_c + k v^2"))
    'F<sub>c</sub> + k v<sup>2</sup>'

    """
    marked = POWER.sub(r"<sup>\1</sup>", NAME.sub(r"\1<sub>\2</sub>", str(escape(text))))
    for word, letter in GREEK:
        marked = re.sub(rf"\b{word}\b", letter, marked)
    return Markup(marked.replace(" - ", f" {MINUS} ").replace("(-", f"({MINUS}"))


def mark_code(text: str) -> Markup:
    """Set the text between backticks as code.

    Parameters
    ----------
    text : str
        Plain text; it is escaped.

    Examples
    --------
    >>> str(mark_code("write `mass = 0.35`"))
    'write <code>mass = 0.35</code>'

    """
    return Markup(TICKS.sub(r"<code>\1</code>", str(escape(text))))
