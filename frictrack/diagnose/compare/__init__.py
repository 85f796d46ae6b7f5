"""Compare models with the measurement: the errors of every model tried, and the spans where the last one fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from frictrack.base import imported
from frictrack.base.errors import FrictrackError
from frictrack.base.workers import one_thread
from frictrack.diagnose.compare.groups import ParameterByGroup, compare_groups
from frictrack.diagnose.compare.local_forces import LocalForces, continue_search, find_local_forces, start_search
from frictrack.diagnose.compare.spans import failing_spans
from frictrack.fit import Fit, GroupFits
from frictrack.records import NotebookView

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = [
    "Comparison",
    "LocalForces",
    "ParameterByGroup",
    "compare",
    "compare_groups",
    "continue_search",
    "failing_spans",
    "find_local_forces",
    "history",
    "start_search",
]


@dataclass(frozen=True, repr=False)
class Comparison(NotebookView):
    """Errors of models, and the spans where the current one fails.

    Parameters
    ----------
    models
        One entry per model, in the order tried: name, effects, settings and errors.
    fails_at
        Failing spans, largest share of the misfit first; see `failing_spans`.

    Examples
    --------
    >>> import frictrack as ft
    >>> runs = ft.samples.runs()[:2]
    >>> fits = [ft.fit(model, runs) for model in ("coulomb", ["coulomb", "viscous"])]
    >>> list(ft.compare(fits).to_dataframe().index)
    ['1_coulomb', '2_coulomb+viscous']

    """

    models: list[dict[str, Any]]
    fails_at: list[dict[str, Any]]

    def __repr__(self) -> str:
        last = self.models[-1]
        shares = f"; it fails in {len(self.fails_at)} spans" if self.fails_at else "; it fails nowhere"
        count = "1 model" if len(self.models) == 1 else f"{len(self.models)} models"
        return f"<Comparison of {count}, the last one {'+'.join(last['model'])}{shares}>"

    def to_dataframe(self) -> pd.DataFrame:
        """Return the errors of all models as a pandas DataFrame, one row per model in the order tried."""
        import pandas as pd  # noqa: PLC0415 - half a second

        rows = [{"model": "+".join(entry["model"]), **entry["errors"]} for entry in self.models]
        return pd.DataFrame(rows, index=pd.Index([entry["name"] for entry in self.models], name="name"))

    def plot(self) -> Figure:
        """Draw the held-out error of every model in the order tried."""
        return imported("frictrack.present.plots:history")(self.models)

    def summary(self) -> dict[str, Any]:
        """Return the JSON of `frictrack compare` and `frictrack history`."""
        return {"models": self.models, "fails_at": self.fails_at}


@one_thread()
def compare(fits: Fit | Sequence[Fit], current: int = -1) -> Comparison:
    """Compare fitted models, and find where the current one fails.

    Parameters
    ----------
    fits
        One fit, or several in the order tried.
    current
        Index of the model whose failing spans are computed; by default the last.

    Returns
    -------
    Comparison
        Errors of all models and failing spans of one.

    Raises
    ------
    FrictrackError
        If `fits` is empty.

    Examples
    --------
    >>> import frictrack as ft
    >>> fit = ft.fit(["coulomb", "viscous"], ft.samples.runs()[:2])
    >>> place = ft.compare(fit).fails_at[0]
    >>> place["run"], [round(x, 2) for x in place["x"]]
    ('slow', [0.09, 0.12])

    """
    tried = [fits] if isinstance(fits, Fit) else list(fits)
    if not tried:
        raise FrictrackError("expected at least one fitted model to compare but got none; run `frictrack fit` first")
    chosen = tried[current]
    parts = chosen.fits.values() if isinstance(chosen, GroupFits) else [chosen]
    spans = [span for f in parts for span in failing_spans(f.solution, f.runs)]
    return Comparison([_entry(i, f) for i, f in enumerate(tried, 1)], spans)


def history(fits: Sequence[Fit], current: int = -1) -> Comparison:
    """Compare all models of a session in the order tried; see `compare`.

    Examples
    --------
    >>> import frictrack as ft
    >>> runs = ft.samples.runs()[:2]
    >>> first = ft.fit(["coulomb"], runs)
    >>> [entry["name"] for entry in ft.history([first, ft.fit(["coulomb", "viscous"], runs)]).models]
    ['1_coulomb', '2_coulomb+viscous']

    """
    return compare(list(fits), current)


def _entry(i: int, fit: Fit) -> dict[str, Any]:
    """Entry of one model; `settings` lists what was fixed, tied or given a prior."""
    named = {"name": f"{i}_{'+'.join(fit.model.names)}", "model": fit.model.names, "settings": fit.model.settings}
    return named | {"errors": fit.errors}
