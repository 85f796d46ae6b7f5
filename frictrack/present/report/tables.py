"""Tables of text for the report and the page; plain text marked with HTML tags, templates and embedded figures."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from inspect import isfunction
from itertools import count
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from frictrack.base import number_format
from frictrack.base.glossary import hover_pattern, meaning_of
from frictrack.base.number_format import DASH, MINUS, format_number, format_size, lower_first
from frictrack.present import plots
from frictrack.present.plots import parameter_unit
from frictrack.present.plots.style import axis_label
from frictrack.results import ModelResults, RunResults, candidates

Cell = str | Markup


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Attributes
    ----------
    heads : tuple of str
        One heading per column.
    rows : tuple of tuples
        Cells as plain text, or as `Markup` where they contain HTML.
    numeric : frozenset of int
        Indices of the columns that are aligned to the right.

    """

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    numeric: frozenset[int] = frozenset()


def make_table(heads: Sequence[str], rows: Sequence[Sequence[Cell]], numeric: Sequence[int] = ()) -> TextTable:
    """Build a table and leave out its empty columns.

    Parameters
    ----------
    heads : sequence of str
        One heading per column.
    rows : sequence of sequences
        One cell per column in each row. A column is empty if its cells are all "" or a dash.
    numeric : sequence of int
        Indices of the columns of numbers, counted before any column is left out.

    Examples
    --------
    >>> make_table(("run", "mass", "speed"), [("v1", "", "2.0")], numeric=(1, 2))
    TextTable(heads=('run', 'speed'), rows=(('v1', '2.0'),), numeric=frozenset({1}))

    """
    kept = [k for k in range(len(heads)) if not rows or any(row[k] not in ("", DASH) for row in rows)]
    new_index = {old: new for new, old in enumerate(kept)}
    return TextTable(
        tuple(heads[k] for k in kept),
        tuple(tuple(row[k] for k in kept) for row in rows),
        frozenset(new_index[k] for k in numeric if k in new_index),
    )


def code_cell(text: str) -> Markup:
    """Set a name of the study file or the command line as code."""
    return Markup("<code>{}</code>").format(text)


PER_RUN_NAME = re.compile(r"^(?P<name>.+)\[(?P<run>.+)\]$")  # "vibration.phase[v3]"
MAX_FIRST_PARAMETERS = 8  # of the first screen
UNRESOLVED = "not resolved: the impulse is known, the peak force is not"
UNITS_WITH_SCALE_ERROR = ("N", "N s", "m", "m/s")  # in N s/m and N/m the error of the scale cancels


def parameter_table(model: ModelResults, scale_error: float = 0.0) -> TextTable:
    """Table of the parameters that all runs share.

    If the model is rejected, a column marked with a dagger gives the standard deviation that includes the misfit.

    Parameters
    ----------
    model : ModelResults
        The fitted model.
    scale_error : float
        Relative standard deviation of the scale. A column gives its contribution to each parameter.

    """
    unresolved = {f"{c['effect']}.width" for c in model.summary.get("collisions", []) if not c["resolved"]}
    rows = []
    for name, p in model.summary["parameters"].items():
        if not PER_RUN_NAME.match(name):
            row = candidates.parameter_row(p)
            remark = UNRESOLVED if name in unresolved else row.remark
            rows.append((code_cell(name), row.value, row.misfit, _scale_contribution(p, scale_error), remark))
    return make_table(("parameter", "value ± std", "† ± with the misfit", "± of the scale", ""), rows, (1, 2, 3))


def short_parameter_table(model: ModelResults) -> TextTable:
    """Table of the first shared parameters with one ± each, for the first screen of the report.

    Where the model is rejected, ± includes the effect of the misfit and is marked with a dagger.

    Parameters
    ----------
    model : ModelResults
        The fitted model.

    """
    shared = [(code_cell(name), candidates.parameter_row(p)) for name, p in shared_parameters(model).items()]
    rows = [(name, row.short, row.short_remark) for name, row in shared[:MAX_FIRST_PARAMETERS]]
    return make_table(("parameter", "value ± std", ""), rows, (1,))


