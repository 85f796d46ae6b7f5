"""Compare errors with their stated deviations: rms z of x, v, a and F for every filter, in the middle and at the ends.

z is 1 where the deviations are true. `F` is the friction force of a run of known mass. The middle leaves out 5 % of the
record at either end, and 2 ms about a jump, which no frames resolve. Errors are correlated over a period of the
cut-off, so that few of them are independent at the ends: a value counts as outside only by more than two of its own
standard errors, from the scatter over the seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product

import numpy as np

import frictrack as ft
from frictrack.records import Displacement
from frictrack.settings.filters import FilterChoice

from .measures import parts
from .run import measured
from .signals import MASS, Array, Signal, signal

MOTIONS = ("plain", "push", "texture", "vib", "coll")  # a slide, as in a film, texture, vibration, collision
NOISES = (1e-6, 3e-6, 1e-5)  # m
FILTERS = {
    "structural": FilterChoice(),
    "low-pass": FilterChoice(cutoff=130.0),
    "kalman": FilterChoice("kalman"),
    "butterworth": FilterChoice("butterworth"),
    "savitzky-golay": FilterChoice("savitzky-golay"),
    "gaussian-process": FilterChoice("gaussian-process"),
    "papers": FilterChoice("papers"),
}
LOW, HIGH = 0.8, 1.25  # of a true deviation
CHANCE_SIGMAS = 2.0  # standard errors by which a value is outside


def scores(truth: Signal, noise: float, choice: FilterChoice, seed: int) -> Array:
    """Error over deviation of x, v, a and F, (4, n)."""
    none, n = np.full(len(truth.t), np.nan), len(truth.t)
    y = measured(truth, noise, seed)
    seen = Displacement(truth.t, y, none, none, np.full(n, noise), none, np.ones(n, dtype=bool))
    m = ft.differentiate(ft.low_pass(seen, method=choice))
    force = ft.friction(ft.Run(seen, m, mass=MASS, free=(truth.t[0], truth.t[-1])))
    pairs = ((m.x, m.sigma_x), (m.v, m.sigma_v), (m.a, m.sigma_a), (force.F, force.sigma_F))
    true = (*truth[2:5], -MASS * truth.a)
    return np.array([(value - one) / sigma for (value, sigma), one in zip(pairs, true, strict=True)])


def rows(seeds: int, motions: Sequence[str] = MOTIONS) -> Iterator[tuple[str, float, str, Array, Array]]:
    """Yield motion, noise, filter, rms z (2, 4) and its standard error: middle and ends, of x, v, a and F."""
    for name, noise in product(motions, NOISES):
        truth = signal(name)
        where = parts(truth)
        places = (where["mid"] & ~where["near"], (where["first"] | where["last"]) & ~where["near"])
        for title, choice in FILTERS.items():
            z = np.array([scores(truth, noise, choice, seed) for seed in range(seeds)])
            squares = np.array([np.mean(z[..., rows] ** 2, axis=2) for rows in places])  # (2, seeds, 4)
            rms = np.sqrt(np.mean(squares, axis=1))
            yield name, noise, title, rms, np.std(squares, axis=1, ddof=1) / np.sqrt(seeds) / (2.0 * rms)


def table(seeds: int, say: Callable[[str], None]) -> None:
    """Print the table, with a star where a deviation is not true, and how many are."""
    true = total = 0
    say(f"{'z of':44}" + "".join(f"{q + ' ' + place:>9}" for place in ("mid", "end") for q in "xvaF"))
    for name, noise, title, z, error in rows(seeds):
        holds = (z + CHANCE_SIGMAS * error >= LOW) & (z - CHANCE_SIGMAS * error <= HIGH)
        true, total = true + int(np.sum(holds)), total + z.size
        cells = (f"{value:8.2f}{' ' if ok else '*'}" for value, ok in zip(z.ravel(), holds.ravel(), strict=True))
        say(f"{name:12}{1e6 * noise:4.0f} um  {title:25}" + "".join(cells))
    say(f"{true} of {total} between {LOW} and {HIGH}, within {CHANCE_SIGMAS:g} standard errors")
