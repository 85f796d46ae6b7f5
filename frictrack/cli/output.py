"""Print the results of the commands; the dictionaries are those that `--json` prints."""

from __future__ import annotations

import math
import re
import shlex
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from frictrack.base.glossary import symbols_in
from frictrack.base.number_format import DASH, format_p_value, format_plain, format_plus_minus
from frictrack.results import candidates, verdicts

BOLD = "[bold]{}[/bold]"
BRIEF_ERRORS = ("F", "held out", "force", "chi²")  # `short` in the rows of errors
MAX_NAME_WIDTH = 20  # characters of a model's name in one line of a table
NOT_IN_TABLE = ("reason", "smoothing", "guard_frames", "sigma_x_um", "noise_at_rest_um")  # as text, or only in JSON


UNBROKEN = re.compile(r"\u202f| (?=[±×] )|(?<=[±×]) |(?<=[\d)]) (?=[%°†]|(?:[kmnµ]?[gmNs]|Hz|px)\b)|(?<=N) (?=s\b)")
LETTERS = {" ": "\ue000", "\u202f": "\ue001"}  # that no text has


class Terminal(Console):
    """Console that ends no line within a number or before its unit, except in tables.

    Rich ends lines also at spaces that do not break, so they are printed as letters first.
    """

    lines = 0  # that were printed

    def print(self, *objects: Any, **how: Any) -> None:
        """Print texts and tables."""
        with self.capture() as printed:
            marked = (UNBROKEN.sub(lambda m: LETTERS[m[0]], one) if isinstance(one, str) else one for one in objects)
            super().print(*marked, **how)
        text = printed.get().translate({ord(letter): space for space, letter in LETTERS.items()})
        self.lines += text.count("\n")
        self.file.write(text)


def table(*headers: str, rows: Iterable[Sequence[str]] = ()) -> Table:
    """Return a table without a box; names in the first column and words that are not long stay whole."""
    new, rows = Table(box=None, pad_edge=False, header_style="dim"), list(rows)
    for i, header in enumerate(headers):
        words = " ".join([header, *(row[i] for row in rows)]).split()
        longest = max((len(word) for word in words if len(word) <= MAX_NAME_WIDTH), default=None)
        new.add_column(header, overflow="fold", no_wrap=i == 0, min_width=longest)
    for row in rows:
        new.add_row(*map(escape, row))
    return new


def filled_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table without its empty columns."""
    filled = [k for k in range(len(heads)) if any(row[k] not in ("", DASH) for row in rows)]
    return table(*(heads[k] for k in filled), rows=([row[k] for k in filled] for row in rows))


def cell(value: Any) -> str:
    """Format a value of a dictionary for a table."""
    if isinstance(value, float):
        return format_plain(value)
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return "" if value is None else str(value)


def say(out: Console, *texts: str | None, form: str = "{}", **how: Any) -> None:
    """Print texts that are not empty, one a line, each in a form with markup."""
    for text in filter(None, texts):
        out.print(form.format(escape(text)), **how)


# --- measurements


def stages(out: Console, result: dict[str, Any]) -> None:
    """Print one row per run, then the notes and the error budgets."""
    runs = result["runs"]
    keys = [k for k, value in runs[0].items() if k not in NOT_IN_TABLE and not isinstance(value, dict | list)]
    heads = (k.replace("_", " ") for k in keys)
    out.print(table(*heads, rows=([cell(row.get(k)) for k in keys] for row in runs)))
    for row in runs:
        notes = (row.get("reason"), row.get("smoothing"), *_happened(row), *row["notes"])
        say(out, *(f"{row['run']}: {note}" for note in notes if note), soft_wrap=True)
    for row in runs:
        if row.get("budget"):
            _budget(out, row)


def _happened(row: dict[str, Any]) -> list[str]:
    """What happened in a run, and what a plain low-pass would have cost."""
    found = [", ".join(f"{e['kind']} at {1e3 * e['from_s']:.1f} ms" for e in row.get("events", ()))]
    if cutoff := row.get("cutoff"):
        plain = format_plain(math.hypot(cutoff["noise"], cutoff["lost"]), 2)
        error = f"error of {format_plain(cutoff['followed_apart'], 2)} {cutoff['unit']}"
        found.append(f"{error}; a plain low-pass at {format_plain(cutoff['chosen_Hz'])} Hz would have {plain}")
        found += cutoff["warnings"]
    return found


def _budget(out: Console, row: dict[str, Any]) -> None:
    """Print the error budget of one run's friction force, the total last, and what would make it smaller."""
    rows = table(f"{row['run']}: error from", "size", "of the mean / N", "of a frame / N")
    for part in row["budget"]:
        unknown = part["source"] != "total" and part["size"] is None
        size = "not known" if unknown else f"{format_plain(part['size'], 2)} {part['unit']}" if part["unit"] else ""
        rows.add_row(part["source"], size, *(format_plain(part[key], 2) for key in ("mean_N", "frame_N")))
    out.print(rows)
    say(out, *row["budget_says"], form="  {}", soft_wrap=True)


