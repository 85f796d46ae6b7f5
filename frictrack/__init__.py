"""Identify friction laws from films of a sliding mass, and find the physical effect that a law lacks.

    import frictrack as ft
    runs = [ft.Run.from_arrays(t, x, mass=0.35, name=name) for name, (t, x) in measured.items()]
    fit = ft.fit("tustin", runs)
    print(ft.diagnose(fit))

or from a film:

    track = ft.track(ft.open_recording("strike_01.avi", fps=4000))
    displacement = ft.calibrate(track, scale="0.5 mm/px")
    run = ft.Run(displacement, ft.differentiate(ft.low_pass(displacement)), mass=0.35)

Names are imported when they are first used, so that `frictrack --help` starts quickly.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any

from frictrack.base import imports_of

if TYPE_CHECKING:
    from frictrack import effects, samples, search, simulate
    from frictrack.base import __version__
    from frictrack.base.errors import FrictrackError
    from frictrack.diagnose import Diagnosis, diagnose
    from frictrack.diagnose.compare import Comparison, ParameterByGroup, compare, compare_groups, history
    from frictrack.effects import effect, models
    from frictrack.fit import CovariateTrends, Fit, GroupFits, bootstrap, fit, profile, trend
    from frictrack.measure.calibration import calibrate, plane_map
    from frictrack.measure.error_budget import budget
    from frictrack.measure.friction import find_events, free_section, friction, with_earlier_runs
    from frictrack.measure.motion import KnownAcceleration, covariance, cutoff_tradeoff, differentiate, low_pass
    from frictrack.measure.repairing import repair, suspect_spans
    from frictrack.recording import open_recording
    from frictrack.records import Displacement, Motion, Run, Track
    from frictrack.settings.filters import FilterChoice
    from frictrack.settings.priors import Prior
    from frictrack.tracking import align_track, contact_sheet, learn_target, track

_MODULE_OF = imports_of(__name__)
_ALIASES = {  # the names of modules that users know, and the room in which each stands
    "costs": "settings.costs",
    "crate": "flow.crate",
    "models": "effects.models",
    "plan": "diagnose.experiments",
    "plots": "present.plots",
}

__all__ = [  # written out: a type checker reads which names are public
    "Comparison",
    "CovariateTrends",
    "Diagnosis",
    "Displacement",
    "FilterChoice",
    "Fit",
    "FrictrackError",
    "GroupFits",
    "KnownAcceleration",
    "Motion",
    "ParameterByGroup",
    "Prior",
    "Run",
    "Track",
    "__version__",
    "align_track",
    "bootstrap",
    "budget",
    "calibrate",
    "compare",
    "compare_groups",
    "contact_sheet",
    "covariance",
    "cutoff_tradeoff",
    "diagnose",
    "differentiate",
    "effect",
    "effects",
    "find_events",
    "fit",
    "free_section",
    "friction",
    "history",
    "learn_target",
    "low_pass",
    "models",
    "open_recording",
    "plane_map",
    "profile",
    "repair",
    "samples",
    "search",
    "simulate",
    "suspect_spans",
    "track",
    "trend",
    "with_earlier_runs",
]


class _Package(ModuleType):
    """The package: imports names when they are first used; a function hides the module of the same name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (isinstance(value, ModuleType) and _MODULE_OF.get(name, "frictrack") != "frictrack"):
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name in _ALIASES:
            return import_module(f"frictrack.{_ALIASES[name]}")
        if _MODULE_OF.get(name) == "frictrack":
            return import_module(f"frictrack.{name}")
        if name in _MODULE_OF:
            value = getattr(import_module(_MODULE_OF[name]), name)
            if isinstance(value, FunctionType):
                value = import_module("frictrack.base.arguments").checked(value)
                value.__module__ = "frictrack"  # where pickle finds it
            setattr(self, name, value)
            return value
        raise AttributeError(f"module 'frictrack' has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return sorted(__all__)


class _Alias(ModuleType):
    """What `from frictrack.plots import ...` finds: the names of the module in its room, which is imported now."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__all__":
            raise AttributeError(name)
        return getattr(getattr(sys.modules["frictrack"], self.__name__.rpartition(".")[2]), name)


sys.modules[__name__].__class__ = _Package
sys.modules.update({f"frictrack.{name}": _Alias(f"frictrack.{name}") for name in _ALIASES})
