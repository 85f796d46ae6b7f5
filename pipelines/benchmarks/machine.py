"""Describe the machine and the versions with which a benchmark was measured."""

from __future__ import annotations

import importlib.metadata
import platform
from pathlib import Path

import frictrack as ft


def described(*packages: str) -> dict[str, str]:
    """Python, processor, frictrack, and the versions of some packages."""
    versions = {name: importlib.metadata.version(name) for name in packages}
    return {"python": platform.python_version(), "cpu": _cpu(), "frictrack": ft.__version__} | versions


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
