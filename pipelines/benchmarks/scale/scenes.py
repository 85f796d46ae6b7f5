"""Rendered films for whoever measures time."""

from __future__ import annotations

from pathlib import Path

from frictrack.simulate.scene import film_scene, read_scene

SCENE = """
name = "scale {seed}"
mass = 0.35
scatter = 0.03
[camera]
fps = 4000
width = 512
height = 80
scale = 0.0005
[law.coulomb]
F_c = 8.0
[law.stribeck]
F_s = 14.0
v_s = 0.4
[law.viscous]
F_v = 1.2
[law.texture]
amplitude = 0.8
period = 0.03
[[run]]
name = "fast"
v = 6.0
frames = 150
[[run]]
name = "slow"
v = 3.8
frames = 240
[[run]]
name = "to_a_stop"
v = 2.6
frames = 330
[[run]]
name = "double_mass"
v = 3.8
frames = 240
mass = 0.70
"""
RUNS = 4


def filmed(folder: Path, seed: int) -> Path:
    """A study of four films; the study file."""
    film_scene(read_scene(SCENE.format(seed=seed)), folder, seed=seed)
    return folder / "study.toml"
