"""Run a study from its file to its report; load, compute and save its results.

    recording -> track -> displacement -> filtered -> motion -> friction        per run, the tables in `stages`
    fit -> compare -> diagnose -> (add, fit again) -> report                    per study, `Session`

`Session` is the only code that computes and saves the results of a study; the command line and the workbench use it.
`read_results` reads what is stored and computes nothing.

    new_study, survey, opening  make, open and check a study before any work
    pipeline, stages            bring the stages of one run up to date
    measured_runs               bring all runs up to date, and check their numbers on the way
    film_stages, track_quality  from a film to its displacement
    sensor_stage                what other instruments and further targets recorded
    plausibility_checks         check the numbers of a study
    fit_request, tried_models   what was asked of a fit; models tried, and fits of candidates
    study_edits, command_history, replay                        changes of a study, undo, repetition
    diagnosis_records           how probable a false effect is, over all diagnoses; what was predicted of runs
    workflows                   a whole study in one call: run, change, plan, demonstration
    stored_results              read stored results, find outdated ones
    run_summaries               a row of numbers for each run, with its error budget
    verification                verify stored results, read all their values
    summaries                   the shapes of the summaries that `Session` returns
    schema                      write the page that describes the HDF5 files
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.base.lazy import lazy_names, module_of

if TYPE_CHECKING:
    from frictrack.flow.command_history import Change, CommandHistory, undo_stacks
    from frictrack.flow.diagnosis_records import SignificanceBudget
    from frictrack.flow.film_stages import contact_sheet_path
    from frictrack.flow.fit_request import FitRequest, user_effects
    from frictrack.flow.new_study import (
        Surveyed,
        check_entered,
        describe_keys,
        propose_study,
        start_study,
        survey_recording,
    )
    from frictrack.flow.opening import open_study, table_needs_mass
    from frictrack.flow.pipeline import Progress, RunPipeline, hash_path, no_progress
    from frictrack.flow.plausibility_checks import Findings
    from frictrack.flow.replay import recorded_models, repeat_models, replay_script
    from frictrack.flow.session import Session
    from frictrack.flow.stages import run_pipeline
    from frictrack.flow.stored_results import (
        AttemptsReader,
        ResultsReader,
        preview_motion,
        read_results,
    )
    from frictrack.flow.study_edits import effect_of_formula
    from frictrack.flow.verification import EXCLUDED, Values, stored_values, verify
    from frictrack.flow.workflows import change_and_diagnose, conclude, demo, plan, run_study

_MODULE_OF = module_of(
    {
        "study_edits": "effect_of_formula",
        "workflows": "change_and_diagnose conclude run_study plan demo",
        "diagnosis_records": "SignificanceBudget",
        "stored_results": "AttemptsReader preview_motion read_results ResultsReader",
        "command_history": "Change CommandHistory undo_stacks",
        "new_study": "check_entered describe_keys propose_study start_study",
        "film_stages": "contact_sheet_path",
        "plausibility_checks": "Findings",
        "fit_request": "FitRequest user_effects",
        "pipeline": "hash_path no_progress Progress RunPipeline",
        "opening": "open_study table_needs_mass",
        "replay": "recorded_models repeat_models replay_script",
        "stages": "run_pipeline",
        "session": "Session",
        "survey": "survey_recording Surveyed",
        "verification": "verify EXCLUDED stored_values Values",
    }
)

__all__ = [*_MODULE_OF]  # noqa: PLE0604 - they are strings
__getattr__ = lazy_names(__name__, _MODULE_OF)
