"""The models tried on a study, in order: kept, refitted only when what they rest on changed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from frictrack import effects, models, store
from frictrack.effects import Effect
from frictrack.effects.settings import Settings, check_ties, definitions
from frictrack.fit import MAX_SEARCH_GENERATIONS, fit, restore, state
from frictrack.fit.uncertainty import merge_uncertainty
from frictrack.flow.ledger import Ledger
from frictrack.flow.stages import Progress, RunWork, digest
from frictrack.models import Model
from frictrack.records import Curve, Modelled, Run
from frictrack.results import ModelResults, plain
from frictrack.store import GroupContent, Provenance
from frictrack.study import EffectTable, Study
from frictrack.study.schema import RunTable

STALE = ("comparison", "diagnosis")  # they speak of the model that was current before


@dataclass(frozen=True)
class Spec:
    """What was asked of a fit: the model as the user built it up, and how it is fitted."""

    base: str | tuple[str, ...]  # "tustin", or a list of effects
    edits: tuple[str, ...] = ()  # "+texture", "-viscous"
    domain: str = "displacement"
    search: str = "varpro"
    seed: int = 0
    per: str | None = None
    over: str = "all"

    def edited(self, edit: str) -> Spec:
        """The same with one effect more (``"+texture"``) or less; what cancels is dropped."""
        opposite = ("-" if edit[0] == "+" else "+") + edit[1:]
        kept = tuple(e for e in self.edits if e != opposite)
        return replace(self, edits=kept if len(kept) < len(self.edits) else (*self.edits, edit))

    def model(self, tables: Iterable[EffectTable] = ()) -> Model:
        """The model itself, with what the study's `[[effect]]` tables say of it.

        Raises `FrictrackError` (usage) for an unknown effect, or settings that do not go together.
        """
        own = own_effects(tables)
        model = models.parse(self.base, own)
        for edit in self.edits:
            model = model + effects.get(edit[1:], own) if edit[0] == "+" else model - edit[1:]
        return with_tables(model, tables)

    @property
    def name(self) -> str:
        """A short name, good for a group: ``tustin+texture``."""
        base = self.base if isinstance(self.base, str) else "+".join(self.base)
        return re.sub(r"[\s,/]+", "+", base) + "".join(self.edits)

    @classmethod
    def parse(cls, text: str) -> Spec:
        """Read what `json` wrote."""
        raw = json.loads(text)
        base = raw["base"] if isinstance(raw["base"], str) else tuple(raw["base"])
        return cls(**(raw | {"base": base, "edits": tuple(raw["edits"])}))

    def json(self) -> str:
        """As text, the same for the same request."""
        return json.dumps(asdict(self), sort_keys=True)


def _specified(run: RunTable) -> list[Any]:
    """What is stated of the instrument, where anything is."""
    return [run.noise, run.drift] if run.noise or run.drift else []


def with_tables(model: Model, tables: Iterable[EffectTable]) -> Model:
    """The model with what the `[[effect]]` tables of the study file say of its effects; the other tables wait.

    Raises `FrictrackError` (usage) for settings that do not go together.
    """
    adjusted = model.adjusted(_settings(tables))
    check_ties(adjusted.effects)
    return adjusted


def own_effects(tables: Iterable[EffectTable]) -> list[Effect]:
    """The effects that the study file defines by a formula; every table is checked."""
    return definitions(_settings(tables))


def told_effects(tables: Iterable[EffectTable]) -> list[Effect]:
    """Every effect that the study file defines or says something of, as it would enter a model."""
    told = _settings(tables)
    own = definitions(told)
    return [one.applied(effects.get(one.effect, own)) for one in told]


def _settings(tables: Iterable[EffectTable]) -> list[Settings]:
    return [Settings(**table.model_dump()) for table in tables]


class Tried:
    """The list of models of a study in ``study.h5``; the last one is current."""

    def __init__(self, study: Study, runs: list[RunWork], progress: Progress, ledger: Ledger) -> None:
        self.study = study
        self.path = study.output / "study.h5"
        self.ledger = ledger
        self.progress = progress
        self._works = runs
        self._fits: dict[str, Any] = {}
        self._records: list[Run] | None = None

    @property
    def runs(self) -> list[Run]:
        """All runs, brought up to date."""
        if self._records is None:
            self._records = [work.record() for work in self._works]
        return self._records

    @property
    def groups(self) -> list[str]:
        """``1_tustin``, ``2_tustin+texture``: in the order tried."""
        return sorted(store.names(self.path, "models"), key=lambda name: int(name.split("_")[0]))

    def spec(self, group: str) -> Spec:
        """What was asked for in a group."""
        return Spec.parse(store.attributes(self.path, f"models/{group}")["settings"])

    @property
    def head(self) -> str | None:
        """The group of the model in force, as it stands in the store."""
        held = (group for group in reversed(self.groups) if store.attributes(self.path, f"models/{group}")["current"])
        return next(held, None)

    def current(self) -> tuple[str, Spec]:
        """The model in force; the study file's when there is none, or when it was changed there."""
        head = self.head
        if head is None:
            return self.append(Spec(self.study.model, domain=self.domain()))
        spec = self.spec(head)
        if store.attributes(self.path, "models")["study_model"] != self._asked:
            return self.append(replace(spec, base=self.study.model, edits=()))
        return head, spec

    def is_stale(self) -> bool:
        """Whether the model in force was fitted to other runs, or under other settings, than those of today."""
        head = self.head
        if head is None:
            return False
        asked = store.attributes(self.path, "models")["study_model"] == self._asked
        return not asked or self.is_outdated(head)

    def is_outdated(self, group: str) -> bool:
        """Whether a model was fitted to other runs, or under other settings, than those of today."""
        return self._provenance(group).key != self.key(self.spec(group))

    def use(self, group: str) -> None:
        """Make a model current that was tried before."""
        store.write(self.path, {}, remove=STALE, attribute_updates=self._marks(group))

    def _marks(self, head: str) -> dict[str, dict[str, Any]]:
        """Attributes of the models once that one is current."""
        return {f"models/{group}": {"current": group == head} for group in self.groups}

    @property
    def _asked(self) -> str:
        """The study file's model, as it is noted beside the models."""
        return json.dumps(plain(self.study.model))

    def domain(self) -> str:
        """Where a load cell measured friction, forces are compared; else displacements."""
        return "force" if any(run.friction_N is not None for run in self.runs) else "displacement"

    def append(self, spec: Spec, do: str = "fit", **told: Any) -> tuple[str, Spec]:
        """Fit a model, put it at the end of the list and make it current; the log has the command that asked for it."""
        fitted = self._fit(spec)
        asked = told or {"model": spec.base if isinstance(spec.base, str) else ",".join(spec.base)}
        with self.ledger.turn(do, **asked) as change:
            group, head = f"{len(self.groups) + 1}_{spec.name}", self.head
            marks = {"models": {"study_model": self._asked}} | self._marks(group)
            entry = {f"models/{group}": self._entry(spec, fitted, current=True)}
            store.write(self.path, entry, remove=STALE, links=self._links(), attribute_updates=marks)
            change.before = {} if head is None else {"current": head}
            change.after = {"current": group}
        self._fits[group] = fitted
        return group, spec

    def _links(self) -> dict[str, str]:
        """The files of the runs, as the study's file shows them."""
        return {f"runs/{work.run.name}": work.path.name for work in self._works}

    def attempt(self, spec: Spec, path: Path) -> dict[str, Any]:
        """Fit a model into a file beside the study: JSON of `fit`."""
        name = f"attempt_{spec.name}"
        entry = self._entry(spec, self._fit(spec), current=False)
        passing = replace(entry, provenance=replace(entry.provenance, inputs="[]"))  # nobody brings it up to date later
        store.write(path, {f"models/{name}": passing})
        return model_results(path, name).summary

    def fit(self, group: str) -> Any:
        """The fit of a group: rebuilt from the store when it is current, else made again."""
        if group not in self._fits:
            spec = self.spec(group)
            if not self.is_outdated(group):
                self._fits[group] = self._restored(group)
            else:
                self._fits[group] = self._fit(spec)
                entry = self._entry(spec, self._fits[group], current=group == self.head)
                removed = ("diagnosis",)  # a link into what was
                store.write(self.path, {f"models/{group}": entry}, remove=removed, links=self._links())
        return self._fits[group]

    def _restored(self, group: str) -> Any:
        return restore(self.runs, store.read(self.path, f"models/{group}")["state"])

    def key(self, spec: Spec) -> str:
        """Hash of all that the fit of this model depends on."""
        return digest(["toml", spec.json(), [e.model_dump() for e in self.study.effects], self.input_hash])

    @property
    def inputs(self) -> list[tuple[str, str]]:
        """The groups of the runs that a fit rests on, each with its key."""
        return [(f"{w.path.name}:/{name}", w.key(name)) for w in self._works for name in ("friction", "motion")]

    def provenance(self, key: str, settings: str) -> Provenance:
        """That of anything made from the runs of today."""
        return Provenance(key, self.input_hash, json.dumps(self.inputs), settings)

    @property
    def input_hash(self) -> str:
        """Hash of the runs as the fit sees them."""
        keys = [
            [
                w.run.name,
                w.run.role,
                w.run.group,
                w.run.clamp_x,
                w.run.beam_length,
                w.key("friction"),
                w.key("motion"),
                *_specified(w.run),
            ]
            for w in self._works
        ]
        return digest([keys, self.study.mass])

    def _fit(self, spec: Spec) -> Any:
        how: dict[str, Any] = {"domain": spec.domain, "search": spec.search, "seed": spec.seed, "over": spec.over}
        if spec.per is not None:
            how["per"] = spec.per
        if self.study.mass is not None:
            how["reference_mass"] = self.study.mass[0]
        fitted = fit(spec.model(self.study.effects), self.runs, callback=self._told(spec.search), **how)
        self.progress(MAX_SEARCH_GENERATIONS, MAX_SEARCH_GENERATIONS, spec.search)
        return fitted

    def _told(self, search: str) -> Callable[[int, Mapping[str, float], float], None]:
        """Progress of a global search, generation by generation."""

        def told(generation: int, best: Mapping[str, float], misfit: float) -> None:
            self.progress(
                min(generation, MAX_SEARCH_GENERATIONS - 1), MAX_SEARCH_GENERATIONS, f"{search}: misfit {misfit:.4g}"
            )

        return told

    def papers(self) -> Any:
        """The current model by the papers' route (force domain, SGA), kept beside the others."""
        spec = replace(self.current()[1], domain="force", search="sga", over="all")
        provenance = store.provenance(self.path, "papers")
        if provenance is None or provenance.key != self.key(spec):
            store.write(self.path, {"papers": self._entry(spec, self._fit(spec), current=False)})
        return self.results("papers")

    def results(self, group: str) -> ModelResults:
        """A stored model as the report wants it; `group` may be ``papers``."""
        return model_results(self.path, group)

    def _provenance(self, group: str) -> Provenance:
        return store.provenance(self.path, f"models/{group}") or Provenance()

    def _entry(self, spec: Spec, fitted: Any, *, current: bool) -> GroupContent:
        content = {
            "current": current,
            "equation": str(fitted.model),
            "summary": json.dumps(plain(fitted.summary())),
            "state": state(fitted),
            "curves": {f"{i:03d}_{curve.run}": curve for i, curve in enumerate(fitted.curves)},
            "motion": {told.run: told for told in fitted.motion},
        }
        return GroupContent(content, self.provenance(self.key(spec), spec.json()))


def model_results(path: Path, group: str) -> ModelResults:
    """A model of a study's file, or of an attempt's, as the report wants it; `group` may be ``papers``."""
    inside = group if group == "papers" else f"models/{group}"
    with store.snapshot(path):
        held = store.read(path, inside)
        curves, motion = (store.names(path, f"{inside}/{part}") for part in ("curves", "motion"))
        return ModelResults(
            name=group,
            equation=held["equation"],
            summary=merge_uncertainty(
                json.loads(held["summary"]), json.loads(held.get("certainty", {}).get("summary", "{}"))
            ),
            curves=tuple(store.read(path, f"{inside}/curves/{name}", Curve) for name in curves),
            motion=tuple(store.read(path, f"{inside}/motion/{name}", Modelled) for name in motion),
            current=bool(held["current"]),
            diagnosis=json.loads(held["diagnosis"]["summary"]) if "diagnosis" in held else None,
            figures=held.get("diagnosis", {}).get("figures", {}),
        )
