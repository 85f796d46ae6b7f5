"""Run many studies side by side: on the processors of this machine, or on the workers of a Dask cluster.

    from frictrack.flow.batch import batch
    result = batch(["campaign/"], Path("frictrack_batch"))

A run that fails never stops the others; it is listed with its reason. A study that was finished before and has not
changed since is not computed again.

    frictrack_batch.csv, .parquet    one row per run
    frictrack_batch.html             the page
    .frictrack/frictrack_batch.jsonl the journal of finished studies

Trends follow the order in which the user named the studies. A value y_i with standard deviation s_i varies from study
to study by more than s_i:

    y_i = a + b i + u_i + e_i,   u_i ~ N(0, tau^2),   e_i ~ N(0, s_i^2)

tau is the value at which the weighted sum of squares equals its expectation n - 2, and b is tested by Student's t with
n - 2 degrees of freedom.

References
----------
Paule & Mandel (1982), J. Res. NBS 87, 377 (tau, here with a slope).

"""

from __future__ import annotations

import glob
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from frictrack.base import __version__
from frictrack.base.distributions import student_sf
from frictrack.base.errors import FrictrackError, UsageError, os_errors_as
from frictrack.base.files import append_line, atomic_write, make_internal_folder
from frictrack.base.number_format import format_plus_minus
from frictrack.base.workers import local_workers
from frictrack.fit import CovariateTrend, CovariateTrends, ParameterEstimates, trend
from frictrack.flow.batch.tasks import BatchState, Scheduler, StudyOutcome, are_unchanged, cluster_workers
from frictrack.present.report import write_campaign
from frictrack.records import Array
from frictrack.results import to_builtins
from frictrack.settings.priors import Prior

MIN_POINTS = 4  # needed to fit a slope
MIN_VARIANCE = 1e-12  # of values without a deviation, over their spread
ALPHA = 0.01  # for all trends over the series together, and for those over all conditions
DRAWN = ("at", "value", "std")  # keys of a trend that only the page draws: positions, values, standard deviations
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*")
Condition = tuple[float | str, str]  # value and unit; a category has no unit


def find_trends(outcomes: Sequence[StudyOutcome]) -> list[dict[str, Any]]:
    """Test every parameter, the noise and the friction level for a trend; return the JSON of each, with `DRAWN`.

    Its p-value is multiplied by the number of trends (Bonferroni).
    """
    first = [next((row for row in one.rows if row.get("verdict")), {}) for one in outcomes]
    units = {name: unit for one in outcomes for name, unit in one.units.items()}
    found = [_trend(name, unit, _column(first, name), _deviations(first, name)) for name, unit in units.items()]
    noise = [_mean(_column(one.rows, "noise_um")) for one in outcomes]
    found.append(_trend("noise of the displacement", "µm", np.array(noise)))
    fitted = [row for one in outcomes for row in one.rows if row.get("role") == "fit"]
    found.append(_trend("friction level of the run", "1", _column(fitted, "level"), axis="run"))
    known = [one for one in found if one is not None]
    return [one | {"p": (p := min(1.0, one["p"] * len(known))), "holds": p < ALPHA} for one in known]


def _deviations(rows: Sequence[dict[str, Any]], name: str) -> Array:
    """Return standard deviations of a parameter; if the model was rejected, those that include the misfit."""
    wider = _column(rows, f"{name} std_misfit")
    return np.where(np.isfinite(wider), wider, _column(rows, f"{name} std"))


