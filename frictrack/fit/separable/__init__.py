"""Variable projection along the measured motion, where the coefficients of a model are linear.

    separable = SeparableModel(layout, [force_block(run, path, friction, sigma), ...])
    state = variable_projection(separable)()
    p = separable.law(state.nonlinear_values, state.coefficients)

`force_block` takes a friction series; `displacement_block` and `chain_block` take pieces of films, in the
displacement or the acceleration domain. `state` holds the non-linear values, the coefficients (K,) and the misfit; p
(P,) holds all unknowns of the layout. `variable_projection(separable)(data)` fits other data (M,) along the same
motion and reuses its tables. `ProjectedProblem(separable, data).refine(state)` refines a known solution.

References
----------
Golub, G. H. & Pereyra, V. (1973). The differentiation of pseudo-inverses and nonlinear least squares problems whose
variables separate. SIAM J. Numer. Anal. 10, 413-432.

"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.fit.separable.blocks import (
    DataBlock,
    chain_block,
    displacement_block,
    force_block,
    path_at_compared,
    repeat_values,
    rows_at_compared,
    tiled_path,
)
from frictrack.fit.separable.common_amplitudes import ConstrainedVariableProjection, variable_projection
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.population import PopulationMisfit, ReducedPopulationMisfit
from frictrack.fit.separable.projected import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.scan import is_scannable
from frictrack.fit.separable.varpro import VariableProjection
