"""Print the evidence from auxiliary signals, and the misfit that no effect explains."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape

from frictrack.axes import AXES


def evidence(out: Console, found: list[dict[str, Any]]) -> None:
    """Print the auxiliary signals that correlate with the residual of the model.

    Parameters
    ----------
    out
        The terminal.
    found
        "evidence" of the JSON of `frictrack diagnose`.

    """
    for one in found:
        out.print(f"[bold]evidence:[/bold] {escape(one['words'])}")


def unexplained(out: Console, left: dict[str, Any] | None) -> None:
    """Print the variable on which the misfit depends, formulas for it, and text for the study file.

    Parameters
    ----------
    out
        The terminal.
    left
        "unexplained" of the JSON of `frictrack diagnose`; None prints nothing.

    """
    if not left:
        return
    default = f"the misfit that no effect explains depends on {AXES[left['axis']].name}"
    out.print(escape(left.get("words") or default))
    for f in left["formulas"]:
        others = f" with {', '.join(f['beside'])}" if f.get("beside") else ""
        out.print(f"  {escape(f['formula'])}{others}  ({100 * f['share']:.1f} % of it, delta BIC {f['delta_bic']:.4g})")
    if left["formulas"] and left["formulas"][0].get("toml"):
        out.print("to use the first formula, paste this into the study file and add the effect `unexplained`:")
        out.print(escape(left["formulas"][0]["toml"]), highlight=False, soft_wrap=True)
