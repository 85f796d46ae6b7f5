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
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import to_json
from scipy.interpolate import CubicSpline

from frictrack.base.arguments import checked
from frictrack.base.distributions import RNG, as_seed
from frictrack.base.errors import FrictrackError, UsageError, describe_fault
from frictrack.base.files import is_file_name, read_small_text
from frictrack.effects import models
from frictrack.effects.models import Model
from frictrack.measure.friction import after_run
from frictrack.records import Array, EarlierRuns
from frictrack.simulate.rendering import Camera, Highlight, Oscillation, Rod, Side, Surface, Target, render, write_film
from frictrack.simulate.trajectory import Conditions, Trajectory, push_force, simulate
from frictrack.study import read_toml

MAX_NUMBER, MAX_FRAMES = 1e12, 1_000_000  # any number; frames of a run
MAX_SCENE_BYTES = 1 << 20


def _file_name(name: str) -> str:
    if not is_file_name(name):
        raise UsageError(f"expected every run with a name that can be a file name but got {name!r}")
    return name


Number = Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER, allow_inf_nan=False)]


class SceneKeys(BaseModel):
    """A table of the scene file; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneRun(SceneKeys):
    """The keys of a ``[[run]]``.

    Attributes
    ----------
    name
        Name of the run and of its film.
    v
        Speed at the start, or that a push would give without friction; negative toward -x, m/s.
    frames
        Number of frames.
    push
        Duration of a push from rest, s; 0: the run starts in motion.
    mass
        Mass, kg, where it is not that of the scene.
    width
        Width of the picture, px, where it is not that of the camera.
    level
        Dry friction of this run over that of the law; drawn with `scatter` by default.
    incline
        Angle by which the course rises toward +x, rad.
    pause
        Time since the end of the run before it, for `run_in` and `heating`, s; 60 by default.

    """

    name: Annotated[str, AfterValidator(_file_name)]
    v: Number
    frames: Annotated[int, Field(ge=2, le=MAX_FRAMES)]
    push: Number = 0.0
    mass: Number | None = None
    width: Side | None = None
    level: Number | None = None
    incline: Number = 0.0
    pause: Number | None = None


class Block(SceneKeys):
    """The keys of ``[target]``.

    Attributes
    ----------
    width
        Length of the block along the course, px.
    height
        Height of the block, px.
    speckle
        Size of the speckles, px.
    rotation
        Rocking, clockwise in the picture; its amplitude is in degrees.

    """

    width: Number = 90.0
    height: Number = 56.0
    speckle: Number = 4.0
    rotation: Oscillation | None = None


class Scene(SceneKeys):
    """A scene: a law, a camera and the runs to film.

    Attributes
    ----------
    name
        Name of the study.
    mass
        Mass at which the forces of the law are given, kg.
    scatter
        Relative standard deviation of dry friction from run to run.
    format
        Suffix of the films.
    clamp_x
        Position of the clamp, for `beam_vibration`, m.
    beam_length
        Free length of the beam, for `beam_vibration`, m.
    lift
        Vertical motion of the mass, m, positive upward.
    law
        A table `[law.EFFECT]` for every effect of the law: values of its parameters (F_s is the total static friction).
    camera
        The table `[camera]`.
    block
        The table `[target]`.
    rod
        What stands in front of the block: the table `[rod]`.
    highlight
        What shines in the window: the table `[highlight]`.
    runs
        A table `[[run]]` for every run.

    """

    name: str = "scene"
    mass: Number = 0.35
    scatter: Number = 0.0
    format: str = "avi"
    clamp_x: Number | None = None
    beam_length: Number | None = None
    lift: Oscillation | None = None
    law: Annotated[dict[str, dict[str, Number]], Field(min_length=1)]
    camera: Camera = Camera()
    block: Block = Field(Block(), alias="target")
    rod: Rod | None = None
    highlight: Highlight | None = None
    runs: Annotated[tuple[SceneRun, ...], Field(min_length=1, alias="run")]

    @property
    def model(self) -> Model:
        """The law as a model, without a camera shake, which the camera adds."""
        return models.of([name for name in self.law if name != "camera_shake"])

    @property
    def target(self) -> Target:
        """The block and what stands in front of it, as they are drawn."""
        given, turn = self.block, self.block.rotation
        return Target(
            width=given.width,
            height=given.height,
            surface=Surface(size=given.speckle, seed=11),
            rotation=turn and replace(turn, amplitude=float(np.deg2rad(turn.amplitude))),
            rod=self.rod,
            highlight=self.highlight,
        )


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
    try:
        scene = Scene.model_validate_json(to_json(raw), strict=True)
        scene.target  # noqa: B018 - checks the block
    except ValidationError as invalid:
        faults = [describe_fault(fault, fault["loc"]) for fault in invalid.errors(include_url=False)]
        raise UsageError("scene: " + "; ".join(faults)) from None
    return scene


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
    text = read_small_text(path, MAX_SCENE_BYTES, "a scene file")
    try:
        scene = read_scene(text)
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
            progress(i, len(scene.runs), f"rendering {run.name}")
        scattered = 1 + scene.scatter * generator.standard_normal()
        level = scattered if run.level is None else run.level
        mass = _mass(scene, run)
        camera = _camera(scene, run)
        if motion is not None:
            pause = DEFAULT_PAUSE_S if run.pause is None else run.pause
            earlier = after_run(earlier, motion.duration, motion.distance, pause)
        motion = true_trajectory(scene, run, camera, level, earlier)
        film = f"{run.name}.{scene.format}"
        write_film(_render_frames(scene, camera, motion, generator), folder / film, camera.fps)
        if _is_driven(scene, run):
            table = np.column_stack([motion.t, push_force(mass, run.v, run.push)(motion.t)])
            np.savetxt(folder / f"{run.name}_drive.csv", table, "%.9g", ",", header="t_s,drive_N", comments="")
        about = {"name": run.name, "mass": mass, "level": level, "v": run.v, "camera": asdict(camera)}
        truth["runs"].append(about | {"x_m": motion.x.tolist()})
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    (folder / "study.toml").write_text(_study_text(scene), encoding="utf-8")
    if progress:
        progress(len(scene.runs), len(scene.runs), "rendered")


def _mass(scene: Scene, run: SceneRun) -> float:
    return scene.mass if run.mass is None else run.mass


def _is_driven(scene: Scene, run: SceneRun) -> bool:
    """Whether a run comes with a measured drive: only where the law says that it may be wrong."""
    return "drive_error" in scene.law and bool(run.push)


def _camera(scene: Scene, run: SceneRun) -> Camera:
    """Camera of one run; a `camera_shake` of the law moves the whole picture."""
    camera = replace(scene.camera, width=run.width or scene.camera.width)
    shake = scene.law.get("camera_shake")
    if shake is None:
        return camera
    amplitude = shake["amplitude"] / camera.scale
    return replace(camera, shake_x=Oscillation(amplitude, shake["frequency"], shake.get("phase", 0.0)))


def true_trajectory(scene: Scene, run: SceneRun, camera: Camera, level: float, earlier: EarlierRuns = ()) -> Trajectory:
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
    mass, target = _mass(scene, run), scene.target
    t = np.arange(run.frames) / camera.fps
    ratio = mass / scene.mass
    conditions = Conditions(
        mass=mass,
        load=ratio * level,
        mass_ratio=ratio,
        pixel_pitch=camera.scale,
        incline=run.incline,
        drive=push_force(mass, run.v, run.push) if run.push else None,
        lift=scene.lift and scene.lift.second_derivative(),
        # the picture's y points down
        angle=target.rotation and replace(target.rotation, amplitude=-target.rotation.amplitude),
        clamp_x=scene.clamp_x,
        beam_length=scene.beam_length,
        earlier=earlier,
    )
    edge = MARGIN_PX + target.width / 2
    # x counts from the left edge of the picture
    start = camera.scale * (edge if run.v > 0 else camera.width - 1 - edge)
    return simulate(scene.model, _effect_values(scene), conditions, t, (start, 0.0 if run.push else run.v))


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


def _render_frames(scene: Scene, camera: Camera, motion: Trajectory, rng: np.random.Generator) -> Any:
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
        lines += ["", "[[run]]", f'name = "{run.name}"', f'video = "{run.name}.{scene.format}"']
        given = {"mass": (run.mass, "kg"), "pause": (run.pause, "s")}
        given |= {"clamp_x": (scene.clamp_x, "m"), "beam_length": (scene.beam_length, "m")}
        lines += [f'{key} = "{value:g} {unit}"' for key, (value, unit) in given.items() if value is not None]
        if _is_driven(scene, run):
            lines.append(f'drive = "{run.name}_drive.csv"')
    return "\n".join(lines) + "\n"
