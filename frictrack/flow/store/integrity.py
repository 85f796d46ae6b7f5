"""Find all faults of one results file: its bytes, its schema, its links to other files.

HDF5 may crash or never return on malicious bytes. A file without this user's signature is therefore read in a separate
process first, together with the others of its folder.
"""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py

from frictrack.base.errors import FrictrackError
from frictrack.base.workers import limit_memory
from frictrack.flow.store.encoding import members, read_array
from frictrack.flow.store.file_header import file_state, read_header

MIN_TIMEOUT_S = 5.0  # for one file, and one second more for every `BYTES_PER_EXTRA_SECOND`
BYTES_PER_EXTRA_SECOND = 2e6
MAX_MEMORY_BYTES = 2 << 30  # of the separate process
_CHILD = "from frictrack.flow.store.integrity import run_check_process; run_check_process()"
_CHECKED: dict[tuple[Path, tuple[int, int, int]], list[dict[str, str]] | None] = {}  # by file and its state


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


REMEDY = "delete it and run again, the recordings are untouched"


def faults_inside(path: Path) -> list[Fault]:
    """Find the faults of a file whose header was checked: links, and those that HDF5 meets."""
    if read_header(path).is_signed:
        return _inside(path)
    found = _faults_in_sandbox(path)
    if found is None:
        return [Fault(path, "", "HDF5 itself fails on it: it is damaged, or made to do harm", REMEDY)]
    return [Fault(path, **fault) for fault in found]


def opens_safely(path: Path) -> bool:
    """Return whether this user wrote a file, or HDF5 can read all of it in a separate process."""
    return read_header(path).is_signed or all(fault.kind != "damage" for fault in faults_inside(path))


def _inside(path: Path, *, untrusted: bool = False) -> list[Fault]:
    """Find the faults inside a file; all of an untrusted one is read, and copied as when it is written to."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            if "schema" not in file.attrs:
                return [Fault(path, "", "another program wrote it", "move it away", "foreign")]
            if untrusted:
                _read_all(file, set())
                with h5py.File(io.BytesIO(), "w") as new:
                    copy_groups(file, new)
            return list(_links(path, file))
    except Exception as e:  # noqa: BLE001 - h5py raises any exception on a damaged file
        return [Fault(path, "", f"is damaged or is not HDF5 ({' '.join(str(e).split())})", REMEDY)]


def _read_all(group: h5py.Group, met: set[int]) -> None:
    """Read everything in a group; `met` are the addresses of groups that were read."""
    address = h5py.h5o.get_info(group.id).addr
    if address in met:  # groups inside themselves or each other would never end
        raise ValueError(f"expected every group in one place but {group.name} is in several")
    met.add(address)
    dict(group.attrs)
    for _, item in members(group):
        if isinstance(item, h5py.Group):
            _read_all(item, met)
        else:
            read_array(item)
            dict(item.attrs)


def copy_groups(old: h5py.File, new: h5py.File) -> None:
    """Copy all groups of a file into another one; links stay links."""
    new.attrs.update(old.attrs)
    for name in old:
        link = old.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink | h5py.SoftLink):
            new[name] = link
        else:
            old.copy(name, new)


def _links(path: Path, group: h5py.Group) -> Iterator[Fault]:
    """Find links that lead nowhere or out of the folder."""
    for name in group:
        link, full = group.get(name, getlink=True), f"{group.name.rstrip('/')}/{name}"
        if isinstance(link, h5py.ExternalLink):
            if Path(link.filename).name != link.filename:
                yield Fault(path, full, f"links to {link.filename}, outside its folder", "frictrack never wrote that")
            elif not (path.parent / link.filename).exists():
                yield Fault(path, full, f"links to {link.filename}, which is not there", "run the study", "link")
        elif isinstance(link, h5py.SoftLink):
            if name not in group:
                yield Fault(path, full, f"links to {link.path}, which is not there", "run the study", "link")
        elif isinstance(group[name], h5py.Group):
            yield from _links(path, group[name])


def _faults_in_sandbox(path: Path) -> list[dict[str, str]] | None:
    """Return the faults that the separate process finds in a file; None if it crashes or exceeds its time.

    One process checks all files of the folder that are still to be checked, since they are opened together.
    """
    key = path, file_state(path)
    if key not in _CHECKED:
        keys = [key, *_other_keys(path)]
        found = _run_check_process([one for one, _ in keys])
        _CHECKED.update(zip(keys, [*found, None], strict=False))  # the process ended at the file after the last one
    return _CHECKED[key]


def _other_keys(path: Path) -> Iterator[tuple[Path, tuple[int, int, int]]]:
    """Yield the other files of a folder, and their states, that the separate process has to check."""
    for other in sorted(path.parent.glob("[!.]*.h5")):
        with suppress(OSError):  # it is gone, or cannot be read
            key, header = (other, file_state(other)), read_header(other)
            if other != path and key not in _CHECKED and header.is_intact and not header.is_signed:
                yield key


def _run_check_process(paths: Sequence[Path]) -> list[Any]:
    """Return the faults of files in their order, of those before the first one that the process fails on."""
    asked = "".join(f"{json.dumps(str(path.absolute()))}\n" for path in paths).encode()
    call, timeout = [sys.executable, "-P", "-c", _CHILD], sum(map(_timeout, paths))
    try:
        said = subprocess.run(call, input=asked, timeout=timeout, check=False, capture_output=True).stdout
    except subprocess.TimeoutExpired as e:
        said = e.stdout or b""
    first, *lines = said.split(b"\n")
    if first != b"ready":
        raise FrictrackError(
            f"expected to open a file of another user in a separate process, but {sys.executable} starts none"
        )
    return [json.loads(line) for line in lines[:-1]]


def _timeout(path: Path) -> float:
    """Return the time that the check of a file may take, s."""
    return MIN_TIMEOUT_S + path.stat().st_size / BYTES_PER_EXTRA_SECOND


def run_check_process() -> None:
    """Check files for the parent process: paths in lines on stdin, the faults of each in a line on stdout."""
    limit_memory(MAX_MEMORY_BYTES)
    _say("ready")
    for line in sys.stdin:
        path = Path(json.loads(line))
        if hasattr(signal, "setitimer"):  # not on Windows; SIGALRM ends a process also within HDF5, and without parent
            signal.setitimer(signal.ITIMER_REAL, _timeout(path))
        found = _inside(path, untrusted=True)
        _say(json.dumps([{k: v for k, v in vars(fault).items() if k != "file"} for fault in found]))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
