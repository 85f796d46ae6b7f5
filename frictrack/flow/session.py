"""Work on one study: fit, compare, diagnose, add effects, report. Every step first updates what it depends on.

Results are stored when they are computed, and read when nothing that they depend on has changed. The modules that
measure, fit and diagnose are imported by the methods that use them: reading what is stored does not wait for them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from frictrack import effects
from frictrack.base import __version__
from frictrack.base.errors import FrictrackError, UsageError, suggest
from frictrack.base.files import lock_work
from frictrack.base.workers import WorkerPool
from frictrack.effects import models
from frictrack.flow import opening, sensor_stage, store, stored_results
from frictrack.flow.command_history import CommandHistory, Predictions, SignificanceBudget, alpha_spent, plan_test
from frictrack.flow.opening import MeasuredRuns, open_study
from frictrack.flow.pipeline import Progress, RunPipeline, digest, hash_path, no_progress
from frictrack.flow.plausibility_checks import find_duplicate_runs, why_unsearched, withhold_verdict
from frictrack.flow.store import Provenance
from frictrack.flow.tried_models import FitRequest, TriedModels, configured_effects, user_effects
from frictrack.results import Results, to_builtins
from frictrack.results.candidates import plain_name
from frictrack.results.verdicts import describe_no_run, describe_tests, describe_verdict
from frictrack.search import METHODS, read_settings
from frictrack.settings.costs import DEFAULT_COSTS
from frictrack.study import Study

P = ParamSpec("P")
T = TypeVar("T")
Json = dict[str, Any]


def exclusive(method: Callable[Concatenate[Session, P], T]) -> Callable[Concatenate[Session, P], T]:
    """Let one process at a time work on the models of a study; the next one waits and uses what the first computed."""

    @wraps(method)
    def locked(session: Session, /, *arguments: P.args, **keywords: P.kwargs) -> T:
        with lock_work(session.study.output, lambda: session.progress(0, 1, "waiting for another frictrack")):
            return method(session, *arguments, **keywords)

    return locked


class Session:
    """One study, its runs and the models tried on it.

    The methods return the dictionaries that the command line prints with ``--json``.

    Parameters
    ----------
    study
        The study, as `open_study` returns it.
    progress
        Called as ``progress(done, total, what)``.
    author
        Recorded in the command history with every change.
    expected_revision
        Revision of the study that the user has seen; a change is refused if the study is at another one. None allows
        any.
    notes
        Sentences for the report, for example on runs that were left out.
    pool
        Processes that take over segments of long uncompressed films; the positions are the same.

    Attributes
    ----------
    runs
        The runs, in the order of the study file.
    findings
        The implausible numbers of the study that were found so far.

    Examples
    --------
    Fit, diagnose, add the best candidate and write the report::

        session = Session(open_study("study.toml"))
        session.fit()
        session.add(session.diagnose()["missing"][0])
        session.report()

    """

    def __init__(
        self,
        study: Study,
        progress: Progress = no_progress,
        *,
        author: str = "python",
        expected_revision: int | None = None,
        notes: tuple[str, ...] = (),
        pool: WorkerPool | None = None,
    ) -> None:
        self.progress, self._pool = progress, pool
        self.notes = notes
        self.commands = CommandHistory(study.output, author, expected_revision)
        self._load(study)

    def _load(self, study: Study) -> None:
        self.study = study
        self._measured = MeasuredRuns(study, self.progress, self._pool)
        self.runs, self.findings = self._measured.pipelines, self._measured.findings
        self.models = TriedModels(study, self.runs, self.progress, self.commands)
        self.budget = SignificanceBudget(study.output)
        self.predictions = Predictions(study.output)
        self.path = study.output / "study.h5"

    def apply(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Run one command that changes the study; the command history, jobs and scripts use this method.

        Parameters
        ----------
        command
            One of `MODEL_EDITS` or `STUDY_EDITS`.
        **arguments
            Those of the method, or of the function in `frictrack.flow.opening`.

        Raises
        ------
        FrictrackError
            If the command is unknown, fails, or the study is not at the expected revision.

        """
        self.commands.check_revision()
        models: dict[str, Callable[..., Any]] = {"fit": self.fit, "add": self.add, "remove": self.remove}
        if command in opening.EDITS:
            return self._edit_study(command, **arguments)
        if command not in models:
            hint = suggest(command, (*models, *opening.EDITS))
            raise UsageError(f"expected a command but got {command!r}; {hint}")
        return models[command](**arguments)

    def _edit_study(self, command: str, **arguments: Any) -> dict[str, Any]:
        result = opening.EDITS[command](self.models, **arguments)
        self._load(open_study(self.study.path, allow_incomplete=True))
        return result

    def bring_up_to(self, stage: str) -> list[RunPipeline]:
        """Bring every run up to date, up to one stage; stages that a table of positions does not have are skipped.

        The numbers in the study file are checked first, and the motion before anything is computed from it.

        Parameters
        ----------
        stage
            Name of the stage; see `frictrack.flow.stages`.

        Raises
        ------
        FrictrackError
            If a stage fails, or a number cannot be right.

        """
        return self._measured.bring_up_to(stage)

    def measure(self, stage: str, *, overlay: bool = False) -> dict[str, Any]:
        """Bring every run up to ``"track"``, ``"motion"`` or ``"friction"``: JSON of those commands.

        Parameters
        ----------
        stage
            The stage.
        overlay
            Write every film once more with the tracked positions drawn into it.

        """
        rows = self._measured.summaries(stage, overlay=overlay)
        return {"runs": rows, "warnings": self.findings.summary, "output": str(self.study.output)}

    @exclusive
    def fit(self, /, model: str | None = None, *, profiles: bool = False, draws: int = 0, **how: Any) -> dict[str, Any]:
        """Fit the current model, or another one that becomes current.

        Parameters
        ----------
        model
            Name of a model, or effects separated by commas; None for the current model.
        profiles
            Compute 95 % intervals by profile likelihood.
        draws
            Number of parametric bootstrap draws for 95 % intervals; 0 for none.
        **how
            `domain`, `search`, `over`, `seed`, `per`; None keeps the setting of the current model. `settings` of a
            global search by name; they are added to those of the study file for the same search.

        Returns
        -------
        dict
            JSON of `frictrack fit`: "parameters", "errors", "per_run", "remarks", ...

        Raises
        ------
        FrictrackError
            If the model is unknown, or a run cannot be measured.

        """
        asked: dict[str, Any] = {key: value for key, value in how.items() if value is not None}
        if asked.get("search") == "varpro":
            asked.setdefault("over", "all")
        if not asked.keys().isdisjoint(("search", "settings", "seed")):
            asked["settings"] = self._search_settings(asked)
        if model is not None:
            parts = tuple(models.names_in(model))
            base = parts if len(parts) > 1 else model
            asked |= {"base": base, "edits": ()}
            FitRequest(base).model(self.study.effects)
        self.bring_up_to("friction")
        if self.models.groups:
            group, request = self.models.current()
        else:  # the study file's model is fitted first, even if another one is asked for
            first = self.models.first_request()
            group, request = self.models.append(first if "base" in asked else replace(first, **asked))
        if replace(request, **asked) != request or ("search" in asked and self.models.was_interrupted(group)):
            group, request = self.models.append(replace(request, **asked), model=model, **how)
        if profiles or draws:
            self._add_uncertainty(group, profiles, draws, request.seed)
        result = self.models.summary(group)
        twice = [f'run "{name}" is {note}' for name, note in find_duplicate_runs(self.runs).items()]
        from_motion = [run for run in self.models.runs if run.drive is None and run.friction_N is None]
        error = max((run.displacement.relative_scale_error for run in from_motion), default=0.0)
        return {**result, "remarks": [*result["remarks"], *twice], "scale_error": error, **self._remarks}

    @property
    def _remarks(self) -> dict[str, Any]:
        """What was noticed of the study and its runs, in the JSON of a fit and of a diagnosis."""
        return {"warnings": self.findings.summary, "findings": self._measured.notes()}

    def _search_settings(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of a global search: those asked for, and the study file's for the same search."""
        group, own = self.models.current_group, self.study.search
        before = self.models.first_request() if group is None else self.models.request(group)
        search, given = asked.get("search", before.search), asked.get("settings", {})
        if "search" in asked or given:
            settings = dict(own.request["settings"]) if own is not None and own.method == search else {}
        else:
            settings = dict(before.settings)
        if "seed" in asked:
            settings.pop("seed", None)
        if given and search != "varpro":
            settings |= read_settings(METHODS[search], given)
        FitRequest("tustin", search=search, settings=settings or given).method  # noqa: B018 - checked before any work
        return settings

    def _add_uncertainty(self, group: str, profiles: bool, draws: int, seed: int) -> None:
        """Store profiles and bootstrap intervals of a fit beside it; those computed before are kept."""
        from frictrack.fit import analyse_uncertainty  # noqa: PLC0415

        inside = f"models/{group}/certainty"
        self.models.bring_up_to_date(group)
        key = digest(["certainty", profiles, draws, seed, self.models.fit_key(self.models.request(group))])
        if self.models.stored_summary(inside, key) is None:
            asked: dict[str, Any] = {"profiles": profiles, "draws": draws, "rng": seed}
            found = analyse_uncertainty(self.models.fit(group), **asked, progress=self.progress).summary()
            known = self.models.stored_summary(inside) or {}
            self.models.keep_summary(inside, known | found, self.models.provenance(key, json.dumps({"seed": seed})))

    @exclusive
    def compare_groups(self, parameter: str) -> dict[str, Any]:
        """Return the JSON of `frictrack compare --parameter`: the current law's parameter in every group of runs."""
        from frictrack.diagnose.compare import compare_groups  # noqa: PLC0415

        self.bring_up_to("friction")
        return compare_groups(self._fitted(), parameter).summary()

    @exclusive
    def compare(self) -> dict[str, Any]:
        """Compare the errors of all models tried, and find where the current one fails.

        If nothing has changed since, the stored comparison is read, and no run is opened.

        Returns
        -------
        dict
            JSON of `frictrack compare`: "models" with their errors, and "fails_at".

        """
        if self.models.groups and not self.models.is_current_outdated():
            stored = self.models.stored_summary("comparison", self._history_key())
            if stored is not None:
                return stored
        from frictrack.diagnose.compare import compare  # noqa: PLC0415

        self.bring_up_to("friction")
        self.models.current()
        entries = [self._tried_model(group) for group in self.models.groups]  # those that are outdated are fitted again
        fails = compare([self._fitted()]).summary()
        provenance = self.models.provenance(self._history_key(), "{}")
        return self.models.keep_summary("comparison", {**fails, "models": entries}, provenance)

    def _fitted(self) -> Any:
        """Return the fit of the current model."""
        return self.models.fit(self.models.current()[0])

    def _history_key(self) -> str:
        """Return the hash of all models tried; it depends on the study file and the recordings, not on results."""
        keys = (self.models.fit_key(self.models.request(group)) for group in self.models.groups)
        return digest([self.models.groups.index(self.models.current()[0]), *keys])

    def _tried_model(self, group: str) -> dict[str, Any]:
        """Return the entry of a model: name, effects, settings and errors."""
        summary, request = self.models.summary(group), self.models.request(group)
        is_lost = bool(request.lost(self.study.effects))
        settings = {} if is_lost else request.model(self.study.effects).settings
        return {"name": group, "model": summary["model"], "settings": settings, "errors": summary["errors"]}

    @exclusive
    def history(self) -> dict[str, Any]:
        """List every model tried with its errors, in order.

        Returns
        -------
        dict
            JSON of `frictrack history`: "models", "fails_at", "tests", "alpha_spent" and "predictions".

        """
        return {**self.compare(), **self.budget.summary(), "predictions": self.predictions.rows}

    @exclusive
    def name_next_run(self) -> dict[str, Any]:
        """Choose the run to film now from the current fit and its diagnosis, and keep what is predicted of it."""
        from frictrack.diagnose.experiments import next_run  # noqa: PLC0415

        group, request = self.models.current()
        fitted = self.models.fit(group)
        found = self.models.stored_summary(f"models/{group}/diagnosis")
        if found is None:
            return {"next": None, "next_reason": "`frictrack diagnose` says first what is open in this model"}
        named = next_run(fitted, found, self.study.costs)
        if named is None:
            return {"next": None, "next_reason": describe_no_run(found)}
        named = to_builtins(named)
        self.predictions.record(named, request.model(self.study.effects).names, self._fitted_runs())
        return {"next": named, "next_reason": None}

    def _fitted_runs(self) -> list[str]:
        """Names of the runs that are fitted."""
        return [run.name for run in self.models.runs if run.role != "validation"]

    @exclusive
    def diagnose(
        self,
        seed: int = 0,
        *,
        quick: bool = False,
        on_verdict: Callable[[dict[str, Any]], None] | None = None,
        alpha: float | None = None,
    ) -> dict[str, Any]:
        """Find the effect that the current model lacks.

        The verdict is stored as soon as it is known; a diagnosis that is interrupted afterwards keeps it. Its
        significance level follows from the tests that were made before; see `frictrack.flow.command_history`.

        Parameters
        ----------
        seed
            Seed of the random numbers.
        quick
            End when the verdict is known; the result has "complete" false.
        on_verdict
            Called with that result, if the diagnosis is not stored in full already.
        alpha
            Significance level; None for that which follows from the tests made before. Given where a diagnosis is
            repeated elsewhere.

        Returns
        -------
        dict
            JSON of `frictrack diagnose`: "verdict", "complete", "missing", "candidates", "next_experiment", ...

        Raises
        ------
        FrictrackError
            If a run cannot be measured.

        """
        self.bring_up_to("friction")
        group, request = self.models.current()
        self.models.bring_up_to_date(group)  # a new fit removes the old diagnosis
        inside = f"models/{group}/diagnosis"
        key = digest(["diagnosis", seed, self.models.fit_key(request), self._diagnosis_inputs()])
        test = plan_test(self.budget.rows, key, self.models.input_hash, request.model(self.study.effects).names)
        test = test if alpha is None else replace(test, alpha=alpha)
        spent = alpha_spent([*self.budget.rows, test])
        more, name = {"alpha_spent": spent, **self._remarks}, plain_name(group)

        def whole(found: dict[str, Any]) -> dict[str, Any]:
            return {**found, **more, "headline": describe_verdict(found, name)}

        found = self.models.stored_summary(inside, key)
        if found is None or not (quick or found.get("complete", True)):
            if found is not None and on_verdict:  # an earlier diagnosis was interrupted after its verdict
                on_verdict(whole(found))
            announce = on_verdict if found is None and on_verdict else lambda _: None
            made = self.models.provenance(key, json.dumps({"seed": seed}))
            found = self._diagnose(group, made, lambda one: announce(whole(one)), alpha=test.alpha, quick=quick)
        elif store.provenance(self.path, "diagnosis") != store.provenance(self.path, inside):
            store.write(self.path, {}, links={"diagnosis": f"/{inside}"})
        if test.named is None:
            self.budget.record(test, found)
        self.predictions.resolve(found, self._fitted_runs())
        return whole(found)

    def _diagnose(self, group: str, provenance: Provenance, announce: Callable[[Json], None], **how: Any) -> Json:
        """Diagnose a model; store the verdict when it is known, and the whole when that is."""
        from frictrack.diagnose import Diagnosis, diagnose, unsearched  # noqa: PLC0415

        inside = f"models/{group}/diagnosis"

        def keep(diagnosis: Diagnosis) -> Json:
            summary = withhold_verdict(diagnosis.summary(), self.findings.contradictions)
            links = {"diagnosis": f"/{inside}"}
            settings = json.dumps(json.loads(provenance.settings) | {"complete": diagnosis.complete})
            made = replace(provenance, settings=settings)
            return self.models.keep_summary(inside, summary, made, links, figures=diagnosis.figures)

        self.progress(0, 0, f"diagnosing {group}")
        how |= {"functions": self.study.functions, "costs": self.study.costs, "progress": self.progress}
        how |= {"own": configured_effects(self.study.effects), "auxiliary": sensor_stage.auxiliary_signals(self.runs)}
        how |= {"rng": json.loads(provenance.settings)["seed"], "on_verdict": lambda verdict: announce(keep(verdict))}
        fitted = self.models.fit(group)
        is_void = bool(why_unsearched(self.findings.contradictions, fitted.model.names))
        diagnosis = unsearched(fitted, how["alpha"]) if is_void else diagnose(fitted, **how)
        return keep(diagnosis) if diagnosis.complete else self.models.stored_summary(inside) or {}

    def _diagnosis_inputs(self) -> list[Any]:
        """What a diagnosis depends on besides the fit: sensors, further tracks, contradictions, `[[effect]]` tables."""
        names = ("sensors", "tracks")
        keys = [pipeline.key(name) for pipeline in self.runs for name in names if name in pipeline.stages]
        contradicted = [str(finding) for finding in self.findings.contradictions]
        functions = [list(self.study.functions)] if self.study.functions else []
        costs = [asdict(self.study.costs)] if self.study.costs != DEFAULT_COSTS else []
        tables = (table.model_dump(mode="json") for table in self.study.effects)
        return [keys, contradicted, *functions, *costs, *tables]

    @exclusive
    def add(self, effect: str, seed: int | None = None) -> dict[str, Any]:
        """Add one effect to the current model and fit again.

        Parameters
        ----------
        effect
            Name of the effect; or "formula:1" for the first formula of the last diagnosis, which is written into the
            study file as an effect.
        seed
            Seed of the random numbers; None for that of the current model.

        Raises
        ------
        FrictrackError
            If the effect is unknown, or the last diagnosis has no such formula.

        """
        return self._change_model("+", self._defined(effect), seed)

    def _defined(self, effect: str) -> str:
        """Return the name of an effect; that of a formula is written into the study file first."""
        number = opening.formula_number(effect)
        if number is None:
            return effect
        group, request = self.models.current()
        found = self.models.stored_summary(f"models/{group}/diagnosis")
        taken = [table.effect for table in self.study.effects]
        keys = opening.choose_formula(number, found, taken, request.model(self.study.effects).names)
        self._edit_study("define", effect=keys)
        return str(keys["effect"])

    @exclusive
    def remove(self, effect: str, seed: int | None = None) -> dict[str, Any]:
        """Remove one effect from the current model and fit again.

        Parameters
        ----------
        effect
            Name of the effect.
        seed
            Seed of the random numbers; None for that of the current model.

        """
        return self._change_model("-", effect, seed)

    def _change_model(self, sign: str, effect: str, seed: int | None) -> dict[str, Any]:
        """Fit the current model with one edit."""
        group, request = self.models.current()
        if sign == "+" or effect not in request.lost(self.study.effects):
            effects.get(effect, user_effects(self.study.effects))  # an unknown name is refused before any work
        self.bring_up_to("friction")
        request = request.edited(sign + effect) if seed is None else replace(request.edited(sign + effect), seed=seed)
        request.model(self.study.effects)
        before, command = self.models.summary(group), "add" if sign == "+" else "remove"
        new_group, _ = self.models.append(request, command, effect=effect, seed=request.seed)
        after = self.models.summary(new_group)
        errors = {"error_before": before["errors"], "error_after": after["errors"]}
        return {"effect": effect, **errors, "parameters": after["parameters"], "misfit": after.get("misfit")}

    @exclusive
    def attempt(self, effect: str) -> dict[str, Any]:
        """Fit the current model with one more effect and keep the fit; the study is not changed.

        `add` takes the same fit from there.

        Parameters
        ----------
        effect
            Name of the effect.

        Returns
        -------
        dict
            The JSON of `fit`.

        """
        effects.get(effect, user_effects(self.study.effects))  # an unknown name is refused before any work
        self.bring_up_to("friction")
        return self.models.attempt(self.models.current()[1].edited(f"+{effect}"))

    @exclusive
    def run(self, seed: int = 0, *, on_verdict: Callable[[dict[str, Any]], None] | None = None) -> dict[str, Any]:
        """Fit, diagnose, compare and report.

        Parameters
        ----------
        seed
            Seed of the diagnosis.
        on_verdict
            Called with "fit" and the incomplete "diagnose" when the verdict is known; see `diagnose`.

        """
        fit = self.fit()
        announce = (lambda found: on_verdict({"fit": fit, "diagnose": found})) if on_verdict else None
        diagnosis = self.diagnose(seed, on_verdict=announce)
        self.report(seed, anew=False)
        warnings = self.findings.summary
        return {"fit": fit, "diagnose": diagnosis, "warnings": warnings, "output": str(self.study.output)}

    @exclusive
    def report(self, seed: int | None = None, *, anew: bool = True) -> Path:
        """Write ``report.html`` and return its path.

        Parameters
        ----------
        seed
            Seed of the diagnosis; None for that of the last one.
        anew
            Write the page even if it was made from the same results before.

        """
        path = self.study.output / "report.html"
        notes = self._update_all(seed)
        warnings = self.findings.messages
        files = (self.study.path, self.path, *(pipeline.path for pipeline in self.runs))
        inputs = digest([__version__, notes, warnings, *map(hash_path, files)])
        results = stored_results.results_key(self.models)
        key = f"{inputs} {results} {self.models.current()[0]}"
        if anew or (written := stored_results.stored_report_key(path)) is None or written[0] != key:
            self.progress(0, 0, f"writing {path.name}")
            from frictrack.present import report  # noqa: PLC0415 - takes seconds to import and draw

            report.write(replace(stored_results.read_results(self.study), notes=notes), path, key)
        return path

    def restart(self) -> None:
        """Remove the models tried; measurements are kept."""
        if self.path.exists():
            with self.commands.record("restart"):
                store.write(self.path, {}, remove=("models", "comparison", "diagnosis", "papers"))
        self._load(self.study)

    @exclusive
    def law_text(self) -> str:
        """Return the current model as the text of a prior file; "" if it rests on a prior, or nothing carries over."""
        fitted = self._fitted()
        if self.study.prior is None and hasattr(fitted, "to_prior"):
            with suppress(FrictrackError):
                return str(fitted.to_prior(self.study.name).to_toml())
        return ""

    @exclusive
    def export_prior(self, path: Path | None = None) -> dict[str, Any]:
        """Write the current model as a prior file for another study: JSON of `frictrack export --to prior`.

        Parameters
        ----------
        path
            The file; default in the folder of the results.

        Raises
        ------
        FrictrackError
            If no parameter carries over, or the runs were fitted group by group.

        """
        fitted = self._fitted()
        if not hasattr(fitted, "to_prior"):
            raise UsageError(
                "expected one law for all runs but the current model was fitted per group; `frictrack fit STUDY "
                "--model ...` without --per fits one law"
            )
        prior = fitted.to_prior(self.study.name)
        file = prior.save(self.study.output / f"{self.study.path.stem}.prior.toml" if path is None else path)
        return {"file": str(file), **prior.summary(), "output": str(self.study.output)}

    @exclusive
    def results(self, seed: int | None = None) -> Results:
        """Bring everything up to date and return all results, for the report and the export.

        Parameters
        ----------
        seed
            Seed of the diagnosis; None for that of the last one.

        """
        notes = self._update_all(seed)
        return replace(stored_results.read_results(self.study), notes=notes)

    def _update_all(self, seed: int | None) -> tuple[str, ...]:
        """Compute all that is missing or outdated; return notes, also on what could not be computed."""
        self._measured.update_all_stages()
        self.compare()
        self.diagnose(self._last_seed() if seed is None else seed)
        return (*self.notes, *self._update_papers_route(), *describe_tests(self.budget.summary()))

    def _last_seed(self) -> int:
        """Return the seed of the last diagnosis."""
        provenance = store.provenance(self.path, "diagnosis")
        return int(json.loads(provenance.settings)["seed"]) if provenance else 0

    def _update_papers_route(self) -> tuple[str, ...]:
        """Bring the fit by the papers' route up to date, or return a note why there is none.

        Where friction was measured, there is no other route.
        """
        if all(run.friction_N is None for run in self.models.runs):
            try:
                self.models.fit_papers_route()
            except FrictrackError as e:
                return (f"the papers' route (force domain, SGA) was not possible: {e}",)
        return ()
