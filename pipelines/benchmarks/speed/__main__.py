"""Measure CPU times of one core, each beside a reference computed in the same run. Nothing fails.

    python pipelines/benchmarks/speed [--only diagnosis,start,loop,demo,films,large,searches,split] [--effects drag,...]
        [--restarts 100] [--json FILE]

diagnosis  5 runs x 700 frames: verdict and complete diagnosis with nothing hidden, with each effect hidden in turn, and
           with causes outside the library; reference: a plain NumPy search of every effect on its whole grid
start      the commands --help, history, effects and a faulty study file; reference: importing NumPy, SciPy, OpenCV,
           pandas, h5py and matplotlib
loop       a candidate added to the model of 5 runs x 700 frames, and taken back, in one session
demo       `frictrack demo` from the command to the report
films      the four sample films to the verdict, and their tracking; reference: decoding the same films
large      200 runs x 700 frames; 50 000 samples of measured friction; 40 000 samples with a drive: time and memory
searches   global searches for TM, ATM1 and ATM2; reference: SciPy's differential evolution on ATM1 with two sinusoids
split      one film of 16 000 frames over two processes: speed-up in wall time, and whether the positions are equal

What is measured is put into the file (default: results.json beside this one); the rest of it stays. A quiet machine.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from machine import described  # noqa: E402

from speed import diagnosis, films, large, searches, startup  # noqa: E402 - found only now

PARTS = {
    "start": startup.measure,
    "diagnosis": diagnosis.measure,
    "loop": diagnosis.measure_loop,
    "demo": films.measure_demo,
    "films": films.measure,
    "large": large.measure,
    "searches": searches.measure,
    "split": films.measure_split,
}
RESULTS = Path(__file__).with_name("results.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas")
    parser.add_argument("--effects", default="", help="hidden effects of the diagnosis, with commas; default all")
    parser.add_argument("--restarts", type=int, default=100, help="of every search")
    parser.add_argument("--json", type=Path, default=RESULTS, help="file for all figures")
    args = parser.parse_args()
    wanted = args.only.split(",")
    if unknown := sorted({*wanted} - {*PARTS}):
        parser.error(f"expected parts out of {', '.join(PARTS)} but got {unknown}")
    known: dict[str, Any] = json.loads(args.json.read_text()) if args.json.exists() else {}
    known["machine"] = described("numpy", "scipy", "h5py", "opencv-python-headless")
    for name in wanted:
        print(f"== {name}", flush=True)
        known[name] = PARTS[name](args, lambda text: print(text, flush=True))
        args.json.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    print(f"results: {args.json}")


if __name__ == "__main__":
    main()
