"""A small library of effects: for tests of what is done with a diagnosis, not of what it finds."""

from __future__ import annotations

import pytest

from frictrack import effects
from frictrack.effects import LIBRARY, registry

FEW = ("coulomb", "stribeck", "viscous", "drag", "texture", "slope", "lens")


def use_few_effects(patched: pytest.MonkeyPatch, names: tuple[str, ...] = FEW) -> None:
    """Let the library hold a few effects while the patch lasts."""
    few = {name: LIBRARY[name] for name in names}
    patched.setattr(effects, "LIBRARY", few)
    patched.setattr(registry, "LIBRARY", few)
