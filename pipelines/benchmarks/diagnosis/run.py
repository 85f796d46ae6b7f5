"""Compute the limits of all methods for all effects, at the setting that is least favourable to frictrack."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diagnosis import sparse
from diagnosis.force import force_size
from diagnosis.ours import repeated, size_seen, stated
from diagnosis.studies import BASE, EFFECTS, detector, holding
from frictrack.validation.blind.ideal_detector import ideal_detection_limit
from frictrack.validation.blind.truth import effect_named

Say = Callable[[str], None]
SIZES_OVER_IDEAL = tuple(2.0**k for k in range(-1, 9))  # of the ideal limit, for the peer
N_NULL_STUDIES = 100  # studies with nothing hidden, by which the peer is calibrated


def limits(names: Sequence[str], repeats: int, python: str | None, say: Say) -> dict[str, Any]:
    """Per effect: the setting, and the smallest size seen by each way; `repeats` 0 leaves frictrack's repeats out."""
    said, ideal = stated(), detector()
    out: dict[str, Any] = {}
    for name in names or EFFECTS:
        limit = said.get(name)
        if limit is None or limit["value"] is None:
            continue
        least = ideal_detection_limit(ideal, effect_named(name), limit["at"])
        if least is None:
            continue
        force = force_size(ideal, name, limit["at"])
        out[name] = {"at": limit["at"], "unit": limit["unit"], "stated": limit["value"], "ideal": least, "force": force}
        say(
            f"{name}: ideal {least:.3g}, stated {limit['value'] / least:.2f} of it, force domain {_times(force, least)}"
        )
    if python:
        _with_peer(out, python, max(repeats, 20), say)
    for name, row in out.items() if repeats else ():
        row["measured"] = repeated(name, row["at"], row["ideal"], repeats, say)
    return out


def _times(size: float | None, ideal: float) -> str:
    return "never" if size is None else f"{size / ideal:.1f}"


def _with_peer(out: dict[str, Any], python: str, repeats: int, say: Say) -> None:
    """The peer's sizes beside the others."""
    forms = {n: row["at"] for n, row in out.items() if effect_named(n).acts_on == "force"}
    owner, law = sparse.owners(forms), len(BASE)
    nothing = [sparse.case(*_drawn(BASE[0], {}, 0.0, seed), forms) for seed in range(N_NULL_STUDIES)]
    answer = sparse.ask(python, nothing, law, None)
    say(f"PySINDy {answer['version']}: threshold {answer['threshold']:.3g} for one false alarm in 100")
    for name in forms:
        row, shares = out[name], []
        for times in SIZES_OVER_IDEAL:
            size = times * row["ideal"]
            cases = [sparse.case(*_drawn(name, row["at"], size, 1000 + s), forms) for s in range(repeats)]
            found = sparse.ask(python, cases, law, answer["threshold"])["kept"]
            shares.append(sum(name in {owner[k] for k in kept} for kept in found) / repeats)
            if shares[-1] >= 1.0:
                break
        row["sparse"] = {"times": list(SIZES_OVER_IDEAL[: len(shares)]), "named": shares}
        row["sparse"]["size"] = size_seen(SIZES_OVER_IDEAL, shares, row["ideal"])
        say(f"{name}: PySINDy {_times(row['sparse']['size'], row['ideal'])} of the ideal limit")


def _drawn(name: str, at: dict[str, float], size: float, seed: int) -> tuple[Any, np.random.Generator]:
    rng = np.random.default_rng([seed, 3])
    return holding(name, at, size, rng), rng
