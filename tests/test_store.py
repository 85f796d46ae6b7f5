"""The store: what goes in comes out, others can read it, and a file is whole or not there."""

from __future__ import annotations

import os
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.flow import store
from frictrack.flow.store import GroupContent, Provenance
from frictrack.records import Curve, Track
from frictrack.results import RecordingInfo


def track(n: int = 5) -> Track:
    t = np.arange(n) / 4000
    x = np.linspace(10, 20, n)
    x[2] = np.nan
    reason = np.array(["", "", "left the picture µ", "", ""])
    return Track(t, x, x, x, x, x, x, reason, name="beam", target=(1.0, 2.0, 30.0, 40.0), notes=("one", "two"))


def equal(a: object, b: object) -> None:
    assert type(a) is type(b)
    for name, value in vars(a).items():
        other = getattr(b, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, other)
            assert value.dtype.kind == other.dtype.kind
        elif isinstance(value, dict):
            assert value.keys() == other.keys()
            for key in value:
                np.testing.assert_array_equal(value[key], other[key])
        else:
            assert value == other, name


def test_a_record_comes_back_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "v3.h5"
    film = RecordingInfo(
        np.arange(3.0), path="v3.avi", fps=4000.0, n_frames=3, hash="ab", picture=np.eye(4, dtype=np.uint8)
    )
    ramp = np.linspace(0, 1, 4)
    curve = Curve(ramp, ramp, ramp, ramp, ramp, ramp, ramp, run="v3", parts={"coulomb": 2 * ramp})
    store.write(path, {"track": GroupContent(track()), "recording": GroupContent(film), "curve": GroupContent(curve)})
    equal(store.read(path, "track", Track), track())
    equal(store.read(path, "recording", RecordingInfo), film)
    equal(store.read(path, "curve", Curve), curve)


def test_a_dictionary_comes_back_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "study.h5"
    content = {
        "theta": np.arange(6.0).reshape(2, 3),
        "domain": "force",
        "seed": 3,
        "tau": None,
        "names": [["a", "b"], []],
        "sub": {"k": 1.5},
        "long": "é" * 90_000,
    }
    store.write(path, {"models/1_tustin": GroupContent(content)})
    back = store.read(path, "models/1_tustin")
    np.testing.assert_array_equal(back.pop("theta"), content.pop("theta"))
    assert back == content


def test_others_read_columns_with_units(tmp_path: Path) -> None:
    path = tmp_path / "v3.h5"
    store.write(
        path, {"track": GroupContent(track(), Provenance(key="k", input_hash="h", settings='{"target": null}'))}
    )
    with h5py.File(path) as file:
        assert file["track/x_px"].attrs["unit"] == "px"
        assert file["track/reason"].asstr()[2] == "left the picture µ"
        assert file["track"].attrs["settings"] == '{"target": null}'
        assert file["track"].attrs["input_hash"] == "h"
        assert file["track"].attrs["version"]


def test_writing_one_group_keeps_the_others(tmp_path: Path) -> None:
    path = tmp_path / "study.h5"
    store.write(
        path,
        {"a": GroupContent({"n": 1}), "b/c": GroupContent({"n": 2}), "gone": GroupContent({"n": 3})},
        links={"runs/v3": "v3.h5"},
    )
    store.write(path, {"a": GroupContent({"n": 4})}, remove=("gone",))
    assert store.read(path, "a") == {"n": 4}
    assert store.read(path, "b/c") == {"n": 2}
    assert store.names(path) == ["a", "b", "runs"]
    with h5py.File(path) as file:
        assert isinstance(file["runs"].get("v3", getlink=True), h5py.ExternalLink)


def test_the_runs_link_shows_the_run(tmp_path: Path) -> None:
    store.write(tmp_path / "v3.h5", {"track": GroupContent(track())})
    store.write(tmp_path / "study.h5", {}, links={"runs/v3": "v3.h5"})
    with h5py.File(tmp_path / "study.h5") as file:
        assert file["runs/v3/track/x_px"].shape == (5,)


