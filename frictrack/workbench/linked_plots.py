"""Define the interface of the linked plots in the browser, common to the page and to notebooks."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

from frictrack.workbench.plot_data import PlotData

MODULE = files("frictrack.workbench").joinpath("linked.js").read_text(encoding="utf-8")  # its head describes the values


class LinkedPlots:
    """Linked plots; the page and the notebook implement how values are set and how changes are reported."""

    film: dict[str, Any]
    frame: bytes

    def set_values(self, **values: Any) -> None:
        """Set several values at once.

        Parameters
        ----------
        **values
            Values of `linked.js` by name.

        """
        raise NotImplementedError

    def on_change(self, name: str, call: Callable[[dict[str, Any]], None]) -> None:
        """Call a function whenever the user changes a value.

        Parameters
        ----------
        name : str
            Name of the value in `linked.js`.
        call : callable
            Gets the new value.

        """
        raise NotImplementedError

    def draw(self, scene: PlotData) -> None:
        """Draw new data."""
        layout, data = scene.pack()
        self.set_values(scene=layout, data=data)

    def show_frame(self, frame: tuple[int, bytes]) -> None:
        """Show a frame of the film.

        Parameters
        ----------
        frame : tuple
            Number of the frame and its JPEG.

        """
        number, jpeg = frame
        self.frame = number.to_bytes(4, "little") + jpeg
