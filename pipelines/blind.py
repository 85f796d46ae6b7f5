"""Run a small blind benchmark: write studies of sealed truth, diagnose them, open the truth and count.

    python pipelines/blind.py FOLDER [--n 20] [--seed 0] [--film] [--workers N]

Begun again it goes on where it was. The full one (420 tables, 40 films) is `--n 420` and `--n 40 --film`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from frictrack.validation.blind import make, score


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--film", action="store_true")
    parser.add_argument("--workers", type=int)
    args = parser.parse_args()

    if not args.folder.exists():
        make(args.folder, args.n, seed=args.seed, film=args.film, workers=args.workers)
    score(args.folder, workers=args.workers)
    for row in json.loads((args.folder / "score.json").read_text())["outcomes"]:
        print(
            f"{row['name']}: {' + '.join(row['hidden']) or 'nothing'} hidden, {row['verdict']} {' '.join(row['named'])}"
        )
    print(args.folder / "score.json")


if __name__ == "__main__":
    main()
