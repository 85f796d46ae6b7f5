"""Compare the first formula with genetic programming (gplearn) on the same residual force, at equal CPU.

Both are judged by their values along the runs, with the law (friction level of every run, viscous friction) projected
out: the form is right if the cause's own form fits these values within `MAX_FORM_ERROR`; the force is right if it
agrees with the hidden force within `MAX_FORCE_ERROR`.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import frictrack as ft
from formulas.causes import CAUSES, Cause
from formulas.studies import Sealed
from frictrack.effects import definitions, read_settings
from frictrack.records import Array

MAX_FORM_ERROR = 0.05  # relative rms difference
MAX_FORCE_ERROR = 0.2
N_STARTS = 5  # per parameter of a cause
FRAME_STEP = 4  # of the frames that gplearn sees: their noise is correlated by the smoother over more
Named = Mapping[str, Array]


def has_gplearn(python: str) -> bool:
    """Whether a Python interpreter has gplearn."""
    return subprocess.run([python, "-c", "import gplearn"], capture_output=True, check=False).returncode == 0


def compared(sealed: Sealed, fit: Any, formulas: Sequence[Mapping[str, Any]], seconds: float, python: str) -> Any:
    """Errors of the first formula and of gplearn's expression, found with `seconds` of CPU."""
    along = _along(sealed)
    cause = CAUSES[sealed.name]
    basis = np.linalg.qr(along["law"])[0]
    truth = sealed.values["F"] * _force(cause, along, sealed.values)
    out = {}
    if formulas:
        out["frictrack"] = _judged(_formula_force(fit, formulas[0], along), truth, cause, along, basis)
    found = _gplearn(along, seconds, sealed, python)
    made = np.array(found.pop("force"))
    out["gplearn"] = found | _judged(made, truth, cause, along, basis)
    return out


def _along(sealed: Sealed) -> dict[str, Array]:
    """Motion and force of all runs, concatenated."""
    parts: dict[str, list[Array]] = {key: [] for key in ("x", "v", "t", "s", "L", "mass", "force", "run")}
    for k, run in enumerate(sealed.runs):
        m = run.motion
        keep = slice(FRAME_STEP, -FRAME_STEP, FRAME_STEP)
        one = np.ones(len(m.t[keep]))
        parts["x"].append(m.x[keep])
        parts["v"].append(m.v[keep])
        parts["t"].append(m.t[keep] - m.t[0])
        parts["s"].append(np.sign(m.v[keep]))
        parts["L"].append(one * float(run.mass) / float(sealed.runs[0].mass))
        parts["mass"].append(one * float(run.mass))
        parts["force"].append(-float(run.mass) * m.a[keep])
        parts["run"].append(one * k)
    along = {key: np.concatenate(values) for key, values in parts.items()}
    levels = [(along["run"] == k) * along["s"] for k in range(len(sealed.runs))]
    return along | {"law": np.column_stack([*levels, along["v"]])}


def _force(cause: Cause, along: Named, values: Mapping[str, float]) -> Array:
    return np.asarray(cause.force(along["x"], np.abs(along["v"]), along["t"], along["s"], along["L"], values))


def _formula_force(fit: Any, formula: Mapping[str, Any], along: Named) -> Array:
    """Force of a formula with its values after it was added and fitted; zero if it cannot be."""
    (effect,) = definitions([read_settings(table) for table in tomllib.loads(formula["toml"])["effect"]])
    try:
        after = ft.fit(fit.model + effect, fit.runs).solution
    except ft.FrictrackError:
        return np.zeros_like(along["x"])
    values = after.problem.layout.values(after.p, 0)[0][effect.name]
    functions = {name: getattr(np, name) for name in ("exp", "log", "sqrt", "tanh", "sin", "cos", "abs")}
    names = {**functions, "atan": np.arctan, "pi": np.pi, **along, **values}
    text = formula["form"].replace("^", "**")
    return np.asarray(eval(text, {"__builtins__": {}}, names)) + np.zeros_like(along["x"])


def _gplearn(along: Named, seconds: float, sealed: Sealed, python: str) -> dict[str, Any]:
    """The expression that gplearn finds in the same force."""
    names = ("x", "speed", "t", "s", "L")
    features = np.column_stack([along["x"], np.abs(along["v"]), along["t"], along["s"], along["L"]])
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "in.npz", Path(folder) / "out.json"
        table = {"features": features, "force": along["force"], "law": along["law"], "names": np.array(names)}
        np.savez(given, seconds=seconds, seed=sum(map(ord, sealed.name)), **table)  # type: ignore[arg-type]
        worker = Path(__file__).with_name("gplearn_worker.py")
        done = subprocess.run([python, str(worker), str(given), str(made)], capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr)
        found: dict[str, Any] = json.loads(made.read_text(encoding="utf-8"))
    return found


def _judged(made: Array, truth: Array, cause: Cause, along: Named, basis: Array) -> dict[str, Any]:
    """Whether a force has the form and the values of the cause, beside the law."""

    def beside(force: Array) -> Array:
        return np.asarray(force - basis @ (basis.T @ force))

    left, hidden = beside(made), beside(truth)
    if not np.all(np.isfinite(left)) or not left @ left > 1e-9 * (hidden @ hidden):
        return {"form_error": None, "force_error": None, "form": False, "values": False}
    form = _form_error(left, cause, along, beside)
    scaled = left * float(left @ hidden) / float(left @ left)  # gplearn's fitness leaves the coefficient free
    force = float(np.linalg.norm(scaled - hidden) / np.linalg.norm(hidden))
    return {
        "form_error": form,
        "force_error": force,
        "form": form < MAX_FORM_ERROR,
        "values": force < MAX_FORCE_ERROR,
    }


def _form_error(left: Array, cause: Cause, along: Named, beside: Any) -> float:
    """Smallest relative difference between a force and the form of the cause, with free parameters."""
    names = list(cause.draws or {})
    u = {"x": along["x"], "v": np.abs(along["v"]), "t": along["t"]}[cause.axis]
    low, span = float(u.min()), float(np.ptp(u))

    def remaining(z: Array) -> Array:
        values = {q: low + a * span if q == "c" else float(np.exp(a)) * span for q, a in zip(names, z, strict=True)}
        column = beside(_force(cause, along, values))
        return np.asarray(left - column * float(column @ left) / max(float(column @ column), 1e-300))

    if not names:
        return float(np.linalg.norm(remaining(np.zeros(0))) / np.linalg.norm(left))
    grids = [
        np.linspace(0.05, 0.95, N_STARTS) if q == "c" else np.log(np.geomspace(0.01, 3.0, N_STARTS)) for q in names
    ]
    starts = sorted(product(*grids), key=lambda z: float(np.sum(remaining(np.array(z)) ** 2)))[:3]
    found = min(float(np.sum(least_squares(remaining, z, max_nfev=50).fun ** 2)) for z in starts)
    return float(np.sqrt(found) / np.linalg.norm(left))
