"""Print the results of the commands as tables; the dictionaries are those that `--json` prints."""

from __future__ import annotations

import math
from collections.abc import Iterable
from math import hypot
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from frictrack.cli.blind_output import blind  # noqa: F401 - the command asks for `blind` here
from frictrack.cli.diagnosis_output import evidence, unexplained
from frictrack.cli.findings_output import findings
from frictrack.cli.plan_output import next_experiment, plan  # noqa: F401 - the command asks for `plan` here
from frictrack.cli.tables import table as _table
from frictrack.number_format import format_plain, format_plus_minus
from frictrack.verdicts import describe_verdict

ERRORS = {
    "rms_displacement_um": ("displacement, rms", "x / µm", 1.0),
    "rms_N": ("friction force, rms", "F / N", 1.0),
    "noise_N": ("noise of the measured force", "noise / N", 1.0),
    "heldout_rms_um": ("held out, rms", "held out / µm", 1.0),
    "heldout_rms_N": ("held out, rms, N", "held out / N", 1.0),
    "free_run_rms_um": ("free run, rms", "free run / µm", 1.0),
    "rms_acceleration": ("acceleration, rms", "a / m/s²", 1.0),
    "relative_force_error": ("relative force error", "force / %", 100.0),
    "reduced_chi2": ("reduced chi²", "chi²", 1.0),
}  # key of `errors` -> description, column head with its unit, factor
MAX_STUDIES = 100  # in the table of a batch; the page shows all
NOT_IN_TABLE = (
    "reason",
    "smoothing",
    "guard_frames",
    "sigma_x_um",
    "noise_at_rest_um",
)  # written as text, or only in the JSON


def fit(out: Console, result: dict[str, Any]) -> None:
    """Print the parameters with standard deviations and units, then the errors.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack fit`.

    """
    out.print(f"[bold]{' + '.join(result['model'])}[/bold]  ({result['domain']} domain, {result['search']})")
    if "equation" in result:
        out.print(escape(result["equation"]))
    out.print(parameters(result["parameters"]))
    if result.get("misfit"):
        out.print(f"[bold]† {escape(result['misfit']['words'])}[/bold]")
    for line in result.get("remarks", []):
        out.print(escape(line))
    if result.get("scale_error"):
        out.print(
            f"the scale has a standard deviation of {format_plain(100 * result['scale_error'], 2)} %, and so has every "
            "force above that was computed from acceleration; this error is common to all runs of a camera and not "
            "included in the ±"
        )
    own_motion(out, result)
    out.print(errors([("", result["errors"])]))


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
    heads = [*(["† ± with misfit"] if rejected else []), "unit", *(["95 % interval"] if has_intervals else [])]
    table = _table("parameter", "value", *heads, "")
    for name, p in values.items():
        word = p.get("reason") or ("at its bound" if p.get("at_bound") else _mu(p))
        cells = [interval(p)] if has_intervals else []
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
    columns = list(columns)
    table = _table("error", *(title for title, _ in columns), "unit")
    for key, cells in _errors([e for _, e in columns]).items():
        words, head, _ = ERRORS[key]
        table.add_row(words, *cells, head.partition(" / ")[2])
    return table


def _errors(models: list[dict[str, Any]]) -> dict[str, list[str]]:
    """Return the errors that any of the models has, as texts, one per model."""
    cells = {}
    for key, (*_, factor) in ERRORS.items():
        values = [e.get(key) for e in models]
        if any(v is not None for v in values):
            cells[key] = [format_plain(None if v is None else v * factor) for v in values]
    return cells


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


def history(out: Console, result: dict[str, Any]) -> None:
    """Print every model tried, in order, one row each.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack history`.

    """
    cells = _errors([model["errors"] for model in result["models"]])
    table = _table("model", *(ERRORS[key][1] for key in cells))
    for model, *values in zip(result["models"], *cells.values(), strict=True):
        name = "\n  ".join([model["name"], *model.get("settings", [])])
        table.add_row(escape(name), *values)
    out.print(table)


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
        table.add_row(s["run"], *ranges, f"{100 * s['share_of_error']:.0f} %", p_text)
    out.print(table)


