"""A study at work: every step first brings up to date what it rests on, and leaves its result in the store."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from frictrack import effects, store
from frictrack.compare import compare, history
from frictrack.diagnose import diagnose
from frictrack.errors import FrictrackError
from frictrack.files import working
from frictrack.fit import analyse_uncertainty
from frictrack.flow import changes
from frictrack.flow.doubts import doubted
from frictrack.flow.films import overlaid
from frictrack.flow.ledger import Ledger
from frictrack.flow.opening import open_study
from frictrack.flow.plausible import Findings
from frictrack.flow.stages import Progress, RunWork, copied, digest, hashed, silent
from frictrack.flow.stored import stored
from frictrack.flow.summary import summary
from frictrack.flow.tables import uneven_runs
from frictrack.flow.tried import Spec, Tried, own_effects, told_effects
from frictrack.flow.witnesses import seen_beside
from frictrack.friction import impact
from frictrack.results import Results, plain
from frictrack.store import GroupContent
from frictrack.study import Study, nearest
from frictrack.version import __version__

AFTER_MOTION = ("motion", "events", "cutoff", "friction")  # stages that rest on the motion, and itself
EDITS = ("fit", "add", "remove")  # of the model
CHOICES: dict[str, Callable[..., dict[str, Any]]] = {
    "edit": changes.edit,
    "take_in": changes.take_in,
    "leave_out": changes.leave_out,
    "define": changes.define,
    "use": changes.use,
    "undo": changes.undo,
    "redo": changes.redo,
}
P = ParamSpec("P")
T = TypeVar("T")


def one_at_a_time(do: Callable[Concatenate[Session, P], T]) -> Callable[Concatenate[Session, P], T]:
    """One process at a time works on the models of a study; the next one waits, and finds what the first has done."""

    @wraps(do)
    def done(session: Session, *told: P.args, **named: P.kwargs) -> T:
        with working(session.study.output, lambda: session.progress(0, 1, "waiting for another frictrack")):
            return do(session, *told, **named)

    return done


class Session:
    """One study, its runs and the models tried on it."""

    def __init__(
        self,
        study: Study,
        progress: Progress = silent,
        *,
        who: str = "python",
        seen: int | None = None,
        notes: tuple[str, ...] = (),
    ) -> None:
        self.progress = progress
        self.notes = notes  # for the report: what was done to the study before
        self.ledger = Ledger(study.output, who, seen)
        self._take(study)

    def _take(self, study: Study) -> None:
        self.study = study
        self.runs = [RunWork(study, run, self.progress) for run in study.runs]
        self.tried = Tried(study, self.runs, self.progress, self.ledger)
        self.findings = Findings(study)
        self.path = study.output / "study.h5"

    def apply(self, do: str, **told: Any) -> dict[str, Any]:
        """One command that changes the study, by its name and words: the door of the log, of jobs and of scripts.

        Raises `FrictrackError` for an unknown command, or where the study was changed since it was `seen`.
        """
        self.ledger.check()
        if do in CHOICES:
            return self._chosen(do, **told)
        if do not in EDITS:
            raise FrictrackError(f"expected a command but got {do!r}; {nearest(do, (*EDITS, *CHOICES))}", usage=True)
        result: dict[str, Any] = getattr(self, do)(**told)
        return result

    def _chosen(self, do: str, **told: Any) -> dict[str, Any]:
        found = CHOICES[do](self, **told)
        self._take(open_study(self.study.path, bare=True))
        return found

    def bring_up_to(self, stage: str) -> list[RunWork]:
        """Do every run up to a stage of its table; a table has no recording and no track to do.

        What was typed is checked first, and the motion before anything is made of it. Raises `FrictrackError` for what
        cannot be right.
        """
        self.findings.of_study()
        if stage in AFTER_MOTION:
            self._each("motion")
            self.findings.of_runs(self.runs)
        self._each(stage)
        if stage == "friction":
            self.findings.of_all(self.runs)
        return self.runs

    def _each(self, stage: str) -> None:
        for i, work in enumerate(self.runs):
            self.progress(i, len(self.runs), "runs")
            if stage in work.stages:
                work.get(stage)
        self.progress(len(self.runs), len(self.runs), "runs")

    def measure(self, stage: str, *, overlay: bool = False) -> dict[str, Any]:
        """Every run up to `track`, `motion` or `friction`: JSON of those commands. A motion has its cut-off priced.

        With `overlay` every film is written once more with what was tracked in it.
        """
        for work in self.runs if overlay else ():
            if work.run.video:
                overlaid(work)
        works = self.bring_up_to("tracks" if stage == "track" else stage)
        if stage != "track":
            self.bring_up_to("cutoff")
        return {"runs": summary(works, stage), "warnings": self.findings.summary, "output": str(self.study.output)}

    @one_at_a_time
    def fit(self, model: str | None = None, *, profiles: bool = False, draws: int = 0, **how: Any) -> dict[str, Any]:
        """Fit the current model, or another one that becomes current: JSON of `fit`.

        `how` may hold domain, search, over, seed, per; what is None stays as it was for the current model. `profiles`
        and a bootstrap of so many `draws` are added to what is known of the fit.
        """
        asked: dict[str, Any] = {key: value for key, value in how.items() if value is not None}
        if asked.get("search") == "varpro":
            asked.setdefault("over", "all")
        if model is not None:
            base = tuple(part.strip() for part in model.split(",")) if "," in model else model
            asked |= {"base": base, "edits": ()}
            Spec(base).model(self.study.effects)
        self.bring_up_to("friction")
        group, spec = self._first(asked) if not self.tried.groups else self.tried.current()
        if replace(spec, **asked) != spec:
            group, spec = self.tried.append(replace(spec, **asked), model=model, **how)
        if profiles or draws:
            self._make_sure(group, profiles, draws, spec.seed)
        found = self._summary(group)
        twice = [f'run "{name}" is {note}' for name, note in copied(self.runs).items()]
        more = {"scale_error": self._scale_error(), "warnings": self.findings.summary, "findings": self._in_records()}
        uneven = uneven_runs([work.get("displacement") for work in self.runs if work.run.table])
        return {**found, "remarks": [*found["remarks"], *twice, *uneven], **more}

    def _in_records(self) -> list[dict[str, str]]:
        """What was found in the displacement of every run and what its mass first hits, nothing looked for in vain."""
        notes = [(work.run.name, note) for work in self.runs for note in work.get("displacement").notes]
        found = [{"run": run, "words": note} for run, note in notes if not note.startswith(("no ", "nothing "))]
        impacts = [{"run": work.run.name, "words": impact(work.record())} for work in self.runs]
        return [*found, *(hit for hit in impacts if hit["words"])]

    def _make_sure(self, group: str, profiles: bool, draws: int, seed: int) -> None:
        """Profiles and bootstrap of a fit, put beside it; what was known of it so stays."""
        fitted, inside = self.tried.fit(group), f"models/{group}/certainty"

        def make() -> dict[str, Any]:
            known = json.loads(store.read(self.path, inside)["summary"]) if store.provenance(self.path, inside) else {}
            asked: dict[str, Any] = {"profiles": profiles, "draws": draws, "seed": seed}
            found = analyse_uncertainty(fitted, **asked, progress=self.progress)
            return {"summary": json.dumps(known | plain(found.summary()))}

        key = digest(["certainty", profiles, draws, seed, self.tried.key(self.tried.spec(group))])
        self._summarised(inside, make, key, seed)

    def _scale_error(self) -> float:
        """Relative standard deviation that the scale adds to every force told from acceleration, all runs alike."""
        told = [run for run in self.tried.runs if run.drive is None and run.friction_N is None]
        return max((run.displacement.relative_scale_error for run in told), default=0.0)

    def _first(self, asked: dict[str, Any]) -> tuple[str, Spec]:
        """The study file's model comes first, even where another one is asked for."""
        how = {} if "base" in asked else asked
        return self.tried.append(replace(Spec(self.study.model, domain=self.tried.domain()), **how))

    def _summary(self, group: str) -> dict[str, Any]:
        self.tried.fit(group)  # again when something it rests on has changed
        return self.tried.results(group).summary

    @one_at_a_time
    def compare(self) -> dict[str, Any]:
        """Errors of all models tried, and where the current one fails: JSON of `compare`."""

        def make() -> dict[str, Any]:
            return {"summary": json.dumps(self._named(compare(self._fits(), self._place()).summary()))}

        return self._summarised("comparison", make, self._history_key())

    @one_at_a_time
    def history(self) -> dict[str, Any]:
        """Every model tried, in order, with its errors: JSON of `history`."""
        return self._named(history(self._fits(), self._place()).summary())

    def _place(self) -> int:
        """Of the current model among those tried."""
        return self.tried.groups.index(self.tried.current()[0])

    def _named(self, summary: dict[str, Any]) -> dict[str, Any]:
        """The models under the names that they have in the store."""
        named = [{**model, "name": group} for model, group in zip(summary["models"], self.tried.groups, strict=True)]
        found: dict[str, Any] = plain({**summary, "models": named})
        return found

    @one_at_a_time
    def diagnose(self, seed: int = 0) -> dict[str, Any]:
        """Which effect is missing: JSON of `diagnose`."""
        self.bring_up_to("friction")
        group, spec = self.tried.current()

        def make() -> dict[str, Any]:
            own, auxiliary = told_effects(self.study.effects), seen_beside(self.runs)
            diagnosis = diagnose(self.tried.fit(group), own=own, auxiliary=auxiliary, seed=seed, progress=self.progress)
            summary = doubted(diagnosis.summary(), self.findings.contradictions)
            return {"summary": json.dumps(plain(summary)), "figures": diagnosis.figures}

        self.tried.fit(group)  # a refit drops the old diagnosis
        inside = f"models/{group}/diagnosis"
        found = self._summarised(inside, make, digest(["diagnosis", seed, self.tried.key(spec), self._told()]), seed)
        if store.provenance(self.path, "diagnosis") != store.provenance(self.path, inside):
            store.write(self.path, {}, links={"diagnosis": f"/{inside}"})
        return {**found, "warnings": self.findings.summary, "findings": self._in_records()}

    def _told(self) -> list[Any]:
        """What a diagnosis rests on beside the fit: the `[[effect]]` tables, and what else was seen or doubted."""
        beside = [work.key(name) for work in self.runs for name in ("sensors", "tracks") if name in work.stages]
        contradicted = [str(finding) for finding in self.findings.contradictions]
        return [beside, contradicted, *(table.model_dump(mode="json") for table in self.study.effects)]

    @one_at_a_time
    def add(self, effect: str, seed: int | None = None) -> dict[str, Any]:
        """Fit again with one effect more: JSON of `add`."""
        return self._edit("+", effect, seed)

    @one_at_a_time
    def remove(self, effect: str, seed: int | None = None) -> dict[str, Any]:
        """Fit again with one effect less: JSON of `remove`."""
        return self._edit("-", effect, seed)

    def _edit(self, sign: str, effect: str, seed: int | None) -> dict[str, Any]:
        effects.get(effect, own_effects(self.study.effects))  # the nearest right name, before any work
        before, after = self._edited(sign + effect, seed)
        return {
            "effect": effect,
            "error_before": before["errors"],
            "error_after": after["errors"],
            "parameters": after["parameters"],
        }

    def _edited(self, edit: str, seed: int | None) -> tuple[dict[str, Any], dict[str, Any]]:
        self.bring_up_to("friction")
        group, spec = self.tried.current()
        spec = spec.edited(edit) if seed is None else replace(spec.edited(edit), seed=seed)
        spec.model(self.study.effects)
        before = self._summary(group)
        do = "add" if edit[0] == "+" else "remove"
        return before, self._summary(self.tried.append(spec, do, effect=edit[1:], seed=spec.seed)[0])

    @one_at_a_time
    def attempt(self, effect: str, path: Path) -> dict[str, Any]:
        """Fit with one effect more and put the model into a file of its own: nothing of the study changes."""
        self.bring_up_to("friction")
        spec = self.tried.current()[1].edited(f"+{effect}")
        return self.tried.attempt(spec, path)

    @one_at_a_time
    def run(self, seed: int = 0) -> dict[str, Any]:
        """Everything: JSON of `run`."""
        fit = self.fit()
        self.compare()
        diagnosis = self.diagnose(seed)
        self.report(seed, anew=False)
        warnings = self.findings.summary
        return {"fit": fit, "diagnose": diagnosis, "warnings": warnings, "output": str(self.study.output)}

    @one_at_a_time
    def report(self, seed: int | None = None, *, anew: bool = True) -> Path:
        """Write ``report.html`` and say where; `seed` is that of the diagnosis, the last one's when None.

        Unless asked for `anew`, a page that was made from the very same results stays.
        """
        path = self.study.output / "report.html"
        notes = self._up_to_date(seed)
        warnings = self.findings.words
        key = digest([__version__, notes, warnings, *(hashed(p) for p in self._files())])
        if anew or not _holds(path, key):
            from frictrack import report  # noqa: PLC0415 - draws for seconds

            report.write(replace(stored(self.study), notes=notes, warnings=warnings), path, key)
        return path

    def _files(self) -> list[Path]:
        """All that a report rests on."""
        return [self.study.path, self.path, *(work.path for work in self.runs)]

    def restart(self) -> None:
        """Forget the models tried; what was measured stays."""
        if self.path.exists():
            with self.ledger.turn("restart"):
                store.write(self.path, {}, remove=("models", "comparison", "diagnosis", "papers"))
        self._take(self.study)

    @one_at_a_time
    def results(self, seed: int | None = None) -> Results:
        """All that the study has come to, for the report and the export."""
        notes = self._up_to_date(seed)
        return replace(stored(self.study), notes=notes, warnings=self.findings.words)

    def _up_to_date(self, seed: int | None) -> tuple[str, ...]:
        """Do all that is missing or stale; what could not be done, in words."""
        for work in self.runs:
            for stage in work.stages:
                work.get(stage)
        self.compare()
        self.diagnose(self._seed() if seed is None else seed)
        return (*self.notes, *self._papers())

    def _seed(self) -> int:
        """The seed of the last diagnosis."""
        held = store.provenance(self.path, "diagnosis")
        return int(json.loads(held.settings)["seed"]) if held else 0

    def _papers(self) -> tuple[str, ...]:
        """Bring the papers' route beside ours up to date, or say why there is none.

        Friction that was measured has no other route.
        """
        if all(run.friction_N is None for run in self.tried.runs):
            try:
                self.tried.papers()
            except FrictrackError as e:
                return (f"the papers' route (force domain, SGA) was not possible: {e}",)
        return ()

    def _fits(self) -> list[Any]:
        self.bring_up_to("friction")
        self.tried.current()
        return [self.tried.fit(group) for group in self.tried.groups]

    def _history_key(self) -> str:
        self.bring_up_to("friction")
        self.tried.current()
        return digest([self._place(), *(self.tried.key(self.tried.spec(group)) for group in self.tried.groups)])

    def _summarised(
        self, group: str, make: Callable[[], dict[str, Any]], key: str, seed: int | None = None
    ) -> dict[str, Any]:
        """A stored summary, made again when its key has changed."""
        held = store.provenance(self.path, group)
        if held is None or held.key != key:
            provenance = self.tried.provenance(key, json.dumps({} if seed is None else {"seed": seed}))
            store.write(self.path, {group: GroupContent(make(), provenance)})
        found: dict[str, Any] = json.loads(store.read(self.path, group)["summary"])
        return found


def _holds(path: Path, key: str) -> bool:
    """Whether a page was made from what has this key: it stands in its head."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        return key.encode() in file.read(2000)