def test_a_stamp_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "v3.h5"
    assert store.provenance(path, "track") is None
    made = Provenance(key="k", input_hash="h", settings="{}")
    store.write(path, {"track": GroupContent(track(), made)})
    assert store.provenance(path, "track") == made
    assert store.provenance(path, "motion") is None


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "v3.h5"
    store.write(path, {"a": GroupContent({"n": 1})})
    before = path.read_bytes()
    with pytest.raises(TypeError):
        store.write(path, {"b": GroupContent({"n": object()})})
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == [".frictrack", "v3.h5"]


def test_the_same_content_makes_the_same_bytes_in_another_second(tmp_path: Path) -> None:
    for name in ("one.h5", "two.h5"):
        content = GroupContent(track(), Provenance(key="k"))
        links = {"runs/v3": "v3.h5", "best/model": "/track"}
        store.write(tmp_path / name, {"track": content, "a/b": GroupContent({"n": 1})}, links=links)
        time.sleep(1.01)  # HDF5's times are in whole seconds
    assert (tmp_path / "one.h5").read_bytes() == (tmp_path / "two.h5").read_bytes()
    with h5py.File(tmp_path / "one.h5") as file:
        timed = [name for name in ("/", "track", "a", "a/b", "runs", "best") if h5py.h5o.get_info(file[name].id).mtime]
    assert timed == []


def damaged(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_a_truncated_file_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "v3.h5"
    store.write(path, {"track": GroupContent(track())})
    damaged(path, path.read_bytes()[:1500])
    with pytest.raises(FrictrackError, match=r"v3\.h5 is damaged or is not HDF5; delete it and run again"):
        store.read(path, "track", Track)
    with pytest.raises(FrictrackError, match="is damaged or is not HDF5"):
        store.write(path, {"a": GroupContent({})})


def test_flipped_bytes_are_found(tmp_path: Path) -> None:
    path = tmp_path / "v3.h5"
    noise = np.random.default_rng(0).normal(size=2000)
    store.write(path, {"a": GroupContent({"x": noise})})
    with h5py.File(path) as file:
        offset = file["a/x"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[offset + 100] ^= 0xFF
    with pytest.raises(FrictrackError, match="is damaged"):
        store.read(damaged(path, bytes(content)), "a")


def test_a_file_of_another_program_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "v3.h5"
    with h5py.File(path, "w") as file:
        file["x"] = 1
    before = path.read_bytes()
    with pytest.raises(FrictrackError, match="to be a frictrack result but another program wrote it; move it away"):
        store.write(path, {"a": GroupContent({})})
    assert path.read_bytes() == before


def test_a_later_schema_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "v3.h5"
    with monkeypatch.context() as later:
        later.setattr("frictrack.flow.store.integrity.SCHEMA", 99)
        later.setattr("frictrack.flow.store.__version__", "7.1.0")
        store.write(path, {"a": GroupContent({"n": 1})})
    before = path.read_bytes()
    words = rf"expected .*v3\.h5 of schema {store.SCHEMA} at most but it has 99 and was written by frictrack 7\.1\.0"
    with pytest.raises(FrictrackError, match=words + r", this is \S+; update it"):
        store.read(path, "a")
    with pytest.raises(FrictrackError, match="update it"):
        store.write(path, {"a": GroupContent({"n": 2})})
    assert path.read_bytes() == before
    assert (fault := store.check(path)) is not None
    assert fault.do == "update it"


def test_a_missing_file_or_group_is_said(tmp_path: Path) -> None:
    with pytest.raises(FrictrackError, match=r"expected results in .*v3\.h5 but there is no such file"):
        store.read(tmp_path / "v3.h5", "track")
    store.write(tmp_path / "v3.h5", {})
    with pytest.raises(FrictrackError, match='holds no "track"; run the study again'):
        store.read(tmp_path / "v3.h5", "track")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_said(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(FrictrackError, match="cannot write results into"):
        store.write(tmp_path / "v3.h5", {})


def test_a_file_where_the_folder_should_be_is_said(tmp_path: Path) -> None:
    (tmp_path / "results").write_text("")
    with pytest.raises(FrictrackError, match="cannot write results into"):
        store.write(tmp_path / "results" / "v3.h5", {})
