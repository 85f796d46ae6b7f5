"""Photron and Phantom: real extracts with greys read by others, and hand-packed films of every bit depth."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from camera_films import write_cine, write_photron

from frictrack.base.errors import FrictrackError
from frictrack.recording import open_recording

CAMERAS = Path(__file__).parent / "data" / "cameras"
N, H, W = 5, 16, 24


def grey(bits, shape=(N, H, W), seed=2):
    return np.random.default_rng(seed).integers(0, 1 << bits, shape).astype(np.uint8 if bits == 8 else np.uint16)


# ---- real extracts; grey values and sums were read with pyMRAW, PIMS and cine-handler

REAL = {
    "ball_12bit.cihx": dict(n=4, shape=(16, 384), depth=12, fps=30000, exposure=2e-5, trigger=-52),
    "ball_12bit.mraw": dict(n=4, shape=(16, 384), depth=12, fps=30000, exposure=2e-5, trigger=-52),
    "sample_16bit.cih": dict(n=4, shape=(40, 128), depth=12, fps=60000 / 36, exposure=1.25e-6, trigger=-1369),
    "showcase_8bit.cih": dict(n=4, shape=(40, 160), depth=8, fps=150, exposure=6.506e-5, trigger=0),
    "p10.cine": dict(n=5, shape=(32, 256), depth=12, fps=100, exposure=7e-5, trigger=0),
    "raw_12_in_16.cine": dict(n=4, shape=(16, 256), depth=12, fps=9003.2, exposure=9.6965e-6, trigger=5417),
}


@pytest.mark.parametrize("name", REAL)
def test_header_of_real_files(name):
    rec, want = open_recording(CAMERAS / name), REAL[name]
    assert (rec.n_frames, rec.shape, rec.bit_depth) == (want["n"], want["shape"], want["depth"])
    assert rec.fps == pytest.approx(want["fps"], rel=1e-5)
    assert rec.exposure == pytest.approx(want["exposure"], rel=1e-4)
    assert rec.trigger == want["trigger"]
    assert rec.direct


PIXELS = {
    "ball_12bit.cihx": (
        [25159680, 25159680, 25159680, 25159680],
        {(1, 8, 289): 4095, (3, 0, 55): 4095, (3, 15, 95): 4095, (1, 13, 162): 4095},
    ),
    "sample_16bit.cih": (
        [8135724, 8267054, 8370961, 7989347],
        {(1, 20, 96): 1391, (3, 1, 18): 3604, (3, 37, 31): 886, (1, 34, 54): 1243},
    ),
    "showcase_8bit.cih": (
        [644591, 646749, 649900, 649704],
        {(1, 20, 120): 7, (3, 1, 23): 104, (3, 37, 39): 28, (1, 34, 67): 109},
    ),
    "p10.cine": (
        [9059479, 9018781, 9145122, 9046613, 33161216],
        {(2, 16, 193): 244, (4, 1, 36): 4048, (4, 30, 63): 4048, (1, 27, 108): 51},
    ),
    "raw_12_in_16.cine": (
        [10592811, 10573370, 10552327, 10568228],
        {(1, 8, 193): 2816, (3, 0, 36): 2885, (3, 15, 63): 2871, (1, 13, 108): 2354},
    ),
}


@pytest.mark.parametrize("name", PIXELS)
def test_pixels_of_real_files(name):
    frames = np.array(list(open_recording(CAMERAS / name).frames()))
    sums, spots = PIXELS[name]
    # P10: the maker's table rounds differently by one count here and there
    slack = 1 if name == "p10.cine" else 0
    np.testing.assert_allclose(frames.sum((1, 2), dtype=np.int64), sums, rtol=1e-3 * slack)
    assert all(abs(int(frames[at]) - value) <= slack for at, value in spots.items())


def test_a_save_step_divides_the_rate():
    notes = open_recording(CAMERAS / "sample_16bit.cih").notes
    assert notes == (
        "the header names 60000 fps while filming and a save step of 36: only one frame in 36 is in the file, "
        "so its own rate is 1666.67 fps",
    )


def test_stamps_win_over_a_wrong_header():
    rec = open_recording(CAMERAS / "raw_12_in_16.cine")
    assert rec.notes == (
        "the frame rate of the file's header is 90000 fps but that of the time stamps is 9003.22 fps; "
        "9003.22 fps is used",
    )
    np.testing.assert_allclose(np.diff(rec.t), 1 / 9003.22, rtol=1e-5)
    assert rec.stamps[0] == pytest.approx(-5417 / 9003.2, rel=1e-4)  # from the trigger: the two fields agree


def test_a_corrupt_last_stamp_is_passed_over():
    rec = open_recording(CAMERAS / "p10.cine")
    assert rec.notes == ("1 time stamp is corrupt: frame 4; passed over",)
    np.testing.assert_allclose(rec.t, np.arange(5) / 100)


def test_companding_is_the_inverse_of_bt709():
    """Codes and grey values from the maker's printed table, which rounds differently by one count here and there."""
    codes = np.array([[1, 12, 64, 140, 300, 500, 700, 900, 1000, 1014, 1015, 1023]])
    printed = [5, 16, 64, 136, 374, 952, 1872, 3159, 3947, 4064, 4095, 4095]
    from frictrack.recording.phantom import _LINEAR_12_BIT  # noqa: PLC0415

    assert np.abs(_LINEAR_12_BIT[codes].astype(int) - printed).max() <= 1
    assert np.all(np.diff(_LINEAR_12_BIT.astype(int)) >= 0)


