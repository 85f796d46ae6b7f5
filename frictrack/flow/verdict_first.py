"""Work in the order in which a person waits for it: the verdict first, then what is shown next, then the report.

Everything is stored as soon as it is known, so that the process may be ended at any moment after the verdict.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from frictrack.candidates import candidate_rows
from frictrack.errors import FrictrackError
from frictrack.flow.session import Session

OnVerdict = Callable[[dict[str, Any]], None]
MAX_CANDIDATES_FITTED = 6


def run_study(session: Session, on_verdict: OnVerdict, *, seed: int = 0) -> dict[str, Any]:
    """Measure, fit and diagnose; then `conclude`.

    Parameters
    ----------
    session
        The study.
    on_verdict
        Called once with "fit" and "diagnose" when fit and verdict are stored.
    seed
        Seed of the diagnosis.

    Returns
    -------
    dict
        "fit" and "diagnose", the JSON of those commands, and "warnings".

    """
    fit = session.fit()
    diagnosis = conclude(session, lambda found: on_verdict({"fit": fit, "diagnose": found}), seed=seed)
    return {"fit": fit, "diagnose": diagnosis, "warnings": session.findings.summary}


def change_and_diagnose(
    session: Session, command: str, on_verdict: OnVerdict, *, effect: str, seed: int | None = None
) -> dict[str, Any]:
    """Add or remove an effect, fit and diagnose the new model; then `conclude`.

    Parameters
    ----------
    session
        The study.
    command
        "add" or "remove".
    on_verdict
        Called once with the incomplete diagnosis when fit and verdict are stored.
    effect
        Name of the effect.
    seed
        Seed of the random numbers; None for that of the current model.

    Returns
    -------
    dict
        The change of the model, as `Session.add` returns it, with "diagnose".

    """
    change = session.apply(command, effect=effect, seed=seed)
    return {**change, "diagnose": conclude(session, on_verdict, seed=seed or 0)}


def conclude(session: Session, on_verdict: OnVerdict, *, seed: int = 0) -> dict[str, Any]:
    """Diagnose the current model; once the verdict is stored, fit its candidates and write the report.

    Parameters
    ----------
    session
        The study.
    on_verdict
        Called once with the diagnosis when the verdict is stored; what follows runs in the background.
    seed
        Seed of the diagnosis.

    Returns
    -------
    dict
        JSON of `frictrack diagnose`.

    """
    announced = False

    def announce(found: dict[str, Any]) -> None:
        nonlocal announced
        if not announced:
            announced = True
            on_verdict(found)
            fit_candidates(session, found, most=1)  # the one that is most likely to be added next

    diagnosis = session.diagnose(seed, on_verdict=announce)
    announce(diagnosis)
    fit_candidates(session, diagnosis)
    session.report(seed, anew=False)
    return diagnosis


def fit_candidates(session: Session, diagnosis: Mapping[str, Any], most: int = MAX_CANDIDATES_FITTED) -> list[str]:
    """Fit the current model with each of the best candidates, and store the fits.

    Parameters
    ----------
    session
        The study.
    diagnosis
        The JSON of the diagnosis of its current model.
    most
        Largest number of candidates.

    Returns
    -------
    list of str
        Names of the candidates that were fitted, now or before; those that cannot be fitted are left out.

    """
    fitted = []
    rows = candidate_rows(diagnosis)
    for effect in [row.effect for row in rows if row.kind != "implausible"][:most]:
        try:
            session.attempt(effect)
        except FrictrackError:
            continue  # it is said when the user tries that effect
        fitted.append(effect)
    return fitted
