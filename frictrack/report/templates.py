"""The templates of all pages: nothing is left undefined, what is written into them is escaped."""

from __future__ import annotations

from datetime import datetime

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template


def template(name: str, *rooms: str) -> Template:
    """A template of the report, or of other rooms of frictrack that are looked through first."""
    loader = ChoiceLoader([PackageLoader("frictrack", room) for room in (*rooms, "report")])
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return pages.get_template(name)


def now() -> str:
    """The time at which a page is written."""
    return datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
