"""Displacement -> low-pass -> displacement, velocity and acceleration with their standard deviations."""

from frictrack.motion.correlated import CorrelatedNoise, correlated_noise
from frictrack.motion.cutoff_trade import trade
from frictrack.motion.derivative import covariance, derivatives, differentiate
from frictrack.motion.filter import low_pass
from frictrack.motion.known_acceleration import KnownAcceleration
from frictrack.motion.noise import noise_level

__all__ = [
    "CorrelatedNoise",
    "KnownAcceleration",
    "correlated_noise",
    "covariance",
    "derivatives",
    "differentiate",
    "low_pass",
    "noise_level",
    "trade",
]
