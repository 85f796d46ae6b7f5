"""Render films for timing."""

from __future__ import annotations

from pathlib import Path

from rendered import FOUR_RUNS

from frictrack.simulate.scene import film_scene, read_scene

LAW = "[law.texture]\namplitude = 0.8\nperiod = 0.03"
RUNS = 4


def filmed(folder: Path, seed: int) -> Path:
    """A study of four films; the study file."""
    film_scene(read_scene(FOUR_RUNS.format(name=f"scale {seed}", law=LAW)), folder, rng=seed)
    return folder / "study.toml"
