"""Write studies of known truth: read a scene file, simulate its runs and film them."""

from frictrack.simulate.scene.scene_file import Scene, read_scene
from frictrack.simulate.scene.study_writer import film_scene, render_scene, true_trajectory

__all__ = ["Scene", "film_scene", "read_scene", "render_scene", "true_trajectory"]
