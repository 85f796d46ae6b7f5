"""Run a study from its file to its report; load, compute and save its results.

    recording -> track -> displacement -> filtered -> motion -> friction        per run, the tables in `stages`
    fit -> compare -> diagnose -> (add, fit again) -> report                    per study, `Session`

`Session` is the only code that computes and saves the results of a study; the command line and the workbench use it.
`read_results` reads what is stored and computes nothing.

    new_study                   make a study of recordings
    opening                     open and check a study before any work; bring its runs up to date; change it, undo
    pipeline, stages            bring the stages of one run up to date
    track_quality               faults of a film's tracks
    sensor_stage                what other instruments and further targets recorded
    plausibility_checks         check the numbers of a study
    tried_models                what was asked of a fit; models tried, and fits of candidates
    command_history             what a study remembers: its changes, the tests of its models, predictions
    workflows                   a whole study in one call: run, change, plan, demonstration, repetition
    stored_results              read stored results, find outdated ones; a row of numbers for each run
    verification                verify stored results, read all their values
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.base import lazy_names

if TYPE_CHECKING:
    from frictrack.flow.command_history import Change, CommandHistory, SignificanceBudget, undo_stacks
    from frictrack.flow.new_study import (
        Surveyed,
        check_entered,
        describe_keys,
        propose_study,
        start_study,
        survey_recording,
    )
    from frictrack.flow.opening import effect_of_formula, open_study
    from frictrack.flow.pipeline import Progress, digest, hash_path, no_progress
    from frictrack.flow.session import Session
    from frictrack.flow.stages import contact_sheet_path, run_pipeline
    from frictrack.flow.stored_results import ResultsReader, preview_motion, read_results
    from frictrack.flow.tried_models import FitRequest, user_effects
    from frictrack.flow.verification import stored_values, verify
    from frictrack.flow.workflows import change_and_diagnose, conclude, demo, plan, replay_script, run_study

__getattr__, __all__ = lazy_names(__name__)
