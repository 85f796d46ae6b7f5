"""Estimate the noise of a displacement series: its white level, and correlation between neighbouring frames."""

from frictrack.motion.noise.correlated import CorrelatedNoise, NoiseStretch, correlated_noise, suspected_noise
from frictrack.motion.noise.white import (
    CORRELATION_COST,
    DIFFERENCE_ORDER,
    FALLBACK_ORDER,
    difference_order,
    difference_variance,
    noise_level,
    slow_spectrum,
)

__all__ = [
    "CORRELATION_COST",
    "DIFFERENCE_ORDER",
    "FALLBACK_ORDER",
    "CorrelatedNoise",
    "NoiseStretch",
    "correlated_noise",
    "difference_order",
    "difference_variance",
    "noise_level",
    "slow_spectrum",
    "suspected_noise",
]
