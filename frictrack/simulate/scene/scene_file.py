"""Read a scene file: what slides, under which law, and how it is filmed.

name = "course A"
mass = 0.35                     # kg, the reference at which the law's newtons are given
scatter = 0.03                  # relative, of dry friction from run to run
clamp_x = -0.1                  # m, for beam_vibration; beam_length likewise
lift = { amplitude = 2e-5, frequency = 40 }          # m, upward: vertical motion of the mass, for measured_load
[law.coulomb]                   # any effects of the library, parameters by name
F_c = 8.0
[camera]                        # fps, width, height, scale (m/px), exposure, bit_depth, full_well, read_noise
prnu = 0.01                     # relative flat-field noise; drift (1/s) of the light
flicker = { amplitude = 0.05, frequency = 100 }      # relative; shake_x, shake_y likewise in px
[target]                        # width, height, speckle (px)
rotation = { amplitude = 0.15, frequency = 40 }      # deg, clockwise in the picture
[rod]                           # in front of the block: x, width (px), reflectance
x = 300
[highlight]                     # on the window: x, y, radius (px), amplitude (1 = white)
x = 200
y = 40
[[run]]
name = "v4"
v = 4.0                         # m/s; negative moves toward -x
frames = 200
push = 0.004                    # s, duration of a push from rest (default 0: the run starts in motion)
pause = 60                      # s since the end of the run before, for run_in and heating
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.files import is_file_name
from frictrack.effects import models
from frictrack.effects.models import Model
from frictrack.simulate.rendering import Camera, Highlight, Oscillation, Rod
from frictrack.study import read_toml

SCENE_KEYS = {
    *("name", "mass", "scatter", "law", "camera", "target", "rod", "highlight", "run", "format"),
    *("clamp_x", "beam_length", "lift"),
}
RUN_KEYS = {"name", "v", "frames", "push", "mass", "width", "level", "incline", "pause"}
TARGET_KEYS = {"width", "height", "speckle", "rotation"}
OSCILLATION_KEYS = ("flicker", "shake_x", "shake_y")
MAX_NUMBER, MAX_SIDE_PX, MAX_FRAMES = 1e12, 16_384, 1_000_000  # any number; side of a picture; frames of a run

SceneElement = TypeVar("SceneElement", Oscillation, Rod, Highlight)


@dataclass(frozen=True)
class Scene:
    """A scene: a law, a camera and the runs to film.

    Attributes
    ----------
    name
        Name of the study.
    mass
        Reference mass, kg.
    scatter
        Relative standard deviation of dry friction from run to run.
    law
        Parameter values by effect, as the scene file gives them (F_s is the total static friction).
    camera, target
        Keyword arguments of `Camera`, and keys of the [target] table with the rotation in rad.
    runs
        The [[run]] tables.
    format
        Suffix of the films.
    front
        Rod and highlight, where the scene has them.
    beam
        clamp_x and beam_length, m, where the scene has them.
    lift
        Vertical motion of the mass, m, positive upward.

    """

    name: str
    mass: float
    scatter: float
    law: dict[str, dict[str, float]]
    camera: dict[str, Any]
    target: dict[str, Any]
    runs: tuple[dict[str, Any], ...]
    format: str = "avi"
    front: dict[str, Any] = field(default_factory=dict)
    beam: dict[str, float] = field(default_factory=dict)
    lift: Oscillation | None = None

    @property
    def model(self) -> Model:
        """The law as a model, without a camera shake, which the camera adds."""
        return models.of([name for name in self.law if name != "camera_shake"])


def read_scene(text: str) -> Scene:
    r"""Read a scene from TOML text.

    Parameters
    ----------
    text
        Contents of a scene file.

    Returns
    -------
    Scene
        The checked scene.

    Raises
    ------
    FrictrackError
        For invalid TOML, unknown keys, values of the wrong type, or a scene without law or runs; all faults at once.

    Examples
    --------
    >>> scene = read_scene('[law.coulomb]\nF_c = 8.0\n[[run]]\nname = "a"\nv = 4.0\nframes = 100')
    >>> scene.mass, len(scene.runs)
    (0.35, 1)

    """
    raw = read_toml("scene", text)
    faults = _type_faults(raw) or _key_faults(raw) + [f for run in raw["run"] for f in _run_faults(run)]
    if faults:
        raise FrictrackError("scene: " + "; ".join(faults), usage=True)
    try:
        return _scene(raw)
    except FrictrackError:
        raise
    except (TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise FrictrackError(f"scene: expected numbers but {fault}", usage=True) from None


def _type_faults(raw: dict[str, Any]) -> list[str]:
    """Name what should be a table but is not."""
    faults = [f"expected [{k}] as a table" for k in ("camera", "target", "law") if not isinstance(raw.get(k, {}), dict)]
    runs, laws = raw.get("run", []), raw.get("law", {})
    if not isinstance(runs, list) or not all(isinstance(run, dict) for run in runs):
        faults.append("expected every run as a table [[run]]")
    if isinstance(laws, dict):
        faults += [f"expected [law.{k}] as a table of numbers" for k, v in laws.items() if not _is_number_table(v)]
    if not runs or not laws:
        faults.append("expected a [law.coulomb] table or the like and at least one [[run]]")
    return faults


def _is_number_table(values: Any) -> bool:
    return isinstance(values, dict) and all(_is_number(v) for v in values.values())


def _is_number(value: Any, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _key_faults(raw: dict[str, Any]) -> list[str]:
    """Name unknown keys and pictures that are too large."""
    faults = [f'unknown key "{k}"' for k in raw if k not in SCENE_KEYS]
    faults += [f'unknown key "{k}" in a run' for run in raw["run"] for k in run if k not in RUN_KEYS]
    faults += [f'unknown key "{k}" in [camera]' for k in raw.get("camera", {}) if k not in _camera_keys()]
    faults += [f'unknown key "{k}" in [target]' for k in raw.get("target", {}) if k not in TARGET_KEYS]
    for key in ("width", "height"):
        value = raw.get("camera", {}).get(key, 8)
        if not isinstance(value, int) or not _is_number(value, 8, MAX_SIDE_PX):
            faults.append(f"expected the camera's {key} from 8 to {MAX_SIDE_PX} px but got {value!r}")
    return faults


def _run_faults(run: dict[str, Any]) -> list[str]:
    """Name faults of a run: its name becomes a file name, and its numbers limit the work to do."""
    name, frames, width = run.get("name"), run.get("frames"), run.get("width", 8)
    faults = []
    if not isinstance(name, str) or not is_file_name(name):
        faults.append(f"expected every run with a name that can be a file name but got {name!r}")
    if not isinstance(frames, int) or not _is_number(frames, 2, MAX_FRAMES):
        faults.append(f"expected frames = 2 to {MAX_FRAMES} in a run but got {frames!r}")
    if not isinstance(width, int) or not _is_number(width, 8, MAX_SIDE_PX):
        faults.append(f"expected a width from 8 to {MAX_SIDE_PX} px but got {width!r}")
    if "v" not in run:
        faults.append("expected v, the speed in m/s, in every run")
    faults += [f"expected {k} as a number but got {v!r}" for k, v in run.items() if k != "name" and not _is_number(v)]
    return faults


def _scene(raw: dict[str, Any]) -> Scene:
    """Scene from a checked table."""
    return Scene(
        name=str(raw.get("name", "scene")),
        mass=float(raw.get("mass", 0.35)),
        scatter=float(raw.get("scatter", 0.0)),
        law={k: dict(v) for k, v in raw["law"].items()},
        camera={
            k: _read_element(Oscillation, k, v) if k in OSCILLATION_KEYS else v
            for k, v in raw.get("camera", {}).items()
        },
        target=_target_keys(raw.get("target", {})),
        runs=tuple(raw["run"]),
        format=str(raw.get("format", "avi")),
        front=_read_foreground(raw),
        beam={key: float(raw[key]) for key in ("clamp_x", "beam_length") if key in raw},
        lift=_read_element(Oscillation, "lift", raw["lift"]) if "lift" in raw else None,
    )


def _camera_keys() -> set[str]:
    return {f.name for f in fields(Camera)}


def _target_keys(given: dict[str, Any]) -> dict[str, Any]:
    """The [target] table with its rotation converted from degrees to radians."""
    if "rotation" not in given:
        return given
    rotation = _read_element(Oscillation, "rotation", given["rotation"])
    return given | {"rotation": replace(rotation, amplitude=float(np.deg2rad(rotation.amplitude)))}


def _read_foreground(raw: dict[str, Any]) -> dict[str, Any]:
    """Rod and highlight, where the scene has them."""
    rod = {"rod": _read_element(Rod, "rod", raw["rod"])} if "rod" in raw else {}
    return rod | ({"highlight": _read_element(Highlight, "highlight", raw["highlight"])} if "highlight" in raw else {})


def _read_element(kind: type[SceneElement], name: str, given: Any) -> SceneElement:
    """Oscillation, rod or highlight from its table."""
    known = [f.name for f in fields(kind)]
    try:
        return kind(**{key: float(value) for key, value in given.items()})
    except (TypeError, ValueError, AttributeError):
        raise FrictrackError(
            f"scene: expected {name} as a table of the numbers {', '.join(known)} but got {given}", usage=True
        ) from None
