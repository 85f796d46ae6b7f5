"""Measure how long a command needs before it does anything."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from speed.child import frictrack, median_of, python
from speed.studies import study_of_tables

REPEATS = 5
IMPORTS = "import numpy, scipy.optimize, scipy.signal, scipy.stats, cv2, pandas, h5py, matplotlib.figure"


def measure(say: Callable[[str], None]) -> dict[str, float]:
    """CPU seconds of light commands, and of importing the libraries that frictrack is built on."""
    with tempfile.TemporaryDirectory() as name:
        study = study_of_tables(Path(name))
        frictrack("fit", str(study))
        faulty = study.with_name("faulty.toml")
        faulty.write_text(study.read_text().replace("mass =", "mess ="))
        commands: dict[str, list[Any]] = {
            "--help": ["--help"],
            "history": ["history", study],
            "effects": ["effects"],
            "verify": ["verify", study],
            "faulty study": ["fit", faulty],
        }
        calls = {key: [sys.executable, "-m", "frictrack", *map(str, words)] for key, words in commands.items()}
        out = {key: median_of(REPEATS, call).cpu_s for key, call in calls.items()}
    python(IMPORTS)
    out["importing the libraries"] = median_of(REPEATS, [sys.executable, "-c", IMPORTS]).cpu_s
    for key, seconds in out.items():
        say(f"{key:24s} {seconds:6.2f} s")
    return out
