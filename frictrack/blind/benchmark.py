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

from frictrack.blind.draw import draw
from frictrack.blind.judge import Outcome, judge, read_outcome
from frictrack.blind.seal import NAME, opened, seal
from frictrack.blind.tally import tally
from frictrack.blind.truth import Truth
from frictrack.blind.write import write_study
from frictrack.errors import FrictrackError
from frictrack.files import replace_text
from frictrack.flow import Progress, silent
from frictrack.results import plain
from frictrack.workers import run_parallel

TABLES = {"one": 200, "none": 100, "two": 60, "foreign": 60}
FILMS = {"one": 20, "none": 10, "fault": 10}
OUTCOMES = "outcomes"


def make(
    folder: Path,
    n: int | None = None,
    *,
    seed: int = 0,
    film: bool = False,
    workers: int | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write n studies (default 420 of tables, 40 of films) into a new folder and seal their truths: its JSON.

    Raises FrictrackError (usage) where the folder holds studies already, or for fewer than one.
    """
    of = FILMS if film else TABLES
    n = sum(of.values()) if n is None else n
    if n < 1:
        raise FrictrackError(f"expected at least one study but got --n {n}", usage=True)
    if folder.exists() and any(folder.iterdir()):
        raise FrictrackError(f"expected a new or empty folder but {folder} holds something; name another", usage=True)
    folder.mkdir(parents=True, exist_ok=True)
    jobs = _planned(n, of, seed)
    names = [f"study_{i + 1:0{len(str(n))}d}" for i in range(n)]
    work = {name: partial(_make, folder / name, *job, film=film) for name, job in zip(names, jobs, strict=True)}
    made = dict(_spread(work, workers, progress, "studies"))
    seal(folder, {name: made[name] for name in names})
    return {"studies": n, "seed": seed, "film": film, "seal": str(folder / NAME), "output": str(folder)}


def _planned(n: int, of: dict[str, int], seed: int) -> list[tuple[int, str, int]]:
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


def _make(folder: Path, seed: int, kind: str, turn: int, *, film: bool) -> Truth:
    truth = draw(seed, kind, turn, film=film)
    write_study(truth, folder)
    return truth


def score(folder: Path, *, seed: int = 0, workers: int | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Open the seal, diagnose every study, add what is named, and count: JSON of the command.

    An outcome is kept in the folder as soon as it is there, so that a score that was interrupted goes on. Raises
    FrictrackError where there is no seal, or where files were changed since it was closed.
    """
    truths = opened(folder)
    key = sha256((folder / NAME).read_bytes()).hexdigest()[:16] + f" seed {seed}"
    kept = folder / OUTCOMES
    kept.mkdir(exist_ok=True)
    rows = {name: row for name in truths if (row := _kept(kept / f"{name}.json", key)) is not None}
    work = {
        name: partial(judge, name, truth, folder / name, seed) for name, truth in truths.items() if name not in rows
    }
    for name, row in _spread(work, workers, progress, "studies"):
        rows[name] = row
        _keep(kept / f"{name}.json", row, key)
    counted = tally([rows[name] for name in truths])
    result: dict[str, Any] = plain({"output": str(folder), "seed": seed} | counted)
    _replace(folder / "score.json", result | {"outcomes": [_plain(rows[name]) for name in truths]})
    return result


def _plain(row: Outcome) -> dict[str, Any]:
    made: dict[str, Any] = plain(asdict(row))
    return made


def _kept(path: Path, key: str) -> Outcome | None:
    """An outcome of these very studies, if there is one."""
    if not path.is_file():
        return None
    held = json.loads(path.read_text(encoding="utf-8"))
    return read_outcome(held["outcome"]) if held["key"] == key else None


def _keep(path: Path, row: Outcome, key: str) -> None:
    _replace(path, {"key": key, "outcome": _plain(row)})


def _replace(path: Path, value: Any) -> None:
    """A JSON file, replaced whole."""
    replace_text(path, json.dumps(value, indent=1, ensure_ascii=False))


def _spread(
    work: dict[str, partial[Any]], workers: int | None, progress: Progress, what: str
) -> Iterator[tuple[str, Any]]:
    """Results as they come, from several processes where that pays."""
    progress(0, len(work), what)
    for done, pair in enumerate(run_parallel(work, workers), 1):
        progress(done, len(work), what)
        yield pair
