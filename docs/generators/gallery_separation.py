"""Find the run that separates two effects, from the tables on which `frictrack plan` rests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

from gallery_runs import COURSE_M, FPS, MASS_KG, NOISE_M, PITCH_M, TUSTIN

from frictrack.diagnose import MIN_CHI2_SEPARATED
from frictrack.diagnose.experiments import ExperimentSetup
from frictrack.diagnose.experiments.evidence import EvidenceTables, tabulate_evidence
from frictrack.diagnose.experiments.selection import REFERENCE_INSTRUCTION
from frictrack.effects import models
from frictrack.records import Array

FIRST_RUN = "4 m/s"  # key of the run that has been filmed already


@dataclass(frozen=True)
class Separation:
    """The run that separates a pair best after a first one, and the expected chi-squared between the two.

    Attributes
    ----------
    first, best
        What is filmed, in words.
    before, after
        Expected chi-squared between the pair after the first run, and after both.

    """

    first: str
    best: str
    before: float
    after: float

    @property
    def is_separated(self) -> bool:
        """Whether the second run suffices."""
        return self.after >= MIN_CHI2_SEPARATED


def separating_run(effect: str, rival: str) -> Separation | None:
    """Find the run that separates two effects best.

    Parameters
    ----------
    effect, rival
        Names of effects.

    Returns
    -------
    Separation or None
        None for an effect that a plan cannot judge: it belongs to the law itself, or needs another measurement.

    """
    tables = _tables()
    if not {effect, rival} <= set(tables.names):
        return None
    keys = [run.design.key for run in tables.runs]
    first = keys.index(FIRST_RUN)
    options = {tables.runs[i].design.words: ((first, i), False) for i in range(len(keys)) if i != first}
    options[REFERENCE_INSTRUCTION] = (first,), True
    evidence = {words: _evidence(effect, rival, *option) for words, option in options.items()}
    best = max(evidence, key=lambda words: evidence[words])
    before = _evidence(effect, rival, (first,), False)
    return Separation(tables.runs[first].design.words, best, before, evidence[best])


def _evidence(effect: str, rival: str, runs: tuple[int, ...], reference: bool) -> float:
    """Expected chi-squared between two effects, whichever is true."""
    tables = _tables()
    a, b = tables.names.index(effect), tables.names.index(rival)
    found = _of_all_pairs(runs, reference)
    return float(min(found[a, b], found[b, a]))


@cache
def _of_all_pairs(runs: tuple[int, ...], reference: bool) -> Array:
    """Expected chi-squared between any two effects; the pages of all effects ask for the same few runs."""
    return _tables().evidence(list(runs), reference=reference)


@cache
def _tables() -> EvidenceTables:
    setup = ExperimentSetup(
        mass=MASS_KG, fps=FPS, pitch=PITCH_M, noise=NOISE_M, law=models.of(list(TUSTIN)), values=TUSTIN, course=COURSE_M
    )
    return tabulate_evidence(setup, lambda done, total, what: None)[0]
