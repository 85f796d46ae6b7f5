"""A scene file becomes films of known truth: what slides, under which law, and how it is filmed.

    name = "course A"
    mass = 0.35                     # kg, the reference at which the law's newtons are quoted
    scatter = 0.03                  # relative, of dry friction from run to run
    clamp_x = -0.1                  # m, for beam_vibration; beam_length likewise
    lift = { amplitude = 2e-5, frequency = 40 }          # m, up: how the mass moves vertically, for measured_load
    [law.coulomb]                   # any effects of the library, parameters by their names
    F_c = 8.0
    [camera]                        # fps, width, height, scale (m/px), exposure, bit_depth, full_well, read_noise
    prnu = 0.01                     # relative flat-field noise; drift (1/s) of the light
    flicker = { amplitude = 0.05, frequency = 100 }      # relative; shake_x, shake_y likewise in px
    [target]                        # width, height, speckle (px)
    rotation = { amplitude = 0.15, frequency = 40 }      # deg, as seen clockwise
    [rod]                           # in front of the block: x, width (px), reflectance
    x = 300
    [highlight]                     # on the window: x, y, radius (px), amplitude (1 = white)
    x = 200
    y = 40
    [[run]]
    name = "v4"
    v = 4.0                         # m/s; negative moves toward -x
    frames = 200
    push = 0.004                    # s of pushing from rest before the free slide (default 0: it starts moving)

A folder as target gets the films, a study file that says nothing of the truth, and `truth.json`; with a `drive_error`
in the law also the drive of every run as it was measured.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.interpolate import CubicSpline

from frictrack import models
from frictrack.errors import FrictrackError
from frictrack.files import is_file_name
from frictrack.models import Model
from frictrack.records import Array
from frictrack.simulate.camera import Camera, Oscillation
from frictrack.simulate.film import write_film
from frictrack.simulate.foreground import Highlight, Rod
from frictrack.simulate.render import Target, render
from frictrack.simulate.slide import Conditions, Slide, simulate
from frictrack.simulate.texture import Surface
from frictrack.study import read_toml

Progress = Callable[[int, int, str], None]
KEYS = {
    *("name", "mass", "scatter", "law", "camera", "target", "rod", "highlight", "run", "format"),
    *("clamp_x", "beam_length", "lift"),
}
RUN_KEYS = {"name", "v", "frames", "push", "mass", "width", "level", "incline"}
TARGET_KEYS = {"width", "height", "speckle", "rotation"}
OSCILLATIONS = ("flicker", "shake_x", "shake_y")
MOST, MOST_PX, MOST_FRAMES = 1e12, 16_384, 1_000_000  # of any number; of a picture's side; of a run
MARGIN = 14.0  # px between the block and the edge of the first frame


Part = TypeVar("Part", Oscillation, Rod, Highlight)


@dataclass(frozen=True)
class Scene:
    """A parsed scene: the law (values as the effects take them), the camera and the runs."""

    name: str
    mass: float
    scatter: float
    law: dict[str, dict[str, float]]
    camera: dict[str, Any]
    target: dict[str, Any]
    runs: tuple[dict[str, Any], ...]
    format: str = "avi"
    front: dict[str, Any] = field(default_factory=dict)  # rod and highlight
    beam: dict[str, float] = field(default_factory=dict)  # clamp_x and beam_length, m
    lift: Oscillation | None = None  # m, up

    @property
    def model(self) -> Model:
        """The law as a model; a camera shake is the camera's."""
        return models.of([name for name in self.law if name != "camera_shake"])


