"""The model of a target that a film has taught: template, fixed pattern, noise and systematic error."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from frictrack.records import Array
from frictrack.tracking.fixed_pattern import FixedPattern
from frictrack.tracking.template import Template


@dataclass(frozen=True, eq=False)
class TargetModel:
    """What the film has taught: the template, what stands still before it, and the usual misfit."""

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
