"""The effects of the library: every file of this folder defines one effect, under the name of the file.

A new file is found by itself. `ORDER` only says where an effect stands in lists; those that it does not name come last,
in alphabetical order.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module

from frictrack.effects.definition import Effect

ORDER = (
    *(
        "coulomb",
        "stribeck",
        "viscous",
        "drag",
        "vibration",
        "decaying_vibration",
        "beam_vibration",
        "texture",
        "patch",
    ),
    *("spring", "collision", "thermal", "drift", "asymmetry", "slope", "load_modulation", "measured_load"),
    *("viscous_modulation", "drive_error", "lens", "peak_locking", "camera_shake", "dropped_frame", "timebase"),
    *("clock_rate", "target_rotation", "presliding", "friction_lag", "lugre", "bouc_wen", "elastic_joint"),
    *("flash_weakening", "log_velocity", "power_law_viscosity", "adhesion", "load_exponent"),
    *("run_in", "heating"),
    *("rolling_shutter", "out_of_plane"),
    *("elasto_plastic", "maxwell_slip", "rate_state_ageing", "rate_state_slip", "eddy_brake", "hydrodynamic_hump"),
)


def load_library() -> dict[str, Effect]:
    """Import every file of this folder.

    Returns
    -------
    dict of Effect
        Effects by name, in the order of `ORDER`.

    Raises
    ------
    TypeError
        For a file that does not define an effect of its own name.

    Examples
    --------
    >>> next(iter(load_library()))
    'coulomb'

    """
    files = [module.name for module in pkgutil.iter_modules(__path__)]
    place = {name: i for i, name in enumerate(ORDER)}
    found = {}
    for name in sorted(files, key=lambda name: (place.get(name, len(ORDER)), name)):
        effect = getattr(import_module(f"{__name__}.{name}"), name, None)
        if not isinstance(effect, Effect) or effect.name != name:
            raise TypeError(f'effects/library/{name}.py: expected an Effect called "{name}" but found {effect!r:.80}')
        found[name] = effect
    return found
