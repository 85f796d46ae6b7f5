"""The linked plots and the film in a notebook: what is selected in one plot shows in all others and on the film.

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
from frictrack.workbench import scenes
from frictrack.workbench.desk import Desk
from frictrack.workbench.drawn import MODULE, Drawn
from frictrack.workbench.films import Bench, Films


class Shown(Drawn, anywidget.AnyWidget):
    """See ``linked.js`` for what goes in and what comes out."""

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

    def put(self, **values: Any) -> None:
        """Set several values at once."""
        with self.hold_sync():
            for name, value in values.items():
                setattr(self, name, value)

    def listen(self, name: str, call: Callable[[dict[str, Any]], None]) -> None:
        """Call with the new value whenever the user has changed one."""
        self.observe(lambda change: call(change["new"]), names=name)


def look(study: str | Path, model: str | None = None, behind: str | None = None) -> Shown:
    """One model of a study on its measurement, the last one unless it is named, and another one `behind` it.

    Names are those of `frictrack history`, such as ``1_tustin``. Nothing is computed. Raises `FrictrackError` where
    the study cannot be read, or has no such model.
    """
    desk = Desk(Path(study))
    desk.look_first()
    if desk.results is None or desk.model is None:
        none = f"expected a study with a model but {study} has none; run `frictrack run` on it"
        raise FrictrackError(desk.said or none)
    models = {m.name: m for m in desk.results.models}
    unknown = [name for name in (model, behind) if name is not None and name not in models]
    if unknown:
        raise FrictrackError(f'expected one of {", ".join(models)} but got "{unknown[0]}"')
    films = Films()
    bench = Bench(desk, films, Shown())
    weakref.finalize(bench.linked, films.close)  # at the end of the kernel, at the latest
    seen = models[model] if model else desk.model
    bench.draw(scenes.compared(desk.results, seen, models[behind] if behind else None), desk.run)
    return bench.linked
