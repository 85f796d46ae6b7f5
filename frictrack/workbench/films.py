"""The film beside the plots, for any tab: which recording is open, which frame is asked for."""

from __future__ import annotations

from typing import Any

from frictrack.errors import FrictrackError
from frictrack.results import RunResults
from frictrack.workbench.desk import Desk
from frictrack.workbench.frames import Frames
from frictrack.workbench.linked import Linked
from frictrack.workbench.scenes import TRACKS, Scene


class Films:
    """The films of a study, opened when they are first looked at; shows their frames in linked plots."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self._open: dict[str, Frames] = {}

    def frames(self, path: Any, fps: float | None) -> Frames:
        """The pictures of a recording."""
        key = f"{path} {fps}"
        if key not in self._open:
            self._open[key] = Frames(path, fps)
        return self._open[key]

    def show(self, linked: Linked, run: str, number: int, scene: Scene | None = None) -> None:
        """A frame of a run's film in the linked plots; nothing where the run has none."""
        table = self.desk.runs.get(run)
        if table is None or table.video is None:
            linked.film = {}
            return
        try:
            frames = self.frames(table.video, table.fps)
            picture = frames[number]
        except FrictrackError as e:
            linked.film = {}
            self.desk.tell(str(e), wrong=True)
            return
        film = {**frames.told, "label": run, **self._drawn(run, scene)}
        if film != linked.film:
            linked.film = film
        linked.picture(picture)

    def _drawn(self, run: str, scene: Scene | None) -> dict[str, Any]:
        """What lies over the picture: tracks, and what the study file says of target, reference and ruler."""
        results = self.desk.results.runs if self.desk.results else ()
        measured = next((r for r in results if r.name == run), None)
        place = next((r["first"] for r in (scene.runs if scene else ()) if r["name"] == run), 0)
        table = self.desk.runs[run]
        ruler = table.scale.get("points") if isinstance(table.scale, dict) and "length" in table.scale else None
        drawn = {"target": table.target, "reference": table.reference, "ruler": ruler}
        shapes = {key: [*shape] for key, shape in drawn.items() if isinstance(shape, tuple | list)}
        return {"first": place, "tracks": _tracks(measured, scene) if measured else [], "shapes": shapes}

    def close(self) -> None:
        """Let go of all recordings."""
        for frames in self._open.values():
            frames.close()
        self._open.clear()


def _tracks(run: RunResults, scene: Scene | None) -> list[dict[str, Any]]:
    """Boxes of the target and of what was tracked beside it, where the scene has their places."""
    found = {"": run.track, **{n: t for n, t in run.tracks.items() if n != "backward"}} if run.track else {}
    out = []
    for colour, (name, track) in zip(TRACKS, found.items(), strict=False):
        x, y = (f"{name}_{axis}" if name else f"film_{axis}:{run.name}" for axis in "xy")
        if scene is None or x not in scene.columns or track is None or track.target is None:
            continue
        out.append(
            {"name": name or "target", "x": x, "y": y, "w": track.target[2], "h": track.target[3], "colour": colour}
        )
    return out
