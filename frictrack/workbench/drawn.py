"""What shows linked plots, whatever carries it to the browser: the module, and what it is told and tells."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

from frictrack.workbench.scenes import Scene

MODULE = files("frictrack.workbench").joinpath("linked.js").read_text(encoding="utf-8")  # what goes in and out: there


class Drawn:
    """The same for the page and for notebooks; they differ in how values are set, and how one hears of a change."""

    film: dict[str, Any]
    frame: bytes

    def put(self, **values: Any) -> None:
        """Set several values at once."""
        raise NotImplementedError

    def listen(self, name: str, call: Callable[[dict[str, Any]], None]) -> None:
        """Call with the new value whenever the user has changed one."""
        raise NotImplementedError

    def draw(self, scene: Scene) -> None:
        """Draw other data."""
        told, data = scene.packed()
        self.put(scene=told, data=data)

    def picture(self, frame: tuple[int, bytes]) -> None:
        """Show a frame of the film: its number and its JPEG."""
        number, jpeg = frame
        self.frame = number.to_bytes(4, "little") + jpeg
