"""Print a diagnosis: verdict, evidence, candidates, misfit that no effect explains."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape

from frictrack.base.number_format import format_plain
from frictrack.cli.fit_output import fails_at
from frictrack.cli.tables import table
from frictrack.results.candidates import MAIN_KINDS, CandidateRow, candidate_rows, not_passing
from frictrack.results.motion_axes import AXES
from frictrack.results.verdicts import (
    CHECK_FIRST,
    VERDICT_ONLY,
    describe_alternatives,
    describe_formula,
    describe_unnamed,
    describe_verdict,
    force_without_effect,
)

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


MAX_FINDINGS = 8  # that the terminal shows


def diagnose(out: Console, result: dict[str, Any]) -> None:
    """Print the verdict, the candidates, and the next experiment.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack diagnose`.

    """
    verdict(out, result)
    diagnosis_rest(out, result)


def verdict(out: Console, result: dict[str, Any]) -> None:
    """Print the verdict and the candidates.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack diagnose`, also of one that is not complete.

    """
    for found in result.get("warnings") or []:
        out.print(f"[bold]{CHECK_FIRST}[/bold] {escape(found['words'])}")
    out.print(f"[bold]{escape(describe_verdict(result))}[/bold]")
    chi2, p = (format_plain(result.get(k), 3) for k in ("reduced_chi2", "p_lack_of_fit"))
    key, unit = ("noise_um", "µm") if result.get("noise_um") is not None else ("noise_N", "N")
    out.print(f"reduced chi² {chi2}, p of lack of fit {p}, noise {format_plain(result.get(key), 3)} {unit}")
    if rests := result.get("rests_on_repairs"):
        out.print(f"[bold]{escape(rests)}[/bold]")
    findings(out, result.get("findings") or [])
    for gap in result.get("undetermined") or []:
        advice = f"; to settle it: {gap['settled_by']}" if gap["settled_by"] else ""
        out.print(escape(f"open: {gap['what']}, {gap['why']}{advice}"))
    rows = candidate_rows(result)
    for row in (one for one in rows if one.passes or one.kind in MAIN_KINDS):
        out.print(f"[bold]{escape(row.effect)}[/bold]: {escape(row.standing)}")
        for line in textwrap.wrap(evidence_of(row), out.width - 2):
            out.print(f"  {escape(line)}")
    if others := not_passing(rows):
        out.print(others)


def diagnosis_rest(out: Console, result: dict[str, Any]) -> None:
    """Print what follows from the verdict: where the model fails, how much each effect explains, what to film next.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack diagnose`.

    """
    evidence(out, result.get("evidence") or [])
    for row in (one for one in candidate_rows(result) if one.kind in MAIN_KINDS and one.share):
        out.print(escape(f"{row.effect} alone explains {row.share} of the misfit"))
    fails_at(out, result.get("fails_at") or [])
    if result.get("repeats_words"):
        out.print(escape(result["repeats_words"]))
    for words in describe_alternatives(result):
        out.print(escape(words))
    unexplained(out, force_without_effect(result))
    for remark in result.get("remarks", []):
        out.print(escape(remark))
    next_experiment(out, result.get("next_experiment") or [])
    if not result.get("complete", True):
        out.print(VERDICT_ONLY)


def evidence_of(row: CandidateRow) -> str:
    """Return parameters, evidence and held-out error of a candidate in one line."""
    error = f"held-out error {row.held_out}" if row.held_out else ""
    return "; ".join(filter(None, (", ".join(row.parameters), row.evidence, error)))


def findings(out: Console, found: list[dict[str, Any]]) -> None:
    """Print the notes on the recordings; the rest of a long list is left to the report.

    Parameters
    ----------
    out
        The terminal.
    found
        "findings" of the JSON of `frictrack fit` or `diagnose`.

    """
    for one in found[:MAX_FINDINGS]:
        out.print(escape(f"{one['run']}: {one['words']}"))
    if (more := len(found) - MAX_FINDINGS) > 0:
        out.print(f"and {more} more findings in the records; the report lists them")


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


def unexplained(out: Console, left: Mapping[str, Any] | None) -> None:
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
    for k, f in enumerate(left["formulas"], 1):
        others = f" with {', '.join(f['beside'])}" if f.get("beside") else ""
        share = f"{100 * f['share']:.1f} % of it, delta BIC {f['delta_bic']:.4g}"
        evidence = "; ".join([share, *describe_formula(f)[: 1 if k > 1 else None]])
        out.print(escape(f"  {k}. {f['formula']}{others}  ({evidence})"))
    if unnamed := describe_unnamed(left):
        out.print(unnamed)
    if left["formulas"] and left["formulas"][0].get("toml"):
        out.print("to use the first formula, add it with `frictrack add STUDY formula:1`, which writes this table:")
        out.print(escape(left["formulas"][0]["toml"]), highlight=False, soft_wrap=True)
