"""Put a fault into the tables of a study or into the lines of its study file; one function per fault."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from reality.faults import Fault

Rows = NDArray[np.int64]
Array = NDArray[np.float64]
LONGEST_BURST = 4
OUTLIER_SHARE = (0.002, 0.02)  # share of the samples
FAULT_PLACE_SHARE = (0.05, 0.9)  # part of a run in which a doubled frame or a lost one is put: not where it rests
LENGTHS = ["x_m", "sigma_m", "y_m"]


@dataclass(frozen=True)
class Recorded:
    """The table of one run as it should be, its positions without noise (n,) m, and the noise, m."""

    data: pd.DataFrame
    clean: Array
    noise: float

    @property
    def interval(self) -> float:
        """Time between two frames, s."""
        return float(np.median(np.diff(self.data["t_s"])))


FaultyTable = tuple[pd.DataFrame, Rows]
Spoil = Callable[[Recorded, Fault, np.random.Generator], FaultyTable]
NO_ROWS: Rows = np.zeros(0, dtype=np.int64)


def with_fault(run: Recorded, name: str, fault: Fault, rng: np.random.Generator) -> tuple[pd.DataFrame, Fault]:
    """The table of a run with the fault in it, where it has one, and the fault with the frames concerned."""
    if name not in fault.runs or fault.kind not in TABLES:
        return run.data, fault
    data, rows = TABLES[fault.kind](run, fault, rng)
    louder = max(fault.louder, _louder(data, run, fault))
    return data, replace(fault, louder=louder, frames=fault.frames | {name: tuple(int(i) for i in rows)})


def _louder(data: pd.DataFrame, run: Recorded, fault: Fault) -> float:
    """Noise of a table over what it should be: of coloured noise at low frequencies, where slow effects are seen."""
    if fault.kind == "coloured":
        return float(np.sqrt((1 + fault.size) / (1 - fault.size)))
    if fault.kind == "quantised" or fault.variant == "samples on even stamps":
        return float(np.sqrt(np.mean((data["x_m"].to_numpy() - run.clean) ** 2))) / run.noise
    return 1.0


# --- tables


def outliers(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Samples that lie off by so many times the noise, each by its own amount, single or in bursts of 2 to 4."""
    n = len(run.data)
    count = max(1, round(n * float(rng.uniform(*OUTLIER_SHARE))))
    rows = np.zeros(0, dtype=np.int64)
    while len(rows) < count:
        length = 1 if fault.variant == "single" else int(rng.integers(2, LONGEST_BURST + 1))
        rows = np.union1d(rows, int(rng.integers(n - length + 1)) + np.arange(length))
    off = fault.size * run.noise * rng.uniform(0.7, 1.4, len(rows)) * rng.choice([-1.0, 1.0], len(rows))
    return _with(run.data, "x_m", _added(run.data["x_m"].to_numpy(), rows, off)), rows


