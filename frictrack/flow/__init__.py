"""Run a study from its file to its report; load, compute and save its results.

    recording -> track -> displacement -> filtered -> motion -> friction        per run, the tables in `stages`
    fit -> compare -> diagnose -> (add, fit again) -> report                    per study, `Session`

`Session` is the only code that computes and saves the results of a study; the command line and the workbench use it.
`read_results` reads what is stored and computes nothing.

    new_study, survey, opening, input_checks                    make, open and check a study before any work
    pipeline, stages            bring the stages of one run up to date
    film_stages, track_quality, target_rotation                 from a film to its displacement
    sensor_stage, auxiliary_signals                             what other instruments recorded
    fit_request, tried_models, study_edits, command_history, replay   models tried, changes of the study, undo
    significance_budget         how probable a false effect is, over all diagnoses of a study
    verdict_first, attempts                                     the verdict before all else, fits of candidates
    plausibility_checks, contradictions, duplicate_runs         checks of the numbers in the study file
    stored_results, result_values, outdated                     read stored results and values, find outdated ones
    run_summaries, run_budget, verification                     summarise and verify stored results
    summaries                   the shapes of the summaries that `Session` returns
    schema                      write the page that describes the HDF5 files
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.lazy import lazy_names, module_of

if TYPE_CHECKING:
    from frictrack.flow.command_history import Change, CommandHistory, undo_stacks
    from frictrack.flow.film_stages import contact_sheet_path
    from frictrack.flow.fit_request import FitRequest, user_effects
    from frictrack.flow.formula_effects import effect_of_formula
    from frictrack.flow.input_checks import table_needs_mass
    from frictrack.flow.new_study import check_entered, describe_keys, propose_study, start_study
    from frictrack.flow.opening import open_study
    from frictrack.flow.pipeline import Progress, RunPipeline, hash_path, no_progress
    from frictrack.flow.plausibility_checks import Findings
    from frictrack.flow.replay import recorded_models, repeat_models, replay_script
    from frictrack.flow.result_values import EXCLUDED, Values, stored_values
    from frictrack.flow.run_plan import plan
    from frictrack.flow.sample_demo import demo
    from frictrack.flow.session import Session
    from frictrack.flow.significance_budget import SignificanceBudget
    from frictrack.flow.stages import run_pipeline
    from frictrack.flow.stored_results import (
        AttemptsReader,
        ResultsReader,
        preview_motion,
        read_results,
    )
    from frictrack.flow.survey import Surveyed, survey_recording
    from frictrack.flow.verdict_first import change_and_diagnose, conclude, run_study
    from frictrack.flow.verification import verify

_MODULE_OF = module_of(
    {
        "result_values": "EXCLUDED stored_values Values",
        "stored_results": "AttemptsReader preview_motion read_results ResultsReader",
        "command_history": "Change CommandHistory undo_stacks",
        "verdict_first": "change_and_diagnose conclude run_study",
        "new_study": "check_entered describe_keys propose_study start_study",
        "film_stages": "contact_sheet_path",
        "sample_demo": "demo",
        "formula_effects": "effect_of_formula",
        "plausibility_checks": "Findings",
        "fit_request": "FitRequest user_effects",
        "pipeline": "hash_path no_progress Progress RunPipeline",
        "opening": "open_study",
        "run_plan": "plan",
        "replay": "recorded_models repeat_models replay_script",
        "stages": "run_pipeline",
        "session": "Session",
        "significance_budget": "SignificanceBudget",
        "survey": "survey_recording Surveyed",
        "input_checks": "table_needs_mass",
        "verification": "verify",
    }
)

__all__ = [*_MODULE_OF]  # noqa: PLE0604 - they are strings
__getattr__ = lazy_names(__name__, _MODULE_OF)
