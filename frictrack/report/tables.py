"""The tables of the report: results in, heads and rows of text out."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from frictrack.number_format import DASH, format_interval, format_number, format_quantity, format_size, format_unit
from frictrack.plots import passes, plain_name
from frictrack.report.markup import mark_code
from frictrack.report.verdict_text import held_out_change
from frictrack.results import ModelResults, RunResults

PER_RUN_NAME = re.compile(r"^(?P<name>.+)\[(?P<run>.+)\]$")  # "vibration.phase[v3]"
UNITS_OF_SCALE = ("N", "N s", "m", "m/s")  # units of what is as wrong as the scale is; in N s/m and N/m it cancels
Cell = str | Markup


@dataclass(frozen=True)
class TextTable:
    """Heads and rows; columns in `numeric` are set flush right."""

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    numeric: frozenset[int] = frozenset()


def table(heads: Sequence[str], rows: Sequence[Sequence[Cell]], numeric: Sequence[int] = ()) -> TextTable:
    """A table whose empty columns are left out."""
    kept = [k for k in range(len(heads)) if not rows or any(row[k] not in ("", DASH) for row in rows)]
    new = {old: k for k, old in enumerate(kept)}
    return TextTable(
        tuple(heads[k] for k in kept),
        tuple(tuple(row[k] for k in kept) for row in rows),
        frozenset(new[k] for k in numeric if k in new),
    )


def code(text: str) -> Markup:
    """A name that can be typed."""
    return Markup("<code>{}</code>").format(text)


def parameters(model: ModelResults, scale_error: float = 0.0) -> TextTable:
    """Shared parameters: value ± standard deviation, what the scale's relative error adds, and what is to be said.

    Where the model is rejected, the deviation with the misfit stands beside, marked with a dagger.
    """
    rejected = any("std_misfit" in p for p in model.summary["parameters"].values())
    blows = {f"{c['effect']}.width" for c in model.summary.get("collisions", []) if not c["resolved"]}
    rows = [
        (
            code(name),
            format_quantity(p["value"], p["std"], p["unit"]),
            *([format_size(p["std_misfit"], p["unit"]) if "std_misfit" in p else ""] if rejected else []),
            _scale_part(p, scale_error),
            _remark(p, unresolved=name in blows),
        )
        for name, p in model.summary["parameters"].items()
        if not PER_RUN_NAME.match(name)
    ]
    heads = ("parameter", "value", *(["† ± with the misfit"] if rejected else []), "± of the scale", "")
    return table(heads, rows, (1, 2, 3) if rejected else (1, 2))


def _scale_part(p: Mapping[str, Any], scale_error: float) -> str:
    """What a common error of the scale does to a parameter that grows with it."""
    value = p["value"]
    if not (scale_error and value) or p["unit"] not in UNITS_OF_SCALE or p.get("reason") == "fixed":
        return ""
    return format_size(abs(value) * scale_error, p["unit"])


def _remark(p: Mapping[str, Any], *, unresolved: bool = False) -> str:
    if unresolved:
        return "not resolved: the impulse is known, a peak force is not"
    if p.get("reason"):
        return str(p["reason"])
    if p.get("at_bound"):
        return "at its bound: the true value may lie beyond"
    mu = p.get("mu")
    return "" if mu is None else f"µ = {format_quantity(mu['value'], mu['std'], '1')}"


def uncertainty(model: ModelResults) -> TextTable:
    """Standard deviation, profile and bootstrap of every parameter, side by side."""
    summary = model.summary
    profiles, drawn = summary.get("profiles", {}), summary.get("bootstrap", {}).get("parameters", {})
    rows = [
        (
            code(name),
            format_quantity(p["value"], p["std"], p["unit"]),
            _interval(profiles[name]["low"], profiles[name]["high"], p["unit"]) if name in profiles else "",
            _interval(drawn[name]["interval"][0], drawn[name]["interval"][1], p["unit"]) if name in drawn else "",
            format_size(drawn[name]["std"], p["unit"]) if name in drawn else "",
            "; ".join(profiles.get(name, {})[key] for key in ("why_low", "why_high") if key in profiles.get(name, {})),
        )
        for name, p in summary["parameters"].items()
        if (name in profiles or name in drawn) and not PER_RUN_NAME.match(name)
    ]
    heads = ("parameter", "value ± std", "95 % by profile", "95 % by bootstrap", "std of the draws", "")
    return table(heads, rows, (1, 2, 3, 4))


def _interval(low: float | None, high: float | None, unit: str) -> str:
    """An interval whose ends may be open."""
    if low is None and high is None:
        return "any"
    if low is None or high is None:
        return f"below {format_size(high, unit)}" if high is not None else f"above {format_size(low or 0.0, unit)}"
    return f"{format_number(low, 4)} to {format_number(high, 4)} {format_unit(unit)}".strip()


def routes(default: ModelResults, papers: ModelResults) -> TextTable:
    """Parameters and errors of the default beside the papers' route."""
    theirs = papers.summary["parameters"]
    rows: list[Sequence[Cell]] = [
        (
            code(name),
            format_quantity(p["value"], p.get("std_misfit", p["std"]), p["unit"]),
            _quantity_or_dash(theirs.get(name)),
        )
        for name, p in default.summary["parameters"].items()
        if not PER_RUN_NAME.match(name)
    ]
    for key, words, unit, factor in ERRORS:
        cells = [m.summary["errors"].get(key) for m in (default, papers)]
        if any(c is not None for c in cells):
            rows.append((words, *(f"{format_number(None if c is None else factor * c)} {unit}".strip() for c in cells)))
    heads = ("", *(f"{m.summary['domain']} domain, {m.summary['search']}" for m in (default, papers)))
    return table(heads, rows, (1, 2))


