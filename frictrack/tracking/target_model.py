"""The model of a target learnt from a film: template, fixed pattern, noise and systematic error."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from frictrack.records import Array
from frictrack.tracking.fixed_pattern import FixedPattern
from frictrack.tracking.template import Template


@dataclass(frozen=True, eq=False)
class TargetModel:
    """What a film has taught about its target.

    Attributes
    ----------
    template : Template
        Band-limited picture of the target and the weights of its pixels.
    pattern : FixedPattern or None
        Flat-field errors, dirt and obstacles that stand still in the picture.
    typical_misfit : float
        Median misfit of a frame; NaN before it is known.
    sigma_inflation : array (3,)
        Factors on the standard deviations of x, y and the angle for correlated residuals (`position_errors`).
    systematic_covariance : array (2, 2)
        Covariance of slow position errors from a changing appearance, px^2.
    rotates : bool
        Whether the target rotates by more than small angles.

    """

    template: Template
    pattern: FixedPattern | None = None
    typical_misfit: float = np.nan  # nan: that of the frames at hand
    sigma_inflation: Array = field(
        default_factory=lambda: np.ones(3)
    )  # of the standard deviations, see `position_errors`
    systematic_covariance: Array = field(
        default_factory=lambda: np.zeros((2, 2))
    )  # px^2, of what the target's changing look adds
    rotates: bool = False  # the target turns by more than small rotations
