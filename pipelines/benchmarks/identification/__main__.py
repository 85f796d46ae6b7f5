"""Compare frictrack and other methods that identify a friction law.

    python pipelines/benchmarks/identification [--only accuracy,emps,optima] [--emps FOLDER] [--json FILE]
        [--scenes tustin,five] [--noises 2,10,50] [--seeds 1000] [--beside 100] [--workers 2]

accuracy: RMS error and bias of every parameter over the Cramer-Rao bound of the displacements (starts free, scatter
known), and the share of truths within 1.96 of the deviations stated; CPU milliseconds of one fit. Scenes: one Tustin
slide (671 frames, 5.6 to 0.06 m/s), five of them with 3 % scatter of the dry friction, and one with one or two lines
(60 Hz, 134 Hz). Other ways are started at the truth and run on fewer draws. How much a fit changes that starts from
the quick smoother is told: at 50 um it may leave out slow frames at the end.

emps: the Electro-Mechanical Positioning System (DATA_EMPS.mat and DATA_EMPS_PULSES.mat in FOLDER): the published fits
reproduced, then frictrack's with the mass found; further effects are chosen on blocks held out of the first record.

optima: how surely and how fast the global optimum is found, frictrack and other optimisers, in an environment
of their own or left out (--peers-python PATH | --no-peers; more in the folder of that name).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from machine import described  # noqa: E402

from identification import SCENES, Plan, accuracy, laws, optima  # noqa: E402 - found only now

PARTS = ("accuracy", "emps", "optima")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas")
    parser.add_argument("--emps", type=Path, help="folder with the two records of the machine")
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--noises", default="2,10,50", help="standard deviations of white noise in um")
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--beside", type=int, default=100, help="draws of the other ways")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--peers-python", default=sys.executable, help="python of the environment with the peers")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--json", type=Path, help="file for all figures")
    args = parser.parse_args()
    wanted, scenes = args.only.split(","), args.scenes.split(",")
    if unknown := sorted({*wanted, *scenes} - {*PARTS, *SCENES}):
        parser.error(f"expected parts out of {', '.join(PARTS)}, scenes out of {', '.join(SCENES)} but got {unknown}")
    if "emps" in wanted and args.emps is None:
        print("emps is left out: give its folder with --emps")
        wanted.remove("emps")
    noises = [1e-6 * float(noise) for noise in args.noises.split(",")]
    python = None if args.no_peers else args.peers_python
    peers = optima.run.Plan(list(optima.PROBLEMS), args.seeds, min(args.beside, 30), python)
    plan = Plan(scenes, noises, args.seeds, args.beside, args.workers)
    machine = described("numpy", "scipy")
    say: Callable[[str], None] = lambda text: print(text, flush=True)  # noqa: E731
    say(", ".join(f"{name} {version}" for name, version in machine.items()))
    parts: dict[str, Callable[[], Any]] = {
        "accuracy": lambda: accuracy.compare(plan, say),
        "emps": lambda: laws.compare(args.emps, say),
        "optima": lambda: optima.compare(peers, say),
    }
    figures = {"machine": machine} | {name: part() for name, part in parts.items() if name in wanted}
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
