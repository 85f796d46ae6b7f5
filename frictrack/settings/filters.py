"""Name the filters that a user can choose for a displacement, and check their settings."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

from frictrack.base.arguments import checked

STRUCTURAL, KALMAN, PAPERS = "structural", "kalman", "papers"
FILTERS: dict[str, tuple[str, tuple[str, ...]]] = {  # what each is, and the settings that it takes
    STRUCTURAL: ("trend, vibrations and events separated", ("cutoff",)),
    KALMAN: ("Kalman smoother of one stiffness", ()),
    "butterworth": ("Butterworth", ("cutoff", "order", "causal")),
    "savitzky-golay": ("Savitzky-Golay", ("order", "window")),
    "gaussian-process": ("Gaussian process", ()),
    PAPERS: ("as in the papers: Butterworth, two differences", ("cutoff", "order", "causal")),
}
METHOD_NAMES = tuple(FILTERS)
ORDERS = {"butterworth": (1, 10), "savitzky-golay": (2, 7), PAPERS: (1, 10)}
PAPERS_CUTOFF = 100.0  # Hz; the papers name no cut-off, order or direction
DEFAULT_ORDER = 4
SETTINGS = ("cutoff", "filter", "order", "window", "causal")  # keys of the study file


@checked
@dataclass(frozen=True)
class FilterChoice:
    """A filter with the settings that were given; None for those that it chooses from the data.

    Attributes
    ----------
    method
        One of `FILTERS`.
    cutoff
        Frequency at which half of the amplitude passes, Hz.
    order
        Order of a Butterworth filter, or degree of the polynomials of Savitzky and Golay.
    window
        Frames of these polynomials.
    causal
        Forward only, as an instrument filters while it records; else forward and backward, without delay.

    Examples
    --------
    >>> import frictrack as ft
    >>> run = ft.samples.runs()[0]
    >>> choice = ft.FilterChoice("butterworth", cutoff=150.0, order=2)
    >>> ft.low_pass(run.displacement, method=choice).reason
    'butterworth, half passes at 150 Hz'

    """

    method: str = STRUCTURAL
    cutoff: Annotated[float, "Hz"] | None = None
    order: int | None = None
    window: int | None = None
    causal: bool = False

    @property
    def is_default(self) -> bool:
        """Whether trend, vibrations and events are separated, without a given filter."""
        return self.method == STRUCTURAL and self.cutoff is None

    def faults(self) -> Iterator[str]:
        """Yield what is wrong with the settings, and what to do.

        Examples
        --------
        >>> next(FilterChoice("kalman", cutoff=60.0).faults())
        'expected no cutoff with filter = "kalman", which finds its settings itself; leave cutoff out'

        """
        if self.method not in FILTERS:
            near = difflib.get_close_matches(self.method, FILTERS, 1)
            hint = f'; did you mean "{near[0]}"?' if near else ""
            yield f'expected filter as one of {", ".join(FILTERS)} but got "{self.method}"{hint}'
            return
        _, takes = FILTERS[self.method]
        for name in ("cutoff", "order", "window", "causal"):
            if name not in takes and getattr(self, name) not in (None, False):
                what = f"takes {', '.join(takes)}" if takes else "finds its settings itself"
                yield f'expected no {name} with filter = "{self.method}", which {what}; leave {name} out'
        low, high = ORDERS.get(self.method, (0, 0))
        if high and self.order is not None and not low <= self.order <= high:
            yield f'expected order from {low} to {high} with filter = "{self.method}" but got {self.order}'
        least = max((self.order or 0) + 1, 5)
        if "window" in takes and self.window is not None and (self.window % 2 == 0 or self.window < least):
            yield f"expected window as an odd number of at least {least} frames but got {self.window}"
