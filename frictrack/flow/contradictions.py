"""Withhold the verdict of a diagnosis while measured data contradict a number in the study file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from frictrack import effects
from frictrack.plausibility import Finding


def withhold_verdict(diagnosis: Mapping[str, Any], findings: Iterable[Finding]) -> dict[str, Any]:
    """Return a diagnosis with the verdict "undetermined" if findings contradict the study file.

    Parameters
    ----------
    diagnosis
        JSON of `diagnose`.
    findings
        Implausible numbers of the study.

    Returns
    -------
    dict
        The same diagnosis if nothing is contradicted, or if an effect of the same cause is in the model or missing.
        Otherwise the verdict is "undetermined", nothing is missing, and the contradictions come first in
        "undetermined".

    Examples
    --------
    >>> from frictrack.plausibility import Finding
    >>> diagnosis = {"verdict": "missing", "missing": ["collision"], "model": ["coulomb"], "undetermined": []}
    >>> finding = Finding("mass", "the mass is 10 times too large", run="a", contradicts=True)
    >>> withhold_verdict(diagnosis, [finding])["verdict"]
    'undetermined'

    """
    contradictions = [f for f in findings if f.contradicts]
    if not contradictions:
        return dict(diagnosis)
    # an effect of the same cause in the model, or found missing, has dealt with the contradiction
    named = {name.split(":")[0] for key in ("model", "missing") for name in diagnosis.get(key, ())}
    explained = {e.same_cause_as for name, e in effects.known().items() if name in named}
    first = [_undetermined_entry(f) for f in contradictions if f.kind not in explained]
    if not first:
        return dict(diagnosis)
    return {**diagnosis, "verdict": "undetermined", "missing": [], "undetermined": [*first, *diagnosis["undetermined"]]}


def _undetermined_entry(finding: Finding) -> dict[str, Any]:
    """Return a contradiction as an entry of "undetermined"."""
    what = f'run "{finding.run}"' if finding.run else "what was typed"
    return {"what": what, "why": finding.words, "settled_by": finding.correction, "limit_over_friction": None}
