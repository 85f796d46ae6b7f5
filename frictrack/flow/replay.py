"""Write the Python script that repeats an analysis: the commands of the history, through the same `Session.apply`."""

from __future__ import annotations

from frictrack.flow.command_history import Change, CommandHistory
from frictrack.study import Study

HEAD = '''"""Repeat the analysis of {name}: every fit and every choice of the history, in order.

The study file {file} already contains the edits that were made in it.
"""

from frictrack.flow import Session, open_study

session = Session(open_study({file!r}))
session.restart()  # forget the models tried; measurements are kept
'''
TAIL = """
print(session.diagnose()["verdict"])
print(session.report())
"""
STUDY_FILE_COMMANDS = ("edit", "take_in", "leave_out", "define")  # their effect is already in the study file


def replay_script(study: Study) -> str:
    """Return a Python script that leads to the current model; commands that were undone are left out.

    Parameters
    ----------
    study
        The study.

    """
    history = CommandHistory(study.output)
    done, _ = history.undo_stacks()
    first = [change for change in history.changes if change.command == "fit" and not change.before][-1:]
    lines = [_command_line(change) for change in (*first, *done) if change.command not in STUDY_FILE_COMMANDS]
    return HEAD.format(name=study.name, file=study.path.name) + "".join(f"{line}\n" for line in lines) + TAIL


def _command_line(change: Change) -> str:
    arguments = "".join(f", {key}={value!r}" for key, value in change.arguments.items() if value is not None)
    return f"session.apply({change.command!r}{arguments})"
