"""Read a scene file, what slides under which law and how it is filmed; simulate, render and write a study of it.

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

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.interpolate import CubicSpline

from frictrack.base.arguments import checked
from frictrack.base.distributions import RNG, as_seed
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.files import is_file_name
from frictrack.effects import models
from frictrack.effects.models import Model
from frictrack.measure.friction import after_run
from frictrack.records import Array, EarlierRuns
from frictrack.simulate.rendering import Camera, Highlight, Oscillation, Rod, Surface, Target, render, write_film
from frictrack.simulate.trajectory import Conditions, Trajectory, push_force, simulate
from frictrack.study import read_toml

SCENE_KEYS = {
    *("name", "mass", "scatter", "law", "camera", "target", "rod", "highlight", "run", "format"),
    *("clamp_x", "beam_length", "lift"),
}
RUN_KEYS = {"name", "v", "frames", "push", "mass", "width", "level", "incline", "pause"}
CAMERA_KEYS = {f.name for f in fields(Camera)}
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
        The camera, and the block with what stands in front of it.
    runs
        The [[run]] tables.
    format
        Suffix of the films.
    beam
        clamp_x and beam_length, m, where the scene has them.
    lift
        Vertical motion of the mass, m, positive upward.

    """

    name: str
    mass: float
    scatter: float
    law: dict[str, dict[str, float]]
    camera: Camera
    target: Target
    runs: tuple[dict[str, Any], ...]
    format: str = "avi"
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
        raise UsageError("scene: " + "; ".join(faults))
    try:
        return _scene(raw)
    except FrictrackError:
        raise
    except (TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise UsageError(f"scene: expected numbers but {fault}") from None


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
    tables = [("", SCENE_KEYS, raw), *((" in a run", RUN_KEYS, run) for run in raw["run"])]
    tables += [
        (" in [camera]", CAMERA_KEYS, raw.get("camera", {})),
        (" in [target]", TARGET_KEYS, raw.get("target", {})),
    ]
    faults = [f'unknown key "{k}"{place}' for place, known, given in tables for k in given if k not in known]
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
    camera: dict[str, Any] = {
        k: _read_element(Oscillation, k, v) if k in OSCILLATION_KEYS else v for k, v in raw.get("camera", {}).items()
    }
    return Scene(
        name=str(raw.get("name", "scene")),
        mass=float(raw.get("mass", 0.35)),
        scatter=float(raw.get("scatter", 0.0)),
        law={k: dict(v) for k, v in raw["law"].items()},
        camera=Camera(**camera),
        target=_read_target(raw),
        runs=tuple(raw["run"]),
        format=str(raw.get("format", "avi")),
        beam={key: float(raw[key]) for key in ("clamp_x", "beam_length") if key in raw},
        lift=_read_element(Oscillation, "lift", raw["lift"]) if "lift" in raw else None,
    )


def _read_target(raw: dict[str, Any]) -> Target:
    """Block, which may rock by an angle given in degrees, and what stands in front of it."""
    given = raw.get("target", {})
    turn = _read_element(Oscillation, "rotation", given["rotation"]) if "rotation" in given else None
    return Target(
        width=float(given.get("width", 90)),
        height=float(given.get("height", 56)),
        surface=Surface(size=float(given.get("speckle", 4.0)), seed=11),
        rotation=turn and replace(turn, amplitude=float(np.deg2rad(turn.amplitude))),
        rod=_read_element(Rod, "rod", raw["rod"]) if "rod" in raw else None,
        highlight=_read_element(Highlight, "highlight", raw["highlight"]) if "highlight" in raw else None,
    )


def _read_element(kind: type[SceneElement], name: str, given: Any) -> SceneElement:
    """Oscillation, rod or highlight from its table."""
    known = [f.name for f in fields(kind)]
    try:
        return kind(**{key: float(value) for key, value in given.items()})
    except (TypeError, ValueError, AttributeError):
        raise UsageError(
            f"scene: expected {name} as a table of the numbers {', '.join(known)} but got {given}"
        ) from None


Progress = Callable[[int, int, str], None]
DEFAULT_PAUSE_S = 60.0  # between two runs of which the scene does not say it
MARGIN_PX = 14.0  # between the block and the edge of the first frame


@checked
def render_scene(path: Path, out: Path, *, rng: RNG = 0, progress: Progress | None = None) -> None:
    """Simulate and film a scene file.

    Parameters
    ----------
    path
        Scene file; `frictrack.simulate.scene` shows its keys.
    out
        Folder for the films, study.toml and truth.json.
    rng
        Random generator, or seed, of scatter and noise.
    progress
        Called with the number of runs done, the number of all runs and a text.

    Raises
    ------
    FrictrackError
        If the scene file is missing or invalid.

    """
    if not path.is_file():
        raise FrictrackError(f"expected a scene file but found none at {path}; see `frictrack render --help`")
    try:
        scene = read_scene(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as fault:
        raise UsageError(f"{path.name} is not a text in UTF-8 (byte {fault.start})") from None
    except FrictrackError as fault:
        raise UsageError(f"{path.name}: {fault}") from None
    film_scene(scene, out, rng=rng, progress=progress)


@checked
def film_scene(scene: Scene, folder: Path, *, rng: RNG = 0, progress: Progress | None = None) -> None:
    """Simulate, render and write every run of a scene.

    The folder gets the films, study.toml without the truth, truth.json and, if the law has a `drive_error`, the
    measured drive of each pushed run.

    Parameters
    ----------
    scene
        What to film.
    folder
        Where to write; created if it does not exist.
    rng
        Random generator, or seed, of scatter and noise.
    progress
        As in `render_scene`.

    """
    generator = np.random.default_rng(rng)
    folder.mkdir(parents=True, exist_ok=True)
    truth: dict[str, Any] = {"scene": scene.name, "mass": scene.mass, "law": scene.law, "seed": as_seed(rng)}
    truth |= {"runs": [], "target": asdict(scene.target)}
    earlier: EarlierRuns = ()
    motion: Trajectory | None = None
    for i, run in enumerate(scene.runs):
        if progress:
            progress(i, len(scene.runs), f"rendering {run['name']}")
        level = float(run.get("level", 1 + scene.scatter * generator.standard_normal()))
        mass = float(run.get("mass", scene.mass))
        camera = _camera(scene, run)
        if motion is not None:
            pause = float(run.get("pause", DEFAULT_PAUSE_S))
            earlier = after_run(earlier, motion.duration, motion.distance, pause)
        motion = true_trajectory(scene, run, camera, level, earlier)
        film = f"{run['name']}.{scene.format}"
        write_film(_render_frames(scene, run, camera, motion, generator), folder / film, camera.fps)
        if _is_driven(scene, run):
            table = np.column_stack([motion.t, push_force(mass, float(run["v"]), float(run["push"]))(motion.t)])
            np.savetxt(folder / f"{run['name']}_drive.csv", table, "%.9g", ",", header="t_s,drive_N", comments="")
        about = {"name": run["name"], "mass": mass, "level": level, "v": run["v"], "camera": asdict(camera)}
        truth["runs"].append(about | {"x_m": motion.x.tolist()})
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    (folder / "study.toml").write_text(_study_text(scene), encoding="utf-8")
    if progress:
        progress(len(scene.runs), len(scene.runs), "rendered")


def _is_driven(scene: Scene, run: dict[str, Any]) -> bool:
    """Whether a run comes with a measured drive: only where the law says that it may be wrong."""
    return "drive_error" in scene.law and bool(run.get("push"))


def _camera(scene: Scene, run: dict[str, Any]) -> Camera:
    """Camera of one run; a `camera_shake` of the law moves the whole picture."""
    camera = replace(scene.camera, width=run.get("width", scene.camera.width))
    shake = scene.law.get("camera_shake")
    if shake is None:
        return camera
    amplitude = shake["amplitude"] / camera.scale
    return replace(camera, shake_x=Oscillation(amplitude, shake["frequency"], shake.get("phase", 0.0)))


def true_trajectory(
    scene: Scene, run: dict[str, Any], camera: Camera, level: float, earlier: EarlierRuns = ()
) -> Trajectory:
    """Simulate one run of a scene; a pushed run starts at rest.

    Parameters
    ----------
    scene, run
        The scene and one of its [[run]] tables.
    camera
        Camera of the run.
    level
        Dry friction of this run over its mean.
    earlier
        What was slid before, as in `Run`.

    Returns
    -------
    Trajectory
        True motion at the frames.

    """
    mass, rotation = float(run.get("mass", scene.mass)), scene.target.rotation
    v, push = float(run["v"]), float(run.get("push", 0.0))
    t = np.arange(int(run["frames"])) / camera.fps
    ratio = mass / scene.mass
    conditions = Conditions(
        mass=mass,
        load=ratio * level,
        mass_ratio=ratio,
        pixel_pitch=camera.scale,
        incline=float(run.get("incline", 0.0)),
        drive=push_force(mass, v, push) if push else None,
        lift=scene.lift and scene.lift.second_derivative(),
        angle=rotation and replace(rotation, amplitude=-rotation.amplitude),  # the picture's y points down
        clamp_x=scene.beam.get("clamp_x"),
        beam_length=scene.beam.get("beam_length"),
        earlier=earlier,
    )
    edge = MARGIN_PX + scene.target.width / 2
    start = camera.scale * (edge if v > 0 else camera.width - 1 - edge)  # x counts from the left edge of the picture
    return simulate(scene.model, _effect_values(scene), conditions, t, (start, 0.0 if push else v))


def _effect_values(scene: Scene) -> dict[str, dict[str, float]]:
    """Parameter values as the effects use them: F_s above F_c, phases 0, fixed values filled in."""
    out = {}
    for effect in scene.model.effects:
        given = scene.law[effect.name]
        known = {p.name for p in effect.parameters}
        wrong = [k for k in given if k not in known]
        if wrong:
            raise UsageError(f"scene: {effect.name} has {', '.join(known)} but not {wrong[0]}")
        out[effect.name] = {p.name: float(given.get(p.name, p.fixed or 0.0)) for p in effect.parameters}
    if "stribeck" in out and "coulomb" in out:
        out["stribeck"]["F_s"] -= out["coulomb"]["F_c"]
    return out


def _render_frames(
    scene: Scene, run: dict[str, Any], camera: Camera, motion: Trajectory, rng: np.random.Generator
) -> Any:
    """Recorded frames of one run."""
    x = (motion.x + motion.shift) / camera.scale
    y = np.full_like(x, camera.height / 2 - 4)
    if scene.lift is not None:
        y = y - scene.lift(motion.t) / camera.scale
    spline_x, spline_y = CubicSpline(motion.t, x), CubicSpline(motion.t, y)

    def position(t: Array) -> tuple[Array, Array]:
        return spline_x(t), spline_y(t)

    return render(position, camera, scene.target, rng, n_frames=len(x))


def _study_text(scene: Scene) -> str:
    """Text of the study file, which does not contain the truth."""
    camera = scene.camera
    lines = [
        "[study]",
        f'name = "{scene.name}"',
        f'mass = "{scene.mass:g} kg"',
        'model = "tustin"                # the first guess; `frictrack diagnose` says what it lacks',
        "",
        "[camera]",
        f"fps = {camera.fps:g}",
        f'scale = "{camera.scale * 1e3:g} mm/px"',
    ]
    for run in scene.runs:
        lines += ["", "[[run]]", f'name = "{run["name"]}"', f'video = "{run["name"]}.{scene.format}"']
        if "mass" in run:
            lines.append(f'mass = "{run["mass"]:g} kg"')
        if "pause" in run:
            lines.append(f'pause = "{run["pause"]:g} s"')
        lines += [f'{key} = "{value:g} m"' for key, value in scene.beam.items()]
        if _is_driven(scene, run):
            lines.append(f'drive = "{run["name"]}_drive.csv"')
    return "\n".join(lines) + "\n"
