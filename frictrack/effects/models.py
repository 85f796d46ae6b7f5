"""Build models, which are named sums of effects.

``tustin() + "texture"`` adds an effect, ``tustin() - "viscous"`` removes one. The effects of a model contain their
settings: fixed values, bounds, priors, ties. `Model.to_toml` writes a model with its settings, `from_toml` reads it.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.base.arguments import checked
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.files import read_small_text
from frictrack.base.number_format import format_plus_minus
from frictrack.effects import Effect, EffectSettings, Path
from frictrack.records import Array
from frictrack.study import read_toml

COMMON_SYMBOLS = frozenset("FLsxvtDmyS")  # of all equations: the whole force, load and level, direction, motion ...
MAX_MODEL_BYTES = 1 << 20  # of a file that holds a model
Values = Mapping[str, Mapping[str, float]]  # effect -> parameter -> value, for one run


@dataclass(frozen=True, repr=False)
class Model:
    """A friction law, and the errors of its measurement, as a sum of effects.

    Effects that modify others, such as a load modulation, change the columns of those. An effect that replaces
    others (`atm2`) removes them from the model when it is added.

    Parameters
    ----------
    effects : tuple of Effect
        The effects, each at most once.
    unused : tuple of EffectSettings
        Settings of other effects, for those that the runs add (`slope`, `gravity`).

    Raises
    ------
    FrictrackError
        If an effect is there twice, if there is none, or if an effect modifies others that are not in the model.

    Examples
    --------
    >>> (tustin() + "texture").names
    ['coulomb', 'stribeck', 'viscous', 'texture']
    >>> "viscous" in tustin() - "viscous"
    False
    >>> tustin()
    <Model: coulomb + stribeck + viscous>

    """

    effects: tuple[Effect, ...]
    unused: tuple[EffectSettings, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        names = [e.name for e in self.effects]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            hint = f"write {twice[0]}:2 for a second one"
            raise UsageError(f"expected every effect once but got {', '.join(twice)} twice; {hint}")
        if not names:
            raise UsageError("expected at least one effect but got an empty model")
        idle = [e for e in self.effects if e.modifies and not e.changed(self.effects)]
        if idle:
            wanted = " or ".join(sorted(idle[0].modifies))
            raise UsageError(f"{idle[0].name} modifies {wanted}, and the model has neither; add one")

    @property
    def names(self) -> list[str]:
        """Names of the effects in order."""
        return [e.name for e in self.effects]

    @property
    def memory(self) -> bool:
        """Whether the force depends on the motion before, and not on the present state alone."""
        return any(e.memory for e in self.effects if e.acts_on == "force")

    @property
    def turns(self) -> bool:
        """Whether the force is continuous at stops and reversals, so that the motion can be integrated through them."""
        return any(e.turns for e in self.effects)

    def clock(self, values: Values) -> float:
        """Ratio of true to recorded time since release, by the effects on the clock of a run."""
        return float(np.prod([e.clock(values[e.name]) for e in self.effects if e.clock is not None]))

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __add__(self, other: str | Effect) -> Model:
        """Add an effect, given or by its name; effects that it replaces are removed.

        An address of the model, such as "stribeck.delta", frees a fixed parameter, or gives every run its own value.
        """
        if isinstance(other, str):
            name, _, parameter = other.partition(".")
            known = next((e for e in self.effects if e.name == name and parameter), None)
            other = effects.get(other) if known is None else known.freed(parameter)
        new = other
        if new.frees and new.name in self:
            return Model(tuple(new if e.name == new.name else e for e in self.effects))
        return Model((*(e for e in self.effects if e.kind not in new.replaces), new))

    def __sub__(self, name: str) -> Model:
        """Remove the effect of that name; raises FrictrackError if it is not in the model."""
        if name not in self:
            known = ", ".join(self.names)
            raise UsageError(f'expected an effect of the model ({known}) to remove but got "{name}"')
        return Model(tuple(e for e in self.effects if e.name != name))

    def __repr__(self) -> str:
        return f"<Model: {' + '.join(self.names)}>"

    def __str__(self) -> str:
        return self.equation()

    def equation(self, estimates: Mapping[str, Any] | None = None) -> str:
        """Write the model as an equation.

        Parameters
        ----------
        estimates : mapping, optional
            Estimates by address ("coulomb.F_c"), each with `value` and `std`. They replace the symbols; parameters
            without an estimate, such as a phase per run, remain symbols.

        Returns
        -------
        str
            The friction force F as a sum, then the measurement effects after semicolons. A symbol that two effects
            have, or that stands for the whole force, ends with the name of its effect.

        """
        texts = [(e.acts_on, self._effect_equation(e, estimates or {})) for e in self.effects]
        force = " + ".join(text for on, text in texts if on == "force") or "0"
        return "; ".join([f"F = {force}", *(text for on, text in texts if on == "measurement")])

    def _effect_equation(self, effect: Effect, estimates: Mapping[str, Any]) -> str:
        """Equation of one effect with its numbers, and its symbols where there are none."""
        text, others = effect.equation, [e for e in self.effects if e is not effect]
        owner = {p.name: e for e in (*others, effect) for p in e.parameters}
        for name, of in owner.items():
            found = estimates.get(f"{of.name}.{name}")
            known = found is not None and found.value is not None
            symbol = _number(found.value, found.std) if known and found else self._symbol(of, name)
            text = re.sub(rf"(?<![\w,]){name}(?!\w)", symbol, text)
        return text

    def _symbol(self, effect: Effect, name: str) -> str:
        """Symbol of a parameter: its name, with its effect or the number of its instance where two would agree."""
        kind, _, number = effect.name.partition(":")
        kinds = {e.name.partition(":")[0] for e in self.effects if any(p.name == name for p in e.parameters)}
        if name in COMMON_SYMBOLS or len(kinds) > 1:
            name = f"{name}{',' if '_' in name else '_'}{kind}"
        return f"{name}_{number}" if number and effect.kind != effect.name else name

    def base(self, effect: Effect) -> Effect:
        """An effect without settings: from the library, its formula, or its declaration.

        Raises
        ------
        FrictrackError
            If the effect was made in another way.

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
                f"expected an effect of the library or a formula but got {effect.name}; "
                "declare it with @frictrack.effect first"
            ) from e

    @property
    def settings(self) -> list[str]:
        """Differences to the library as text: `stribeck.delta free`, `vibration.frequency = 60 Hz`."""
        out: list[str] = []
        for e in self.effects:
            with suppress(FrictrackError):  # not from the library: no settings to compare with
                different = effects.differences(e, self.base(e))
                follows = different.pop("follows_level", None)
                if follows is not None:
                    out.append(f"{e.name} {'follows' if follows else 'does not follow'} the friction levels")
                out += [_setting_text(e, name, key, v) for key, of in different.items() for name, v in of.items()]
        return out

    def adjusted(self, settings: Iterable[EffectSettings]) -> Model:
        """Apply settings to the effects of the model; those of other effects are kept for `joined_by`."""
        by_effect = {one.effect: one for one in settings}
        made = tuple(by_effect.pop(e.name).applied(e) if e.name in by_effect else e for e in self.effects)
        return Model(made, tuple(by_effect.values()))

    def joined_by(self, name: str, known: Mapping[str, Any]) -> Model:
        """Return the model with an effect that the runs add, and what they know of its one parameter.

        Settings of a user come first: a value that is fixed, freed or has a prior.
        """
        of_user = name in self or any(one.effect == name for one in self.unused)
        effect = next((e for e in self.effects if e.name == name), effects.get(name))
        for one in self.unused:
            effect = one.applied(effect) if one.effect == name else effect
        (p,) = effect.parameters
        if not of_user or (p.free and not (p.prior or "fixed" in known)):
            effect = effect.adjusted(**{p.name: {**known, "per_run": p.per_run or known["per_run"]}})
        return replace(self, effects=(*(e for e in self.effects if e.name != name), effect))

    def to_toml(self) -> str:
        """Write the model as in a study file: `model`, and an `[[effect]]` table for each effect with settings.

        Returns
        -------
        str
            TOML text, which `from_toml` reads.

        Raises
        ------
        FrictrackError
            If an effect is not of the library, not a formula and not declared.

        """
        import tomlkit  # noqa: PLC0415 - only to write

        document = tomlkit.document()
        document["model"] = self.names
        tables = tomlkit.aot()
        for name, keys in self._tables().items():
            table = tomlkit.table()
            table.update({"effect": name} | {k: _inline(v) if isinstance(v, Mapping) else v for k, v in keys.items()})
            tables.append(table)
        if len(tables):
            document["effect"] = tables
        return tomlkit.dumps(document)

    def _tables(self) -> dict[str, dict[str, Any]]:
        """Settings and formulas by effect, for the `[[effect]]` tables."""
        out: dict[str, dict[str, Any]] = {}
        for e in self.effects:
            if e.formula is not None:
                bounds = {p.name: p.bounds for p in e.parameters if np.any(np.isfinite(p.bounds))}
                units = {p.name: p.unit for p in e.parameters if p.unit != "1"}
                keys = {"formula": e.formula, "acts_on": e.acts_on, "units": units, "bounds": bounds}
                out.setdefault(e.kind, {}).update({k: v for k, v in keys.items() if v and v != "force"})
            different = effects.differences(e, self.base(e))
            if different:
                out.setdefault(e.name, {}).update(different)
        return out

    def next_instance(self, kind: str) -> str:
        """Name that a further effect of that kind gets: "vibration", then "vibration:2"."""
        if kind not in self:
            return kind
        return next(f"{kind}:{i}" for i in range(2, 99) if f"{kind}:{i}" not in self)

    def force_columns(self, path: Path, values: Values, states: dict[str, Array] | None = None) -> dict[str, Array]:
        """Columns of every force effect along a path, after the effects that modify others.

        Parameters
        ----------
        path : Path
            Motion of a run, n samples.
        values : mapping
            Non-linear parameters: effect -> parameter -> value.
        states : dict, optional
            Takes the states (n, k) along the path by effect; the last ones are the `Path.states` of what continues it.

        Returns
        -------
        dict
            Columns (n, k) by effect, N per unit coefficient.

        """
        path = self.pressed(path, values)

        def columns(e: Effect, *inner: Array) -> Array:
            entered = replace(path, begin=path.states[e.name]) if e.name in path.states else path
            if states is not None and e.state is not None:
                states[e.name] = e.state(entered, values[e.name], *inner)
                entered = replace(entered, remembered=states[e.name])
            return _columns_run_by_run(e, entered, values[e.name], inner)

        made = {e.name: columns(e) for e in self.effects if e.acts_on == "force" and not e.modifies}
        for modifier in sorted((e for e in self.effects if e.modifies), key=lambda e: e.rank):
            modified = [e.name for e in modifier.changed(self.effects)]
            if modified:
                inner = np.concatenate([made[name] for name in modified], axis=1)
                ends = np.cumsum([made[name].shape[1] for name in modified])[:-1]
                parts = np.split(columns(modifier, inner), ends, axis=1)
                made |= dict(zip(modified, parts, strict=True))
        return made

    def pressed(self, path: Path, values: Values) -> Path:
        """Return a path on a circle that stands upright with the load of the gravity and the slope of the model."""
        if not path.upright or "gravity" not in self or "g" not in values["gravity"]:
            return path
        assert path.mass is not None
        forward = values["slope"]["F"] * np.divide(path.mass_ratio, path.mass) if "slope" in self else 0.0
        return path.pressed(values["gravity"]["g"], forward)

    def states(self, path: Path, values: Values) -> dict[str, Array]:
        """States (n, k) of the effects with memory along a path, by effect."""
        out: dict[str, Array] = {}
        remembering = [e for e in self.effects if e.state is not None]
        needed = [*remembering, *(changed for e in remembering for changed in e.changed(self.effects))]
        needed += [e for e in self.effects if any(one in needed for one in e.changed(self.effects))]
        if needed:
            Model(tuple(e for e in self.effects if e in needed)).force_columns(path, values, out)
        return out

    def measurement_columns(self, path: Path, values: Values) -> dict[str, Array]:
        """Columns (n, k) of every measurement effect along a path, m per unit coefficient."""
        return {e.name: e.columns(path, values[e.name]) for e in self.effects if e.acts_on == "measurement"}

    def force(self, path: Path, values: Values) -> Array:
        """Total friction force along a path.

        Parameters
        ----------
        path : Path
            Motion of a run, n samples.
        values : mapping
            All parameters: effect -> parameter -> value.

        Returns
        -------
        Array
            (n,) force, N.

        """
        return self.force_of(self.force_columns(path, values), values, np.zeros_like(path.v))

    def force_of(self, columns: Mapping[str, Array], values: Values, start: Array) -> Array:
        """Add the forces of effects with the given columns (n, k) to `start` (n,), in place."""
        for e in self.effects:
            if e.name in columns:
                for column, p in zip(columns[e.name].T, e.linear, strict=True):
                    start += column * values[e.name][p.name]
        return start

    def effect_contribution(self, name: str, path: Path, values: Values) -> Array:
        """Compute what one effect adds to the friction force, or to the measured position.

        Parameters
        ----------
        name : str
            Name of the effect in the model.
        path : Path
            Motion of a run, n samples.
        values : mapping
            All parameters: effect -> parameter -> value.

        Returns
        -------
        Array
            (n,) force, N, or picture shift, m. For a modifier the change of the force that it makes.

        Examples
        --------
        >>> import numpy as np
        >>> from frictrack.effects import Path
        >>> path = Path(t=np.zeros(2), x=np.zeros(2), v=np.array([1.0, 2.0]), s=np.ones(2))
        >>> values = {"coulomb": {"F_c": 3.0}, "viscous": {"F_v": 0.5}}
        >>> of(["coulomb", "viscous"]).effect_contribution("viscous", path, values)
        array([0.5, 1. ])

        """
        effect = next(e for e in self.effects if e.name == name)
        if effect.modifies:
            return np.asarray(self.force(path, values) - (self - name).force(path, values))
        columns = self.force_columns if effect.acts_on == "force" else self.measurement_columns
        return np.asarray(columns(path, values)[name] @ self.coefficients(name, values))

    def coefficients(self, name: str, values: Values) -> Array:
        """Linear coefficients of one effect, in the order of its columns."""
        effect = next(e for e in self.effects if e.name == name)
        return np.array([values[name][p.name] for p in effect.linear])


