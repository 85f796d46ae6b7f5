"""Measure frictrack on records with faults: confidently wrong verdicts, faults named, processor time.

    python pipelines/benchmarks/reality [--n 200] [--seed 0] [--workers 1] [--only KIND] [--limit 120]
        [--minutes M] [--folder FOLDER] [--json FILE]

Every study is a blind one (a law, five to eight runs, one effect or none hidden in it) with one fault: outliers,
doubled or missing frames, quantised positions, a jittered or a wrong clock, coloured noise, a wrong mass, unit or
incline, the same recording twice, a target that turns, or one that passes behind a rod. One in ten has none.

A verdict is confidently wrong where it names an effect that is neither hidden nor indistinguishable from what is (or is
the fault itself), where it is `complete` although an effect of twice the detection limit is hidden and the fault was
not named, or where a parameter is more than five quoted deviations off and nothing was remarked.

Outcomes are kept in the folder as they come: run it again to go on, with a larger --n to add more. Tables come first,
films last. The figures, also of a part of the studies, are put into the file (default: results.json beside this one);
a run of one kind only prints them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from machine import described  # noqa: E402

from frictrack.base import __version__  # noqa: E402
from frictrack.base.files import replace_text  # noqa: E402
from frictrack.base.workers import processors, run_parallel  # noqa: E402
from frictrack.results import to_builtins  # noqa: E402
from reality.faults import FILMED, KINDS  # noqa: E402 - found only now
from reality.judge import CPU_LIMIT_S, Outcome, judge, judged, read_outcome  # noqa: E402
from reality.studies import draw_case, planned  # noqa: E402
from reality.tally import table, tally  # noqa: E402

RESULTS = Path(__file__).with_name("results.json")
Plan = tuple[int, str, str, int]


def main() -> None:
    args = _arguments()
    folder = args.folder or Path(tempfile.gettempdir()) / f"frictrack_reality_{__version__}_{args.seed}"
    plans = {_name_of(i, args.only): plan for i, plan in enumerate(planned(args.n, args.seed, args.only))}
    rows = {name: row for name, plan in plans.items() if (row := _kept(folder, name, plan, args.limit))}
    left = sorted((n for n in plans if n not in rows), key=lambda n: plans[n][1] in FILMED)  # films take longest
    work = {name: partial(one, folder, name, plans[name], args.limit) for name in left if args.minutes > 0}
    end = time.monotonic() + 60 * args.minutes
    for name, row in run_parallel(work, args.workers):
        rows[name] = row
        print(f"{len(rows)}/{len(plans)} {_short(row)}", file=sys.stderr, flush=True)
        if time.monotonic() > end:
            break
    counts = tally([rows[name] for name in plans if name in rows])
    print("\n".join(table(counts)))
    if not args.only:
        about = described("numpy", "scipy", "opencv-python-headless") | {"cores": processors()}
        text = json.dumps(to_builtins({"machine": about, "seed": args.seed} | counts), indent=1, ensure_ascii=False)
        replace_text(args.json, text + "\n")
        print(f"results: {args.json}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=200, help="studies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=None, help="processes (default: as many as processors)")
    parser.add_argument("--only", default="", choices=["", *KINDS], help="one kind of fault")
    parser.add_argument("--limit", type=float, default=CPU_LIMIT_S, help="processor time of a study, s")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after these no study is begun; 0: count")
    parser.add_argument("--folder", type=Path, default=None, help="where studies and outcomes are kept")
    parser.add_argument("--json", type=Path, default=RESULTS, help="file for all figures")
    return parser.parse_args()


def _name_of(i: int, only: str) -> str:
    """Name of a study, which does not show what is in it."""
    return f"{only[:2]}{'_' if only else ''}study_{i + 1:03d}"


def one(folder: Path, name: str, plan: Plan, limit: float) -> Outcome:
    """Draw, write and judge one study, and keep the outcome."""
    study = folder / name
    shutil.rmtree(study, ignore_errors=True)
    row = judge(draw_case(name, *plan), study, limit)
    shutil.rmtree(study / "study_results", ignore_errors=True)
    held = {"plan": list(plan), "limit": limit, "outcome": to_builtins(row.to_dict())}
    replace_text(folder / f"{name}.json", json.dumps(held, indent=1, ensure_ascii=False))
    return row


def _kept(folder: Path, name: str, plan: Plan, limit: float) -> Outcome | None:
    """The outcome of this very study, if there is one, judged as it is judged now."""
    path = folder / f"{name}.json"
    if not path.is_file():
        return None
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return judged(read_outcome(held["outcome"])) if (held["plan"], held["limit"]) == (list(plan), limit) else None


def _short(row: Outcome) -> str:
    named = "named" if row.named else "not named"
    said = f"{row.verdict} {'+'.join(row.missing)}".strip()
    return (
        f"{row.name} {row.fault.kind} ({named}), hidden {'+'.join(row.hidden) or '-'}: {said}, {row.seconds:.1f} s"
        + (f"; WRONG: {row.wrong}" if row.wrong else "")
    )


if __name__ == "__main__":
    from reality.__main__ import main as run  # under a name by which worker processes find its functions

    run()
