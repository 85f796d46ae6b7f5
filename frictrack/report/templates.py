"""Load the HTML templates of all pages and embed figures in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from itertools import count

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack import plots

ID_ATTRIBUTES = re.compile(r'(\bid="|url\(#|xlink:href="#)')


def page_template(name: str, *packages: str) -> Template:
    """Load a template. Text that is written into it is escaped, and a name that it does not get is an error.

    Parameters
    ----------
    name : str
        File name of the template.
    *packages : str
        Sub-packages of frictrack that are searched before `report`.

    """
    loader = ChoiceLoader([PackageLoader("frictrack", package) for package in (*packages, "report")])
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