def _quantity_or_dash(p: Mapping[str, Any] | None) -> str:
    return DASH if p is None else format_quantity(p["value"], p["std"], p["unit"])


ERRORS = (
    ("rms_displacement_um", "displacement, rms", "µm", 1.0),
    ("rms_N", "friction force, rms", "N", 1.0),
    ("noise_N", "noise of the measured force", "N", 1.0),
    ("heldout_rms_um", "held out, rms", "µm", 1.0),
    ("heldout_rms_N", "held out, rms", "N", 1.0),
    ("free_run_rms_um", "free run over the whole record, rms", "µm", 1.0),
    ("free_run_relative", "free run, relative", "%", 100.0),
    ("rms_acceleration", "acceleration, rms", "m/s²", 1.0),
    ("sse_acceleration", "acceleration, sum of squares", "m²/s⁴", 1.0),
    ("relative_force_error", "relative force error", "%", 100.0),
    ("reduced_chi2", "reduced chi²", "", 1.0),
)  # key, words, unit, factor


def history(models: Sequence[ModelResults]) -> TextTable:
    """Every model tried, in order, with its errors."""
    used = [e for e in ERRORS if any(m.summary["errors"].get(e[0]) is not None for m in models)]
    heads = (
        "model",
        *(f"{words} / {_unit_in_brackets(unit)}" if unit else words for _, words, unit, _ in used),
        "verdict",
    )
    rows = []
    for k, m in enumerate(models, 1):
        errors = m.summary["errors"]
        cells = [format_number(None if errors.get(key) is None else f * errors[key]) for key, _, _, f in used]
        name = Markup("{}. {}{}").format(k, plain_name(m.name), " (current)" if m.current else "")
        rows.append((name, *cells, (m.diagnosis or {}).get("verdict", "")))
    return table(heads, rows, range(1, len(used) + 1))


def _unit_in_brackets(unit: str) -> str:
    return f"({unit})" if "/" in unit else unit