def _reach(ends: list[float]) -> str:
    """Format both ends of a span, with as many digits as distinguish them."""
    size, width = max(map(abs, ends)), abs(ends[1] - ends[0])
    digits = 4 if width == 0 else max(4, 2 + math.ceil(math.log10(size / width)))
    return " to ".join(format_plain(end, digits) for end in ends)


def diagnose(out: Console, result: dict[str, Any]) -> None:
    """Print the verdict, the candidates, and the next experiment.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack diagnose`.

    """
    out.print(f"[bold]{escape(describe_verdict(result))}[/bold]")
    chi2, p = (format_plain(result.get(k), 3) for k in ("reduced_chi2", "p_lack_of_fit"))
    key, unit = ("noise_um", "µm") if result.get("noise_um") is not None else ("noise_N", "N")
    out.print(f"reduced chi² {chi2}, p of lack of fit {p}, noise {format_plain(result.get(key), 3)} {unit}")
    evidence(out, result.get("evidence") or [])
    fails_at(out, result.get("fails_at") or [])
    if result.get("repeats_words"):
        out.print(escape(result["repeats_words"]))
    findings(out, result.get("findings") or [])
    for gap in result.get("undetermined") or []:
        advice = f"; to settle it: {gap['settled_by']}" if gap["settled_by"] else ""
        out.print(escape(f"open: {gap['what']}, {gap['why']}{advice}"))
    if result["candidates"]:
        out.print(candidates([c for c in result["candidates"] if not c.get("implausible")]))
    for c in result["candidates"]:
        if c.get("implausible"):
            out.print(escape(f"{c['effect']} imitates the misfit and is not plausible: {c['implausible']}"))
    if result.get("importance"):
        out.print(importance(result["importance"]))
    unexplained(out, result.get("unexplained"))
    for remark in result.get("remarks", []):
        out.print(escape(remark))
    next_experiment(out, result.get("next_experiment") or [])


def candidates(found: list[dict[str, Any]]) -> Table:
    """Return a table with one row per candidate, best first.

    Parameters
    ----------
    found
        "candidates" of the JSON of `frictrack diagnose`; their values per run are not shown.

    """
    table = _table("candidate", "parameters", "p", "delta BIC", "held out", "indistinguishable from")
    table.columns[0].no_wrap = True
    for c in found:
        shared = {k: v for k, v in c["parameters"].items() if "[" not in k}
        values = (f"{name} {_with_unit(p)}" for name, p in shared.items())
        unit = "um" if c.get("heldout_rms_before_um") is not None else "N"
        before, after = (format_plain(c.get(f"heldout_rms_{when}_{unit}")) for when in ("before", "after"))
        rivals = ", ".join(c["indistinguishable_from"])
        known = c.get(f"heldout_rms_after_{unit}") is not None  # only the best few are held out
        held_out = f"{before} -> {after} {unit.replace('u', 'µ')}" if known else ""
        table.add_row(
            c["effect"], "\n".join(values), format_plain(c["p"], 2), format_plain(c["delta_bic"], 3), held_out, rivals
        )
    return table


def importance(rows: list[dict[str, Any]]) -> Table:
    """Return a table with the share of the misfit that each effect explains, alone and in sequence.

    Parameters
    ----------
    rows
        "importance" of the JSON of `frictrack diagnose`.

    """
    table = _table("effect", "explains alone", "adds in sequence", "held out after", "")
    for row in rows:
        shares = [_percent(row[key]) for key in ("explained_alone", "explained_in_sequence")]
        unit = "um" if "heldout_rms_after_um" in row else "N"
        rms = row[f"heldout_rms_after_{unit}"]
        after = "" if rms is None else f"{format_plain(rms)} {unit.replace('u', 'µ')}"
        table.add_row(row["effect"], *shares, after, "stop here" if row["stop"] else "")
    return table


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


def _with_unit(parameter: dict[str, Any]) -> str:
    unit = "" if parameter["value"] is None or parameter["unit"] == "1" else parameter["unit"]
    return f"{format_plus_minus(parameter['value'], parameter['std'])} {unit}".rstrip()


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


