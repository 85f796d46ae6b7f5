"""Measure a diagnosis: detection limits of several methods, and scores of blind studies.

    python pipelines/benchmarks/diagnosis [--only limits,blind,notebook] [--effects drag,texture] [--repeats 20]
        [--peers-python PATH | --no-peers] [--blind FOLDER ...] [--json FILE]

limits: one study (five runs, 10 um, 3 % scatter): the limit that frictrack states and the size that it names in 95 of
100 repeats, the ideal detector's, the same detector's in the force domain, and a sparse regression's (PySINDy).

blind: the scores of folders on which `frictrack blind score` has finished. What is measured is put into the file
(default: results.json beside this one); the rest of it stays.

notebook: notebooks/blind.ipynb is executed again; it shows what results.json holds.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from machine import described  # noqa: E402

from diagnosis import run  # noqa: E402 - found only now

PARTS = ("limits", "blind", "notebook")
RESULTS = Path(__file__).with_name("results.json")
NOTEBOOK = Path(__file__).resolve().parents[3] / "notebooks" / "blind.ipynb"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas")
    parser.add_argument("--effects", default="", help="some effects only, with commas")
    parser.add_argument("--repeats", type=int, default=20, help="of every size; 0: none")
    parser.add_argument("--peers-python", default=sys.executable, help="python of an environment with pysindy")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--blind", type=Path, nargs="*", default=[], help="folders that were scored")
    parser.add_argument("--json", type=Path, default=RESULTS, help="file for all figures")
    args = parser.parse_args()
    wanted = args.only.split(",")
    if unknown := sorted({*wanted} - {*PARTS}):
        parser.error(f"expected parts out of {', '.join(PARTS)} but got {unknown}")
    known: dict[str, Any] = json.loads(args.json.read_text()) if args.json.exists() else {}
    known["machine"] = described("numpy", "scipy")
    if "limits" in wanted:
        names = [n for n in args.effects.split(",") if n]
        python = None if args.no_peers else args.peers_python
        known.setdefault("limits", {}).update(
            run.limits(names, args.repeats, python, lambda text: print(text, flush=True))
        )
    if "blind" in wanted:
        known["blind"] = known.get("blind", {}) | {_kind(s): s for s in map(_score, args.blind)}
    if set(wanted) - {"notebook"}:
        args.json.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
        print(f"results: {args.json}")
    if "notebook" in wanted:
        _execute()
        print(f"results: {NOTEBOOK}")


def _execute() -> None:
    """The notebook with the outputs of the stored results."""
    import nbformat  # noqa: PLC0415
    from nbclient import NotebookClient  # noqa: PLC0415

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times of day
    nbformat.write(notebook, NOTEBOOK)


def _score(folder: Path) -> dict[str, Any]:
    """A score without what only its own folder needs."""
    score = json.loads((folder / "score.json").read_text(encoding="utf-8"))
    rows = [{k: r[k] for k in ("kind", "hidden", "size", "verdict", "named", "film")} for r in score["outcomes"]]
    return {k: v for k, v in score.items() if k not in ("output", "outcomes")} | {"outcomes": rows}


def _kind(score: dict[str, Any]) -> str:
    return "films" if any(r["film"] for r in score["outcomes"]) else "tables"


if __name__ == "__main__":
    main()
