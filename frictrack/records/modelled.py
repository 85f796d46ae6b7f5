"""Records of what a model says: measurement and model of one run, and the modelled motion."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from frictrack.records.frame_table import Array, FrameTable, Mask, column


@dataclass(frozen=True, eq=False, repr=False)
class Curve(FrameTable):
    """Measurement and fitted model of one run, at the frames that were fitted (or predicted)."""

    signals: ClassVar[tuple[str, ...]] = ("x", "x_model")
    t: Array = column("s")
    x: Array = column("m")  # measured displacement
    sigma_x: Array = column("m")
    x_model: Array = column("m")  # fitted displacement, measurement effects included
    v_model: Array = column("m/s")
    a_model: Array = column("m/s^2")
    F_model: Array = column("N")
    run: str = "run"
    role: str = "fit"
    parts: dict[str, Array] = field(default_factory=dict)  # force of each effect, N
    repaired: NDArray[np.int8] | None = column(
        "", kind=np.int8, default=None
    )  # 0 as measured, 1 tracked again; None: no frame was repaired
    F_filtered: Array | None = column("N", default=None)  # F_model through the filter of the run; None if it has none

    @property
    def residual(self) -> Array:
        """Measured minus modelled displacement (n,), m."""
        return self.x - self.x_model

    @property
    def F_as_measured(self) -> Array:
        """Force of the model (n,), N, comparable with the measured one: through the same filter where that is known."""
        return self.F_model if self.F_filtered is None else self.F_filtered


@dataclass(frozen=True, eq=False, repr=False)
class ModelledMotion(FrameTable):
    """Motion of one run by the fitted model, at the frames that were fitted (or predicted).

    Standard deviations are those of the fit; mass and scale errors, common to all runs, are not included. They are NaN
    if the model is too far from the data to be linearised.
    """

    signals: ClassVar[tuple[str, ...]] = ("v",)
    t: Array = column("s")
    x: Array = column("m")  # of the slider, without measurement effects
    v: Array = column("m/s")
    a: Array = column("m/s^2")
    F: Array = column("N")
    sigma_x: Array = column("m", nan=True)
    sigma_v: Array = column("m/s", nan=True)
    sigma_a: Array = column("m/s^2", nan=True)
    sigma_F: Array = column("N", nan=True)
    blow: Mask = column("", kind=np.bool_)  # frames of a collision too short to be resolved: a and F are unknown there
    segment: NDArray[np.int_] = column("", kind=np.int_)  # number of the segment that a frame belongs to
    run: str = "run"
    role: str = "fit"
    notes: tuple[str, ...] = ()  # how the standard deviations were computed if the model lacks something
