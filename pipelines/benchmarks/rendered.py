"""Test the whole chain on rendered films: six studies with one hidden effect or none, from tracking to verdict.

    python pipelines/benchmarks/rendered.py [--seed 0] [--only texture] [--keep FOLDER]

Every study: two speeds, one run to a stop, one with double mass, two reversed; 3 % scatter of the dry friction.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

from frictrack.flow import Session, open_study
from frictrack.simulate.scene import film_scene, read_scene

HIDDEN = {
    "vibration": "[law.vibration]\namplitude = 1.5\nfrequency = 95\nphase = 0.4",
    "texture": "[law.texture]\namplitude = 0.8\nperiod = 0.025\nphase = 0.7",
    "drag": "[law.drag]\nc = 0.12",
    "patch": "[law.patch]\nF = 2.5\nx_c = 0.09\nw = 0.008",
    "camera_shake": "[law.camera_shake]\namplitude = 3e-6\nfrequency = 80",
    "none": "",
}

FOUR_RUNS = """
name = "{name}"
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
{law}
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
REVERSED_RUN = """[[run]]
name = "back_fast"
v = -6.0
frames = 150
[[run]]
name = "back_slow"
v = -3.8
frames = 240
"""


def study(hidden: str, folder: Path, seed: int) -> str:
    """Film one study, run the loop on it, and say what came out, in one line."""
    film_scene(
        read_scene((FOUR_RUNS + REVERSED_RUN).format(name=f"rendered: {hidden}", law=HIDDEN[hidden])), folder, seed=seed
    )
    start = time.perf_counter()
    session = Session(open_study(folder / "study.toml"))
    found = session.diagnose(seed)
    (folder / "diagnosis.json").write_text(json.dumps(found, indent=1, default=str), encoding="utf-8")
    best = found["candidates"][0] if found["candidates"] and found["missing"] else None
    held = (
        "" if best is None else f"held out {best['heldout_rms_before_um']:.2f} -> {best['heldout_rms_after_um']:.2f} um"
    )
    rivals = best["indistinguishable_from"] if best else []
    return (
        f"{hidden:13} {found['verdict']:12} missing {found['missing']} rivals {rivals} {held} "
        f"noise {found['noise_um']:.2f} um  chi2 {found['reduced_chi2']:.3g}  {time.perf_counter() - start:.0f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=HIDDEN)
    parser.add_argument("--keep", type=Path, help="folder in which films and results stay")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for hidden in [args.only] if args.only else HIDDEN:
            print(study(hidden, (args.keep or Path(temporary)) / hidden, args.seed), flush=True)


if __name__ == "__main__":
    main()
