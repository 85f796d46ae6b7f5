"""List what the last bits of a result depend on: versions of the software, BLAS, operating system and processor."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from frictrack.version import __version__

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

    libraries = [
        one for one in threadpool_info() if one["user_api"] == "blas" and not _is_of_opencv(str(one["filepath"]))
    ]
    names = [f"{one['internal_api']} {one['version']} {one.get('architecture', '')}".strip() for one in libraries]
    return ", ".join(sorted(set(names))) or "unknown"


def _is_of_opencv(path: str) -> bool:
    """Return whether a library is that of OpenCV, which is loaded only where a film is read."""
    return "opencv" in path


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
