"""Run a sparse-regression peer, PySINDy, on the same data; run by a Python that has it:

    python sparse.py < cases.npz > shares.json

    python -m venv peers && peers/bin/pip install pysindy

Force is the smoothed m a of the same front end; the dictionary holds the law's terms, and every effect of the list at
its true setting (both quadratures of a wave), which is generous. Terms are scaled to one. The threshold of its
sequentially thresholded least squares is where 99 of 100 studies with nothing hidden keep no term beside the law's.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

Array = Any
KEPT_FRAME_STEP = 5  # every so many frames, as neighbours of a filtered force say the same
ALPHA = 0.01


# --- here: cases


def case(truth: Any, rng: np.random.Generator, forms: dict[str, dict[str, float]]) -> tuple[Array, Array]:
    """Dictionary (n, K) and force (n,) of one recorded study."""
    from diagnosis.studies import recorded  # noqa: PLC0415

    rows, right = [], []
    for run in recorded(truth, rng):
        m = run.motion
        keep = np.flatnonzero(np.abs(m.v) > 0.1)[20:-20:KEPT_FRAME_STEP]
        rows.append(_terms(run, keep, truth, forms))
        right.append(-run.mass * m.a[keep])
    return np.vstack(rows), np.concatenate(right)


def _terms(run: Any, keep: Array, truth: Any, forms: dict[str, dict[str, float]]) -> Array:
    """The law's terms, then every effect's."""
    from frictrack import effects  # noqa: PLC0415

    m, ratio = run.motion, run.mass / truth.mass
    s = np.full(len(keep), np.sign(np.median(m.v)))
    path = effects.Path(
        m.t[keep] - m.t[0], m.x[keep], m.v[keep], s, ratio, ratio, run.displacement.pixel_pitch, mass=run.mass
    )
    law = truth.base.force_columns(path, truth.law)
    out = [np.column_stack([law[n] for n in truth.model])]
    dry = law["coulomb"] * truth.law["coulomb"]["F_c"] + law["stribeck"] * truth.law["stribeck"]["F_s"]
    viscous = law["viscous"] * truth.law["viscous"]["F_v"]
    for name, at in forms.items():
        effect = effects.get(name)
        inner = viscous if "viscous" in effect.modifies else dry
        phases = [p.name for p in effect.parameters if p.role == "phase"]
        for q in (0.0, np.pi / 2) if phases else (0.0,):
            own = {p.name: p.fixed or 1.0 for p in effect.parameters} | at | dict.fromkeys(phases, q)
            made = effect.columns(path, own, inner) - inner if effect.modifies else effect.columns(path, own)
            out.append(made[:, :1])
    return np.hstack(out)


def owners(forms: Iterable[str]) -> list[str]:
    """Which effect every column after the law's belongs to."""
    from frictrack import effects  # noqa: PLC0415

    return [n for n in forms for _ in range(2 if any(p.role == "phase" for p in effects.get(n).parameters) else 1)]


def ask(python: str, cases: list[tuple[Array, Array]], law: int, threshold: float | None) -> dict[str, Any]:
    """What the peer finds: the smallest threshold without false alarms, or which terms it keeps of every case."""
    buffer = io.BytesIO()
    arrays = {f"a{i}": a for i, (a, _) in enumerate(cases)} | {f"y{i}": y for i, (_, y) in enumerate(cases)}
    np.savez(buffer, law=law, threshold=np.nan if threshold is None else threshold, **arrays)
    done = subprocess.run([python, Path(__file__)], input=buffer.getvalue(), capture_output=True, check=True)
    return dict(json.loads(done.stdout))


# --- there: the peer


def kept(optimizer: Any, a: Array, y: Array, law: int) -> list[int]:
    """Columns beside the law's that are kept."""
    norm = np.linalg.norm(a, axis=0)
    norm[norm == 0] = 1.0
    optimizer.fit(a / norm, (y / np.linalg.norm(y))[:, None])
    return [int(k) - law for k in np.flatnonzero(np.abs(optimizer.coef_[0]) > 0) if k >= law]


def main() -> None:
    import warnings  # noqa: PLC0415

    import pysindy  # noqa: PLC0415

    warnings.simplefilter("ignore")
    given = np.load(io.BytesIO(sys.stdin.buffer.read()))
    law, threshold = int(given["law"]), float(given["threshold"])
    cases = [(given[f"a{i}"], given[f"y{i}"]) for i in range(sum(k[0] == "a" for k in given.files))]

    def found(at: float) -> list[list[int]]:
        return [kept(pysindy.STLSQ(threshold=at, alpha=1e-10, max_iter=50), a, y, law) for a, y in cases]

    if np.isnan(threshold):
        steps = np.geomspace(1e-4, 1.0, 60)
        clean = [at for at in steps if np.mean([bool(k) for k in found(at)]) <= ALPHA]
        sys.stdout.write(json.dumps({"threshold": float(min(clean, default=1.0)), "version": pysindy.__version__}))
    else:
        sys.stdout.write(json.dumps({"kept": found(threshold)}))


if __name__ == "__main__":
    main()
