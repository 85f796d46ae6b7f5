"""Show linked plots and film in a notebook.

from frictrack.workbench.notebook import look
look("study.toml")
look(fit)
"""

from __future__ import annotations

import re
import weakref
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import anywidget
import numpy as np
import traitlets

from frictrack import flow
from frictrack.base.errors import FrictrackError
from frictrack.present.plots import AnyModel, AnyRun, as_model, as_runs
from frictrack.records import Array
from frictrack.results import ModelResults, Results, RunResults
from frictrack.workbench import plot_data
from frictrack.workbench.films import FilmFile, Films, film_file

if TYPE_CHECKING:
    from frictrack.workbench.plot_data import PlotData

STATIC = files("frictrack.workbench").joinpath("static")
ENTRY = "widget.js"
IMPORT = re.compile(r'^import (\{[^}]+\}) from "\./([\w.]+)";\n', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:class|function|const|let) (\w+))", re.MULTILINE)


@cache
def widget_module() -> str:
    """Text of the module: every imported module becomes a function that is called once and returns its exports.

    Returns
    -------
    str
        An ES module without imports.

    """
    joined: dict[str, str] = {}
    _add(ENTRY, joined)
    return "\n".join(joined.values())


def _add(name: str, joined: dict[str, str]) -> None:
    """Add a module after those that it imports."""
    text = STATIC.joinpath("plots", name).read_text(encoding="utf-8")
    for _, other in IMPORT.findall(text):
        if other not in joined:
            _add(other, joined)
    text = IMPORT.sub(lambda found: f"const {found[1].replace(' as ', ': ')} = {_variable(found[2])};\n", text)
    if name == ENTRY:
        joined[name] = text
        return
    exported = ", ".join(EXPORT.findall(text))
    body = EXPORT.sub("", text)
    joined[name] = f"const {_variable(name)} = (() => {{\n{body}return {{ {exported} }};\n}})();\n"


def _variable(name: str) -> str:
    return f"module_{name.removesuffix('.js')}"


@cache
def widget_style() -> str:
    """Style sheet of the widget; its design tokens hold within the widget only.

    Returns
    -------
    str
        CSS.

    """
    tokens = STATIC.joinpath("tokens.css").read_text(encoding="utf-8").replace(":root", ".fp-notebook")
    return tokens + STATIC.joinpath("plots", "plots.css").read_text(encoding="utf-8")


class NotebookPlots(anywidget.AnyWidget):
    """Linked plots with the film.

    Attributes
    ----------
    selection : dict
        What is selected: `count`, `per_run`, and `run` and `frame` of the cursor.
    selected : dict
        Numbers of the selected frames, by name of the run.

    """

    scene = traitlets.Dict().tag(sync=True)
    data = traitlets.Bytes().tag(sync=True)
    films: Any = traitlets.List().tag(sync=True)
    selection = traitlets.Dict().tag(sync=True)
    rows = traitlets.Bytes().tag(sync=True)  # Int32, numbers of the selected rows

    _esm = widget_module()
    _css = widget_style()

    def __init__(self, scene: PlotData, sources: Mapping[str, FilmFile]) -> None:
        opened, (layout, data) = Films(), scene.layout()
        info = [{"run": run, **opened.open(file).info().result()} for run, file in sources.items()]
        super().__init__(scene=layout, data=data, films=info)
        self._opened, self._sources = opened, dict(sources)
        self.on_msg(self._send_frame)
        weakref.finalize(self, opened.close)  # at the latest when the kernel ends

    @property
    def selected(self) -> dict[str, Array]:
        """Numbers of the selected frames (n,) by name of the run."""
        rows, found = np.frombuffer(self.rows, dtype="<i4"), {}
        for run in self.scene["runs"]:
            own = rows[(rows >= run["first"]) & (rows < run["first"] + run["count"])]
            if len(own):
                found[run["name"]] = own - run["first"] + run["frame"]
        return found

    def _send_frame(self, _: Any, asked: Any, buffers: Any) -> None:
        """Answer the browser, which asks for a frame of a run."""
        try:
            jpeg = self._opened.open(self._sources[asked["run"]]).frame(int(asked["frame"])).result()
        except (FrictrackError, KeyError) as e:
            self.send({"id": asked["id"], "error": str(e)})
        else:
            self.send({"id": asked["id"]}, buffers=[jpeg])


