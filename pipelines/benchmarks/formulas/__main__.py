"""Score the formulas that name an unknown cause, on sealed studies made by an independent integrator.

    python pipelines/benchmarks/formulas [--n 28] [--empty 10] [--seed 0] [--search-only] [--gplearn [PYTHON]]
                                          [--json FILE]

Each study has six runs, 10 um of noise and 2 % scatter of the friction level; the cause is one of 14 formulas, three
times the ideal detection limit in size. --search-only searches formulas in the residual of the fit, without the library
of effects. Columns: the right formula first; or in the group that is stated as equivalent; values within three standard
deviations after the formula was added; CPU seconds; of formulas stated with a probability, the share that is right.
--gplearn lets gplearn, of the environment of PYTHON, search in the same residual for as many CPU seconds.
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

from formulas.comparison import has_gplearn  # noqa: E402 - found only now
from formulas.run import all_studies, overview  # noqa: E402 - found only now


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=28, help="studies with a cause")
    parser.add_argument("--empty", type=int, default=10, help="studies without one")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first study")
    parser.add_argument("--search-only", action="store_true", help="search formulas only, without a diagnosis")
    parser.add_argument("--gplearn", nargs="?", const=sys.executable, help="Python interpreter that has gplearn")
    parser.add_argument("--json", type=Path, help="file for all figures")
    args = parser.parse_args()
    if args.gplearn and not has_gplearn(args.gplearn):
        print(f"The comparison is skipped: {args.gplearn} has no gplearn; install it there with pip install gplearn.")
        args.gplearn = None
    result = all_studies(
        args.n,
        args.empty,
        args.seed,
        lambda line: print(line, flush=True),
        full=not args.search_only,
        gplearn=args.gplearn,
    )
    print(overview(result["score"]))
    if args.json:
        args.json.write_text(json.dumps(result, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
