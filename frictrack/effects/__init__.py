"""The library of physical effects: one cause per file, one line of the table each."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any

from frictrack.effects.asymmetry import asymmetry
from frictrack.effects.atm2 import atm2
from frictrack.effects.base import NEEDS, Effect, Parameter, Path, Span
from frictrack.effects.beam_vibration import beam_vibration
from frictrack.effects.bouc_wen import bouc_wen
from frictrack.effects.camera_shake import camera_shake
from frictrack.effects.clock_rate import clock_rate
from frictrack.effects.collision import collision
from frictrack.effects.coulomb import coulomb
from frictrack.effects.decaying_vibration import decaying_vibration
from frictrack.effects.drag import drag
from frictrack.effects.drift import drift
from frictrack.effects.drive_error import drive_error
from frictrack.effects.dropped_frame import dropped_frame
from frictrack.effects.formula import formula
from frictrack.effects.friction_lag import friction_lag
from frictrack.effects.lens import lens
from frictrack.effects.load_modulation import load_modulation
from frictrack.effects.lugre import lugre
from frictrack.effects.measured_load import measured_load
from frictrack.effects.patch import patch
from frictrack.effects.peak_locking import peak_locking
from frictrack.effects.presliding import presliding
from frictrack.effects.slope import slope
from frictrack.effects.spring import spring
from frictrack.effects.stribeck import stribeck
from frictrack.effects.target_rotation import target_rotation
from frictrack.effects.texture import texture
from frictrack.effects.thermal import thermal
from frictrack.effects.timebase import timebase
from frictrack.effects.user import DECLARED, effect
from frictrack.effects.vibration import vibration
from frictrack.effects.viscous import viscous
from frictrack.effects.viscous_modulation import viscous_modulation
from frictrack.errors import FrictrackError

__all__ = ["LIBRARY", "Effect", "Parameter", "Path", "Span", "atm2", "catalogue", "effect", "formula", "get", "known"]

MAX_INSTANCES = 99  # of one effect in a model
MAX_ORDER = 20  # sines of ATM1 and ATM2: 60 parameters and more; the papers stop at 4

LIBRARY: dict[str, Effect] = {
    e.name: e
    for e in (
        *(coulomb, stribeck, viscous, drag, vibration, decaying_vibration, beam_vibration, texture, patch, spring),
        *(collision, thermal, drift, asymmetry, slope, load_modulation, measured_load, viscous_modulation),
        *(drive_error, lens, peak_locking, camera_shake, dropped_frame, timebase, clock_rate, target_rotation),
        *(presliding, friction_lag, lugre, bouc_wen),
    )
}


def is_library(name: str) -> bool:
    """Whether a name is taken by the library."""
    return name in LIBRARY or name in ("atm2", "mass", "level")


def known(extra: Iterable[Effect] = ()) -> dict[str, Effect]:
    """Every effect by name: the library's, those declared in Python, and `extra` (formulas of a study, or adjusted)."""
    return LIBRARY | DECLARED | {e.name: e for e in extra}


def get(name: str, extra: Iterable[Effect] = ()) -> Effect:
    """The effect of that name: `texture`, a further instance `vibration:2`, or `atm2:2` (order 2).

    `extra` may hold further effects, such as the formulas of a study. Raises FrictrackError (usage) for an unknown
    name, naming the nearest right one.
    """
    kind, colon, suffix = name.partition(":")
    if kind == "atm2":
        return atm2(order(name) if colon else 2)
    number = _counted(suffix, MAX_INSTANCES)
    if suffix and number is None:
        raise FrictrackError(f'expected a number up to {MAX_INSTANCES} after the colon but got "{name}"', usage=True)
    table = known(extra)
    if name in table:
        return table[name]
    if kind not in table:
        near = difflib.get_close_matches(kind, [*table, "atm2"], 1)
        hint = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(table)}, atm2"
        raise FrictrackError(f'expected the name of an effect but got "{name}"; {hint}', usage=True)
    return table[kind].called(name) if number is not None and number > 1 else table[kind]


def order(name: str) -> int:
    """How many sines a model or an effect has by its name, as "atm1:2".

    Raises FrictrackError (usage) for one without an order, or with one beyond `MAX_ORDER`.
    """
    kind, _, suffix = name.partition(":")
    found = _counted(suffix, MAX_ORDER)
    if found is None:
        wanted = f'an order from 1 to {MAX_ORDER} after the colon, as in "{kind}:2"'
        raise FrictrackError(f'expected {wanted}, but got "{name[:40]}"', usage=True)
    return found


def _counted(text: str, most: int) -> int | None:
    """A number from 1 to `most`; None for another text. `int` reads further scripts, and thousands of digits slowly."""
    found = int(text) if re.fullmatch(r"[0-9]{1,4}", text) else 0
    return found if 1 <= found <= most else None


def catalogue(extra: Iterable[Effect] = ()) -> list[dict[str, Any]]:
    """Every effect as the command `effects` prints it: the library's, your own, and `extra`."""
    return [_entry(e) for e in (*known(extra).values(), atm2(2))]


def _entry(effect: Effect) -> dict[str, Any]:
    return {
        "name": effect.name,
        "acts_on": effect.acts_on,
        "equation": effect.equation,
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "linear": p.linear,
                "bounds": [float(b) if abs(b) < float("inf") else None for b in p.bounds],
                "per_run": p.per_run,
            }
            for p in effect.parameters
        ],
        "what": effect.what,
        "looks_like": effect.looks_like,
        "mistaken_for": effect.mistaken_for,
        "confirm": effect.confirm,
        "source": effect.source,
        "needs": [NEEDS[need][0] for need in effect.needs],
    }
