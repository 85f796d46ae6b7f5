"""Models: named sums of effects. `tustin() + "texture"` adds a cause, `- "viscous"` takes one away."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.effects import Effect, Path
from frictrack.errors import FrictrackError
from frictrack.records import Array

Values = Mapping[str, Mapping[str, float]]  # effect -> parameter -> value, for one run


@dataclass(frozen=True)
class Model:
    """A friction law (and picture of it) as a sum of effects.

    An effect that modifies others (a load modulation) reshapes their columns; one that replaces others
    (`atm2`) takes their place.
    """

    effects: tuple[Effect, ...]

    def __post_init__(self) -> None:
        names = [e.name for e in self.effects]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            hint = f"write {twice[0]}:2 for a second one"
            raise FrictrackError(f"expected every effect once but got {', '.join(twice)} twice; {hint}", usage=True)
        if not names:
            raise FrictrackError("expected at least one effect but got an empty model", usage=True)
        kinds = {e.kind for e in self.effects}
        idle = [e for e in self.effects if e.modifies and not kinds & e.modifies]
        if idle:
            wanted = " or ".join(sorted(idle[0].modifies))
            raise FrictrackError(f"{idle[0].name} modifies {wanted}, and the model has neither; add one", usage=True)

    @property
    def names(self) -> list[str]:
        """The effects in order."""
        return [e.name for e in self.effects]

    @property
    def memory(self) -> bool:
        """Whether the force depends on the whole motion so far."""
        return any(e.memory for e in self.effects if e.acts_on == "force")

    @property
    def turns(self) -> bool:
        """Whether the force passes stops and reversals without a jump, so that a run can be followed through them."""
        return any(e.turns for e in self.effects)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __add__(self, other: str | Effect) -> Model:
        """The model with one more effect; what the new one replaces is dropped."""
        new = effects.get(other) if isinstance(other, str) else other
        return Model((*(e for e in self.effects if e.kind not in new.replaces), new))

    def __sub__(self, name: str) -> Model:
        """The model without the effect of that name."""
        if name not in self:
            known = ", ".join(self.names)
            raise FrictrackError(f'expected an effect of the model ({known}) to remove but got "{name}"', usage=True)
        return Model(tuple(e for e in self.effects if e.name != name))

    def __str__(self) -> str:
        force = [e.equation for e in self.effects if e.acts_on == "force"]
        picture = [e.equation for e in self.effects if e.acts_on == "measurement"]
        return "F = " + " + ".join(force) + "".join(f"; {p}" for p in picture)

    def next_instance(self, kind: str) -> str:
        """The name under which one more effect of that kind would enter."""
        if kind not in self:
            return kind
        return next(f"{kind}:{i}" for i in range(2, 99) if f"{kind}:{i}" not in self)

    def force_columns(self, path: Path, values: Values) -> dict[str, Array]:
        """Columns of every force effect along the path, each (n, k), modifiers applied to what they modify."""
        made = {
            e.name: e.columns(path, values[e.name]) for e in self.effects if e.acts_on == "force" and not e.modifies
        }
        for modifier in sorted((e for e in self.effects if e.modifies), key=lambda e: e.rank):
            for e in self.effects:
                if e.kind in modifier.modifies and e.name in made:
                    made[e.name] = modifier.columns(path, values[modifier.name], made[e.name])
        return made

    def measurement_columns(self, path: Path, values: Values) -> dict[str, Array]:
        """Columns of every measurement effect along the path, each (n, k), m per unit coefficient."""
        return {e.name: e.columns(path, values[e.name]) for e in self.effects if e.acts_on == "measurement"}

    def force(self, path: Path, values: Values) -> Array:
        """Total friction force along the path, N, shape (n,)."""
        columns = self.force_columns(path, values)
        total = np.zeros_like(path.v)
        for name, block in columns.items():
            total += block @ self.coefficients(name, values)
        return total

    def coefficients(self, name: str, values: Values) -> Array:
        """Linear coefficients of one effect, in the order of its columns."""
        effect = next(e for e in self.effects if e.name == name)
        return np.array([values[name][p.name] for p in effect.linear])


def of(names: Iterable[str | Effect]) -> Model:
    """The model that sums the named effects."""
    return Model(tuple(effects.get(n) if isinstance(n, str) else n for n in names))


def tustin() -> Model:
    """Tustin model (TM): Coulomb + Stribeck with delta = 1 + viscous (first paper, Eq. 2)."""
    return of(["coulomb", "stribeck", "viscous"])


def stribeck_model() -> Model:
    """Stribeck model with the exponent delta free (first paper, Eq. 1)."""
    free = effects.get("stribeck").adjusted(delta={"fixed": None})
    return of(["coulomb", free, "viscous"])


def _instances(kind: str, n: int) -> list[str]:
    return [kind if i == 1 else f"{kind}:{i}" for i in range(1, n + 1)]


def atm1(n: int) -> Model:
    """Augmented Tustin model 1: Tustin plus n sine forces in time (first paper, Eq. 3)."""
    return of(["coulomb", "stribeck", "viscous", *_instances("vibration", n)])


def atm2(n: int) -> Model:
    """Augmented Tustin model 2 as printed (first paper, Eq. 4)."""
    return of([f"atm2:{n}"])


def dahl() -> Model:
    """Dahl model: Coulomb friction that builds up like a spring that yields, and viscous friction (Dahl 1968)."""
    return of(["coulomb", "viscous", "presliding"])


def lugre() -> Model:
    """LuGre model; its sigma_2 is the viscous coefficient (Canudas de Wit et al. 1995)."""
    return of(["lugre", "viscous"])


NAMED: dict[str, Any] = {
    "tustin": tustin,
    "stribeck-model": stribeck_model,
    "dahl": dahl,
    "lugre": lugre,
    "atm1": atm1,
    "atm2": atm2,
}


def parse(text: str | Sequence[str]) -> Model:
    """Model from its name (`tustin`, `atm1:2`), a comma list or a list of effects.

    Raises FrictrackError (usage) for a name that is neither.
    """
    if not isinstance(text, str):
        return of(text)
    kind, _, order = text.partition(":")
    if kind in ("atm1", "atm2"):
        if not order.isdigit() or int(order) < 1:
            raise FrictrackError(f'expected an order after the colon, as in "{kind}:2", but got "{text}"', usage=True)
        model: Model = NAMED[kind](int(order))
        return model
    if text in NAMED:
        named: Model = NAMED[text]()
        return named
    near = difflib.get_close_matches(text, NAMED, 1)
    if near and "," not in text and kind not in effects.LIBRARY:
        raise FrictrackError(f'expected the name of a model but got "{text}"; did you mean "{near[0]}"?', usage=True)
    return of([part.strip() for part in text.split(",") if part.strip()])
