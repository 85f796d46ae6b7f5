"""Simulate, render and write a whole study of known truth from a scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from frictrack.base.distributions import RNG, accepts_seed, as_seed
from frictrack.base.errors import FrictrackError
from frictrack.measure.friction import after_run
from frictrack.records import Array, EarlierRuns
from frictrack.simulate.conditions import Conditions, push_force
from frictrack.simulate.rendering import Camera, Oscillation, Surface, Target, render, write_film
from frictrack.simulate.scene.scene_file import Scene, read_scene
from frictrack.simulate.trajectory import Trajectory, simulate

Progress = Callable[[int, int, str], None]
DEFAULT_PAUSE_S = 60.0  # between two runs of which the scene does not say it
MARGIN_PX = 14.0  # between the block and the edge of the first frame


@accepts_seed
def render_scene(path: Path, out: Path, *, rng: RNG = 0, progress: Progress | None = None) -> None:
    """Simulate and film a scene file.

    Parameters
    ----------
    path
        Scene file; `frictrack.simulate.scene.scene_file` shows its keys.
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
        raise FrictrackError(f"{path.name} is not a text in UTF-8 (byte {fault.start})", usage=True) from None
    except FrictrackError as fault:
        raise FrictrackError(f"{path.name}: {fault}", usage=True) from None
    film_scene(scene, out, rng=rng, progress=progress)


@accepts_seed
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
    truth: dict[str, Any] = {
        "scene": scene.name,
        "mass": scene.mass,
        "law": scene.law,
        "seed": as_seed(rng),
        "runs": [],
    }
    truth["target"] = asdict(_target(scene))
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
            drive = push_force(mass, float(run["v"]), float(run["push"]))(motion.t)
            table = np.column_stack([motion.t, drive])
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
    camera = Camera(**(scene.camera | ({"width": run["width"]} if "width" in run else {})))
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
    mass = float(run.get("mass", scene.mass))
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
        lift=None if scene.lift is None else scene.lift.second_derivative(),
        angle=_counterclockwise(scene.target.get("rotation")),
        clamp_x=scene.beam.get("clamp_x"),
        beam_length=scene.beam.get("beam_length"),
        earlier=earlier,
    )
    return simulate(
        scene.model, _effect_values(scene), conditions, t, (_start_x(scene, run, camera), 0.0 if push else v)
    )


def _counterclockwise(rotation: Oscillation | None) -> Oscillation | None:
    """Rotation with the angle counter-clockwise in space: the picture's y points down."""
    return None if rotation is None else replace(rotation, amplitude=-rotation.amplitude)


def _start_x(scene: Scene, run: dict[str, Any], camera: Camera) -> float:
    """Start of the block's centre, m; x is counted from the left edge of the picture in all runs."""
    edge = MARGIN_PX + scene.target.get("width", 90.0) / 2
    return camera.scale * (edge if run["v"] > 0 else camera.width - 1 - edge)


def _effect_values(scene: Scene) -> dict[str, dict[str, float]]:
    """Parameter values as the effects use them: F_s above F_c, phases 0, fixed values filled in."""
    out = {}
    for effect in scene.model.effects:
        given = scene.law[effect.name]
        known = {p.name for p in effect.parameters}
        wrong = [k for k in given if k not in known]
        if wrong:
            raise FrictrackError(f"scene: {effect.name} has {', '.join(known)} but not {wrong[0]}", usage=True)
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

    return render(position, camera, _target(scene), rng, n_frames=len(x))


def _target(scene: Scene) -> Target:
    """Block, and what stands in front of it."""
    return Target(
        width=float(scene.target.get("width", 90)),
        height=float(scene.target.get("height", 56)),
        surface=Surface(size=float(scene.target.get("speckle", 4.0)), seed=11),
        rotation=scene.target.get("rotation"),
        **scene.front,
    )


def _study_text(scene: Scene) -> str:
    """Text of the study file, which does not contain the truth."""
    camera = Camera(**scene.camera)
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