def track(out: Console, result: dict[str, Any]) -> None:
    """Print how well each film was measured: a table in px, then details of each film."""
    if not result["runs"]:
        out.print("no films in this study: its runs are tables")
        return
    rows = [(r["run"], f"{r['found']}/{r['frames']}", *candidates.measurement_cells(r)) for r in result["runs"]]
    out.print(filled_table(("run", "found", *candidates.MEASUREMENT_HEADS), rows))
    out.print(
        "σ: standard deviation per frame; locking: peak locking; back: rms difference to tracking from the last frame; "
        "fixed: noise of the fixed reference",
        style="dim",
    )
    for row in result["runs"]:
        out.print(f"[bold]{escape(row['run'])}[/bold]  {escape(row['target'])}", soft_wrap=True)
        say(out, *_details(row), form="  {}", soft_wrap=True)


def _details(row: dict[str, Any]) -> list[str]:
    """Return the details of one film: time base, lost frames, notes, pictures."""
    audit = "; ".join(f"{r['what']} {r['value']} ({r['verdict']})" for r in row["timebase"] if r["verdict"] != "none")
    reasons = ", ".join(f"{count} x {reason}" for reason, count in row["lost"].items())
    lost = f"{verdicts.describe_lost(sum(row['lost'].values()), row['frames'])}: {reasons}" if reasons else ""
    pictures = ", ".join(filter(None, (row["contact_sheet"], row["overlay"])))
    look_at = [f"look at frames {span['first']} to {span['last']}: {span['words']}" for span in row.get("suspects", [])]
    return [f"time base: {audit}" if audit else "", lost, *look_at, *row["notes"], pictures]


# --- fits


def fit(out: Console, result: dict[str, Any]) -> None:
    """Print the parameters with standard deviations and units, then the errors."""
    out.print(f"[bold]{' + '.join(result['model'])}[/bold]  ({result['domain']} domain, {result['search']})")
    if "equation" in result:
        out.print(escape(result["equation"]))
        out.print(f"{symbols_in(result['equation'])}.", style="dim")
    out.print(parameters(result["parameters"]))
    prior = result.get("prior") or {}
    for group, one in prior.items() if "chi2" not in prior else [("", prior)]:
        said = "no direction determined by the runs" if one["p"] is None else f"p = {one['p']:.2g}"
        of = f"{group}: " if group else ""
        say(out, f"{of}disagreement of runs and prior: chi² {one['chi2']:.3g} in {one['dof']} directions, {said}")
    say(out, (result.get("misfit") or {}).get("words"), form="[bold]† {}[/bold]")
    say(out, *result.get("remarks") or ())
    if error := result.get("scale_error"):
        share = f"the scale has a standard deviation of {format_plain(100 * error, 2)} %"
        out.print(f"{share}, common to all runs of a camera and included in every ±")
    out.print(errors([("", result["errors"])]))


def parameters(values: dict[str, Any], *, brief: bool = False, more: str = "") -> Table:
    """Return a table with one row per parameter: value ± standard deviation, remark.

    A dagger column with wider deviations, intervals and the weight of a prior are shown where any parameter has them;
    a brief table has one ± that includes the misfit, and the remark as far as it fits into a line; `more` says what it
    leaves out.
    """
    found = {name: candidates.parameter_row(p) for name, p in values.items()}
    if brief:
        new = table("parameter", "value ± std", more)
        new.columns[1].no_wrap = True
        for name, row in found.items():
            new.add_row(escape(name), row.short, Text(row.short_remark, no_wrap=True, overflow="ellipsis"))
        return new
    heads = ("parameter", "value ± std", "† ± with misfit", "95 % interval", "from the prior", "")
    cells = [(n, r.value, r.misfit, r.interval, r.from_prior, r.remark) for n, r in found.items()]
    return filled_table(heads, cells)


