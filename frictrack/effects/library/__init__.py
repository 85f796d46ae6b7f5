"""The effects of the library: every file of this folder is one effect, of the name of the file.

What a file assigns and its functions are the fields of `Effect` of the same names: `equation`, `parameters`, `columns`,
`what` and so on. A new file is found by itself. `ORDER` only says where an effect stands in lists; those that it does
not name come last, in alphabetical order.
"""

from __future__ import annotations

import pkgutil
from dataclasses import fields
from importlib import import_module
from types import ModuleType

from frictrack.effects.definition import Effect

ORDER = (
    *("coulomb", "stribeck", "viscous", "drag", "vibration", "decaying_vibration", "beam_vibration", "texture"),
    *("patch", "spring", "collision", "thermal", "drift", "asymmetry", "slope", "load_modulation"),
    *("measured_load", "viscous_modulation", "drive_error", "drive_delay", "drive_offset", "cell_lag"),
    *("cell_delay", "cell_drift", "lens", "peak_locking", "camera_shake", "dropped_frame", "timebase", "clock_rate"),
    *("target_rotation", "presliding", "friction_lag", "lugre", "bouc_wen", "elastic_joint", "flash_weakening"),
    *("log_velocity", "power_law_viscosity", "adhesion", "load_exponent", "gravity", "run_in", "heating"),
    *("rolling_shutter", "out_of_plane", "elasto_plastic", "maxwell_slip", "rate_state_ageing"),
    *("rate_state_slip", "eddy_brake", "hydrodynamic_hump"),
)
FIELDS = {field.name for field in fields(Effect)} - {"name"}
NEEDED = ("equation", "parameters", "columns")


def load_library() -> dict[str, Effect]:
    """Import every file of this folder.

    Returns
    -------
    dict of Effect
        Effects by name, in the order of `ORDER`.

    Raises
    ------
    TypeError
        For a file without a needed field, or one that assigns what is no field of an effect.

    Examples
    --------
    >>> next(iter(load_library()))
    'coulomb'

    """
    files = [module.name for module in pkgutil.iter_modules(__path__)]
    place = {name: i for i, name in enumerate(ORDER)}
    files.sort(key=lambda name: (place.get(name, len(ORDER)), name))
    return {name: _effect(name, import_module(f"{__name__}.{name}")) for name in files}


def _effect(name: str, module: ModuleType) -> Effect:
    """The effect that a file defines; constants of its own are in capitals."""
    lacking = [key for key in NEEDED if not hasattr(module, key)]
    assigned = [key for key, value in vars(module).items() if isinstance(value, str | int | tuple | frozenset | dict)]
    unknown = [key for key in assigned if key.islower() and key[0] != "_" and key not in FIELDS]
    if lacking or unknown:
        fault = f"expected {lacking[0]}" if lacking else f'unknown field "{unknown[0]}" of an effect'
        raise TypeError(f"effects/library/{name}.py: {fault}; see the fields of Effect")
    return Effect(name=name, **{key: value for key, value in vars(module).items() if key in FIELDS})
