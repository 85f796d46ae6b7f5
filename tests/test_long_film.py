"""A recording larger than memory is tracked in bounded memory, and only the target's surroundings are read."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from film import block_film

SIDE, N = 2048, 4900  # 20.5 GB at 8 bit
HEADER = """#Camera Information Header
Record Rate(fps) : 4000
Shutter Speed(s) : 1/20000
Total Frame : {n}
Start Frame : 0
Image Width : {side}
Image Height : {side}
Color Type : Mono
Color Bit : 8
EffectiveBit Depth : 8
EffectiveBit Side : Lower
File Format : MRaw
"""

TRACKER = r"""
import re, sys
import numpy as np
import frictrack as ft

track = ft.track(ft.open_recording(sys.argv[1]), [24, 1012, 44, 28])
with open("/proc/self/status") as status:  # the peak of getrusage starts with that of the parent
    peak = int(re.search(r"VmHWM:\s+(\d+)", status.read())[1]) / 1024
truth = np.load(sys.argv[2])
off = track.x_px - truth
print(int(track.found.sum()), float(np.nanstd(off)), peak)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs files with holes")
def test_twenty_gigabytes(tmp_path: Path):
    """The film is a sparse file: only the rows that the target crosses hold anything."""
    x = 50 + 100 * (1 - np.cos(np.arange(N) / 400)) / 2
    strip = block_film(x, size=(36, 52), shape=(64, 224))
    (tmp_path / "long.cih").write_text(HEADER.format(n=N, side=SIDE))
    with (tmp_path / "long.mraw").open("wb") as film:
        for i in range(N):
            for row, line in enumerate(strip.frame(i)):
                film.seek(i * SIDE * SIDE + (994 + row) * SIDE)
                film.write(line.tobytes())
        film.truncate(N * SIDE * SIDE)
    np.save(tmp_path / "truth.npy", x)
    assert (tmp_path / "long.mraw").stat().st_size > 20e9
    arguments = [sys.executable, "-c", TRACKER, str(tmp_path / "long.mraw"), str(tmp_path / "truth.npy")]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    found, error, peak = (float(v) for v in done.stdout.split())
    assert found == N
    assert error < 0.005
    assert peak < 1000, f"{peak:.0f} MB resident"
