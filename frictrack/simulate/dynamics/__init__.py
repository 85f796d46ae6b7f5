"""Integrate the equation of motion m x'' = D(t) - F(x, v, t) by collocation, and linearise the solution.

The simulator and the fit share this integrator. Three steps use it:

- `Panels` cuts time into panels with three Gauss-Legendre nodes each;
- `solve_motion` returns the motion as a `CollocationSolution` and its `LinearResponse`, the derivative of the motion
  with respect to small forces and to the start;
- `EdgeResponse` applies such a response to many forces at once.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.simulate.dynamics.collocation import (
    MEMORY_TOLERANCE_M,
    NODES,
    NOT_INTEGRATED,
    TOLERANCE_M,
    CollocationSolution,
    EdgeResponse,
    LinearResponse,
    Panels,
    Start,
    difference_steps,
    response_with_memory,
    solve_motion,
    solve_simplified_newton,
)
from frictrack.simulate.dynamics.reversals import directions, mean_directions