def run(out: Console, result: dict[str, Any]) -> None:
    """Print the fit, then the diagnosis."""
    fit(out, result["fit"])
    diagnose(out, result["diagnose"])


def demo(out: Console, result: dict[str, Any]) -> None:
    """Print the steps of the demonstration."""
    out.print("A sliding mass was filmed. The diagnosis of the study's first model:")
    diagnose(out, result["diagnose"])
    if result["add"]:
        out.print(f"[bold]{result['add']['effect']}[/bold] was added and the model fitted again:")
        edit(out, result["add"])
    out.print("Every model tried:")
    history(out, result["history"])


def reproduce(out: Console, result: dict[str, Any]) -> None:
    """Print every claim of the papers with its verdict.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack reproduce`.

    """
    for part in result["parts"]:
        out.print(f"[bold]{escape(part['title'])}[/bold]")
        for c in part["claims"]:
            out.print(f"  {c['where']}: {c['claim']}: [bold]{c['verdict']}[/bold]", soft_wrap=True)
            out.print(f"    printed: {escape(c['printed'])}; here: {escape(c['ours'])}", soft_wrap=True)
    n = result["counts"]
    out.print(f"{n['holds']} claims hold, {n['fails']} do not, {n['open']} cannot be decided")
    if result["quick"]:
        out.print("quick run with few seeds: no statistics")


def stages(out: Console, result: dict[str, Any]) -> None:
    """Print one row per run, then the notes.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack motion` or `friction`.

    """
    first = result["runs"][0]
    keys = [k for k in first if k not in NOT_IN_TABLE and not isinstance(first[k], dict | list)]
    table = _table(*(k.replace("_", " ") for k in keys))
    for row in result["runs"]:
        table.add_row(*(_cell(row.get(k)) for k in keys))
    out.print(table)
    for row in result["runs"]:
        for note in [*filter(None, [row.get("reason"), row.get("smoothing")]), *_happened(row), *row["notes"]]:
            out.print(f"{row['run']}: {escape(note)}", soft_wrap=True)
    for row in result["runs"]:
        if row.get("budget"):
            budget(out, row)


def _happened(row: dict[str, Any]) -> list[str]:
    """What happened in a run, and what a plain low-pass would have cost."""
    events = [f"{e['kind']} at {1e3 * e['from_s']:.1f} ms" for e in row.get("events", ())]
    lines = [", ".join(events)] if events else []
    cutoff = row.get("cutoff")
    if cutoff:
        plain = format_plain(hypot(cutoff["noise"], cutoff["lost"]), 2)
        lines.append(
            f"error of {format_plain(cutoff['followed_apart'], 2)} {cutoff['unit']}; a plain low-pass at "
            f"{format_plain(cutoff['chosen_Hz'])} Hz would have {plain}"
        )
        lines += cutoff["warnings"]
    return lines


def budget(out: Console, row: dict[str, Any]) -> None:
    """Print the error budget of one run's friction force, the total last, and what would make it smaller.

    Parameters
    ----------
    out
        The terminal.
    row
        A row of the JSON of `frictrack friction`.

    """
    table = _table(f"{row['run']}: error from", "size", "of the mean / N", "of a frame / N")
    for part in row["budget"]:
        unknown = part["source"] != "total" and part["size"] is None
        size = "not known" if unknown else f"{format_plain(part['size'], 2)} {part['unit']}" if part["unit"] else ""
        table.add_row(part["source"], size, *(format_plain(part[key], 2) for key in ("mean_N", "frame_N")))
    out.print(table)
    for says in row["budget_says"]:
        out.print(f"  {escape(says)}", soft_wrap=True)


def track(out: Console, result: dict[str, Any]) -> None:
    """Print how well each film was measured: a table in px, then details of each film.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack track`.

    """
    if not result["runs"]:
        out.print("no films in this study: its runs are tables")
        return
    heads = ("run", "found", "σ / px", "σ / µm", "score", "peak locking / px", "backward / px", "reference / px",
             "shake / px", "blur / px")  # fmt: skip
    table = _table(*heads)
    for row in result["runs"]:
        table.add_row(*_measured(row))
    out.print(table)
    out.print(
        "σ: standard deviation per frame; backward: rms difference to tracking from the last frame; reference: noise "
        "of the fixed reference",
        style="dim",
    )
    for row in result["runs"]:
        out.print(f"[bold]{escape(row['run'])}[/bold]  {escape(row['target'])}", soft_wrap=True)
        for line in _behind(row):
            out.print(f"  {escape(line)}", soft_wrap=True)


