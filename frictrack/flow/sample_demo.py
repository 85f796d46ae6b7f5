"""Run the demonstration on the sample study: fit, diagnose, add the missing effects, report."""

from __future__ import annotations

from pathlib import Path

from frictrack import samples
from frictrack.flow.opening import open_study
from frictrack.flow.pipeline import Progress, no_progress
from frictrack.flow.session import Session
from frictrack.flow.summaries import DemoSummary, ModelChange

MAX_EFFECTS_ADDED = 4  # effects that may be added before the demo gives up


def demo(folder: Path, seed: int = 0, progress: Progress = no_progress) -> DemoSummary:
    """Run the sample study in a folder; the films are copied there if it has no study.

    The best candidate is added until the diagnosis finds nothing more.

    Parameters
    ----------
    folder
        Folder of the study.
    seed
        Seed of the diagnoses.
    progress
        Called as ``progress(done, total, what)``.

    Returns
    -------
    dict
        JSON of `frictrack demo`.

    """
    path = folder / "study.toml"
    if not path.exists():
        samples.copy_films(folder)
    session = Session(open_study(path), progress)
    session.restart()
    first = found = session.diagnose(seed)
    added: list[ModelChange] = []
    while found["missing"] and len(added) < MAX_EFFECTS_ADDED:
        added.append(session.add(found["missing"][0], seed))
        found = session.diagnose(seed)
    history = session.history()
    report = session.report(seed)
    return {"diagnose": first, "add": added[0] if added else None, "history": history, "report": str(report)}
