"""Diagnose one study with a fault, collect the findings, and judge whether the verdict is confidently wrong."""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any

from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study
from frictrack.flow.pipeline import RunPipeline
from frictrack.validation.blind import write_study
from frictrack.validation.blind.outcome import equivalent_effects, parameter_deviations
from frictrack.validation.blind.truth import effect_named
from reality.faults import Fault, noted, read_fault
from reality.studies import Case, write_case

MIN_VISIBLE_SIZE = 2.0  # times the detection limit: a hidden effect of that size has to be seen
MAX_DEVIATION_SIGMAS = 5.0  # quoted deviations
CPU_LIMIT_S = 120.0  # s
N_STACK_FUNCTIONS = 12  # functions that say where a study ran out of time
HARMLESS_REMARKS = (  # parts of remarks that speak of no fault: on any study, or on how parameters are correlated
    *("is absorbed exactly", "single run:", "on an incline, Coulomb", "not tried:", "long record:", "no camera shake:"),
    *("are hard to distinguish", "are correlated", "all runs move one way"),
)
STOPPED, OUT_OF_TIME, BROKEN = "stopped", "out of time", "broken"


class OutOfTime(BaseException):
    """A study has used up its processor time; no handler of ordinary errors may catch it."""


@dataclass(frozen=True)
class Outcome:
    """What was said of one study, and what is true.

    `groups` holds every effect named as missing with what the diagnosis cannot distinguish from it. `z` are the law's
    parameters off the truth in quoted deviations, where the law that is left is the true one. `wrong` says why the
    verdict is confidently wrong; empty where it is not.
    """

    name: str
    fault: Fault
    hidden: tuple[str, ...] = ()
    size: tuple[float, ...] = ()
    film: bool = False
    verdict: str = ""
    groups: tuple[tuple[str, ...], ...] = ()
    allowed: tuple[str, ...] = ()  # effects that may be named
    findings: tuple[str, ...] = ()
    z: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0  # CPU, from opening the study to the law with what was named
    error: str = ""
    named: bool = False  # the fault, by a finding
    noted: tuple[str, ...] = ()  # kinds of fault that findings speak of
    wrong: str = ""

    @property
    def missing(self) -> tuple[str, ...]:
        """Effects named as missing."""
        return tuple(group[0] for group in self.groups)

    @property
    def worst(self) -> tuple[str, float]:
        """The parameter that is furthest off, and by how many deviations; no name where none is known."""
        return max(self.z.items(), key=lambda item: abs(item[1]), default=("", 0.0))

    def to_dict(self) -> dict[str, Any]:
        """JSON."""
        return asdict(self) | {"fault": self.fault.to_dict()}


def read_outcome(raw: dict[str, Any]) -> Outcome:
    """An outcome from its JSON."""
    lists = {key: tuple(raw[key]) for key in ("hidden", "size", "allowed", "findings", "noted")}
    groups = tuple(tuple(group) for group in raw["groups"])
    return Outcome(**raw | lists | {"groups": groups, "fault": read_fault(raw["fault"])})


def judge(case: Case, folder: Path, limit: float = CPU_LIMIT_S, seed: int = 0) -> Outcome:
    """Write a study, diagnose it within so much processor time (s), and judge what was said."""
    case = write_case(case, folder)
    truth = case.truth
    said = diagnosed(case, folder / "study.toml", limit, seed)
    said = replace(said, allowed=_allowed(case, said), hidden=truth.hidden, size=truth.size, film=truth.film)
    return judged(said)


def judged(said: Outcome) -> Outcome:
    """The outcome with what follows from what was said: whether the fault is named, and whether it is wrong."""
    findings = tuple(line for line in said.findings if not any(part in line for part in HARMLESS_REMARKS))
    named = said.fault.is_named(findings, said.missing)
    said = replace(said, findings=findings, named=named, noted=tuple(noted(findings)))
    return replace(said, wrong=wrong(said))


def wrong(said: Outcome) -> str:
    """Why a verdict is confidently wrong; empty where it is not."""
    if said.verdict in ("missing", "ambiguous"):
        for group in said.groups:
            if not set(group) & set(said.allowed):
                return f"names {' / '.join(group)}"
    seen = [h for h in said.hidden if any(phrase in " ".join(said.findings) for phrase in effect_named(h).noted_as)]
    size = max(said.size, default=0.0) / said.fault.louder
    if said.verdict == "complete" and not said.named and not seen and size >= MIN_VISIBLE_SIZE:
        return f"complete, while {said.hidden[0]} of {size:.1f} limits is hidden"
    address, z = said.worst
    if said.verdict in ("complete", "missing") and abs(z) > MAX_DEVIATION_SIGMAS and not _warned(said):
        return f"{address} {z:+.1f} deviations off, without a finding"
    return ""


