"""The linked plots and the film as a component of the page; the same module shows in a notebook."""

from __future__ import annotations

from importlib.resources import files

import param
from panel.custom import AnyWidgetComponent

from frictrack.workbench.scenes import Scene

MODULE = files("frictrack.workbench").joinpath("linked.js").read_text(encoding="utf-8")


class Linked(AnyWidgetComponent):
    """See ``linked.js`` for what goes in and what comes out."""

    scene = param.Dict(default={})
    data = param.Bytes(default=b"")
    film = param.Dict(default={})
    frame = param.Bytes(default=b"")
    tool = param.String(default="")
    selection = param.Dict(default={})
    want = param.Dict(default={})
    drawn = param.Dict(default={})
    moved = param.Dict(default={})

    _esm = MODULE
    _debounce = 0  # ms; Panel waits 50 otherwise

    def draw(self, scene: Scene) -> None:
        """Draw other data."""
        told, data = scene.packed()
        self.param.update(scene=told, data=data)

    def picture(self, frame: tuple[int, bytes]) -> None:
        """Show a frame of the film: its number and its JPEG."""
        number, jpeg = frame
        self.frame = number.to_bytes(4, "little") + jpeg
