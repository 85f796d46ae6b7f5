"""Keep the models tried on a study in ``study.h5``, in order, and fit again only what has changed.

`FitRequest` is what a user asked of a fit; `TriedModels` are the fits, and all that was computed from them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from frictrack import effects, measure
from frictrack.base.errors import UsageError, result_or_none
from frictrack.base.files import INTERNAL_FOLDER, make_internal_folder, make_subfolder
from frictrack.effects import Effect, EffectSettings, check_ties, definitions, models
from frictrack.effects.models import Model
from frictrack.flow import store
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.pipeline import Progress, RunPipeline, digest, no_progress
from frictrack.flow.plausibility_checks import find_duplicate_runs
from frictrack.flow.stages import run_pipeline
from frictrack.flow.store import GroupContent, Provenance
from frictrack.records import Curve, ModelledMotion, Run
from frictrack.results import ModelResults, to_builtins
from frictrack.search import METHODS, Convergence, SearchMethod, search_method
from frictrack.settings.priors import Prior
from frictrack.study import EffectTable, Study

RECORDS_OF_FIT = {"curves": Curve, "motion": ModelledMotion, "convergence": Convergence}  # groups in that of a model
ATTEMPTS_FOLDER = "attempts"  # in the internal folder of the results: fits of the current model with one more effect
MAX_ATTEMPTS = 60  # files; the oldest are removed first
KEY_LENGTH = 32  # characters of the hash in the name of such a file
NO_LINKS: Mapping[str, str] = MappingProxyType({})
GROUPS_OF_CURRENT_MODEL = ("comparison", "diagnosis")  # removed when another model becomes current


@dataclass(frozen=True)
class FitRequest:
    """What the user asked of a fit: a model, edits of it, and how it is fitted.

    Examples
    --------
    >>> request = FitRequest("tustin").edited("+texture")
    >>> request.name
    'tustin+texture'
    >>> request.edited("-texture") == FitRequest("tustin")
    True

    """

    base: str | tuple[str, ...]  # name of a model ("tustin"), or names of effects
    edits: tuple[str, ...] = ()  # effects that were added ("+texture") or removed ("-viscous") since
    domain: str = "displacement"  # domain, search, seed, per, over: see `frictrack.fit`
    search: str = "varpro"
    seed: int = 0
    per: str | None = None
    over: str = "all"
    # settings of a global search that were asked for, by name
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> str | SearchMethod:
        """The search for `frictrack.fit`: its name, or with settings its record."""
        if self.search == "varpro" and self.settings:
            raise UsageError(
                f"expected settings ({', '.join(self.settings)}) with a global search ({', '.join(METHODS)}) but the "
                "search is varpro; add --search mga, for example"
            )
        return search_method(self.search, self.settings) if self.settings else self.search

    def edited(self, edit: str) -> FitRequest:
        """Return the request with one more edit (``"+texture"``, ``"-viscous"``); opposite edits cancel."""
        opposite = ("-" if edit[0] == "+" else "+") + edit[1:]
        kept = tuple(e for e in self.edits if e != opposite)
        return replace(self, edits=kept if len(kept) < len(self.edits) else (*self.edits, edit))

    def model(self, tables: Iterable[EffectTable] = ()) -> Model:
        """Return the model, with the settings of the study's `[[effect]]` tables."""
        own = user_effects(tables)
        for effect in self.lost(tables):
            raise UsageError(
                f'the model {self.name} has an effect "{effect}" that the study file no longer defines; write its '
                f"[[effect]] table again, or take it out of the model: frictrack remove STUDY {effect}"
            )
        model = models.parse(self.base, own)
        for edit in self.edits:
            inside = edit[1:].partition(".")[0] in model
            added = edit[1:] if inside and "." in edit else effects.get(edit[1:], own)
            model = model + added if edit[0] == "+" else model - edit[1:]
        adjusted = model.adjusted(_settings(tables))
        check_ties(adjusted.effects)
        return adjusted

    def lost(self, tables: Iterable[EffectTable]) -> list[str]:
        """Return the effects that were added and that neither the library nor an `[[effect]]` table defines now."""
        own, added = user_effects(tables), [edit[1:] for edit in self.edits if edit[0] == "+"]
        return [name for name in added if result_or_none(effects.get, name, own) is None]

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


