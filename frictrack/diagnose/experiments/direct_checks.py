"""Predict the evidence of direct checks: measurements that show one cause without filming another run.

Examples are a mark at rest, a rule, a level, a clock and a sensor. If the cause is present, an explanation without it
is refuted by the whole signal, S in chi-squared. If it is absent, an explanation with it may shrink the effect by a
share a, which costs part of the evidence G that the runs give it. The least of (1 - a)^2 G + a^2 S is G S/(G + S).
"""

from __future__ import annotations

from frictrack.diagnose.effect_description import FittedEffect
from frictrack.diagnose.experiments.expected_separation import FittedExplanation
from frictrack.effects import ACCELEROMETER_CHECK, DirectCheck


def direct_checks(one: FittedExplanation, other: FittedExplanation) -> list[tuple[DirectCheck, float, float]]:
    """Return the checks that separate two explanations.

    Parameters
    ----------
    one, other
        Two explanations of the same runs.

    Returns
    -------
    list of (DirectCheck, float, float)
        Each check with the chi-squared expected if `one` is true and if `other` is true.

    """
    out = []
    for explained, rival in ((one, other), (other, one)):
        for check in _checks_of(explained, rival):
            signal = check.signal(FittedEffect(explained.effect, explained.solution))
            absent = explained.gain * signal / max(explained.gain + signal, 1e-12)
            out.append((check, signal, absent) if explained is one else (check, absent, signal))
    return out


def _checks_of(explained: FittedExplanation, rival: FittedExplanation) -> list[DirectCheck]:
    effect, other = explained.fitted_effect, rival.fitted_effect
    if effect.kind == other.kind:
        return []
    found = [effect.direct_check] if effect.direct_check is not None else []
    if effect.acts_on == "force" and other.acts_on == "measurement":
        found.append(ACCELEROMETER_CHECK)
    return found