# ---- hand-packed films


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("write", [write_photron, write_cine])
def test_boxes_of_hand_packed_films(tmp_path, write, bits):
    truth = grey(bits)
    rec = open_recording(write(tmp_path, truth, bits))
    if bits == 10 and write is write_cine:
        from frictrack.recording.phantom import _LINEAR_12_BIT  # noqa: PLC0415

        truth = _LINEAR_12_BIT[truth]
    assert rec.direct
    np.testing.assert_array_equal(rec.pick(range(N)), truth)
    rng = np.random.default_rng(5)
    for h, w in ((1, 1), (5, 6), (7, 9), (H, W), (H, 3), (2, W)):
        indices = rng.integers(0, N, 40)
        corners = np.column_stack([rng.integers(0, W - w + 1, 40), rng.integers(0, H - h + 1, 40)])
        boxes = rec.cut(indices, corners, (h, w))
        assert boxes.dtype == (np.uint8 if bits == 8 else np.uint16)
        for box, i, (x, y) in zip(boxes, indices, corners, strict=True):
            np.testing.assert_array_equal(box, truth[i, y : y + h, x : x + w])


def test_pictures_stored_from_the_top_and_padded_rows(tmp_path):
    truth = grey(8, (N, H, W + 1))
    padded = np.zeros((N, H, W + 4), np.uint8)
    padded[..., : W + 1] = truth
    path = write_cine(tmp_path, padded, 8, upward=False)
    data = bytearray(path.read_bytes())
    struct.pack_into("<i", data, 44 + 4, W + 1)
    path.write_bytes(data)
    np.testing.assert_array_equal(open_recording(path).pick(range(N)), truth)


def test_values_in_the_high_bits_and_the_other_byte_order(tmp_path):
    truth = grey(12)
    high = open_recording(write_photron(tmp_path, truth << 4, 16, depth=12, side="Higher"))
    np.testing.assert_array_equal(high.pick(range(N)), truth)
    assert high.bit_depth == 12
    (tmp_path / "b").mkdir()
    other = open_recording(write_photron(tmp_path / "b", truth, 16, depth=12, order=">"))
    np.testing.assert_array_equal(other.pick(range(N)), truth)


@pytest.mark.parametrize(
    ("written", "seconds"),
    [("119149.0", 1 / 119149), ("1/15371", 1 / 15371), ("0.00002", 2e-5), ("Frame", None), ("0", None), ("1/0", None)],
)
def test_shutter_is_read_whatever_its_unit(tmp_path, written, seconds):
    exposure = open_recording(write_photron(tmp_path, grey(8), 8, **{"Shutter Speed(s)": written})).exposure
    assert exposure == (None if seconds is None else pytest.approx(seconds))


