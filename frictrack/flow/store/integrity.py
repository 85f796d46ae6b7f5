"""Find all faults of one results file: its bytes, its schema, its checksums, its links to other files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py

from frictrack.base.errors import FrictrackError
from frictrack.flow.store.checksums import check_visited_once, wrong_checksums
from frictrack.flow.store.encoding import empty_file_in_memory, migrate
from frictrack.flow.store.file_header import check_in_sandbox, is_signed_by_user, read_header, run_sandbox_process
from frictrack.flow.store.hdf5_io import REMEDY, check_header, copy_groups


@dataclass(frozen=True)
class Fault:
    """One fault: what is wrong, where, and what to do."""

    file: Path
    group: str  # "/motion/x"; "" where it is the file
    what: str
    do: str
    kind: str = "damage"  # or "foreign", "link", "changed", "outdated", "missing", "leftover"

    @property
    def words(self) -> str:
        """The fault in one line."""
        return f"{', '.join(filter(None, (str(self.file), self.group)))}: {self.what}; {self.do}"


def check(path: Path) -> list[Fault]:
    """Find every fault of one HDF5 file. Nothing is raised, whatever the file holds."""
    try:
        check_header(path, reread=True)
    except (FrictrackError, OSError) as e:
        return _damaged_groups(path, e)
    found = _inside(path, sealed=True) if is_signed_by_user(path) else _inside_in_sandbox(path)
    if found is None:
        return [Fault(path, "", "HDF5 itself fails on it: it is damaged, or made to do harm", REMEDY)]
    return found


def _damaged_groups(path: Path, why: Exception) -> list[Fault]:
    """Name the damaged groups of a file whose bytes have changed, as far as HDF5 can still read it."""
    try:
        header = read_header(path)
    except OSError as e:
        return [Fault(path, "", f"cannot be read ({e.strerror})", "look at its rights and at the disk")]
    what, _, do = str(why).removeprefix(f"{path} ").rpartition("; ")
    if header is None or do == "update it":
        return [Fault(path, "", what, do)]
    inside = _inside_in_sandbox(path)
    where = "HDF5 itself fails on them" if inside is None else "none of them in what is read"
    return inside or [Fault(path, "", f"some of its bytes are not those that were written, {where}", REMEDY)]


def _inside(path: Path, *, sealed: bool = False) -> list[Fault]:
    """Find the faults inside a file; with an intact header, all checksums inside are right."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            if "schema" not in file.attrs:
                return [Fault(path, "", "another program wrote it", "move it away", "foreign")]
            now = migrate(file)
            wrong = [Fault(path, name, what, REMEDY) for name, what in (() if sealed else wrong_checksums(now))]
            return wrong + list(_links(path, now, "/", set()))
    except Exception as e:  # noqa: BLE001 - h5py raises any exception on a damaged file
        return [Fault(path, "", f"is damaged or is not HDF5 ({' '.join(str(e).split())})", REMEDY)]


def _links(path: Path, file: h5py.File, inside: str, met: set[int]) -> Iterator[Fault]:
    """Find links that lead nowhere or out of the folder; `met` are the groups that were visited."""
    check_visited_once(file[inside], met)
    for name in file[inside]:
        link, full = file.get(f"{inside}{name}", getlink=True), f"{inside}{name}"
        if isinstance(link, h5py.ExternalLink):
            target = path.parent / link.filename
            if Path(link.filename).name != link.filename:
                yield Fault(path, full, f"links to {link.filename}, outside its folder", "frictrack never wrote that")
            elif not target.exists():
                yield Fault(path, full, f"links to {link.filename}, which is not there", "run the study", "link")
        elif isinstance(link, h5py.SoftLink):
            if full not in file:
                yield Fault(path, full, f"links to {link.path}, which is not there", "run the study", "link")
        elif isinstance(file[full], h5py.Group):
            yield from _links(path, file, f"{full}/", met)


def _inside_in_sandbox(path: Path) -> list[Fault] | None:
    """Find the faults inside a file in a separate process; None if it crashes or never returns."""
    found = check_in_sandbox(path)
    return None if found is None else [Fault(path, **fault) for fault in found]


def run_check_process() -> None:
    """Run the process that checks files for others; see `frictrack.flow.store.file_header`."""
    run_sandbox_process(_faults_as_dicts)


def _faults_as_dicts(path: Path) -> list[dict[str, str]]:
    """Find the faults inside a file; one that is sound is also copied, as it is when it is written to."""
    found = _inside(path)
    if all(fault.kind != "damage" for fault in found):
        with suppress(Exception), h5py.File(path, "r", locking=False) as old, empty_file_in_memory() as new:
            copy_groups(old, new)
    return [{k: v for k, v in vars(fault).items() if k != "file"} for fault in found]
