"""Render films of a textured block of known trajectory, as a high-speed camera would record them."""

# ruff: noqa: F401 - the imports are the interface

from frictrack.simulate.rendering.camera import Camera, Highlight, Oscillation, Rod, Side, write_film
from frictrack.simulate.rendering.renderer import Surface, Target, render, render_clean
