"""One blind study through the whole loop, and how it went."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.blind.detection_limits import limits_over_ideal
from frictrack.blind.equivalents import equivalent_effects
from frictrack.blind.failure_overlap import overlap
from frictrack.blind.truth import Truth, effect_named
from frictrack.errors import FrictrackError
from frictrack.fit import Fit
from frictrack.flow import Session, open_study


@dataclass(frozen=True)
class Outcome:
    """What was said of one study, beside the truth."""

    name: str
    kind: str
    hidden: tuple[str, ...]
    size: tuple[float, ...]
    film: bool = False
    verdict: str = ""
    named: tuple[str, ...] = ()  # effects found, in order
    group: tuple[str, ...] = ()  # the first one and what the diagnosis cannot tell from it
    equivalents: dict[str, tuple[str, ...]] = field(default_factory=dict)  # per hidden effect: those that fit as well
    noted: tuple[str, ...] = ()  # faults that the measuring chain told and took away by itself
    reduced_chi2: float | None = None  # after adding what was named
    heldout: float | None = None  # held-out error over the true noise, after adding
    z: dict[str, float] = field(default_factory=dict)  # (found - true)/stated deviation of the law that was named
    overlap: float | None = None  # F1 of the frames where it fails
    limits: dict[str, float] = field(default_factory=dict)  # detection limits over the ideal detector's, nothing hidden
    seconds: float = 0.0  # of the diagnosis, CPU
    fault: str = ""  # what went wrong, where nothing could be judged


def read_outcome(raw: dict[str, Any]) -> Outcome:
    """An outcome from its JSON."""
    lists = {name: tuple(raw[name]) for name in ("hidden", "size", "named", "group", "noted")}
    equivalents = {name: tuple(others) for name, others in raw["alike"].items()}
    known = {key: value for key, value in raw.items() if key != "alike"}
    return Outcome(**known | lists, equivalents=equivalents)


def judge_study(name: str, truth: Truth, folder: Path, seed: int = 0) -> Outcome:
    """Diagnose a study, add what it names, and compare with the truth; work that fails is an outcome too."""
    blank = Outcome(name, truth.kind, truth.hidden, truth.size, truth.film)
    try:
        return _diagnose(truth, folder, seed, blank)
    except FrictrackError as e:
        return replace(blank, verdict="failed", fault=str(e))
    except Exception as e:  # noqa: BLE001 - a fault of ours is a failure of this study, and no end of the others
        return replace(blank, verdict="failed", fault=f"{type(e).__name__}: {e}")


def _diagnose(truth: Truth, folder: Path, seed: int, blank: Outcome) -> Outcome:
    session = Session(open_study(folder / "study.toml"))
    session.fit()
    begin = time.process_time()
    diagnosis = session.diagnose(seed)
    seconds = time.process_time() - begin
    named = tuple(diagnosis["missing"])
    fit: Fit = session.models.fit(session.models.current()[0])
    low_pass_half_width = {run.name: 0.5 / run.motion.cutoff for run in fit.runs if np.isfinite(run.motion.cutoff)}
    out = replace(
        blank,
        verdict=diagnosis["verdict"],
        named=named,
        group=_first_group(diagnosis),
        equivalents=equivalent_effects(truth, fit.solution) if _has_equivalents(truth) else {},
        noted=_faults_in_notes(session),
        overlap=overlap(truth, diagnosis["fails_at"], low_pass_half_width),
        limits=limits_over_ideal(truth, diagnosis["detection_limits"]) if truth.kind == "none" and not named else {},
        seconds=seconds,
    )
    noise = (_tracking_error(session, truth) or diagnosis["noise_um"]) if truth.film else 1e6 * truth.noise
    return _with_additions(session, truth, noise, out) if named else _without_additions(session, noise, out)


def _tracking_error(session: Session, truth: Truth) -> float | None:
    """What the tracker was truly off by in the fitted frames, rms in um, beside each film's own start and speed.

    A shake of the camera is taken away by the fixed reference. None where frames are lost: they are no longer those
    that were drawn.
    """
    squares = []
    for run, work in zip(truth.runs, session.runs, strict=True):
        slide, displacement = truth.slide(run), work.get("displacement")
        if len(displacement.x) != len(slide.x):
            return None
        drawn = slide.x if "camera_shake" in run.values else slide.x + slide.shift
        kept = displacement.valid & work.get("friction").free
        off, t = (displacement.x - drawn)[kept], slide.t[kept] - slide.t[kept].mean()
        off = off - off.mean()
        squares.append((off - t * (t @ off) / (t @ t)) ** 2)
    return 1e6 * float(np.sqrt(np.mean(np.concatenate(squares))))


def _first_group(diagnosis: dict[str, Any]) -> tuple[str, ...]:
    """What is named first, and what the diagnosis cannot tell from it."""
    if not diagnosis["missing"]:
        return ()
    first = diagnosis["missing"][0]
    rivals = [c["indistinguishable_from"] for c in diagnosis["candidates"] if c["effect"] == first]
    return (first, *(rivals[0] if rivals else ()))


def _has_equivalents(truth: Truth) -> bool:
    """Whether what nobody can tell from the truth is known: of films whose frames are the drawn ones, too."""
    retimed = truth.film and "dropped_frame" in truth.hidden
    return bool(truth.hidden) and truth.kind != "foreign" and not retimed


def _without_additions(session: Session, noise: float, out: Outcome) -> Outcome:
    """Nothing to add: the errors of the law as it stands."""
    errors = session.fit()["errors"]
    return replace(out, reduced_chi2=errors["reduced_chi2"], heldout=errors["heldout_rms_um"] / noise)


def _with_additions(session: Session, truth: Truth, noise: float, out: Outcome) -> Outcome:
    """What was named is added, one after the other."""
    for name in out.named:
        after = session.add(name)
    errors = after["error_after"]
    return replace(
        out,
        reduced_chi2=errors["reduced_chi2"],
        heldout=errors["heldout_rms_um"] / noise,
        z=parameter_deviations(truth, out.named, after["parameters"]),
    )


def _faults_in_notes(session: Session) -> tuple[str, ...]:
    """Faults that are in the notes of the records."""
    stages = [(work, name) for work in session.runs for name in ("track", "displacement") if name in work.stages]
    words = " ".join(note for work, name in stages for note in work.get(name).notes)
    return tuple(name for name, e in effects.LIBRARY.items() if any(phrase in words for phrase in e.noted_as))


def parameter_deviations(truth: Truth, named: tuple[str, ...], parameters: dict[str, Any]) -> dict[str, float]:
    """(Found - true)/stated deviation of all shared numbers, where exactly what was hidden was named."""
    if set(named) != set(truth.hidden):
        return {}
    own = {name: next(r.values[name] for r in truth.runs if name in r.values) for name in truth.hidden}
    law = truth.law | own
    quoted = {f"{name}.{key}": value for name, values in law.items() for key, value in values.items()}
    out = {}
    for name, values in law.items():
        effect = effect_named(name)
        true = values | (effect.quote(values, quoted) if effect.quote else {})
        for p in effect.parameters:
            estimate = parameters.get(f"{name}.{p.name}")
            if estimate is None or p.per_run or not estimate["std"] or estimate["value"] is None:
                continue
            error = estimate["value"] - true[p.name]
            if p.role == "phase":
                error = float(np.angle(np.exp(1j * error)))
            out[f"{name}.{p.name}"] = error / estimate["std"]
    return out