class TriedModels:
    """The models tried on a study; one of them is current."""

    def __init__(self, study: Study, pipelines: list[RunPipeline], progress: Progress, log: CommandHistory) -> None:
        self.study = study
        self.path = study.output / "study.h5"
        self.commands = log
        self.progress = progress
        self.pipelines = pipelines

    @cached_property
    def runs(self) -> list[Run]:
        """All runs, brought up to date; a recording that is given twice counts once."""
        runs, twice = [pipeline.to_run() for pipeline in self.pipelines], find_duplicate_runs(self.pipelines)
        once = [(run, p.run.pause) for run, p in zip(runs, self.pipelines, strict=True) if run.name not in twice]
        return measure.friction.with_earlier_runs([run for run, _ in once], [pause for _, pause in once])

    # --- which models there are

    @property
    def groups(self) -> list[str]:
        """Names of the groups, in the order in which the models were tried."""
        return sorted(store.names(self.path, "models"), key=lambda name: int(name.split("_")[0]))

    def request(self, group: str) -> FitRequest:
        """Return what was asked for in a group."""
        return FitRequest.from_json(store.attributes(self.path, f"models/{group}")["settings"])

    @property
    def current_group(self) -> str | None:
        """The group that is marked as current in the store; None if no model was tried."""
        flags = ((group, store.attributes(self.path, f"models/{group}")["current"]) for group in reversed(self.groups))
        return next((group for group, is_current in flags if is_current), None)

    def current(self) -> tuple[str, FitRequest]:
        """Return group and request of the current model.

        If none was tried, or the study file names another model or search than before, that one is fitted first.
        """
        group = self.current_group
        if group is None:
            return self.append(self.first_request())
        request, changes = self.request(group), self._study_changes()
        return self.append(replace(request, **changes)) if changes else (group, request)

    def first_request(self) -> FitRequest:
        """Return the request of the study file's model, fitted by the search of the study file."""
        return FitRequest(self.study.model, domain=self.domain(), **self._study_search)

    def domain(self) -> str:
        """Return the domain of a new fit: "force" if a load cell measured friction, else "displacement"."""
        return "force" if any(run.friction_N is not None for run in self.runs) else "displacement"

    @property
    def _asked(self) -> dict[str, str]:
        """What the study file asks of a fit, as it is stored beside the models: its model, and its search if any."""
        search = {"study_search": json.dumps(self._study_search)} if self._study_search else {}
        return {"study_model": json.dumps(to_builtins(self.study.model)), **search}

    @property
    def _study_search(self) -> dict[str, Any]:
        """The study file's search as arguments of `FitRequest`; empty without a table [search]."""
        return {} if self.study.search is None else self.study.search.request

    def _study_changes(self) -> dict[str, Any]:
        """Return what the study file asks of a fit now that it did not ask when the last model was fitted."""
        before, now = store.attributes(self.path, "models"), self._asked
        if before["study_model"] != now["study_model"]:
            return {"base": self.study.model, "edits": (), **self._study_search}
        return {} if before.get("study_search") == now.get("study_search") else self._study_search

    def is_current_outdated(self) -> bool:
        """Return whether the current model belongs to other runs or settings than today's, or another study model."""
        group = self.current_group
        return group is not None and (bool(self._study_changes()) or self.is_outdated(group))

    def is_outdated(self, group: str) -> bool:
        """Return whether a model was fitted to other runs, or with other settings, than today's."""
        made = store.provenance(self.path, f"models/{group}") or Provenance()
        return made.key != self.fit_key(self.request(group))

    def was_interrupted(self, group: str) -> bool:
        """Return whether the search of a fit was stopped by hand: asked for again, it is searched again."""
        summary = json.loads(store.read(self.path, f"models/{group}", without=("state", *RECORDS_OF_FIT))["summary"])
        searched = summary.get("searched", {})
        return any(one.get("ended") == "interrupted" for one in (searched, *searched.values()) if isinstance(one, dict))

    def select(self, group: str) -> None:
        """Make a model current that was tried before."""
        store.write(self.path, {}, remove=GROUPS_OF_CURRENT_MODEL, attribute_updates=self._current_flags(group))

    def _current_flags(self, current: str) -> dict[str, dict[str, Any]]:
        """Return the attributes of all groups once one of them is current."""
        return {f"models/{group}": {"current": group == current} for group in self.groups}

    # --- what a fit depends on

    def fit_key(self, request: FitRequest) -> str:
        """Return the hash of all that the fit of a model depends on."""
        prior = self._prior(request)
        known = [] if prior is None else [prior.to_toml()]
        tables = [table.model_dump() for table in self.study.effects]
        return digest(["toml", request.to_json(), tables, self.input_hash, *known])

    def _prior(self, request: FitRequest) -> Prior | None:
        """Return the prior that a fit uses; the papers' route, whose residuals have no noise model, uses none."""
        return None if request.domain == "force" and self.domain() == "displacement" else self.study.prior

    @property
    def input_hash(self) -> str:
        """Hash of the runs, as far as a fit depends on them."""
        keys: list[list[Any]] = []
        for p in self.pipelines:
            keys.append([p.run.name, p.run.role, p.run.group, p.run.clamp_x, p.run.beam_length])
            keys[-1] += [p.key("friction"), p.key("motion")]
            keys[-1] += [p.run.noise, p.run.drift] if p.run.noise or p.run.drift else []
            keys[-1] += [] if p.run.pause is None else [p.run.pause]
        return digest([keys, self.study.mass])

    def provenance(self, key: str, settings: str) -> Provenance:
        """Return the provenance of something that is computed from today's runs."""
        inputs = [(f"{p.path.name}:/{name}", p.key(name)) for p in self.pipelines for name in ("friction", "motion")]
        return Provenance(key, self.input_hash, json.dumps(inputs), settings)

    # --- fits

    def append(self, request: FitRequest, command: str = "fit", **arguments: Any) -> tuple[str, FitRequest]:
        """Fit a model, store it as the last one, make it current and record the command."""
        if self.study.prior is not None and self._prior(request) is None:
            from frictrack.fit import PRIOR_NEEDS_NOISE  # noqa: PLC0415

            raise UsageError(PRIOR_NEEDS_NOISE)
        entry = self._fitted(request, current=True)
        base = request.base if isinstance(request.base, str) else ",".join(request.base)
        with self.commands.record(command, **(arguments or {"model": base})) as change:
            group, before = f"{len(self.groups) + 1}_{request.name}", self.current_group
            store.write(
                self.path,
                {f"models/{group}": entry},
                remove=GROUPS_OF_CURRENT_MODEL,
                links=self._run_links(),
                attribute_updates={"models": self._asked} | self._current_flags(group),
            )
            change.before = {} if before is None else {"current": before}
            change.after = {"current": group}
        return group, request

    def _run_links(self) -> dict[str, str]:
        """Return the links from ``study.h5`` to the files of the runs."""
        return {f"runs/{pipeline.run.name}": pipeline.path.name for pipeline in self.pipelines}

    def fit(self, group: str) -> Any:
        """Return the fit of a group, which is computed again if it is outdated: a `Fit`, or `GroupFits`."""
        from frictrack.fit import restore  # noqa: PLC0415

        self.bring_up_to_date(group)
        return restore(self.runs, store.read(self.path, f"models/{group}")["state"])

    def bring_up_to_date(self, group: str) -> None:
        """Fit a model again if it is outdated; one with an effect that is no longer defined stays as it was."""
        if self.is_outdated(group) and not self.request(group).lost(self.study.effects):
            entry = self._fitted(self.request(group), current=group == self.current_group)
            removed = ("diagnosis",)  # a link into the group that is replaced
            store.write(self.path, {f"models/{group}": entry}, remove=removed, links=self._run_links())

    def fit_papers_route(self) -> None:
        """Fit the current model in the force domain by SGA or the study's search, and store it beside the others."""
        search = self.study.search
        own = {"search": "sga", "settings": {}} if search is None or search.method == "varpro" else search.request
        request = replace(self.current()[1], domain="force", over="all", **own)
        made = store.provenance(self.path, "papers")
        if made is None or made.key != self.fit_key(request):
            store.write(self.path, {"papers": self._fitted(request, current=False)})

    def _fitted(self, request: FitRequest, *, current: bool) -> GroupContent:
        """Fit a model, or take its fit if it was attempted; return the content of its group, as it will be restored.

        So one process or several give the same bits.
        """
        from frictrack.fit import fit, generation_limit, restore, state  # noqa: PLC0415

        made = self.provenance(self.fit_key(request), request.to_json())
        if attempted := self.stored_attempt(request):
            return GroupContent(_read_fit(attempted[0], f"models/{attempted[1]}") | {"current": current}, made)
        self.progress(0, 0, f"fitting {request.name} ({request.domain} domain, {request.search})")
        limit = 1000 if request.search == "varpro" else generation_limit(request.method) or 1000  # else not known

        def report(generation: int, best: Mapping[str, float], misfit: float) -> None:
            done = min(generation, limit - 1)
            self.progress(done, limit, f"{request.search}: misfit {misfit:.4g}, generation")

        mass = None if self.study.mass is None else self.study.mass[0]
        how: dict[str, Any] = {"domain": request.domain, "search": request.method, "rng": request.seed}
        how |= {"over": request.over, "per": request.per, "prior": self._prior(request), "reference_mass": mass}
        fitted = fit(request.model(self.study.effects), self.runs, callback=report, **how)
        self.progress(limit, limit, request.search)
        fitted = restore(self.runs, state(fitted))
        content: dict[str, Any] = {
            "current": current,
            "equation": str(fitted.model),
            "summary": json.dumps(to_builtins(fitted.summary())),
            "state": state(fitted),
            "curves": {f"{i:03d}_{curve.run}": curve for i, curve in enumerate(fitted.curves)},
            "motion": {motion.run: motion for motion in fitted.motion},
            **({"convergence": fitted.convergence} if fitted.convergence else {}),
        }
        return GroupContent(content, made)

    # --- fits of the current model with one more effect, each in a file of its own

    def _attempt_place(self, request: FitRequest) -> tuple[Path, str]:
        """Return file and group of the fit of a request that is attempted; the file has the key of the fit as name."""
        folder = self.study.output / INTERNAL_FOLDER / ATTEMPTS_FOLDER
        return folder / f"{self.fit_key(request)[:KEY_LENGTH]}.h5", f"attempt_{request.name}"

    def stored_attempt(self, request: FitRequest) -> tuple[Path, str] | None:
        """Return file and group of the attempted fit of a request; None if there is none, or it cannot be read."""
        path, group = self._attempt_place(request)
        return (path, group) if result_or_none(store.provenance, path, f"models/{group}") else None

    def attempt(self, request: FitRequest) -> dict[str, Any]:
        """Fit a model into a file of its own, unless it is there already: JSON of `fit`."""
        path, group = self._attempt_place(request)
        if self.stored_attempt(request) is None:
            entry = self._fitted(request, current=False)
            _make_room_for_attempt(self.study.output)
            standalone = replace(entry, provenance=replace(entry.provenance, inputs="[]"))
            store.write(path, {f"models/{group}": standalone})
        return model_results(path, group).summary

    # --- what is stored beside a fit: its JSON, and that of all that follows from it

    def content_key(self, group: str) -> str:
        """Return a text that changes when what is stored of a model does: its fit, its intervals, its diagnosis."""
        held = store.attributes(self.path, group)
        parts = [store.provenance(self.path, f"{group}/{part}") for part in ("certainty", "diagnosis")]
        return str(held.get("sha256") or digest([held, *parts]))  # the checksum of schema 2, which reports of then hold

    def stored_summary(self, group: str, key: str | None = None) -> dict[str, Any] | None:
        """Return the JSON that a group holds; None if there is none, or if it has another key than `key`."""
        made = store.provenance(self.path, group)
        if made is None or key not in (None, made.key):
            return None
        return json.loads(store.read(self.path, group, without=("figures",))["summary"])

    def keep_summary(
        self, group: str, summary: Any, provenance: Provenance, links: Mapping[str, str] = NO_LINKS, **more: Any
    ) -> dict[str, Any]:
        """Store the JSON of something that was computed from the models, with more content of its group; return it."""
        found: dict[str, Any] = to_builtins(summary)
        content = GroupContent({"summary": json.dumps(found), **more}, provenance)
        store.write(self.path, {group: content}, links=links)
        return found

    def summary(self, group: str) -> dict[str, Any]:
        """Return the JSON of a fit; a model that is outdated is fitted again."""
        self.bring_up_to_date(group)
        unread = ("state", *RECORDS_OF_FIT, "diagnosis")
        return _summary_of(store.read(self.path, f"models/{group}", without=unread))


