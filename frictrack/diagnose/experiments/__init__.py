"""The next experiment: the run, or the measurement beside the film, that would part what these runs cannot.

Every run of a menu is simulated under each explanation, and the others are fitted to it over all runs, that one
included, without noise: what they leave unexplained is the expected evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any

from frictrack.diagnose.experiments.advice_text import describe_separation, describe_unseparated, explain_separation
from frictrack.diagnose.experiments.direct_checks import direct_checks
from frictrack.diagnose.experiments.expected_separation import Contest, Explanation, make_explanation
from frictrack.diagnose.experiments.menu import Experiment, menu
from frictrack.diagnose.experiments.unknown_cause import explain_by_axes
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.measured_friction import is_measured_friction

__all__ = [
    "Contest",
    "Experiment",
    "Explanation",
    "make_explanation",
    "menu",
    "next_experiment",
    "plan_for_candidates",
    "plan_for_unexplained",
    "rate_runs",
]

MAX_BIC_NEAR = 60.0  # difference of BIC from the best within which a candidate is worth a run that rules it out
MIN_BIC_SEPARATED = 10.0  # expected difference of BIC from which two explanations are told apart
MAX_EXPLANATIONS = 3  # explanations that are compared with each other
MAX_EXPERIMENTS = 5  # experiments that are told
MAX_AXES = 2  # along which what no effect explains is compared
AXIS_RUN_KEYS = ("slower", "faster", "to a stop", "reversed", "double mass", "half mass")  # runs that tell axes apart
COSTLY_CHECKS = ("accelerometer", "course sensor", "known weight")  # what has to be bought, fixed and brought in time
COST_FACTOR = 10.0  # times as much evidence as a film must come from these to be preferred

Progress = Callable[[str], None]
Pair = tuple[str, str]  # true explanation, the other one


@dataclass(frozen=True)
class RatedExperiment:
    """One experiment and the evidence expected of it, for every (true, other) pair of explanations."""

    key: str
    words: str
    kind: str  # "film", or "measurement" beside it
    evidence: dict[Pair, float]

    def parted(self) -> list[Pair]:
        """Pairs of explanations that it tells apart, whichever is true."""
        return [
            (a, b)
            for a, b in self.evidence
            if a < b and min(self.evidence[a, b], self.evidence.get((b, a), 0.0)) >= MIN_BIC_SEPARATED
        ]

    def least(self) -> float:
        """Least evidence over the pairs that it tells apart."""
        return min((min(self.evidence[a, b], self.evidence[b, a]) for a, b in self.parted()), default=0.0)

    def worth(self) -> float:
        """Evidence against effort: a sensor has to be fixed and brought in time with the camera."""
        return self.least() * (1.0 if self.kind == "film" or self.key not in COSTLY_CHECKS else 1 / COST_FACTOR)

    def summary(self, names: Sequence[str]) -> dict[str, Any]:
        """Entry of the JSON of `frictrack diagnose`."""
        pairs = self.parted()
        among = {name for pair in pairs for name in pair}
        told = [name for name in names if name in among]
        each = {n: min(self.evidence[n, b] for b in told if tuple(sorted((n, b))) in pairs) for n in told}
        why = explain_separation(told) if self.kind == "film" else ""
        return {
            "what": f"{self.words}: {why}" if why else self.words,
            "separates": told,
            "expected_delta_bic": self.least(),
            "expected_if_true": each,
            "groups": _groups(told, pairs),
            "tells": describe_separation(_groups(told, pairs)),
            "kind": self.kind,
            "key": self.key,
        }


def _groups(names: Sequence[str], parted: Sequence[Pair]) -> list[list[str]]:
    """Names in groups of those that stay together, the largest last."""
    groups: list[list[str]] = []
    for name in names:
        mine = [g for g in groups if any(tuple(sorted((name, other))) not in parted for other in g)]
        groups = [g for g in groups if g not in mine] + [[*(other for g in mine for other in g), name]]
    return sorted(groups, key=len)


def next_experiment(
    explanations: Sequence[Explanation], tell: Progress = lambda what: None, keys: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """What would part explanations of the same runs, best first: JSON; at most `MAX_EXPLANATIONS` are compared.

    `keys` may name the runs of the menu that are weighed. Where nothing of it can, one entry says so and names other
    means.
    """
    among = list(explanations)[:MAX_EXPLANATIONS]
    if len(among) < 2 or any(is_measured_friction(e.solution.problem) for e in among):
        return []
    names = [e.effect for e in among]
    offers = [
        offer
        for offer in (*(rate_runs(among, tell, keys) if _coast(among) else ()), *rate_direct_checks(among))
        if offer.parted()
    ]
    out = [offer.summary(names) for offer in _ordered(offers)[:MAX_EXPERIMENTS]]
    left = [pair for pair in combinations(names, 2) if not any(tuple(sorted(pair)) in o.parted() for o in offers)]
    return out + [_hopeless(pair, among) for pair in left if _coast(among)]


def plan_for_unexplained(solution: Solution, tell: Progress = lambda what: None) -> list[dict[str, Any]]:
    """What would tell whether that which a law leaves belongs to the place, the time or the speed: JSON."""
    if is_measured_friction(solution.problem) or any(p.turns or p.cut for p in solution.problem.pieces):
        return []
    return next_experiment(explain_by_axes(solution)[:MAX_AXES], tell, AXIS_RUN_KEYS)


def plan_for_candidates(
    bare: Solution,
    passing: Sequence[tuple[str, Solution, float]],
    rivals: Sequence[str],
    tell: Progress = lambda what: None,
) -> list[dict[str, Any]]:
    """The next experiment of a diagnosis: JSON.

    `passing` holds the candidates that pass, best first, each with its fit and its difference of BIC; those are
    compared that the runs cannot tell from the best, and those that are `MAX_BIC_NEAR` it.
    """
    if not passing:
        return []
    best, _, most = passing[0]
    near = [c for c in passing if c[0] == best or c[0] in rivals or most - c[2] < MAX_BIC_NEAR]
    near.sort(key=lambda c: (c[0] != best, c[0] not in rivals, -c[2]))
    near = near[:MAX_EXPLANATIONS]
    return next_experiment([make_explanation(n, s, bare) for n, s, _ in near], tell)


def _ordered(offers: Sequence[RatedExperiment]) -> list[RatedExperiment]:
    """Best first: the one that parts most pairs, then what parts those that are left, and so on."""
    left, out = list(offers), []
    open_pairs: set[Pair] = set()
    while left:
        open_pairs = open_pairs or {pair for o in left for pair in o.parted()}
        best = max(left, key=lambda o: (len(open_pairs & set(o.parted())), o.worth()))
        open_pairs -= set(best.parted())
        if not any(open_pairs & set(o.parted()) for o in left):
            open_pairs = set()
        left.remove(best)
        out.append(best)
    return out


def rate_runs(
    among: Sequence[Explanation], tell: Progress = lambda what: None, keys: Sequence[str] = ()
) -> Iterator[RatedExperiment]:
    """Every run of the menu (or those of some `keys`) with the evidence expected of it."""
    duels = {(a.effect, b.effect): Contest(a, b) for a, b in permutations(among, 2)}
    for entry in (e for e in menu(among[0].solution) if not keys or e.key in keys):
        tell(f"weighing an experiment: {entry.key}")
        yield RatedExperiment(entry.key, entry.words, "film", _both_ways(duels, entry))


def _both_ways(duels: dict[Pair, Contest], entry: Experiment) -> dict[Pair, float]:
    """Expected evidence of a run for every pair, whichever is true; once it is too little, the reverse is not asked."""
    out: dict[Pair, float] = {}
    for (true, other), duel in duels.items():
        parted = out.get((other, true), MIN_BIC_SEPARATED) >= MIN_BIC_SEPARATED
        out[true, other] = _after(duel, entry) if parted else 0.0
    return out


def _after(duel: Contest, entry: Experiment) -> float:
    """Expected evidence; none where the run cannot be made, or its motion not be followed."""
    try:
        return duel.after(entry.film)
    except FrictrackError:
        return 0.0


def rate_direct_checks(among: Sequence[Explanation]) -> Iterator[RatedExperiment]:
    """Measurements beside the film with the evidence expected of them."""
    made: dict[str, RatedExperiment] = {}
    for one, other in combinations(among, 2):
        for check, if_one, if_other in direct_checks(one, other):
            offer = made.setdefault(check.key, RatedExperiment(check.key, check.words, "measurement", {}))
            offer.evidence[one.effect, other.effect] = if_one
            offer.evidence[other.effect, one.effect] = if_other
    yield from made.values()


def _coast(among: Sequence[Explanation]) -> bool:
    """Whether the runs are followed in one piece, so that others like them can be foretold."""
    return not any(p.turns or p.cut for e in among for p in e.solution.problem.pieces)


def _hopeless(pair: tuple[str, str], among: Sequence[Explanation]) -> dict[str, Any]:
    confirm = [
        e.confirm for told in among for e in told.solution.problem.model.effects if e.name == told.effect in pair
    ]
    return {
        "what": describe_unseparated(pair, confirm),
        "separates": [],
        "expected_delta_bic": 0.0,
        "expected_if_true": {},
        "groups": [list(pair)],
        "tells": "",
        "kind": "none",
        "key": "none",
    }
