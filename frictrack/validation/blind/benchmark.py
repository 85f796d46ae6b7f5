"""Run the blind benchmark: write and seal studies, later open them, diagnose them and count what was right."""

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

from frictrack.base.errors import FrictrackError
from frictrack.base.files import replace_text
from frictrack.base.workers import run_parallel
from frictrack.flow import Progress, no_progress
from frictrack.results import to_builtins
from frictrack.validation.blind.outcome import Outcome, judge_study, read_outcome
from frictrack.validation.blind.study_files import SEAL_FILE, open_seal, seal, write_study
from frictrack.validation.blind.tally import tally
from frictrack.validation.blind.truth import Truth
from frictrack.validation.blind.truth_sampling import KINDS, draw_truth

STUDIES_PER_KIND_TABLES = {"one": 200, "none": 100, "two": 60, "foreign": 60}
STUDIES_PER_KIND_FILMS = {"one": 20, "none": 10, "fault": 10}
STUDIES_OF_ONE_KIND = 60
OUTCOMES_FOLDER = "outcomes"


def make(  # noqa: PLR0913 - named settings
    folder: Path | str,
    n: int | None = None,
    *,
    seed: int = 0,
    film: bool = False,
    kind: str | None = None,
    workers: int | None = None,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Write studies of known truth into a new folder and seal the truth.

    Parameters
    ----------
    folder
        New or empty folder.
    n
        Number of studies; by default 420 with tables or 40 with films, or 60 of one kind.
    seed
        Seed of all draws.
    film
        Whether to render films instead of writing tables.
    kind
        Kind of all studies ("one", "none", "two", "three", "foreign" or "fault"); None for a mixture.
    workers
        Number of processes; by default as many as `run_parallel` chooses.
    progress
        Called with the number of studies done, the number of all and a text.

    Returns
    -------
    dict
        JSON of the command: studies, seed, film, seal, output.

    Raises
    ------
    FrictrackError
        If the folder contains files, n is below 1, or the kind is unknown (usage).

    """
    if kind is not None and kind not in KINDS:
        raise FrictrackError(f'expected one of the kinds {", ".join(KINDS)} but got "{kind}"', usage=True)
    mixture = STUDIES_PER_KIND_FILMS if film else STUDIES_PER_KIND_TABLES
    of = mixture if kind is None else {kind: STUDIES_OF_ONE_KIND}
    n = sum(of.values()) if n is None else n
    folder = Path(folder)
    if n < 1:
        raise FrictrackError(f"expected at least one study but got --n {n}", usage=True)
    if folder.exists() and any(folder.iterdir()):
        raise FrictrackError(
            f"expected a new or empty folder but {folder} contains files; give another folder", usage=True
        )
    folder.mkdir(parents=True, exist_ok=True)
    jobs = _plan_studies(n, of, seed)
    names = [f"study_{i + 1:0{len(str(n))}d}" for i in range(n)]
    work = {name: partial(_make_study, folder / name, *job, film=film) for name, job in zip(names, jobs, strict=True)}
    truths = dict(_run_with_progress(work, workers, progress))
    seal(folder, {name: truths[name] for name in names})
    return {"studies": n, "seed": seed, "film": film, "seal": str(folder / SEAL_FILE), "output": str(folder)}


def _plan_studies(n: int, of: dict[str, int], seed: int) -> list[tuple[int, str, int]]:
    """Seed, kind and turn of each study, with kinds shuffled so that neither order nor name reveals them."""
    shares = {kind: n * count / sum(of.values()) for kind, count in of.items()}
    counts = {kind: int(share) for kind, share in shares.items()}
    short = sorted(shares, key=lambda kind: counts[kind] - shares[kind])[: n - sum(counts.values())]
    counts |= {kind: counts[kind] + 1 for kind in short}
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    rng = np.random.default_rng([seed, 11])
    rng.shuffle(kinds)
    seeds = rng.choice(2**31, n, replace=False)
    first_turn = {kind: int(rng.integers(100)) for kind in of}
    done: Counter[str] = Counter()
    out = []
    for own, kind in zip(seeds, kinds, strict=True):
        out.append((int(own), kind, first_turn[kind] + done[kind]))
        done[kind] += 1
    return out


def _make_study(folder: Path, seed: int, kind: str, turn: int, *, film: bool) -> Truth:
    """Draw and write one study."""
    truth = draw_truth(seed, kind, turn, film=film)
    write_study(truth, folder)
    return truth


def score(
    folder: Path | str, *, seed: int = 0, workers: int | None = None, progress: Progress = no_progress
) -> dict[str, Any]:
    """Open the sealed truth, diagnose each study, add the named effects, and count what was right.

    Each outcome is stored in the folder at once, so an interrupted call continues where it stopped.

    Parameters
    ----------
    folder
        Folder written by `make`.
    seed
        Seed of the diagnoses.
    workers, progress
        As in `make`.

    Returns
    -------
    dict
        JSON of the command; `tally` describes it. It is also written to score.json, with all outcomes.

    Raises
    ------
    FrictrackError
        If there is no sealed truth, or if files changed since it was sealed.

    """
    folder = Path(folder)
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
    for name, row in _run_with_progress(work, workers, progress):
        rows[name] = row
        _write_json(kept / f"{name}.json", {"key": key, "outcome": _to_json(row)})
    counted = tally([rows[name] for name in truths])
    result: dict[str, Any] = to_builtins({"output": str(folder), "seed": seed} | counted)
    _write_json(folder / "score.json", result | {"outcomes": [_to_json(rows[name]) for name in truths]})
    return result


def _to_json(row: Outcome) -> dict[str, Any]:
    """Outcome as JSON."""
    values: dict[str, Any] = to_builtins(asdict(row))
    return {"alike" if key == "equivalents" else key: value for key, value in values.items()}  # key in existing files


def _read_kept(path: Path, key: str) -> Outcome | None:
    """Stored outcome; None if there is none, or only one of other studies or another seed."""
    if not path.is_file():
        return None
    stored = json.loads(path.read_text(encoding="utf-8"))
    return read_outcome(stored["outcome"]) if stored["key"] == key else None


def _write_json(path: Path, value: Any) -> None:
    """Replace a JSON file atomically."""
    replace_text(path, json.dumps(value, indent=1, ensure_ascii=False))


def _run_with_progress(
    work: dict[str, partial[Any]], workers: int | None, progress: Progress
) -> Iterator[tuple[str, Any]]:
    """Yield names and results as they finish, and report the progress."""
    progress(0, len(work), "studies")
    for done, pair in enumerate(run_parallel(work, workers), 1):
        progress(done, len(work), "studies")
        yield pair
