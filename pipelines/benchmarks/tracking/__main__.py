"""Compare accuracy and speed of frictrack and other trackers on rendered films.

    python pipelines/benchmarks/tracking [--seeds 5] [--frames 600] [--conditions nominal,hard] [--json FILE]
                                         [--peers-python PATH | --no-peers] [--speed | --no-speed] [--nuisances]
    python pipelines/benchmarks/tracking --automatic 200

Peers beside OpenCV live in an environment of their own (pyidi brings another OpenCV); what is not installed is
left out:

    python -m venv peers && peers/bin/pip install opencv-contrib-python scikit-image trackpy pyidi
    python pipelines/benchmarks/tracking --peers-python peers/bin/python

Columns: RMS of the error in x, constant removed, over the frames not lost; the same over the Cramer-Rao bound of
the known template; amplitude tied to the sub-pixel position (two harmonics, mean square above what noise gives;
noise of one film beside it); largest error of any frame not given up; frames more than 1 px off or given up; of
these the ones not given up; acceleration error behind a Savitzky-Golay smoother (15 ms, order 4) over that of
white noise at the bound; rms of error over stated standard deviation; frames per CPU second of one thread
(frictrack from its file, the peers from memory). Films are kept in a temporary folder (FRICTRACK_FILMS). The bound
leaves out rod, highlight, rotation, flat-field noise and compression.
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

from tracking import CONDITIONS, NUISANCES, automatic, run, speed  # noqa: E402 - found only now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--conditions", default=",".join(CONDITIONS))
    parser.add_argument("--nuisances", action="store_true", help="also each nuisance of the hard film alone")
    parser.add_argument("--peers-python", default=sys.executable, help="python of the environment with the peers")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--speed", action=argparse.BooleanOptionalAction, default=None, help="alone, or left out")
    parser.add_argument("--automatic", type=int, metavar="FILMS", help="only: targets found among other things, of 200")
    parser.add_argument("--json", type=Path, help="file for all figures")
    args = parser.parse_args()
    if args.automatic:
        print(automatic.run(args.automatic, lambda text: print(text, flush=True)))
        return
    names = [*args.conditions.split(","), *(NUISANCES if args.nuisances else ())]
    peers = None if args.no_peers else args.peers_python
    if peers and (absent := run.missing(peers)):
        print(f"not installed and left out: {', '.join(absent)}; see --peers-python")
    figures: dict[str, object] = {"machine": run.machine()}
    print(*(f"{name} {version}" for name, version in run.machine().items()), sep=", ")
    if args.speed is not True:
        results = run.accuracy(names, args.seeds, args.frames, peers, lambda text: print(text, flush=True))
        print(run.overview(results))
        figures["accuracy"] = results
    if args.speed is not False:
        figures["speed"] = speed.measure(lambda text: print(text, flush=True))
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
