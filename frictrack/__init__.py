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
import warnings
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from frictrack.lazy import module_of

if TYPE_CHECKING:
    from frictrack import effects, models, samples, search, simulate
    from frictrack.calibration import calibrate, plane_map
    from frictrack.compare import Comparison, ParameterByGroup, compare, compare_groups, history
    from frictrack.covariates import CovariateTrends, trend
    from frictrack.diagnose import Diagnosis, diagnose
    from frictrack.effects import effect
    from frictrack.error_budget import budget
    from frictrack.errors import FrictrackError
    from frictrack.filters import FilterChoice
    from frictrack.fit import Fit, GroupFits, bootstrap, fit, profile
    from frictrack.friction import find_events, free_section, friction, with_earlier_runs
    from frictrack.motion import KnownAcceleration, covariance, cutoff_tradeoff, differentiate, low_pass
    from frictrack.priors import Prior
    from frictrack.recording import open_recording
    from frictrack.records import Displacement, Motion, Run, Track
    from frictrack.repairing import repair, suspect_spans
    from frictrack.tracking import align_track, contact_sheet, learn_target, track
    from frictrack.version import __version__

_MODULE_OF = module_of(
    {
        "recording": "open_recording",
        "tracking": "track learn_target align_track contact_sheet",
        "repairing": "repair suspect_spans",
        "calibration": "calibrate plane_map",
        "motion": "low_pass differentiate covariance KnownAcceleration cutoff_tradeoff",
        "filters": "FilterChoice",
        "friction": "free_section friction find_events with_earlier_runs",
        "error_budget": "budget",
        "fit": "fit profile bootstrap Fit GroupFits",
        "compare": "compare compare_groups history Comparison ParameterByGroup",
        "diagnose": "diagnose Diagnosis",
        "records": "Displacement Motion Track Run",
        "priors": "Prior",
        "covariates": "trend CovariateTrends",
        "effects": "effect",
        "errors": "FrictrackError",
        "version": "__version__",
    }
)
_RENAMED = {"aligned": "align_track", "happenings": "find_events", "trade": "cutoff_tradeoff"}  # in version 0.2
_MODULES = ("models", "effects", "samples", "search", "simulate")

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
        if not (name in _MODULE_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        if name in _MODULE_OF:
            value = getattr(import_module(f"frictrack.{_MODULE_OF[name]}"), name)
            setattr(self, name, value)
            return value
        if name in _RENAMED:
            warnings.warn(f"frictrack.{name} is now called {_RENAMED[name]}", DeprecationWarning, stacklevel=2)
            return getattr(self, _RENAMED[name])
        if name in _MODULES:
            return import_module(f"frictrack.{name}")
        raise AttributeError(f"module 'frictrack' has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return sorted(__all__)


sys.modules[__name__].__class__ = _Package
