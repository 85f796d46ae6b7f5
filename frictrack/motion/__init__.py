"""Displacement -> low-pass -> displacement, velocity and acceleration with their standard deviations."""

from frictrack.motion.derivative import covariance, derivatives, differentiate
from frictrack.motion.filter import low_pass
from frictrack.motion.known import KnownAcceleration
from frictrack.motion.noise import lag1, noise_level
from frictrack.motion.trade import trade

__all__ = [
    "KnownAcceleration",
    "covariance",
    "derivatives",
    "differentiate",
    "lag1",
    "low_pass",
    "noise_level",
    "trade",
]
