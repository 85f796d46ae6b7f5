"""Measure how many of the effects added in whole sessions are false: diagnose, add, try alternatives, diagnose again.

    python pipelines/benchmarks/sessions [--n 100] [--seed 0] [--additions 6] [--ideas 0] [--json FILE]

Every session works on a simulated study with nothing, one or two effects hidden. A simulated user diagnoses and adds
the first effect that is named. When nothing is named, the user tries again: the same model with another seed or, in
the share `ideas` of the cases, with a random effect added. The session ends after so many additions, or six diagnoses.
An effect that was named and added is false if it is neither hidden nor fits the same data as well as a hidden one.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402
from machine import described  # noqa: E402

from frictrack.base.errors import FrictrackError  # noqa: E402
from frictrack.flow import Session, open_study  # noqa: E402
from frictrack.validation.blind import write_study  # noqa: E402
from frictrack.validation.blind.outcome import equivalent_effects  # noqa: E402
from frictrack.validation.blind.truth import Truth  # noqa: E402
from frictrack.validation.blind.truth_sampling import candidates, draw_truth  # noqa: E402

KINDS = ("none", "one", "two")
MAX_DIAGNOSES = 6


@dataclass
class Outcome:
    """What happened in one session."""

    seed: int
    hidden: tuple[str, ...]
    added: list[str]
    false: list[str]
    diagnoses: int
    alpha_spent: float
    seconds: float


def acceptable_effects(truth: Truth, session: Session) -> set[str]:
    """Hidden effects, and those that fit the same data as well."""
    if not truth.hidden:
        return set()
    solution = session.models.fit(session.models.current()[0]).solution
    return {name for group in equivalent_effects(truth, solution).values() for name in group}


def play(truth: Truth, folder: Path, limits: tuple[int, float], rng: np.random.Generator) -> Outcome:
    """Play one session; `limits` is (additions, share of ideas)."""
    additions, ideas = limits
    write_study(truth, folder)
    session, begun = Session(open_study(folder / "study.toml")), time.process_time()
    session.fit()
    accepted = acceptable_effects(truth, session)
    added, false, seed, diagnoses = [], [], 0, 0
    while diagnoses < MAX_DIAGNOSES and len(added) < additions:
        diagnoses += 1
        found = session.diagnose(seed, quick=True)
        if named := [*found["missing"], *found["leads"]]:
            name = named[0]
            session.add(name)
            added.append(name)
            if name.split(":")[0] not in accepted:
                false.append(name)
        elif rng.uniform() < ideas:
            add_random(session, truth, rng)
        else:
            seed += 1
    spent = session.budget.summary()["alpha_spent"]
    return Outcome(truth.seed, truth.hidden, added, false, diagnoses, spent, time.process_time() - begun)


def add_random(session: Session, truth: Truth, rng: np.random.Generator) -> None:
    """Add an effect that was not named, as a user would who tries an idea."""
    _, request = session.models.current()
    model = request.model(session.study.effects).names
    free = [name for name in candidates("one", truth.model) if name not in model]
    for name in rng.permutation(free):
        try:
            session.add(str(name))
        except FrictrackError:
            continue
        return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--additions", type=int, default=6)
    parser.add_argument("--ideas", type=float, default=0.0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    outcomes: list[Outcome] = []
    for k in range(args.n):
        rng = np.random.default_rng([args.seed, k])
        truth = draw_truth(int(rng.integers(2**31)), KINDS[k % len(KINDS)], k // len(KINDS))
        with tempfile.TemporaryDirectory() as folder:
            outcomes.append(play(truth, Path(folder) / "study", (args.additions, args.ideas), rng))
        one = outcomes[-1]
        print(f"{k + 1:3d} hidden {', '.join(one.hidden) or 'nothing'}: added {', '.join(one.added) or 'nothing'}; "
              f"false {', '.join(one.false) or 'none'}; {one.diagnoses} diagnoses, "
              f"alpha {one.alpha_spent:.4f}, {one.seconds:.0f} s", flush=True)  # fmt: skip
    print(json.dumps(totals(outcomes)))
    if args.json:
        made = {"machine": described("numpy", "scipy"), **totals(outcomes), "sessions": [asdict(o) for o in outcomes]}
        args.json.write_text(json.dumps(made, indent=1) + "\n")


def totals(outcomes: list[Outcome]) -> dict[str, Any]:
    """Additions and false ones, of all sessions."""
    return {
        "n": len(outcomes),
        "diagnoses": sum(o.diagnoses for o in outcomes),
        "additions": sum(len(o.added) for o in outcomes),
        "false_additions": sum(len(o.false) for o in outcomes),
        "sessions_with_a_false_addition": sum(bool(o.false) for o in outcomes),
        "alpha_spent_max": max(o.alpha_spent for o in outcomes),
    }


if __name__ == "__main__":
    main()
