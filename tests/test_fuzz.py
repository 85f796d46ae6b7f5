"""Any damage to a valid file of any kind is taken, or is one sentence; nothing crashes, hangs or asks for the moon.

Inputs come from Hypothesis, targets from `pipelines/fuzz`, where Atheris looks for longer and is guided by coverage.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

FUZZ = Path(__file__).resolve().parents[1] / "pipelines" / "fuzz"
CONTAINERS = ("avi", "mp4", "mkv")  # FFmpeg has a minute of its own in test_recording_damaged
NAMES = (
    *("tiff", "cine", "cih", "cihx", "folder", *CONTAINERS),
    *("study", "address", "crate", "described", "scene", "formula", "unit", "scale", "lens", "log"),
    # .mat files are read in a process of their own, half a second each
    *("table", "labview", "waveforms", "sheet", "workbook", "sensor", "store"),
)
PIECES = (
    *(
        b"\0",
        b"\n",
        b"\r",
        b"nan",
        b"-inf",
        b"1e308",
        b"1e999",
        b"-1",
        b"9" * 400,
        b"**9",
        b"^",
        b"../",
        b"<",
        b"&",
        b"%n",
    ),
    *(b'"', b"'", b"[", b"]", b"{", b"}", b"(", b")", b"=", b",", b";", b"\t"),
    *(b"\xef\xbb\xbf", b"\xff\xfe", b"\xc3", b"\xe2\x80\xae"),  # byte order marks, half a letter, right to left
    *(b"\xff" * 4, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0" * 8, b"\0\0\0\1"),
)
MAX_ERROR_LENGTH = 10.0  # s


@st.composite
def damaged(draw: st.DrawFn, seeds: list[bytes]) -> bytes:
    """A valid input cut off, or with bits, numbers, pieces and stretches of it changed; the head is hit most often."""
    data = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.one_of(st.integers(0, min(len(data), 400)), st.integers(0, len(data))))
        end = at + draw(st.integers(0, 40))
        piece = draw(st.sampled_from(PIECES))
        kind = draw(st.integers(0, 6))
        if kind == 0:
            del data[at:]
        elif kind == 1:
            data[at : at + 1] = bytes(b ^ (1 << draw(st.integers(0, 7))) for b in data[at : at + 1])
        elif kind == 2:
            data[at : at + len(piece)] = piece
        elif kind == 3:
            data[at:at] = piece
        elif kind == 4:
            del data[at:end]
        elif kind == 5:
            data[at:at] = data[at:end] * draw(st.integers(1, 20))
        else:
            data[at:end] = bytes(len(data[at:end]))
    return bytes(data)


def look(name: str, examples: int, last: Path) -> None:
    """One target on so many inputs; the last of them is kept in a file, should the process not come back."""
    import targets  # noqa: PLC0415

    target = targets.TARGETS[name]
    valid = target.seeds()
    whole = [seed.decode().encode("utf-16") for seed in valid] if name in ("study", "table", "sensor") else []
    for seed in [*valid, *whole, b""]:
        with tempfile.TemporaryDirectory() as folder:
            targets.excused(target, seed, Path(folder))

    @settings(
        max_examples=examples, derandomize=True, deadline=None, database=None, suppress_health_check=[*HealthCheck]
    )
    @given(damaged(valid))
    def stands(data: bytes) -> None:
        last.write_bytes(data)
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            targets.excused(target, data, Path(folder))
        assert time.perf_counter() - start < MAX_ERROR_LENGTH

    stands()


def main(names: list[str], examples: int, last: Path) -> None:
    """The process of one group, its memory bounded."""
    from targets import bounded  # noqa: PLC0415

    warnings.simplefilter("ignore")
    bounded()
    for name in names:
        sys.stderr.write(f"target {name}\n")
        look(name, examples, last)


def in_another_process(names: Any, examples: int, folder: Path) -> None:
    """A crash of a library beneath must not take the tests with it."""
    code = (
        f"import sys; sys.path[:0] = [{str(FUZZ)!r}, {str(Path(__file__).parent)!r}]\n"
        "from pathlib import Path; import test_fuzz\n"
        f"test_fuzz.main({list(names)!r}, {examples}, Path({str(folder / 'last')!r}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, f"{folder / 'last'} ended with {done.returncode}: {done.stderr[-4000:]}"


@pytest.mark.skipif(sys.platform != "linux", reason="bounds the memory of a process")
def test_damage_of_any_kind_is_taken_or_told(tmp_path: Path) -> None:
    in_another_process(NAMES, 12, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_more_damage(tmp_path: Path, name: str) -> None:
    in_another_process([name], 3000, tmp_path)