def shared_parameters(model: ModelResults) -> dict[str, Mapping[str, Any]]:
    """Parameters that all runs share, those that were not fixed first."""
    shared = {name: p for name, p in model.summary["parameters"].items() if not PER_RUN_NAME.match(name)}
    return dict(sorted(shared.items(), key=lambda item: item[1].get("reason") == "fixed"))


def _scale_contribution(p: Mapping[str, Any], scale_error: float) -> str:
    """Error that the common error of the scale causes in a parameter that is proportional to the scale."""
    value = p["value"]
    if not (scale_error and value) or p["unit"] not in UNITS_WITH_SCALE_ERROR or p.get("reason") == "fixed":
        return ""
    return format_size(abs(value) * scale_error, p["unit"])


def interval_table(model: ModelResults) -> TextTable:
    """Table of the standard deviation, the profile interval and the bootstrap interval of every parameter."""
    summary = model.summary
    profiles, bootstrap = summary.get("profiles", {}), summary.get("bootstrap", {}).get("parameters", {})
    rows = []
    for name, p in summary["parameters"].items():
        profile, drawn, unit = profiles.get(name), bootstrap.get(name), p["unit"]
        if (profile or drawn) and not PER_RUN_NAME.match(name):
            by_profile = candidates.interval_with_unit((profile["low"], profile["high"]), unit) if profile else ""
            by_draws = ("", "")
            if drawn:
                by_draws = candidates.interval_with_unit(drawn["interval"], unit), format_size(drawn["std"], unit)
            why = "; ".join((profile or {})[key] for key in ("why_low", "why_high") if key in (profile or {}))
            rows.append((code_cell(name), candidates.parameter_row(p).value, by_profile, *by_draws, why))
    heads = ("parameter", "value ± std", "95 % by profile", "95 % by bootstrap", "std of the draws", "")
    return make_table(heads, rows, (1, 2, 3, 4))


def run_table(model: ModelResults) -> TextTable:
    """Table of the runs of a fit: friction level, noise, errors, and the parameters that differ between runs."""
    per_run: dict[str, dict[str, str]] = {}
    for name, p in model.summary["parameters"].items():
        if m := PER_RUN_NAME.match(name):
            per_run.setdefault(m["name"], {})[m["run"]] = candidates.parameter_row(p).value
    rows = []
    for row in model.summary["per_run"]:
        share = row["errors"].get("relative_force_error")
        numbers = (row["level"], row.get("noise_um"), row["errors"].get("rms_displacement_um"),
                   row["errors"].get("free_run_rms_um"), None if share is None else 100 * share)  # fmt: skip
        own = (values.get(row["run"], DASH) for values in per_run.values())
        role = "" if row["role"] == "fit" else "predicted, not fitted"
        rows.append((row["run"], role, *map(format_number, numbers), str(row["segments"]), *own))
    errors = ("residual / µm", "free run / µm", "filtered force error / %")
    heads = ("run", "", "friction level", "noise / µm", *errors, "segments", *per_run)
    return make_table(heads, rows, range(2, len(heads)))


def history_table(models: Sequence[ModelResults]) -> TextTable:
    """Table of the models in the order in which they were fitted, with their errors and verdicts."""
    errors = candidates.error_rows(m.summary["errors"] for m in models)
    heads = ("model", *(axis_label(e.name, e.unit) for e in errors), "verdict")
    rows = []
    for k, m in enumerate(models):
        name = Markup("{}. {}{}").format(k + 1, candidates.plain_name(m.name), " (current)" if m.current else "")
        rows.append((name, *(format_number(e.values[k]) for e in errors), (m.diagnosis or {}).get("verdict", "")))
    return make_table(heads, rows, range(1, len(errors) + 1))


def failing_table(spans: Sequence[Mapping[str, Any]]) -> TextTable:
    """Table of the spans in which a model fails."""
    return make_table(("run", *candidates.FAILING_HEADS), candidates.failing_rows(spans), range(1, 6))


