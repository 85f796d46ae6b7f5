"""List the files of a crate: the study file, what it was computed from, and the results.

A file lies in the crate where it lies beside the study file, so that the unpacked crate is a study like any other. An
input from outside the folder of the study gets a place in ``inputs/``. A recording of more than `MAX_INCLUDED_BYTES`
is described by its name, size and hash only, unless it is asked for; tables are always included.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from frictrack.base import __version__
from frictrack.base.errors import FrictrackError, os_errors_as, result_or_none
from frictrack.base.remote import RemoteFile, local_path, locate
from frictrack.flow import Session, hash_path
from frictrack.flow.pipeline import RunPipeline
from frictrack.recording import open_recording
from frictrack.study import Study, read_toml

MAX_EXPANSION = 200  # times the size of the zip file, above `MAX_UNPACKED_BYTES`; deflate reaches 1030
MAX_UNPACKED_BYTES = 1_000_000_000  # that any crate may unpack to
_NAME = re.compile(r'(?!\.\.?$)[^\x00-\x1f\\/:*?"<>|]{0,254}[^\x00-\x1f\\/:*?"<>|. ]')  # on Windows, too


def safe_place(text: str) -> str:
    """Return the path of a file in a crate, with slashes; it stays inside the crate on every operating system.

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
    """Unpack a zip file into a new folder; no file of it, whatever its name, gets to another place or is a link."""
    try:
        with zipfile.ZipFile(crate) as file:
            _check_size(crate, sum(info.file_size for info in file.infolist()), folder)
            file.extractall(folder)  # each file ends at the size that was declared; its checksum is compared
    except FrictrackError:
        raise
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, LookupError, RuntimeError, ValueError) as e:
        raise FrictrackError(f"{crate} is damaged or is not a zip file ({e}); fetch it again") from e
    except OSError as e:
        raise FrictrackError(f"cannot unpack {crate} into {folder}: {e.strerror or e}") from e


def _check_size(crate: Path, total: int, folder: Path) -> None:
    """Check the declared bytes of all files before anything is written."""
    size = crate.stat().st_size
    if total > max(MAX_UNPACKED_BYTES, MAX_EXPANSION * size):
        raise FrictrackError(
            f"expected a crate whose files unpack to {MAX_EXPANSION} times its size at most but those of {crate} "
            f"unpack to {total / size:.0f} times; it was not unpacked"
        )
    free = shutil.disk_usage(folder.parent).free
    if total > free:
        raise FrictrackError(
            f"expected {total / 1e9:.2f} GB of free disk for {crate} but there are {free / 1e9:.2f} GB"
        )


MAX_INCLUDED_BYTES = 10_000_000  # of one recording, all its files together, that is included without being asked for
METADATA = "ro-crate-metadata.json"
MOVED = "path in the study file"  # `propertyID` of where the crate has what the study file names otherwise
OUTSIDE = "inputs"  # folder in the crate of what lies outside the folder of the study
RESULTS = "results"  # the same of the results


@dataclass(frozen=True)
class Part:
    """One file of a crate."""

    source: Path  # the file on this machine, which need not exist of a crate that was read
    place: str  # its path in the crate, with slashes
    role: str  # "study", "input" or "result"
    size: int  # size, sha256: its bytes, and their SHA-256
    sha256: str
    is_film: bool = False  # whether it belongs to a film, which is not compressed again
    is_included: bool = True  # whether the crate contains it; else it is described by its hash

    @classmethod
    def read(cls, source: Path, place: str, role: str, *, is_film: bool = False, is_included: bool = True) -> Part:
        """Return the part of a file, with its size and hash."""
        with os_errors_as(f"cannot read {source}"):
            size = source.stat().st_size
            return cls(source, safe_place(place), role, size, hash_path(source), is_film, is_included)


@dataclass(frozen=True)
class Payload:
    """All files of a crate."""

    parts: tuple[Part, ...]  # the files
    moved: dict[str, str]  # place in the crate by the path in the study file, of what lies elsewhere in the crate
    results: str  # place of the folder of the results


def list_payload(session: Session, *, include_recordings: bool) -> Payload:
    """List all files of a crate, and hash them."""
    places = _Places(session.study)
    found: dict[Path, Part] = {}
    for source, place, role, film, included in _sources(session, places, include_recordings):
        if source not in found:
            session.progress(0, 0, f"hashing {source.name}")
            found[source] = Part.read(source, place, role, is_film=film, is_included=included)
    return Payload(tuple(found.values()), places.moved(), places.results)


def _sources(session: Session, places: _Places, with_films: bool) -> Iterator[tuple[Path, str, str, bool, bool]]:
    """Yield source, place, role, whether it is of a film, and whether it is included."""
    study = session.study
    yield _absolute(study.path), study.path.name, "study", False, True
    if study.prior_file is not None:
        yield _absolute(study.prior_file), places.of(study.prior_file), "input", False, True
    for pipeline in session.runs:
        for path in pipeline.input_files():
            is_film = path == pipeline.run.video
            files = _files(pipeline, path, is_film=is_film)
            small = sum(file.stat().st_size for file in files) <= MAX_INCLUDED_BYTES
            places.of(path)
            for file in files:
                place = places.of_part(path, file)
                yield file, place, "input", is_film, not is_film or small or with_films
    for path in _result_files(session):
        yield path, f"{places.results}/{path.relative_to(_absolute(study.output)).as_posix()}", "result", False, True


