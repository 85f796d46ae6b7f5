"""Variable projection along the measured motion, where the coefficients of a model are linear.

    separable = SeparableModel(problem.layout, problem.blocks)
    state = variable_projection(separable)()
    p = separable.law(state.nonlinear_values, state.coefficients)

The blocks of a problem are its displacements, accelerations or measured friction. `state` holds the non-linear values,
the coefficients (K,) and the misfit; p (P,) holds all unknowns of the layout. `variable_projection(separable)(data)`
fits other data (M,) along the same motion and reuses its tables. `ProjectedProblem(separable, data).refine(state)`
refines a known solution.

References
----------
Golub, G. H. & Pereyra, V. (1973). The differentiation of pseudo-inverses and nonlinear least squares problems whose
variables separate. SIAM J. Numer. Anal. 10, 413-432.

"""
