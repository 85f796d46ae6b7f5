"""Print a diagnosis: verdict, evidence, candidates, misfit that no effect explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from frictrack.candidates import MAIN_KINDS, CandidateRow, candidate_rows, not_passing
from frictrack.cli.fit_output import fails_at
from frictrack.cli.plan_output import next_experiment
from frictrack.cli.tables import filled_columns
from frictrack.motion_axes import AXES
from frictrack.number_format import format_plain
from frictrack.verdicts import (
    CHECK_FIRST,
    VERDICT_ONLY,
    describe_alternatives,
    describe_formula,
    describe_unnamed,
    describe_verdict,
    force_without_effect,
)

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
    if any(row.passes for row in rows):
        out.print(candidates([row for row in rows if row.passes or row.kind == "rival"]))
    for row in (one for one in rows if one.kind in MAIN_KINDS and one.parameters):
        out.print(escape(f"{row.effect}: {', '.join(row.parameters)}"))
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


def candidates(rows: Sequence[CandidateRow]) -> Table:
    """Return a table with one row per candidate.

    Parameters
    ----------
    rows
        From `candidate_rows`.

    """
    heads = ("candidate", "", "p", "delta BIC", "held-out error")
    cells = [(r.effect, r.standing, r.p, format_plain(r.delta_bic, 3), r.held_out) for r in rows]
    return filled_columns(heads, cells)


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
