"""Show linked plots and film in a notebook.

from frictrack.workbench.notebook import look
look("study.toml")
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anywidget
import traitlets

from frictrack.errors import FrictrackError
from frictrack.workbench import plot_data
from frictrack.workbench.linked_plots import MODULE, LinkedPlots
from frictrack.workbench.page_state import PageState
from frictrack.workbench.plots_with_film import OpenFilms, PlotsWithFilm


class NotebookPlots(LinkedPlots, anywidget.AnyWidget):
    """Linked plots; ``linked.js`` describes the values."""

    scene = traitlets.Dict().tag(sync=True)
    data = traitlets.Bytes().tag(sync=True)
    film = traitlets.Dict().tag(sync=True)
    frame = traitlets.Bytes().tag(sync=True)
    tool = traitlets.Unicode().tag(sync=True)
    selection = traitlets.Dict().tag(sync=True)
    want = traitlets.Dict().tag(sync=True)
    drawn = traitlets.Dict().tag(sync=True)
    moved = traitlets.Dict().tag(sync=True)

    _esm = MODULE

    def set_values(self, **values: Any) -> None:
        """Set several values at once."""
        with self.hold_sync():
            for name, value in values.items():
                setattr(self, name, value)

    def on_change(self, name: str, call: Callable[[dict[str, Any]], None]) -> None:
        """Call a function with the new value whenever the user changes the value `name`."""
        self.observe(lambda change: call(change["new"]), names=name)


def look(study: str | Path, model: str | None = None, behind: str | None = None) -> NotebookPlots:
    """Show a model of a study on its measurement, in linked plots with the film. Nothing is computed.

    Parameters
    ----------
    study : str or Path
        The study file.
    model : str, optional
        Name of the model as in `frictrack history`, such as ``1_tustin``; the current model by default.
    behind : str, optional
        Name of another model, shown in the background.

    Returns
    -------
    NotebookPlots
        The widget.

    Raises
    ------
    FrictrackError
        If the study cannot be read or has no such model.

    """
    state = PageState(Path(study))
    state.load()
    if state.results is None or state.model is None:
        none = f"expected a study with a model but {study} has none; run `frictrack run` on it"
        raise FrictrackError(state.message or none)
    models = {m.name: m for m in state.results.models}
    unknown = [name for name in (model, behind) if name is not None and name not in models]
    if unknown:
        raise FrictrackError(f'expected one of {", ".join(models)} but got "{unknown[0]}"')
    films = OpenFilms()
    plots_with_film = PlotsWithFilm(state, films, NotebookPlots())
    weakref.finalize(plots_with_film.linked, films.close)  # at the latest when the kernel ends
    shown = models[model] if model else state.model
    plots_with_film.draw(
        plot_data.comparison_plots(state.results, shown, models[behind] if behind else None), state.run
    )
    return plots_with_film.linked
