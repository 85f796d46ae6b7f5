"""Trajectories and rendered film of known truth."""

from frictrack.simulate.slide import Conditions, Slide, simulate

__all__ = ["Conditions", "Slide", "simulate"]
