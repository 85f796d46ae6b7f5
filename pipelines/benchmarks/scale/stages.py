"""Measure the time of each stage of one study, and of reading its films alone."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from frictrack.flow import Session, open_study
from frictrack.recording import open_recording
from scale.scenes import filmed

Say = Callable[[str], None]


def measure(say: Say) -> dict[str, Any]:
    """Seconds of processor time of every stage of four films, of what follows, and of the decoder alone."""
    with tempfile.TemporaryDirectory() as name:
        path = filmed(Path(name) / "warm", 1)
        Session(open_study(path)).run()  # what is loaded or compiled once is not counted
        path = filmed(Path(name) / "study", 0)
        session = Session(open_study(path))
        frames = 0
        start = time.process_time()
        for run in session.study.runs:
            assert run.video is not None
            for _ in open_recording(Path(str(run.video)), fps=run.fps).frames():
                frames += 1
        decoder = time.process_time() - start
        spent: dict[str, float] = {}
        for stage in session.runs[0].stages:
            spent[stage] = _timed(lambda stage=stage: session.bring_up_to(stage))
        spent["fit"] = _timed(session.fit)
        spent["compare"] = _timed(session.compare)
        spent["diagnose"] = _timed(session.diagnose)
        spent["papers' route"] = _timed(session.results)
        spent["report"] = _timed(session.report)
        again = _timed(Session(open_study(path)).run)
    total = sum(spent.values())
    for stage, took in spent.items():
        say(f"{stage:14} {took:7.3f} s  {100 * took / total:5.1f} %")
    say(f"{'all':14} {total:7.3f} s; the decoder alone {decoder:.3f} s for {frames} frames; again {again:.2f} s")
    return {"frames": frames, "stages_s": spent, "decoder_s": decoder, "again_s": again}


def _timed(work: Callable[[], Any]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start