def errors(columns: Iterable[tuple[str, dict[str, Any]]], *, brief: bool = False) -> Table:
    """Return a table with one row per error and one column per model; a brief one has only `BRIEF_ERRORS`."""
    titles, models = zip(*columns, strict=True)
    found = (row for row in candidates.error_rows(models) if (row.short in BRIEF_ERRORS if brief else row.short))
    return table("error", *titles, "unit", rows=([r.name, *map(format_plain, r.values), r.unit] for r in found))


def sentences(out: Console, result: dict[str, Any]) -> None:
    """Print the sentences of a result, one a line."""
    say(out, *result["words"])


def history(out: Console, result: dict[str, Any]) -> None:
    """Print every model tried, in order, one row each."""
    models = result["models"]
    found = [row for row in candidates.error_rows(model["errors"] for model in models) if row.short]
    heads = (f"{row.short} / {row.unit}" if row.unit else row.short for row in found)
    rows = table("model", *heads)
    for k, model in enumerate(models):
        name = candidates.numbered_name(model["name"])
        name = name if len(name) <= MAX_NAME_WIDTH else name.replace(" + ", "\n  + ")
        words = escape("\n  ".join([name, *model.get("settings", [])]))
        rows.add_row(words, *(format_plain(row.values[k]) for row in found))
    out.print(rows)
    say(out, *verdicts.describe_tests(result), *verdicts.describe_predictions(result))


def fails_at(out: Console, result: dict[str, Any]) -> None:
    """Print spans of time, position and velocity with their share of the misfit."""
    if spans := result.get("fails_at"):
        out.print(table("fails in", *candidates.FAILING_HEADS, rows=candidates.failing_rows(spans)))


MAX_FINDINGS = 8  # that the terminal shows
MAX_LINES, LAST_LINES, MIN_PARAMETERS = 15, 3, 2  # without --details; the last: what to look at, and the results
MAX_NAMED, MAX_RUNS = 2, 3  # effects and runs to film that are printed without --details
MAX_DIFFERENCES = 5  # printed of one group
MAX_STUDIES = 100  # in the table of a batch; the page shows all
NOT_GIVEN = {"license": "a licence, without which nobody may use the data", "author": "an author"}
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

# --- the diagnosis


def verdict(out: Console, result: dict[str, Any]) -> None:
    """Print the verdict and the candidates."""
    warnings = (found["words"] for found in result.get("warnings") or [])
    say(out, *warnings, form=f"[bold]{verdicts.CHECK_FIRST}[/bold] {{}}")
    say(out, verdicts.headline(result), form=BOLD)
    chi2, p = format_plain(result.get("reduced_chi2"), 3), format_p_value(result.get("p_lack_of_fit"))
    key, unit = ("noise_um", "µm") if result.get("noise_um") is not None else ("noise_N", "N")
    out.print(f"reduced chi² {chi2}, lack of fit: p {p}, noise {format_plain(result.get(key), 3)} {unit}")
    say(out, result.get("rests_on_repairs"), form=BOLD)
    findings = [f"{one['run']}: {one['words']}" for one in result.get("findings") or []]
    say(out, *findings[:MAX_FINDINGS])
    if (more := len(findings) - MAX_FINDINGS) > 0:
        out.print(f"and {more} more findings in the records; the report lists them")
    for gap in result.get("undetermined") or []:
        advice = f"; to settle it: {gap['settled_by']}" if gap["settled_by"] else ""
        say(out, f"open: {gap['what']}, {gap['why']}{advice}")
    rows = candidates.candidate_rows(result)
    for row in (one for one in rows if one.passes or one.kind in candidates.MAIN_KINDS):
        out.print(f"[bold]{escape(row.effect)}[/bold]: {escape(row.standing)}")
        out.print(f"  {escape(row.line)}")
    say(out, candidates.not_passing(rows))