def route_table(default: ModelResults, papers: ModelResults) -> TextTable:
    """Table of the parameters and errors of the default fit and of the papers' route."""
    both = [m.summary["parameters"] for m in (default, papers)]
    rows: list[Sequence[Cell]] = [
        (code_cell(name), *(candidates.parameter_row(one[name]).short if name in one else DASH for one in both))
        for name in default.summary["parameters"]
        if not PER_RUN_NAME.match(name)
    ]
    for e in candidates.error_rows(m.summary["errors"] for m in (default, papers)):
        rows.append((e.name, *(f"{format_number(value)} {e.unit}".strip() for value in e.values)))
    heads = ("", *(f"{m.summary['domain']} domain, {m.summary['search']}" for m in (default, papers)))
    return make_table(heads, rows, (1, 2))


def track_table(runs: Sequence[RunResults]) -> TextTable:
    """Table of the films: frame rate, frames with the target, pixel pitch and its error."""
    rows = []
    for run in runs:
        if run.film is None or run.track is None:
            continue
        t, pitch, error = run.track, run.displacement.pixel_pitch, 100 * run.displacement.relative_scale_error
        at = "" if t.target is None else f"[{', '.join(f'{v:.0f}' for v in t.target)}]"
        scale = (format_number(1e6 * pitch if pitch else None, 4), format_number(error, 2) if error else "")
        found = f"{int(t.found.sum())} of {len(t)}"
        rows.append((run.name, run.source, f"{run.film.fps:g}", found, code_cell(at), *scale))
    heads = ("run", "film", "frames per s", "frames with target", "target", "µm/px", "scale error / %")
    return make_table(heads, rows, (2, 3, 5, 6))


def measurement_table(runs: Sequence[RunResults]) -> TextTable:
    """Table of the measurement self-checks of each film: noise, peak locking, shake, blur."""
    rows = [(run.name, *candidates.measurement_cells(run.quality)) for run in runs if run.quality]
    return make_table(("run", *candidates.MEASUREMENT_HEADS), rows, range(1, len(candidates.MEASUREMENT_HEADS) + 1))


MAX_OTHERS_SHOWN = 3  # where no candidate was found


def candidate_table(rows: Sequence[candidates.CandidateRow]) -> tuple[TextTable, TextTable]:
    """Tables of the candidates that were found or cannot be told from those, and of the others."""
    heads = ("effect", "", "held-out error", "explains alone", "p", "delta BIC")
    shown = [row for row in rows if row.kind in candidates.MAIN_KINDS] or list(rows[:MAX_OTHERS_SHOWN])

    def table(listed: Sequence[candidates.CandidateRow]) -> TextTable:
        name = Markup('<span class="mark {}"></span><code>{}</code>').format
        cells = (
            (name(row.kind, row.effect), row.standing, row.held_out, row.share, row.p, format_number(row.delta_bic))
            for row in listed
        )
        return make_table(heads, list(cells), (2, 3, 4, 5))

    return table(shown), table([row for row in rows if row not in shown])


def detection_limit_table(diagnosis: Mapping[str, Any]) -> TextTable:
    """Table of the smallest size of each effect that 95 of 100 repeats would detect."""
    rows = []
    for name, limit in diagnosis["detection_limits"].items():
        size = DASH if limit["value"] is None else format_size(limit["value"], limit["unit"])
        at = (f"{key} {format_size(value, parameter_unit(name, key))}" for key, value in limit.get("at", {}).items())
        rows.append((code_cell(name), size, limit.get("reason") or ", ".join(at)))
    return make_table(("effect", "detectable from", "at the least favourable"), rows, (1,))


GREEK = (("delta", "δ"), ("pi", "π"), ("omega", "ω"), ("tau", "τ"))
TICKS = re.compile(r"`([^`]+)`")
NAME = re.compile(r"(?<![A-Za-z_])([A-Za-z]+)_([A-Za-z0-9]+(?:[,_][A-Za-z0-9]+)*)")
POWER = re.compile(r"\^([A-Za-z0-9]+)")


