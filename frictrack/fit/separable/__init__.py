"""Along the measured motion the coefficients of a law are linear: blocks of data, rows of a model, and searches.

    along = Along(layout, [force_block(run, path, friction, sigma), ...])     a force series: no mass, no derivative
    state = search_of(along)()                    the law: state.numbers (P,), state.coefficients (K,), state.misfit
    p = along.law(state.numbers, state.coefficients)                          all unknowns of the layout, (P,)
    state = Projected(along, along.data).refine(Projected(along, along.data).at(p), groups)     from a known start

`displacement_block(piece)` and `chain_block(piece, chain, noise)` serve films in either domain.
`variable_projection(along)(data)` searches other data (M,) along the same motion with the tables of the first.
"""

from frictrack.fit.separable.blocks import (
    DataBlock,
    chain_block,
    displacement_block,
    force_block,
    path_at_compared,
    rows_at_compared,
)
from frictrack.fit.separable.constrained import ConstrainedVariableProjection, variable_projection
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.population import PopulationMisfit, ReducedPopulationMisfit
from frictrack.fit.separable.scan_tables import is_scannable
from frictrack.fit.separable.varpro import VariableProjection

__all__ = [
    "ConstrainedVariableProjection",
    "DataBlock",
    "PopulationMisfit",
    "ProjectedProblem",
    "ReducedPopulationMisfit",
    "SeparableModel",
    "SeparableSolution",
    "VariableProjection",
    "chain_block",
    "displacement_block",
    "force_block",
    "is_scannable",
    "path_at_compared",
    "rows_at_compared",
    "variable_projection",
]