def stored_models(study: Study) -> TriedModels:
    """Return the models of a study as they are stored, and its runs: nothing is computed."""
    pipelines = [run_pipeline(study, run, stored_only=True) for run in study.runs]
    return TriedModels(study, pipelines, no_progress, CommandHistory(study.output))


def _make_room_for_attempt(output: Path) -> None:
    """Create the folder of the attempts and remove the oldest of too many."""
    folder = make_subfolder(make_internal_folder(output), ATTEMPTS_FOLDER)
    files = sorted(folder.glob("[!.]*.h5"), key=lambda path: path.stat().st_mtime_ns)
    for path in files[: max(len(files) - MAX_ATTEMPTS + 1, 0)]:
        with suppress(OSError):
            path.unlink()


def _read_fit(path: Path, inside: str, *without: str) -> dict[str, Any]:
    """Return what a group of a fit holds, with its records."""
    with store.snapshot(path):
        content: dict[str, Any] = store.read(path, inside, without=(*without, *RECORDS_OF_FIT))
        for part, kind in RECORDS_OF_FIT.items():
            names = store.names(path, f"{inside}/{part}")
            content[part] = {name: store.read(path, f"{inside}/{part}/{name}", kind) for name in names}
    return content


def model_results(path: Path, group: str) -> ModelResults:
    """Read a model from the file of a study or of an attempt."""
    stored = _read_fit(path, group if group == "papers" else f"models/{group}", "state")
    return ModelResults(
        name=group,
        equation=stored["equation"],
        summary=_summary_of(stored),
        curves=tuple(stored["curves"].values()),
        motion=tuple(stored["motion"].values()),
        convergence=stored["convergence"],
        current=bool(stored["current"]),
        diagnosis=json.loads(stored["diagnosis"]["summary"]) if "diagnosis" in stored else None,
        figures=stored.get("diagnosis", {}).get("figures", {}),
    )


def _summary_of(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON of a stored fit, with the intervals that were computed for it."""
    from frictrack.fit.uncertainty import merge_uncertainty  # noqa: PLC0415

    intervals = json.loads(stored.get("certainty", {}).get("summary", "{}"))
    return merge_uncertainty(json.loads(stored["summary"]), intervals)
