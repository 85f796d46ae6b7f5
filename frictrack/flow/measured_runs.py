"""The runs of a study: bring them up to date stage by stage, and check their numbers on the way."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from frictrack.base.errors import FrictrackError
from frictrack.flow.pipeline import Progress, RunPipeline
from frictrack.flow.stages import run_pipelines
from frictrack.study import Study

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool
    from frictrack.flow.plausibility_checks import Findings

STAGES_FROM_MOTION = ("motion", "events", "cutoff", "friction")


class MeasuredRuns:
    """The runs of a study with what was measured of them.

    Parameters
    ----------
    study
        The study.
    progress
        Called as ``progress(done, total, what)``.
    pool
        Processes that take over segments of long uncompressed films; the positions are the same.

    Attributes
    ----------
    pipelines : list of RunPipeline
        One per run, in the order of the study file.

    """

    def __init__(self, study: Study, progress: Progress, pool: WorkerPool | None) -> None:
        self._study, self._progress = study, progress
        self.pipelines = run_pipelines(study, progress, pool)
        self._inputs_checked = False

    @cached_property
    def findings(self) -> Findings:
        """The implausible numbers of the study that were found so far."""
        from frictrack.flow.plausibility_checks import Findings  # noqa: PLC0415 - not needed for stored results

        return Findings(self._study)

    def bring_up_to(self, stage: str) -> list[RunPipeline]:
        """Bring every run up to date; see `frictrack.flow.session.Session.bring_up_to`."""
        if self._study.incomplete:
            raise FrictrackError(f"{self._study.path.name}: {'; '.join(self._study.incomplete)}", usage=True)
        self.findings.check_study_file()
        self._check_inputs(stage)
        if stage in STAGES_FROM_MOTION:
            self._update("motion", self.pipelines)
            self.findings.check_runs(self.pipelines)
        self._update(stage, self.pipelines)
        if stage == "friction":
            self.findings.check_all_runs(self.pipelines)
            self.findings.save(self.pipelines)
        return self.pipelines

    def _check_inputs(self, stage: str) -> None:
        """Check all inputs once, and the units of tables before films are tracked."""
        if not self._inputs_checked:
            from frictrack.flow.opening import check_inputs  # noqa: PLC0415 - not needed for stored results

            check_inputs(self.pipelines)
            self._inputs_checked = True
        tables = [p for p in self.pipelines if p.run.table]
        if stage in STAGES_FROM_MOTION and tables and len(tables) < len(self.pipelines):
            self._update("motion", tables)
            self.findings.check_tables(tables)

    def _update(self, stage: str, pipelines: list[RunPipeline]) -> None:
        missing = [p for p in pipelines if stage in p.stages and not p.is_current(stage)]
        if missing:
            count = "1 run" if len(missing) == 1 else f"{len(missing)} runs"
            self._progress(0, 0, f"measuring {count} up to {stage}")
        for i, pipeline in enumerate(pipelines):
            self._progress(i, len(pipelines), "runs")
            if stage in pipeline.stages:
                pipeline.get(stage)
        self._progress(len(pipelines), len(pipelines), "runs")

    def update_all_stages(self) -> None:
        """Compute every stage of every run that is missing or outdated."""
        for pipeline in self.pipelines:
            with pipeline.saved_together():
                for stage in pipeline.stages:
                    pipeline.get(stage)

    def summaries(self, stage: str, *, overlay: bool = False) -> list[dict[str, Any]]:
        """Bring every run up to "track", "motion" or "friction", and return a row of numbers for each.

        Parameters
        ----------
        stage
            The stage.
        overlay
            Write every film once more with the tracked positions drawn into it.

        """
        from frictrack.flow.film_stages import write_overlay  # noqa: PLC0415
        from frictrack.flow.run_summaries import run_summaries  # noqa: PLC0415

        for pipeline in self.pipelines if overlay else ():
            if pipeline.run.video:
                write_overlay(pipeline)
        pipelines = self.bring_up_to("tracks" if stage == "track" else stage)
        if stage != "track":
            self.bring_up_to("cutoff")
        rows: list[dict[str, Any]] = run_summaries(pipelines, stage)
        return rows

    def notes(self) -> list[dict[str, str]]:
        """Notes on the displacement of every run and on its impact; notes that nothing was found are left out."""
        from frictrack.measure.friction import impact  # noqa: PLC0415

        notes = [
            (pipeline.run.name, note) for pipeline in self.pipelines for note in pipeline.get("displacement").notes
        ]
        found = [{"run": run, "words": note} for run, note in notes if not note.startswith(("no ", "nothing "))]
        impacts = [{"run": p.run.name, "words": impact(p.to_run())} for p in self.pipelines]
        return [*found, *(one for one in impacts if one["words"])]
