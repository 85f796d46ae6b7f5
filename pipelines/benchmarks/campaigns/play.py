"""Play campaigns: film, diagnose, plan, film again; the runs that frictrack names against a fixed design."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import frictrack as ft
from campaigns.studies import FPS, MAX_DURATION_S, SPEEDS, Campaign, Settings
from frictrack import effects
from frictrack.diagnose.experiments import next_run
from frictrack.diagnose.model_selection import information_criterion, likelihood_gain
from frictrack.fit import Fit
from frictrack.fit.stepwise import add_effect, refine_to_end
from frictrack.flow.command_history import CompletenessTest, named_effects, plan_test
from frictrack.settings.costs import Costs
from frictrack.validation.blind.ideal_detector import degrees_of_freedom, detection_threshold

MAX_RUNS, N_FIRST = 6, 2
RULES = ("sure", "closed")  # first sure verdict; first one that leaves nothing open
N_FORMS = 100  # independent forms of an effect in a scan
MIN_PROMISED = 10.0  # expected evidence from which on a run is promised to separate two explanations


@dataclass
class Step:
    """One diagnosis: the number of runs, its verdict and level, whether it is sure, right, and leaves nothing open.

    `closed`: no run that the set-up can do would show more (a slope needs four runs in both directions).
    """

    runs: int
    verdict: str
    missing: list[str]
    alpha: float
    sure: bool
    right: bool
    closed: bool


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

    def __init__(self, campaign: Campaign, costs: Costs) -> None:
        self.campaign, self.costs = campaign, costs
        self.runs: list[Any] = []
        self.tests: list[CompletenessTest] = []
        self.steps: list[Step] = []

    def film(self, settings: Settings) -> None:
        """Film one run."""
        self.runs.append(self.campaign.film(settings, len(self.runs) + 1))

    def diagnose(self) -> tuple[Fit, dict[str, Any], dict[str, Any] | None]:
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
        plan = None if found["verdict"] == "missing" and sure else next_run(fit, found, self.costs)
        closed = sure and plan is None
        self.steps.append(Step(len(self.runs), found["verdict"], found["missing"], test.alpha, sure, right, closed))
        return fit, found, plan

    def ended(self, rule: str) -> dict[str, Any]:
        """Runs at the first verdict that is `sure` (or `closed`) if it is right, and how it is wrong if not."""
        first = next((s for s in self.steps if getattr(s, rule)), None)
        wrong = first is not None and not first.right
        named = first is not None and first.verdict == "missing"
        return {
            "runs": first.runs if first is not None and first.right else None,
            "wrong_name": wrong and named,
            "missed": wrong and not named,
        }

    def summary(self) -> dict[str, Any]:
        """Runs needed and wrong verdicts by both rules, and all steps."""
        return {**{rule: self.ended(rule) for rule in RULES}, "steps": [asdict(s) for s in self.steps]}


def oracle_gain(campaign: Campaign) -> float:
    """Fall of minus twice the log-likelihood if the hidden effect is added, over the threshold of a whole search.

    Fitted to the six runs of the fixed design, by one who is told the effect. Below 1 nobody can name it.
    """
    runs = [campaign.film(settings, k + 1) for k, settings in enumerate(campaign.fixed_design())]
    law, effect = list(campaign.model), effects.get(campaign.hidden)
    gain = likelihood_gain(ft.fit(law, runs).solution, ft.fit([*law, effect.name], runs).solution)
    return gain / detection_threshold(degrees_of_freedom(effect, len(runs)), N_FORMS)


def play(campaign: Campaign, costs: Costs) -> dict[str, Any]:
    """Play one campaign in both ways, until nothing is open or there are six runs."""
    begun = time.process_time()
    design = campaign.fixed_design()
    fixed, adaptive = Arm(campaign, costs), Arm(campaign, costs)
    for settings in design:
        fixed.film(settings)
        if len(fixed.runs) >= N_FIRST:
            fixed.diagnose()
            if fixed.steps[-1].closed:
                break
    predictions: list[Prediction] = []
    named: list[dict[str, Any]] = []
    for settings in (design[0], design[-1]):  # slow to a stop, and fast the other way
        adaptive.film(settings)
    while True:
        fit, _, plan = adaptive.diagnose()
        predictions += realised(named[-1], fit) if named else []
        if adaptive.steps[-1].closed or len(adaptive.runs) == MAX_RUNS or plan is None:
            break
        named.append(plan)
        adaptive.film(_settings(plan, campaign))
    kept = ("key", "settings", "cost", "separates", "expected_delta_bic", "expected_interval")
    return {
        "seed": campaign.seed,
        "hidden": campaign.hidden,
        "oracle_gain": (gain := oracle_gain(campaign) if campaign.hidden else None),
        "visible": gain is None or gain >= 1.0,
        "model": list(campaign.model),
        "fixed": fixed.summary(),
        "adaptive": adaptive.summary() | {"named": [{k: p[k] for k in kept} for p in named]},
        "predictions": [asdict(p) | {"factor_two": p.within_factor_two, "inside": p.in_interval} for p in predictions],
        "cpu_s": time.process_time() - begun,
    }


def _settings(plan: dict[str, Any], campaign: Campaign) -> Settings:
    """What a person does who films the named run."""
    own = plan["settings"]
    speed = float(np.sign(own["speed"]) * np.clip(abs(own["speed"]), *SPEEDS))
    return Settings(speed, own["mass"] / campaign.mass, float(np.deg2rad(own["incline_deg"])))


def realised(plan: dict[str, Any], fit: Fit) -> list[Prediction]:
    """The least evidence predicted of a named run if the explanation is true that is best after it was filmed.

    Empty where no rivals were named, or where nothing was predicted for the best one.
    """
    rows = [p for p in plan["predictions"] if p["rival"] in effects.LIBRARY and p["true"] in effects.LIBRARY]
    bic = {n: _criterion(fit, n) for n in dict.fromkeys(n for p in rows for n in (p["true"], p["rival"]))}
    best = min(bic, key=lambda n: bic[n], default="")
    least = min((p for p in rows if p["true"] == best), key=lambda p: p["expected"], default=None)
    if least is None:
        return []
    low, high = least["interval"]
    gained = float(bic[least["rival"]] - bic[best])
    return [Prediction(plan["key"], best, least["rival"], least["expected"], low, high, gained)]


def _criterion(fit: Fit, name: str) -> float:
    """BIC of the model with one effect more, of the better of two fits: all at once, and the effect on top."""
    again = ft.fit([*fit.model.names, name], fit.runs).solution
    added = refine_to_end(add_effect(fit.solution, effects.get(name)))
    return min(information_criterion(again), information_criterion(added))


def costs_of(campaign: Campaign) -> Costs:
    """What the set-up can do: 2 to 8 m/s, both directions, two masses, an incline, one camera of limited memory."""
    return Costs(
        film=1.0, camera=float("inf"),
        speeds=SPEEDS, masses=(campaign.mass, 2 * campaign.mass), frames=FPS * MAX_DURATION_S,
    )  # fmt: skip


def score(played: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all campaigns whose hidden effect could be seen in six runs, and the number of the others."""
    hopeless = [one for one in played if not one["visible"]]
    played = [one for one in played if one["visible"]]
    n = max(len(played), 1)
    predictions = [p for one in played for p in one["predictions"]]
    rated = [p for p in predictions if p["expected"] >= MIN_PROMISED]

    def arm(name: str, rule: str) -> dict[str, Any]:
        needed = [one[name][rule]["runs"] for one in played]
        return {
            "right": sum(r is not None for r in needed),
            "at_most_three_runs": sum(r is not None and r <= MAX_RUNS // 2 for r in needed) / n,
            "at_most_half_of_fixed": sum(
                r is not None and r <= max((f or MAX_RUNS) / 2, N_FIRST)
                for r, f in zip(needed, (one["fixed"][rule]["runs"] for one in played), strict=True)
            )
            / n,
            "wrong_name": sum(one[name][rule]["wrong_name"] for one in played),
            "complete_though_hidden": sum(one[name][rule]["missed"] for one in played),
            "ambiguous_no_run_separates": sum(_is_left_open(one[name]["steps"]) for one in played),
            "mean_runs": float(np.mean([r or MAX_RUNS for r in needed])),
        }

    return {
        "n": len(played),
        "not_visible": len(hopeless),
        "not_visible_wrong_name": sum(one["adaptive"]["sure"]["wrong_name"] for one in hopeless),
        **{f"{name}_{rule}": arm(name, rule) for rule in RULES for name in ("fixed", "adaptive")},
        "predictions": len(predictions),
        "rated": len(rated),
        "within_factor_two": sum(p["factor_two"] for p in rated) / max(len(rated), 1),
        "in_interval": sum(p["inside"] for p in rated) / max(len(rated), 1),
    }


def _is_left_open(steps: Sequence[dict[str, Any]]) -> bool:
    """Whether a campaign ended before its last run, because no run of the set-up separates what explains the runs."""
    return bool(steps[-1]["verdict"] == "ambiguous" and steps[-1]["runs"] < MAX_RUNS)


def tell_one(one: dict[str, Any], tell: Callable[[str], None]) -> None:
    """One line for a campaign."""

    def steps(name: str) -> str:
        marks = [f"{s['runs']} {s['verdict']} {'+'.join(s['missing'])}{'.' * s['closed']}" for s in one[name]["steps"]]
        return f"{one[name]['sure']['runs']}/{one[name]['closed']['runs']} ({', '.join(marks)})"

    named = ", ".join(p["key"] for p in one["adaptive"]["named"])
    forecast = " ".join(f"{p['expected']:.3g}->{p['realised']:.3g}" for p in one["predictions"])
    seen = "" if one["visible"] else f" (not visible: {one['oracle_gain']:.2g} of the threshold)"
    tell(f"{one['seed']} {one['hidden'] or 'nothing'}{seen}: fixed {steps('fixed')}; adaptive {steps('adaptive')} "
         f"[{named}] {forecast}; {one['cpu_s']:.0f} s")  # fmt: skip
