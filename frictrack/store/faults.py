"""All that can be wrong with one file: its bytes, its schema, the checksums in it, its links to other files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py

from frictrack.errors import FrictrackError
from frictrack.store.apart import asked, serve
from frictrack.store.claims import once
from frictrack.store.door import REMEDY, border, copy
from frictrack.store.marks import is_ours
from frictrack.store.migrations import in_memory, migrated
from frictrack.store.seal import head
from frictrack.store.sums import wrong_sums


@dataclass(frozen=True)
class Fault:
    """What is wrong, where, and what to do."""

    file: Path
    group: str  # "/motion/x"; "" where it is the file
    what: str
    do: str
    kind: str = "damage"  # or "foreign", "link", "changed", "outdated", "missing", "leftover"

    @property
    def words(self) -> str:
        """One line."""
        return f"{', '.join(filter(None, (str(self.file), self.group)))}: {self.what}; {self.do}"


def check(path: Path) -> list[Fault]:
    """Every fault of one HDF5 file, none where it is sound. Nothing is raised whatever the file holds."""
    try:
        border(path, anew=True)
    except (FrictrackError, OSError) as e:
        return _hit(path, e)
    found = _inside(path, sealed=True) if is_ours(path) else _apart(path)
    if found is None:
        return [Fault(path, "", "HDF5 itself fails on it: it is damaged, or made to do harm", REMEDY)]
    return found


def _hit(path: Path, why: Exception) -> list[Fault]:
    """Of a file whose bytes are not those that were written: the groups hit, as far as HDF5 can still tell."""
    try:
        told = head(path)
    except OSError as e:
        return [Fault(path, "", f"cannot be read ({e.strerror})", "look at its rights and at the disk")]
    what, _, do = str(why).removeprefix(f"{path} ").rpartition("; ")
    if told is None or do == "update it":
        return [Fault(path, "", what, do)]
    inside = _apart(path)
    where = "HDF5 itself fails on them" if inside is None else "none of them in what is read"
    return inside or [Fault(path, "", f"some of its bytes are not those that were written, {where}", REMEDY)]


def _inside(path: Path, *, sealed: bool = False) -> list[Fault]:
    """What is wrong inside a file; where our own seal is whole, every checksum inside is that of its content."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            if "schema" not in file.attrs:
                return [Fault(path, "", "another program wrote it", "move it away", "foreign")]
            now = migrated(file)
            wrong = [Fault(path, name, what, REMEDY) for name, what in (() if sealed else wrong_sums(now))]
            return wrong + list(_links(path, now, "/", set()))
    except Exception as e:  # noqa: BLE001 - whatever h5py stumbles over in a damaged file
        return [Fault(path, "", f"is damaged or is not HDF5 ({' '.join(str(e).split())})", REMEDY)]


def _links(path: Path, file: h5py.File, inside: str, met: set[int]) -> Iterator[Fault]:
    """Links that show nothing, or something outside the folder; `met` are the groups above and beside."""
    once(file[inside], met)
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


def _apart(path: Path) -> list[Fault] | None:
    """What is wrong inside, looked for by a process of its own; None where it crashes or never returns."""
    found = asked(path)
    return None if found is None else [Fault(path, **told) for told in found]


def answer() -> None:
    """Be the process that looks into files for others."""
    serve(_told)


def _told(path: Path) -> list[dict[str, str]]:
    """What is wrong inside a file; one that will be read is copied too, as it is when something is written into it."""
    found = _inside(path)
    if all(fault.kind != "damage" for fault in found):
        with suppress(Exception), h5py.File(path, "r", locking=False) as old, in_memory() as new:
            copy(old, new)
    return [{k: v for k, v in vars(fault).items() if k != "file"} for fault in found]
