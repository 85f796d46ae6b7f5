"""Count the outcomes of many studies: shares of correct diagnoses with Wilson intervals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import permutations
from typing import Any

import numpy as np
from scipy.stats import binomtest, norm

from frictrack.validation.blind.outcome import NOTHING, Outcome
from frictrack.validation.blind.truth import effect_named
from frictrack.validation.blind.truth_sampling import KINDS

PARAMETER_CONFIDENCE = 0.99  # level of the intervals that should contain the true parameters
REDUCED_CHI2_RANGE = (0.9, 1.1)  # within which a fit explains the data
HELDOUT_TOLERANCE = 0.05  # relative difference of the held-out error from the noise
Criterion = Callable[[Outcome], bool]
VERDICTS_WITHOUT_NAMES = ("complete", "undetermined")


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Confidence interval of a share (Wilson 1927, J. Am. Stat. Assoc. 22); (0, 1) if there are no cases.

    Examples
    --------
    >>> [round(edge, 4) for edge in wilson(95, 100)]
    [0.8882, 0.9785]

    """
    if not of:
        return 0.0, 1.0
    interval = binomtest(hits, of).proportion_ci(confidence_level=0.95, method="wilson")
    return float(interval.low), float(interval.high)


def count_with_interval(hits: int, of: int) -> dict[str, Any]:
    """Share of hits with its 95 % Wilson interval, as JSON."""
    return {"hits": hits, "of": of, "share": hits / of if of else None, "interval": list(wilson(hits, of))}


def _share(rows: Sequence[Outcome], criterion: Criterion) -> dict[str, Any]:
    return count_with_interval(sum(map(criterion, rows)), len(rows))


# --- criteria of one study


def is_named_first(row: Outcome) -> bool:
    """Whether the hidden effect is named first; a fault that was found and corrected during tracking counts."""
    return is_named_in_record(row) or (bool(row.group) and row.group[0] == row.hidden[0])


def is_named_in_record(row: Outcome) -> bool:
    """Whether tracking or calibration found the hidden fault, and nothing else is named."""
    return row.hidden[0] in row.noted and not row.named


def is_in_group(row: Outcome) -> bool:
    """Whether the hidden effect is first, or in a first group no larger than the set of its equivalents."""
    return is_named_first(row) or (row.hidden[0] in row.group and len(row.group) <= len(_equivalent_set(row)))


def _equivalent_set(row: Outcome) -> tuple[str, ...]:
    """Equivalents of the first hidden effect, itself included."""
    return row.equivalents.get(row.hidden[0], row.hidden[:1])


def are_all_named(row: Outcome) -> bool:
    """Whether as many named effects are the hidden ones or equivalents of them."""
    return _holds_all(row, row.named)


def are_all_stated(row: Outcome) -> bool:
    """Whether one of the sets stated as equal, with what tracking found, holds all hidden effects or equivalents."""
    return any(_holds_all(row, {*one, *row.noted}) for one in row.sets)


def is_wrong_without_doubt(row: Outcome) -> bool:
    """Whether the effects named without a rival are not exactly the hidden ones, or equivalents of them."""
    left = [h for h in row.hidden if h not in row.noted]
    exact = any(
        set(order) >= set(_needed(row, left)) and _fit(row, row.named, order)
        for order in permutations(row.hidden, len(row.named))
    )
    return row.verdict == "missing" and not exact


def _holds_all(row: Outcome, names: Iterable[str]) -> bool:
    """Whether a different name stands for each hidden effect that is needed."""
    needed = _needed(row, row.hidden)
    return any(_fit(row, order, needed) for order in permutations(names, len(needed)))


def _needed(row: Outcome, hidden: Sequence[str]) -> list[str]:
    """Hidden effects that the law and the other hidden ones do not imitate."""
    return [h for h in hidden if NOTHING not in row.equivalents.get(h, ())]


def _fit(row: Outcome, names: Sequence[str], hidden: Sequence[str]) -> bool:
    """Whether each name is the hidden effect at its place or an equivalent of it."""
    return all(name in {h, *row.equivalents.get(h, ())} for name, h in zip(names, hidden, strict=True))


def is_reproduced(row: Outcome) -> bool:
    """Whether a foreign effect is called unexplained, or the named effects leave only noise."""
    good = row.reduced_chi2 is not None and row.reduced_chi2 <= REDUCED_CHI2_RANGE[1]
    return row.verdict == "unexplained" or (good and row.verdict in ("missing", "ambiguous"))


def is_fault(name: str) -> bool:
    """Whether an effect is a fault of the measurement; `NOTHING`, in place of an effect, is none."""
    return name != NOTHING and effect_named(name).acts_on == "measurement"


def can_show(row: Outcome) -> bool:
    """Whether the data can reveal a measurement fault: no force is equivalent, or the background of a film shows it."""
    first = effect_named(row.hidden[0])
    if row.film and first.film_fault and first.noted_as:
        return True
    return len(row.hidden) == 1 and is_fault(row.hidden[0]) and all(is_fault(n) for n in _equivalent_set(row))


def is_called_fault(row: Outcome) -> bool:
    """Whether the diagnosis, tracking or calibration attributes a measurement fault to the measurement."""
    return row.hidden[0] in row.noted or (bool(row.group) and is_fault(row.group[0].split(":")[0]))


def _within_noise(row: Outcome) -> bool:
    return row.heldout is not None and abs(row.heldout - 1) <= HELDOUT_TOLERANCE


def _within_chi2(row: Outcome) -> bool:
    return row.reduced_chi2 is not None and REDUCED_CHI2_RANGE[0] <= row.reduced_chi2 <= REDUCED_CHI2_RANGE[1]


# --- all studies


def tally(rows: Sequence[Outcome]) -> dict[str, Any]:
    """Compute all figures of the benchmark.

    Returns JSON: number of studies, then shares by kind of study, errors after adding the named effects, overlap of
    failing spans, detection limits, confusion table, CPU time and failed studies. A share of no studies is null.
    """
    kind = {k: [r for r in rows if r.kind == k] for k in KINDS}
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
        **{
            name: {
                word: _share(kind[name], are_all_named),
                f"{word}_by_name": _share(kind[name], lambda r: set(r.hidden) <= set(r.named)),
                f"{word}_stated": _share(kind[name], are_all_stated),
                "wrong_without_doubt": _share(kind[name], is_wrong_without_doubt),
            }
            for name, word in (("two", "both"), ("three", "all"))
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
    """Median and largest ratio of stated to ideal detection limits, by effect."""
    out = {}
    for name in sorted({n for r in rows for n in r.limits}):
        ratios = [r.limits[name] for r in rows if name in r.limits]
        out[name] = {"median": float(np.median(ratios)), "largest": float(np.max(ratios)), "of": len(ratios)}
    return out


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def seconds(rows: Sequence[Outcome]) -> dict[str, float | None]:
    """Median and largest CPU time of a diagnosis, s."""
    times = [r.seconds for r in rows if r.verdict != "failed"]
    return {"median": _median(times), "largest": max(times, default=None)}


def confusion(rows: Sequence[Outcome]) -> dict[str, dict[str, int]]:
    """Count of what was named first (or of the verdict), by hidden effect."""
    names = sorted({r.hidden[0] for r in rows})
    return {n: dict(Counter(r.group[0] if r.group else r.verdict for r in rows if r.hidden[0] == n)) for n in names}
