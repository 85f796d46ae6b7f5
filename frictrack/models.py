"""Models: named sums of effects. `tustin() + "texture"` adds a cause, `- "viscous"` takes one away.

A model's effects carry their settings: fixed values, bounds, priors, ties. `to_toml` writes all, `from_toml` reads it.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.effects import Effect, EffectSettings, Path
from frictrack.errors import FrictrackError
from frictrack.number_format import format_concise
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

    def clock(self, values: Values) -> float:
        """True over recorded time since release, by the effects of the clock of a run."""
        return float(np.prod([e.clock(values[e.name]) for e in self.effects if e.clock is not None]))

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
        return self.equation()

    def equation(self, estimates: Mapping[str, Any] | None = None) -> str:
        """The law as a sum; with `estimates` (by address, each with value and std) numbers stand for the symbols.

        What has no value there, such as a phase of every run, stays a symbol.
        """
        force = [self._written(e, estimates or {}) for e in self.effects if e.acts_on == "force"]
        picture = [self._written(e, estimates or {}) for e in self.effects if e.acts_on == "measurement"]
        return "F = " + (" + ".join(force) or "0") + "".join(f"; {p}" for p in picture)

    def _written(self, effect: Effect, estimates: Mapping[str, Any]) -> str:
        """The equation of one effect, the symbols of a further instance with its number."""
        _, _, number = effect.name.partition(":")
        text = effect.equation
        others = {p.name: f"{e.name}.{p.name}" for e in self.effects for p in e.parameters if e is not effect}
        own = {p.name: f"{effect.name}.{p.name}" for p in effect.parameters}
        for name, address in (others | own).items():
            found = estimates.get(address)
            symbol = f"{name}_{number}" if number and name in own and effect.kind != effect.name else name
            if found is not None and found.value is not None:
                symbol = format_concise(found.value, found.std)
            text = re.sub(rf"\b{name}\b", symbol, text)
        return text

    def base(self, effect: Effect) -> Effect:
        """One of the effects as it is without settings: from the library, its formula, or its declaration.

        Raises FrictrackError for one that is none of these.
        """
        if effect.formula is not None:
            return effects.formula(
                effect.kind,
                effect.formula,
                units={p.name: p.unit for p in effect.parameters},
                bounds={p.name: p.bounds for p in effect.parameters},
                acts_on=effect.acts_on,
            ).called(effect.name)
        try:
            return effects.get(effect.name)
        except FrictrackError as e:
            raise FrictrackError(
                f"{effect.name} is neither of the library nor a formula; declare it with @frictrack.effect first"
            ) from e

    @property
    def settings(self) -> list[str]:
        """What differs from the library, in words: `stribeck.delta free`, `vibration.frequency = 60 Hz`."""
        out = []
        for e in self.effects:
            try:
                different = effects.differences(e, self.base(e))
            except FrictrackError:  # made by hand: nothing to differ from
                continue
            out += [_said(e, name, key, value) for key, of in different.items() for name, value in of.items()]
        return out

    def adjusted(self, told: Iterable[EffectSettings]) -> Model:
        """The model with the settings of those of its effects that `told` speaks of; the others wait."""
        of = {one.effect: one for one in told}
        return Model(tuple(of[e.name].applied(e) if e.name in of else e for e in self.effects))

    def to_toml(self) -> str:
        """The model as a study file has it: `model`, and an `[[effect]]` table where settings differ from the library.

        Raises FrictrackError for an effect that is neither of the library nor a formula nor declared.
        """
        import tomlkit  # noqa: PLC0415 - only to write

        document = tomlkit.document()
        document["model"] = self.names
        tables = tomlkit.aot()
        for name, keys in self._tables().items():
            table = tomlkit.table()
            table["effect"] = name
            for key, value in keys.items():
                table[key] = value if isinstance(value, str) else _inline(value)
            tables.append(table)
        if len(tables):
            document["effect"] = tables
        return tomlkit.dumps(document)

    def _tables(self) -> dict[str, dict[str, Any]]:
        """EffectSettings of every effect that has some, formulas among them."""
        out: dict[str, dict[str, Any]] = {}
        for e in self.effects:
            if e.formula is not None:
                shut = {p.name: p.bounds for p in e.parameters if np.any(np.isfinite(p.bounds))}
                units = {p.name: p.unit for p in e.parameters if p.unit != "1"}
                told = {"formula": e.formula, "acts_on": e.acts_on, "units": units, "bounds": shut}
                out.setdefault(e.kind, {}).update({k: v for k, v in told.items() if v and v != "force"})
            different = effects.differences(e, self.base(e))
            if different:
                out.setdefault(e.name, {}).update(different)
        return out

    def next_instance(self, kind: str) -> str:
        """The name under which one more effect of that kind would enter."""
        if kind not in self:
            return kind
        return next(f"{kind}:{i}" for i in range(2, 99) if f"{kind}:{i}" not in self)

    def force_columns(self, path: Path, values: Values) -> dict[str, Array]:
        """Columns of every force effect along the path, each (n, k), modifiers applied to what they modify."""
        return self._formed(path, values, None)

    def states(self, path: Path, values: Values) -> dict[str, Array]:
        """What every effect with memory remembers at the last sample of a path, (1, k) each: `Path.states` from there.

        The path is that of one individual.
        """
        out: dict[str, Array] = {}
        self._formed(path, values, out)
        return out

    def _formed(self, path: Path, values: Values, states: dict[str, Array] | None) -> dict[str, Array]:
        """Columns of every force effect; what is remembered at the end of the path is put into `states`, if given."""

        def columns(e: Effect, *inner: Array) -> Array:
            entered = replace(path, begin=path.states[e.name]) if e.name in path.states else path
            if states is not None and e.state is not None:
                states[e.name] = e.state(entered, values[e.name], *inner)[-1:]
            return e.columns(entered, values[e.name], *inner)

        made = {e.name: columns(e) for e in self.effects if e.acts_on == "force" and not e.modifies}
        for modifier in sorted((e for e in self.effects if e.modifies), key=lambda e: e.rank):
            reshaped = [e.name for e in self.effects if e.kind in modifier.modifies and e.name in made]
            if reshaped:
                whole = np.concatenate([made[name] for name in reshaped], axis=1)
                ends = np.cumsum([made[name].shape[1] for name in reshaped])[:-1]
                bent = np.split(columns(modifier, whole), ends, axis=1)
                made |= dict(zip(reshaped, bent, strict=True))
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


def _inline(value: Mapping[str, Any]) -> Any:
    import tomlkit  # noqa: PLC0415

    table = tomlkit.inline_table()
    table.update({k: list(map(float, v)) if isinstance(v, tuple) else v for k, v in value.items()})
    return table


_KEYS = {
    "fix": lambda p, v: f"{p.name} free" if v is False else f"{p.name} = {v:g} {p.unit}",
    "bounds": lambda p, v: f"{p.name} in [{v[0]:g}, {v[1]:g}] {p.unit}",
    "prior": lambda p, v: f"{p.name} known as {v[0]:g} \N{PLUS-MINUS SIGN} {v[1]:g} {p.unit}",
    "tie": lambda p, v: f"{p.name} = {v}",
    "per_run": lambda p, v: f"{p.name} {'per run' if v else 'shared'}",
}


def _said(effect: Effect, name: str, key: str, value: Any) -> str:
    text: str = _KEYS[key](effect.parameter(name), value)
    return f"{effect.name}.{text.removesuffix(' 1')}"


def of(names: Iterable[str | Effect], extra: Iterable[Effect] = ()) -> Model:
    """The model that sums the named effects; `extra` are effects beside the library's, such as a study's formulas."""
    extra = list(extra)
    return Model(tuple(effects.get(n, extra) if isinstance(n, str) else n for n in names))


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


def parse(text: str | Sequence[str], extra: Iterable[Effect] = ()) -> Model:
    """Model from its name (`tustin`, `atm1:2`), a comma list or a list of effects, `extra` as in `of`.

    Raises FrictrackError (usage) for a name that is neither.
    """
    extra = list(extra)
    if not isinstance(text, str):
        return of(text, extra)
    kind, _, _ = text.partition(":")
    if kind in ("atm1", "atm2") and "," not in text:
        model: Model = NAMED[kind](effects.order(text))
        return model
    if text in NAMED:
        named: Model = NAMED[text]()
        return named
    near = difflib.get_close_matches(text, NAMED, 1)
    if near and "," not in text and kind not in effects.known(extra):
        raise FrictrackError(f'expected the name of a model but got "{text}"; did you mean "{near[0]}"?', usage=True)
    return of([part.strip() for part in text.split(",") if part.strip()], extra)


def from_toml(source: str | FilePath) -> Model:
    """The model that a TOML text or file holds: `to_toml`'s, or that of a study file (its `model` and `[[effect]]`).

    Raises FrictrackError (usage) for what is not TOML, an unknown name, or settings that do not go together.
    """
    file = FilePath(source) if isinstance(source, FilePath) or str(source).endswith(".toml") else None
    try:
        raw = tomllib.loads(str(source) if file is None else file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, OSError) as e:
        raise FrictrackError(
            f"expected a model in TOML but got {file or 'a text'} that cannot be read: {e}", usage=True
        ) from e
    asked = raw.get("model", raw.get("study", {}).get("model"))
    if not isinstance(asked, str | list):
        raise FrictrackError(
            'expected model = a name or a list of effects, as in model = ["coulomb", "viscous"]', usage=True
        )
    told = [effects.read_settings(table) for table in raw.get("effect", [])]
    model = parse(asked, effects.definitions(told)).adjusted(told)
    effects.check_ties(model.effects)
    return model