def _trend(name: str, unit: str, y: Array, s: Array | None = None, axis: str = "study") -> dict[str, Any] | None:
    """Return the trend of values y (n,) with standard deviations s (n,); None for too few values or a constant.

    Positions `at` in the series count from 1; `change` is that from the first to the last of them.
    """
    known = np.isfinite(y)
    if np.count_nonzero(known) < MIN_POINTS or np.ptp(y[known]) == 0.0:
        return None
    s = np.full(len(y), np.nan) if s is None else s
    at, y, s = np.flatnonzero(known).astype(np.float64) + 1.0, y[known], s[known]
    slope, slope_std, scatter, p = fit_slope(at, y, np.nan_to_num(s))
    found = {"n": len(at), "name": name, "unit": unit, "along": axis, "slope": slope, "slope_std": slope_std}
    found |= {"change": slope * np.ptp(at), "change_std": slope_std * np.ptp(at), "scatter": scatter, "p": p}
    return found | {"at": at, "value": y, "std": s}


def fit_slope(at: Array, y: Array, s: Array) -> tuple[float, float, float, float]:
    """Fit a straight line to values that scatter by more than their standard deviations.

    References
    ----------
    Paule & Mandel (1982), J. Res. NBS 87, 377.

    Examples
    --------
    >>> slope, _, tau, p = fit_slope(np.arange(6.0), np.array([0.0, 1.1, 1.9, 3.0, 4.1, 5.0]), np.full(6, 0.1))
    >>> round(slope, 2), tau, p < 0.001
    (1.0, 0.0, True)

    """
    unit, spread = float(np.std(y)) or 1.0, float(np.std(at))
    rows = np.column_stack([np.ones(len(y)), (at - np.mean(at)) / spread])
    seen = ParameterEstimates((y - np.mean(y)) / unit, (s / unit) ** 2 + MIN_VARIANCE, rows)
    tau = seen.scatter_of(seen.degrees)  # the sum of squares equals its expectation
    b, covariance, _ = seen.at_scatter(tau)
    deviation = float(np.sqrt(covariance[1, 1]))
    p = float(2.0 * student_sf(abs(b[1]) / deviation, seen.degrees))
    return float(b[1]) * unit / spread, deviation * unit / spread, tau * unit, p


def _column(rows: Sequence[Mapping[str, Any]], key: str) -> Array:
    """Return the numbers of a column (n,), NaN where there are none."""
    found = (row.get(key) for row in rows)
    return np.array([value if isinstance(value, int | float) else np.nan for value in found], dtype=np.float64)