def test_exposure_longer_than_the_frame_interval_is_said(tmp_path):
    rec = open_recording(write_photron(tmp_path, grey(8), 8), fps=200_000)
    assert rec.notes == (
        "the frame rate of the file's header is 10000 fps but that given by the user is 200000 fps; 200000 fps is used",
        "the exposure of 8.393 us is longer than the frame interval of 5 us; one of the two is wrong",
    )


def test_the_hash_sees_header_and_pixels(tmp_path):
    path = write_photron(tmp_path, grey(8), 8)
    before = open_recording(path).hash
    assert open_recording(tmp_path / "film.mraw").hash == before
    path.write_text(path.read_text() + "More : 1\n")
    assert open_recording(path).hash != before


def test_what_a_photron_file_lacks(tmp_path):
    path = write_photron(tmp_path, grey(8), 8)
    (tmp_path / "film.mraw").rename(tmp_path / "gone")
    with pytest.raises(FrictrackError, match=r"film.cih: expected its film film.mraw beside it; copy both files"):
        open_recording(path)
    (tmp_path / "gone").rename(tmp_path / "film.mraw")
    path.unlink()
    with pytest.raises(FrictrackError, match=r"film.mraw: expected its header film.cihx or film.cih beside it"):
        open_recording(tmp_path / "film.mraw")


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (
            {"Color Type": "Color", "Color Bit": 24},
            "expected grey values of 8, 10, 12 or 16 bit but got Color of 24 bit",
        ),
        ({"Image Width": "ten"}, 'expected "Image Width" as a whole number from 1 to 65536 but got "ten"'),
        ({"Image Height": None}, 'expected "Image Height" as a whole number from 1 to 65536 but got "nothing"'),
        ({"Image Width": 10**9}, 'from 1 to 65536 but got "1000000000"'),
        ({"File Format": "Tiff"}, 'expected the header of an mraw film but its pictures are "Tiff"'),
        ({"Image Width": 23, "Color Bit": 12}, "expected rows of whole bytes but got 23 px of 12 bit"),
    ],
)
def test_photron_headers_that_cannot_be(tmp_path, more, text):
    with pytest.raises(FrictrackError, match=text):
        open_recording(write_photron(tmp_path, grey(8), 8, **more))


def test_truncated_films_give_what_is_there(tmp_path):
    for path, data in (
        (write_photron(tmp_path, grey(8), 8, n=9), tmp_path / "film.mraw"),
        (write_cine(tmp_path, grey(8), 8), tmp_path / "film.cine"),
    ):
        data.write_bytes(data.read_bytes()[:-10])
        rec = open_recording(path)
        promised = 9 if path.suffix == ".cih" else N
        assert rec.notes[0] == f"truncated film: 4 of {promised} promised frames are in the file"
        np.testing.assert_array_equal(rec.pick(range(4)), grey(8)[:4])


def test_cine_that_cannot_be_read(tmp_path):
    path = write_cine(tmp_path, grey(8), 8, compression=1)
    with pytest.raises(FrictrackError, match=r"expected uncompressed grey values .* but got 8 bit, compression 1"):
        open_recording(path)
    path.write_bytes(b"CI" + bytes(30))
    with pytest.raises(
        FrictrackError, match=r"film.cine: expected a Phantom film but the file breaks off in its header"
    ):
        open_recording(path)


def test_dropped_and_doubled_frames_of_a_cine(tmp_path):
    ticks = [0, 1, 2, 5, 6, 6, 7, 8, 9, 10, 11, 12]
    truth = grey(8, (12, H, W))
    rec = open_recording(write_cine(tmp_path, truth, 8, stamps=[k / 5000 for k in ticks]))
    kept = [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    np.testing.assert_allclose(rec.t * 5000, np.array(ticks)[kept], atol=1e-4)
    np.testing.assert_array_equal(rec.pick(range(11)), truth[kept])
    np.testing.assert_array_equal(list(rec.frames()), truth[kept])
    np.testing.assert_array_equal(rec.frame(5), truth[6])
    np.testing.assert_array_equal(rec.cut([5], [[1, 2]], (3, 4))[0], truth[6, 2:5, 1:5])
    assert (rec.n_frames, len(rec.stamps)) == (11, 11)
    assert rec.notes == (
        "2 frames are missing before frame 3; left as gaps in time",
        "1 frame has the time of the one before: frame 5; left out",
    )
