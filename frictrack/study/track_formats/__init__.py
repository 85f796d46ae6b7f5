"""Read the files of other programs as tables: which format a file has, and who reads it.

    tracker_project      Tracker (Open Source Physics): .trk, .trz
    kinovea_project      Kinovea: .kva
    deeplabcut           DeepLabCut: .csv
    hdf5_tracks          DeepLabCut .h5, movement .nc, SLEAP .h5; `hdf5_contents` reads them in another process
    dice_solution        DICe: a folder of solutions, or the solution of one subset
    pyidi_displacements  pyidi: .npy
    instruments          LabVIEW: .lvm, .tdms; MATLAB: .mat
    track_table          positions of several tracks -> one table

A new format is one module and one line in `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from frictrack.study.table_layout import TableFile
from frictrack.study.track_formats.image_correlation import (
    is_dice_file,
    is_dice_folder,
    read_dice,
    read_pyidi_displacements,
    refuse_pickle,
)
from frictrack.study.track_formats.instruments import (
    is_labview_text,
    read_labview_text,
    read_matlab,
    read_tdms,
)
from frictrack.study.track_formats.pose_tracks import (
    is_deeplabcut_text,
    is_hdf5,
    read_deeplabcut_text,
    read_hdf5_tracks,
)
from frictrack.study.track_formats.video_projects import is_kinovea_project, read_kinovea_project, read_tracker_project

FOLDER = "/"  # in place of the end of a name


@dataclass(frozen=True)
class TrackFormat:
    """A format of tracks.

    Parameters
    ----------
    programs
        The programs that write it.
    suffixes
        Ends of the names of its files, or `FOLDER`.
    read
        Function that reads one; it raises `ValueError` if it cannot.
    is_one
        Function that says whether a file has this format, where other files end alike; None if none do.

    """

    programs: str
    suffixes: tuple[str, ...]
    read: Callable[[Path], TableFile]
    is_one: Callable[[Path], bool] | None = None


FORMATS = (
    TrackFormat("LabVIEW", (".lvm",), read_labview_text),
    TrackFormat("LabVIEW", (".txt", ".csv", ".tsv", ".dat"), read_labview_text, is_labview_text),
    TrackFormat("LabVIEW", (".tdms",), read_tdms),
    TrackFormat("MATLAB", (".mat",), read_matlab),
    TrackFormat("Tracker", (".trk", ".trz"), read_tracker_project),
    TrackFormat("Kinovea", (".kva",), read_kinovea_project),
    TrackFormat("Kinovea", (".xml",), read_kinovea_project, is_kinovea_project),
    TrackFormat("DeepLabCut", (".csv",), read_deeplabcut_text, is_deeplabcut_text),
    TrackFormat("DICe", (".txt", ".csv"), read_dice, is_dice_file),
    TrackFormat("DICe", (FOLDER,), read_dice, is_dice_folder),
    TrackFormat("DeepLabCut, movement or SLEAP", (".h5", ".hdf5", ".nc"), read_hdf5_tracks, is_hdf5),
    TrackFormat("pyidi", (".npy",), read_pyidi_displacements),
    TrackFormat("pyidi", (".pkl", ".pickle"), refuse_pickle),
)


def find_track_format(path: Path) -> TrackFormat | None:
    """Return the format of a file or folder; None if it holds no tracks of another program.

    Parameters
    ----------
    path
        The file or folder, which exists.

    """
    suffix = FOLDER if path.is_dir() else path.suffix.lower()
    alike = (one for one in FORMATS if suffix in one.suffixes)
    return next((one for one in alike if one.is_one is None or one.is_one(path)), None)