def _columns_run_by_run(e: Effect, path: Path, values: Mapping[str, Any], inner: Sequence[Array]) -> Array:
    """Columns of an effect; of one that looks at what lies before the path, run by run if the path joins several."""
    if not path.runs or e.varies_with is not None or e.memory:
        return e.columns(path, values, *inner)
    made = []
    for rows, own in path.apart():
        values_there = {
            k: float(np.ravel(v)[rows.start] if isinstance(v, np.ndarray) else v) for k, v in values.items()
        }
        made.append(e.columns(own, values_there, *(part[rows] for part in inner)))
    return np.concatenate(made)


def _inline(value: Mapping[str, Any]) -> Any:
    import tomlkit  # noqa: PLC0415

    table = tomlkit.inline_table()
    for key, one in value.items():
        table[key] = (
            _inline(one) if isinstance(one, Mapping) else list(map(float, one)) if isinstance(one, tuple) else one
        )
    return table


_SETTING_TEXTS = {
    "fix": lambda p, v: f"{p.name} free" if v is False else f"{p.name} = {v:g} {p.unit}",
    "bounds": lambda p, v: f"{p.name} in [{v[0]:g}, {v[1]:g}] {p.unit}",
    "prior": lambda p, v: f"{p.name} known as {v[0]:g} \N{PLUS-MINUS SIGN} {v[1]:g} {p.unit}",
    "prior_correlation": lambda p, v: f"{p.name} correlated with {', '.join(v)} before the fit",
    "tie": lambda p, v: f"{p.name} = {v}",
    "per_run": lambda p, v: f"{p.name} {'per run' if v else 'shared'}",
}


