"""Print the next experiment, and a plan of runs."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape

from frictrack.cli.tables import table
from frictrack.number_format import format_plain

MAX_EXAMPLES = 2  # pairs that are named for a run


def next_experiment(out: Console, steps: list[dict[str, Any]]) -> None:
    """Print the next experiments, best first, with the expected evidence.

    Parameters
    ----------
    out
        The terminal.
    steps
        "next_experiment" of the JSON of `frictrack diagnose`.

    """
    if not steps:
        return
    out.print("[bold]Next experiment[/bold]")
    for k, step in enumerate(steps, 1):
        out.print(f"  {k}. {escape(step['what'])}", soft_wrap=True)
        evidence = _evidence(step)
        if evidence:
            out.print(f"     {evidence}", soft_wrap=True, style="dim")


def _evidence(step: dict[str, Any]) -> str:
    """Describe which effects an experiment distinguishes, and how well."""
    if not step["separates"]:
        return ""
    groups = step.get("tells", ", ".join(step["separates"])).removesuffix(" apart")
    cost = "" if step.get("cost") in (None, 1.0) else f"; cost {format_plain(step['cost'], 3)}"
    return f"separates {groups}; expected delta BIC {_expected(step)}{cost}"


def _expected(step: dict[str, Any]) -> str:
    """Expected evidence with its 95 % interval, if that is known."""
    expected = format_plain(step.get("expected_delta_bic"), 2)
    low, high = step.get("expected_interval") or (None, None)
    if low is None:
        return expected
    above = f"at least {format_plain(low, 2)}" if high is None else f"{format_plain(low, 2)} to {format_plain(high, 2)}"
    return f"{expected} (95 %: {above})"


def plan(out: Console, result: dict[str, Any]) -> None:
    """Print the runs in order with what each adds, the pairs that remain, and what cannot be detected.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack plan`.

    """
    _film_now(out, result)
    for line in result["assumed"]:
        out.print(f"assumed: {escape(line)}", style="dim", soft_wrap=True)
    if result["done"]:
        out.print(f"filmed already: {escape('; '.join(result['done']))}", soft_wrap=True)
    rows = table("", "film", "cost", "separates", "pairs left", "for example")
    for k, run in enumerate(result["runs"], 1):
        some = run["separates"][:: max(1, len(run["separates"]) // MAX_EXAMPLES)][:MAX_EXAMPLES]
        example = "\n".join(" from ".join(pair) for pair in some)
        rows.add_row(
            str(k), escape(run["what"]), format_plain(run["cost"], 3), str(run["adds"]), str(run["pairs_left"]), example
        )
    if result["runs"]:
        out.print(rows)
    else:
        out.print(f"none of the possible runs separates any of the {result['pairs_before']} remaining pairs of effects")
    _open(out, result)
    _limits(out, result["detection_limits"])


def _film_now(out: Console, result: dict[str, Any]) -> None:
    """Print the run to film now with its settings, cost and expected evidence, or why there is none."""
    named = result.get("next")
    if named is None:
        if result.get("next_reason"):
            out.print(f"[bold]Next run[/bold]: no run; {escape(result['next_reason'])}", soft_wrap=True)
        return
    own = named["settings"]
    out.print(f"[bold]Next run[/bold]: {escape(named['what'])}", soft_wrap=True)
    settings = (
        f"speed {own['speed']:.3g} m/s, mass {own['mass']:.3g} kg, incline {own['incline_deg']:.2g} degrees, "
        f"{own['fps']:.4g} frames/s; cost {format_plain(named['cost'], 3)}"
    )
    out.print(f"  {settings}", soft_wrap=True)
    about = ", ".join(named["separates"])
    out.print(f"  about {about}; expected delta BIC {_expected(named)}", soft_wrap=True, style="dim")


def _open(out: Console, result: dict[str, Any]) -> None:
    for one in result["left"]:
        pair = " and ".join(one["effects"])
        what = f"[bold]{pair}[/bold] cannot be separated: {escape(one['why'])}; {escape(one['settle'])}"
        out.print(what, soft_wrap=True)
    for one in result["unseen"]:
        what = f"[bold]{one['effect']}[/bold] cannot be detected: {escape(one['why'])}; {escape(one['settle'])}"
        out.print(what, soft_wrap=True)
    for name, why in result["not_planned"].items():
        out.print(f"{name} was not planned for: it {escape(why)}", style="dim", soft_wrap=True)


def _limits(out: Console, limits: dict[str, Any]) -> None:
    rows = table("effect", "detection limit", "at")
    for name, limit in limits.items():
        unit = "" if limit["unit"] == "1" else limit["unit"]
        size = limit["reason"] if limit["value"] is None else f"{format_plain(limit['value'], 2)} {unit}".rstrip()
        rows.add_row(name, size, limit["at_words"])
    out.print(rows)
