"""Identify friction laws from films of a sliding mass, and find the physical effect that a law lacks.

    import frictrack as ft
    track = ft.track(ft.open_recording("strike_01.avi", fps=4000))
    disp = ft.calibrate(track, scale="0.5 mm/px")
    run = ft.Run(disp, ft.differentiate(ft.low_pass(disp)), mass=0.35)
    fit = ft.fit("tustin", [run])
    print(ft.diagnose(fit).verdict)

Names are imported when they are first used, so that `frictrack --help` starts quickly.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

_MODULE_OF = {
    "open_recording": "recording",
    "track": "tracking",
    "learn_target": "tracking",
    "aligned": "tracking",
    "contact_sheet": "tracking",
    "calibrate": "calibration",
    "plane_map": "calibration",
    "low_pass": "motion",
    "differentiate": "motion",
    "covariance": "motion",
    "KnownAcceleration": "motion",
    "trade": "motion",
    "free_section": "friction",
    "friction": "friction",
    "happenings": "events",
    "budget": "budget",
    "fit": "fit",
    "profile": "fit",
    "bootstrap": "fit",
    "compare": "compare",
    "history": "compare",
    "diagnose": "diagnose",
    "effect": "effects",
    "Run": "records",
    "FrictrackError": "errors",
    "__version__": "version",
}
_MODULES = ("models", "effects", "search", "simulate")

__all__ = [*_MODULE_OF, *_MODULES]  # noqa: PLE0604 - they are strings


class _Package(ModuleType):
    """The package: imports names when they are first used; a function hides the module of the same name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _MODULE_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name in _MODULE_OF:
            value = getattr(import_module(f"frictrack.{_MODULE_OF[name]}"), name)
            setattr(self, name, value)
            return value
        if name in _MODULES:
            return import_module(f"frictrack.{name}")
        raise AttributeError(f"module 'frictrack' has no attribute {name!r}")


sys.modules[__name__].__class__ = _Package
