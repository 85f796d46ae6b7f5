"""The next experiment: the run, or the measurement beside the film, that would part what these runs cannot.

Every run of a menu is simulated under each explanation, and the others are fitted to it over all runs, that one
included, without noise: what they leave unexplained is the expected evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any

from frictrack.diagnose.experiments.advice_text import because, told_apart, unparted
from frictrack.diagnose.experiments.direct_checks import checks
from frictrack.diagnose.experiments.expected_separation import Duel, Explanation, explanation
from frictrack.diagnose.experiments.menu import Experiment, menu
from frictrack.diagnose.experiments.unknown_cause import along_axes
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.measured_friction import is_series

__all__ = [
    "Duel",
    "Experiment",
    "Explanation",
    "explanation",
    "films",
    "for_unexplained",
    "menu",
    "next_experiment",
    "settling",
]

NEAR = 60.0  # difference of BIC from the best within which a candidate is worth a run that rules it out
PARTED = 10.0  # expected difference of BIC from which two explanations are told apart
MOST = 3  # explanations that are compared with each other
SHOWN = 5  # experiments that are told
AXES = 2  # along which what no effect explains is compared
SIMPLE = ("slower", "faster", "to a stop", "reversed", "double mass", "half mass")  # runs that tell axes apart
EFFORT = ("accelerometer", "course sensor", "known weight")  # what has to be bought, fixed and brought in time
DEAR = 10.0  # times as much evidence as a film must come from these to be preferred

Progress = Callable[[str], None]
Pair = tuple[str, str]  # true explanation, the other one


@dataclass(frozen=True)
class Offer:
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
            if a < b and min(self.evidence[a, b], self.evidence.get((b, a), 0.0)) >= PARTED
        ]

    def least(self) -> float:
        """Least evidence over the pairs that it tells apart."""
        return min((min(self.evidence[a, b], self.evidence[b, a]) for a, b in self.parted()), default=0.0)

    def worth(self) -> float:
        """Evidence against effort: a sensor has to be fixed and brought in time with the camera."""
        return self.least() * (1.0 if self.kind == "film" or self.key not in EFFORT else 1 / DEAR)

    def summary(self, names: Sequence[str]) -> dict[str, Any]:
        """Entry of the JSON of `frictrack diagnose`."""
        pairs = self.parted()
        among = {name for pair in pairs for name in pair}
        told = [name for name in names if name in among]
        each = {n: min(self.evidence[n, b] for b in told if tuple(sorted((n, b))) in pairs) for n in told}
        why = because(told) if self.kind == "film" else ""
        return {
            "what": f"{self.words}: {why}" if why else self.words,
            "separates": told,
            "expected_delta_bic": self.least(),
            "expected_if_true": each,
            "groups": _groups(told, pairs),
            "tells": told_apart(_groups(told, pairs)),
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
    """What would part explanations of the same runs, best first: JSON; the first `MOST` of them are compared.

    `keys` may name the runs of the menu that are weighed. Where nothing of it can, one entry says so and names other
    means.
    """
    among = list(explanations)[:MOST]
    if len(among) < 2 or any(is_series(e.solution.problem) for e in among):
        return []
    names = [e.effect for e in among]
    offers = [
        offer for offer in (*(films(among, tell, keys) if _coast(among) else ()), *beside(among)) if offer.parted()
    ]
    out = [offer.summary(names) for offer in _ordered(offers)[:SHOWN]]
    left = [pair for pair in combinations(names, 2) if not any(tuple(sorted(pair)) in o.parted() for o in offers)]
    return out + [_hopeless(pair, among) for pair in left if _coast(among)]


def for_unexplained(solution: Solution, tell: Progress = lambda what: None) -> list[dict[str, Any]]:
    """What would tell whether that which a law leaves belongs to the place, the time or the speed: JSON."""
    if is_series(solution.problem) or any(p.turns or p.cut for p in solution.problem.pieces):
        return []
    return next_experiment(along_axes(solution)[:AXES], tell, SIMPLE)


def settling(
    bare: Solution,
    passing: Sequence[tuple[str, Solution, float]],
    rivals: Sequence[str],
    tell: Progress = lambda what: None,
) -> list[dict[str, Any]]:
    """The next experiment of a diagnosis: JSON.

    `passing` holds the candidates that pass, best first, each with its fit and its difference of BIC; those are
    compared that the runs cannot tell from the best, and those that are `NEAR` it.
    """
    if not passing:
        return []
    best, _, most = passing[0]
    near = [c for c in passing if c[0] == best or c[0] in rivals or most - c[2] < NEAR]
    near.sort(key=lambda c: (c[0] != best, c[0] not in rivals, -c[2]))
    near = near[:MOST]
    return next_experiment([explanation(n, s, bare) for n, s, _ in near], tell)


def _ordered(offers: Sequence[Offer]) -> list[Offer]:
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


def films(
    among: Sequence[Explanation], tell: Progress = lambda what: None, keys: Sequence[str] = ()
) -> Iterator[Offer]:
    """Every run of the menu (or those of some `keys`) with the evidence expected of it."""
    duels = {(a.effect, b.effect): Duel(a, b) for a, b in permutations(among, 2)}
    for entry in (e for e in menu(among[0].solution) if not keys or e.key in keys):
        tell(f"weighing an experiment: {entry.key}")
        yield Offer(entry.key, entry.words, "film", _both_ways(duels, entry))


def _both_ways(duels: dict[Pair, Duel], entry: Experiment) -> dict[Pair, float]:
    """Expected evidence of a run for every pair, whichever is true; once it is too little, the reverse is not asked."""
    out: dict[Pair, float] = {}
    for (true, other), duel in duels.items():
        parted = out.get((other, true), PARTED) >= PARTED
        out[true, other] = _after(duel, entry) if parted else 0.0
    return out


def _after(duel: Duel, entry: Experiment) -> float:
    """Expected evidence; none where the run cannot be made, or its motion not be followed."""
    try:
        return duel.after(entry.film)
    except FrictrackError:
        return 0.0


def beside(among: Sequence[Explanation]) -> Iterator[Offer]:
    """Measurements beside the film with the evidence expected of them."""
    made: dict[str, Offer] = {}
    for one, other in combinations(among, 2):
        for check, if_one, if_other in checks(one, other):
            offer = made.setdefault(check.key, Offer(check.key, check.words, "measurement", {}))
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
        "what": unparted(pair, confirm),
        "separates": [],
        "expected_delta_bic": 0.0,
        "expected_if_true": {},
        "groups": [list(pair)],
        "tells": "",
        "kind": "none",
        "key": "none",
    }
