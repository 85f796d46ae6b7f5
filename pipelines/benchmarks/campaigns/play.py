"""Play campaigns: film, diagnose, plan, film again; the runs that frictrack names against a fixed design."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import frictrack as ft
from campaigns.studies import FPS, SPEEDS, Campaign, Settings
from frictrack import effects
from frictrack.costs import Costs
from frictrack.diagnose.model_selection import information_criterion
from frictrack.fit import Fit
from frictrack.fit.stepwise import add_effect, refine_to_end
from frictrack.flow.significance_budget import CompletenessTest, named_effects, plan_test
from frictrack.plan import next_run

MAX_RUNS, N_FIRST = 6, 2
MIN_RATED = 1.0  # realised evidence below which a factor says nothing


@dataclass
class Step:
    """One diagnosis: the number of runs, its verdict and level, and whether that is sure, and right."""

    runs: int
    verdict: str
    missing: list[str]
    alpha: float
    sure: bool
    right: bool


@dataclass
class Prediction:
    """One prediction: what was expected of a run, its interval, and the evidence after it was filmed."""

    run: str
    true: str
    rival: str | None
    expected: float
    low: float
    high: float | None
    realised: float

    @property
    def within_factor_two(self) -> bool:
        """Whether the realised evidence is between half and twice the expected one."""
        return 0.5 <= self.realised / max(self.expected, 1e-300) <= 2.0

    @property
    def in_interval(self) -> bool:
        """Whether the realised evidence is inside the interval."""
        return self.low <= self.realised <= (self.high if self.high is not None else np.inf)


class Arm:
    """One way to plan a campaign, diagnosed after every film within one budget of significance."""

    def __init__(self, campaign: Campaign) -> None:
        self.campaign = campaign
        self.runs: list[Any] = []
        self.tests: list[CompletenessTest] = []
        self.steps: list[Step] = []

    def film(self, settings: Settings) -> None:
        """Film one run."""
        self.runs.append(self.campaign.film(settings, len(self.runs) + 1))

    def diagnose(self) -> tuple[Fit, dict[str, Any]]:
        """Fit and diagnose all runs; every test after the first is made at the level that the budget leaves."""
        model = list(self.campaign.model)
        test = plan_test(self.tests, key := str(len(self.runs)), key, model)
        fit = ft.fit(model, self.runs)
        found = ft.diagnose(fit, quick=True, alpha=test.alpha).summary()
        self.tests.append(
            CompletenessTest(**asdict(test) | {"named": named_effects(found), "verdict": found["verdict"]})
        )
        sure = found["verdict"] == "complete" or (found["verdict"] == "missing" and len(found["missing"]) == 1)
        right = found["missing"] == ([self.campaign.hidden] if self.campaign.hidden else [])
        self.steps.append(Step(len(self.runs), found["verdict"], found["missing"], test.alpha, sure, sure and right))
        return fit, found

    @property
    def runs_needed(self) -> int | None:
        """Runs at the first sure verdict, if it is right; None else."""
        first = next((s for s in self.steps if s.sure), None)
        return first.runs if first and first.right else None

    @property
    def wrong(self) -> bool:
        """Whether the first sure verdict is wrong."""
        first = next((s for s in self.steps if s.sure), None)
        return first is not None and not first.right


def play(campaign: Campaign, costs: Costs) -> dict[str, Any]:
    """Play one campaign in both ways."""
    begun = time.process_time()
    design = campaign.fixed_design()
    fixed, adaptive = Arm(campaign), Arm(campaign)
    for settings in design:
        fixed.film(settings)
        if len(fixed.runs) >= N_FIRST:
            fixed.diagnose()
            if fixed.steps[-1].sure:
                break
    predictions, named = [], []
    for settings in (design[0], design[-1]):  # slow to a stop, and fast the other way
        adaptive.film(settings)
    while True:
        fit, found = adaptive.diagnose()
        if named:
            predictions += realised(named[-1], fit, found)
        if adaptive.steps[-1].sure or len(adaptive.runs) == MAX_RUNS:
            break
        plan = next_run(fit, found, costs)
        if plan is None:
            named.append(None)
            break
        named.append(plan)
        adaptive.film(_settings(plan, campaign))
    return {
        "seed": campaign.seed,
        "hidden": campaign.hidden,
        "model": list(campaign.model),
        "fixed": {"runs": fixed.runs_needed, "wrong": fixed.wrong, "steps": [asdict(s) for s in fixed.steps]},
        "adaptive": {"runs": adaptive.runs_needed, "wrong": adaptive.wrong,
                     "steps": [asdict(s) for s in adaptive.steps],
                     "named": [p and {k: p[k] for k in ("key", "settings", "cost", "separates")} for p in named]},
        "predictions": [asdict(p) | {"factor_two": p.within_factor_two, "inside": p.in_interval} for p in predictions],
        "cpu_s": time.process_time() - begun,
    }  # fmt: skip


def _settings(plan: dict[str, Any], campaign: Campaign) -> Settings:
    """What a person does who films the named run."""
    own = plan["settings"]
    speed = float(np.sign(own["speed"]) * np.clip(abs(own["speed"]), *SPEEDS))
    return Settings(speed, own["mass"] / campaign.mass, float(np.deg2rad(own["incline_deg"])))


def realised(plan: dict[str, Any], fit: Fit, found: dict[str, Any]) -> list[Prediction]:
    """Evidence after the named run, for the prediction whose true explanation the new runs favour."""
    rows = [p for p in plan["predictions"] if p["rival"] is not None]
    names = list(dict.fromkeys(p["true"] for p in rows))
    bic = {}
    for name in names:
        if name in effects.LIBRARY:
            bic[name] = information_criterion(refine_to_end(add_effect(fit.solution, effects.get(name))))
    if len(bic) < len(names) or not bic:
        return []
    best = min(bic, key=lambda n: bic[n])
    out = []
    for p in rows:
        if p["true"] == best:
            low, high = p["interval"]
            out.append(
                Prediction(plan["key"], best, p["rival"], p["expected"], low, high, float(bic[p["rival"]] - bic[best]))
            )
    return out


def costs_of(campaign: Campaign) -> Costs:
    """What the set-up of the campaigns can do: 2 to 8 m/s, both directions, two masses, an incline, one camera."""
    return Costs(
        film=1.0, mass=1.0, direction=0.5, incline=1.0, camera=float("inf"),
        speeds=SPEEDS, masses=(campaign.mass, 2 * campaign.mass),
    )  # fmt: skip


def score(played: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all campaigns."""
    n = max(len(played), 1)
    predictions = [p for one in played for p in one["predictions"]]
    rated = [p for p in predictions if abs(p["realised"]) >= MIN_RATED]

    def arm(name: str) -> dict[str, Any]:
        needed = [one[name]["runs"] for one in played]
        return {
            "right": sum(r is not None for r in needed),
            "within_half": sum(r is not None and r <= MAX_RUNS // 2 for r in needed) / n,
            "wrong": sum(one[name]["wrong"] for one in played),
            "mean_runs": float(np.mean([r or MAX_RUNS for r in needed])),
        }

    return {
        "n": len(played),
        "fps": FPS,
        "fixed": arm("fixed"),
        "adaptive": arm("adaptive"),
        "predictions": len(predictions),
        "within_factor_two": sum(p["factor_two"] for p in rated) / max(len(rated), 1),
        "in_interval": sum(p["inside"] for p in predictions) / max(len(predictions), 1),
    }


def tell_one(one: dict[str, Any], tell: Callable[[str], None]) -> None:
    """One line for a campaign."""
    def steps(name: str) -> str:
        return ", ".join(f"{s['runs']} {s['verdict']} {'+'.join(s['missing'])}".strip() for s in one[name]["steps"])

    named = " ".join(p["key"] if p else "none" for p in one["adaptive"]["named"])
    forecast = " ".join(f"{p['expected']:.3g}->{p['realised']:.3g}" for p in one["predictions"])
    tell(f"{one['seed']} {one['hidden'] or 'nothing'}: fixed {one['fixed']['runs']} ({steps('fixed')}); "
         f"adaptive {one['adaptive']['runs']} ({steps('adaptive')}) [{named}] {forecast}; {one['cpu_s']:.0f} s")  # fmt: skip
