"""Read the files of other programs as tables: which format a file has, and who reads it.

    video_projects     Tracker (Open Source Physics): .trk, .trz; Kinovea: .kva
    picture_tracks     DeepLabCut: .csv, .h5; movement: .nc; SLEAP: .h5; `hdf5_contents` reads HDF5 in another process;
                       DICe: a folder of solutions, or the solution of one subset; pyidi: .npy
    instruments        LabVIEW: .lvm, .tdms; MATLAB: .mat

A new format is one module and one line in `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from frictrack.study.table_layout import TableFile
from frictrack.study.track_formats import instruments, picture_tracks, video_projects

FOLDER = "/"  # in place of the end of a name


@dataclass(frozen=True)
class TrackFormat:
    """A format of tracks."""

    programs: str  # the programs that write it
    suffixes: tuple[str, ...]  # ends of the names of its files, or `FOLDER`
    read: Callable[[Path], TableFile]  # function that reads one; it raises `ValueError` if it cannot
    # function that says whether a file has this format, where other files end alike; None if none do
    is_one: Callable[[Path], bool] | None = None


TEXTS = (".txt", ".csv", ".tsv", ".dat")
HDF5 = (".h5", ".hdf5", ".nc")
FORMATS = (
    TrackFormat("LabVIEW", (".lvm",), instruments.read_labview_text),
    TrackFormat("LabVIEW", TEXTS, instruments.read_labview_text, instruments.is_labview_text),
    TrackFormat("LabVIEW", (".tdms",), instruments.read_tdms),
    TrackFormat("MATLAB", (".mat",), instruments.read_matlab),
    TrackFormat("NumPy", (".npz",), instruments.read_npz),
    TrackFormat("Tracker", (".trk", ".trz"), video_projects.read_tracker_project),
    TrackFormat("Kinovea", (".kva",), video_projects.read_kinovea_project),
    TrackFormat("Kinovea", (".xml",), video_projects.read_kinovea_project, video_projects.is_kinovea_project),
    TrackFormat("DeepLabCut", (".csv",), picture_tracks.read_deeplabcut_text, picture_tracks.is_deeplabcut_text),
    TrackFormat("DICe", TEXTS[:2], picture_tracks.read_dice, picture_tracks.is_dice_file),
    TrackFormat("DICe", (FOLDER,), picture_tracks.read_dice, picture_tracks.is_dice_folder),
    TrackFormat("DeepLabCut, movement or SLEAP", HDF5, picture_tracks.read_hdf5_tracks, picture_tracks.is_hdf5),
    TrackFormat("pyidi", (".npy",), picture_tracks.read_pyidi_displacements),
    TrackFormat("pyidi", (".pkl", ".pickle"), picture_tracks.refuse_pickle),
)


def find_track_format(path: Path) -> TrackFormat | None:
    """Return the format of a file or folder; None if it holds no tracks of another program."""
    suffix = FOLDER if path.is_dir() else path.suffix.lower()
    alike = (one for one in FORMATS if suffix in one.suffixes)
    return next((one for one in alike if one.is_one is None or one.is_one(path)), None)
