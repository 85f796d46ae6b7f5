"""Generalised Maxwell slip: elements in parallel, each elastic up to its own slip, so that loops lie within loops.

The force has a kink wherever an element slips. A fit to a measured friction force takes seconds; a fit to a film
integrates the motion through every kink and takes minutes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.effects.definition import Effect, Parameter
from frictrack.effects.in_study import EffectInStudy
from frictrack.effects.library.presliding import bending, quote
from frictrack.effects.path import Nonlinear, Path
from frictrack.effects.scans import breakaway_lengths
from frictrack.number_format import format_number
from frictrack.records import Array

N_ELEMENTS = 8  # with equal limits
SPREADS = np.array([1.5, 3.0, 10.0])
ELASTIC = 0.0  # exponent of an element: elastic up to slip


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns times the mean bending of the elements in the direction of motion, same shape as `inner`.

    `stiffness` is fitted as the length level/stiffness, m. It is the harmonic mean of the lengths over which the
    elements slip, since the stiffness of the unbent contact is the sum of theirs.
    """
    return inner * (path.s * np.mean(state(path, nonlinear, inner), axis=1))[:, None]


def state(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Bending of every element, -1 to 1, (n, N_ELEMENTS)."""
    ratios = _length_ratios(nonlinear["spread"])
    made = []
    for i, ratio in enumerate(ratios):
        own = path if path.begin is None else replace(path, begin=path.begin[:, i : i + 1])
        made.append(bending(own, nonlinear["stiffness"] * ratio, ELASTIC))
    return np.column_stack(made)


def _length_ratios(spread: float | Array) -> list[Array]:
    """Slip length of every element over the harmonic mean: evenly spaced logarithms, the ends apart by spread^2."""
    powers = np.linspace(-1.0, 1.0, N_ELEMENTS)
    lengths = [np.asarray(spread, dtype=float) ** power for power in powers]
    mean = N_ELEMENTS / sum(1.0 / length for length in lengths)
    return [np.asarray(length / mean) for length in lengths]


def describe(effect: EffectInStudy) -> str:
    """How far the elements differ."""
    return f"elements that slip over lengths up to {format_number(effect.value('spread') ** 2)} times as long as others"


generalised_maxwell_slip = Effect(
    name="generalised_maxwell_slip",
    acts_on="force",
    equation="coulomb + stribeck times mean(w_i) sgn v, dw_i/dt = v/length_i up to |w_i| = 1; sum of the stiffness, "
    "lengths over a range of spread^2",
    parameters=(
        Parameter("stiffness", "N/m", (1e-9, np.inf), scan=breakaway_lengths),
        Parameter("spread", "1", (1.0, 100.0), scan=lambda span: SPREADS),
    ),
    columns=columns,
    state=state,
    modifies=frozenset({"coulomb", "stribeck"}),
    replaces=frozenset({"presliding"}),
    scales_with="load",
    memory=True,
    turns=True,
    rank=1,
    what="Asperities of different stiffness bend and slip one after another.",
    looks_like="a loop against x after every reversal; a reversal within the loop closes where it began",
    mistaken_for="presliding, as long as no reversal lies within the loop of another one",
    confirm="Reverse twice within the breakaway length: the small loop closes, and the large one goes on as before.",
    invariant="nested loops need a reversal within the breakaway length",
    source="Al-Bender, Lampaert & Swevers 2005, IEEE Trans. Automatic Control 50, 1883, with equal limits, lengths "
    "evenly spaced in their logarithm, and slip at the level of the moment",
    describe=describe,
    quote=quote,
)
