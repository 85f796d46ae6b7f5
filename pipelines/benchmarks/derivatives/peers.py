"""Run one method of PyNumDiff, applied twice, on one record; needs numpy and pynumdiff.

Runs in an environment of its own, within a limit of CPU seconds, which the system enforces:

    python -m venv peers && peers/bin/pip install pynumdiff cvxpy

Every pass takes the settings that `optimize` finds: either with a band limit in Hz ("own": this is what a user has), or
with the true derivative of that pass ("oracle"; the best velocity is not always the best begin of an acceleration, so
that its own choice sometimes wins).
"""

from __future__ import annotations

import json
import resource
import sys
import time
import warnings

import numpy as np

METHODS = (
    "savgoldiff",
    "butterdiff",
    "splinediff",
    "polydiff",
    "spectraldiff",
    "kerneldiff",
    "rtsdiff",
    "tvrdiff",
)
# Their whole search space takes minutes; with this part of it they come back in time.
NARROWED_CHOICES = {
    "rtsdiff": {"order": 3, "forwardbackward": False, "log_qr_ratio": [1.0, 5.0, 9.0, 13.0, 17.0]},
    "tvrdiff": {"order": 3, "huberM": 6.0, "gamma": [1e-2, 1.0, 1e2]},
}


def main() -> None:
    """Read a job (file, method, seconds, band limit or null) and leave x, v, a and the CPU seconds in the file out."""
    job = json.loads(sys.argv[1])
    warnings.simplefilter("ignore")
    import pynumdiff  # noqa: PLC0415 - only where installed
    from pynumdiff.optimize import optimize  # noqa: PLC0415

    resource.setrlimit(resource.RLIMIT_CPU, (job["seconds"], job["seconds"]))
    method, record = getattr(pynumdiff, job["method"]), np.load(job["file"])
    interval = float(record["t"][1] - record["t"][0])
    start, made, settings = time.process_time(), record["y"], []
    passes, part = [], NARROWED_CHOICES.get(job["method"], {})
    for truth in ("v", "a"):
        hint = {"bandlimit": job["band"]} if job["band"] else {"dxdt_truth": record[truth]}
        chosen, _ = optimize(method, made, interval, parallel=False, search_space_updates=part, **hint)
        smooth, made = method(made, interval, **chosen)
        passes.append((smooth, made))
        settings.append({k: v if isinstance(v, str | bool) else float(v) for k, v in chosen.items()})
    seconds = time.process_time() - start
    print(json.dumps(settings))
    np.savez(job["out"], x=passes[0][0], v=passes[0][1], a=made, seconds=seconds)


if __name__ == "__main__":
    main()
