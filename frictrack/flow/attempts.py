"""Keep fits of the current model with one more effect, so that a candidate is shown, or added, without fitting again.

Each is a file ``.frictrack/attempts/KEY.h5`` in the folder of the results. KEY is the hash of everything that the fit
depends on, so that the fit of another model, of other runs or other settings is never found.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from frictrack import store
from frictrack.errors import FrictrackError
from frictrack.files import INTERNAL_FOLDER, make_internal_folder, make_subfolder

FOLDER = "attempts"
MAX_KEPT = 60  # files; the oldest are removed first
KEY_LENGTH = 32  # characters of the hash in a file name


def attempt_path(output: Path, key: str) -> Path:
    """Return the file that holds a fit if it was attempted.

    Parameters
    ----------
    output
        Folder of the results.
    key
        Hash of everything that the fit depends on.

    """
    return output / INTERNAL_FOLDER / FOLDER / f"{key[:KEY_LENGTH]}.h5"


def stored_attempt(output: Path, key: str) -> tuple[Path, str] | None:
    """Return file and group of an attempted fit; None if there is none, or if it cannot be read.

    Parameters
    ----------
    output
        Folder of the results.
    key
        Hash of everything that the fit depends on.

    """
    path = attempt_path(output, key)
    if not path.exists():
        return None
    try:
        group = next(iter(store.names(path, "models")), None)
        made = store.provenance(path, f"models/{group}") if group else None
    except FrictrackError:
        return None
    return (path, str(group)) if made is not None and made.key == key else None


def make_attempts_folder(output: Path) -> Path:
    """Create the folder of the attempts, remove the oldest of too many, and return it.

    Parameters
    ----------
    output
        Folder of the results.

    """
    folder = make_subfolder(make_internal_folder(output), FOLDER)
    files = sorted(folder.glob("[!.]*.h5"), key=lambda path: path.stat().st_mtime_ns)
    for path in files[: max(len(files) - MAX_KEPT + 1, 0)]:
        with suppress(OSError):
            path.unlink()
    return folder
