"""Fit how the laws of the studies of a batch depend on the conditions that their study files state."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from frictrack.batch.tasks import StudyOutcome
from frictrack.covariates import CovariateTrend, CovariateTrends, trend
from frictrack.errors import FrictrackError
from frictrack.number_format import format_plus_minus
from frictrack.priors import Prior

ALPHA = 0.01  # for all parameters of all conditions together
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
Condition = tuple[float | str, str]  # value and unit; a category has no unit


def read_condition(raw: float | str) -> Condition:
    """Read a condition: a number, a number with a unit, or the name of a category.

    Examples
    --------
    >>> read_condition("20 degC"), read_condition(3), read_condition("steel on brass")
    ((20.0, 'degC'), (3.0, ''), ('steel on brass', ''))

    """
    if not isinstance(raw, str):
        return float(raw), ""
    found = _QUANTITY.fullmatch(raw)
    return (float(found[1]), found[2]) if found else (raw.strip(), "")


def condition_trends(outcomes: Sequence[StudyOutcome]) -> list[dict[str, Any]]:
    """Fit the trends over every condition that studies state.

    A study takes part if it states the condition and has a law of its own: fitted without the prior of another study,
    with the model that most of these studies have.

    Parameters
    ----------
    outcomes
        The studies in order.

    Returns
    -------
    list of dict
        One entry per condition: trends, or the reason why there are none, and what to read as sentences.

    """
    names = list(dict.fromkeys(name for one in outcomes for name in one.conditions))
    entries = [_entry(name, outcomes) for name in names]
    count = max(sum(len(entry["trends"]) for entry in entries), 1)
    for entry in entries:
        for one in entry["trends"]:
            one["holds"] = one["p"] * count < ALPHA
    return entries


def _entry(name: str, outcomes: Sequence[StudyOutcome]) -> dict[str, Any]:
    """Return the JSON of one condition."""
    stated = [(one, read_condition(one.conditions[name])) for one in outcomes if name in one.conditions and one.law]
    laws = [Prior.from_toml(one.law, one.study) for one, _ in stated]
    usual = Counter(law.model for law in laws).most_common(1)
    same = [i for i, law in enumerate(laws) if law.model == usual[0][0]]
    left_out = [one.study for one in outcomes if name in one.conditions]
    used = [stated[i][0].study for i in same]
    unit = stated[same[0]][1][1] if same else ""
    head = {"condition": name, "unit": unit, "studies": used, "left_out": [s for s in left_out if s not in used]}
    units = {stated[i][1][1] for i in same}
    try:
        if len(units) > 1:
            raise FrictrackError(f"expected one unit of {name} but got {', '.join(sorted(units))}")
        found = trend([laws[i] for i in same], [stated[i][1][0] for i in same], name)
    except FrictrackError as e:
        return {**head, "load": None, "trends": [], "reason": str(e), "words": [f"no trend over {name}: {e}"]}
    return {
        **head,
        "load": found.load,
        "trends": [one.summary() for one in found.trends.values()],
        "reason": None,
        "words": list(_words(found, unit)),
    }


def _words(found: CovariateTrends, unit: str) -> Iterator[str]:
    """Yield one sentence per parameter."""
    for name, one in found.trends.items():
        own = "" if one.unit == "1" else f" {one.unit}"
        scatter = f"scatter between studies {one.scatter:.2g}{own}, p = {one.p:.2g}"
        yield f"over {found.condition}, {name} {_change(one, own, unit)}; {scatter}"
    if found.load is not None:
        yield f"forces of these trends belong to a load of {found.load:.4g} N"


def _change(one: CovariateTrend, own: str, unit: str) -> str:
    """Return the slope, or the value of every category."""
    rows: Mapping[str, str] = {
        term: f"{format_plus_minus(float(value), float(std))}{own}"
        for term, value, std in zip(one.terms, one.coefficients, one.std, strict=True)
    }
    if one.origin is not None:
        return f"changes by {rows['slope']} per {unit or 'unit'}"
    return "is " + ", ".join(f"{value} ({term})" for term, value in rows.items())
