"""Compare errors with their stated deviations where a force has a clock of its own: rms z of F and of the law.

    OMP_NUM_THREADS=1 python pipelines/benchmarks/driven.py [--seeds 12] [--only WORD,WORD]

A mass slides under Coulomb and viscous friction, integrated by SciPy. Positions come at one rate, a force sensor at
another, at a random phase: a `drive` that pushes the mass, or the `friction` that a load cell under the course
measures. Noise of the sensor is a share of the mean force. An `amplifier` is a low-pass (Butterworth, of first or
second order) that the force went through before it was sampled; noise is added before it (`inner`) or after (`outer`).
Positions of a `coast` are rounded to a step, with noise of 2 % of it.

z is an error over its stated deviation: of x, v and F over the free section, and of the law's two parameters, F_c and
F_v. Deviations are true where z is 1, and too small where it is more. chi2: median of the reduced chi-squared. The
error of rounding depends on the motion: few seeds of one motion scatter by more than the standard error that counts.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import butter, lfilter

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study
from frictrack.records import Array, Run

MASS, F_C, F_V = 0.4, 0.8, 0.6  # kg, N, N s/m
TRUTH = {"coulomb.F_c": F_C, "viscous.F_v": F_V}
MODEL = list(effect.split(".")[0] for effect in TRUTH)
FINE = 20_000.0  # Hz, at which an amplifier acts
LOW, HIGH = 0.8, 1.25  # of a true deviation


@dataclass(frozen=True)
class Case:
    """What is measured: `kind` is drive, friction or coast, rates in Hz, noise as a share of the force, m, and m."""

    kind: str
    rate: float  # of the positions
    of_force: float = 0.0  # rate of the sensor; 0 for that of the positions
    noise: float = 0.02
    sigma: float = 1e-5  # of the positions
    step: float = 0.0  # of rounded positions
    amplifier: float = 0.0  # Hz
    order: int = 1
    inner: bool = False  # whether the noise passes the amplifier
    duration: float = 1.0

    @property
    def model(self) -> list[str]:
        """The law, and the lag of a cell behind an amplifier, which a diagnosis names."""
        return [*MODEL, "cell_lag"] if self.kind == "friction" and self.amplifier else MODEL

    def __str__(self) -> str:
        words = [self.kind, f"{self.rate:g} Hz"]
        if self.kind != "coast":
            words += [f"force {self.of_force or self.rate:g} Hz", f"{100 * self.noise:g} %"]
        if self.amplifier:
            words.append(f"amplifier {self.amplifier:g} Hz x{self.order} {'inner' if self.inner else 'outer'}")
        words.append(f"step {1e6 * self.step:g} um" if self.step else f"{1e6 * self.sigma:g} um")
        return ", ".join(words)


def push(t: Array | float, k: int, case: Case) -> Array:
    """Drive (N) of run k at times (s)."""
    if case.kind == "coast":
        return 0.0 * np.asarray(t)
    return np.asarray(2.2 + 0.1 * k + 0.5 * np.sin(2 * np.pi * (3 + k) * t + k))


def motion(k: int, case: Case, seed: int, t: Array) -> tuple[Array, Array]:
    """Position and velocity of run k at times (n,); its start differs by a few per cent from seed to seed."""
    place, factor = np.random.default_rng((seed, k)).uniform((0.0, 0.97), (0.01, 1.03))

    def slope(at: float, y: Array) -> list[float]:
        return [y[1], (float(push(at, k, case)) - F_C - F_V * y[1]) / MASS]

    v0 = factor * (2.6 + 0.5 * k if case.kind == "coast" else 0.2 + 0.05 * k)
    x, v = solve_ivp(slope, (0, t[-1]), [place, v0], t_eval=t, rtol=1e-10, atol=1e-12, max_step=0.02).y
    return x, v


def measured(case: Case, k: int, seed: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Times and positions, times and forces of run k."""
    t, rng = np.arange(round(case.duration * case.rate)) / case.rate, np.random.default_rng((seed, k, 1))
    x = motion(k, case, seed, t)[0] + case.sigma * rng.standard_normal(len(t))
    x = np.round(x / case.step) * case.step if case.step else x
    if case.kind == "coast":
        return (t, x), (t, np.zeros(len(t)))
    rate = case.of_force or case.rate
    u = (np.arange(np.ceil(case.duration * rate) + 2) - rng.random()) / rate
    lead = 20.0 / case.amplifier if case.amplifier else 0.0
    fine = np.arange(round((u[0] - lead) * FINE), round(u[-1] * FINE) + 2) / FINE

    def force(at: Array) -> Array:
        if case.kind == "drive":
            return push(at, k, case)
        inside = np.clip(at, 0.0, case.duration)
        grid = np.linspace(0.0, inside[-1], max(round(inside[-1] * 4000), 2))
        return F_C + F_V * np.interp(inside, grid, motion(k, case, seed, grid)[1])

    size = case.noise * float(np.mean(force(u)))
    if not case.amplifier:
        return (t, x), (u, force(u) + size * rng.standard_normal(len(u)))
    inner = case.inner * size * np.sqrt(FINE / rate) * rng.standard_normal(len(fine))
    passed = (
        lfilter(*butter(case.order, case.amplifier, fs=FINE), force(fine) + inner - force(fine)[0]) + force(fine)[0]
    )
    values = np.interp(u, fine, passed) + (not case.inner) * size * rng.standard_normal(len(u))
    return (t, x), (u, values)


