"""Measure how frictrack scales: cores, length of a film, number of runs, and time per stage.

    python pipelines/benchmarks/scale [--only cores,length,split,runs,stages,archive] [--json FILE]

cores   studies of four rendered films each, by `frictrack batch` on 1, 2, 4, ... processes: runs a minute, and how much
        of the ideal speed that is; resumed once, to see what a finished study costs
length  one film of 1000, 4000 and 16000 frames of 1024 x 256 px (up to 4 GB, in files with holes): the most memory that
        tracking takes, and its time a frame
split   one film of 16000 frames by one and by two processes: share of twice the speed, and whether numbers are the same
runs    5 to 40 runs of 700 frames: processor time of fit and diagnosis, and the exponent in the number of runs
stages  one study of four films: time of every stage, beside the decoder alone
archive 1000, 5000 and 25 000 finished studies of four runs: time and memory of a batch that finds nothing to do

What is measured is put into the file (default: results.json beside this one); the rest of it stays. A quiet machine.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from parts import measure_parts, parts_parser  # noqa: E402

from frictrack.base.workers import processors  # noqa: E402
from scale import archive, cores, length, runs, split, stages  # noqa: E402 - found only now

PARTS = {
    "cores": cores.measure,
    "length": length.measure,
    "split": split.measure,
    "runs": runs.measure,
    "stages": stages.measure,
    "archive": archive.measure,
}
RESULTS = Path(__file__).with_name("results.json")


def main() -> None:
    parser = parts_parser(__doc__, PARTS, RESULTS)
    measure_parts(parser, parser.parse_args(), PARTS, cores=processors())


if __name__ == "__main__":
    main()
