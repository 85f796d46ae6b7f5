"""Provide sample data: four films with a hidden effect, the same slides as arrays, and two published measurements.

import frictrack as ft
fit = ft.fit("tustin", ft.samples.runs())
study = ft.samples.copy_films("my_folder")      # then: frictrack run my_folder
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.arguments import checked
from frictrack.records import Run

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["carriage", "copy_films", "films_folder", "runs", "strokes"]

DATA = Path(__file__).parent / "data"
STUDY_FILES = ("*.avi", "study.toml", "truth.json")
TRACKING_NOISE = 0.7e-6  # m, of one frame: 0.0014 px at 0.5 mm/px


def films_folder() -> Path:
    """Return the folder of the sample films: within an installed package, or in a checkout of the project.

    Returns
    -------
    Path
        Folder with four films (`*.avi`), study.toml, scene.toml (what was rendered) and truth.json.

    Examples
    --------
    >>> import frictrack as ft
    >>> sorted(path.stem for path in ft.samples.films_folder().glob("*.avi"))
    ['double_mass', 'fast', 'slow', 'to_a_stop']

    """
    installed = Path(__file__).parent / "films"  # put there when the wheel is built
    return installed if installed.exists() else Path(__file__).parents[2] / "sample_videos"


@checked
def copy_films(folder: Path | str) -> Path:
    """Copy the sample study, four films of 4000 frames/s with a study file, into a folder.

    Parameters
    ----------
    folder
        Where to; created if it does not exist.

    Returns
    -------
    Path
        The study file.

    Raises
    ------
    OSError
        If the folder cannot be written.

    Examples
    --------
    >>> import frictrack as ft
    >>> import tempfile
    >>> ft.samples.copy_films(tempfile.mkdtemp()).name
    'study.toml'

    """
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    for pattern in STUDY_FILES:
        for path in films_folder().glob(pattern):
            shutil.copyfile(path, target / path.name)
    return target / "study.toml"


@checked
def runs(rng: np.random.Generator | int | None = 0) -> list[Run]:
    """Make the four slides of the sample films of arrays, without any film.

    The true positions of the films, with the noise of a tracked frame (0.7 um). The friction is Tustin's
    (F_c = 0.9 N, F_s = 1.3 N, v_s = 0.4 m/s, F_v = 0.04 N s/m), and one stretch of the course rubs harder.

    Parameters
    ----------
    rng
        Random generator of the noise, or its seed.

    Returns
    -------
    list of Run
        "fast" (6 m/s), "slow" (3 m/s), "to_a_stop" (0.44 m/s) and "double_mass" (4 m/s), at 4000 frames/s.

    Examples
    --------
    >>> import frictrack as ft
    >>> [run.name for run in ft.samples.runs()]
    ['fast', 'slow', 'to_a_stop', 'double_mass']

    """
    rng = np.random.default_rng(rng)
    truth = json.loads((films_folder() / "truth.json").read_text(encoding="utf-8"))
    return [_slide(slide, rng) for slide in truth["runs"]]


def _slide(slide: dict[str, Any], rng: np.random.Generator) -> Run:
    """Make one run of the true positions of a film."""
    x = np.array(slide["x_m"])
    t = np.arange(len(x)) / slide["camera"]["fps"]
    seen = x + TRACKING_NOISE * rng.standard_normal(len(x))
    return Run.from_arrays(t, seen, mass=slide["mass"], name=slide["name"])


def strokes() -> pd.DataFrame:
    """Read four strokes to and fro of a tribometer under 5 N; its load cell measured the friction.

    Returns
    -------
    pandas.DataFrame
        3100 rows at 200 Hz: "Time [s]", "Normal [uN]", "Position [mm]" and "Friction [uN]", whose sign is
        opposite to that of the velocity.

    References
    ----------
    J. Christopherson, FrictionModels.jl (MIT licence, beside the data).

    Examples
    --------
    >>> import frictrack as ft
    >>> columns = {"t": "Time [s]", "x": "Position [mm]", "friction": "-Friction [uN]"}
    >>> run = ft.Run.from_dataframe(ft.samples.strokes()[900:1700], columns=columns, name="strokes", normal_load=5.0)
    >>> f"{abs(run.friction_N).max():.1f} N"
    '2.6 N'

    """
    import pandas as pd  # noqa: PLC0415 - slow to import

    return pd.read_csv(DATA / "tribometer" / "strokes.txt", sep="\t")


def carriage() -> pd.DataFrame:
    """Read the motion of a machine's carriage with the force of its motor, a benchmark of system identification.

    Returns
    -------
    pandas.DataFrame
        Columns "t_s", "x_m" and "drive_N", at 200 Hz.

    References
    ----------
    A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS", Workshop on Nonlinear System
    Identification Benchmarks, 2019 (a decimated extract).

    Examples
    --------
    >>> import frictrack as ft
    >>> table = ft.samples.carriage()
    >>> list(table.columns)
    ['t_s', 'x_m', 'drive_N']

    """
    import pandas as pd  # noqa: PLC0415

    x, drive = np.loadtxt(DATA / "emps_200Hz.csv", delimiter=",").T
    return pd.DataFrame({"t_s": np.arange(len(x)) / 200.0, "x_m": x, "drive_N": drive})
