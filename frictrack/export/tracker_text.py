"""Export measured positions as text like the video program Tracker (Open Source Physics) does: one file per run.

The first line is the name of the track, the second one names the columns: t in s, x and y in m. Source:
``ExportDataDialog.saveAsAction`` and ``TrackerIO.getData`` of github.com/OpenSourcePhysics/tracker. `frictrack.study`
reads such a file as the table of a run.
"""

from __future__ import annotations

import numpy as np

from frictrack.export.formats import ExportedFiles
from frictrack.files import make_subfolder, replace_text
from frictrack.records import Displacement
from frictrack.results import BACKWARD, Results, RunResults

FOLDER = "tracker"


def write_txt(results: Results) -> ExportedFiles:
    """Write the texts into the folder `tracker`."""
    folder = make_subfolder(results.output, FOLDER)
    paths, lost = [], []
    for run in results.runs:
        paths.append(replace_text(folder / f"{run.name}.txt", _text(run)))
        left_out = len(run.displacement) - int(np.count_nonzero(run.displacement.known))
        if left_out:
            lost.append(f"{left_out} frames of {run.name} without a valid position, which are left out")
        further = [name for name in run.tracks if name != BACKWARD]
        if further:
            lost.append(f"further targets of {run.name} ({', '.join(further)}), whose positions --to trk writes")
    return ExportedFiles(tuple(paths), tuple(lost))


def _text(run: RunResults) -> str:
    """Return the text of one run; numbers have all digits."""
    d = run.displacement
    names = [name for name in ("t", "x", "y") if _is_measured(d, name)]
    rows = np.column_stack([getattr(d, name)[d.known] for name in names]).tolist()
    title = run.name.replace(" ", "_") + "\t" * (len(names) - 1)
    return "\n".join([title, "\t".join(names), *("\t".join(map(repr, row)) for row in rows), ""])


def _is_measured(displacement: Displacement, name: str) -> bool:
    return bool(np.all(np.isfinite(getattr(displacement, name)[displacement.known])))
