"""Draw a blind study, put one fault into it, and write it: tables or films, and a study file without the truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from frictrack.records import GRAVITY
from frictrack.simulate import Conditions
from frictrack.simulate.rendering import Camera, Rod, Target, render, write_film
from frictrack.validation.blind import (
    BLOCK_SIZE_PX,
    FULL_WELL_E,
    READ_NOISE_E,
    WALL,
    run_table,
    study_lines,
)
from frictrack.validation.blind import FILM_WIDTH_PX as FILM_WIDTH
from frictrack.validation.blind.truth import RunTruth, Truth
from frictrack.validation.blind.truth_sampling import MAX_DURATION_S, draw_truth
from reality.faults import FILMED, KINDS, NONE, Fault, draw_fault
from reality.spoil import Recorded, copied, lines_with_fault, with_fault

TURNED_HEIGHT, HEIGHT = 112, 72  # px; a turning block needs its diagonal
FRICTION = (0.1, 0.4)  # coefficients of friction on a slope
FRAMES_AFTER_STOP = 8  # frames after a stop
REFLECTANCE = (0.02, 0.6)  # of a rod


@dataclass(frozen=True)
class InclinedCase(Truth):
    """A blind truth on a course that rises toward +x by `incline`, rad."""

    incline: float = 0.0

    def conditions(self, run: RunTruth) -> Conditions:
        """What holds in a run."""
        return replace(super().conditions(run), incline=self.incline)


@dataclass(frozen=True)
class Case:
    """One study: its truth and its fault."""

    name: str
    truth: Truth
    fault: Fault


def planned(n: int, seed: int, only: str = "") -> list[tuple[int, str, str, int]]:
    """Seed, fault, kind of the hidden truth and turn of each of n studies; the first n do not depend on n."""
    out: list[tuple[int, str, str, int]] = []
    done: Counter[str] = Counter()
    block = 0
    while len(out) < n:
        rng = np.random.default_rng([seed, 19, block])
        faults = [kind for kind, about in KINDS.items() for _ in range(about.often) if only in ("", kind)]
        for fault in rng.permutation(faults).tolist():
            hidden = ("none", "one")[(done[fault] + list(KINDS).index(fault)) % 2] if fault != "incline" else "none"
            out.append((int(rng.integers(2**31)), fault, hidden, sum(done.values())))
            done[fault] += 1
        block += 1
    return out[:n]


def draw_case(name: str, seed: int, fault: str, hidden: str, turn: int) -> Case:
    """One study drawn: a blind truth, in which the fault is not hidden as an effect too, and a fault."""
    rng = np.random.default_rng([seed, 23])
    drawn = draw_fault(fault, ["placeholder"], rng)
    film = fault in FILMED or drawn.variant == "scale"
    for again in range(40):
        truth = draw_truth(seed, hidden, turn + again, film=film)
        if not set(truth.hidden) & set(drawn.allowed):
            break
    if fault == "incline":
        truth = inclined_case(truth, drawn.size, rng)
    return Case(name, truth, _placed(drawn, truth, rng))


def _placed(fault: Fault, truth: Truth, rng: np.random.Generator) -> Fault:
    """The fault in runs of the truth; a scale is that of all films.

    Masses that are all ten times off leave no trace where no force is known; a thousand times no laboratory has.
    """
    names = [run.name for run in truth.runs]
    if fault.kind == NONE:
        return fault
    in_all = fault.in_all or fault.variant == "scale"
    silent = fault.kind == "mass" and in_all and fault.variant in ("10", "0.1") and not truth.push
    runs = tuple(names) if in_all else (str(rng.choice(names)),)
    return replace(fault, in_all=in_all, runs=runs, visible=not silent)


def inclined_case(flat: Truth, degrees: float, rng: np.random.Generator) -> InclinedCase:
    """The same study on a slope, with less friction, so that gravity matters; runs last as long as they do there."""
    angle = float(np.radians(degrees) * rng.choice([-1, 1]))
    level = flat.mass * GRAVITY * float(np.cos(angle) * rng.uniform(*FRICTION))
    share = level / flat.law["coulomb"]["F_c"]
    sizes = {"coulomb": ("F_c",), "stribeck": ("F_s",), "viscous": ("F_v",), "drag": ("c",)}
    law = {e: {k: v * share if k in sizes[e] else v for k, v in own.items()} for e, own in flat.law.items()}
    known = {f.name: getattr(flat, f.name) for f in fields(Truth)}
    on = InclinedCase(**known | {"law": law, "push": 0.0, "lift": None, "clamp": None}, incline=angle)
    return replace(on, runs=tuple(replace(run, frames=_frames(on, run)) for run in on.runs))


def _frames(truth: Truth, run: RunTruth) -> int:
    """Frames until the mass leaves the course or has come to rest."""
    run = replace(run, frames=int(MAX_DURATION_S * truth.fps))
    trajectory = truth.trajectory(run)
    gone = np.flatnonzero(np.abs(trajectory.x - trajectory.x[0]) > truth.course)
    stops = np.flatnonzero(np.abs(trajectory.v) < 1e-9)
    return min(
        [run.frames, *(int(rows[0]) + more for rows, more in ((gone, 0), (stops, FRAMES_AFTER_STOP)) if len(rows))]
    )


def write_case(case: Case, folder: Path) -> Case:
    """Write a study with its fault; the case with the frames that the fault concerns."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([case.truth.seed, 29])
    fault, more = case.fault, []
    for run in case.truth.runs:
        if case.truth.film:
            filmed(case, run, folder / f"{run.name}.avi", rng)
            continue
        good = recorded(case.truth, run, rng)
        data, fault = with_fault(good, run.name, fault, rng)
        _write(data, folder / f"{run.name}.csv")
        if fault.kind == "copy" and run.name in fault.runs:
            _write(copied(good, fault, rng), folder / "again.csv")
            more = ["", "[[run]]", 'name = "again"', 'table = "again.csv"', *_own(case.truth, run)]
    lines = [*lines_with_fault(_lines(case), fault), *more]
    (folder / "study.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return replace(case, fault=replace(fault, runs=(*fault.runs, "again")) if more else fault)


def recorded(truth: Truth, run: RunTruth, rng: np.random.Generator) -> Recorded:
    """The table of one run as it should be."""
    trajectory = truth.trajectory(run)
    return Recorded(run_table(truth, run, rng), trajectory.x + trajectory.shift, truth.noise)


def _write(data: Any, path: Path) -> None:
    data.to_csv(path, index=False, float_format="%.9g")


def _own(truth: Truth, run: RunTruth) -> list[str]:
    """What the study file says of one run beside its name and its table."""
    mass = [f"mass = {truth.mass * run.mass_ratio:.6g}"] if run.mass_ratio != 1.0 else []
    return [*mass, *([f"clamp_x = {truth.clamp:.6g}"] if truth.clamp is not None else [])]


def _lines(case: Case) -> list[str]:
    """The study file; on a slope with the incline, wrong as the fault has it."""
    lines = list(study_lines(case.truth, case.name))
    truth = case.truth
    if not isinstance(truth, InclinedCase) or case.fault.variant == "not stated":
        return lines
    stated = np.degrees(truth.incline) * (-1 if case.fault.variant == "sign" else 1)
    heads = {f'name = "{run.name}"' for run in truth.runs}
    return [part for line in lines for part in ((line, f'incline = "{stated:.4g} deg"') if line in heads else (line,))]


def filmed(case: Case, run: RunTruth, path: Path, rng: np.random.Generator) -> None:
    """Render one run: a block before a still wall that turns, or passes behind a rod, as the fault has it."""
    truth, fault = case.truth, case.fault
    trajectory = truth.trajectory(run)
    turns = fault.kind == "rotation"
    height = TURNED_HEIGHT if turns else HEIGHT
    rate = np.radians(fault.size) * truth.fps * (1 if truth.seed % 2 else -1) if turns else 0.0
    place_at = CubicSpline(trajectory.t, (trajectory.x + trajectory.shift) / truth.pitch)

    def position(t: Any) -> tuple[Any, ...]:
        place = place_at(t), np.full(np.shape(t), height / 2 - 3)
        return (*place, run.phase + rate * np.asarray(t)) if turns else place

    camera = Camera(
        fps=truth.fps,
        width=FILM_WIDTH,
        height=height,
        scale=truth.pitch,
        exposure=0.0 if turns else 0.1,  # a flash: of a turned block every instant takes as long as a whole frame
        full_well=FULL_WELL_E,
        read_noise=READ_NOISE_E,
    )
    target = Target(*BLOCK_SIZE_PX, background=WALL, rod=_rod(case), course=not turns)
    write_film(render(position, camera, target, rng, n_frames=run.frames), path, truth.fps)


def _rod(case: Case) -> Rod | None:
    """The rod before the course, the same in all films."""
    if case.fault.kind != "occlusion":
        return None
    rng = np.random.default_rng([case.truth.seed, 31])
    middle = float(rng.uniform(0.35, 0.65)) * FILM_WIDTH
    return Rod(middle, case.fault.size, float(rng.uniform(*REFLECTANCE)))
