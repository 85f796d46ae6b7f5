"""Analyse a folder of recordings with one mass, scale and frame rate: study file, results, report.

    python pipelines/folder.py FOLDER --mass 0.35kg --scale 0.5mm/px --fps 4000

Begun again it does what is missing. Keys that differ between runs are written into FOLDER/study.toml by hand.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from frictrack.flow import Session, open_study, start_study

FILMS = {".avi", ".mp4", ".mov", ".mkv", ".cine", ".cih", ".cihx", ".tif", ".tiff"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--mass", required=True)
    parser.add_argument("--scale", required=True)
    parser.add_argument("--fps", type=float, required=True)
    args = parser.parse_args()

    path = args.folder / "study.toml"
    if not path.exists():
        films = sorted(film for film in args.folder.iterdir() if film.suffix.lower() in FILMS)
        start_study(path, films, {"mass": args.mass, "scale": args.scale, "fps": args.fps})
    session = Session(open_study(path), lambda done, total, what: print(f"{done} of {total} {what}"))
    found = session.run()
    for name, parameter in found["fit"]["parameters"].items():
        print(name, parameter["value"], parameter["unit"])
    print(found["diagnose"]["verdict"], found["diagnose"]["missing"])
    print(session.study.output / "report.html")


if __name__ == "__main__":
    main()
