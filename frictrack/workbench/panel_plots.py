"""Show the linked plots as a Panel component."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import param
from panel.custom import AnyWidgetComponent

from frictrack.workbench.linked_plots import MODULE, LinkedPlots


class PanelPlots(LinkedPlots, AnyWidgetComponent):
    """Linked plots; ``linked.js`` describes the values."""

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

    def set_values(self, **values: Any) -> None:
        """Set several values at once."""
        self.param.update(**values)

    def on_change(self, name: str, call: Callable[[dict[str, Any]], None]) -> None:
        """Call a function with the new value whenever the user changes the value `name`."""
        self.param.watch(lambda event: call(event.new), name)