def runs_of(case: Case, seed: int, folder: Path, count: int = 2) -> list[Run]:
    """Runs as a study file makes them; those of one clock from arrays."""
    lines = ["[study]", f"mass = {MASS}"]
    for k in range(count):
        (t, x), (u, force) = measured(case, k, seed)
        column = {"drive": "drive_N", "friction": "friction_N"}.get(case.kind, "")
        np.savetxt(folder / f"x{k}.csv", np.c_[t, x.round(9)], delimiter=",", header="t_s,x_m", comments="", fmt="%.9f")
        np.savetxt(folder / f"f{k}.csv", np.c_[u, force], delimiter=",", header=f"t_s,{column}", comments="")
        lines += ["[[run]]", f'name = "r{k}"', f'table = "x{k}.csv"', f"free = [0, {case.duration}]"]
        if column:
            key = "drive" if case.kind == "drive" else "sensor"
            lines.append(f'{key} = {{table = "f{k}.csv", offset = 0.0}}')
    (folder / "study.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [pipeline.to_run() for pipeline in Session(open_study(folder / "study.toml")).runs]


def scores(case: Case, seed: int, folder: Path) -> tuple[Array, float]:
    """z of x, v, F (rms over the runs), of F_c and F_v; reduced chi-squared."""
    runs = runs_of(case, seed, folder)
    squares = []
    for k, run in enumerate(runs):
        x, v = motion(k, case, seed, run.motion.t)
        rows, force = ft.free_section(run)[0], ft.friction(run)
        truth = F_C + F_V * v
        pairs = ((run.motion.x, x, run.motion.sigma_x), (run.motion.v, v, run.motion.sigma_v))
        pairs += ((force.F, truth, force.sigma_F),)
        squares.append([np.mean(((m - true) / sigma)[rows] ** 2) for m, true, sigma in pairs])
    found = ft.fit(case.model, runs)
    p = found.parameters
    law = [(p[name].value - true) / p[name].std for name, true in TRUTH.items()]
    return np.append(np.sqrt(np.mean(squares, axis=0)), law), found.reduced_chi2


def cases() -> Iterator[Case]:
    """The rows of the table."""
    for kind in ("drive", "friction"):
        for rate, of_force in ((200.0, 25.0), (200.0, 100.0), (200.0, 1000.0), (1000.0, 250.0), (4000.0, 1000.0)):
            yield from (Case(kind, rate, of_force, noise, duration=1.0) for noise in (0.005, 0.02, 0.05))
        yield Case(kind, 4000.0, 25.0, 0.02)
        yield Case(kind, 500.0, 500.0, 0.02)
        for amplifier in (20.0, 60.0, 200.0):
            yield from (Case(kind, 1000.0, 1000.0, 0.005, amplifier=amplifier, inner=inner) for inner in (False, True))
            yield Case(kind, 1000.0, 1000.0, 0.02, amplifier=amplifier, order=2)
        yield Case(kind, 500.0, 100.0, 0.005, amplifier=20.0)
    for step in (1e-6, 1e-5, 1e-4, 1e-3):
        for rate in (100.0, 200.0, 1000.0, 4000.0):
            yield Case("coast", rate, step=step, sigma=0.02 * step, duration=0.5)
        yield Case("drive", 200.0, 200.0, 0.0, step=step, sigma=0.02 * step)


def main() -> None:
    """Print the table, with a star where a deviation is not true."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--only", default="", help="rows that hold all of these words")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{'z of':62}{'x':>7}{'v':>7}{'F':>7}{'F_c':>7}{'F_v':>7}{'worst':>7}{'chi2':>8}")
    for case in cases():
        if not all(word in str(case) for word in args.only.split(",")):
            continue
        found, failed = [], 0
        for seed in range(args.seeds):
            try:
                with tempfile.TemporaryDirectory() as folder:
                    found.append(scores(case, seed, Path(folder)))
            except (FrictrackError, ZeroDivisionError, TypeError) as error:
                failed += 1
                print(type(error).__name__, str(error)[:100], file=sys.stderr)
        if not found:
            continue
        z = np.array([one for one, _ in found])
        rms = np.sqrt(np.mean(z**2, axis=0))
        chance = 2.0 / np.sqrt(2.0 * len(z))  # two standard errors, relative
        wrong = (rms * (1 + chance) < LOW) | (rms * (1 - chance) > HIGH)
        cells = "".join(f"{value:6.2f}{'*' if bad else ' '}" for value, bad in zip(rms, wrong, strict=True))
        chi2 = np.median([one for _, one in found])
        print(
            f"{case!s:62}{cells}{np.max(np.abs(z[:, 3:])):6.1f} {chi2:8.2f}{f' {failed} failed' * (failed > 0)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
