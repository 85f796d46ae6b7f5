"""Create HTML tables, figures and buttons for all tabs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn
from markupsafe import escape
from matplotlib.figure import Figure

from frictrack import plots
from frictrack.report.tables import TextTable

CSS = """
:host, body { font-family: system-ui, sans-serif; font-size: 14px; color: #1a1a1a; }
.ft-table { border-collapse: collapse; font-size: 14px; }
.ft-table th, .ft-table td { border-bottom: 1px solid #d0d0d0; padding: 4px 10px; text-align: left; }
.ft-table td.n { text-align: right; font-variant-numeric: tabular-nums; }
.ft-card { border: 1px solid #c8c8c8; border-left: 6px solid #0072b2; padding: 8px 12px; background: #fff; }
.ft-card.weak { border-left-color: #bbb; }
.ft-card h3, .ft-h { font-size: 15px; margin: 0 0 4px 0; }
.ft-note { color: #555; margin: 2px 0; }
.ft-message { padding: 6px 10px; background: #e8f1f8; min-height: 1.4em; }
.ft-message.wrong { background: #fbe3d6; border-left: 6px solid #d55e00; }
.ft-verdict { font-size: 17px; font-weight: 600; }
svg { max-width: 100%; height: auto; }
"""


def html(text: str, **more: Any) -> pn.pane.HTML:
    """Create a pane of HTML.

    Parameters
    ----------
    text : str
        HTML; text from files must be escaped before.
    **more
        Arguments of `panel.pane.HTML`.

    """
    wide = {} if "width" in more else {"sizing_mode": "stretch_width"}
    return pn.pane.HTML(text, stylesheets=[CSS], **wide, **more)


def grid(table: TextTable) -> str:
    """Convert a table to HTML.

    Parameters
    ----------
    table : TextTable
        The table; its cells are escaped unless they are `Markup`.

    """
    heads = "".join(f"<th>{escape(head)}</th>" for head in table.heads)
    kinds = [" class=n" if i in table.numeric else "" for i in range(len(table.heads))]
    rows = ("".join(f"<td{k}>{escape(c)}</td>" for k, c in zip(kinds, row, strict=True)) for row in table.rows)
    return f"<table class=ft-table><tr>{heads}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


def heading(text: str) -> str:
    """Convert a text to a small heading in HTML.

    Examples
    --------
    >>> heading("Notes")
    '<h2 class=ft-h>Notes</h2>'

    """
    return f"<h2 class=ft-h>{escape(text)}</h2>"


def note(text: str) -> str:
    """Convert a text to a remark in HTML.

    Examples
    --------
    >>> note("a < b")
    '<p class=ft-note>a &lt; b</p>'

    """
    return f"<p class=ft-note>{escape(text)}</p>"


def figure(made: Figure) -> pn.pane.HTML:
    """Show a figure as SVG."""
    return html(plots.svg(made))


def button(name: str, click: Callable[[], Any], kind: str = "default", **more: Any) -> pn.widgets.Button:
    """Create a button that calls a function without arguments.

    Parameters
    ----------
    name : str
        Text on the button.
    click : callable
        The function.
    kind : str
        Colour of the button in Panel: "default", "primary", "success" or "warning".
    **more
        Arguments of `panel.widgets.Button`.

    """
    made = pn.widgets.Button(label=name, color=kind, **more)
    made.on_click(lambda event: click())
    return made
