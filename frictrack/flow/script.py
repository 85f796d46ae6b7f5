"""The Python script that repeats what was done to a study: the log, told again through the same door."""

from __future__ import annotations

from frictrack.flow.ledger import Change, Ledger
from frictrack.study import Study

HEAD = '''"""Repeats the analysis of {name}: every fit and every choice of the log, in order.

The study file {file} holds what was edited in it already.
"""

from frictrack.flow import Session, open_study

session = Session(open_study({file!r}))
session.restart()  # forget the models tried; what was measured stays
'''
TAIL = """
print(session.diagnose()["verdict"])
print(session.report())
"""
FILE = ("edit", "take_in", "leave_out", "define")  # stand in the study file


def script(study: Study) -> str:
    """A script that leads to the model that is current now; what was undone is not in it."""
    ledger = Ledger(study.output)
    done, _ = ledger.stacks()
    first = [change for change in ledger.changes if change.do == "fit" and not change.before][-1:]
    lines = [_line(change) for change in (*first, *done) if change.do not in FILE]
    return HEAD.format(name=study.name, file=study.path.name) + "".join(f"{line}\n" for line in lines) + TAIL


def _line(change: Change) -> str:
    told = "".join(f", {key}={value!r}" for key, value in change.told.items() if value is not None)
    return f"session.apply({change.do!r}{told})"
