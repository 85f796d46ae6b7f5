"""Many studies, one after the other; a failed one never stops the rest and is listed with its reason."""

from __future__ import annotations

import csv
import glob
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from frictrack.errors import FrictrackError
from frictrack.files import replace_text
from frictrack.flow import Progress, Session, open_study, silent

HEAD = ("study", "run", "role", "verdict", "missing", "reason", "model", "domain")


def find_studies(patterns: Sequence[str]) -> list[Path]:
    """Study files behind files, folders (searched through) and globs, each once, in order.

    Raises `FrictrackError` (usage) for a pattern that finds none.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        matches = sorted(glob.glob(pattern, recursive=True)) or [pattern]
        studies = [s for match in matches for s in _studies(Path(match))]
        if not studies:
            raise FrictrackError(f"expected study files in {pattern} but found none", usage=True)
        found |= dict.fromkeys(studies)
    return list(found)


def _studies(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.rglob("study.toml"))
    return [path] if path.exists() else []


def batch(patterns: Sequence[str], out: Path, seed: int = 0, progress: Progress = silent) -> dict[str, Any]:
    """Run every study and write one CSV row per run to `out`: JSON of `batch`."""
    paths = find_studies(patterns)
    rows: list[dict[str, Any]] = []
    studies = []
    for i, path in enumerate(paths):
        progress(i, len(paths), "studies")
        done, runs = _one(path, seed, progress)
        studies.append(done)
        rows += runs
        _write(out, rows)  # after every study, so that nothing finished is lost
    progress(len(paths), len(paths), "studies")
    failed = [{"study": s["study"], "reason": s["reason"]} for s in studies if s["reason"]]
    return {"studies": studies, "failed": failed, "output": str(out)}


def _one(path: Path, seed: int, progress: Progress) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """One study: its line of the summary, and one row per run (a single one where it failed)."""
    try:
        result = Session(open_study(path), progress).run(seed)
    except Exception as e:  # noqa: BLE001 - whatever befalls one study must not stop the others
        reason = str(e) if isinstance(e, FrictrackError) else f"{type(e).__name__}: {e}"
        reason = " ".join(reason.split())
        return {"study": str(path), "runs": 0, "reason": reason}, [{"study": str(path), "reason": reason}]
    fit, diagnosis = result["fit"], result["diagnose"]
    shared = {
        "study": str(path),
        "verdict": diagnosis["verdict"],
        "missing": " ".join(diagnosis["missing"]),
        "model": " ".join(fit["model"]),
        "domain": fit["domain"],
        **{name: p["value"] for name, p in fit["parameters"].items()},
        **{f"{name} std": p["std"] for name, p in fit["parameters"].items()},
    }
    rows = [shared | _run_row(run) for run in fit["per_run"]]
    summary = {k: shared[k] for k in ("study", "verdict")} | {"missing": diagnosis["missing"]}
    return summary | {"runs": len(rows), "reason": None, "results": result["output"]}, rows


def _run_row(run: dict[str, Any]) -> dict[str, Any]:
    own = {k: run.get(k) for k in ("run", "role", "level", "noise_um", "segments")}
    return own | run.get("errors", {})


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    """The table, replaced whole."""
    names = list(dict.fromkeys([*HEAD, *(name for row in rows for name in row)]))
    table = io.StringIO()
    writer = csv.DictWriter(table, names)
    writer.writeheader()
    writer.writerows(rows)
    replace_text(path, table.getvalue())
