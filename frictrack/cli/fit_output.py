"""Print fits: parameters, errors, comparison of models."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from frictrack.base.number_format import format_plain, format_plus_minus, format_share
from frictrack.cli.tables import break_name
from frictrack.cli.tables import table as _table
from frictrack.results.error_rows import error_rows
from frictrack.results.verdicts import describe_predictions, describe_tests

MAX_WIDTH = 1000  # of a table that is measured before it is broken to the width of the terminal


def fit(out: Console, result: dict[str, Any], *, motion: bool = True) -> None:
    """Print the parameters with standard deviations and units, then the errors.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack fit`.
    motion
        Whether to say how well the model knows the motion of every run.

    """
    out.print(f"[bold]{' + '.join(result['model'])}[/bold]  ({result['domain']} domain, {result['search']})")
    if "equation" in result:
        out.print(escape(result["equation"]))
    out.print(parameters(result["parameters"]))
    if result.get("prior"):
        _prior(out, result["prior"])
    if result.get("misfit"):
        out.print(f"[bold]† {escape(result['misfit']['words'])}[/bold]")
    for line in result.get("remarks", []):
        out.print(escape(line))
    if result.get("scale_error"):
        out.print(
            f"the scale has a standard deviation of {format_plain(100 * result['scale_error'], 2)} %, common to all "
            "runs of a camera and included in every ±"
        )
    if motion:
        own_motion(out, result)
    out.print(errors([("", result["errors"])]))


def _prior(out: Console, prior: dict[str, Any]) -> None:
    """Print how well the data agree with the prior; of several groups, group by group."""
    for group, one in prior.items() if "chi2" not in prior else [("", prior)]:
        said = "no direction determined by the runs" if one["p"] is None else f"p = {one['p']:.2g}"
        text = f"disagreement of runs and prior: chi² {one['chi2']:.3g} in {one['dof']} directions, {said}"
        out.print(f"{escape(group)}: {text}" if group else text)


def own_motion(out: Console, result: dict[str, Any]) -> None:
    """Print how precisely the model gives the motion of each run, and the collisions.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack fit`; of it "per_run" and "collisions" are used.

    """
    for row in result["per_run"]:
        motion = row.get("motion")
        if motion:
            model, smoothed = format_plain(motion["sigma_a"], 2), format_plain(motion["sigma_a_smoothed"], 2)
            text = f"standard deviation of a: {model} m/s² by the model, {smoothed} m/s² by smoothing"
            out.print(f"{escape(row['run'])}: {text}")
            for note in motion["notes"]:
                out.print(f"  {escape(note)}")
    for c in result.get("collisions", []):
        share = None if c["relative_std"] is None else 100 * c["relative_std"]
        impulse = f"impulse {format_plus_minus(c['impulse_N_s'], c['std'])} N s ({format_plain(share, 2)} %)"
        out.print(f"{escape(c['run'])}, {c['effect']}: {impulse}; {c['words']}")


def parameters(values: dict[str, Any]) -> Table:
    """Return a table with one row per parameter: value ± standard deviation, unit, remark.

    Parameters
    ----------
    values
        "parameters" of the JSON of `frictrack fit`: "value", "std", "unit", "reason" by name.

    """
    has_intervals = any("interval" in p for p in values.values())
    rejected = any("std_misfit" in p for p in values.values())
    with_prior = any("from_prior" in p for p in values.values())
    heads = [
        *(["† ± with misfit"] if rejected else []),
        "unit",
        *(["95 % interval"] if has_intervals else []),
        *(["from the prior"] if with_prior else []),
    ]
    table = _table("parameter", "value", *heads, "")
    for name, p in values.items():
        word = p.get("reason") or ("at its bound" if p.get("at_bound") else _mu(p))
        cells = [interval(p)] if has_intervals else []
        cells += [f"{100 * p['from_prior']:.0f} %" if "from_prior" in p else ""] if with_prior else []
        wider = [format_plain(p.get("std_misfit"), 2)] if rejected else []
        table.add_row(escape(name), format_plus_minus(p["value"], p["std"]), *wider, p["unit"], *cells, escape(word))
    return table


def interval(p: dict[str, Any]) -> str:
    """Format a 95 % interval; either end may be open.

    Parameters
    ----------
    p
        A parameter with the key "interval", if an interval was computed.

    Examples
    --------
    >>> interval({"interval": [1.0, None]})
    'above 1'

    """
    low, high = p.get("interval") or (None, None)
    if low is None and high is None:
        return "any" if "interval" in p else ""
    if low is None:
        return f"below {format_plain(high)}"
    return f"above {format_plain(low)}" if high is None else f"{format_plain(low)} to {format_plain(high)}"


def _mu(p: dict[str, Any]) -> str:
    """Format the coefficient of friction, if the normal load is known."""
    mu = p.get("mu")
    return "" if mu is None else f"mu {format_plus_minus(mu['value'], mu['std'])}"


def errors(columns: Iterable[tuple[str, dict[str, Any]]]) -> Table:
    """Return a table with one row per error and one column per model.

    Parameters
    ----------
    columns
        Head of the column, and "errors" of the model.

    """
    titles, models = zip(*columns, strict=True)
    table = _table("error", *titles, "unit")
    for row in (one for one in error_rows(models) if one.short):
        table.add_row(row.name, *map(format_plain, row.values), row.unit)
    return table


def compare(out: Console, result: dict[str, Any]) -> None:
    """Print the errors of every model, and where the current one fails.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack compare`.

    """
    history(out, result)
    fails_at(out, result["fails_at"])


def sentences(out: Console, result: dict[str, Any]) -> None:
    """Print the "words" of a result, one sentence a line.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack compare --parameter`.

    """
    for sentence in result["words"]:
        out.print(escape(sentence))


def history(out: Console, result: dict[str, Any]) -> None:
    """Print every model tried, in order, one row each.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack history`.

    """
    whole = _models(result["models"], str)
    fits = out.measure(whole, options=out.options.update(max_width=MAX_WIDTH)).maximum <= out.width
    out.print(whole if fits else _models(result["models"], break_name))
    for sentence in (*describe_tests(result), *describe_predictions(result)):
        out.print(escape(sentence))


def _models(models: list[dict[str, Any]], write: Callable[[str], str]) -> Table:
    """Return a table with one row per model; `write` formats its name."""
    rows = [row for row in error_rows(model["errors"] for model in models) if row.short]
    table = _table("model", *(f"{row.short} / {row.unit}" if row.unit else row.short for row in rows))
    for k, model in enumerate(models):
        name = "\n  ".join([write(model["name"]), *model.get("settings", [])])
        table.add_row(escape(name), *(format_plain(row.values[k]) for row in rows))
    return table


def fails_at(out: Console, spans: list[dict[str, Any]]) -> None:
    """Print spans of time, position and velocity with their share of the misfit.

    Parameters
    ----------
    out
        The terminal.
    spans
        "fails_at" of the JSON of `frictrack compare`.

    """
    if not spans:
        return
    table = _table("fails in", "t / s", "x / m", "v / (m/s)", "share of the misfit", "p")
    for s in spans:
        ranges = [_reach(s[k]) if s.get(k) else "-" for k in ("t", "x", "v")]
        p = s.get("p")
        p_text = "-" if p is None else "< 1e-6" if p < 1e-6 else format_plain(p, 1)
        table.add_row(s["run"], *ranges, format_share(s["share_of_error"]), p_text)
    out.print(table)


def _reach(ends: list[float]) -> str:
    """Format both ends of a span, with as many digits as distinguish them."""
    size, width = max(map(abs, ends)), abs(ends[1] - ends[0])
    digits = 4 if width == 0 else max(4, 2 + math.ceil(math.log10(size / width)))
    return " to ".join(format_plain(end, digits) for end in ends)


def edit(out: Console, result: dict[str, Any]) -> None:
    """Print the errors before and after an effect was added or removed.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack add` or `remove`.

    """
    out.print(parameters(result["parameters"]))
    out.print(errors([("before", result["error_before"]), ("after", result["error_after"])]))
