"""Penalties that a larger model must outweigh: the Bayesian information criterion (BIC)."""

from __future__ import annotations

import numpy as np

EVENT_PARAMETERS = 2.0  # as which an event in one run counts, its moment beside its size


def bic_penalty(count: float, frames: int) -> float:
    """Return the fall of chi-squared that `count` further parameters must exceed to lower the BIC.

    Parameters
    ----------
    count : float
        Number of further parameters.
    frames : int
        Number of frames that are fitted.

    Returns
    -------
    float
        Natural logarithm of the frames for every parameter.

    Examples
    --------
    >>> round(bic_penalty(2, 1000), 2)  # 2 ln 1000
    13.82

    References
    ----------
    Schwarz (1978), Annals of Statistics 6, 461-464.

    """
    return count * float(np.log(frames))