def diagnosis_rest(out: Console, result: dict[str, Any]) -> None:
    """Print what follows from the verdict: where the model fails, how much each effect explains, what to film next."""
    result = result.get("diagnose", result)  # of `frictrack run`
    say(out, *(one["words"] for one in result.get("evidence") or []), form="[bold]evidence:[/bold] {}")
    rows = [one for one in candidates.candidate_rows(result) if one.kind in candidates.MAIN_KINDS and one.share]
    say(out, *(f"{row.effect} alone explains {row.share} of the misfit" for row in rows))
    fails_at(out, result)
    say(out, result.get("repeats_words"), *verdicts.describe_alternatives(result))
    unexplained(out, verdicts.force_without_effect(result))
    say(out, *result.get("remarks") or ())
    next_experiment(out, result)
    say(out, None if result.get("complete", True) else verdicts.VERDICT_ONLY)


def unexplained(out: Console, left: Mapping[str, Any] | None) -> None:
    """Print the variable on which the misfit depends, formulas for it, and text for the study file."""
    if not left:
        return
    say(out, verdicts.describe_unexplained(left))
    for k, f in enumerate(left["formulas"], 1):
        others = f" with {', '.join(f['beside'])}" if f.get("beside") else ""
        evidence = "; ".join([verdicts.formula_evidence(f), *verdicts.describe_formula(f)[: 1 if k > 1 else None]])
        say(out, f"  {k}. {f['formula']}{others}  ({evidence})")
    say(out, verdicts.describe_unnamed(left))
    if left["formulas"] and left["formulas"][0].get("toml"):
        out.print("to use the first formula, add it with `frictrack add STUDY formula:1`, which writes this table:")
        out.print(escape(left["formulas"][0]["toml"]), highlight=False, soft_wrap=True)


def next_experiment(out: Console, result: dict[str, Any]) -> None:
    """Print the next experiments, best first, with the expected evidence."""
    steps = verdicts.next_experiments(result)
    say(out, *["Next experiment"] * bool(steps), form=BOLD)
    for k, step in enumerate(steps, 1):
        say(out, step.what, form=f"  {k}. {{}}", soft_wrap=True)
        if step.separates:
            out.print(f"     {step.words}", soft_wrap=True, style="dim")


def plan(out: Console, result: dict[str, Any]) -> None:
    """Print the first runs in order with what each adds, and how much all leave open."""
    _film_now(out, result)
    rows = table("", "film", "cost", "separates", "pairs left", "for example")
    for k, run in enumerate(result["runs"][:MAX_RUNS], 1):
        example = " from ".join(run["separates"][0]) if run["separates"] else ""
        numbers = (format_plain(run["cost"], 3), str(run["adds"]), str(run["pairs_left"]))
        rows.add_row(str(k), escape(run["what"]), *numbers, example)
    none = f"none of the possible runs separates any of the {result['pairs_before']} remaining pairs of effects"
    out.print(rows if result["runs"] else none)
    left, unseen, rest = (len(result[key]) for key in ("left", "unseen", "not_planned"))
    out.print(f"left open: {left} groups not separated, {unseen} effects not detected, {rest} not planned for")


def plan_details(out: Console, result: dict[str, Any]) -> None:
    """Print what is filmed and assumed, what no run settles and why, and the detection limits."""
    say(out, "; ".join(result["done"]), form="filmed already: {}", soft_wrap=True)
    say(out, *result["assumed"], form="assumed: {}", soft_wrap=True, style="dim")
    left = [(" and ".join(one["effects"]), "separated", one) for one in result["left"]]
    for what, done, one in (*left, *((one["effect"], "detected", one) for one in result["unseen"])):
        say(out, f"{one['why']}; {one['settle']}", form=f"[bold]{what}[/bold] cannot be {done}: {{}}", soft_wrap=True)
    not_planned = (f"{name} was not planned for: it {why}" for name, why in result["not_planned"].items())
    say(out, *not_planned, soft_wrap=True, style="dim")
    rows = table("effect", "detection limit", "at")
    for name, limit in result["detection_limits"].items():
        unit = "" if limit["unit"] == "1" else limit["unit"]
        size = limit["reason"] if limit["value"] is None else f"{format_plain(limit['value'], 2)} {unit}".rstrip()
        rows.add_row(name, size, limit["at_words"])
    out.print(rows)


