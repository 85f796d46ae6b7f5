"""What a diagnosis says: every candidate with its evidence, the verdict, and what these runs could have shown."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from frictrack.diagnose.auxiliary_signals import Evidence
from frictrack.diagnose.power import Undetermined
from frictrack.diagnose.repeatability import Repeatability
from frictrack.records import Array

MAX_ERROR_RATIO = 1.002  # times the held-out error before: a change of that size is none


@dataclass(frozen=True)
class Candidate:
    """One effect tried on top of the model, refined, with its evidence."""

    effect: str
    acts_on: str
    parameters: dict[str, Any]
    p: float
    delta_bic: float
    heldout_before: float | None = None  # m
    heldout_after: float | None = None
    heldout: str | None = None
    indistinguishable_from: tuple[str, ...] = ()
    words: dict[str, str] = field(default_factory=dict)
    implausible: str = ""  # why it imitates the misfit and is no cause
    unit: str = "um"  # of the held-out errors: um of displacement, or N where friction was measured

    @property
    def helps(self) -> bool:
        """Whether the held-out error falls with it, or stays: a run's own level hides what only runs together show."""
        if self.heldout_after is None or self.heldout_before is None:
            return True
        return self.heldout_after < MAX_ERROR_RATIO * self.heldout_before

    def summary(self) -> dict[str, Any]:
        """Entry of the JSON of `frictrack diagnose`."""
        held = {"before": self.heldout_before, "after": self.heldout_after}
        factor = 1e6 if self.unit == "um" else 1.0
        return {
            "effect": self.effect,
            "acts_on": self.acts_on,
            "parameters": self.parameters,
            "p": self.p,
            "delta_bic": self.delta_bic,
            **{f"heldout_rms_{when}_um": None for when in held},
            **{f"heldout_rms_{when}_{self.unit}": None if e is None else e * factor for when, e in held.items()},
            "heldout": self.heldout,
            "indistinguishable_from": list(self.indistinguishable_from),
            "implausible": self.implausible or None,
            "words": self.words,
        }


@dataclass(frozen=True)
class Importance:
    """What one effect explains of the misfit: by itself, and after those above it in the table.

    Shares of chi-squared beyond the noise; the held-out error is that of the law with this effect and those above it,
    m, or N where friction was measured. `stop` marks the last effect that is worth adding.
    """

    effect: str
    alone: float | None
    in_sequence: float | None
    heldout_after: float | None
    unit: str = "um"
    stop: bool = False

    def summary(self) -> dict[str, Any]:
        """Entry of the JSON `importance`."""
        factor = 1e6 if self.unit == "um" else 1.0
        held = None if self.heldout_after is None else self.heldout_after * factor
        shares = {"explained_alone": self.alone, "explained_in_sequence": self.in_sequence}
        return {"effect": self.effect, **shares, f"heldout_rms_after_{self.unit}": held, "stop": self.stop}


@dataclass(frozen=True)
class Diagnosis:
    """What is missing in a fitted model, how sure, and what these runs could have shown."""

    model: list[str]
    verdict: str
    missing: list[str]
    noise_um: float | None
    reduced_chi2: float
    p_lack_of_fit: float
    fails_at: list[dict[str, Any]]
    candidates: list[Candidate]
    unexplained: dict[str, Any] | None
    detection_limits: dict[str, dict[str, Any]]
    remarks: list[str]
    figures: dict[str, dict[str, Array]]
    noise_N: float | None = None  # where friction was measured
    next_experiment: list[dict[str, Any]] = field(default_factory=list)
    evidence: list[Evidence] = field(default_factory=list)  # what moved in step with the residual, first evidence first
    undetermined: list[Undetermined] = field(default_factory=list)  # what the runs leave open
    importance: list[Importance] = field(default_factory=list)  # most important first
    repeats: Repeatability = field(
        default_factory=Repeatability
    )  # whether the failure is common to the runs, and along which axis

    @property
    def best(self) -> Candidate | None:
        """The candidate with the strongest evidence."""
        return self.candidates[0] if self.candidates else None

    def summary(self) -> dict[str, Any]:
        """The JSON of `frictrack diagnose`."""
        return {
            "model": self.model,
            "verdict": self.verdict,
            "undetermined": [u.summary() for u in self.undetermined],
            "importance": [i.summary() for i in self.importance],
            "evidence": [e.summary() for e in self.evidence],
            "missing": self.missing,
            "noise_um": self.noise_um,
            **({} if self.noise_N is None else {"noise_N": self.noise_N}),
            "reduced_chi2": self.reduced_chi2,
            "p_lack_of_fit": self.p_lack_of_fit,
            "fails_at": self.fails_at,
            "repeats": self.repeats.summary(),
            "repeats_words": self.repeats.words,
            "candidates": [c.summary() for c in self.candidates],
            "unexplained": self.unexplained,
            "next_experiment": self.next_experiment,
            "detection_limits": self.detection_limits,
            "remarks": self.remarks,
        }