def _number(value: float, std: float | None) -> str:
    """A number of an equation, in brackets where it has a standard deviation or a sign."""
    known = bool(std) and math.isfinite(std or 0.0)
    text = format_plus_minus(value, std) if known else f"{value:.4g}"
    return f"({text})" if known or value < 0 else text


def _setting_text(effect: Effect, name: str, key: str, value: Any) -> str:
    text: str = _SETTING_TEXTS[key](effect.parameter(name), value)
    return f"{effect.name}.{text.removesuffix(' 1')}"


@checked
def of(names: Iterable[str | Effect], extra: Iterable[Effect] = ()) -> Model:
    """Build the sum of some effects.

    Parameters
    ----------
    names : iterable of str or Effect
        Names of effects, or effects.
    extra : iterable of Effect
        Effects that are not in the library, such as the formulas of a study.

    Examples
    --------
    >>> of(["coulomb", "texture"]).names
    ['coulomb', 'texture']

    """
    extra = list(extra)
    return Model(tuple(effects.get(n, extra) if isinstance(n, str) else n for n in names))


def tustin() -> Model:
    """Tustin model (TM): Coulomb, Stribeck with delta = 1, and viscous friction (first paper, Eq. 2).

    Examples
    --------
    >>> tustin().names
    ['coulomb', 'stribeck', 'viscous']

    """
    return of(["coulomb", "stribeck", "viscous"])


