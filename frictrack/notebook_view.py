"""The base of results that a notebook shows with their figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from frictrack.lazy import imported

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class NotebookView:
    """Base of records and results that can be drawn; a notebook shows their line of text and their figure."""

    drawn_by: ClassVar[str]  # the function that draws it, "package.module:name"; it is imported when it is called

    def plot(self) -> Figure:
        """Draw it as a matplotlib figure."""
        figure: Figure = imported(self.drawn_by)(self)
        return figure

    def _repr_html_(self) -> str:
        page: str = imported("frictrack.plots:html")(self)
        return page