def _measured(row: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of one film."""
    locking = (row["peak_locking_px"], row["peak_locking_std_px"])
    shaking = "none" if row["shake_px"] == 0 else format_plain(row["shake_px"], 2)
    return (
        escape(row["run"]),
        f"{row['found']} of {row['frames']}",
        *(format_plain(row[key], 3) for key in ("sigma_px", "sigma_um")),
        format_plain(row["score"], 3),
        "-" if locking[0] is None else f"{locking[0]:.1g} ± {locking[1]:.1g}",
        format_plain(row["forward_backward_px"], 2),
        format_plain(row["noise_floor_px"], 2),
        shaking,
        format_plain(row["blur_px"], 2),
    )


def _behind(row: dict[str, Any]) -> list[str]:
    """Return the details of one film: time base, lost frames, notes, pictures."""
    audit = "; ".join(f"{r['what']} {r['value']} ({r['verdict']})" for r in row["timebase"] if r["verdict"] != "none")
    lost = ", ".join(f"{count} x {reason}" for reason, count in row["lost"].items())
    pictures = ", ".join(filter(None, (row["contact_sheet"], row["overlay"])))
    lines = [f"time base: {audit}" if audit else "", f"lost: {lost}" if lost else "", *row["notes"], pictures]
    return [line for line in lines if line]


def effects(out: Console, result: dict[str, Any]) -> None:
    """Print what each effect adds, looks like, and is confused with.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack effects`.

    """
    table = _table("effect", "equation", "parameters", "looks like", "mistaken for", box=box.SQUARE, show_lines=True)
    for e in result["effects"]:
        units = "\n".join(f"{p['name']} {p['unit']}" + ", per run" * p["per_run"] for p in e["parameters"])
        units += "".join(f"\nneeds {what}" for what in e["needs"])
        cells = e["name"], e["equation"], units, e["looks_like"], e["mistaken_for"]
        table.add_row(*(escape(text) for text in cells))
    out.print(table)
    out.print("`frictrack add STUDY EFFECT` adds an effect to the model")


def batch(out: Console, result: dict[str, Any]) -> None:
    """Print one row per study, and trends over the series.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack batch`.

    """
    table = _table("study", "runs", "verdict", "missing", "failed because")
    for row in result["studies"][:MAX_STUDIES]:
        table.add_row(*(_cell(row.get(k)) for k in ("study", "runs", "verdict", "missing", "reason")))
    out.print(table)
    if (more := len(result["studies"]) - MAX_STUDIES) > 0:
        out.print(f"and {more} more")
    for run in (one for one in result["failed"] if one["run"]):
        out.print(f"left out of {run['study']}: {run['reason']}", markup=False)
    for trend in (one for one in result["trends"] if one["holds"]):
        change = format_plus_minus(trend["change"], trend["change_std"])
        unit = f" {trend['unit']}".removesuffix(" 1")
        out.print(f"over the series, {trend['name']} changes by {change}{unit}", markup=False)


def verify(out: Console, result: dict[str, Any]) -> None:
    """Print one line per fault, then what was verified.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack verify`.

    """
    for fault in result["faults"]:
        out.print(f"{fault['kind']}: {fault['words']}", soft_wrap=True, markup=False)
    if old := result["without_checksums"]:
        out.print(f"{len(old)} files of an earlier schema have no checksums; they get them when they are next written")
    for folder in result["at_work"]:
        out.print(f"another frictrack process is writing in {folder}", soft_wrap=True, markup=False)
    if result["sound"]:
        out.print(f"{result['files']} result files are sound")


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return format_plain(value)
    if isinstance(value, list):
        return escape(", ".join(str(v) for v in value))
    return "" if value is None else escape(str(value))