def _film_now(out: Console, result: dict[str, Any]) -> None:
    """Print the run to film now with its settings, cost and expected evidence, or why there is none."""
    named = result.get("next")
    if named is None:
        say(out, result.get("next_reason"), form="[bold]Next run[/bold]: no run; {}", soft_wrap=True)
        return
    own, about = named["settings"], ", ".join(named["separates"])
    set_up = (
        f"speed {own['speed']:.3g} m/s, mass {own['mass']:.3g} kg, incline {own['incline_deg']:.2g} degrees, "
        f"{own['fps']:.4g} frames/s; cost {format_plain(named['cost'], 3)}"
    )
    evidence = f"about {about}; expected delta BIC {verdicts.expected_evidence(named)}"
    say(out, named["what"], form="[bold]Next run[/bold]: {}", soft_wrap=True)
    say(out, set_up, form="  {}", soft_wrap=True)
    say(out, evidence, form="  {}", soft_wrap=True, style="dim")


# --- the whole analysis


def run_verdict(out: Console, result: dict[str, Any]) -> None:
    """Print the fit, then the verdict, while the rest is being computed."""
    fit(out, result["fit"])
    verdict(out, result["diagnose"])


def run_brief(out: Terminal, result: dict[str, Any]) -> None:
    """Print the verdict with its evidence, the parameters, and the most important warning."""
    fitted = result["fit"]
    _brief_verdict(out, result["diagnose"])
    found = [row for row in candidates.error_rows([fitted["errors"]]) if row.short in BRIEF_ERRORS][-3:]
    say(out, "; ".join(f"{e.name} {format_plain(e.values[0], 3)} {e.unit}".rstrip() for e in found))
    _brief_parameters(out, fitted)


def _brief_parameters(out: Terminal, result: dict[str, Any], after: int = LAST_LINES) -> None:
    """Print what fits of the parameters that all runs share and that were fitted, and what a dagger means.

    Those that the data do not determine are left out first. `after` is the number of lines that will follow.
    """
    fitted = {name: one for name, one in result["parameters"].items() if one.get("reason") != "fixed"}
    misfit = (result.get("misfit") or {}).get("words", "").partition(". ")[0]
    most = max(MAX_LINES - out.lines - after - 1 - bool(misfit), MIN_PARAMETERS)
    shared = sorted((name for name in fitted if "[" not in name), key=lambda name: fitted[name].get("value") is None)
    shown = {name: one for name, one in fitted.items() if name in shared[:most]}
    left_out = len(fitted) - len(shown)
    out.print(parameters(shown, brief=True, more=f"and {left_out} more in the report" * (left_out > 0)))
    say(out, misfit, form="† {}")


def _brief_verdict(out: Console, found: dict[str, Any]) -> None:
    """Print the most important warning, the verdict, and the effects that it names with their evidence."""
    warnings = [f"{verdicts.CHECK_FIRST} {one['words']}" for one in found.get("warnings") or []]
    warnings += [found["rests_on_repairs"]] if found.get("rests_on_repairs") else []
    warnings += [f"{one['run']}: {one['words']}" for one in found.get("findings") or []]
    say(out, *warnings[:1], form=BOLD + f" (and {len(warnings) - 1} more in the report)" * (len(warnings) > 1))
    say(out, verdicts.headline(found), form=BOLD)
    if found["verdict"] == "undetermined":
        say(out, verdicts.describe_open_question(found))
    rows = [row for row in candidates.candidate_rows(found) if row.kind in ("named", "lead")]
    say(out, *(f"{row.effect}: {row.line}" for row in rows[:MAX_NAMED]))
    say(out, (verdicts.force_without_effect(found) or {}).get("words"))


def demo(out: Terminal, result: dict[str, Any]) -> None:
    """Print the steps of the demonstration."""
    out.print("A sliding mass was filmed. The diagnosis of the study's first model:")
    _brief_verdict(out, result["diagnose"])
    if result["add"]:
        change = candidates.describe_held_out(result["add"]["error_before"], result["add"]["error_after"])
        out.print(f"With [bold]{result['add']['effect']}[/bold] in the model, {change}")
        _brief_parameters(out, result["add"], LAST_LINES - 1)


