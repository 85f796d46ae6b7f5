"""Measure how many runs a sure verdict takes if frictrack names each next run, against a fixed design of six.

    python pipelines/benchmarks/campaigns [--n 40] [--seed 1000] [--json FILE]

Every campaign hides one effect, or nothing, in a simulated set-up with 2 to 8 m/s, both directions, two masses and an
incline. Both arms are diagnosed after each film, within one budget of significance, until the verdict is sure: one
missing effect without a rival, or `complete`. Truth is written and integrated without frictrack (scipy).
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

from machine import described  # noqa: E402

from campaigns.causes import EFFECTS  # noqa: E402
from campaigns.play import costs_of, play, score, tell_one  # noqa: E402
from campaigns.studies import draw  # noqa: E402

HIDDEN = ["", "", *EFFECTS]  # two in eleven campaigns hide nothing


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    played = []
    for k in range(args.n):
        campaign = draw(args.seed + k, HIDDEN[k % len(HIDDEN)])
        played.append(play(campaign, costs_of(campaign)))
        tell_one(played[-1], lambda line: print(line, flush=True))
        if args.json:
            made = {"machine": described("numpy", "scipy"), "score": score(played), "campaigns": played}
            args.json.write_text(json.dumps(made, indent=1) + "\n")
    print(json.dumps(score(played)))


if __name__ == "__main__":
    main()