def stribeck_model() -> Model:
    """Stribeck model: the Tustin model with a free exponent delta (first paper, Eq. 1).

    Examples
    --------
    >>> stribeck_model().names
    ['coulomb', 'stribeck', 'viscous']

    """
    return of(["coulomb", effects.get("stribeck").adjusted(delta={"fixed": None}), "viscous"])


@checked
def atm1(n: int) -> Model:
    """Augmented Tustin model 1: Tustin model and n sinusoidal forces in time (first paper, Eq. 3).

    Examples
    --------
    >>> atm1(1).names
    ['coulomb', 'stribeck', 'viscous', 'vibration']

    """
    if n < 1:
        raise UsageError(f"expected n of at least 1, the number of sinusoids, but got {n}")
    return of(
        ["coulomb", "stribeck", "viscous", *(f"vibration:{i}" if i > 1 else "vibration" for i in range(1, n + 1))]
    )


@checked
def atm2(n: int) -> Model:
    """Augmented Tustin model 2 (first paper, Eq. 4), with t in every sum.

    Examples
    --------
    >>> atm2(2).names
    ['atm2:2']

    """
    return of([f"atm2:{n}"])


@checked
def atm2_printed(n: int) -> Model:
    """Augmented Tustin model 2 as printed, without t in two of its three sums (first paper, Eq. 4).

    Examples
    --------
    >>> atm2_printed(2).names
    ['atm2_printed:2']

    """
    return of([f"atm2_printed:{n}"])


