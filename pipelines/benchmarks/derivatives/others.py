"""Run peer methods in another Python: one process per method and record."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from .estimate import Array, Estimate
from .peers import METHODS
from .plan import Plan
from .signals import Signal

__all__ = ["CHOICES", "METHODS", "missing", "peer", "version"]

CHOICES = "own", "oracle"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
# Hz, the band limit that PyNumDiff asks its user for: above the highest line, and as high as a collision or jump needs.
BANDS = {"vib": 100.0, "plain": 20.0, "two": 200.0, "high": 400.0, "decay": 150.0, "push": 100.0, "incline": 50.0}
MAX_BAND_HZ = 400.0


def peer(plan: Plan, truth: Signal, y: Array, method: str, choice: str) -> tuple[Estimate, float] | str:
    """Estimate and CPU seconds of one peer, or why there is none."""
    assert plan.python is not None
    with tempfile.TemporaryDirectory() as folder:
        record, out = Path(folder) / "record.npz", Path(folder) / "found.npz"
        np.savez(record, t=truth.t, y=y, v=truth.v, a=truth.a)
        job = {"file": str(record), "out": str(out), "method": method, "seconds": plan.peer_seconds}
        job["band"] = BANDS.get(truth.name, MAX_BAND_HZ) if choice == "own" else None
        command = [plan.python, str(Path(__file__).with_name("peers.py")), json.dumps(job)]
        done = subprocess.run(command, env=os.environ | ONE_THREAD, capture_output=True, text=True, check=False)
        if not out.exists():
            # Negative: ended by the system at its limit of CPU time.
            last = (done.stderr.strip() or "ended without a word").splitlines()[-1]
            return f"more than {plan.peer_seconds} s" if done.returncode < 0 else last
        found = dict(np.load(out))
    return Estimate(found["x"], found["v"], found["a"]), float(found["seconds"])


def missing(python: str) -> list[str]:
    """Libraries of peers that the other Python does not have."""
    code = "import importlib.util as u; print(*[m for m in ('pynumdiff', 'cvxpy') if not u.find_spec(m)])"
    return subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def version(python: str) -> str:
    """Version of PyNumDiff in the other Python."""
    code = "import importlib.metadata as m; print(m.version('pynumdiff'))"
    return subprocess.run([python, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