def _files(pipeline: RunPipeline, path: Path | RemoteFile, *, is_film: bool) -> list[Path]:
    """Return the files of an input, which may be a folder."""
    if is_film:
        film = pipeline.recording if isinstance(path, Path) else open_recording(local_path(path), fps=pipeline.run.fps)
        return [_absolute(file) for file in film.files if isinstance(file, Path)]  # all of them: a film is whole here
    local = _absolute(local_path(path))
    return sorted(file for file in local.iterdir() if file.is_file()) if local.is_dir() else [local]


def _result_files(session: Session) -> list[Path]:
    """Return the results that exist: HDF5 files, report, history, tests and predictions."""
    output = session.study.output
    files = [session.path, *(pipeline.path for pipeline in session.runs), output / "report.html"]
    files += [session.commands.path, session.budget.path, session.predictions.path]
    return [_absolute(path) for path in files if path.exists()]


class _Places:
    """Find the places of files in the crate, and remember those that are not where the study file says."""

    def __init__(self, study: Study) -> None:
        self._study = study
        self._folder = _absolute(study.folder)
        self._outside: dict[Path, str] = {}  # folder outside that of the study -> folder in the crate
        self._moved: dict[Path | str, str] = {}
        output = _absolute(study.output)
        inside = output.is_relative_to(self._folder) and output != self._folder
        self.results = output.relative_to(self._folder).as_posix() if inside else RESULTS
        self._moved[output] = self.results

    def of(self, path: Path | RemoteFile) -> str:
        """Return the place of a file or folder that the study file names."""
        local = _absolute(local_path(path))
        if not isinstance(path, RemoteFile) and local.is_relative_to(self._folder):
            place = local.relative_to(self._folder).as_posix()
        else:
            folder = self._outside.setdefault(local.parent, f"{OUTSIDE}/{len(self._outside) + 1}")
            place = f"{folder}/{local.name}"
        self._moved[path.url if isinstance(path, RemoteFile) else local] = place
        return place

    def of_part(self, path: Path | RemoteFile, file: Path) -> str:
        """Return the place of a file of an input: in its folder, or beside it."""
        local, place = _absolute(local_path(path)), self.of(path)
        if file.is_relative_to(local):
            return place if file == local else f"{place}/{file.relative_to(local).as_posix()}"
        return f"{place.rpartition('/')[0]}/{file.name}".lstrip("/")

    def moved(self) -> dict[str, str]:
        """Return the places by the texts of the study file that name what was moved."""
        raw = read_toml(self._study.path.name, self._study.path.read_text(encoding="utf-8"))
        texts = dict.fromkeys(text for *_, text in texts_in(raw) if text)
        found = {text: self._place(text) for text in texts}
        return {text: place for text, place in found.items() if place not in (None, text)}

    def _place(self, text: str) -> str | None:
        path = result_or_none(locate, text, self._folder)
        if path is None:  # no text that names a file
            return None
        return self._moved.get(path.url if isinstance(path, RemoteFile) else _absolute(path))


def texts_in(tables: Any) -> Iterator[tuple[Any, Any, str]]:
    """Yield container, key and value of every text in tables and lists."""
    items = tables.items() if isinstance(tables, dict) else enumerate(tables) if isinstance(tables, list) else ()
    for key, part in list(items):
        if isinstance(part, str):
            yield tables, key, str(part)
        else:
            yield from texts_in(part)


def _absolute(path: Path) -> Path:
    """Return the absolute path without ``..``; links are kept."""
    return Path(os.path.abspath(path))  # Path.absolute keeps "..", Path.resolve follows links


PACKAGES = {"numpy": "numpy", "scipy": "scipy", "h5py": "h5py", "opencv": "opencv-python-headless"}
CPU_INFO = Path("/proc/cpuinfo")
FRICTRACK = "frictrack"
MACHINE = ("operating system", "processor")  # what is no software package


def platform_versions() -> dict[str, str]:
    """Return the versions by name: frictrack, python, the packages, BLAS, operating system, processor.

    The same versions give the same results bit for bit: BLAS chooses its kernels by the processor.

    Examples
    --------
    >>> sorted(platform_versions())[:3]
    ['blas', 'frictrack', 'h5py']

    """
    found = {FRICTRACK: __version__, "python": f"{platform.python_implementation()} {platform.python_version()}"}
    found |= {name: _package_version(package) for name, package in PACKAGES.items()}
    return found | {"blas": _blas(), "operating system": _operating_system(), "processor": _processor()}


def _package_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # another distribution of the same module
        return "unknown"


def _blas() -> str:
    """Return the linear algebra that NumPy and SciPy were built with, and its kernels for this processor."""
    import numpy.linalg  # noqa: F401, PLC0415 - loads the library that is asked for
    import scipy.linalg  # noqa: F401, PLC0415
    from threadpoolctl import threadpool_info  # noqa: PLC0415 - as they

    # OpenCV, which is loaded only where a film is read, has a library of its own
    found = [one for one in threadpool_info() if one["user_api"] == "blas" and "opencv" not in str(one["filepath"])]
    names = [f"{one['internal_api']} {one['version']} {one.get('architecture', '')}".strip() for one in found]
    return ", ".join(sorted(set(names))) or "unknown"


def _operating_system() -> str:
    library = " ".join(part for part in platform.libc_ver() if part)
    release = platform.mac_ver()[0] or (platform.release() if platform.system() == "Windows" else library)
    return f"{platform.system()} {release} {platform.machine()}"


def _processor() -> str:
    try:
        lines = CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine() or "unknown"
