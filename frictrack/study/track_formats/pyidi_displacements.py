"""Read displacements of pyidi that were saved as a NumPy array: (points, frames, 2) in px, rows (y) before columns (x).

pyidi itself saves ``results.pkl`` (``IDIMethod.save`` of github.com/ladisk/pyidi). A pickle can run any code when it is
opened, so it is refused; ``numpy.save`` writes what ``get_displacements`` returns without that risk.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from frictrack.study.table_cells import MAX_UNPACKED_BYTES, TableFile
from frictrack.study.track_formats.track_table import FRAMES, TargetPositions, table_of_tracks

SAVE = 'numpy.save("displacements.npy", displacements)'


def read_pyidi_displacements(path: Path) -> TableFile:
    """Read the displacements of points, by frame.

    Parameters
    ----------
    path
        A .npy file.

    Raises
    ------
    ValueError
        If it holds something else.

    """
    if (size := path.stat().st_size) > MAX_UNPACKED_BYTES:
        raise ValueError(f"{size / 1e6:.0f} MB; save fewer points")
    try:
        found = np.load(path, mmap_mode="r", allow_pickle=False)  # the size is checked before anything is read
    except Exception as e:  # damaged headers make NumPy fail in many ways
        raise ValueError(str(e) or type(e).__name__) from e
    if found.ndim != 3 or found.shape[2] != 2 or found.dtype.kind != "f":
        raise ValueError(f"expected displacements (points, frames, 2) but got {found.dtype} {found.shape}")
    frames = np.arange(found.shape[1], dtype=float)
    tracks = [
        TargetPositions(f"point {i}", frames, np.array(point[:, 1], dtype=float), np.array(point[:, 0], dtype=float))
        for i, point in enumerate(found)
    ]
    return table_of_tracks("pyidi", tracks, FRAMES)


def refuse_pickle(path: Path) -> TableFile:
    """Raise `ValueError`: opening a pickle could run any code."""
    raise ValueError(f"a pickle, which can run any code when it is opened, is never read; save with {SAVE}")
