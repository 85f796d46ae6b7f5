"""Draw studies with one small effect, diagnose them, and count what frictrack and the ideal detector name."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from diagnosis.studies import recorded

import frictrack as ft
from frictrack.validation.blind.truth import Truth
from frictrack.validation.blind.truth_sampling import draw_truth, effects_in_order
from small_signals.ideal import name_ideally

EFFECTS = ("stribeck", "viscous", "drag", "texture", "patch", "vibration", "beam_vibration", "load_modulation", "slope",
           "asymmetry", "thermal", "camera_shake")  # fmt: skip
SIZES = (1.0, 1.5)  # over the limit of the ideal detector
SIZE_TOLERANCE = 1.0001
MAX_SEEDS = 20  # tried until a study can hide the effect at this size

Tell = Callable[[str], None]


def studies(name: str, size: float, n: int, seed: int) -> Iterator[Truth]:
    """Draw `n` studies that hide one effect at a multiple of the ideal limit."""
    turn, found = effects_in_order("one").index(name), 0
    for k in range(n * MAX_SEEDS):
        truth = draw_truth(1000 * seed + k, "one", turn, sizes=(size, size * SIZE_TOLERANCE))
        if truth.hidden == (name,):
            yield truth
            found += 1
        if found == n:
            return


def one_study(truth: Truth) -> dict[str, Any]:
    """Diagnose one study with one hidden effect, and compare with the ideal detector."""
    (name,) = truth.hidden
    fit = ft.fit(list(truth.model), recorded(truth, np.random.default_rng([truth.seed, 7])))
    begin = time.process_time()
    found = ft.diagnose(fit, rng=truth.seed, quick=True)
    seconds = time.process_time() - begin
    group = named_group(found)
    p = {c.effect: c.p for c in found.candidates}
    return {
        "effect": name,
        "size": truth.size[0],
        "seed": truth.seed,
        "law": list(truth.model),
        "verdict": found.verdict,
        "missing": found.missing,
        "group": group,
        "p": p.get(name),
        "detected": p.get(name, 1.0) < found.alpha / 2,
        "first": found.missing[:1] == [name],
        "named": name in group,
        "false": [n for n in found.missing[1:] if n != name],
        "ideal": asdict(name_ideally(truth, fit.solution)),
        "cpu_s": seconds,
    }


def named_group(found: Any) -> list[str]:
    """The effect named first, and those stated as indistinguishable from it."""
    first = next((c for c in found.candidates if c.effect in found.missing[:1]), None)
    return [] if first is None else [first.effect, *first.indistinguishable_from]


def empty_study(seed: int) -> dict[str, Any]:
    """Diagnose one study that hides nothing."""
    truth = draw_truth(seed, "none")
    fit = ft.fit(list(truth.model), recorded(truth, np.random.default_rng([seed, 7])))
    begin = time.process_time()
    found = ft.diagnose(fit, rng=seed, quick=True)
    return {
        "seed": seed,
        "verdict": found.verdict,
        "missing": found.missing,
        "p": min((c.p for c in found.candidates), default=1.0),
        "significant": {c.effect: c.delta_bic for c in found.candidates if c.p < found.alpha / 2},
        "p_lack_of_fit": found.p_lack_of_fit,
        "cpu_s": time.process_time() - begin,
    }


def table(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Counts by effect and size; the last rows are the sums over all effects."""
    out = []
    for size in sorted({round(r["size"], 2) for r in rows}):
        here = [r for r in rows if round(r["size"], 2) == size]
        for name in [*dict.fromkeys(r["effect"] for r in here), "all"]:
            own = [r for r in here if name in (r["effect"], "all")]
            out.append({"effect": name, "size": size, **_counts(own)})
    return out


def _counts(own: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How many studies of a list are detected and named, by frictrack and by the ideal detector."""
    counts = {key: sum(bool(r[key]) for r in own) for key in ("detected", "first", "named", "false")}
    ideal = {f"ideal_{key}": sum(r["ideal"][key] for r in own) for key in ("detected", "first", "named")}
    ratio = counts["named"] / ideal["ideal_named"] if ideal["ideal_named"] else None
    return {"studies": len(own), **counts, **ideal, "ratio": ratio}


def overview(rows: Sequence[dict[str, Any]]) -> str:
    """The table as text."""
    heads = ("studies", "detected", "ideal_detected", "first", "ideal_first", "named", "ideal_named", "false", "ratio")
    lines = ["{:>5} {:18}".format("size", "effect") + " ".join(f"{h:>14}" for h in heads)]
    for row in rows:
        cells = ("-" if row[h] is None else f"{row[h]:.2f}" if h == "ratio" else str(row[h]) for h in heads)
        lines.append(f"{row['size']:5.2f} {row['effect']:18}" + " ".join(f"{c:>14}" for c in cells))
    return "\n".join(lines)


def measure(effects: Sequence[str], sizes: Sequence[float], n: int, seed: int, tell: Tell) -> list[dict[str, Any]]:
    """Score `n` studies of every effect and size; one line for each is told."""
    rows = []
    for name in effects:
        for size in sizes:
            for truth in studies(name, size, n, seed):
                rows.append(row := one_study(truth))
                ideal = row["ideal"]
                tell(
                    f"{name} {size:g} seed {truth.seed}: {row['verdict']} {'+'.join(row['missing'])} "
                    f"group {','.join(row['group'])} p={row['p']}; ideal {ideal['best']} "
                    f"{'detected' if ideal['detected'] else 'not detected'}, equivalents "
                    f"{','.join(ideal['equivalents'])}; {row['cpu_s']:.1f} s"
                )
    return rows
