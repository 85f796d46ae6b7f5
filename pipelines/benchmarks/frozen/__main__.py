"""Compare the outputs of frictrack with those stored from an earlier version: a rewrite must not change them.

    python pipelines/benchmarks/frozen [--only tables,films | --quick] [--texts] [--write]

Numbers must agree to 1e-9 of their size. Sentences may become plainer: they are compared with --texts only; words that
are values (a verdict, the name of an effect or run) always are. What is stored was computed on one machine: another
processor may round differently, so compare there with outputs written there (`--write` on the earlier commit).
`--quick` takes about a minute, everything about ten. Exit status 1 where anything differs.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from cases import CASES, QUICK, ROOT

OUTPUTS = Path(__file__).resolve().parent / "outputs"
RELATIVE = 1e-9
# Values of the run and not of the result: processor times, versions, checksums of files that hold either.
IGNORED = {
    "version",
    "python",
    "machine",
    "cpu_s",
    "cpu_seconds",
    "seconds",
    "ms",
    "cpu_ms",
    "frames_per_cpu_second",
    "frames_per_s",
}
SHOWN = 12  # differences per case


def plain(value: Any, folder: str) -> Any:
    """A JSON value without the folder that it was made in."""
    if isinstance(value, dict):
        return {key: plain(v, folder) for key, v in value.items()}
    if isinstance(value, list):
        return [plain(v, folder) for v in value]
    return value.replace(folder, "FOLDER").replace(str(ROOT), "ROOT") if isinstance(value, str) else value


def differences(old: Any, new: Any, *, texts: bool, rtol: float = RELATIVE, at: str = "") -> Iterator[str]:
    """Yield where two JSON values differ, and how."""
    if isinstance(old, dict) and isinstance(new, dict):
        yield from (f"{at}/{key}: only in the {side}" for key, side in _unpaired(old, new))
        for key in old.keys() & new.keys():
            if key not in IGNORED:
                yield from differences(old[key], new[key], texts=texts, rtol=rtol, at=f"{at}/{key}")
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield f"{at}: {len(old)} entries, now {len(new)}"
        for i, (a, b) in enumerate(zip(old, new, strict=False)):
            yield from differences(a, b, texts=texts, rtol=rtol, at=f"{at}/{i}")
    elif not _equal(old, new, texts=texts, rtol=rtol):
        yield f"{at}: {old!r:.200} -> {new!r:.200}"


def _unpaired(old: dict[str, Any], new: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield from ((key, "stored output") for key in sorted(old.keys() - new.keys()))
    yield from ((key, "new output") for key in sorted(new.keys() - old.keys()))


def _equal(old: Any, new: Any, *, texts: bool, rtol: float) -> bool:
    if isinstance(old, float) and isinstance(new, int | float) and not isinstance(new, bool):
        return math.isclose(old, new, rel_tol=rtol) or (math.isnan(old) and math.isnan(new))
    if isinstance(old, str) and isinstance(new, str) and not texts and " " in old.strip():
        return True
    return bool(old == new)


def main() -> int:
    """Compare or write; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(CASES), help="cases, with commas")
    parser.add_argument("--quick", action="store_true", help=f"only {', '.join(QUICK)}")
    parser.add_argument("--texts", action="store_true", help="compare sentences, too")
    parser.add_argument("--relative", type=float, default=RELATIVE, help="largest relative difference of numbers")
    parser.add_argument("--shown", type=int, default=SHOWN, help="differences shown per case")
    parser.add_argument("--write", action="store_true", help="store the outputs instead of comparing them")
    options = parser.parse_args()
    failed = False
    for name in QUICK if options.quick else options.only.split(","):
        with tempfile.TemporaryDirectory() as folder:
            new = json.loads(json.dumps(plain(CASES[name](Path(folder)), folder)))
        path = OUTPUTS / f"{name}.json"
        if options.write:
            OUTPUTS.mkdir(exist_ok=True)
            path.write_text(json.dumps(new, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            continue
        found = list(
            differences(json.loads(path.read_text(encoding="utf-8")), new, texts=options.texts, rtol=options.relative)
        )
        failed |= bool(found)
        print(f"{name}: {len(found)} differences" if found else f"{name}: equal", flush=True)
        print("".join(f"    {line}\n" for line in found[: options.shown]), end="", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
