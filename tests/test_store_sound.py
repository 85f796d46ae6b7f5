"""The store under ill treatment: flipped bytes, other programs, readers while a writer works, hostile links."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frictrack import study
from frictrack.base import __version__
from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study, store
from frictrack.flow.store import GroupContent, Provenance, integrity
from frictrack.flow.store.integrity import header_of

sys.path.insert(0, str(Path(__file__).parents[1] / "docs" / "generators"))
import hdf5 as written


def sealed(hdf5, *how):
    """A whole file of an HDF5 part that anybody may have written."""
    return header_of(hdf5, *how) + hdf5


def sample(path: Path) -> Path:
    """A file with all that a file may hold."""
    rng = np.random.default_rng(0)
    content: dict[str, Any] = {
        "x": rng.normal(size=3000),
        "n": np.arange(700),
        "valid": rng.random(700) > 0.5,
        "reason": np.array(["", "left the picture", "µ"] * 200),
        "picture": rng.integers(0, 255, (20, 30), dtype=np.uint8),
        "law": "F_c = 8 N",
        "mass": 0.35,
        "tau": None,
        "names": [["a", "b"], []],
        "long": "é" * 20_000,
        "inside": {"k": 3, "y": np.zeros(5)},
    }
    provenance = Provenance("k" * 64, "h" * 64, '[[":/other", "k"]]', '{"mass": 0.35}')
    store.write(
        path, {"models/1_tustin": GroupContent(content, provenance), "other": GroupContent({"n": 1}, provenance)}
    )
    store.write(path, {}, links={"diagnosis": "/models/1_tustin", "runs/v3": path.name})
    return path


def everything(path: Path) -> dict[str, Any]:
    """All that anybody can read of a file by HDF5 alone."""
    found: dict[str, Any] = {}

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        value = item[()].tobytes() if isinstance(item, h5py.Dataset) else sorted(item)
        attributes = {k: (str(getattr(v, "dtype", "")), str(v)) for k, v in item.attrs.items()}
        found[name] = (value, str(getattr(item, "dtype", "")), attributes)

    with h5py.File(path, "r", locking=False) as file:
        look("/", file)
        file.visititems(look)
        for name in ("diagnosis", "runs/v3"):
            found[name] = vars(file.get(name, getlink=True))
    return found


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample(tmp_path_factory.mktemp("sound") / "study.h5")


def test_a_sound_file_has_no_faults(sound: Path) -> None:
    assert store.check(sound) is None


def test_every_flipped_bit_of_the_first_bytes_is_found(sound: Path) -> None:
    """The seal itself, and HDF5's superblock, which the seal leaves out."""
    content, path = sound.read_bytes(), sound.with_name("flipped_head.h5")
    for at in (*range(0, 150, 3), *range(store.HEADER_BYTES - 4, store.CHECKSUM_START)):
        for bit in range(8) if at >= store.HEADER_BYTES else (at % 8,):
            flipped = bytearray(content)
            flipped[at] ^= 1 << bit
            path.write_bytes(flipped)
            with pytest.raises(FrictrackError, match="is damaged or is not HDF5"):
                store.read(path, "models/1_tustin")


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_every_flipped_byte_is_found(sound: Path, data: st.DataObject) -> None:
    """Wherever it is: in the numbers, in the structure, in the seal, in space that HDF5 does not use."""
    content = bytearray(sound.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path = sound.with_name("flipped.h5")
    path.write_bytes(content)
    with pytest.raises(FrictrackError, match="is damaged or is not HDF5; delete it"):
        store.read(path, "models/1_tustin")


def test_bytes_that_hdf5_fails_on_end_another_process(sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sealed again by who means harm: in this heap of strings a few of the bytes let HDF5 2.0 search without end."""
    monkeypatch.setattr(integrity, "MIN_TIMEOUT_S", 0.4)
    content, path = sound.read_bytes(), sound.with_name("harm.h5")
    text = content.index(b'{"mass": 0.35}')
    for at in range(text - 8, text + 30, 3):
        harm = bytearray(content)
        harm[at] = 8
        path.write_bytes(sealed(bytes(harm[store.HEADER_BYTES :]), __version__))
        with suppress(FrictrackError):
            store.read(path, "models/1_tustin")
        store.check(path)


@pytest.mark.parametrize("child", ["os.abort()", "time.sleep(60)"])
def test_a_process_that_fails_on_a_file_says_so(sound: Path, monkeypatch: pytest.MonkeyPatch, child: str) -> None:
    monkeypatch.setattr(integrity, "MIN_TIMEOUT_S", 0.4)
    monkeypatch.setattr(integrity, "_CHILD", f"import os, time; print('ready', flush=True); input(); {child}")
    path = sound.with_name("strange.h5")
    path.write_bytes(sealed(sound.read_bytes()[store.HEADER_BYTES :], __version__))
    for _ in range(2):  # the answer is kept
        with pytest.raises(FrictrackError, match=r"strange.h5 is damaged or is not HDF5; delete it and run again"):
            store.read(path, "models/1_tustin")
    assert (fault := store.check(path)) is not None
    assert fault.what == "HDF5 itself fails on it: it is damaged, or made to do harm"


def test_one_process_checks_all_files_of_a_folder(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first is asked for, HDF5 fails on the second; those after it are checked when they are asked for."""
    content = sealed(sound.read_bytes()[store.HEADER_BYTES :], __version__)
    for name in "abcd":
        (tmp_path / f"{name}.h5").write_bytes(content)
    fails = "original = i._inside; i._inside = lambda p, **how: os.abort() if p.name == 'b.h5' else original(p, **how)"
    child = f"import os; from frictrack.flow.store import integrity as i; {fails}; i.run_check_process()"
    monkeypatch.setattr(integrity, "_CHILD", child)
    started, run = [], subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda *args, **how: started.append(1) or run(*args, **how))
    assert [store.check(tmp_path / f"{name}.h5") is None for name in "abcd"] == [True, False, True, True]
    assert len(started) == 2


@pytest.mark.skipif(sys.platform == "win32", reason="SIGALRM")
def test_a_process_that_hangs_ends_also_when_nobody_waits(sound: Path) -> None:
    code = """
from frictrack.flow.store import integrity
import ctypes
integrity.MIN_TIMEOUT_S = 0.3
integrity._inside = lambda path, untrusted: ctypes.CDLL(None).sleep(60)
integrity.run_check_process()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as asked:
        assert asked.stdin is not None
        asked.stdin.write(f"{json.dumps(str(sound))}\n".encode())
        asked.stdin.flush()
        assert asked.wait(30) == -signal.SIGALRM


def test_where_no_process_begins_no_file_is_called_damaged(sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(integrity, "_CHILD", "import nothing_of_the_kind")
    path = sound.with_name("unknown.h5")
    path.write_bytes(sealed(sound.read_bytes()[store.HEADER_BYTES :], __version__))
    with pytest.raises(FrictrackError, match=r"but .*python.* starts none"):
        store.read(path, "models/1_tustin")


def test_files_of_others_are_read_and_take_our_mark_when_written(sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(shutil.copy(sound, sound.with_name("theirs.h5")))
    asked: list[Path] = []
    monkeypatch.setattr(integrity, "_run_check_process", lambda paths: asked.append(paths[0]) or [None])
    assert store.names(path)
    assert asked == []
    for secret in (b"of somebody else", b""):  # also where there is no home to keep it
        monkeypatch.setattr(integrity, "_secret", lambda secret=secret: secret)
        shutil.copy(sound, path)
        for _ in range(3):
            assert store.read(path, "other") == {"n": 1}
        store.write(path, {"other": GroupContent({"n": 1})})
        assert store.read(path, "other") == {"n": 1}
        assert store.read_header(path).is_signed == bool(secret)
    assert asked == [path] * 3


def test_a_plain_reader_needs_nothing_of_ours(sound: Path) -> None:
    code = f"""
import sys, h5py
with h5py.File({str(sound)!r}) as f:
    g = f["models/1_tustin"]
    print(g["x"].shape, g.attrs["law"], g["reason"].asstr()[2], g["valid"].dtype, f["diagnosis/inside"].attrs["k"],
          f.userblock_size, f.attrs["schema"], "frictrack" in sys.modules)
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told == f"(3000,) F_c = 8 N µ bool 3 512 {store.SCHEMA} False\n"


@pytest.mark.skipif(shutil.which("h5dump") is None, reason="hdf5-tools is not installed")
def test_h5dump_and_h5ls_read_it(sound: Path) -> None:
    def run(*command: str) -> str:
        return subprocess.run([*command, str(sound)], capture_output=True, text=True, check=True).stdout

    assert "F_c = 8 N" in run("h5dump", "-a", "/models/1_tustin/law")
    assert "left the picture" in run("h5dump", "-d", "/models/1_tustin/reason", "-c", "3")
    assert "Dataset {3000}" in run("h5ls", "-r")


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="no sha256sum here")
def test_the_seal_is_what_the_page_says(sound: Path) -> None:
    line = next(line for line in written.schema_page().splitlines() if "sha256sum" in line)
    command = line.split("`")[1].replace("v3.h5", str(sound))
    told = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True).stdout.split()[0]
    assert sound.read_bytes()[: store.HEADER_BYTES].decode().split("\n")[1].endswith(told)


