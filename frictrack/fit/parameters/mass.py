"""Fit an unknown mass: where the drive is measured, 1/m is one more linear coefficient.

The equation of motion is written in units of a guessed mass m_ref:

    m_ref x'' = q D - q F + m_ref g,     q = m_ref/m,     g the gravity along the track, independent of the mass

So q - 1 multiplies the drive, and every force coefficient is fitted as q times itself. After the fit m_ref is set to
the fitted mass: then q = 1, and all values are in kilograms and newtons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, Nonlinear, Parameter, Path
from frictrack.effects.models import Model
from frictrack.fit.parameters.constraints import MASS
from frictrack.fit.parameters.layout import ParameterLayout
from frictrack.records import Array, Run

MIN_MASS_RATIO = 1e-6  # q at the largest mass that is searched


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Return -D, shape (n, 1): N per unit of q - 1; zero without a drive."""
    return -(np.zeros_like(path.t) if path.drive is None else path.drive)[:, None]


MASS_EFFECT = Effect(
    name=MASS,
    acts_on="force",
    equation="",
    parameters=(Parameter("m", "kg", (MIN_MASS_RATIO - 1.0, np.inf), linear=True),),
    columns=columns,
    varies_with="",
    what="The mass that slides, where it was not weighed but the drive was measured.",
)


def is_mass_unknown(runs: Sequence[Run]) -> bool:
    """Return whether the mass of these runs is to be fitted.

    Raises
    ------
    FrictrackError
        If the mass cannot be fitted: no measured drive, or only some runs have a mass.

    """
    unknown = [r.name for r in runs if r.mass is None]
    undriven = [r.name for r in runs if r.mass is None and r.drive is None]
    if undriven:
        raise FrictrackError(
            f'run "{undriven[0]}": expected a mass for a fit of the displacement but got none, and without a measured '
            "drive force and mass scale together: weigh the slider and give mass, or measure the drive"
        )
    if unknown and len(unknown) < len(runs):
        raise FrictrackError(
            f"expected one mass to be fitted for all runs but only {', '.join(unknown)} of {len(runs)} runs leave it "
            "open; leave it open for all, or weigh these too"
        )
    return bool(unknown)


def with_mass(model: Model) -> Model:
    """Add the mass to the unknowns of a model.

    Raises
    ------
    FrictrackError
        (usage) For bounds in newtons, which cannot be applied before the mass is known.

    """
    for effect in (e for e in model.effects if e.acts_on == "force"):
        for p in effect.linear:
            if any(np.isfinite(b) and b != 0 for b in p.bounds):
                raise FrictrackError(
                    f"expected no bounds of {effect.name}.{p.name} where the mass is fitted too: forces are known "
                    f"only with it; give prior = {{{p.name} = [mean, std]}} instead, or fix it",
                    usage=True,
                )
    return Model((*model.effects, MASS_EFFECT))


def without_mass(model: Model) -> Model:
    """Return the model without the mass among its effects."""
    return Model(tuple(e for e in model.effects if e.name != MASS))


def rescale_to_mass(layout: ParameterLayout, p: Array, q: float) -> Array:
    """Convert unknowns p (P,) to a unit of mass that is q times smaller."""
    out = np.array(p, dtype=float)
    forces = {e.name for e in layout.model.effects if e.acts_on == "force"}
    for i, s in enumerate(layout.slots):
        if s.effect == MASS:
            out[i] = (1.0 + p[i]) / q - 1.0
        elif s.linear and s.effect in forces:
            out[i] = p[i] / q
    return out


def with_fitted_mass(run: Run, mass: float) -> Run:
    """Return the run with the fitted mass (kg) if it had none."""
    return run if run.mass is not None or run.drive is None else replace(run, mass=mass)