def _mean(values: Array) -> float:
    """Return the mean of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else np.nan


def read_condition(raw: float | str) -> Condition:
    """Read a condition: a number, a number with a unit, or the name of a category.

    Examples
    --------
    >>> read_condition("20 degC"), read_condition(3), read_condition("steel on brass")
    ((20.0, 'degC'), (3.0, ''), ('steel on brass', ''))

    """
    if not isinstance(raw, str):
        return float(raw), ""
    found = _QUANTITY.fullmatch(raw)
    return (float(found[1]), found[2]) if found else (raw.strip(), "")


def condition_trends(outcomes: Sequence[StudyOutcome]) -> list[dict[str, Any]]:
    """Fit the trends over every condition that studies state.

    A study takes part if it states the condition and has a law of its own: fitted without the prior of another study,
    with the model that most of these studies have.
    """
    names = list(dict.fromkeys(name for one in outcomes for name in one.conditions))
    entries = [_entry(name, outcomes) for name in names]
    count = max(sum(len(entry["trends"]) for entry in entries), 1)
    for entry in entries:
        for one in entry["trends"]:
            one["holds"] = one["p"] * count < ALPHA
    return entries


def _entry(name: str, outcomes: Sequence[StudyOutcome]) -> dict[str, Any]:
    """Return the JSON of one condition."""
    stated = [(one, read_condition(one.conditions[name])) for one in outcomes if name in one.conditions and one.law]
    laws = [Prior.from_toml(one.law, one.study) for one, _ in stated]
    usual = Counter(law.model for law in laws).most_common(1)
    same = [i for i, law in enumerate(laws) if law.model == usual[0][0]]
    left_out = [one.study for one in outcomes if name in one.conditions]
    used = [stated[i][0].study for i in same]
    unit = stated[same[0]][1][1] if same else ""
    head = {"condition": name, "unit": unit, "studies": used, "left_out": [s for s in left_out if s not in used]}
    units = {stated[i][1][1] for i in same}
    try:
        if len(units) > 1:
            raise FrictrackError(f"expected one unit of {name} but got {', '.join(sorted(units))}")
        found = trend([laws[i] for i in same], [stated[i][1][0] for i in same], name)
    except FrictrackError as e:
        return {**head, "load": None, "trends": [], "reason": str(e), "words": [f"no trend over {name}: {e}"]}
    trends = [one.summary() for one in found.trends.values()]
    return {**head, "load": found.load, "trends": trends, "reason": None, "words": list(_words(found, unit))}


def _words(found: CovariateTrends, unit: str) -> Iterator[str]:
    """Yield one sentence per parameter."""
    for name, one in found.trends.items():
        own = "" if one.unit == "1" else f" {one.unit}"
        scatter = f"scatter between studies {one.scatter:.2g}{own}, p = {one.p:.2g}"
        yield f"over {found.condition}, {name} {_change(one, own, unit)}; {scatter}"
    if found.load is not None:
        yield f"forces of these trends belong to a load of {found.load:.4g} N"


def _change(one: CovariateTrend, own: str, unit: str) -> str:
    """Return the slope, or the value of every category."""
    found = zip(one.terms, one.coefficients, one.std, strict=True)
    rows = {term: f"{format_plus_minus(float(value), float(std))}{own}" for term, value, std in found}
    if one.origin is not None:
        return f"changes by {rows['slope']} per {unit or 'unit'}"
    return "is " + ", ".join(f"{value} ({term})" for term, value in rows.items())


FIRST_COLUMNS = ("study", "run", "role", "verdict", "missing", "reason", "model", "domain")  # of the table of runs


def batch(
    patterns: Sequence[str],
    stem: Path,
    seed: int = 0,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    watch: Callable[[BatchState], None] = lambda state: None,
) -> dict[str, Any]:
    """Run every study that is not finished, and write tables, page and journal: JSON of `frictrack batch`.

    Parameters
    ----------
    patterns
        Study files, folders and globs.
    stem
        Path of the output files without suffix.
    seed
        Seed of the diagnoses.
    workers
        Number of processes of this machine; as many as there are processors if None.
    scheduler
        Address of a Dask scheduler, whose workers are used instead.
    watch
        Called several times a second with the state of the batch.

    Raises
    ------
    FrictrackError
        (usage) If a pattern matches no study, or no scheduler answers.

    """
    paths = find_studies(patterns)
    labels = {path.resolve(): path for path in paths}
    journal = Journal(make_internal_folder(stem.parent) / f"{stem.name}.jsonl")
    outcomes = journal.finished(labels, seed)
    state = BatchState(len(labels), kept=len(outcomes))
    todo = [path for path in labels if path not in outcomes]
    if todo:
        with cluster_workers(scheduler) if scheduler else local_workers(workers) as pool:
            for one in Scheduler(todo, seed, pool, state).run(watch):
                journal.append(one)
                outcomes[Path(one.study)] = one
    return _write_results(stem, [(label, outcomes[path]) for path, label in labels.items() if path in outcomes], state)


def _write_results(stem: Path, done: Sequence[tuple[Path, StudyOutcome]], state: BatchState) -> dict[str, Any]:
    """Write tables and page of the studies, each as the user named it; return the JSON of `batch`."""
    outcomes = [one for _, one in done]
    rows = [{"study": str(label), **row} for label, one in done for row in one.rows]
    files = write_table(rows, stem, {name: unit for one in outcomes for name, unit in one.units.items()})
    studies = [{"study": str(label), **one.summary} for label, one in done]
    found = find_trends(outcomes)
    result: dict[str, Any] = to_builtins(
        {
            "studies": studies,
            "failed": [{"study": str(label), **failure} for label, one in done for failure in one.failures],
            "kept": state.kept,
            "seconds": state.seconds,
            "runs_per_minute": 60.0 * state.runs / max(state.seconds, 1e-9),
            "verdicts": dict(Counter(one["verdict"] for one in studies if not one["reason"])),
            "trends": [{key: value for key, value in one.items() if key not in DRAWN} for one in found],
            "conditions": condition_trends(outcomes),
            "tables": [str(path) for path in files],
        }
    )
    folder = stem.resolve().parent
    results = {str(label): Path(one.summary["results"]) for label, one in done if one.summary.get("results")}
    reports = {name: Path(os.path.relpath(own / "report.html", folder)).as_posix() for name, own in results.items()}
    page = write_campaign(result, found, reports, stem.with_name(f"{stem.name}.html"))
    return result | {"output": str(page)}


def find_studies(patterns: Sequence[str]) -> list[Path]:
    """Find study files, each once, with numbers in names in numerical order (``run_9`` before ``run_10``).

    Parameters
    ----------
    patterns
        Study files, folders (searched with their subfolders) and globs.

    Raises
    ------
    FrictrackError
        (usage) If a pattern matches no study file.

    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        matches = glob.glob(pattern, recursive=True) or [pattern]
        found_here = (path.rglob("study.toml") if path.is_dir() else [path] for path in map(Path, matches))
        studies = [study for each in found_here for study in each if study.exists()]
        if not studies:
            raise UsageError(f"expected study files in {pattern} but found none")
        found |= dict.fromkeys(sorted(studies, key=_natural))
    return list(found)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sorting key by which numbers in a path count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]


