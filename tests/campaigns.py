"""Small studies for whoever runs many of them, and what is in their results."""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import psutil

if TYPE_CHECKING:
    from frictrack.flow.batch.tasks import StudyOutcome

MASS = 0.5


def slide(path: Path, seed: int, force: float = 0.6) -> None:
    """A run that Coulomb friction alone brakes."""
    rng = np.random.default_rng(seed)
    t = np.arange(160) / 1000.0
    x = 2.0 * t - 0.5 * force / MASS * t**2 + 5e-6 * rng.standard_normal(len(t))
    np.savetxt(path, np.column_stack([t, x]), delimiter=",", header="t_s,x_m", comments="")


def campaign(folder: Path, count: int, runs: int = 1) -> Path:
    """A folder of studies."""
    for k in range(count):
        own = folder / f"day_{k + 1}"
        own.mkdir(parents=True)
        text = f'[study]\nmass = {MASS}\nmodel = ["coulomb"]\n'
        for i in range(runs):
            slide(own / f"r{i}.csv", 10 * k + i)
            text += f'[[run]]\ntable = "r{i}.csv"\n'
        (own / "study.toml").write_text(text)
    return folder


def contents(path: Path) -> dict[str, Any]:
    """All that an HDF5 file holds, by name."""
    found: dict[str, Any] = {}

    def note(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            held = item[()]
            found[name] = held.tobytes() if isinstance(held, np.ndarray) and held.dtype.kind != "O" else str(held)
        found.update({f"{name}@{key}": str(value) for key, value in item.attrs.items()})

    with h5py.File(path) as file:
        note("", file)
        file.visititems(note)
    return found


def results(folder: Path) -> dict[str, Any]:
    """All that the studies below a folder have come to."""
    return {str(path.relative_to(folder)): contents(path) for path in sorted(folder.rglob("[!.]*.h5"))}


def die_once(mark: str) -> str:
    """End this process, unless it did so before."""
    if not Path(mark).exists():
        Path(mark).touch()
        signal.raise_signal(signal.SIGKILL)
    return "done"


def short_study(path: Path, seed: int) -> StudyOutcome:
    """Stand in for `begin_study`."""
    from frictrack.flow.batch.tasks import StudyOutcome  # noqa: PLC0415 - few tests need it

    time.sleep(0.02)
    with path.with_name("ended").open("a") as file:
        file.write("x")
    return StudyOutcome(
        str(path), {"verdict": "complete", "missing": [], "runs": 1, "reason": None}, [{"run": "r0"}], seed=seed
    )


@contextmanager
def killed_workers(moments: list[float]) -> Iterator[list[int]]:
    """Kill a process of this one at every moment, s after the begin of the block; yield the process ids of the dead."""
    ended, dead = threading.Event(), []

    def kill() -> None:
        began = time.monotonic()
        for moment in moments:
            ended.wait(max(0.0, began + moment - time.monotonic()))
            while not ended.is_set():
                if workers := [one for one in psutil.Process().children() if _is_worker(one) and one.pid not in dead]:
                    chosen = random.choice(workers)
                    with suppress(psutil.Error):
                        chosen.kill()
                    dead.append(chosen.pid)
                    break
                time.sleep(0.0005)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield dead
    finally:
        ended.set()
        killer.join()


def _is_worker(process: psutil.Process) -> bool:
    try:
        return any("spawn_main" in part for part in process.cmdline())
    except psutil.Error:  # it has ended
        return False
