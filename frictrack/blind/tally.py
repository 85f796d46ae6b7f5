"""Outcomes of many studies as the figures that a user asks for, each with its interval (Wilson 1927)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import permutations
from typing import Any

import numpy as np
from scipy.stats import norm

from frictrack.blind.outcome import Outcome
from frictrack.blind.truth import effect_named

PARAMETER_CONFIDENCE = 0.99  # of the parameters' intervals
REDUCED_CHI2_RANGE, HELDOUT_TOLERANCE = (0.9, 1.1), 0.05
Criterion = Callable[[Outcome], bool]
VERDICTS_WITHOUT_NAMES = ("complete", "undetermined")  # verdicts that name nothing


def wilson(hits: int, of: int, level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of a share (Wilson 1927)."""
    if not of:
        return 0.0, 1.0
    z = float(norm.isf((1 - level) / 2))
    share, spread = hits / of, z**2 / of
    middle = (share + spread / 2) / (1 + spread)
    half = z * np.sqrt(share * (1 - share) / of + spread / (4 * of)) / (1 + spread)
    return max(float(middle - half), 0.0), min(float(middle + half), 1.0)


def count_with_interval(hits: int, of: int) -> dict[str, Any]:
    """A share with its interval."""
    return {"hits": hits, "of": of, "share": hits / of if of else None, "interval": list(wilson(hits, of))}


def _share(rows: Sequence[Outcome], criterion: Criterion) -> dict[str, Any]:
    return count_with_interval(sum(map(criterion, rows)), len(rows))


# --- what is right of one study


def is_named_first(row: Outcome) -> bool:
    """The hidden cause is named first; what was found in the records and mended there was named before all else."""
    return is_named_in_record(row) or (bool(row.group) and row.group[0] == row.hidden[0])


def is_named_in_record(row: Outcome) -> bool:
    """The hidden fault was found in the records, and nothing else is named."""
    return row.hidden[0] in row.noted and not row.named


def is_in_group(row: Outcome) -> bool:
    """The hidden cause is named first, or in a group no larger than what nobody could tell apart."""
    return is_named_first(row) or (row.hidden[0] in row.group and len(row.group) <= len(_equivalent_set(row)))


def _equivalent_set(row: Outcome) -> tuple[str, ...]:
    """What nobody could tell from the first hidden cause, itself among them."""
    return row.equivalents.get(row.hidden[0], row.hidden[:1])


def are_both_named(row: Outcome) -> bool:
    """Two named effects stand for the two hidden causes, each the cause itself or what nobody could tell from it."""
    sets = [set(row.equivalents.get(h, (h,))) | {h} for h in row.hidden]
    return any(all(n in s for n, s in zip(pair, sets, strict=True)) for pair in permutations(row.named, len(sets)))


def is_reproduced(row: Outcome) -> bool:
    """A foreign cause is called unexplained, or its stand-ins leave nothing but noise."""
    good = row.reduced_chi2 is not None and row.reduced_chi2 <= REDUCED_CHI2_RANGE[1]
    return row.verdict == "unexplained" or (good and row.verdict in ("missing", "ambiguous"))


def is_fault(name: str) -> bool:
    """Whether a cause lies in the measurement."""
    return effect_named(name).acts_on == "measurement"


def can_show(row: Outcome) -> bool:
    """Whether the data can show a fault of the measurement: no force does the same, or a film's background tells."""
    first = effect_named(row.hidden[0])
    if row.film and first.film_fault and first.noted_as:
        return True
    return len(row.hidden) == 1 and is_fault(row.hidden[0]) and all(is_fault(n) for n in _equivalent_set(row))


def is_called_fault(row: Outcome) -> bool:
    """A fault of the measurement is called one, by the diagnosis or by the measuring chain before it."""
    return row.hidden[0] in row.noted or (bool(row.group) and is_fault(row.group[0].split(":")[0]))


