"""Compare all searches on one study: result, distance from the best, and time.

python pipelines/searches.py STUDY [--model tustin] [--domain force] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from importlib.util import find_spec
from pathlib import Path

import frictrack as ft
from frictrack.flow import Session, open_study

SEARCHES = ("varpro", "ga", "mga", "sa", "sga", "de", "da", "cmaes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--model", default="tustin")
    parser.add_argument("--domain", choices=("displacement", "force"), default="force")
    parser.add_argument("--searches", default=",".join(SEARCHES))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    runs = [work.to_run() for work in Session(open_study(args.study)).bring_up_to("friction")]
    found = {}
    for search in args.searches.split(","):
        if search == "cmaes" and find_spec("cma") is None:
            print('cmaes left out: pip install "frictrack[cmaes]"')
            continue
        start = time.perf_counter()
        fit = ft.fit(args.model, runs, domain=args.domain, search=search, rng=args.seed)
        found[search] = fit, time.perf_counter() - start

    key = "rms_displacement_um" if args.domain == "displacement" else "sse_acceleration"
    best = min(fit.errors[key] for fit, _ in found.values())
    names = [name for name, p in next(iter(found.values()))[0].parameters.items() if "[" not in name]
    print("search  ", *(f"{name:>16}" for name in names), f"{key:>22}  over the best   time / s")
    for search, (fit, took) in found.items():
        values = (fit.parameters[name].value for name in names)
        cells = (f"{'not determined':>16}" if value is None else f"{value:16.5g}" for value in values)
        error = fit.errors[key]
        print(f"{search:8}", *cells, f"{error:22.6g}  {100 * (error / best - 1):12.3f} %  {took:9.2f}")


if __name__ == "__main__":
    main()
