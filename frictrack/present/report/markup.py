"""Mark plain text with HTML tags, load the templates of all pages and embed figures in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from itertools import count

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from frictrack.base.glossary import hover_pattern, meaning_of
from frictrack.base.number_format import MINUS
from frictrack.present import plots

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


UNEXPLAINED = re.compile(  # parts of a page in which no word is explained: figures, scripts, heads, links and tags
    r"(<(head|svg|script|h1|nav|a|code|button)\b.*?</\2>|<[^>]*>)", re.DOTALL
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
        meaning = meaning_of(found[0])
        if meaning in seen:
            return found[0]
        seen.add(meaning)
        return f'<abbr tabindex="0" title="{escape(meaning)}">{found[0]}</abbr>'

    parts: list[str] = []
    at = 0
    for skipped in UNEXPLAINED.finditer(html):
        parts += (hover_pattern().sub(mark, html[at : skipped.start()]), skipped[0])
        at = skipped.end()
        if skipped[0].startswith(("<details", "<section")):
            seen.clear()
    return "".join((*parts, hover_pattern().sub(mark, html[at:])))


ID_ATTRIBUTES = re.compile(r'(\bid="|url\(#|xlink:href="#)')


def page_template(name: str, *packages: str) -> Template:
    """Load a template. Text that is written into it is escaped, and a name that it does not get is an error.

    Parameters
    ----------
    name : str
        File name of the template.
    *packages : str
        Folders in that of frictrack that are searched before `present/report`.

    """
    loader = ChoiceLoader([PackageLoader("frictrack", package) for package in (*packages, "present/report")])
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return pages.get_template(name)


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
