"""Print the results of the commands as tables; the dictionaries are those that `--json` prints."""

from __future__ import annotations

import shlex
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from frictrack.base.number_format import format_plain, format_plus_minus
from frictrack.cli.diagnosis_output import diagnose, diagnosis_rest, evidence_of, plan, verdict  # noqa: F401
from frictrack.cli.fit_output import compare, edit, fit, history, parameters, sentences  # noqa: F401 - `print_result` looks the function up here
from frictrack.cli.measurement_output import stages, track  # noqa: F401
from frictrack.cli.tables import cell, table
from frictrack.results.candidates import candidate_rows
from frictrack.results.error_rows import error_rows
from frictrack.results.verdicts import CHECK_FIRST, describe_verdict, force_without_effect

MAX_NAMED, MAX_PARAMETERS = 3, 6  # that `frictrack run` prints without --details
BRIEF_ERRORS = ("F", "held out", "force", "chi²")  # `short` in the rows of errors
SHARES = (  # words, and where they stand
    ("one hidden: named first", ("one", "named_first")),
    ("one hidden: first, or in its group", ("one", "in_group")),
    ("one hidden: first where nothing is like it", ("one", "first_where_alone")),
    ("one hidden: missed", ("one", "missed")),
    ("one hidden: more than one named", ("one", "more_than_hidden")),
    ("nothing hidden: false alarms", ("none", "false_alarms")),
    ("two hidden: both found", ("two", "both")),
    ("not in the library: unexplained, or reproduced", ("foreign", "unexplained_or_reproduced")),
    ("fault of the measurement: called one", ("fault", "called")),
    ("after: reduced chi-squared within 0.9-1.1", ("after", "reduced_chi2")),
    ("after: held out within 5 % of the noise", ("after", "heldout")),
    ("after: truth within the 99 % intervals", ("after", "parameters")),
)


def blind(out: Console, result: dict[str, Any]) -> None:
    """Print the shares of hits with intervals, detection limits and confusions.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack blind score`.

    """
    out.print(_shares(result))
    one, where, time = result["one"], result["where"], result["seconds"]
    out.print(
        f"median group {format_plain(one['median_group'])}, "
        f"of indistinguishable effects {format_plain(one['median_set'])}"
    )
    out.print(f"where it fails: mean F1 {format_plain(where['mean_f1'], 3)} over {where['of']} studies")
    out.print(f"a diagnosis takes {format_plain(time['median'], 3)} s, at most {format_plain(time['largest'], 3)} s")
    if result["limits"]:
        out.print(_limits(result["limits"]))
    if result["confusion"]:
        out.print(_confusion(result["confusion"]))
    for one in result["failed"]:
        out.print(f"{one['study']} failed: {escape(one['reason'])}")


def _shares(result: dict[str, Any]) -> Table:
    rows = table(f"{result['studies']} studies", "hits", "of", "share / %", "95 % interval / %")
    for words, (group, key) in SHARES:
        one = result[group][key]
        if one["of"]:
            low, high = (100 * q for q in one["interval"])
            rows.add_row(
                words, str(one["hits"]), str(one["of"]), format_plain(100 * one["share"], 3), f"{low:.1f}-{high:.1f}"
            )
    return rows


def _limits(limits: dict[str, dict[str, float]]) -> Table:
    rows = table("detection limit over the ideal detector's", "median", "largest", "studies")
    for name, one in limits.items():
        rows.add_row(name, format_plain(one["median"], 3), format_plain(one["largest"], 3), str(one["of"]))
    return rows


def _confusion(confusion: dict[str, dict[str, int]]) -> Table:
    rows = table("hidden", "named first")
    for name, counts in confusion.items():
        ordered = sorted(counts.items(), key=lambda pair: -pair[1])
        rows.add_row(name, ", ".join(f"{what} {count}" for what, count in ordered))
    return rows


MAX_DIFFERENCES = 5  # printed of one group
NOT_GIVEN = {"license": "a licence, without which nobody may use the data", "author": "an author"}


def crate(out: Console, result: dict[str, Any]) -> None:
    """Print size and content of a crate, and what is missing in it.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack export --to crate`.

    """
    out.print(f"{result['files']} files, {result['bytes'] / 1e6:.1f} MB")
    if result["by_hash"]:
        rows = table("not included, only its hash", "MB", "SHA-256")
        for one in result["by_hash"]:
            rows.add_row(escape(one["file"]), f"{one['bytes'] / 1e6:.1f}", one["sha256"][:12])
        out.print(rows)
        out.print("to include them: --include-recordings; publish them elsewhere otherwise", markup=False)
    for name in result["not_given"]:
        out.print(f"not given: {NOT_GIVEN[name]}; give --{name}", markup=False)


