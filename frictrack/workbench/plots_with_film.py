"""Show linked plots next to the film; the film shows the frame that is selected in a plot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.results import RunResults
from frictrack.study import RunTable
from frictrack.workbench.frame_images import FrameImages
from frictrack.workbench.linked_plots import LinkedPlots
from frictrack.workbench.page_state import PageState
from frictrack.workbench.plot_data import TRACK_COLOURS, PlotData, all_tracks, position_column


class OpenFilms:
    """The films of a study, each opened when it is first shown."""

    def __init__(self) -> None:
        self._open: dict[str, FrameImages] = {}

    def frames(self, path: Any, fps: float | None) -> FrameImages:
        """Pictures of a recording, which is opened at the first call.

        Parameters
        ----------
        path : Path
            The recording.
        fps : float or None
            Frames per second; None to read it from the file.

        """
        key = f"{path} {fps}"
        if key not in self._open:
            self._open[key] = FrameImages(path, fps)
        return self._open[key]

    def close(self) -> None:
        """Close all recordings."""
        for frames in self._open.values():
            frames.close()
        self._open.clear()


Plots = TypeVar("Plots", bound=LinkedPlots)


class PlotsWithFilm(Generic[Plots]):
    """Linked plots and the film, which shows the frame selected in a plot or by its slider.

    Parameters
    ----------
    state : PageState
        The study.
    films : OpenFilms
        Its films.
    linked : LinkedPlots
        The plots, of the page or of a notebook.

    """

    def __init__(self, state: PageState, films: OpenFilms, linked: Plots) -> None:
        self.state, self.films, self.linked = state, films, linked
        self.scene = PlotData()
        linked.on_change("selection", self._on_selection)
        linked.on_change("want", self._on_frame_wanted)

    def draw(self, scene: PlotData, run: str = "") -> None:
        """Draw new data and the first frame of a run.

        Parameters
        ----------
        scene : PlotData
            The data.
        run : str
            Name of the run. The film is hidden if there are neither data nor a run.

        """
        self.scene = scene
        self.linked.draw(scene)
        if run or not scene.rows:
            self.show(run, 0)

    def show(self, run: str, number: int) -> None:
        """Show a frame of a run's film, or hide the film if the run has none.

        Parameters
        ----------
        run : str
            Name of the run.
        number : int
            Number of the frame; it is clipped to the film.

        """
        table = self.state.runs.get(run)
        if table is None or table.video is None:
            self.linked.film = {}
            return
        try:
            frames = self.films.frames(table.video, table.fps)
            show_frame = frames[number]
        except FrictrackError as e:
            self.linked.film = {}
            self.state.notify(str(e), is_error=True)
            return
        film = {**frames.info, "label": run, **self._overlay(table)}
        if film != self.linked.film:
            self.linked.film = film
        self.linked.show_frame(show_frame)

    def _overlay(self, run: RunTable) -> dict[str, Any]:
        """What is drawn over the picture: tracks; target, reference and ruler of the study file."""
        results = self.state.results.runs if self.state.results else ()
        measured = next((r for r in results if r.name == run.name), None)
        rows = next((r for r in self.scene.runs if r["name"] == run.name), {"first": 0, "frame": 0})
        ruler = run.scale.get("points") if isinstance(run.scale, dict) and "length" in run.scale else None
        drawn = {"target": run.target, "reference": run.reference, "ruler": ruler}
        shapes = {key: _in_box(shape) for key, shape in drawn.items() if isinstance(shape, tuple | list)}
        where = {key: rows[key] for key in ("first", "frame")}
        return {**where, "tracks": _tracks(measured, self.scene) if measured else [], "shapes": shapes}

    def _on_selection(self, chosen: dict[str, Any]) -> None:
        if chosen.get("middle") is not None:
            self.show(*self.scene.frame_of_row(int(chosen["middle"])))

    def _on_frame_wanted(self, asked: dict[str, Any]) -> None:
        self.show(self.linked.film["label"], int(asked["frame"]))


def _in_box(shape: Sequence[Any]) -> list[Any]:
    """Convert a shape to what the page draws; an outline becomes its bounding box."""
    if len(shape) < 3 or isinstance(shape[0], int | float):
        return [*shape]
    low, high = np.min(shape, axis=0), np.max(shape, axis=0)
    return [*low.tolist(), *(high - low).tolist()]


def _tracks(run: RunResults, scene: PlotData) -> list[dict[str, Any]]:
    """Boxes of all tracked targets whose positions are in the scene."""
    out = []
    for colour, (name, track) in zip(TRACK_COLOURS, all_tracks(run).items(), strict=False):
        x, y = (position_column(name, axis, run) for axis in "xy")
        if x not in scene.columns or track.target is None:
            continue
        out.append({"name": name, "x": x, "y": y, "w": track.target[2], "h": track.target[3], "colour": colour})
    return out