def test_the_page_is_that_of_the_code() -> None:
    assert written.PAGE.read_text(encoding="utf-8") == written.schema_page(), "python docs/generators/hdf5.py"


def test_the_page_tells_of_all_that_is_there(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(open_study(study_file))
    session.fit()
    session.compare()
    for stage in session.runs[0].stages:
        session.runs[0].get(stage)
    page, own = written.schema_page(), {*vars(Provenance()), "sha256", *store.NEXUS_ATTRIBUTES}
    results = study_file.parent / "study_results"
    with h5py.File(results / "slow.h5") as file:
        for stage, group in file.items():
            section = page.split(f"### `/{stage}`")[1].split("###")[0]
            for name in {*group, *group.attrs} - own:
                assert f"| `{name.removesuffix('_unit')}` |" in section, f"{stage}/{name}"
            for name, item in group.items():
                if isinstance(item, h5py.Dataset):
                    row = next(line for line in section.splitlines() if line.startswith(f"| `{name}` |"))
                    unit, kind = item.attrs["unit"], row.split("|")[3].strip()
                    assert row.split("|")[4].strip() == unit
                    assert kind.startswith(str(item.dtype)), row
    with h5py.File(results / "study.h5") as file:
        assert set(file) <= set(written.STUDY_GROUPS)
        (model,) = file["models"].values()
        assert {*model, *model.attrs} - own <= set(written.MODEL_MEMBERS)
        for part, kind in (("curves", "curves/<number>_<run>"), ("motion", "motion/<run>")):
            section = page.split(f"### `{kind}`")[1].split("###")[0]
            for group in model[part].values():
                for name in {*group, *group.attrs} - own:
                    assert f"| `{name}` |" in section, f"{part}/{name}"
    shutil.copy(results / "slow.h5", results / "v3.h5")
    monkeypatch.chdir(results)
    exec(page.split("```python")[1].split("```")[0], {})


def _replace_on(path: Path, stop: Any) -> None:
    """Write generation after generation: every number of both groups is the generation's."""
    generation = 1
    while not stop.is_set():
        some, other = ({"x": np.full(4000, float(generation)), "n": generation} for _ in range(2))
        store.write(path, {"a": GroupContent(some), "b/c": GroupContent(other)})
        generation += 1


def _ours(path: Path, out: Any) -> None:
    """Reads until the file was replaced ten times before its eyes."""
    seen: set[int] = set()
    while len(seen) < 10:
        with store.snapshot(path):
            a, b = store.read(path, "a"), store.read(path, "b/c")
        assert store.read(path, "a")["n"] >= a["n"]
        assert {a["n"], *a["x"]} == {b["n"], *b["x"]} == {float(a["n"])}, "torn"
        assert store.check(path) is None
        seen.add(int(a["n"]))
    out.put(len(seen))


def _theirs(path: Path, out: Any) -> None:
    """The same by plain h5py with its locks, which keeps the file open for a while."""
    seen: set[int] = set()
    while len(seen) < 10:
        with h5py.File(path) as file:
            first = file["a"].attrs["n"]
            time.sleep(0.05)
            assert np.all(file["a/x"][:] == first)
            assert np.all(file["b/c/x"][:] == first)
        seen.add(int(first))
    out.put(len(seen))


@pytest.mark.slow
def test_readers_see_whole_versions_while_a_writer_works(tmp_path: Path) -> None:
    path = tmp_path / "study.h5"
    store.write(path, {name: GroupContent({"x": np.zeros(4000), "n": 0}) for name in ("a", "b/c")})
    context = multiprocessing.get_context("spawn")
    stop, out = context.Event(), context.Queue()
    readers = [context.Process(target=target, args=(path, out)) for target in (_ours, _theirs)]
    writer = context.Process(target=_replace_on, args=(path, stop))
    with h5py.File(path) as kept:  # opened before, read after it was replaced many times
        for process in (writer, *readers):
            process.start()
        for process in readers:
            process.join(100)
        stop.set()
        writer.join(20)
        assert np.all(kept["a/x"][:] == 0)
    assert [process.exitcode for process in (*readers, writer)] == [0, 0, 0]
    assert [out.get(timeout=5) for _ in readers] == [10, 10]


def test_a_file_that_is_replaced_at_every_opening_is_never_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worst luck of the test above: another version, of another size, is there whenever a reader looks again."""
    path, opened, generations = tmp_path / "study.h5", Path.open, itertools.count(1)
    store.write(path, {"a": GroupContent({"n": 0})})

    def replaced_after(self: Path, *args: Any, **kwargs: Any) -> Any:
        file = opened(self, *args, **kwargs)
        if self == path:
            with monkeypatch.context() as quiet:
                quiet.setattr(Path, "open", opened)
                n = next(generations)
                store.write(path, {"a": GroupContent({"n": n, "x": np.zeros(n)})})
        return file

    monkeypatch.setattr(Path, "open", replaced_after)
    for _ in range(3):
        assert store.check(path) is None
        assert store.read(path, "a")["n"] > 0
    assert next(generations) > 6


def test_a_viewer_that_has_the_file_open_for_writing_stops_nobody(tmp_path: Path) -> None:
    """HDF5 would lock it; we do not ask for its locks, which network drives may lack."""
    path = tmp_path / "v3.h5"
    store.write(path, {"a": GroupContent({"n": 1})})
    code = f"import h5py, sys; f = h5py.File({str(path)!r}, 'r+'); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as viewer:
        assert viewer.stdout is not None
        assert viewer.stdout.readline() == "open\n"
        assert store.read(path, "a") == {"n": 1}
        store.write(path, {"a": GroupContent({"n": 2})})
        viewer.communicate("", timeout=20)
    assert store.read(path, "a") == {"n": 2}
    assert store.check(path) is None


def test_a_hostile_link_is_not_written_through(tmp_path: Path) -> None:
    outside = tmp_path / "outside" / "theirs.h5"
    store.write(outside, {"models/1": GroupContent({"n": 1})})
    before = outside.read_bytes()
    path = tmp_path / "lab" / "study.h5"
    store.write(path, {}, links={"models": "../outside/theirs.h5"})
    for change in (
        {"groups": {"models/2": GroupContent({"n": 2})}},
        {"groups": {}, "attribute_updates": {"models": {"n": 3}}},
        {"groups": {}, "remove": ("models/models",)},
    ):
        with pytest.raises(FrictrackError, match=r"expected the group /models in .* but it is a link"):
            store.write(path, **change)  # type: ignore[arg-type]
    with pytest.raises(FrictrackError, match="but it is another thing"):
        store.read(path, "models")
    assert outside.read_bytes() == before


def test_a_table_that_changes_while_it_is_read_is_measured_again(
    new_study_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was read is never said to be what came after."""
    table, original = new_study_file.parent / "slow.csv", study.read_run_table
    late = table.read_text()[:-3] + "7\n"

    def changed_meanwhile(run: Any) -> Any:
        found = original(run)
        if run.name == "slow":
            table.write_text(late)
        return found

    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(study, "read_run_table", changed_meanwhile)
        Session(open_study(new_study_file)).bring_up_to("displacement")
    work = Session(open_study(new_study_file)).runs[[r.name for r in open_study(new_study_file).runs].index("slow")]
    assert not work.is_current("displacement")
    assert work.get("displacement").x[-1] == np.loadtxt(table, delimiter=",", skiprows=1)[-1, 1]


def test_times_of_files_and_clocks_that_jump_do_not_matter(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Session(open_study(study_file)).bring_up_to("motion")
    results = study_file.parent / "study_results"
    before = {path: path.read_bytes() for path in results.glob("*.h5")}
    for at, path in enumerate([*before, *study_file.parent.glob("*.csv"), study_file]):
        os.utime(path, (at * 1e9, at * 1e9))  # 1970, 2001, 2033, ...
    monkeypatch.setattr(time, "time", lambda: 0.0)
    Session(open_study(study_file)).bring_up_to("motion")
    assert {path: path.read_bytes() for path in results.glob("*.h5")} == before


def test_stamps_name_every_input(study_file: Path) -> None:
    work = Session(open_study(study_file)).runs[0]
    work.get("motion")
    provenances = store.provenances(work.path)
    assert [name for name, _ in json.loads(provenances["displacement"].inputs)] == [f"{work.run.name}.csv"]
    assert json.loads(provenances["motion"].inputs) == [[":/filtered", provenances["filtered"].key]]
