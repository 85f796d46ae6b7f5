"""Run the cases whose outputs are stored: commands with `--json`, blind studies, small benchmarks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[3]
FPS = 4000.0
MASS = 0.35  # kg
COMMANDS = ("run", "motion", "friction", "fit", "compare", "diagnose", "add", "history", "remove", "plan", "verify")


def called(*command: str, where: Path) -> str:
    """Return what a command prints on stdout.

    Raises RuntimeError with the end of its stderr where it fails.
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, *command], cwd=where, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")
    return done.stdout


def frictrack(*arguments: str, where: Path) -> Any:
    """Return the JSON that a command of frictrack prints."""
    return json.loads(called("-m", "frictrack", *arguments, "--json", where=where))


def benchmark(name: str, *arguments: str, where: Path) -> Any:
    """Return the JSON that a benchmark writes."""
    target = where / f"{name}.json"
    called(str(ROOT / "pipelines" / "benchmarks" / name), *arguments, "--json", str(target), where=where)
    return json.loads(target.read_text(encoding="utf-8"))


def _commands(where: Path, effect: str) -> dict[str, Any]:
    """Return the JSON of every command of the loop, one after the other on the same study."""
    more = {"add": (effect,), "remove": (effect,)}
    out = {name: frictrack(name, "study.toml", *more.get(name, ()), where=where) for name in COMMANDS}
    frictrack("export", "study.toml", where=where)
    tables = sorted(where.rglob("*.csv"))
    out["export"] = {path.name: path.read_text(encoding="utf-8").splitlines()[:20] for path in tables}
    return out


def tables(where: Path) -> Any:
    """Three slides under Coulomb and viscous friction (closed form, 10 um of noise); the study leaves viscous out."""
    rng = np.random.default_rng(1)
    t = np.arange(500) / FPS
    decay = 0.4 / MASS
    text = f'[study]\nname = "tables"\nmass = "{MASS} +/- 0.002 kg"\nmodel = ["coulomb"]\n'
    for name, v0 in {"slow": 2.0, "middle": 3.0, "fast": 3.5}.items():
        x = (v0 + 1.2 / 0.4) / decay * (1 - np.exp(-decay * t)) - 1.2 / 0.4 * t
        rows = np.c_[t, x + 10e-6 * rng.normal(size=len(t))]
        np.savetxt(where / f"{name}.csv", rows, delimiter=",", header="t_s,x_m", comments="")
        text += f'\n[[run]]\nname = "{name}"\ntable = "{name}.csv"\n'
    (where / "study.toml").write_text(text, encoding="utf-8")
    return _commands(where, "viscous") | {"effects": frictrack("effects", where=where)}


def measured(where: Path) -> Any:
    """Two records of measured friction, a Stribeck curve over a ramp of the speed; the study is Coulomb friction."""
    rng = np.random.default_rng(2)
    t = np.arange(600) / 200.0
    text = '[study]\nname = "measured"\nmodel = ["coulomb"]\n'
    for name, v1 in {"first": 0.6, "second": 0.4}.items():
        v = 0.02 + v1 * t / t[-1]
        force = 1.2 + 0.8 * np.exp(-((v / 0.1) ** 2)) + 0.5 * v + 0.01 * rng.normal(size=len(t))
        x = np.cumsum(v) / 200.0
        header = "t_s,x_m,friction_N"
        np.savetxt(where / f"{name}.csv", np.c_[t, x, force], delimiter=",", header=header, comments="")
        text += f'\n[[run]]\nname = "{name}"\ntable = "{name}.csv"\n'
    (where / "study.toml").write_text(text, encoding="utf-8")
    names = ("run", "fit", "compare", "diagnose")
    return {name: frictrack(name, "study.toml", where=where) for name in names}


def films(where: Path) -> Any:
    """The sample films from the track to the force, and a fit."""
    shutil.copytree(ROOT / "sample_videos", where, dirs_exist_ok=True)
    return {name: frictrack(name, "study.toml", where=where) for name in ("track", "motion", "friction", "fit")}


def demo(where: Path) -> Any:
    """The demo, and every command of the loop on its study."""
    return frictrack("demo", where=where)


def blind(where: Path) -> Any:
    """Seven blind studies, one of each kind at least, and their score."""
    frictrack("blind", "make", "out", "--n", "7", "--seed", "5", where=where)
    score = frictrack("blind", "score", "out", "--workers", "1", where=where)
    outcomes = {p.name: json.loads(p.read_text("utf-8")) for p in sorted((where / "out" / "outcomes").glob("*.json"))}
    return {"score": score, "outcomes": outcomes}


def reality(where: Path) -> Any:
    """Four studies of real records' faults."""
    return benchmark("reality", "--n", "4", "--seed", "3", "--workers", "1", "--folder", "out", where=where)


def derivatives(where: Path) -> Any:
    """The derivatives of two records."""
    chosen = ("--signals", "vib,coll", "--noises", "10", "--seeds", "1", "--methods", "frictrack", "--no-peers")
    return benchmark("derivatives", *chosen, where=where)


def tracking(where: Path) -> Any:
    """One rendered film followed."""
    chosen = ("--seeds", "1", "--frames", "80", "--conditions", "nominal", "--no-peers", "--no-speed")
    return benchmark("tracking", *chosen, where=where)


def identification(where: Path) -> Any:
    """Five fits of one slide."""
    chosen = ("--only", "accuracy", "--scenes", "tustin", "--noises", "10", "--seeds", "5", "--beside", "1")
    return benchmark("identification", *chosen, "--workers", "1", "--no-peers", where=where)


CASES: dict[str, Callable[[Path], Any]] = {
    case.__name__: case
    for case in (tables, measured, films, derivatives, tracking, identification, demo, blind, reality)
}
QUICK = ("tables", "measured", "films")
