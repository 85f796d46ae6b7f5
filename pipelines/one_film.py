"""Identify a friction law from films of one mass, find the missing effect, and print errors before and after.

    python pipelines/one_film.py [--mass 0.35kg --scale 0.5mm/px --fps 4000 FILM ...]

Without films it takes two of the samples. Nothing is stored; `frictrack run` does the same and keeps every stage.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import frictrack as ft
from frictrack.base.units import parse_quantity

SAMPLES = ft.samples.films_folder()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("films", nargs="*", type=Path, default=[SAMPLES / "fast.avi", SAMPLES / "slow.avi"])
    parser.add_argument("--mass", default="0.35 kg")
    parser.add_argument("--scale", default="0.5 mm/px")
    parser.add_argument("--fps", type=float, default=4000.0)
    parser.add_argument("--model", default="tustin")
    args = parser.parse_args()

    mass, sigma_mass = parse_quantity(args.mass, "kg", "mass")
    tracks, runs = [], []
    for film in args.films:
        tracks.append(ft.track(ft.open_recording(film, fps=args.fps)))
        displacement = ft.calibrate(ft.align_track(tracks[-1], tracks[0]), scale=args.scale)
        motion = ft.differentiate(ft.low_pass(displacement))
        runs.append(ft.Run(displacement, motion, mass=mass, sigma_mass=sigma_mass, name=film.stem))
        print(f"{film.name}: {len(displacement)} frames, at most {motion.v.max():.2f} m/s")

    fit = ft.fit(args.model, runs)
    print(fit.equation)
    diagnosis = ft.diagnose(fit)
    print(f"{diagnosis.verdict}: {', '.join(diagnosis.missing) or 'nothing'} missing")
    if diagnosis.best is None or not diagnosis.missing:
        return
    better = ft.fit(fit.model + diagnosis.best.effect, runs)
    before, after = (one.errors["heldout_rms_um"] for one in (fit, better))
    print(f"held out {before:.2f} um, with {diagnosis.best.effect} {after:.2f} um")
    print(better.equation)


if __name__ == "__main__":
    main()
