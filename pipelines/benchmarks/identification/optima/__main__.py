"""Run only the comparison of optimisers:

python pipelines/benchmarks/identification/optima [--problems "TM,ATM1 n=2"] [--seeds 1000] [--beside 30]
                                                  [--peers-python PATH | --no-peers] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from identification.optima import PROBLEMS, compare  # noqa: E402 - found only now
from identification.optima.run import Plan  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=",".join(PROBLEMS))
    parser.add_argument("--seeds", type=int, default=1000, help="of the default search")
    parser.add_argument("--beside", type=int, default=30, help="of every other one")
    parser.add_argument("--peers-python", default=sys.executable, help="python of the environment with the peers")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--json", type=Path, help="file for all figures")
    args = parser.parse_args()
    plan = Plan(args.problems.split(","), args.seeds, args.beside, None if args.no_peers else args.peers_python)
    figures = compare(plan, lambda text: print(text, flush=True))
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
