"""Count the outcomes of many studies: confidently wrong, fault named, processor time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from frictrack.validation.blind.outcome import count_with_interval
from reality.faults import KINDS, NONE
from reality.judge import BROKEN, CPU_LIMIT_S, MAX_DEVIATION_SIGMAS, OUT_OF_TIME, Outcome


def tally(rows: Sequence[Outcome]) -> dict[str, Any]:
    """All figures as JSON; shares with their intervals (Wilson 1927)."""
    faulty = [r for r in rows if r.fault.shows]
    clean = [r for r in rows if r.fault.kind == NONE]
    known = [r for r in rows if r.z]
    return {
        "studies": len(rows),
        "confidently_wrong": _share(rows, lambda r: bool(r.wrong)),
        "fault_named": _share(faulty, lambda r: r.named),
        "named_by_nothing_but_chance": _share(clean, lambda r: bool(r.noted)),
        "within_five_deviations": _share(known, lambda r: abs(r.worst[1]) <= MAX_DEVIATION_SIGMAS),
        "within_120_s": _share(rows, lambda r: r.seconds <= CPU_LIMIT_S and r.verdict != OUT_OF_TIME),
        "broken": [{"study": r.name, "fault": r.fault.kind, "error": r.error} for r in rows if r.verdict == BROKEN],
        "seconds": _seconds(rows),
        "by_fault": {kind: _of_kind([r for r in rows if r.fault.kind == kind]) for kind in KINDS},
        "wrong": [_line(r) | {"reason": r.wrong} for r in rows if r.wrong],
        "not_named": [_line(r) | {"noted": list(r.noted)} for r in faulty if not r.named],
    }


def _share(rows: Sequence[Outcome], right: Callable[[Outcome], bool]) -> dict[str, Any]:
    return count_with_interval(sum(map(right, rows)), len(rows))


def _seconds(rows: Sequence[Outcome]) -> dict[str, float | None]:
    times = [r.seconds for r in rows]
    return {"median": float(np.median(times)) if times else None, "largest": max(times, default=None)}


def _of_kind(rows: Sequence[Outcome]) -> dict[str, Any]:
    """Figures of the studies with one kind of fault."""
    return {
        "studies": len(rows),
        "wrong": sum(bool(r.wrong) for r in rows),
        "named": sum(r.named for r in rows if r.fault.shows),
        "shows": sum(r.fault.shows for r in rows),
        "verdicts": dict(Counter(r.verdict for r in rows)),
        "seconds": _seconds(rows),
    }


def _line(row: Outcome) -> dict[str, Any]:
    """A study in short."""
    address, z = row.worst
    return {
        "study": row.name,
        "fault": row.fault.kind,
        "variant": row.fault.variant,
        "size": row.fault.size,
        "runs": "all" if row.fault.in_all else list(row.fault.runs),
        "hidden": list(row.hidden),
        "limits": list(row.size),
        "verdict": row.verdict,
        "missing": [list(group) for group in row.groups],
        "worst": {address: z} if address else {},
        "error": row.error,
    }


def table(counts: dict[str, Any]) -> Iterator[str]:
    """The figures as lines of text."""
    yield f"{'fault':12} {'studies':>7} {'wrong':>6} {'named':>8} {'median s':>9} {'largest s':>10}  verdicts"
    for kind, row in counts["by_fault"].items():
        if not row["studies"]:
            continue
        named = f"{row['named']}/{row['shows']}" if row["shows"] else "-"
        times, said = row["seconds"], ", ".join(f"{n} {verdict}" for verdict, n in row["verdicts"].items())
        head = f"{kind:12} {row['studies']:7d} {row['wrong']:6d} {named:>8}"
        yield f"{head} {times['median']:9.1f} {times['largest']:10.1f}  {said}"
    for name in ("confidently_wrong", "fault_named", "named_by_nothing_but_chance", "within_five_deviations"):
        yield _sentence(name, counts[name])
    yield _sentence("within_120_s", counts["within_120_s"])


def _sentence(name: str, share: dict[str, Any]) -> str:
    low, high = share["interval"]
    return f"{name.replace('_', ' ')}: {share['hits']} of {share['of']} (95 %: {100 * low:.0f} to {100 * high:.0f} %)"
