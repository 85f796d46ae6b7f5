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

import os
import sys
from functools import partial
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from parts import measure_parts, parts_parser  # noqa: E402
from scale import split  # noqa: E402 - found only now

from speed import diagnosis, films, large, searches, startup  # noqa: E402

PARTS = {
    "start": startup.measure,
    "diagnosis": diagnosis.measure,
    "loop": diagnosis.measure_loop,
    "demo": films.measure_demo,
    "films": films.measure,
    "large": large.measure,
    "searches": searches.measure,
    "split": split.measure,
}
RESULTS = Path(__file__).with_name("results.json")


def main() -> None:
    parser = parts_parser(__doc__, PARTS, RESULTS)
    parser.add_argument("--effects", default="", help="hidden effects of the diagnosis, with commas; default all")
    parser.add_argument("--restarts", type=int, default=100, help="of every search")
    args = parser.parse_args()
    chosen = [name for name in args.effects.split(",") if name]
    asked = {
        "diagnosis": partial(diagnosis.measure, chosen=chosen),
        "searches": partial(searches.measure, restarts=args.restarts),
    }
    measure_parts(parser, args, PARTS | asked)


if __name__ == "__main__":
    main()
