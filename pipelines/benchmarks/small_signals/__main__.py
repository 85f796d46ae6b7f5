"""Measure how often small hidden effects are named, compared with an ideal detector.

    python pipelines/benchmarks/small_signals [--n 10] [--empty 40] [--seed 0] [--effects drag,texture]
        [--sizes 1.0,1.5] [--json FILE]

Each study is drawn as by `frictrack blind make` and hides one effect. Its size is a multiple of the limit of the ideal
detector, which sees that size in 95 of 100 repeats. The ideal detector fits every effect of the library to the same
noisy data, from where each fits best without noise.

Columns: detected (the p-value of the true effect is below the level); first (it is named first); named (it is named
first, or stated as indistinguishable from the one named first); the same of the ideal detector; false (a further effect
is named); ratio (named, over named by the ideal detector).
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

from small_signals import run  # noqa: E402 - found only now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=10, help="studies of every effect and size")
    parser.add_argument("--empty", type=int, default=0, help="studies that hide nothing")
    parser.add_argument("--seed", type=int, default=0, help="other studies for every seed")
    parser.add_argument("--effects", default=",".join(run.EFFECTS), help="effects, with commas")
    parser.add_argument("--sizes", default=",".join(map(str, run.SIZES)), help="over the ideal limit, with commas")
    parser.add_argument("--json", type=Path, help="file for all figures")
    args = parser.parse_args()
    names = [n for n in args.effects.split(",") if n]
    rows = run.measure(names, [float(s) for s in args.sizes.split(",")], args.n, args.seed, _tell) if args.n else []
    empty = [run.empty_study(1000 * args.seed + k) for k in range(args.empty)]
    table = run.table(rows)
    if rows:
        print(run.overview(table))
    if empty:
        print(f"false alarms: {sum(bool(e['missing']) for e in empty)} of {len(empty)} studies that hide nothing")
    if args.json:
        args.json.write_text(json.dumps({"table": table, "studies": rows, "empty": empty}, indent=1), encoding="utf-8")


def _tell(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    main()
