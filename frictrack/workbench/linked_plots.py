"""The interface of the linked plots in the browser, common to the page and to notebooks."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

from frictrack.workbench.plot_data import PlotData

MODULE = files("frictrack.workbench").joinpath("linked.js").read_text(encoding="utf-8")  # what goes in and out: there


class LinkedPlots:
    """The same for the page and for notebooks; they differ in how values are set, and how one hears of a change."""

    film: dict[str, Any]
    frame: bytes

    def set_values(self, **values: Any) -> None:
        """Set several values at once."""
        raise NotImplementedError

    def on_change(self, name: str, call: Callable[[dict[str, Any]], None]) -> None:
        """Call with the new value whenever the user has changed one."""
        raise NotImplementedError

    def draw(self, scene: PlotData) -> None:
        """Draw other data."""
        layout, data = scene.packed()
        self.set_values(scene=layout, data=data)

    def show_frame(self, frame: tuple[int, bytes]) -> None:
        """Show a frame of the film: its number and its JPEG."""
        number, jpeg = frame
        self.frame = number.to_bytes(4, "little") + jpeg
