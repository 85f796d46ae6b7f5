"""The base of the search methods: a record of settings, checked when it is built, that is called to search.

`ft.fit`, `frictrack fit --set` and the table [search] of a study file share these records.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import Field, asdict, dataclass, field, fields, replace
from math import inf
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.search.evaluator import CostEvaluator

PAPER_NAMES = {"p_c": "crossover", "p_m": "mutation", "l": "bits"}  # symbol of the papers in small letters -> setting
WORDS = {"int": "a whole number", "float": "a number", "tuple": "two numbers", "bool": "true or false"}


def setting(
    default: Any,
    *,
    low: float = -inf,
    high: float = inf,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """Declare a setting: its default, its limits (`above` is exclusive), or the texts that it may be."""
    return field(default=default, metadata={"low": low, "high": high, "above": above, "choices": choices})


@dataclass(frozen=True)
class SearchMethod:
    """A search method with its settings; a setting that is None is chosen for each problem.

    Parameters
    ----------
    generations : int, optional
        Generations after the first. None: as many as the budget of evaluations allows.
    restarts : int
        Further searches from new random points; the best of all counts.
    seed : int, optional
        Seed of the random numbers. None: that of the fit.

    Raises
    ------
    FrictrackError
        (usage) For values out of range; all are listed.

    """

    name: ClassVar[str] = ""
    generations: int | None = setting(None, low=1, high=10**7)
    restarts: int = setting(0, low=0, high=1000)
    seed: int | None = setting(None, low=0)

    def __post_init__(self) -> None:
        refuse(self.name, *(fault for f in fields(self) for fault in _faults(f, getattr(self, f.name))))

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Ask the evaluator for the costs of points in the unit box until it stops the search, or until converged."""
        raise NotImplementedError

    @property
    def points(self) -> tuple[int, int] | None:
        """Points evaluated in the first and in every later generation; None where this varies."""
        return None

    def resolved(self, evaluator: CostEvaluator) -> Self:
        """Return the settings with a value for each that is None, chosen for the problem of the evaluator."""
        return self

    def filled(self, **chosen: Any) -> Self:
        """Return the settings with values for those that are None."""
        return replace(self, **{name: value for name, value in chosen.items() if getattr(self, name) is None})

    def generation_limit(self, max_evaluations: int) -> int | None:
        """Return G_max, the generations of one start within a budget of evaluations; None where it is not known."""
        if self.generations is not None or self.points is None:
            return self.generations
        first, each = self.points
        return max(1, -(-(max_evaluations - first) // each))

    def limit(self, evaluator: CostEvaluator) -> int:
        """Return G_max of a method that evaluates the same number of points in every generation; at least 1."""
        limit = self.generation_limit(evaluator.max_evaluations)
        assert limit is not None  # such methods know their points
        return limit

    def summary(self) -> dict[str, Any]:
        """Return the name of the method and all settings as JSON."""
        return {"method": self.name, **asdict(self)}


def read_settings(kind: type[SearchMethod], raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings by their names, as numbers: texts are read, and the papers' symbols are known.

    Parameters
    ----------
    kind : type
        The method.
    raw : mapping
        Values by name: "population", or a symbol as the papers write it, "P_c".

    Raises
    ------
    FrictrackError
        (usage) For unknown settings, with the list of the known ones, and for values out of range.

    """
    known = [f.name for f in fields(kind)]
    names = {key: key.lower() if key.lower() in known else PAPER_NAMES.get(key.lower(), key) for key in raw}
    faults = [f'expected a setting among {", ".join(known)} but got "{key}"' for key in raw if names[key] not in known]
    given = list(names.values())
    faults += [f"expected {name} once but got it twice" for name in sorted({n for n in given if given.count(n) > 1})]
    refuse(kind.name, *faults)
    found = {name: _read(raw[key]) for key, name in names.items()}
    kind(**found)  # checks the values
    return found


def refuse(name: str, *faults: str) -> None:
    """Raise FrictrackError (usage) if there are faults in the settings of a method."""
    if faults:
        raise FrictrackError(f"search {name}: {'; '.join(faults)}", usage=True)


def _read(value: Any) -> Any:
    """Read a text of the command line as a number, true, false or a list; other texts and values stay as they are."""
    if isinstance(value, str):
        try:
            value = json.loads(value if "," not in value else f"[{value}]")
        except ValueError:
            return None if value == "none" else value
    return tuple(value) if isinstance(value, list) else value


def _faults(f: Field[Any], value: Any) -> list[str]:
    """Return what is wrong with the value of a setting: empty, or one sentence."""
    kind, limits = str(f.type), f.metadata  # types are texts here: "int | None"
    if (value is None and kind.endswith("None")) or not limits:
        return []
    kind = kind.partition(" ")[0].partition("[")[0]
    if limits["choices"]:
        words, right = f"one of {', '.join(limits['choices'])}", value in limits["choices"]
    elif kind == "bool":
        words, right = WORDS[kind], isinstance(value, bool)
    else:
        words, right = f"{WORDS[kind]}{_range(limits)}", _is_number(value, kind) and _is_inside(value, limits)
    return [] if right else [f"expected {f.name} as {words} but got {value!r}"]


def _is_number(value: Any, kind: str) -> bool:
    if kind == "tuple":
        return isinstance(value, tuple) and len(value) == 2 and all(_is_number(v, "float") for v in value)
    return isinstance(value, Integral if kind == "int" else Real) and not isinstance(value, bool)


def _is_inside(value: Any, limits: Mapping[str, Any]) -> bool:
    least = -inf if limits["above"] is None else limits["above"]
    return all(limits["low"] <= v <= limits["high"] and v > least and abs(v) < inf for v in np.atleast_1d(value))


def _range(limits: Mapping[str, Any]) -> str:
    low = f" of at least {limits['low']}" if limits["low"] > -inf else ""
    low = low if limits["above"] is None else f" above {limits['above']}"
    return low + (f" and at most {limits['high']}" if limits["high"] < inf else "")
