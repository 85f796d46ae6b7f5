"""The blind benchmark: studies made and sealed, and later opened, diagnosed and counted."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from frictrack.blind.draw_truth import draw_truth
from frictrack.blind.outcome import Outcome, judge_study, read_outcome
from frictrack.blind.seal import SEAL_FILE, open_seal, seal
from frictrack.blind.tally import tally
from frictrack.blind.truth import Truth
from frictrack.blind.write_study import write_study
from frictrack.errors import FrictrackError
from frictrack.files import replace_text
from frictrack.flow import Progress, no_progress
from frictrack.results import to_builtins
from frictrack.workers import run_parallel

STUDIES_PER_KIND_TABLES = {"one": 200, "none": 100, "two": 60, "foreign": 60}
STUDIES_PER_KIND_FILMS = {"one": 20, "none": 10, "fault": 10}
OUTCOMES_FOLDER = "outcomes"


def make(
    folder: Path,
    n: int | None = None,
    *,
    seed: int = 0,
    film: bool = False,
    workers: int | None = None,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Write n studies (default 420 of tables, 40 of films) into a new folder and seal their truths: its JSON.

    Raises FrictrackError (usage) where the folder holds studies already, or for fewer than one.
    """
    of = STUDIES_PER_KIND_FILMS if film else STUDIES_PER_KIND_TABLES
    n = sum(of.values()) if n is None else n
    if n < 1:
        raise FrictrackError(f"expected at least one study but got --n {n}", usage=True)
    if folder.exists() and any(folder.iterdir()):
        raise FrictrackError(f"expected a new or empty folder but {folder} holds something; name another", usage=True)
    folder.mkdir(parents=True, exist_ok=True)
    jobs = _plan_studies(n, of, seed)
    names = [f"study_{i + 1:0{len(str(n))}d}" for i in range(n)]
    work = {name: partial(_make_study, folder / name, *job, film=film) for name, job in zip(names, jobs, strict=True)}
    truths = dict(_run_with_progress(work, workers, progress, "studies"))
    seal(folder, {name: truths[name] for name in names})
    return {"studies": n, "seed": seed, "film": film, "seal": str(folder / SEAL_FILE), "output": str(folder)}


def _plan_studies(n: int, of: dict[str, int], seed: int) -> list[tuple[int, str, int]]:
    """Seed, kind and turn of every study, kinds shuffled: neither place nor name may tell."""
    shares = {kind: n * count / sum(of.values()) for kind, count in of.items()}
    counts = {kind: int(share) for kind, share in shares.items()}
    short = sorted(shares, key=lambda kind: counts[kind] - shares[kind])[: n - sum(counts.values())]
    counts |= {kind: counts[kind] + 1 for kind in short}
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    rng = np.random.default_rng([seed, 11])
    rng.shuffle(kinds)
    seeds = rng.choice(2**31, n, replace=False)
    begun = {kind: int(rng.integers(100)) for kind in of}  # whose turn is first
    done: Counter[str] = Counter()
    out = []
    for own, kind in zip(seeds, kinds, strict=True):
        out.append((int(own), kind, begun[kind] + done[kind]))
        done[kind] += 1
    return out


def _make_study(folder: Path, seed: int, kind: str, turn: int, *, film: bool) -> Truth:
    truth = draw_truth(seed, kind, turn, film=film)
    write_study(truth, folder)
    return truth


def score(
    folder: Path, *, seed: int = 0, workers: int | None = None, progress: Progress = no_progress
) -> dict[str, Any]:
    """Open the seal, diagnose every study, add what is named, and count: JSON of the command.

    An outcome is kept in the folder as soon as it is there, so that a score that was interrupted goes on. Raises
    FrictrackError where there is no seal, or where files were changed since it was closed.
    """
    truths = open_seal(folder)
    key = sha256((folder / SEAL_FILE).read_bytes()).hexdigest()[:16] + f" seed {seed}"
    kept = folder / OUTCOMES_FOLDER
    kept.mkdir(exist_ok=True)
    rows = {name: row for name in truths if (row := _read_kept(kept / f"{name}.json", key)) is not None}
    work = {
        name: partial(judge_study, name, truth, folder / name, seed)
        for name, truth in truths.items()
        if name not in rows
    }
    for name, row in _run_with_progress(work, workers, progress, "studies"):
        rows[name] = row
        _write_kept(kept / f"{name}.json", row, key)
    counted = tally([rows[name] for name in truths])
    result: dict[str, Any] = to_builtins({"output": str(folder), "seed": seed} | counted)
    _write_json(folder / "score.json", result | {"outcomes": [_to_json(rows[name]) for name in truths]})
    return result


def _to_json(row: Outcome) -> dict[str, Any]:
    values: dict[str, Any] = to_builtins(asdict(row))
    return {"alike" if key == "equivalents" else key: value for key, value in values.items()}  # key in existing files


def _read_kept(path: Path, key: str) -> Outcome | None:
    """An outcome of these very studies, if there is one."""
    if not path.is_file():
        return None
    held = json.loads(path.read_text(encoding="utf-8"))
    return read_outcome(held["outcome"]) if held["key"] == key else None


def _write_kept(path: Path, row: Outcome, key: str) -> None:
    _write_json(path, {"key": key, "outcome": _to_json(row)})


def _write_json(path: Path, value: Any) -> None:
    """A JSON file, replaced whole."""
    replace_text(path, json.dumps(value, indent=1, ensure_ascii=False))


def _run_with_progress(
    work: dict[str, partial[Any]], workers: int | None, progress: Progress, what: str
) -> Iterator[tuple[str, Any]]:
    """Results as they come, from several processes where that pays."""
    progress(0, len(work), what)
    for done, pair in enumerate(run_parallel(work, workers), 1):
        progress(done, len(work), what)
        yield pair