def dahl() -> Model:
    """Dahl model: Coulomb friction with presliding, and viscous friction.

    References
    ----------
    P. R. Dahl (1968): A Solid Friction Model, The Aerospace Corporation, TOR-0158(3107-18)-1.

    Examples
    --------
    >>> dahl().names
    ['coulomb', 'viscous', 'presliding']

    """
    return of(["coulomb", "viscous", "presliding"])


def lugre() -> Model:
    """LuGre model; its sigma_2 is the coefficient of viscous friction.

    References
    ----------
    C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky (1995): A new model for control of systems with friction,
    IEEE Trans. Automatic Control 40(3), 419-425.

    Examples
    --------
    >>> lugre().names
    ['lugre', 'viscous']

    """
    return of(["lugre", "viscous"])


NAMED: dict[str, Any] = {
    "tustin": tustin,
    "stribeck-model": stribeck_model,
    "dahl": dahl,
    "lugre": lugre,
    "atm1": atm1,
    "atm2": atm2,
    "atm2_printed": atm2_printed,
}


def parse(text: str | Sequence[str | Effect], extra: Iterable[Effect] = ()) -> Model:
    """Build a model from its name or from names of effects.

    Parameters
    ----------
    text : str or sequence of str
        Name of a model ("tustin", "atm1:2"), or names of effects and models separated by commas or in a list: a model
        stands for its effects.
    extra : iterable of Effect
        Effects that are not in the library, such as the formulas of a study.

    Raises
    ------
    FrictrackError
        (usage) If a name is neither that of a model nor that of an effect; the message tells its place.

    Examples
    --------
    >>> parse("coulomb, viscous").names
    ['coulomb', 'viscous']
    >>> parse("tustin + texture").names
    ['coulomb', 'stribeck', 'viscous', 'texture']

    """
    extra = list(extra)
    words = _words_of(text)
    _check_words(words, extra)
    whole = isinstance(text, str) and len(words) == 1
    return Model(tuple(effect for word in words for effect in _effects_of(word, extra, whole=whole)))