def _warned(said: Outcome) -> bool:
    return said.named or bool(said.findings)


def diagnosed(case: Case, path: Path, limit: float, seed: int) -> Outcome:
    """What frictrack says of a study, errors that stop it included."""
    begin, session = time.process_time(), None
    out = Outcome(case.name, case.fault)
    try:
        with cpu_limit(limit):
            session = Session(open_study(path))
            out = _said(session, case, seed, out)
    except OutOfTime as e:
        out = replace(out, verdict=OUT_OF_TIME, error=str(e))
    except FrictrackError as e:
        out = replace(out, verdict=STOPPED, error=str(e), findings=(str(e),))
    except Exception as e:  # noqa: BLE001 - a fault of ours is an outcome of this study, and no end of the others
        out = replace(out, verdict=BROKEN, error=f"{type(e).__name__}: {e}")
    seconds = time.process_time() - begin
    return replace(out, seconds=seconds, findings=tuple(dict.fromkeys([*out.findings, *notes(session)])))


def _said(session: Session, case: Case, seed: int, out: Outcome) -> Outcome:
    """Fit, diagnose, add what is named where it is what was hidden, and compare the law with the truth."""
    fit = session.fit()
    said = session.diagnose(seed)
    remarks = [*fit["remarks"], *said["remarks"]]
    missing = tuple(said["missing"])
    groups = tuple((name, *_rivals(said, name)) for name in missing)
    out = replace(out, verdict=said["verdict"], groups=groups, findings=tuple(remarks))
    return replace(out, z=_deviations(session, case, missing, fit["parameters"]))


def _rivals(said: dict[str, Any], name: str) -> list[str]:
    """What the diagnosis cannot distinguish from an effect that it names."""
    return next((c["indistinguishable_from"] for c in said["candidates"] if c["effect"] == name), [])


def _deviations(session: Session, case: Case, missing: tuple[str, ...], parameters: dict[str, Any]) -> dict[str, float]:
    """Parameters of the law off the truth, in quoted deviations, where the law that is left is the true one.

    None are known where the fault leaves no trace: then the law is off by it, and nobody could tell.
    """
    truth = case.truth
    if set(missing) != set(truth.hidden) and missing:
        return {}
    if not case.fault.visible:
        return {}
    for name in missing:
        parameters = session.add(name)["parameters"]
    known = truth if missing else replace(truth, hidden=())
    quoted = {k: p | {"std": p.get("std_misfit", p["std"])} for k, p in parameters.items()}
    return parameter_deviations(known, missing, quoted)


def notes(session: Session | None) -> list[str]:
    """All that the measuring chain says of the runs: warnings on what was typed, notes of stages that are done."""
    if session is None:
        return []
    found = list(session.findings.messages)
    for work in session.runs:
        found += [f'run "{work.run.name}": {note}' for note in _of_run(work)]
    return found


def _of_run(work: RunPipeline) -> list[str]:
    """Notes of the recording, the track and the displacement of a run."""
    out: list[str] = []
    for stage in ("recording", "track", "displacement"):
        if stage in work.stages:
            with suppress(FrictrackError):
                part = work.get(stage)
                out += [*getattr(part, "notes", ()), *getattr(getattr(part, "timebase", None), "notes", ())]
    return out


def _allowed(case: Case, said: Outcome) -> tuple[str, ...]:
    """Effects that are hidden, the fault itself, or what nobody can distinguish from what is hidden.

    That is looked for only where something else is named, in the study without its fault.
    """
    allowed = {*case.truth.hidden, *case.fault.allowed}
    if case.truth.hidden and any(not set(group) & allowed for group in said.groups):
        with suppress(FrictrackError):
            allowed |= {name for names in indistinguishable(case).values() for name in names}
    return tuple(sorted(allowed))


def indistinguishable(case: Case) -> dict[str, tuple[str, ...]]:
    """Per hidden effect what nobody can distinguish from it, by tables of the study without the fault."""
    truth = replace(case.truth, film=False)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "clean"
        write_study(truth, folder)
        session = Session(open_study(folder / "study.toml"))
        session.fit()
        return equivalent_effects(truth, session.models.fit(session.models.current()[0]).solution)


@contextmanager
def cpu_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` when this process has worked for so many seconds; where there is no such timer, never."""
    if not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGPROF, _expired)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _expired(signum: int, frame: FrameType | None) -> None:
    """Say where the work was, from the innermost function of frictrack outward."""
    places: list[str] = []
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if "frictrack" in path.parts:
            places.append(f"{path.parent.name}/{path.name}: {frame.f_code.co_name}")
        frame = frame.f_back
    raise OutOfTime(", ".join(places[:N_STACK_FUNCTIONS]))
