"""Run the parts of a benchmark that the command line asks for, and put what they measured into one file."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from machine import described

Say = Callable[[str], None]
PACKAGES = ("numpy", "scipy", "h5py", "opencv-python-headless")


def parts_parser(description: str | None, parts: Mapping[str, Any], results: Path) -> argparse.ArgumentParser:
    """Return a parser of ``--only`` and ``--json``; the names of all parts and `results` are their defaults."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(parts), help="parts, with commas")
    parser.add_argument("--json", type=Path, default=results, help="file for all figures")
    return parser


def measure_parts(
    parser: argparse.ArgumentParser, args: argparse.Namespace, parts: Mapping[str, Callable[[Say], Any]], **machine: Any
) -> None:
    """Measure the parts asked for; each is written to the file when it is done, and the rest of the file stays.

    Parameters
    ----------
    parser, args
        Parser of `parts_parser`, and what it read.
    parts
        Function of every part; it gets a function that prints, and returns what goes into the file.
    **machine
        What the file says of the machine besides processor and versions.

    """
    wanted = args.only.split(",")
    if unknown := sorted({*wanted} - {*parts}):
        parser.error(f"expected parts out of {', '.join(parts)} but got {unknown}")
    known: dict[str, Any] = json.loads(args.json.read_text()) if args.json.exists() else {}
    known["machine"] = described(*PACKAGES) | machine
    for name in wanted:
        print(f"== {name}", flush=True)
        known[name] = parts[name](lambda text: print(text, flush=True))
        args.json.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    print(f"results: {args.json}")
