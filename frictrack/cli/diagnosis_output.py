"""First evidence and what no effect explains, as a person at the bench reads them."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape

from frictrack.axes import AXES


def evidence(out: Console, found: list[dict[str, Any]]) -> None:
    """What moved in step with what the model leaves."""
    for one in found:
        out.print(f"[bold]evidence:[/bold] {escape(one['words'])}")


def unexplained(out: Console, left: dict[str, Any] | None) -> None:
    """The axis, the formulas, and what to paste into the study file."""
    if not left:
        return
    said = f"what no effect explains repeats best along {AXES[left['axis']].name}"
    out.print(escape(left.get("words") or said))
    for f in left["formulas"]:
        beside = f" beside {', '.join(f['beside'])}" if f.get("beside") else ""
        out.print(f"  {escape(f['formula'])}{beside}  ({100 * f['share']:.1f} % of it, delta BIC {f['delta_bic']:.4g})")
    if left["formulas"] and left["formulas"][0].get("toml"):
        out.print("to take the first into the law, paste into the study file and add unexplained:")
        out.print(escape(left["formulas"][0]["toml"]), highlight=False, soft_wrap=True)