def spans(found: Sequence[Mapping[str, Any]]) -> TextTable:
    """Where a model fails."""
    rows = [
        (
            s["run"],
            format_interval(s.get("t"), 1e3),
            format_interval(s.get("x")),
            format_interval(s.get("v")),
            f"{100 * s['share_of_error']:.0f} %",
            _chance(s.get("p")),
        )
        for s in found
    ]
    return table(("run", "t / ms", "x / m", "v / (m/s)", "share of the misfit", "p"), rows, (1, 2, 3, 4, 5))


def _chance(p: float | None) -> str:
    """A p-value; what is far beyond any doubt is not given digits that no noise is known to."""
    return "" if p is None else "< 10\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT SIX}" if p < 1e-6 else format_number(p, 1)


@dataclass(frozen=True)
class Card:
    """One candidate in words."""

    name: str
    passes: bool
    acts_on: str
    rank: str
    words: Mapping[str, Markup]
    numbers: tuple[Cell, ...]
    rivals: tuple[str, ...]


def cards(diagnosis: Mapping[str, Any]) -> list[Card]:
    """Candidates, best first."""
    return [
        Card(
            name=c["effect"],
            passes=passes(c),
            acts_on={"force": "a force on the mass", "measurement": "a fault of the picture"}.get(c["acts_on"], ""),
            rank=_rank(c, diagnosis["candidates"][0]),
            words={key: mark_code(c["words"].get(key, "")) for key in ("what", "looks_like", "here", "confirm")},
            numbers=tuple(_numbers(c)),
            rivals=tuple(c["indistinguishable_from"]),
        )
        for c in diagnosis["candidates"]
    ]


def importance(diagnosis: Mapping[str, Any]) -> TextTable:
    """What every effect explains of the misfit: alone, and after those above it; the last one that is worth adding."""
    rows = []
    for row in diagnosis.get("importance") or []:
        shares = [_share_of_misfit(row[key]) for key in ("explained_alone", "explained_in_sequence")]
        unit = "um" if "heldout_rms_after_um" in row else "N"
        held = row[f"heldout_rms_after_{unit}"]
        after = "" if held is None else f"{format_number(held)} {format_unit(unit)}"
        rows.append((code(row["effect"]), *shares, after, "stop here" if row["stop"] else ""))
    return table(("effect", "explains alone", "adds in sequence", "held out after it", ""), rows, (1, 2, 3))


