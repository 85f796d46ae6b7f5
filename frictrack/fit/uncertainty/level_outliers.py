"""Find a run whose dry friction differs from that of all others: its frame rate, scale or load may be wrong.

Each run has its own friction level, because surfaces scatter. A wrong frame rate or scale of one run changes its
accelerations by a factor, which the level absorbs exactly: the misfit does not show it, but the level does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from frictrack.fit.least_squares import Solution
from frictrack.records import Array

MIN_OTHER_RUNS = 2  # that agree with each other
MIN_RATIO = 1.3  # smaller differences are usual between repeats of a run
MIN_SPREADS = 5.0  # of the other runs, and standard deviations of the difference


def level_remarks(solution: Solution, covariance: Array, reduced_chi2: float) -> Iterator[str]:
    """State which run has another level of dry friction than all others, and what may cause that.

    Parameters
    ----------
    solution
        A fit.
    covariance
        Covariance (P, P) of its unknowns, for noise alone.
    reduced_chi2
        Of the fit; a misfit widens the standard deviations by its root.

    """
    layout = solution.problem.layout
    at = np.asarray(layout.levels, dtype=int)
    levels = solution.p[at]
    within = covariance[np.ix_(at, at)] * max(1.0, reduced_chi2) / np.outer(levels, levels)
    yield from describe_level_outliers(layout.run_names, levels, within)


def describe_level_outliers(names: Sequence[str], levels: Array, covariance: Array) -> Iterator[str]:
    """Describe every run whose level differs from all others, which agree.

    Parameters
    ----------
    names
        Names of the runs.
    levels
        Levels (R,) of dry friction, as factors.
    covariance
        Covariance (R, R) of their logarithms.

    Examples
    --------
    >>> import numpy as np
    >>> names = ["v3", "v5", "v7", "v9"]
    >>> found = describe_level_outliers(names, np.array([1.0, 1.02, 4.0, 0.99]), 1e-4 * np.eye(4))
    >>> next(found).split(":")[0]
    'dry friction in v7 is 3.99 times that in the other runs, which agree within 1.5 %'
    >>> list(describe_level_outliers(names, np.array([1.0, 1.1, 0.9, 1.2]), 1e-4 * np.eye(4)))
    []

    """
    logs = np.log(levels)
    for k, name in enumerate(names) if len(names) > MIN_OTHER_RUNS else ():
        contrast = np.where(np.arange(len(names)) == k, 1.0, -1.0 / (len(names) - 1))
        departure, sigma = float(contrast @ logs), float(np.sqrt(contrast @ covariance @ contrast))
        spread = float(np.std(np.delete(logs, k), ddof=1))
        if abs(departure) < max(np.log(MIN_RATIO), MIN_SPREADS * spread, MIN_SPREADS * sigma):
            continue
        ratio = float(np.exp(departure))
        agreement = f"the other runs, which agree within {100 * spread:.2g} %"
        yield (
            f"dry friction in {name} is {ratio:.3g} times that in {agreement}: check its frame rate "
            f"(one that is {ratio**0.5:.3g} times too high does this), its scale ({ratio:.3g} times), its normal load "
            "and its surface"
        )