def reproduced_crate(out: Console, result: dict[str, Any]) -> None:
    """Print the comparison group by group, and which versions differ.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack reproduce CRATE`.

    """
    rows = table("group", "numbers", "largest difference", "equal")
    for group in result["groups"]:
        largest = group["largest_difference"]
        size = "infinite" if largest is None else f"{largest:.1e}" if largest else "0"
        equal = "yes" if group["equal"] else f"[bold]NO[/bold], {group['n_differences']}"
        rows.add_row(escape(f"{group['file']}:/{group['group']}"), str(group["numbers"]), size, equal)
    out.print(rows)
    for group in result["groups"]:
        for one in group["differences"][:MAX_DIFFERENCES]:
            where = f"{one['file']}:/{one['group']} {one['value']}".rstrip()
            out.print(f"{where}: {one['stored']} in the crate, {one['computed']} here", markup=False, soft_wrap=True)
    for place in result["altered"]:
        out.print(f"altered since the crate was written: {place}", markup=False, soft_wrap=True)
    for one in result["versions"]:
        out.print(f"{one['name']}: {one['stored']} in the crate, {one['computed']} here", markup=False, soft_wrap=True)
    if not result["equal"]:
        same = "are the same" if result["same_conclusions"] else "differ, too"
        out.print(f"models, verdicts, parameters and errors {same}")
    how = f"to a relative {result['tolerance']:g}, as versions differ" if result["versions"] else "bit for bit"
    out.print(f"{result['numbers']} numbers compared {how}, in {result['seconds']:.0f} s", markup=False)


MAX_STUDIES = 100  # in the table of a batch; the page shows all


def init(out: Console, result: dict[str, Any]) -> None:
    """Print what was found in a folder, what was left out, and what the user must give.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack init`.

    """
    rows = table("found", "")
    for one in result["found"]:
        rows.add_row(escape(one["file"]), escape(one["words"]))
    out.print(rows)
    if result["skipped"]:
        rows = table("left out", "")
        for one in result["skipped"]:
            rows.add_row(escape(one["file"]), escape(one["reason"]))
        out.print(rows)
    path = result["study"]
    needed = (
        f"fill in {', '.join(result['fill_in'])} (marked FILL IN), then" if result["fill_in"] else "look it over, then"
    )
    out.print(f"next: open {path}, {needed} `frictrack run {shlex.quote(path)}`", markup=False)


def prior(out: Console, result: dict[str, Any]) -> None:
    """Print the parameters of a prior file, and what was left out.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack export --to prior`.

    """
    rows = table("parameter", "value", "unit", "scales with")
    for name, one in result["parameters"].items():
        scales = "" if one["scales_with"] == "nothing" else one["scales_with"]
        rows.add_row(escape(name), format_plus_minus(one["value"], one["std"]), one["unit"], scales)
    out.print(rows)
    for name, reason in result["left_out"].items():
        out.print(f"left out: {escape(name)}, {escape(reason)}")


def export(out: Console, result: dict[str, Any]) -> None:
    """Print what the format could not hold.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack export`.

    """
    for what in result["lost"]:
        out.print(f"not in these files: {what}", soft_wrap=True, markup=False)


def run(out: Console, result: dict[str, Any]) -> None:
    """Print the fit, then the diagnosis."""
    fit(out, result["fit"], motion=False)
    diagnose(out, result["diagnose"])


def run_verdict(out: Console, result: dict[str, Any]) -> None:
    """Print the fit, then the verdict, while the rest is being computed."""
    fit(out, result["fit"], motion=False)
    verdict(out, result["diagnose"])


def run_rest(out: Console, result: dict[str, Any]) -> None:
    """Print what follows from a verdict that was printed before."""
    diagnosis_rest(out, result["diagnose"])


def run_brief(out: Console, result: dict[str, Any]) -> None:
    """Print the verdict with its evidence, the parameters, and the most important warning."""
    fitted = result["fit"]
    _brief_verdict(out, result["diagnose"])
    errors = [row for row in error_rows([fitted["errors"]]) if row.short in BRIEF_ERRORS]
    words = "; ".join(f"{e.name} {format_plain(e.values[0], 3)} {e.unit}".rstrip() for e in errors)
    out.print(escape(f"{' + '.join(fitted['model'])}: {words}"))
    shared = [(name, one) for name, one in fitted["parameters"].items() if "[" not in name][:MAX_PARAMETERS]
    out.print(parameters(dict(shared)))
    if left_out := _more(len(fitted["parameters"]) - len(shared), "parameter"):
        out.print(left_out.strip())
    if fitted.get("misfit"):
        out.print(escape(f"† {fitted['misfit']['words'].partition('. ')[0]}"))


