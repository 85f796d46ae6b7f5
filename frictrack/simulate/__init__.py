"""Simulate runs of known truth: trajectories of the slider here, films and scenes in sub-packages.

- `frictrack.simulate` simulates trajectories under any model;
- `frictrack.simulate.dynamics` is the integrator, which the fit shares;
- `frictrack.simulate.rendering` draws films of a trajectory;
- `frictrack.simulate.scene` reads a scene file and writes a whole study of known truth.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.simulate.trajectory import (
    Conditions,
    Start,
    Trajectory,
    image_shift,
    is_smooth_at_rest,
    push_force,
    simulate,
    simulate_displacement,
)