def look(
    what: str | Path | Results | AnyModel,
    runs: Sequence[AnyRun] | None = None,
    *,
    model: str | None = None,
    background: str | AnyModel | None = None,
    films: Mapping[str, str | Path] | None = None,
) -> NotebookPlots:
    """Show a model on its measurement, in linked plots with the film. Nothing is computed.

    Parameters
    ----------
    what : str, Path, Results or Fit
        A study file, its results, or a fit.
    runs : sequence of Run, optional
        The runs of the fit; by default those that it was fitted to.
    model : str, optional
        Of a study: name of the model as in `frictrack history --json`: ``1_tustin``; the current model by default.
    background : str or Fit, optional
        Another model, shown in the background.
    films : mapping, optional
        Path of the recording by name of the run. A study knows its films.

    Returns
    -------
    NotebookPlots
        The widget.

    Raises
    ------
    FrictrackError
        If the study cannot be read, has no such model, or the model has no run.

    Examples
    --------
    >>> import frictrack as ft
    >>> fit = ft.fit(["coulomb", "viscous"], ft.samples.runs()[:2])
    >>> look(fit).scene["rows"] == sum(len(run.motion) for run in fit.runs)
    True

    """
    sources = {name: film_file(Path(path)) for name, path in (films or {}).items()}
    if isinstance(what, str | Path):
        what, found = _read_study(Path(what))
        sources = found | sources
    if isinstance(what, Results):
        shown = _model_of(what, model)
        other = _model_of(what, background) if isinstance(background, str) else _fit_only(background)
        scene = plot_data.comparison_plots(what, shown, other)
        measured: Sequence[RunResults] = what.runs
    else:
        measured = as_runs(cast("Any", what).runs if runs is None else runs)
        other = _fit_only(background)
        scene = plot_data.model_plots(measured, as_model(what), other)
    if not scene.rows:
        raise FrictrackError("expected runs that the model was fitted to, but it has none; give runs = [...]")
    scene.extra["large"] = plot_data.RESIDUAL_TITLES[0]
    _number_first_frames(scene, sources, measured)
    return NotebookPlots(scene, {r["name"]: sources[r["name"]] for r in scene.runs if r["name"] in sources})


def _read_study(path: Path) -> tuple[Results, dict[str, FilmFile]]:
    """Results of a study, and its films by name of the run."""
    study = flow.open_study(path)
    results = flow.read_results(study)
    if results.current is None:
        raise FrictrackError(f"expected a study with a model but {path} has none; run `frictrack run` on it")
    films = {run.name: (run.video, run.fps) for run in study.runs if isinstance(run.video, Path)}
    return results, {name: film_file(path, fps) for name, (path, fps) in films.items() if path.exists()}


def _model_of(results: Results, name: str | None) -> ModelResults:
    """A model of a study by its name; the current one without a name."""
    models = {m.name: m for m in results.models}
    if name is None and results.current is not None:
        return results.current
    if name not in models:
        raise FrictrackError(f'expected one of {", ".join(models)} but got "{name}"')
    return models[name]


def _fit_only(background: str | AnyModel | None) -> ModelResults | None:
    if isinstance(background, str):
        raise FrictrackError(f'expected a fit as background of a fit but got the name "{background}"')
    return None if background is None else as_model(background)


def _number_first_frames(scene: PlotData, films: Mapping[str, FilmFile], runs: Sequence[RunResults]) -> None:
    """Find the frame of the film at which the motion begins, for runs whose track is not known."""
    by_name = {run.name: run for run in runs}
    for entry in scene.runs:
        run = by_name[entry["name"]]
        if entry["name"] in films and run.track is None:
            t = run.motion.t
            entry["frame"] = max(0, round(float(t[0] / np.median(np.diff(t)))))
