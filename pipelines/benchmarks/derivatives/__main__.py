"""Compare frictrack and other methods that differentiate displacement twice, on signals of known truth.

    python pipelines/benchmarks/derivatives [--signals vib,coll] [--noises 2,10,50] [--seeds 8] [--methods WORD,WORD]
                                            [--json FILE] [--peers-python PATH | --no-peers] [--calibration]

Peers live in an environment of their own; what is not installed is left out. Most take long and run on one record of
each kind; `own`: settings by PyNumDiff's `optimize` with a band limit fed by hand, `oracle`: with the true derivative.

    python -m venv peers && peers/bin/pip install pynumdiff cvxpy
    python pipelines/benchmarks/derivatives --peers-python peers/bin/python

Columns: RMS error of the acceleration (m/s^2) over the whole record, ends included; the same over that of the Wiener
filter that knows the true spectrum (of all seeds, though peers ran on the first alone); of the worst seed; in
mid-course, in the first and the last 5 % of the record; within 2 ms of a jump or a collision and away from these; RMS
error of velocity and position; rms of error over stated standard deviation; CPU milliseconds of one record on one
thread. What is called oracle knows the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from derivatives import SIGNALS, calibration, others, run  # noqa: E402 - found only now
from derivatives.plan import Plan  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", default=",".join(SIGNALS))
    parser.add_argument("--noises", default="2,10,50", help="standard deviations of white noise in um")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--methods", default="", help="only those whose name contains one of these words")
    parser.add_argument("--peers-python", default=sys.executable, help="python of the environment with the peers")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--peer-seeds", type=int, default=1)
    parser.add_argument("--peer-seconds", type=int, default=45, help="CPU seconds of one peer on one record")
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("--calibration", action="store_true", help="only errors over stated deviations, of all filters")
    args = parser.parse_args()
    if args.calibration:
        return calibration.table(args.seeds, lambda text: print(text, flush=True))
    names = args.signals.split(",")
    if unknown := sorted(set(names) - set(SIGNALS)):
        parser.error(f"expected signals out of {', '.join(SIGNALS)} but got {', '.join(unknown)}")
    noises = [1e-6 * float(noise) for noise in args.noises.split(",")]
    words = [word for word in args.methods.split(",") if word]
    python = None if args.no_peers else args.peers_python
    if python and (absent := others.missing(python)):
        print(f"not installed and left out: {', '.join(absent)}; see --peers-python")
        python = None if "pynumdiff" in absent else python
    plan = Plan(names, noises, args.seeds, words, python, args.peer_seeds, args.peer_seconds)
    machine = run.machine(python)
    print(*(f"{name} {version}" for name, version in machine.items()), sep=", ")
    results = run.compare(plan, lambda text: print(text, flush=True))
    print(run.overview(results))
    if args.json:
        args.json.write_text(json.dumps({"machine": machine, "accuracy": results}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
