"""Unpack the zip file of a crate that anybody may have written: nothing leaves the folder or fills the disk."""

from __future__ import annotations

import re
import shutil
import stat
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from frictrack.errors import FrictrackError

MAX_FILES = 200_000  # in one crate; a folder of pictures has one file per frame
MAX_EXPANSION = 200  # times the size of the zip file, above `MAX_UNPACKED_BYTES`; deflate reaches 1030
MAX_UNPACKED_BYTES = 1_000_000_000  # that any crate may unpack to
COPY_BYTES = 1 << 20  # that are copied at once
_NAME = re.compile(r'(?!\.\.?$)[^\x00-\x1f\\/:*?"<>|]{0,254}[^\x00-\x1f\\/:*?"<>|. ]')  # on Windows, too


def safe_place(text: str) -> str:
    """Return the path of a file in a crate, with slashes; it stays inside the crate on every operating system.

    Parameters
    ----------
    text
        The path as the crate has it.

    Raises
    ------
    FrictrackError
        If it leads out of the crate, or no system can have such a file.

    Examples
    --------
    >>> safe_place("films/v3.avi")
    'films/v3.avi'

    """
    parts = PurePosixPath(text).parts
    if not parts or not all(_NAME.fullmatch(part) for part in parts):
        raise FrictrackError(
            f'expected the path of a file inside a crate, without \\ : * ? " < > |, but got {text[:200]!r}; '
            "rename it, or do not trust this crate"
        )
    return "/".join(parts)


def unpack(crate: Path, folder: Path) -> None:
    """Unpack a zip file into a new folder.

    Parameters
    ----------
    crate
        The zip file.
    folder
        The folder, which does not exist yet.

    Raises
    ------
    FrictrackError
        If it is no zip file, is damaged, would write outside the folder, or would unpack to far more than its size.

    """
    try:
        with zipfile.ZipFile(crate) as file:
            infos = [info for info in file.infolist() if not info.is_dir()]
            _check(crate, infos, folder)
            for info in infos:
                _copy(file, info, folder / safe_place(info.filename))
    except FrictrackError:
        raise
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, LookupError, RuntimeError, ValueError) as e:
        raise FrictrackError(f"{crate} is damaged or is not a zip file ({e}); fetch it again") from e
    except OSError as e:
        raise FrictrackError(f"cannot unpack {crate} into {folder}: {e.strerror or e}") from e


def _check(crate: Path, infos: list[zipfile.ZipInfo], folder: Path) -> None:
    """Check what the file declares before anything is written."""
    places = [safe_place(info.filename).casefold() for info in infos]
    if len(set(places)) < len(places):
        raise FrictrackError(f"expected every file of {crate} once but it has two of one name; it was not unpacked")
    if any(stat.S_ISLNK(info.external_attr >> 16) for info in infos):
        raise FrictrackError(f"expected files in {crate} but it has a link; it was not unpacked")
    total, size = sum(info.file_size for info in infos), crate.stat().st_size
    if len(infos) > MAX_FILES or total > max(MAX_UNPACKED_BYTES, MAX_EXPANSION * size):
        raise FrictrackError(
            f"expected a crate of at most {MAX_FILES} files that unpack to {MAX_EXPANSION} times its size but "
            f"{crate} has {len(infos)} that unpack to {total / size:.0f} times; it was not unpacked"
        )
    free = shutil.disk_usage(folder.parent).free
    if total > free:
        raise FrictrackError(
            f"expected {total / 1e9:.2f} GB of free disk for {crate} but there are {free / 1e9:.2f} GB"
        )


def _copy(file: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> None:
    """Copy one file; zipfile ends it at the size that was declared, and compares its checksum."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with file.open(info) as source, path.open("xb") as copy:
        shutil.copyfileobj(source, copy, COPY_BYTES)
