"""Show a result in a notebook: its line of text and its figure."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from typing import Protocol

from matplotlib.figure import Figure

from frictrack.present.plots.style import png


class Drawable(Protocol):
    """What prints itself in a line and can be drawn."""

    def plot(self) -> Figure:
        """Return the figure."""
        ...


def html(result: Drawable) -> str:
    """Return the text and the figure of a result as HTML.

    Parameters
    ----------
    result : Drawable
        A record, run, fit or diagnosis.

    """
    picture = b64encode(png(result.plot())).decode()
    image = f'<img alt="" style="max-width: 100%" src="data:image/png;base64,{picture}">'
    return f"<p><code>{escape(repr(result))}</code></p>{image}"