def mark_equation(text: str) -> Markup:
    """Set the subscripts, powers and Greek letters of an equation in plain text as HTML.

    Parameters
    ----------
    text : str
        Plain text; it is escaped.

    Examples
    --------
    >>> str(mark_equation("F_c + k v^2"))
    'F<sub>c</sub> + k v<sup>2</sup>'

    """
    marked = POWER.sub(r"<sup>\1</sup>", NAME.sub(r"\1<sub>\2</sub>", str(escape(text))))
    for word, letter in GREEK:
        marked = re.sub(rf"\b{word}\b", letter, marked)
    return Markup(marked.replace(" - ", f" {MINUS} ").replace("(-", f"({MINUS}"))


def mark_code(text: str) -> Markup:
    """Set the text between backticks as code.

    Parameters
    ----------
    text : str
        Plain text; it is escaped.

    Examples
    --------
    >>> str(mark_code("write `mass = 0.35`"))
    'write <code>mass = 0.35</code>'

    """
    return Markup(TICKS.sub(r"<code>\1</code>", str(escape(text))))


UNEXPLAINED = (  # parts of a page in which no word is explained: figures, scripts, heads, links and tags
    r"(?P<unexplained><(?P<tag>head|svg|script|h1|nav|a|code|button)\b.*?</(?P=tag)>|<[^>]*>)"
)


def explain_words(html: str) -> str:
    """Let the pointer explain the words of the glossary: each where it stands first in a section of a page.

    Examples
    --------
    >>> explain_words("<p>a free run, a free run</p>")[:60]
    '<p>a <abbr tabindex="0" title="one simulation over a whole r'

    """
    seen: set[str] = set()

    def mark(found: re.Match[str]) -> str:
        if found["unexplained"]:
            if found[0].startswith(("<details", "<section")):
                seen.clear()
            return found[0]
        meaning = meaning_of(found[0])
        if meaning in seen:
            return found[0]
        seen.add(meaning)
        return f'<abbr tabindex="0" title="{escape(meaning)}">{found[0]}</abbr>'

    return re.sub(f"{UNEXPLAINED}|{hover_pattern().pattern}", mark, html, flags=re.DOTALL | re.IGNORECASE)


ID_ATTRIBUTES = re.compile(r'(\bid="|url\(#|xlink:href="#)')


@cache
def _templates(*packages: str) -> Environment:
    loader = ChoiceLoader([PackageLoader("frictrack", package) for package in (*packages, "present/report")])
    pages = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    # every function of `number_format` is a filter, without "format_" in its name; those of Jinja stay
    functions = {name: one for name, one in vars(number_format).items() if isfunction(one)}
    pages.filters = {name.removeprefix("format_"): one for name, one in functions.items()} | pages.filters
    pages.filters |= {"code": mark_code, "evidence": describe_evidence}
    return pages


def page_template(name: str, *packages: str) -> Template:
    """Load a template. Text that is written into it is escaped, and a name that it does not get is an error."""
    return _templates(*packages).get_template(name)


def sentences(macro: str, *arguments: Any) -> list[Markup]:
    """Fill in a macro of `sentences.html.j2`; every line that it gives is a sentence."""
    module: Any = page_template("sentences.html.j2").module
    lines = str(getattr(module, macro)(*arguments)).splitlines()
    return [Markup(line) for line in lines if line.strip()]


def describe_evidence(row: candidates.CandidateRow) -> str:
    """What a candidate effect is, and the evidence for it."""
    return f"{lower_first(row.source['words'].get('what', ''))}; {row.evidence}"


def now() -> str:
    """Local date and time, with the time zone."""
    return datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")


class SvgEmbedder:
    """Convert figures to SVG elements of one page, each with its own ids."""

    def __init__(self) -> None:
        self._numbers: Iterator[int] = count(1)

    def __call__(self, figure: Figure) -> Markup:
        """Convert a figure to an `<svg>` element."""
        return self.embed(plots.svg(figure))

    def embed(self, svg: str) -> Markup:
        """Give an `<svg>` element its own ids."""
        prefix = f"f{next(self._numbers)}-"
        return Markup(ID_ATTRIBUTES.sub(rf"\g<1>{prefix}", svg))