def _brief_verdict(out: Console, found: dict[str, Any]) -> None:
    """Print the most important warning, the verdict, and the effects that it names with their evidence."""
    warnings = [f"{CHECK_FIRST} {one['words']}" for one in found.get("warnings") or []]
    warnings += [found["rests_on_repairs"]] if found.get("rests_on_repairs") else []
    warnings += [f"{one['run']}: {one['words']}" for one in found.get("findings") or []]
    for line in warnings[:1]:
        out.print(f"[bold]{escape(line)}[/bold]" + _more(len(warnings) - 1, "warning"))
    out.print(f"[bold]{escape(describe_verdict(found))}[/bold]")
    for row in [one for one in candidate_rows(found) if one.kind in ("named", "lead")][:MAX_NAMED]:
        out.print(escape(f"{row.effect}: {evidence_of(row)}"))
    if (left := force_without_effect(found)) and left.get("words"):
        out.print(escape(left["words"]))


def _more(count: int, what: str) -> str:
    return f" (and {count} more {what}{'s' * (count > 1)} in the report)" if count > 0 else ""


def demo(out: Console, result: dict[str, Any]) -> None:
    """Print the steps of the demonstration."""
    out.print("A sliding mass was filmed. The diagnosis of the study's first model:")
    _brief_verdict(out, result["diagnose"])
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


def effects(out: Console, result: dict[str, Any]) -> None:
    """Print one line per effect.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack effects`.

    """
    rows = table("effect", "what it is")
    longest = max(len(e["name"]) for e in result["effects"])
    rows.columns[1].no_wrap, rows.columns[1].overflow = True, "ellipsis"
    rows.columns[1].max_width = out.width - longest - 1
    for e in result["effects"]:
        rows.add_row(escape(e["name"]), escape(e["what"]))
    out.print(rows)
    out.print("`frictrack effects EFFECT` describes an effect; `frictrack add STUDY EFFECT` adds it to the model")


def explain(out: Console, result: dict[str, Any]) -> None:
    """Print the meaning of a word, and the effect of this name."""
    for term in result["terms"]:
        word, *others = term["words"]
        also = f" ({', '.join(others)})" if others else ""
        out.print(f"[bold]{escape(word)}[/bold]{escape(also)}: {escape(term['meaning'])}")
    described_effects(out, result)
    for e in result["effects"]:
        out.print(f"the same: `frictrack effects {e['name']}`; all effects: `frictrack effects`", markup=False)


def described_effects(out: Console, result: dict[str, Any]) -> None:
    """Print what each effect adds, looks like, and is confused with."""
    for e in result["effects"]:
        units = [f"{p['name']} {p['unit']}" + ", per run" * p["per_run"] for p in e["parameters"]]
        lines = {
            "equation": e["equation"],
            "parameters": "; ".join(units),
            "needs": "; ".join(e["needs"]),
            "looks like": e["looks_like"],
            "mistaken for": e["mistaken_for"],
            "confirm": e["confirm"],
            "source": e["source"],
        }
        out.print(f"[bold]{escape(e['name'])}[/bold]: {escape(e['what'])}")
        for head, text in lines.items():
            if text:
                out.print(f"  {head}: {escape(text)}")


def batch(out: Console, result: dict[str, Any]) -> None:
    """Print one row per study, and trends over the series.

    Parameters
    ----------
    out
        The terminal.
    result
        JSON of `frictrack batch`.

    """
    rows = table("study", "runs", "verdict", "missing", "failed because")
    rows.columns[0].no_wrap = False  # a path may be longer than the terminal
    for row in result["studies"][:MAX_STUDIES]:
        rows.add_row(*(cell(row.get(k)) for k in ("study", "runs", "verdict", "missing", "reason")))
    out.print(rows)
    if (more := len(result["studies"]) - MAX_STUDIES) > 0:
        out.print(f"and {more} more")
    for run in (one for one in result["failed"] if one["run"]):
        out.print(f"left out of {run['study']}: {run['reason']}", markup=False)
    for trend in (one for one in result["trends"] if one["holds"]):
        change = format_plus_minus(trend["change"], trend["change_std"])
        unit = f" {trend['unit']}".removesuffix(" 1")
        out.print(f"over the series, {trend['name']} changes by {change}{unit}", markup=False)
    for line in (line for one in result.get("conditions", ()) for line in one["words"]):
        out.print(line, markup=False)


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
    if old := result["partly_hashed"]:
        words = "identify their film by the hash of 3 MB of it; to have all of it hashed, delete them and run again"
        out.print(f"{len(old)} results of an earlier version {words}")
    for folder in result["at_work"]:
        out.print(f"another frictrack process is writing in {folder}", soft_wrap=True, markup=False)
    if result["sound"]:
        out.print(f"{result['files']} result files are sound")