def edit(out: Terminal, result: dict[str, Any]) -> None:
    """Print the parameters, and the errors before and after an effect was added or removed."""
    both = errors([("before", result["error_before"]), ("after", result["error_after"])], brief=True)
    _brief_parameters(out, result, both.row_count + 1 + LAST_LINES)
    out.print(both)


# --- the other commands


def blind(out: Console, result: dict[str, Any]) -> None:
    """Print the shares of hits with intervals; score.json has more: groups, detection limits, confusions, times."""
    rows = table(f"{result['studies']} studies", "hits", "of", "share / %", "95 % interval / %")
    for words, (group, key) in SHARES:
        if (hits := result[group][key])["of"]:
            low, high = (100 * q for q in hits["interval"])
            share = (format_plain(100 * hits["share"], 3), f"{low:.1f}-{high:.1f}")
            rows.add_row(words, str(hits["hits"]), str(hits["of"]), *share)
    out.print(rows)
    say(out, *(f"{failed['study']} failed: {failed['reason']}" for failed in result["failed"]))


def crate(out: Console, result: dict[str, Any]) -> None:
    """Print size and content of a crate, and what is missing in it."""
    out.print(f"{result['files']} files, {result['bytes'] / 1e6:.1f} MB")
    if result["by_hash"]:
        files = ((f["file"], f"{f['bytes'] / 1e6:.1f}", f["sha256"][:12]) for f in result["by_hash"])
        out.print(table("not included, only its hash", "MB", "SHA-256", rows=files))
        out.print("to include them: --include-recordings; publish them elsewhere otherwise")
    say(out, *(f"not given: {NOT_GIVEN[name]}; give --{name}" for name in result["not_given"]))


def reproduced_crate(out: Console, result: dict[str, Any]) -> None:
    """Print the comparison group by group, and which versions differ."""
    rows = table("group", "numbers", "largest difference", "equal")
    for group in result["groups"]:
        largest = group["largest_difference"]
        size = "infinite" if largest is None else f"{largest:.1e}" if largest else "0"
        equal = "yes" if group["equal"] else f"[bold]NO[/bold], {group['n_differences']}"
        rows.add_row(escape(f"{group['file']}:/{group['group']}"), str(group["numbers"]), size, equal)
    out.print(rows)
    differ = [one for group in result["groups"] for one in group["differences"][:MAX_DIFFERENCES]]
    places = [(f"{one['file']}:/{one['group']} {one['value']}".rstrip(), one) for one in differ]
    places += [(one["name"], one) for one in result["versions"]]
    differences = (f"{what}: {one['stored']} in the crate, {one['computed']} here" for what, one in places)
    say(out, *differences, soft_wrap=True)
    say(out, *result["altered"], form="altered since the crate was written: {}", soft_wrap=True)
    if not result["equal"]:
        same = "are the same" if result["same_conclusions"] else "differ, too"
        out.print(f"models, verdicts, parameters and errors {same}")
    how = f"to a relative {result['tolerance']:g}, as versions differ" if result["versions"] else "bit for bit"
    out.print(f"{result['numbers']} numbers compared {how}, in {result['seconds']:.0f} s", markup=False)


def init(out: Console, result: dict[str, Any]) -> None:
    """Print what was found in a folder, what was left out, and what the user must give."""
    out.print(table("found", "", rows=((one["file"], one["words"]) for one in result["found"])))
    if result["skipped"]:
        out.print(table("left out", "", rows=((one["file"], one["reason"]) for one in result["skipped"])))
    needed = f"fill in {', '.join(result['fill_in'])} (marked FILL IN)" if result["fill_in"] else "look it over"
    path = result["study"]
    out.print(f"next: open {path}, {needed}, then `frictrack run {shlex.quote(path)}`", markup=False)


def prior(out: Console, result: dict[str, Any]) -> None:
    """Print the parameters of a prior file, and what was left out."""
    rows = table("parameter", "value", "unit", "scales with")
    for name, one in result["parameters"].items():
        scales = "" if one["scales_with"] == "nothing" else one["scales_with"]
        rows.add_row(escape(name), format_plus_minus(one["value"], one["std"]), one["unit"], scales)
    out.print(rows)
    say(out, *(f"left out: {name}, {reason}" for name, reason in result["left_out"].items()))


def export(out: Console, result: dict[str, Any]) -> None:
    """Print what the format could not hold."""
    say(out, *result["lost"], form="not in these files: {}", soft_wrap=True)