def _within_noise(row: Outcome) -> bool:
    return row.heldout is not None and abs(row.heldout - 1) <= HELDOUT_TOLERANCE


def _within_chi2(row: Outcome) -> bool:
    return row.reduced_chi2 is not None and REDUCED_CHI2_RANGE[0] <= row.reduced_chi2 <= REDUCED_CHI2_RANGE[1]


# --- all of them


def tally(rows: Sequence[Outcome]) -> dict[str, Any]:
    """All figures of the benchmark as JSON, `studies` first; what no study speaks of has share null."""
    kind = {k: [r for r in rows if r.kind == k] for k in ("one", "none", "two", "foreign", "fault")}
    one = kind["one"]
    criterion = [r for r in one + kind["fault"] if is_named_first(r)]
    local = [r.overlap for r in one if r.overlap is not None]
    edge = float(norm.isf((1 - PARAMETER_CONFIDENCE) / 2))
    z = [abs(v) <= edge for r in criterion for v in r.z.values()]
    return {
        "studies": len(rows),
        "one": {
            "named_first": _share(one, is_named_first),
            "in_group": _share(one, is_in_group),
            "first_where_alone": _share([r for r in one if len(_equivalent_set(r)) == 1], is_named_first),
            "missed": _share(one, lambda r: r.verdict in VERDICTS_WITHOUT_NAMES and not is_named_in_record(r)),
            "more_than_hidden": _share(one, lambda r: len(r.named) > 1),
            "median_group": _median([len(r.group) for r in one if r.group]),
            "median_set": _median([len(_equivalent_set(r)) for r in one]),
        },
        "none": {
            "false_alarms": _share(kind["none"], lambda r: r.verdict not in VERDICTS_WITHOUT_NAMES),
            "undetermined": _share(kind["none"], lambda r: r.verdict == "undetermined"),
        },
        "two": {
            "both": _share(kind["two"], are_both_named),
            "both_by_name": _share(kind["two"], lambda r: set(r.hidden) <= set(r.named)),
        },
        "foreign": {
            "unexplained_or_reproduced": _share(kind["foreign"], is_reproduced),
            "unexplained": _share(kind["foreign"], lambda r: r.verdict == "unexplained"),
        },
        "fault": {"called": _share([r for r in one + kind["fault"] if can_show(r)], is_called_fault)},
        "after": {
            "reduced_chi2": _share(criterion, _within_chi2),
            "heldout": _share(criterion, _within_noise),
            "parameters": count_with_interval(sum(z), len(z)),
        },
        "where": {"mean_f1": float(np.mean(local)) if local else None, "of": len(local)},
        "limits": limits(kind["none"]),
        "confusion": confusion(one + kind["fault"]),
        "seconds": seconds(rows),
        "failed": [{"study": r.name, "reason": r.fault} for r in rows if r.verdict == "failed"],
    }  # fmt: skip


def limits(rows: Sequence[Outcome]) -> dict[str, dict[str, float]]:
    """Stated detection limits over the ideal detector's, per effect: median and largest."""
    out = {}
    for name in sorted({n for r in rows for n in r.limits}):
        ratios = [r.limits[name] for r in rows if name in r.limits]
        out[name] = {"median": float(np.median(ratios)), "largest": float(np.max(ratios)), "of": len(ratios)}
    return out


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def seconds(rows: Sequence[Outcome]) -> dict[str, float | None]:
    """CPU time of a diagnosis."""
    times = [r.seconds for r in rows if r.verdict != "failed"]
    return {"median": _median(times), "largest": max(times, default=None)}


def confusion(rows: Sequence[Outcome]) -> dict[str, dict[str, int]]:
    """What was named first (or the verdict), by what was hidden."""
    names = sorted({r.hidden[0] for r in rows})
    return {n: dict(Counter(r.group[0] if r.group else r.verdict for r in rows if r.hidden[0] == n)) for n in names}
