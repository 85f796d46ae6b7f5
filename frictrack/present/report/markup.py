"""Mark plain text with HTML tags, load the templates of all pages and embed figures in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from functools import cache
from inspect import isfunction
from itertools import count
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from frictrack.base import number_format
from frictrack.base.glossary import hover_pattern, meaning_of
from frictrack.base.number_format import MINUS, lower_first
from frictrack.present import plots
from frictrack.results.candidates import CandidateRow

GREEK = (("delta", "δ"), ("pi", "π"), ("omega", "ω"), ("tau", "τ"))
TICKS = re.compile(r"`([^`]+)`")
NAME = re.compile(r"(?<![A-Za-z_])([A-Za-z]+)_([A-Za-z0-9]+(?:[,_][A-Za-z0-9]+)*)")
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


UNEXPLAINED = (  # parts of a page in which no word is explained: figures, scripts, heads, links and tags
    r"(?P<unexplained><(?P<tag>head|svg|script|h1|nav|a|code|button)\b.*?</(?P=tag)>|<[^>]*>)"
)


def explain_words(html: str) -> str:
    """Let the pointer explain the words of the glossary: each where it stands first in a section of a page.

    Examples
    --------
    >>> explain_words("<p>a free run, a free run</p>")[:60]
    '<p>a <abbr tabindex="0" title="one simulation over a whole r'

    """
    seen: set[str] = set()

    def mark(found: re.Match[str]) -> str:
        if found["unexplained"]:
            if found[0].startswith(("<details", "<section")):
                seen.clear()
            return found[0]
        meaning = meaning_of(found[0])
        if meaning in seen:
            return found[0]
        seen.add(meaning)
        return f'<abbr tabindex="0" title="{escape(meaning)}">{found[0]}</abbr>'

    return re.sub(f"{UNEXPLAINED}|{hover_pattern().pattern}", mark, html, flags=re.DOTALL | re.IGNORECASE)


ID_ATTRIBUTES = re.compile(r'(\bid="|url\(#|xlink:href="#)')


@cache
def _templates(*packages: str) -> Environment:
    loader = ChoiceLoader([PackageLoader("frictrack", package) for package in (*packages, "present/report")])
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    # every function of `number_format` is a filter, without "format_" in its name; those of Jinja stay
    functions = {name: one for name, one in vars(number_format).items() if isfunction(one)}
    pages.filters = {name.removeprefix("format_"): one for name, one in functions.items()} | pages.filters
    pages.filters |= {"code": mark_code, "evidence": describe_evidence}
    return pages


def page_template(name: str, *packages: str) -> Template:
    """Load a template. Text that is written into it is escaped, and a name that it does not get is an error."""
    return _templates(*packages).get_template(name)


def sentences(macro: str, *arguments: Any) -> list[Markup]:
    """Fill in a macro of `sentences.html.j2`; every line that it gives is a sentence."""
    module: Any = page_template("sentences.html.j2").module
    lines = str(getattr(module, macro)(*arguments)).splitlines()
    return [Markup(line) for line in lines if line.strip()]


def describe_evidence(row: CandidateRow) -> str:
    """What a candidate effect is, and the evidence for it."""
    return f"{lower_first(row.source['words'].get('what', ''))}; {row.evidence}"


def now() -> str:
    """Local date and time, with the time zone."""
    return datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")


class SvgEmbedder:
    """Convert figures to SVG elements of one page, each with its own ids."""

    def __init__(self) -> None:
        self._numbers: Iterator[int] = count(1)

    def __call__(self, figure: Figure) -> Markup:
        """Convert a figure to an `<svg>` element."""
        return self.embed(plots.svg(figure))

    def embed(self, svg: str) -> Markup:
        """Give an `<svg>` element its own ids."""
        prefix = f"f{next(self._numbers)}-"
        return Markup(ID_ATTRIBUTES.sub(rf"\g<1>{prefix}", svg))
