"""Define the result of a diagnosis: candidates with evidence, their importance, the verdict, detection limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from frictrack.diagnose.auxiliary_signals import Evidence
from frictrack.diagnose.examination import ALPHA
from frictrack.diagnose.power import Undetermined
from frictrack.diagnose.repeatability import Repeatability
from frictrack.records import Array, NotebookView

if TYPE_CHECKING:
    import pandas as pd


def _in_unit(error: float | None, unit: str) -> float | None:
    """A held-out error in um, or in N where friction was measured."""
    return None if error is None else error * (1e6 if unit == "um" else 1.0)


@dataclass(frozen=True, repr=False)
class Candidate:
    """One effect tried on top of the model, refined, with its evidence.

    Parameters
    ----------
    effect
        Name of the effect.
    acts_on
        "force" or "measurement".
    parameters
        Value, standard deviation and unit of its parameters.
    p
        p-value for the whole search.
    delta_bic
        Fall of the Bayesian information criterion.
    heldout_before, heldout_after
        Held-out error without and with it, m, or N for measured friction.
    heldout
        How frames were held out.
    indistinguishable_from
        Effects whose best fit predicts the same data.
    words
        Description of the effect; see `describe_effect`.
    implausible
        Why it cannot be the cause; empty if it can.
    unit
        Unit of the held-out errors in the JSON: "um", or "N" for measured friction.
    passes
        Whether it is plausible, significant for the whole search, and confirmed by its simulated fit.

    """

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
    passes: bool = False

    def __repr__(self) -> str:
        alike = (
            f", indistinguishable from {', '.join(self.indistinguishable_from)}" if self.indistinguishable_from else ""
        )
        return f"<Candidate {self.effect}: p = {self.p:.3g}, delta BIC {self.delta_bic:.4g}{alike}>"

    def summary(self) -> dict[str, Any]:
        """Return the entry of the JSON of `frictrack diagnose`."""
        held = {"before": self.heldout_before, "after": self.heldout_after}
        return {
            "effect": self.effect,
            "acts_on": self.acts_on,
            "parameters": self.parameters,
            "p": self.p,
            "delta_bic": self.delta_bic,
            **{f"heldout_rms_{when}_um": None for when in held},
            **{f"heldout_rms_{when}_{self.unit}": _in_unit(e, self.unit) for when, e in held.items()},
            "heldout": self.heldout,
            "indistinguishable_from": list(self.indistinguishable_from),
            "implausible": self.implausible or None,
            "passes": self.passes,
            "words": self.words,
        }


@dataclass(frozen=True)
class Importance:
    """Share of the misfit that one effect explains, alone and after those above it in the table.

    Parameters
    ----------
    effect
        Name of the effect.
    alone, in_sequence
        Shares of the chi-squared above its expectation.
    heldout_after
        Held-out error of the model with this effect and those above it, m, or N for measured friction.
    unit
        Unit of the held-out error in the JSON.
    stop
        Whether it is the last effect worth adding.

    """

    effect: str
    alone: float | None
    in_sequence: float | None
    heldout_after: float | None
    unit: str = "um"
    stop: bool = False

    def summary(self) -> dict[str, Any]:
        """Return the entry of the JSON `importance`."""
        shares = {"explained_alone": self.alone, "explained_in_sequence": self.in_sequence}
        held = {f"heldout_rms_after_{self.unit}": _in_unit(self.heldout_after, self.unit)}
        return {"effect": self.effect, **shares, **held, "stop": self.stop}


@dataclass(frozen=True, repr=False)
class Diagnosis(NotebookView):
    """Result of a diagnosis.

    Parameters
    ----------
    model
        Effects of the fitted model.
    verdict
        "complete", "missing", "ambiguous", "unexplained" or "undetermined".
    missing
        Effects that the model lacks: with them nothing is left. Empty where none explain it.
    leads
        Effects that explain a part of what is left unexplained.
    noise_um, noise_N
        Noise of a frame, um, or N for measured friction.
    reduced_chi2, p_lack_of_fit
        Misfit of the model and its p-value.
    fails_at
        Spans where the model fails; see `compare.failing_spans`.
    candidates
        All effects tried, best first.
    unexplained
        Force that no effect explains; see `unexplained_force`.
    detection_limits
        Smallest detectable size of every effect.
    remarks
        Sentences on the limits of the diagnosis.
    figures
        Curves for plots, by figure and name.
    next_experiment
        Proposed experiments, best first.
    evidence
        Other measurements that match the residual, largest share first.
    undetermined
        What the runs leave open.
    alternatives
        Other sets of effects that explain as much as those that are missing, with their BIC over that of these.
    importance
        Effects by importance.
    repeats
        Whether the misfit repeats from run to run, and over which axis.
    complete
        False for the verdict alone: `fails_at`, `importance`, `evidence`, `repeats` and `next_experiment` are empty.
    alpha
        Significance level of the diagnosis: half for lack of fit, half for candidates.
    levels
        Addresses, such as "viscous.level", to add to the model: what the friction levels of the runs multiply in it.
    rests_on_repairs
        A sentence if the verdict would change without the frames that the user had tracked again; None otherwise.

    Examples
    --------
    >>> import frictrack as ft
    >>> found = ft.diagnose(ft.fit(["coulomb", "viscous"], ft.samples.runs()[:2]), quick=True)
    >>> found.verdict, found.missing, found.candidates[0].effect
    ('missing', ['patch'], 'patch')

    """

    drawn_by: ClassVar[str] = "frictrack.present.plots:verdict"
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
    alternatives: list[dict[str, Any]] = field(default_factory=list)  # other sets of effects
    importance: list[Importance] = field(default_factory=list)  # most important first
    # whether the failure is common to the runs, and along which axis
    repeats: Repeatability = field(default_factory=Repeatability)
    alpha: float = ALPHA
    leads: list[str] = field(default_factory=list)  # of "unexplained"
    levels: list[str] = field(default_factory=list)  # to add: what the friction levels multiply
    complete: bool = True  # False: the verdict, and nothing of what follows from it
    rests_on_repairs: str | None = None  # a sentence if the verdict changes without the frames that were tracked again

    def __repr__(self) -> str:
        model, lacks = "+".join(self.model), f": {', '.join(self.missing)}" if self.missing else ""
        lacks += f"; leads: {', '.join(self.leads)}" if self.leads else ""
        first = f"; first candidate {self.best!r}" if self.best and not self.missing else ""
        return f"<Diagnosis of {model}: {self.verdict}{lacks}; reduced chi-squared {self.reduced_chi2:.4g}{first}>"

    def to_dataframe(self) -> pd.DataFrame:
        """Return the candidates as a pandas DataFrame, best first: p, delta BIC and held-out errors (m or N)."""
        import pandas as pd  # noqa: PLC0415 - half a second

        names = ("acts_on", "p", "delta_bic", "heldout_before", "heldout_after")
        rows = {c.effect: {name: getattr(c, name) for name in names} for c in self.candidates}
        numbers = {name: float for name in names if name != "acts_on"}
        frame = pd.DataFrame.from_dict(rows, orient="index", columns=list(names))
        return frame.astype(numbers).rename_axis("effect")

    @property
    def best(self) -> Candidate | None:
        """The candidate with the strongest evidence."""
        return self.candidates[0] if self.candidates else None

    def summary(self) -> dict[str, Any]:
        """Return the JSON of `frictrack diagnose`."""
        return {
            "model": self.model,
            "verdict": self.verdict,
            "complete": self.complete,
            "alpha": self.alpha,
            "rests_on_repairs": self.rests_on_repairs,
            "undetermined": [u.summary() for u in self.undetermined],
            "alternatives": self.alternatives,
            "importance": [i.summary() for i in self.importance],
            "evidence": [e.summary() for e in self.evidence],
            "missing": self.missing,
            "leads": self.leads,
            "levels": self.levels,
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
