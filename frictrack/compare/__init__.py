"""Model against measurement: the errors of every model tried, and where the last one fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from frictrack.compare.residual import ResidualForce, curvature, effect_force, residual_force
from frictrack.compare.spans import failing_spans
from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.fit.groups import GroupFits
from frictrack.threads import one_thread

__all__ = [
    "Comparison",
    "ResidualForce",
    "compare",
    "curvature",
    "effect_force",
    "failing_spans",
    "history",
    "residual_force",
]


@dataclass(frozen=True)
class Comparison:
    """Errors of the models in the order in which they were tried, and the spans where the current one fails."""

    models: list[dict[str, Any]]
    fails_at: list[dict[str, Any]]

    def summary(self) -> dict[str, Any]:
        """The JSON of `frictrack compare` and `frictrack history`."""
        return {"models": self.models, "fails_at": self.fails_at}


@one_thread()
def compare(fits: Fit | Sequence[Fit], current: int = -1) -> Comparison:
    """Errors of every model tried, and where the `current` one fails: the last, when nothing is said."""
    tried = [fits] if isinstance(fits, Fit) else list(fits)
    if not tried:
        raise FrictrackError("expected at least one fitted model to compare but got none; run `frictrack fit` first")
    chosen = tried[current]
    parts = chosen.fits.values() if isinstance(chosen, GroupFits) else [chosen]
    spans = [span for f in parts for span in failing_spans(f.solution, f.runs)]
    return Comparison([_entry(i, f) for i, f in enumerate(tried, 1)], spans)


def history(fits: Sequence[Fit], current: int = -1) -> Comparison:
    """The same for a whole session: the error of every model, in order."""
    return compare(list(fits), current)


def _entry(i: int, fit: Fit) -> dict[str, Any]:
    """One model; `settings` tells in words what was fixed, tied or known of it beside the library."""
    named = {"name": f"{i}_{'+'.join(fit.model.names)}", "model": fit.model.names, "settings": fit.model.settings}
    return named | {"errors": fit.errors}