def names_in(text: str) -> list[str]:
    """Return the names in the text of a model, between commas or plus signs.

    Examples
    --------
    >>> names_in("coulomb + viscous"), names_in("coulomb,viscous")
    (['coulomb', 'viscous'], ['coulomb', 'viscous'])

    """
    return [part.strip() for part in text.replace("+", ",").split(",") if part.strip()]


def _words_of(given: object) -> list[str | Effect]:
    """Names and effects of a text, or of a list; raise an error for anything else."""
    if isinstance(given, str):
        return [*names_in(given)]
    words: list[str | Effect] = []
    for word in given if isinstance(given, Iterable) else [given]:
        if not isinstance(word, str | Effect):
            got = type(word).__name__
            raise UsageError(f'expected the name of a model, such as "tustin", or a list of effects but got {got}')
        words.append(word)
    return words


def _check_words(words: Sequence[str | Effect], extra: Sequence[Effect]) -> None:
    """Raise one error with every word that is neither a model nor an effect, its place and the nearest name."""
    known = list(dict.fromkeys([*NAMED, *effects.known(extra)]))
    unknown = [
        (f'"{word[:40]}"' + (f" (name {i} of {len(words)})" if len(words) > 1 else ""), word.partition(":")[0])
        for i, word in enumerate(words, 1)
        if isinstance(word, str) and word.partition(":")[0] not in known
    ]
    if not unknown:
        return
    nearest = [difflib.get_close_matches(kind, known, 1) for _, kind in unknown]
    named = " and ".join(place for place, _ in unknown)
    meant = " and ".join(f'"{near[0]}"' for near in nearest if near)
    hint = f"did you mean {meant}?" if meant else f"known are {', '.join(known)}"
    raise UsageError(f"expected names of models or effects but got {named}; {hint}")


def _effects_of(word: str | Effect, extra: Sequence[Effect], *, whole: bool) -> tuple[Effect, ...]:
    """Return the effects of a name; "lugre", a model and an effect, is the model if it is the whole text."""
    if not isinstance(word, str):
        return (word,)
    kind = word.partition(":")[0]
    if kind in ("atm1", "atm2", "atm2_printed"):
        return tuple(NAMED[kind](effects.order(word)).effects)
    if word in NAMED and (whole or word not in effects.known(extra)):
        return tuple(NAMED[word]().effects)
    return (effects.get(word, extra),)


@checked
def from_toml(source: str | FilePath) -> Model:
    """Read a model from TOML.

    Parameters
    ----------
    source : str or Path
        TOML text, or a TOML file: one written by `Model.to_toml`, or a study file.

    Raises
    ------
    FrictrackError
        If the text is not TOML, a name is unknown, or settings contradict each other.

    Examples
    --------
    >>> from_toml(of(["coulomb", "drag"]).to_toml()).names
    ['coulomb', 'drag']

    """
    file = FilePath(source) if isinstance(source, FilePath) or str(source).endswith(".toml") else None
    text = str(source) if file is None else read_small_text(file, MAX_MODEL_BYTES, "a model in the file")
    raw = read_toml("model" if file is None else file.name, text)
    asked = raw.get("model", raw.get("study", {}).get("model"))
    if not isinstance(asked, str | list):
        raise UsageError('expected model = a name or a list of effects, as in model = ["coulomb", "viscous"]')
    tables = [effects.read_settings(table) for table in raw.get("effect", [])]
    model = parse(asked, effects.definitions(tables)).adjusted(tables)
    effects.check_ties(model.effects)
    return model
