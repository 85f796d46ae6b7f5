"""Linked plots and the film beside them, for any tab: which recording is open, which frame is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.results import RunResults
from frictrack.study import RunTable
from frictrack.workbench.desk import Desk
from frictrack.workbench.drawn import Drawn
from frictrack.workbench.frames import Frames
from frictrack.workbench.scenes import TRACKS, Scene, on_film, tracks


class Films:
    """The films of a study, opened when they are first looked at."""

    def __init__(self) -> None:
        self._open: dict[str, Frames] = {}

    def frames(self, path: Any, fps: float | None) -> Frames:
        """The pictures of a recording."""
        key = f"{path} {fps}"
        if key not in self._open:
            self._open[key] = Frames(path, fps)
        return self._open[key]

    def close(self) -> None:
        """Let go of all recordings."""
        for frames in self._open.values():
            frames.close()
        self._open.clear()


Shown = TypeVar("Shown", bound=Drawn)


class Bench(Generic[Shown]):
    """Linked plots with the film beside them: it shows the frame that is chosen in a plot, or asked for below it."""

    def __init__(self, desk: Desk, films: Films, linked: Shown) -> None:
        self.desk, self.films, self.linked = desk, films, linked
        self.scene = Scene()
        linked.listen("selection", self._selected)
        linked.listen("want", self._wanted)

    def draw(self, scene: Scene, run: str = "") -> None:
        """Draw other data, and the first frame of a run; without data and run no film is shown."""
        self.scene = scene
        self.linked.draw(scene)
        if run or not scene.rows:
            self.show(run, 0)

    def show(self, run: str, number: int) -> None:
        """A frame of a run's film; nothing where the run has none."""
        table = self.desk.runs.get(run)
        if table is None or table.video is None:
            self.linked.film = {}
            return
        try:
            frames = self.films.frames(table.video, table.fps)
            picture = frames[number]
        except FrictrackError as e:
            self.linked.film = {}
            self.desk.tell(str(e), wrong=True)
            return
        film = {**frames.told, "label": run, **self._over(table)}
        if film != self.linked.film:
            self.linked.film = film
        self.linked.picture(picture)

    def _over(self, run: RunTable) -> dict[str, Any]:
        """What lies over the picture: tracks, and what the study file says of target, reference and ruler."""
        results = self.desk.results.runs if self.desk.results else ()
        measured = next((r for r in results if r.name == run.name), None)
        rows = next((r for r in self.scene.runs if r["name"] == run.name), {"first": 0, "frame": 0})
        ruler = run.scale.get("points") if isinstance(run.scale, dict) and "length" in run.scale else None
        drawn = {"target": run.target, "reference": run.reference, "ruler": ruler}
        shapes = {key: _in_box(shape) for key, shape in drawn.items() if isinstance(shape, tuple | list)}
        where = {key: rows[key] for key in ("first", "frame")}
        return {**where, "tracks": _tracks(measured, self.scene) if measured else [], "shapes": shapes}

    def _selected(self, chosen: dict[str, Any]) -> None:
        if chosen.get("middle") is not None:
            self.show(*self.scene.place(int(chosen["middle"])))

    def _wanted(self, asked: dict[str, Any]) -> None:
        self.show(self.linked.film["label"], int(asked["frame"]))


def _in_box(shape: Sequence[Any]) -> list[Any]:
    """A shape as the page draws it: an outline by the rectangle round it."""
    if len(shape) < 3 or isinstance(shape[0], int | float):
        return [*shape]
    low, high = np.min(shape, axis=0), np.max(shape, axis=0)
    return [*low.tolist(), *(high - low).tolist()]


def _tracks(run: RunResults, scene: Scene) -> list[dict[str, Any]]:
    """Boxes of the target and of what was tracked beside it, where the scene has their places."""
    out = []
    for colour, (name, track) in zip(TRACKS, tracks(run).items(), strict=False):
        x, y = (on_film(name, axis, run) for axis in "xy")
        if x not in scene.columns or track.target is None:
            continue
        out.append({"name": name, "x": x, "y": y, "w": track.target[2], "h": track.target[3], "colour": colour})
    return out
