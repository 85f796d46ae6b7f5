"""What a user asks of a fit, and the settings of effects in a study file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, EffectSettings, check_ties, definitions, models
from frictrack.effects.models import Model
from frictrack.search import METHODS, SearchMethod, search_method
from frictrack.study import EffectTable


@dataclass(frozen=True)
class FitRequest:
    """What the user asked of a fit: a model, edits of it, and how it is fitted.

    Attributes
    ----------
    base
        Name of a model ("tustin"), or names of effects.
    edits
        Effects that were added ("+texture") or removed ("-viscous") since.
    domain, search, seed, per, over
        See `frictrack.fit`.
    settings
        Settings of a global search that were asked for, by name.

    Examples
    --------
    >>> request = FitRequest("tustin").edited("+texture")
    >>> request.name
    'tustin+texture'
    >>> request.edited("-texture") == FitRequest("tustin")
    True

    """

    base: str | tuple[str, ...]
    edits: tuple[str, ...] = ()
    domain: str = "displacement"
    search: str = "varpro"
    seed: int = 0
    per: str | None = None
    over: str = "all"
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> str | SearchMethod:
        """The search for `frictrack.fit`: its name, or with settings its record.

        Raises
        ------
        FrictrackError
            (usage) For settings that the search does not have, or that are out of range.

        """
        if self.search == "varpro" and self.settings:
            raise FrictrackError(
                f"expected settings ({', '.join(self.settings)}) with a global search ({', '.join(METHODS)}) but the "
                "search is varpro; add --search mga, for example",
                usage=True,
            )
        return search_method(self.search, self.settings) if self.settings else self.search

    def edited(self, edit: str) -> FitRequest:
        """Return the request with one more edit (``"+texture"``, ``"-viscous"``); opposite edits cancel."""
        opposite = ("-" if edit[0] == "+" else "+") + edit[1:]
        kept = tuple(e for e in self.edits if e != opposite)
        return replace(self, edits=kept if len(kept) < len(self.edits) else (*self.edits, edit))

    def model(self, tables: Iterable[EffectTable] = ()) -> Model:
        """Return the model, with the settings of the study's `[[effect]]` tables.

        Raises
        ------
        FrictrackError
            (usage) For an unknown effect, or settings that contradict each other.

        """
        own = user_effects(tables)
        model = models.parse(self.base, own)
        for edit in self.edits:
            inside = edit[1:].partition(".")[0] in model
            added = edit[1:] if inside and "." in edit else effects.get(edit[1:], own)
            model = model + added if edit[0] == "+" else model - edit[1:]
        return apply_effect_tables(model, tables)

    @property
    def name(self) -> str:
        """A short name that can be the name of a group: ``tustin+texture``."""
        base = self.base if isinstance(self.base, str) else "+".join(self.base)
        return re.sub(r"[\s,/]+", "+", base) + "".join(self.edits)

    @classmethod
    def from_json(cls, text: str) -> FitRequest:
        """Read what `to_json` wrote."""
        raw = json.loads(text)
        base = raw["base"] if isinstance(raw["base"], str) else tuple(raw["base"])
        return cls(**(raw | {"base": base, "edits": tuple(raw["edits"])}))

    def to_json(self) -> str:
        """Return the request as JSON; equal requests give equal texts."""
        content = asdict(self)
        if not self.settings:  # as early versions wrote it: a fit without settings is not outdated
            del content["settings"]
        return json.dumps(content, sort_keys=True)


def apply_effect_tables(model: Model, tables: Iterable[EffectTable]) -> Model:
    """Return the model with the settings of `[[effect]]` tables; tables of effects that it lacks are ignored.

    Raises
    ------
    FrictrackError
        (usage) If settings contradict each other.

    """
    adjusted = model.adjusted(_settings(tables))
    check_ties(adjusted.effects)
    return adjusted


def user_effects(tables: Iterable[EffectTable]) -> list[Effect]:
    """Return the effects that `[[effect]]` tables define by a formula; every table is checked.

    Raises
    ------
    FrictrackError
        (usage) If a formula or a setting is wrong.

    """
    return definitions(_settings(tables))


def configured_effects(tables: Iterable[EffectTable]) -> list[Effect]:
    """Return every effect that has an `[[effect]]` table, with its settings applied."""
    settings = _settings(tables)
    own = definitions(settings)
    return [one.applied(effects.get(one.effect, own)) for one in settings]


def _settings(tables: Iterable[EffectTable]) -> list[EffectSettings]:
    return [EffectSettings(**table.model_dump()) for table in tables]
