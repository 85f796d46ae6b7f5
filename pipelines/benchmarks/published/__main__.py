"""Score frictrack on published benchmarks, each as its authors score it, beside their figures.

    python pipelines/benchmarks/published FOLDER [--only emps,bouc_wen,pendulum] [--json FILE]

FOLDER holds the folders `emps` (DATA_EMPS.mat, DATA_EMPS_PULSES.mat), `bouc_wen` (train_data.csv, uval_multisine.mat,
yval_multisine.mat, NARX_multisine.csv) and `pendulum` (id*.csv, free.csv: time in s, angle in rad), at any depth. Those
that are missing are left out. The figures are put into the file (default: results.json beside this one).

emps: relative force error in the authors' measure. Effects are chosen, and all coefficients fitted, on the first half
of the validation record; the second half is only scored. Beside it the transfer from drive to position, with the
largest share of the mass that could hang on a spring.

bouc_wen: rms of a free run over the whole test record, fitted on samples of the training record.

pendulum: rms of the angle, each decay as one free run.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from machine import described  # noqa: E402

from published import decay, hysteresis, positioning  # noqa: E402 - found only now

Score = Callable[[Path], dict[str, Any]]
RESULTS = Path(__file__).with_name("results.json")
SCORES: dict[str, Score] = {
    "emps": lambda folder: positioning.score(folder, _say),
    "bouc_wen": hysteresis.score,
    "pendulum": decay.score,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder that holds the data of the benchmarks")
    parser.add_argument("--only", default=",".join(SCORES), help="benchmarks, with commas")
    parser.add_argument("--json", type=Path, default=RESULTS, help="file for all figures")
    args = parser.parse_args()
    wanted = args.only.split(",")
    if unknown := sorted({*wanted} - {*SCORES}):
        parser.error(f"expected benchmarks out of {', '.join(SCORES)} but got {unknown}")
    figures: dict[str, Any] = json.loads(args.json.read_text()) if args.json.exists() else {}
    for name in wanted:
        folder = next((f for f in sorted(args.folder.rglob(name)) if f.is_dir()), None)
        if folder is None:
            print(f"{name} is left out: {args.folder} has no folder of that name")
            continue
        figures[name] = SCORES[name](folder)
        _say(_table(name, figures[name]))
        figures["machine"] = described("numpy", "scipy")
        args.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def _table(name: str, figures: dict[str, Any]) -> str:
    lines = [f"\n{name:90}{'published':>10}{'frictrack':>10}"]
    for row in figures["rows"]:
        published = "" if row["published"] is None else f"{row['published']:.2f}"
        lines.append(f"{row['what']:90}{published:>10}{row['ours']:>10.3f} {row['unit']}")
    lines += [f"  {key}: {value}" for key, value in figures.get("flexibility", {}).items()]
    return "\n".join(lines)


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    main()
