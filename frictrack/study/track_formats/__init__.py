"""Read the files of other programs as tables: which format a file has, and who reads it.

    video_projects     Tracker (Open Source Physics): .trk, .trz; Kinovea: .kva
    picture_tracks     DeepLabCut: .csv, .h5; movement: .nc; SLEAP: .h5; `hdf5_contents` reads HDF5 in another process;
                       DICe: a folder of solutions, or the solution of one subset; pyidi: .npy
    instruments        LabVIEW: .lvm, .tdms; MATLAB: .mat; NumPy: .npz

A new format is one module and one line in `FORMATS`: command line and page know its files by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from frictrack.base import imported

if TYPE_CHECKING:
    from frictrack.study.table_layout import TableFile

FOLDER = "/"  # in place of the end of a name


@dataclass(frozen=True)
class TrackFormat:
    """A format of tracks. Its functions are named, so that the readers and pandas are loaded when a file is read."""

    programs: str  # the programs that write it
    suffixes: tuple[str, ...]  # ends of the names of its files, or `FOLDER`
    reader: str  # "module:function" of this package; the function returns a table, or raises `ValueError`
    test: str = ""  # the same of the function that says whether a file has this format, where other files end alike
    certain: bool = False  # whether every such file is a record: no other need be opened to list the recordings

    def read(self, path: Path) -> TableFile:
        """Read a file."""
        found: TableFile = imported(f"{__name__}.{self.reader}")(path)
        return found

    def is_one(self, path: Path) -> bool:
        """Return whether a file that ends so has this format."""
        return not self.test or bool(imported(f"{__name__}.{self.test}")(path))


TEXTS = (".txt", ".csv", ".tsv", ".dat")
HDF5 = (".h5", ".hdf5", ".nc")
PICKLES = (".pkl", ".pickle")  # are refused
FORMATS = (
    TrackFormat("LabVIEW", (".lvm",), "instruments:read_labview_text", certain=True),
    TrackFormat("LabVIEW", TEXTS, "instruments:read_labview_text", "instruments:is_labview_text"),
    TrackFormat("LabVIEW", (".tdms",), "instruments:read_tdms", certain=True),
    TrackFormat("MATLAB", (".mat",), "instruments:read_matlab"),
    TrackFormat("NumPy", (".npz",), "instruments:read_npz"),
    TrackFormat("Tracker", (".trk", ".trz"), "video_projects:read_tracker_project", certain=True),
    TrackFormat("Kinovea", (".kva",), "video_projects:read_kinovea_project", certain=True),
    TrackFormat("Kinovea", (".xml",), "video_projects:read_kinovea_project", "video_projects:is_kinovea_project"),
    TrackFormat("DeepLabCut", (".csv",), "picture_tracks:read_deeplabcut_text", "picture_tracks:is_deeplabcut_text"),
    TrackFormat("DICe", TEXTS[:2], "picture_tracks:read_dice", "picture_tracks:is_dice_file"),
    TrackFormat("DICe", (FOLDER,), "picture_tracks:read_dice", "picture_tracks:is_dice_folder"),
    TrackFormat("DeepLabCut, movement or SLEAP", HDF5, "picture_tracks:read_hdf5_tracks", "picture_tracks:is_hdf5"),
    TrackFormat("pyidi", (".npy",), "picture_tracks:read_pyidi_displacements"),
    TrackFormat("pyidi", PICKLES, "picture_tracks:refuse_pickle"),
)


def find_track_format(path: Path) -> TrackFormat | None:
    """Return the format of a file or folder; None if it holds no tracks of another program.

    Examples
    --------
    >>> find_track_format(Path("slide.TRK")).programs
    'Tracker'

    """
    suffix = FOLDER if path.is_dir() else path.suffix.lower()
    return next((one for one in FORMATS if suffix in one.suffixes and one.is_one(path)), None)
