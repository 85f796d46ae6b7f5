"""The conditions of one simulated run, and the drive force of a short push."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.effects import Path
from frictrack.records import GRAVITY, Array, EarlierRuns


@dataclass(frozen=True)
class Conditions:
    """Conditions of one simulated run.

    Functions of time take t (n,), s since release, and return (n,).

    Attributes
    ----------
    mass
        Mass of the slider, kg.
    load, mass_ratio
        Normal load and mass, each over its reference.
    pixel_pitch
        Object size of one pixel, m; None where no camera is simulated.
    incline
        Angle by which the course rises toward +x, rad.
    drive
        Drive force, N; None for none.
    lift
        Vertical acceleration, m/s^2, positive upward; None for none.
    angle
        Angle of the target, rad, counter-clockwise; None for none.
    clamp_x, beam_length
        Place of the clamp and length of the beam under the course, m.
    earlier
        For every run before, the rest since its end (s) and the distance slid in it (m); None where it is not known.

    """

    mass: float
    load: float = 1.0
    mass_ratio: float = 1.0
    pixel_pitch: float | None = None
    incline: float = 0.0
    drive: Callable[[Array], Array] | None = None
    lift: Callable[[Array], Array] | None = None
    angle: Callable[[Array], Array] | None = None
    clamp_x: float | None = None
    beam_length: float | None = None
    earlier: EarlierRuns | None = None

    def path(self, x: Array, v: Array, t: Array, s: float) -> Path:
        """Path of a motion x (m), v (m/s), t (s), each (n,), in direction s (1 or -1) under these conditions."""
        return Path(
            t=t,
            x=x,
            v=v,
            s=np.full(np.shape(t), s),
            load=self.load,
            mass_ratio=self.mass_ratio,
            mass=self.mass,
            pixel_pitch=self.pixel_pitch,
            drive=None if self.drive is None else self.drive(t),
            drive_at=self.drive,
            lift=None if self.lift is None else self.lift(t),
            gravity=GRAVITY * float(np.cos(self.incline)),
            angle=None if self.angle is None else self.angle(t),
            clamp_x=self.clamp_x,
            beam_length=self.beam_length,
            earlier=None if self.earlier is None else (self.earlier,),
        )


def push_force(mass: float, speed: float, duration: float) -> Callable[[Array], Array]:
    """Drive force of a smooth push that brings a mass from rest to a speed where there is no friction.

    Parameters
    ----------
    mass
        Mass, kg.
    speed
        Speed after the push, m/s; negative toward -x.
    duration
        Time from 0 during which the force acts, s.

    Returns
    -------
    callable
        Function of t (n,), s, that returns the force (n,), N: a squared sine over the duration, else 0.

    Examples
    --------
    >>> force = push_force(0.5, 4.0, 0.01)
    >>> force(np.array([0.0, 0.005, 0.02])).round(9).tolist()
    [0.0, 400.0, 0.0]

    """

    def force(t: Array) -> Array:
        phase = np.clip(np.asarray(t) / duration, 0.0, 1.0)
        return np.asarray(2 * mass * speed / duration * np.sin(np.pi * phase) ** 2)

    return force
