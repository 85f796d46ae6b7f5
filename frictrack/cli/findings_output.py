"""Print the notes on the recordings."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape

MAX_FINDINGS = 8  # that the terminal shows


def findings(out: Console, findings: list[dict[str, Any]]) -> None:
    """Print the notes on the recordings; the rest of a long list is left to the report.

    Parameters
    ----------
    out
        The terminal.
    findings
        "findings" of the JSON of `frictrack fit` or `diagnose`.

    """
    for found in findings[:MAX_FINDINGS]:
        out.print(escape(f"{found['run']}: {found['words']}"))
    if (more := len(findings) - MAX_FINDINGS) > 0:
        out.print(f"and {more} more findings in the records; the report lists them")
