"""Collect a campaign of studies in one table and plot the drift of Coulomb friction over it.

    python pipelines/campaign.py PATH... [--workers N | --scheduler ADDRESS]

PATH is what `frictrack batch` takes: study files, folders, globs. Finished studies are not processed again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from frictrack.flow.batch import batch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--scheduler")
    parser.add_argument("--output", type=Path, default=Path("campaign"))
    args = parser.parse_args()

    found = batch(args.paths, args.output, workers=args.workers, scheduler=args.scheduler)
    runs = pd.read_csv(found["tables"][0])
    studies = runs.dropna(subset="verdict").groupby("study", sort=False).first()
    if "coulomb.F_c" in studies:
        print(studies[["coulomb.F_c", "coulomb.F_c std", "verdict"]])
    for trend in found["trends"]:
        verdict = "changes" if trend["holds"] else "no trend"
        print(f"{trend['name']}: {trend['change']:.3g} +- {trend['change_std']:.2g} {trend['unit']}, {verdict}")
    for one in found["failed"]:
        print(f"failed: {one['study']} {one['run']}: {one['reason']}")
    print(found["output"])


if __name__ == "__main__":  # the processes of a batch import this file and must not begin one of their own
    main()