def _share_of_misfit(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


def _rank(c: Mapping[str, Any], best: Mapping[str, Any]) -> str:
    """How a candidate stands beside the best one."""
    if c.get("implausible"):
        return f"imitates the misfit, not plausible: {c['implausible']}"
    if not passes(c):
        return "does not pass"
    if c is best:
        return "passes, the best"
    if c["effect"] in best["indistinguishable_from"]:
        return "passes, as good as the best"
    return f"passes, but {format_number(best['delta_bic'] - c['delta_bic'])} behind the best"


def _numbers(c: Mapping[str, Any]) -> list[Cell]:
    """Shared parameters, then the evidence."""
    shared = {name: p for name, p in c["parameters"].items() if not PER_RUN_NAME.match(name)}
    own = sorted({m["name"] for name in c["parameters"] if (m := PER_RUN_NAME.match(name))})
    out: list[Cell] = [f"{name} {format_quantity(p['value'], p['std'], p['unit'])}" for name, p in shared.items()]
    if own:
        out.append(f"one {' and one '.join(own)} per run")
    out.append(f"p = {format_number(c['p'], 1)}, delta BIC {format_number(c['delta_bic'])}")
    change = held_out_change(c)
    if change:
        out.append(f"held out {change} ({'whole runs' if c['heldout'] == 'run' else 'every other frame'})")
    return out


def runs(model: ModelResults) -> TextTable:
    """One row per run: level, noise, errors, and the parameters of its own."""
    own: dict[str, dict[str, str]] = {}
    for name, p in model.summary["parameters"].items():
        m = PER_RUN_NAME.match(name)
        if m:
            own.setdefault(m["name"], {})[m["run"]] = format_quantity(p["value"], p["std"], p["unit"])
    rows = [
        (
            row["run"],
            "" if row["role"] == "fit" else "predicted, not fitted",
            format_number(row["level"]),
            format_number(row.get("noise_um")),
            format_number(row["errors"].get("rms_displacement_um")),
            format_number(row["errors"].get("free_run_rms_um")),
            format_number(_percent(row["errors"].get("relative_force_error"))),
            str(row["segments"]),
            *(of.get(row["run"], DASH) for of in own.values()),
        )
        for row in model.summary["per_run"]
    ]
    errors = ("residual / µm", "free run / µm", "force error / %")
    heads = ("run", "", "friction level", "noise / µm", *errors, "segments", *own)
    return table(heads, rows, range(2, len(heads)))


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def limits(diagnosis: Mapping[str, Any]) -> TextTable:
    """What would have been found in 95 of 100 repeats."""
    rows = [
        (code(name), _limit(limit), limit.get("reason") or _at(name, limit))
        for name, limit in diagnosis["detection_limits"].items()
    ]
    return table(("effect", "found from", "at the least favourable"), rows, (1,))


def _limit(limit: Mapping[str, Any]) -> str:
    return DASH if limit["value"] is None else format_size(limit["value"], limit["unit"])


def _at(effect: str, limit: Mapping[str, Any]) -> str:
    from frictrack import effects  # noqa: PLC0415 - only for the units

    kind = effects.LIBRARY.get(effect.split(":", maxsplit=1)[0])
    units = {} if kind is None else {p.name: p.unit for p in kind.parameters}
    return ", ".join(f"{name} {format_size(value, units.get(name, ''))}" for name, value in limit.get("at", {}).items())


def tracks(runs: Sequence[RunResults]) -> TextTable:
    """Which films were tracked, and on what scale."""
    rows = []
    for run in runs:
        if run.film is None or run.track is None:
            continue
        t, found = run.track, run.track.found
        at = "" if t.target is None else "[" + ", ".join(f"{v:.0f}" for v in t.target) + "]"
        pitch, error = run.displacement.pixel_pitch, 100 * run.displacement.relative_scale_error
        rows.append(
            (run.name, run.source, f"{run.film.fps:g}", f"{int(found.sum())} of {len(t)}", code(at),
             format_number(1e6 * pitch if pitch else None, 4), format_number(error, 2) if error else "")
        )  # fmt: skip
    heads = ("run", "film", "frames per s", "target found in", "target", "µm/px", "scale known to / %")
    return table(heads, rows, (2, 3, 5, 6))


def measurement(runs: Sequence[RunResults]) -> TextTable:
    """What each film says of its own measurement."""
    rows = []
    for run in runs:
        if not run.quality:
            continue
        q = run.quality
        locking = format_quantity(q["peak_locking_px"], q["peak_locking_std_px"], "") if q["peak_locking_px"] else ""
        still = "none" if q["shake_px"] == 0 else format_number(q["shake_px"], 2)
        rows.append(
            (run.name, format_number(q["sigma_px"], 2), format_number(q["sigma_um"], 2), format_number(q["score"]),
             locking, format_number(q["forward_backward_px"], 2), format_number(q["noise_floor_px"], 2), still,
             format_number(None if q["exposure_s"] is None else 1e6 * q["exposure_s"]), format_number(q["blur_px"], 2))
        )  # fmt: skip
    heads = ("run", "σ / px", "σ / µm", "match score", "peak locking / px", "backward / px", "reference / px",
             "shake / px", "exposure / µs", "blur / px")  # fmt: skip
    return table(heads, rows, range(1, len(heads)))


def has_validation_runs(model: ModelResults) -> bool:
    """Whether runs were predicted rather than fitted."""
    return any(row["role"] == "validation" for row in model.summary["per_run"])
