"""Measure verdict, complete diagnosis, and the loop of adding an effect and taking it back."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import frictrack as ft
from frictrack.flow import Session, open_study
from frictrack.validation.blind.truth import Truth
from speed.plain_search import plain_search
from speed.studies import draw_study, effects_to_hide, foreign_causes, recorded_runs, study_of_tables

Say = Callable[[str], None]


def measure(say: Say, chosen: Sequence[str] = ()) -> dict[str, Any]:
    """CPU seconds of every study, and their median and worst; with `chosen` only some hidden effects."""
    studies = [("none", 0)]
    studies += [("one", i) for i, name in enumerate(effects_to_hide()) if not chosen or name in chosen]
    studies += [("foreign", i) for i in range(len(foreign_causes())) if not chosen]
    rows = []
    ft.diagnose(ft.fit(["coulomb"], recorded_runs(draw_study("none", 1))[:2]))  # everything is imported now
    for kind, turn in studies:
        rows.append(_measure_study(kind, draw_study(kind, turn)))
        say(_line(rows[-1]))
    summary = {key: {"median": statistics.median(v), "worst": max(v)} for key, v in _columns(rows).items()}
    for key, figures in summary.items():
        say(f"{key:20s} median {figures['median']:6.2f}  worst {figures['worst']:6.2f}")
    return {"rows": rows, "summary": summary}


def _measure_study(kind: str, truth: Truth) -> dict[str, Any]:
    """Time fit, verdict, complete diagnosis and the plain search of one study."""
    runs = recorded_runs(truth)
    verdict_at: list[float] = []
    start = time.process_time()
    fit = ft.fit(list(truth.model), runs)
    found = ft.diagnose(fit, on_verdict=lambda _: verdict_at.append(time.process_time()))
    end = time.process_time()
    plain_search(truth.model, runs)
    plain = time.process_time() - end
    verdict = (verdict_at[0] if verdict_at else end) - start
    return {
        "kind": kind,
        "hidden": list(truth.hidden),
        "verdict": found.verdict,
        "named": list(found.missing),
        "frames": sum(len(run.displacement.t) for run in runs),
        "verdict_s": verdict,
        "complete_s": end - start,
        "plain_s": plain,
        "verdict_over_plain": verdict / plain,
    }


def _line(row: dict[str, Any]) -> str:
    named = ", ".join(row["named"]) or row["verdict"]
    hidden = ", ".join(row["hidden"]) or "nothing"
    return (
        f"{hidden:20s} {named:34s} verdict {row['verdict_s']:5.2f} s, complete {row['complete_s']:5.2f} s, "
        f"plain search {row['plain_s']:5.2f} s, verdict over it {row['verdict_over_plain']:4.1f}"
    )


def _columns(rows: list[dict[str, Any]]) -> dict[str, list[float]]:
    keys = ("verdict_s", "complete_s", "plain_s", "verdict_over_plain")
    return {key: [row[key] for row in rows] for key in keys}


def measure_loop(say: Say) -> dict[str, float]:
    """CPU seconds of adding a candidate and taking it back, in one session."""
    with tempfile.TemporaryDirectory() as name:
        session = Session(open_study(study_of_tables(Path(name))))
        session.fit()
        out = {}
        for key, step in (
            ("add", lambda: session.add("drag")),
            ("undo", lambda: session.apply("undo")),
            ("add again", lambda: session.add("texture")),
        ):
            start = time.process_time()
            step()
            out[key] = time.process_time() - start
            say(f"{key:12s} {out[key]:6.3f} s")
    return out