def doubled(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Frames that show what the one before showed, put in (all later ones come late) or in place of their own."""
    rows = _chosen(len(run.data), fault, rng)
    source = np.arange(len(run.data))
    if fault.variant.endswith("in place"):
        for row in rows:  # in order: of three in a row all show the one before the first
            source[row] = source[row - 1]
        return _even(run.data, source), rows
    source = np.insert(source, rows, rows - 1)
    return _even(run.data, source), rows + np.arange(len(rows))


def missing(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Frames that are lost while the time stamps go on evenly."""
    rows = _chosen(len(run.data), fault, rng)
    return _even(run.data, np.delete(np.arange(len(run.data)), rows)), rows


def quantised(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Positions that an encoder rounds to steps of so many times the noise."""
    step = fault.size * run.noise
    return _with(run.data, "x_m", np.round(run.data["x_m"].to_numpy() / step) * step), NO_ROWS


def jitter(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Uneven stamps of even samples, uneven samples with their true stamps, or uneven samples on even stamps."""
    t, x = run.data["t_s"].to_numpy(), run.data["x_m"].to_numpy()
    late = fault.size * run.interval * rng.uniform(-np.sqrt(3), np.sqrt(3), len(t))
    if fault.variant == "stamps":
        return _with(run.data, "t_s", t + late), NO_ROWS
    moved = _with(run.data, "x_m", CubicSpline(t, run.clean)(t + late) + x - run.clean)
    return (_with(moved, "t_s", t + late) if fault.variant == "samples" else moved), NO_ROWS


def clock(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Time stamps that run fast or slow by a constant share."""
    return _with(run.data, "t_s", run.data["t_s"].to_numpy() * clock_factor(fault)), NO_ROWS


def clock_factor(fault: Fault) -> float:
    """Written time over true time; every second fault is slow."""
    return 1.0 + fault.size * (1 if round(1e6 * fault.size) % 2 else -1)


def coloured(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Noise of the stated size that an autoregressive process of order one makes instead of a white one."""
    white = rng.standard_normal(len(run.data) + 200)
    noise = lfilter([np.sqrt(1 - fault.size**2)], [1.0, -fault.size], white)[200:]
    return _with(run.data, "x_m", run.clean + run.noise * noise), NO_ROWS


def unit(run: Recorded, fault: Fault, rng: np.random.Generator) -> FaultyTable:
    """Lengths in mm, or times in ms, under the head of metres and seconds."""
    columns = {"x": LENGTHS, "t": ["t_s"]}[fault.variant]
    scaled = {name: run.data[name] * fault.size for name in columns if name in run.data}
    return run.data.assign(**scaled), NO_ROWS


TABLES: dict[str, Spoil] = {
    "outliers": outliers,
    "doubled": doubled,
    "missing": missing,
    "quantised": quantised,
    "jitter": jitter,
    "clock": clock,
    "coloured": coloured,
    "unit": unit,
}


def copied(run: Recorded, fault: Fault, rng: np.random.Generator) -> pd.DataFrame:
    """The recording once more: as it is, cut, with another origin of time and place, or with fewer digits."""
    data = run.data
    if fault.variant == "cut":
        n = round(fault.size * len(data))
        data = data.iloc[n // 2 : len(data) - n // 2]
    if fault.variant == "shifted":
        return data.assign(t_s=data["t_s"] + 0.25, x_m=data["x_m"] + 0.05)
    if fault.variant == "fewer digits":
        step = 10.0 ** np.floor(np.log10(run.noise))
        return data.assign(x_m=np.round(data["x_m"] / step) * step)
    return data


def _chosen(n: int, fault: Fault, rng: np.random.Generator) -> Rows:
    """One frame, three in a row, or a share of all, in the part of a run in which it moves."""
    low, high = (round(part * n) for part in FAULT_PLACE_SHARE)
    if not fault.variant.startswith("scattered"):
        return int(rng.integers(low, high)) + np.arange(1 if fault.variant.startswith("one") else 3)
    return np.sort(rng.choice(np.arange(low, high), max(2, round(fault.size * n)), replace=False))


def _even(data: pd.DataFrame, source: Rows) -> pd.DataFrame:
    """Rows of a table in another order on the even clock of the camera."""
    t = data["t_s"].to_numpy()
    return data.iloc[source].assign(t_s=t[0] + np.arange(len(source)) * (t[1] - t[0])).reset_index(drop=True)


def _with(data: pd.DataFrame, column: str, values: Array) -> pd.DataFrame:
    return data.assign(**{column: values})


def _added(x: Array, rows: Rows, off: Array) -> Array:
    out = x.copy()
    out[rows] += off
    return out


# --- the study file


def lines_with_fault(lines: list[str], fault: Fault) -> list[str]:
    """The study file with the fault in it, where it belongs there."""
    if fault.kind == "mass":
        return _masses(lines, fault)
    if fault.kind == "clock" and fault.variant == "stamps and fps":
        rate = next(float(line.split("=")[1]) for line in lines if line.startswith("fps"))
        return _in_runs(lines, fault.runs, f"fps = {rate / clock_factor(fault):.8g}")
    if fault.kind == "unit" and fault.variant == "scale":
        return [re.sub(r'mm/px"', 'm/px"', line) for line in lines]
    return lines


def _masses(lines: list[str], fault: Fault) -> list[str]:
    """Masses so many times too large: all of them, or that of one run."""
    factor = float(fault.variant)
    if fault.in_all:
        return [_scaled(line, factor) for line in lines]
    reference = next(line for line in lines if line.startswith("mass"))
    own = _block(lines, fault.runs[0])
    kept = [i for i in own if lines[i].startswith("mass")]
    wrong = _scaled(lines[kept[0]] if kept else reference, factor)
    if kept:
        return [wrong if i == kept[0] else line for i, line in enumerate(lines)]
    return _in_runs(lines, fault.runs, wrong)


def _scaled(line: str, factor: float) -> str:
    return f"mass = {float(line.split('=')[1]) * factor:.6g}" if line.startswith("mass") else line


def _block(lines: list[str], run: str) -> range:
    """Lines of a run, after its name."""
    first = lines.index(f'name = "{run}"') + 1
    return range(first, next((i for i in range(first, len(lines)) if lines[i].startswith("[")), len(lines)))


def _in_runs(lines: list[str], runs: tuple[str, ...], more: str) -> list[str]:
    """One line more in some runs."""
    heads = {f'name = "{run}"' for run in runs}
    return [part for line in lines for part in ((line, more) if line in heads else (line,))]
