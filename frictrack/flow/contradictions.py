"""Keep a verdict open while the measured data contradict what was typed: one of the two is wrong, and so may it be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from frictrack.plausibility import Finding

# Effects that are what a finding is about: where one of them is in the law or named, the finding says no more.
SAME_CAUSE = {"fps": ("clock_rate",), "incline": ("slope",)}


def withhold_verdict(diagnosis: Mapping[str, Any], findings: Iterable[Finding]) -> dict[str, Any]:
    """Return a diagnosis whose verdict is open while findings contradict what was typed.

    Parameters
    ----------
    diagnosis
        The JSON of `diagnose`.
    findings
        What is implausible in the study.

    Returns
    -------
    dict
        The same diagnosis where nothing is contradicted, or where an effect of the same cause is in the law or named;
        else one with the verdict "undetermined", nothing missing, and the contradictions first of what is open.

    Examples
    --------
    >>> from frictrack.plausibility import Finding
    >>> said = {"verdict": "missing", "missing": ["collision"], "model": ["coulomb"], "undetermined": []}
    >>> doubted(said, [Finding("mass", "the mass is 10 times too large", run="a", contradicts=True)])["verdict"]
    'undetermined'

    """
    contradictions = [f for f in findings if f.contradicts]
    if not contradictions:
        return dict(diagnosis)
    known = {name.split(":")[0] for key in ("model", "missing") for name in diagnosis.get(key, ())}
    first = [_undetermined_entry(f) for f in contradictions if not known.intersection(SAME_CAUSE.get(f.kind, ()))]
    if not first:
        return dict(diagnosis)
    return {**diagnosis, "verdict": "undetermined", "missing": [], "undetermined": [*first, *diagnosis["undetermined"]]}


def _undetermined_entry(finding: Finding) -> dict[str, Any]:
    """A contradiction as an entry of `undetermined`."""
    what = f'run "{finding.run}"' if finding.run else "what was typed"
    return {"what": what, "why": finding.words, "settled_by": finding.correction, "limit_over_friction": None}