def read_scene(text: str) -> Scene:
    """Scene from TOML text.

    Raises FrictrackError (usage) for what is no TOML, a key that a scene does not have, a value of the wrong kind, or
    a scene without law or runs.
    """
    raw = read_toml("scene", text)
    faults = _kind_faults(raw) or _key_faults(raw) + [f for run in raw["run"] for f in _run_faults(run)]
    if faults:
        raise FrictrackError("scene: " + "; ".join(faults), usage=True)
    try:
        return _scene(raw)
    except FrictrackError:
        raise
    except (TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise FrictrackError(f"scene: expected numbers but {fault}", usage=True) from None


def _kind_faults(raw: dict[str, Any]) -> list[str]:
    """What is no table and should be one."""
    faults = [f"expected [{k}] as a table" for k in ("camera", "target", "law") if not isinstance(raw.get(k, {}), dict)]
    runs, laws = raw.get("run", []), raw.get("law", {})
    if not isinstance(runs, list) or not all(isinstance(run, dict) for run in runs):
        faults.append("expected every run as a table [[run]]")
    if isinstance(laws, dict):
        faults += [f"expected [law.{k}] as a table of numbers" for k, v in laws.items() if not _is_law(v)]
    if not runs or not laws:
        faults.append("expected a [law.coulomb] table or the like and at least one [[run]]")
    return faults


def _is_law(values: Any) -> bool:
    return isinstance(values, dict) and all(_is_number(v) for v in values.values())


def _is_number(value: Any, low: float = -MOST, high: float = MOST) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def _key_faults(raw: dict[str, Any]) -> list[str]:
    """Keys that a scene does not have, and pictures that are too large."""
    faults = [f'unknown key "{k}"' for k in raw if k not in KEYS]
    faults += [f'unknown key "{k}" in a run' for run in raw["run"] for k in run if k not in RUN_KEYS]
    faults += [f'unknown key "{k}" in [camera]' for k in raw.get("camera", {}) if k not in _camera_keys()]
    faults += [f'unknown key "{k}" in [target]' for k in raw.get("target", {}) if k not in TARGET_KEYS]
    for key in ("width", "height"):
        value = raw.get("camera", {}).get(key, 8)
        if not isinstance(value, int) or not _is_number(value, 8, MOST_PX):
            faults.append(f"expected the camera's {key} from 8 to {MOST_PX} px but got {value!r}")
    return faults


def _run_faults(run: dict[str, Any]) -> list[str]:
    """What is wrong with a run: films are named by it, and its numbers bound how much there is to do."""
    name, frames, width = run.get("name"), run.get("frames"), run.get("width", 8)
    faults = []
    if not isinstance(name, str) or not is_file_name(name):
        faults.append(f"expected every run with a name that can be a file name but got {name!r}")
    if not isinstance(frames, int) or not _is_number(frames, 2, MOST_FRAMES):
        faults.append(f"expected frames = 2 to {MOST_FRAMES} in a run but got {frames!r}")
    if not isinstance(width, int) or not _is_number(width, 8, MOST_PX):
        faults.append(f"expected a width from 8 to {MOST_PX} px but got {width!r}")
    if "v" not in run:
        faults.append("expected v, the speed in m/s, in every run")
    faults += [f"expected {k} as a number but got {v!r}" for k, v in run.items() if k != "name" and not _is_number(v)]
    return faults


def _scene(raw: dict[str, Any]) -> Scene:
    """The scene of a checked table."""
    return Scene(
        name=str(raw.get("name", "scene")),
        mass=float(raw.get("mass", 0.35)),
        scatter=float(raw.get("scatter", 0.0)),
        law={k: dict(v) for k, v in raw["law"].items()},
        camera={k: _part(Oscillation, k, v) if k in OSCILLATIONS else v for k, v in raw.get("camera", {}).items()},
        target=_target_keys(raw.get("target", {})),
        runs=tuple(raw["run"]),
        format=str(raw.get("format", "avi")),
        front=_front(raw),
        beam={key: float(raw[key]) for key in ("clamp_x", "beam_length") if key in raw},
        lift=_part(Oscillation, "lift", raw["lift"]) if "lift" in raw else None,
    )


def _camera_keys() -> set[str]:
    return {f.name for f in fields(Camera)}


def _target_keys(given: dict[str, Any]) -> dict[str, Any]:
    """The table of the target; its rotation comes in degrees."""
    if "rotation" not in given:
        return given
    turn = _part(Oscillation, "rotation", given["rotation"])
    return given | {"rotation": replace(turn, amplitude=float(np.deg2rad(turn.amplitude)))}


def _front(raw: dict[str, Any]) -> dict[str, Any]:
    """Rod and highlight, where the scene has them."""
    rod = {"rod": _part(Rod, "rod", raw["rod"])} if "rod" in raw else {}
    return rod | ({"highlight": _part(Highlight, "highlight", raw["highlight"])} if "highlight" in raw else {})


def _part(kind: type[Part], name: str, given: Any) -> Part:
    """A part of the scene from its table."""
    known = [f.name for f in fields(kind)]
    try:
        return kind(**{key: float(value) for key, value in given.items()})
    except (TypeError, ValueError, AttributeError):
        raise FrictrackError(
            f"scene: expected {name} as a table of the numbers {', '.join(known)} but got {given}", usage=True
        ) from None


def render_scene(path: Path, out: Path, *, seed: int = 0, progress: Progress | None = None) -> None:
    """Film a scene file into the folder `out`: films, study.toml, truth.json.

    Raises FrictrackError for a scene file that is missing or wrong.
    """
    if not path.is_file():
        raise FrictrackError(f"expected a scene file but found none at {path}; see `frictrack render --help`")
    try:
        scene = read_scene(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as fault:
        raise FrictrackError(f"{path.name} is not a text in UTF-8 (byte {fault.start})", usage=True) from None
    except FrictrackError as fault:
        raise FrictrackError(f"{path.name}: {fault}", usage=True) from None
    film_scene(scene, out, seed=seed, progress=progress)


def sample_study(folder: Path, progress: Progress | None = None) -> None:
    """The sample study of four short films with a hidden effect, rendered into `folder`."""
    text = resources.files("frictrack.simulate").joinpath("sample.toml").read_text(encoding="utf-8")
    film_scene(read_scene(text), folder, progress=progress)


def film_scene(scene: Scene, folder: Path, *, seed: int = 0, progress: Progress | None = None) -> None:
    """Simulate, render and write every run of a scene."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    truth: dict[str, Any] = {"scene": scene.name, "mass": scene.mass, "law": scene.law, "seed": seed, "runs": []}
    truth["target"] = asdict(_target(scene))
    for i, run in enumerate(scene.runs):
        if progress:
            progress(i, len(scene.runs), f"rendering {run['name']}")
        level = float(run.get("level", 1 + scene.scatter * rng.standard_normal()))
        camera = _camera(scene, run)
        slide = slide_of(scene, run, camera, level)
        film = f"{run['name']}.{scene.format}"
        write_film(_frames(scene, run, camera, slide, rng), folder / film, camera.fps)
        if _is_driven(scene, run):
            drive = _push(float(run.get("mass", scene.mass)), float(run["v"]), float(run["push"]))(slide.t)
            table = np.column_stack([slide.t, drive])
            np.savetxt(folder / f"{run['name']}_drive.csv", table, "%.9g", ",", header="t_s,drive_N", comments="")
        about = {"name": run["name"], "level": level, "v": run["v"], "camera": asdict(camera)}
        truth["runs"].append(about | {"x_m": slide.x.tolist()})
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    (folder / "study.toml").write_text(_study_text(scene), encoding="utf-8")
    if progress:
        progress(len(scene.runs), len(scene.runs), "rendered")


def _is_driven(scene: Scene, run: dict[str, Any]) -> bool:
    """Whether the drive of a run is told: only where it may be wrong, as a struck run has none."""
    return "drive_error" in scene.law and bool(run.get("push"))


def _camera(scene: Scene, run: dict[str, Any]) -> Camera:
    """The camera of one run; a camera shake of the law shakes the whole picture."""
    camera = Camera(**(scene.camera | ({"width": run["width"]} if "width" in run else {})))
    shake = scene.law.get("camera_shake")
    if shake is None:
        return camera
    amplitude = shake["amplitude"] / camera.scale
    return replace(camera, shake_x=Oscillation(amplitude, shake["frequency"], shake.get("phase", 0.0)))


def slide_of(scene: Scene, run: dict[str, Any], camera: Camera, level: float) -> Slide:
    """True motion of one run at its frames; a pushed run starts at rest."""
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
        drive=_push(mass, v, push) if push else None,
        lift=None if scene.lift is None else _twice(scene.lift),
        angle=_turning(scene.target.get("rotation")),
        **scene.beam,
    )
    return simulate(scene.model, _values(scene), conditions, t, (_begin(scene, run, camera), 0.0 if push else v))


def _push(mass: float, v: float, push: float) -> Callable[[Array], Array]:
    """A smooth push that would bring the mass to v without friction, N."""

    def drive(at: Array) -> Array:
        phase = np.clip(np.asarray(at) / push, 0.0, 1.0)
        return np.asarray(2 * mass * v / push * np.sin(np.pi * phase) ** 2)

    return drive


def _twice(swing: Oscillation) -> Oscillation:
    """Its second derivative."""
    return replace(swing, amplitude=-swing.amplitude * (2 * np.pi * swing.frequency) ** 2)


def _turning(rotation: Oscillation | None) -> Oscillation | None:
    """Angle of the target counter-clockwise; the picture's y points down."""
    return None if rotation is None else replace(rotation, amplitude=-rotation.amplitude)


def _begin(scene: Scene, run: dict[str, Any], camera: Camera) -> float:
    """Where the block's centre starts on the course, m: x is counted from the picture's left edge in all runs."""
    edge = MARGIN + scene.target.get("width", 90.0) / 2
    return camera.scale * (edge if run["v"] > 0 else camera.width - 1 - edge)


def _values(scene: Scene) -> dict[str, dict[str, float]]:
    """Values as the effects take them: F_s above F_c, phases zero, fixed ones filled in."""
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


def _frames(scene: Scene, run: dict[str, Any], camera: Camera, slide: Slide, rng: np.random.Generator) -> Any:
    x = (slide.x + slide.shift) / camera.scale
    y = np.full_like(x, camera.height / 2 - 4)
    if scene.lift is not None:
        y = y - scene.lift(slide.t) / camera.scale
    spline, across = CubicSpline(slide.t, x), CubicSpline(slide.t, y)

    def position(t: Array) -> tuple[Array, Array]:
        return spline(t), across(t)

    return render(position, camera, _target(scene), rng, n_frames=len(x))


def _target(scene: Scene) -> Target:
    """The block, and what stands in front of it."""
    return Target(
        width=float(scene.target.get("width", 90)),
        height=float(scene.target.get("height", 56)),
        surface=Surface(size=float(scene.target.get("speckle", 4.0)), seed=11),
        rotation=scene.target.get("rotation"),
        **scene.front,
    )


def _study_text(scene: Scene) -> str:
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
        lines += [f'{key} = "{value:g} m"' for key, value in scene.beam.items()]
        if _is_driven(scene, run):
            lines.append(f'drive = "{run["name"]}_drive.csv"')
    return "\n".join(lines) + "\n"
