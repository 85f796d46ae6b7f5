"""Run a command as a process of its own, and measure its CPU time and its largest memory."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Spent:
    """What a command took: CPU time in s, its largest memory in MB, and what it printed."""

    cpu_s: float
    peak_MB: float
    printed: str
    code: int


def run_command(command: Sequence[str], folder: Path | None = None) -> Spent:
    """Run a command to its end, and measure it with all its children.

    Parameters
    ----------
    command
        Program and arguments.
    folder
        Where it runs.

    Returns
    -------
    Spent

    """
    # An installed package is compiled once; some shells forbid it, and every command would compile 500 files again.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=env)
    assert process.stdout is not None
    printed = process.stdout.read().decode()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    process.stdout.close()
    return Spent(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3, printed, process.returncode)


def frictrack(*arguments: str, folder: Path | None = None) -> Spent:
    """Run a command of frictrack in this Python."""
    return run_command([sys.executable, "-m", "frictrack", *arguments], folder)


def python(code: str, *arguments: str, folder: Path | None = None) -> Spent:
    """Run some Python code."""
    return run_command([sys.executable, "-c", code, *arguments], folder)


def median_of(repeats: int, command: Sequence[str], folder: Path | None = None) -> Spent:
    """Run a command several times after one that warms the disk cache; return the run of median CPU time."""
    run_command(command, folder)
    spent = sorted((run_command(command, folder) for _ in range(repeats)), key=lambda s: s.cpu_s)
    return spent[repeats // 2]
