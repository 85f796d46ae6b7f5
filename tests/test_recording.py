"""Every format gives back the frames that were written, with the true times, and says clearly what it cannot read."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from camera_films import write_cine, write_photron

from frictrack.base.errors import FrictrackError
from frictrack.recording import FORMATS, open_recording, random_access
from frictrack.recording.timebase import AuditRow
from frictrack.study.writing import FILMS

N, H, W = 12, 32, 48


def stack(kind=np.uint8):
    top = np.iinfo(kind).max if kind == np.uint8 else 4095
    return np.random.default_rng(3).integers(0, top, (N, H, W)).astype(kind)


def write_video(path, frames, fps, codec="FFV1"):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (W, H), False)
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def write_folder(path, frames, numbers=None, suffix="png"):
    path.mkdir()
    for i, frame in zip(numbers or range(len(frames)), frames, strict=True):
        assert cv2.imwrite(str(path / f"img_{i}.{suffix}"), frame)
    return path


def write_any(tmp_path, form):
    """A film in this form, and its true frames."""
    if form in CAMERA_FILMS:
        write, bits = CAMERA_FILMS[form]
        truth = stack(np.uint8 if bits == 8 else np.uint16)
        return write(tmp_path, truth, bits), truth
    if form in TIFFS:
        path, truth = tmp_path / "film.tif", stack(np.uint8 if form == "deflate" else np.uint16)
        tifffile.imwrite(path, truth, **TIFFS[form])
        return path, truth
    if form == "folder":
        return write_folder(tmp_path / "film", stack(np.uint16)), stack(np.uint16)
    return write_video(tmp_path / f"film.{form}", stack(), 100), stack()


TIFFS = {
    "pages": {"photometric": "minisblack"},
    "bigtiff": {"photometric": "minisblack", "bigtiff": True},
    "deflate": {"photometric": "minisblack", "compression": "deflate"},
    "imagej": {"imagej": True},
}
CAMERA_FILMS = {
    "mraw8": (write_photron, 8),
    "mraw12": (write_photron, 12),
    "mraw16": (write_photron, 16),
    "cine8": (write_cine, 8),
    "cine12": (write_cine, 12),
    "cine16": (write_cine, 16),
}
DIRECT = ["pages", "imagej", "bigtiff", *CAMERA_FILMS]
FORMS = ["avi", "mkv", "deflate", "folder", *DIRECT]


@pytest.mark.parametrize("form", FORMS)
def test_contract_of_every_format(tmp_path, form):
    path, truth = write_any(tmp_path, form)
    rec = open_recording(path, fps=4000)
    assert (rec.n_frames, len(rec), rec.shape, rec.fps) == (N, N, (H, W), 4000.0)
    assert rec.bit_depth == (8 if truth.dtype == np.uint8 else 12 if form.endswith("12") else 16)
    assert rec.direct == (form in DIRECT)
    np.testing.assert_allclose(rec.t, np.arange(N) / 4000)
    frames = list(rec.frames())
    assert all(f.dtype == truth.dtype for f in frames)
    np.testing.assert_array_equal(frames, truth)
    np.testing.assert_array_equal(list(rec.frames(3, 9, 2)), truth[3:9:2])
    np.testing.assert_array_equal(rec.pick([0, 5, 11]), truth[[0, 5, 11]])
    np.testing.assert_array_equal(rec.frame(7), truth[7])
    np.testing.assert_array_equal(rec.frame(2), truth[2])  # going back
    np.testing.assert_array_equal(rec.frame(-1), truth[-1])
    with pytest.raises(FrictrackError, match="expected a frame from 0 to 11 but got 12"):
        rec.frame(12)
    assert rec.timebase.rows[0] == AuditRow("frame rate, given", "4000 fps", "used")


@pytest.mark.parametrize("form", FORMS)
def test_boxes_of_every_format(tmp_path, form):
    path, truth = write_any(tmp_path, form)
    indices, corners = [7, 0, 11, 7], [[0, 0], [W - 9, H - 6], [3, 5], [8, 1]]
    with random_access(open_recording(path, fps=4000)) as rec:
        boxes = rec.cut(indices, corners, (6, 9))
        assert rec.direct
    assert boxes.dtype == truth.dtype
    for box, i, (x, y) in zip(boxes, indices, corners, strict=True):
        np.testing.assert_array_equal(box, truth[i, y : y + 6, x : x + 9])


@pytest.mark.parametrize("form", FORMS)
def test_frames_are_read_lazily(tmp_path, form):
    path, truth = write_any(tmp_path, form)
    frames = open_recording(path, fps=4000).frames()
    np.testing.assert_array_equal(next(frames), truth[0])
    np.testing.assert_array_equal(next(frames), truth[1])


@pytest.mark.parametrize("form", FORMS)
def test_hash_follows_the_content(tmp_path, form):
    path, _ = write_any(tmp_path, form)
    before = open_recording(path, fps=4000).hash
    assert re.fullmatch("[0-9a-f]{64}", before)
    assert open_recording(path, fps=100).hash == before
    victim = sorted(path.iterdir())[5] if path.is_dir() else path
    data = bytearray(victim.read_bytes())
    data[-40] ^= 1
    victim.write_bytes(data)
    assert open_recording(path, fps=4000).hash != before


def test_every_suffix_belongs_to_one_format():
    suffixes = [s for kind in FORMATS for s in kind.suffixes]
    assert len(suffixes) == len(set(suffixes))
    assert all(s == s.lower() and s.startswith(".") for s in suffixes)
    assert set(suffixes) - {".cih", ".cihx"} == set(FILMS)  # which command line and page look for


# ---- frame rate


def test_playback_rate_is_refused(tmp_path):
    path = write_video(tmp_path / "strike.avi", stack(), 29.97)
    with pytest.raises(FrictrackError, match=r"strike.avi: .* says 29.97 fps, .* give the true rate as fps .*square"):
        open_recording(path)
    assert open_recording(path, fps=240).fps == 240


def test_high_rate_of_the_container_is_believed_and_the_users_wins(tmp_path):
    path = write_video(tmp_path / "a.mkv", stack(), 500)
    assert open_recording(path).fps == pytest.approx(500)
    assert open_recording(path, fps=4000).fps == 4000


def test_no_rate_at_all(tmp_path):
    with pytest.raises(FrictrackError, match="the file names no frame rate; give the true rate as fps"):
        open_recording(write_folder(tmp_path / "f", stack()))


def test_rate_of_imagej(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", stack(), imagej=True, metadata={"finterval": 1 / 2500})
    assert open_recording(tmp_path / "a.tif").fps == pytest.approx(2500)


@pytest.mark.parametrize("fps", [0, -5, float("nan")])
def test_impossible_rate(tmp_path, fps):
    with pytest.raises(FrictrackError, match="expected a frame rate above 0 fps but got"):
        open_recording(write_folder(tmp_path / "f", stack()), fps=fps)


# ---- pictures


def test_twelve_bits_are_told_apart(tmp_path):
    white = (281, "H", 1, 4095, True)
    tifffile.imwrite(tmp_path / "a.tif", stack(np.uint16), photometric="minisblack", extratags=[white])
    assert open_recording(tmp_path / "a.tif", 4000).bit_depth == 12


def test_sixteen_bit_video(tmp_path):
    path = tmp_path / "a.avi"
    options = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 25, (W, H), options)
    for frame in stack(np.uint16):
        writer.write(frame)
    writer.release()
    rec = open_recording(path, 4000)
    assert rec.bit_depth == 16
    np.testing.assert_array_equal(list(rec.frames()), stack(np.uint16))


def test_colour_tiff_becomes_luma(tmp_path):
    red = np.zeros((3, H, W, 3), np.uint8)
    red[..., 0] = 200
    tifffile.imwrite(tmp_path / "a.tif", red, photometric="rgb")
    assert np.all(open_recording(tmp_path / "a.tif", 4000).frame(0) == 60)  # 0.299 * 200


def test_folder_is_in_natural_order_and_gaps_are_gaps_in_time(tmp_path):
    numbers = [8, 9, 10, 11, 14, 15]
    path = write_folder(tmp_path / "f", stack()[:6], numbers)
    (path / "note.txt").write_text("no frame")
    cv2.imwrite(str(path / "0_overview.jpg"), stack()[0])
    rec = open_recording(path, fps=1000)
    np.testing.assert_array_equal(list(rec.frames()), stack()[:6])
    np.testing.assert_allclose(rec.t * 1000, [0, 1, 2, 3, 6, 7])
    assert rec.notes == ("2 frames are missing in the numbering of the pictures",)


def test_every_tenth_number_is_no_gap(tmp_path):
    rec = open_recording(write_folder(tmp_path / "f", stack()[:4], [0, 10, 20, 30]), fps=1000)
    np.testing.assert_allclose(rec.t * 1000, [0, 1, 2, 3])
    assert rec.notes == ()


def test_a_broken_picture_is_black_and_the_film_goes_on(tmp_path):
    path = write_folder(tmp_path / "f", stack()[:4])
    (path / "img_2.png").write_bytes(b"broken")
    frames = list(open_recording(path, 1000).frames())
    assert [bool(f.any()) for f in frames] == [True, True, False, True]


def test_pictures_of_another_size(tmp_path):
    path = write_folder(tmp_path / "f", stack()[:3])
    cv2.imwrite(str(path / "img_3.png"), np.zeros((20, 20), np.uint8))
    with pytest.raises(FrictrackError, match=r"expected pictures of 48x32 px but img_3.png has 20x20 px"):
        list(open_recording(path, 1000).frames())


# ---- what cannot be read


def cut(path: Path, share: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def test_truncated_tiff_reads_what_is_there(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, stack(), imagej=True)
    rec = open_recording(cut(path, 0.5), 4000)
    assert 4 <= rec.n_frames <= 6
    assert rec.notes == (f"truncated film: {rec.n_frames} of {N} promised frames are in the file",)
    np.testing.assert_array_equal(list(rec.frames()), stack()[: rec.n_frames])


def test_tiff_truncated_to_nothing(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, stack(), imagej=True)
    with tifffile.TiffFile(path) as tif:
        start = tif.pages[0].dataoffsets[0]
    path.write_bytes(path.read_bytes()[: start + 10])
    with pytest.raises(FrictrackError, match=r"a.tif: truncated film: none of its 12 frames is complete"):
        open_recording(path, 4000)


def test_truncated_video_says_so(tmp_path):
    path = write_video(tmp_path / "a.mp4", [cv2.GaussianBlur(f, (0, 0), 2) for f in stack()], 200, "mp4v")
    data = bytearray(path.read_bytes())
    moov = data.find(b"moov") - 4
    box = data[moov:]
    # The index first and half of the pictures: what is left of a copy that broke off. Offsets in the
    # index are those of the pictures, which move back by the length of the index.
    at = box.find(b"stco") + 8
    count = int.from_bytes(box[at : at + 4], "big")
    for i in range(count):
        place = slice(at + 4 + 4 * i, at + 8 + 4 * i)
        box[place] = (int.from_bytes(box[place], "big") + len(box)).to_bytes(4, "big")
    head = int.from_bytes(data[:4], "big")
    body = data[head:moov]
    path.write_bytes(bytes(data[:head] + box + body[: len(body) // 2]))
    rec = open_recording(path, 4000)
    assert 1 < rec.n_frames < N
    assert rec.notes[0] == f"truncated film: {rec.n_frames} of {N} promised frames are in the file"
    assert (
        rec.notes[1]
        == "the frame rate of the file's header is 200 fps but that given by the user is 4000 fps; 4000 fps is used"
    )
    assert len(list(rec.frames())) >= rec.n_frames - 1


def one_frame(tmp_path):
    return write_folder(tmp_path / "one", stack()[:1])


def no_pictures(tmp_path):
    (tmp_path / "empty").mkdir()
    return tmp_path / "empty"


def text_as(name):
    def make(tmp_path):
        (tmp_path / name).write_text("no film " * 50)
        return tmp_path / name

    return make


def nothing_in(tmp_path):
    (tmp_path / "zero.avi").touch()
    return tmp_path / "zero.avi"


def floats(tmp_path):
    tifffile.imwrite(tmp_path / "f.tif", stack().astype(np.float32), photometric="minisblack")
    return tmp_path / "f.tif"


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda p: p / "gone.avi", "gone.avi: expected a recording but there is no such file; check the path"),
        (text_as("a.avi"), "a.avi: expected a film but the file cannot be read as one"),
        (text_as("a.tif"), "a.tif: expected a TIFF film but the file cannot be read as one"),
        (text_as("a.docx"), r'a.docx: expected a film \(.avi, .*folder of pictures\) but got ".docx"'),
        (nothing_in, "zero.avi: expected a film but the file is empty"),
        (no_pictures, r"empty: expected pictures \(.png, .*\) in the folder but found none"),
        (one_frame, "one: expected a recording of many frames but got one frame"),
        (floats, "f.tif: expected grey values of 8 to 16 bit but got float32"),
    ],
)
def test_what_cannot_be_read_is_said_in_one_sentence(tmp_path, make, text):
    with pytest.raises(FrictrackError, match=text) as caught:
        open_recording(make(tmp_path), fps=4000)
    assert "\n" not in str(caught.value)
