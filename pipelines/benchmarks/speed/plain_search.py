"""Search the library as a plain NumPy script does: every effect on its whole grid, with 999 draws of the noise.

This is the reference of the timing. It knows the measured motion, the columns of the effects and their grids, and
nothing else: white noise, least squares beside the model's own columns, no levels of friction, no refinement.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.effects import LIBRARY, Effect, Path, Span
from frictrack.fit.linearised import scan_points
from frictrack.records import Array, Run

DRAWS = 999


def plain_search(model: Sequence[str], runs: Sequence[Run], seed: int = 0) -> list[tuple[str, float, float]]:
    """Scan every effect that these runs can show.

    Parameters
    ----------
    model
        Effects of the fitted model.
    runs
        Recorded runs.
    seed
        Of the draws.

    Returns
    -------
    list of tuple
        Effect, its best gain in chi-squared, and its p-value over the whole search; best first.

    """
    paths = [_path(run, runs[0]) for run in runs]
    base = np.concatenate([_response(runs, paths, LIBRARY[name], {"v_s": 0.35, "delta": 1.0}) for name in model])
    basis = np.linalg.qr(np.concatenate([base, _starts(paths)]).T)[0]
    data = np.concatenate([r.displacement.x / r.displacement.sigma_x for r in runs])
    noise = np.random.default_rng(seed).standard_normal((len(data), DRAWS))
    series = np.column_stack([data, noise])
    series -= basis @ (basis.T @ series)
    best: dict[str, Array] = {}
    for effect in LIBRARY.values():
        if effect.name in model or effect.needs or effect.modifies or effect.memory:
            continue
        for point in scan_points(effect, _span(paths)):
            gains = _gain(runs, paths, effect, point, (basis, series))
            best[effect.name] = np.maximum(best.get(effect.name, np.zeros(DRAWS + 1)), gains)
    largest = np.max([gains[1:] for gains in best.values()], axis=0)
    rows = [(name, float(g[0]), float((1 + np.sum(largest >= g[0])) / (1 + DRAWS))) for name, g in best.items()]
    return sorted(rows, key=lambda row: -row[1])


def _gain(
    runs: Sequence[Run], paths: Sequence[Path], effect: Effect, point: dict[str, float], of: tuple[Array, Array]
) -> Array:
    """Fall of chi-squared (D,) by one effect at one point of its grid; both quadratures of a wave."""
    basis, series = of
    phases = [p.name for p in effect.parameters if p.role == "phase"]
    quadratures = [dict.fromkeys(phases, q) for q in (0.0, np.pi / 2)] if phases else [{}]
    rows = np.concatenate([_response(runs, paths, effect, point | q) for q in quadratures])
    rows = rows - (rows @ basis) @ basis.T
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = np.linalg.qr((rows / np.where(size > 0, size, 1.0)).T)[0]
    return np.asarray(np.square(rows.T @ series).sum(axis=0))


def _response(runs: Sequence[Run], paths: Sequence[Path], effect: Effect, point: dict[str, float]) -> Array:
    """Displacement over the noise, (k, N), under each column of an effect, integrated along the measured motion."""
    parts = []
    for run, path in zip(runs, paths, strict=True):
        columns = effect.columns(path, point).T
        if effect.acts_on == "force":
            dt = np.gradient(path.t)
            columns = np.cumsum(np.cumsum(columns * dt, axis=1) * dt, axis=1) / run.mass
        parts.append(columns / run.displacement.sigma_x)
    return np.concatenate(parts, axis=1)


def _starts(paths: Sequence[Path]) -> Array:
    """Start position and velocity of every run, (2 R, N)."""
    ends = np.cumsum([0, *(len(p.t) for p in paths)])
    rows = np.zeros((2 * len(paths), ends[-1]))
    for i, path in enumerate(paths):
        rows[2 * i, ends[i] : ends[i + 1]] = 1.0
        rows[2 * i + 1, ends[i] : ends[i + 1]] = path.t
    return rows


def _path(run: Run, reference: Run) -> Path:
    motion = run.motion
    assert motion is not None
    sign = np.full(len(motion.t), np.sign(np.mean(motion.v)))
    ratio = run.mass / reference.mass
    return Path(
        motion.t - motion.t[0],
        motion.x,
        motion.v,
        sign,
        load=ratio,
        mass_ratio=ratio,
        pixel_pitch=run.displacement.pixel_pitch,
        mass=run.mass,
    )


def _span(paths: Sequence[Path]) -> Span:
    speeds = np.concatenate([np.abs(p.v) for p in paths])
    places = np.concatenate([p.x for p in paths])
    return Span(
        duration=max(p.t[-1] for p in paths),
        x_min=float(places.min()),
        x_max=float(places.max()),
        v_min=float(np.quantile(speeds, 0.01)),
        v_max=float(speeds.max()),
        fps=float(1 / np.median(np.diff(paths[0].t))),
    )