def reproduce(out: Console, result: dict[str, Any]) -> None:
    """Print every claim of the papers with its verdict."""
    for part in result["parts"]:
        say(out, part["title"], form=BOLD)
        for c in part["claims"]:
            out.print(f"  {c['where']}: {c['claim']}: [bold]{c['verdict']}[/bold]", soft_wrap=True)
            out.print(f"    printed: {escape(c['printed'])}; here: {escape(c['ours'])}", soft_wrap=True)
    n = result["counts"]
    out.print(f"{n['holds']} claims hold, {n['fails']} do not, {n['open']} cannot be decided")
    say(out, "quick run with few seeds: no statistics" if result["quick"] else None)


def effects(out: Console, result: dict[str, Any]) -> None:
    """Print one line per effect."""
    width = out.width - max(len(e["name"]) for e in result["effects"]) - 2
    named = ((e["name"], textwrap.shorten(e["what"], width, placeholder=" …")) for e in result["effects"])
    out.print(table("effect", "what it is", rows=named))
    out.print("`frictrack effects EFFECT` describes an effect; `frictrack add STUDY EFFECT` adds it to the model")


def explain(out: Console, result: dict[str, Any]) -> None:
    """Print the meaning of a word, and the effect of this name."""
    for term in result["terms"]:
        word, *others = term["words"]
        also = f" ({', '.join(others)})" if others else ""
        out.print(f"[bold]{escape(word)}[/bold]{escape(also)}: {escape(term['meaning'])}")
    described_effects(out, result)
    say(out, *(f"the same: `frictrack effects {e['name']}`" for e in result["effects"]), soft_wrap=True)


def described_effects(out: Console, result: dict[str, Any]) -> None:
    """Print what each effect adds, looks like, and is confused with."""
    for e in result["effects"]:
        units = [f"{p['name']} {p['unit']}" + ", per run" * p["per_run"] for p in e["parameters"]]
        symbols = symbols_in(e["equation"], {p["name"] for p in e["parameters"]})
        said = e | {"parameters": "; ".join(units), "symbols": symbols, "needs": "; ".join(e["needs"])}
        out.print(f"[bold]{escape(e['name'])}[/bold]: {escape(e['what'])}")
        keys = ("equation", "parameters", "symbols", "needs", "looks_like", "mistaken_for", "confirm", "source")
        say(out, *(f"{key.replace('_', ' ')}: {said[key]}" for key in keys if said[key]), form="  {}")


def batch(out: Console, result: dict[str, Any]) -> None:
    """Print one row per study, and trends over the series."""
    rows = table("study", "runs", "verdict", "missing", "failed because")
    rows.columns[0].no_wrap = False  # a path may be longer than the terminal
    for row in result["studies"][:MAX_STUDIES]:
        rows.add_row(*(escape(cell(row.get(k))) for k in ("study", "runs", "verdict", "missing", "reason")))
    out.print(rows)
    if (more := len(result["studies"]) - MAX_STUDIES) > 0:
        out.print(f"and {more} more")
    say(out, *(f"left out of {failed['study']}: {failed['reason']}" for failed in result["failed"] if failed["run"]))
    for trend in (one for one in result["trends"] if one["holds"]):
        change = format_plus_minus(trend["change"], trend["change_std"])
        unit = f" {trend['unit']}".removesuffix(" 1")
        say(out, f"over the series, {trend['name']} changes by {change}{unit}")
    say(out, *(line for one in result.get("conditions", ()) for line in one["words"]))


def verify(out: Console, result: dict[str, Any]) -> None:
    """Print one line per fault, then what was verified."""
    say(out, *(f"{fault['kind']}: {fault['words']}" for fault in result["faults"]), soft_wrap=True)
    if old := result["without_checksums"]:
        out.print(f"{len(old)} files of an earlier schema have no checksums; they get them when they are next written")
    if old := result["partly_hashed"]:
        words = "identify their film by the hash of 3 MB of it; to have all of it hashed, delete them and run again"
        out.print(f"{len(old)} results of an earlier version {words}")
    say(out, *result["at_work"], form="another frictrack process is writing in {}", soft_wrap=True)
    say(out, f"{result['files']} result files are sound" if result["sound"] else None)