class Journal:
    """A file of JSON lines that is only appended to; an incomplete last line is ignored."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def finished(self, studies: Iterable[Path], seed: int) -> dict[Path, StudyOutcome]:
        """Return the studies whose files have not changed since this version finished them with this seed."""
        outcomes = self._lines()
        kept = ((path, outcomes.get(str(path))) for path in studies)
        return {path: done for path, done in kept if done and done.seed == seed and are_unchanged(done.files)}

    def append(self, done: StudyOutcome) -> None:
        """Append the outcome of a study."""
        line = json.dumps({"version": __version__, **asdict(done)}, ensure_ascii=False)
        with os_errors_as(f"cannot write {self.path}", "what was finished before is kept"):
            append_line(self.path, line)

    def _lines(self) -> dict[str, StudyOutcome]:
        """Return the last outcome of every study that this version has written."""
        with os_errors_as(f"cannot read {self.path}"):
            lines = self.path.read_bytes().split(b"\n") if self.path.exists() else []
        outcomes = {}
        for line in lines:
            try:
                raw = json.loads(line)
                if raw.pop("version") == __version__:
                    outcomes[raw["study"]] = StudyOutcome(**raw)
            except (ValueError, TypeError, KeyError, AttributeError):
                continue  # incomplete or not ours: the study is run again
        return outcomes


def make_table(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the rows as a table; missing values are empty."""
    names = list(dict.fromkeys([*FIRST_COLUMNS, *(name for row in rows for name in row)]))
    table = pd.DataFrame(list(rows), columns=names)
    for name in FIRST_COLUMNS:
        table[name] = table[name].astype("string")
    return table


def write_table(rows: Sequence[dict[str, Any]], stem: Path, units: Mapping[str, str]) -> list[Path]:
    """Write ``stem.csv`` and, if pyarrow is installed, ``stem.parquet`` with the units of the columns as attributes."""
    table = make_table(rows)
    paths = [stem.with_name(f"{stem.name}.csv")]
    with atomic_write(paths[0]) as part:
        table.to_csv(part, index=False)
    if find_spec("pyarrow") is not None:
        paths.append(stem.with_name(f"{stem.name}.parquet"))
        with atomic_write(paths[1]) as part:
            kinds = ("", " std", " std_misfit")
            table.attrs["units"] = {f"{name}{kind}": unit for name, unit in units.items() for kind in kinds}
            table.to_parquet(part, index=False)
    return paths
