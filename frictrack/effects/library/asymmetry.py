"""Direction-dependent friction: dry level and viscous coefficient differ between the two directions."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase, TestDraw
from frictrack.effects.ranges import Span


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L and |v|, shape (n, 2): N per N of dF, N per N s/m of dF_v."""
    return np.column_stack([np.full_like(path.v, path.load), np.abs(path.v)])


def draw_viscous_part(span: Span, uniform: Array) -> dict[str, float]:
    """Return a viscous part that is at most as large as the dry one at the highest speed."""
    return {"dF_v": (2.0 * float(uniform[1]) - 1.0) / span.v_max}


equation = "dF L + dF_v |v|"
parameters = (Parameter("dF", "N", linear=True, loaded=True), Parameter("dF_v", "N s/m", linear=True))
varies_with = "v"
scales_with = "load"
what = "The surfaces resist more one way than the other: wear, tilted asperities, a screw."
looks_like = "forward and reversed runs need different friction laws"
mistaken_for = "slope (the level part), a drive offset"
confirm = "Turn the mass round on the course: asymmetry of its own face turns with it."
describe = Phrase("{2 * dF} N between the two directions at the reference load, and {2 * dF_v} N more for every m/s")
invariant = "asymmetry depends on the direction of motion and grows with the load or the speed"
settled_by = "turn the mass round on the course"
in_base_law = True
test_draw = TestDraw(coefficients=draw_viscous_part)
source = "Janot, Gautier & Brunot 2019 (EMPS)"
