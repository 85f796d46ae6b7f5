"""Studies with a hidden effect: is it named?

    python pipelines/benchmarks/hidden_effect.py [--hidden 40] [--none 20] [--one-run] [--seed 0] [--workers 2]

Displacement tables of six runs (three speeds, one with double mass, two reversed), 3 % scatter of the dry friction,
10 um noise. One effect of size 5 % is hidden (15 % where only the comparison of runs shows it: slope, asymmetry;
measurement effects: rms of one sigma after what start and base model absorb). `--one-run` keeps the second run only.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

import frictrack as ft
from frictrack import effects, models
from frictrack.records import Displacement, Run
from frictrack.simulate.slide import Conditions, Slide, simulate

NOISE = 10e-6  # m
SCATTER = 0.03
FPS = 4000.0
PITCH = 0.5e-3  # m
HIDDEN = [
    *("drag", "vibration", "texture", "patch", "spring", "collision", "asymmetry", "slope"),
    *("load_modulation", "lens", "peak_locking", "camera_shake"),
]
BETWEEN_RUNS = {"slope", "asymmetry"}
SCALE = {"patch": "F", "spring": "k", "drag": "c", "slope": "F", "load_modulation": "depth", "lens": "k"}


@dataclass(frozen=True)
class Truth:
    """What one study hides."""

    effect: str | None
    values: dict[str, float]


def base_law(rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """A Tustin law, drawn."""
    return {
        "coulomb": {"F_c": rng.uniform(4, 10)},
        "stribeck": {"F_s": rng.uniform(2, 7), "v_s": rng.uniform(0.2, 0.8), "delta": 1.0},
        "viscous": {"F_v": rng.uniform(0.3, 1.5)},
    }


def shape_of(effect: str, rng: np.random.Generator, travel: float) -> dict[str, float]:
    """Parameters of a hidden effect at unit size."""
    phase = rng.uniform(-np.pi, np.pi)
    wave = {"amplitude": 1.0, "phase": phase}
    return {
        "drag": {"c": 1.0},
        "vibration": wave | {"frequency": rng.uniform(15, 100)},
        "texture": wave | {"period": rng.uniform(0.015, 0.08)},
        "patch": {"F": 1.0, "x_c": travel * rng.uniform(0.25, 0.75), "w": rng.uniform(0.008, 0.03)},
        "spring": {"k": 1.0, "x_0": 0.0},
        "collision": {"J": 1.0, "time": rng.uniform(0.03, 0.1), "width": rng.uniform(3e-4, 1e-3)},
        "asymmetry": {"dF": 1.0, "dF_v": 0.0},
        "slope": {"F": 1.0},
        "load_modulation": {"depth": 1.0, "phase": phase, "frequency": rng.uniform(15, 100)},
        "lens": {"k": 1.0, "x_c": travel * rng.uniform(0.2, 0.8)},
        "peak_locking": wave,
        "camera_shake": wave | {"frequency": rng.uniform(15, 100)},
    }[effect]


def make_study(seed: int, effect: str | None, *, one_run: bool = False) -> tuple[list[Run], Truth]:
    """Runs of one study and what they hide."""
    rng = np.random.default_rng([seed, 77])
    law, mass = base_law(rng), rng.uniform(0.25, 0.5)
    low = rng.uniform(2.0, 2.6)
    specs = [(low, 1), (low + 1.8, 1), (low + 3.6, 1), (low + 1.8, 2), (-low - 1.2, 1), (-low - 3.0, 1)]
    travel = 0.7
    shape = shape_of(effect, rng, travel) if effect else {}
    slides = [_slide(models.tustin(), law, mass, s, travel, 1.0) for s in specs]
    size = 0.0 if effect is None else _size(effect, shape, law, slides, specs, mass)
    runs = []
    for i, spec in enumerate(specs if not one_run else specs[1:2]):
        level = 1 + SCATTER * rng.standard_normal()
        model, values = models.tustin(), {k: dict(v) for k, v in law.items()}
        if effect is not None:
            model = model + effect
            values[effect] = _scaled(effect, shape, size, mass * spec[1] * abs(spec[0]), rng)
        slide = _slide(model, values, mass, spec, travel, level)
        runs.append(_run(f"r{i}", slide, mass * spec[1], rng))
    return runs, Truth(effect, _scaled(effect, shape, size, 1.0, rng) if effect else {})


def _slide(
    model: models.Model, values: Any, mass: float, spec: tuple[float, int], travel: float, level: float
) -> Slide:
    v, ratio = spec
    t = np.arange(int(0.16 * FPS)) / FPS
    conditions = Conditions(mass * ratio, load=ratio * level, mass_ratio=ratio, pixel_pitch=PITCH)
    return simulate(model, values, conditions, t, (0.0 if v > 0 else travel, v))


def _size(effect: str, shape: Any, law: Any, slides: list[Slide], specs: Any, mass: float) -> float:
    """Factor that brings the effect to its nominal size, from the base motion of all runs."""
    if effect == "collision":
        return 0.05  # of the momentum, run by run
    moving = [np.abs(s.v) > 0 for s in slides]
    made = effects.get(effect)
    friction = np.mean(np.concatenate([np.abs(s.F[m]) for s, m in zip(slides, moving, strict=True)]))
    blocks = []
    for slide, m, (v, ratio) in zip(slides, moving, specs, strict=True):
        s = np.full(m.sum(), np.sign(v))
        path = effects.Path(slide.t[m], slide.x[m], slide.v[m], s, ratio, ratio, PITCH)
        if made.modifies:
            blocks.append(np.abs(slide.F[m]) * np.sin(2 * np.pi * shape["frequency"] * slide.t[m]))
            continue
        columns = made.columns(path, shape)[:, 0]
        if made.acts_on == "measurement":
            dry = models.tustin().force_columns(path, law)
            trend = [np.ones(m.sum()), slide.t[m]]
            for column in dry.values():
                trend.append(np.cumsum(np.cumsum(column[:, 0])) / FPS**2)
            basis = np.linalg.qr(np.column_stack(trend))[0]
            columns = columns - basis @ (basis.T @ columns)
        blocks.append(columns)
    rms = np.sqrt(np.mean(np.concatenate(blocks) ** 2))
    if made.acts_on == "measurement":
        return float(NOISE / rms)
    return float((0.15 if effect in BETWEEN_RUNS else 0.05) * friction / rms)


def _scaled(effect: str, shape: Any, size: float, momentum: float, rng: np.random.Generator) -> dict[str, float]:
    values = dict(shape)
    name = {"collision": "J", "asymmetry": "dF"}.get(effect, SCALE.get(effect, "amplitude"))
    values[name] = size * (momentum if effect == "collision" else 1.0)
    if effect in ("vibration", "load_modulation", "camera_shake"):
        values["phase"] = float(rng.uniform(-np.pi, np.pi))
    return values


def _run(name: str, slide: Slide, mass: float, rng: np.random.Generator) -> Run:
    n = len(slide.t)
    nan = np.full(n, np.nan)
    x = slide.x + slide.shift + NOISE * rng.standard_normal(n)
    seen = np.ones(n, dtype=bool)
    disp = Displacement(slide.t, x, nan, nan, np.full(n, NOISE), nan, seen, pixel_pitch=PITCH)
    return Run(disp, ft.differentiate(ft.low_pass(disp)), mass=mass, name=name)


def judge(job: tuple[int, str | None, bool]) -> dict[str, Any]:
    """Make one study, diagnose it, and say how it went."""
    seed, effect, one_run = job
    runs, truth = make_study(seed, effect, one_run=one_run)
    start = time.perf_counter()
    diagnosis = ft.diagnose(ft.fit("tustin", runs), seed=seed)
    best = diagnosis.best
    named = best.effect if best is not None and diagnosis.verdict != "complete" else None
    group = [named, *(best.indistinguishable_from if best is not None else ())] if named else []
    return {
        "seed": seed,
        "truth": truth.effect,
        "verdict": diagnosis.verdict,
        "missing": diagnosis.missing,
        "group": group,
        "right": named == truth.effect if truth.effect is None or named is None else truth.effect in group[:3],
        "p_lof": diagnosis.p_lack_of_fit,
        "p": best.p if best else None,
        "after": best.heldout_after if best else None,
        "seconds": time.perf_counter() - start,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hidden", type=int, default=40)
    parser.add_argument("--none", type=int, default=20)
    parser.add_argument("--one-run", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", help="one effect alone")
    args = parser.parse_args()
    names = [args.only] if args.only else HIDDEN
    jobs = [(args.seed + i, names[i % len(names)], args.one_run) for i in range(args.hidden)]
    jobs += [(args.seed + 1000 + i, None, args.one_run) for i in range(args.none)]
    with ProcessPoolExecutor(args.workers) as pool:
        rows = []
        for row in pool.map(judge, jobs):
            rows.append(row)
            mark = "ok   " if row["right"] else "WRONG"
            print(
                f"{mark} {row['truth'] or 'nothing'!s:16} {row['verdict']:12} group {row['group']} "
                f"missing {row['missing']} p {row['p']} lof {row['p_lof']:.3f} {row['seconds']:.1f} s",
                flush=True,
            )
    hidden = [r for r in rows if r["truth"]]
    none = [r for r in rows if not r["truth"]]
    first = sum(bool(r["group"]) and r["group"][0] == r["truth"] for r in hidden)
    print(f"\nhidden: right {sum(r['right'] for r in hidden)} of {len(hidden)} (first {first})")
    alone = [r for r in hidden if r["verdict"] == "missing" and r["missing"][0] != r["truth"]]
    silent = sum(r["verdict"] == "complete" for r in hidden)
    print(f"a single wrong name: {len(alone)}; not seen (complete): {silent}")
    print(f"nothing hidden: complete {sum(r['verdict'] == 'complete' for r in none)} of {len(none)}")


if __name__ == "__main__":
    main()
