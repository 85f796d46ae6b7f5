"""Accept random generators and seeds as the scientific Python ecosystem agreed (SPEC 7)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

RNG = np.random.Generator | int | None
"""What `rng` takes: a generator, which is advanced; a seed; or None for other numbers in every call."""

P = ParamSpec("P")
T = TypeVar("T")


def accepts_seed(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function with the keyword `rng` also accept the older keyword `seed`, with a deprecation warning.

    Parameters
    ----------
    function
        A function with the keyword argument `rng`.

    Returns
    -------
    callable
        The same function; it raises TypeError if both keywords are given.

    References
    ----------
    SPEC 7, Seeding pseudo-random number generation, https://scientific-python.org/specs/spec-0007

    Examples
    --------
    >>> @accepts_seed
    ... def draw(n, *, rng=0):
    ...     return np.random.default_rng(rng).integers(10, size=n)
    >>> draw(3, rng=1).tolist()
    [4, 5, 7]

    """

    @wraps(function)
    def with_seed(*args: Any, **keywords: Any) -> T:
        if "seed" in keywords:
            if "rng" in keywords:
                raise TypeError(f"expected rng or seed in {function.__name__}() but got both")
            warnings.warn(f"seed is deprecated in {function.__name__}(); use rng", DeprecationWarning, stacklevel=2)
            keywords["rng"] = keywords.pop("seed")
        return function(*args, **keywords)

    return with_seed


def as_seed(rng: RNG) -> int | None:
    """Return the seed if `rng` is one, to store it with a result; None for a generator.

    Examples
    --------
    >>> as_seed(3), as_seed(np.random.default_rng(3))
    (3, None)

    """
    return None if rng is None or isinstance(rng, np.random.Generator) else int(rng)
