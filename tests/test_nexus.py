"""Marks of the result files by the rules of NeXus (manual, classes NXroot and NXdata), read with plain h5py."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from frictrack.flow import Session, open_study, store
from frictrack.flow.store import GroupContent, encoding


@pytest.fixture(scope="module")
def results(measured_tables: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of results of three tables with two models."""
    folder = tmp_path_factory.mktemp("nexus")
    shutil.copytree(measured_tables, folder, dirs_exist_ok=True)
    session = Session(open_study(folder / "study.toml"))
    session.fit()
    session.fit("coulomb")
    for run in session.runs:
        for stage in run.stages:
            run.get(stage)
    return folder / "study_results"


def default_of(file: h5py.File) -> h5py.Group:
    """The group to which `default` leads from the root, each time the name of a child."""
    group = file
    while group.attrs["NX_class"] != "NXdata":
        assert "/" not in group.attrs["default"]
        group = group[group.attrs["default"]]
    return group


def check_data(group: h5py.Group) -> None:
    """What NXdata asks for: `signal` names a dataset, `axes` one per dimension, of the same length."""
    signal = group[group.attrs["signal"]]
    axes = [name.decode() if isinstance(name, bytes) else name for name in group.attrs["axes"]]
    assert len(axes) == signal.ndim == 1
    assert group[axes[0]].shape == signal.shape
    others = [name.decode() if isinstance(name, bytes) else name for name in group.attrs.get("auxiliary_signals", [])]
    for name in (group.attrs["signal"], *axes, *others):
        assert group[name].attrs["units"] == group[name].attrs["unit"] != ""
    assert all(group[name].shape == signal.shape for name in others)
    assert {group[name].attrs["units"] for name in others} <= {signal.attrs["units"]}


def test_default_leads_to_the_displacement_of_a_run(results: Path) -> None:
    with h5py.File(results / "slow.h5", locking=False) as file:
        assert file.attrs["NX_class"] == "NXroot"
        group = default_of(file)
        assert (group.name, group.attrs["signal"], group["x"].attrs["units"]) == ("/displacement", "x", "m")
        marked = [name for name, item in file.items() if item.attrs.get("NX_class") == "NXdata"]
        assert marked == ["displacement", "filtered", "friction", "motion"]
        assert [file[name].attrs["signal"] for name in marked] == ["x", "x", "F", "v"]
        for name in marked:
            check_data(file[name])


def test_default_of_a_study_leads_to_the_current_model(results: Path) -> None:
    with h5py.File(results / "study.h5", locking=False) as file:
        group = default_of(file)
        assert group.name == "/models/2_coulomb/curves/000_slow"
        assert (group.attrs["signal"], list(group.attrs["auxiliary_signals"])) == ("x", [b"x_model"])
        for model in file["models"].values():
            for part in ("curves", "motion"):
                for curve in model[part].values():
                    check_data(curve)
    assert store.check(results / "study.h5") is None


def test_marks_are_not_content(results: Path) -> None:
    """They are in no dictionary, and a study whose files lack them is up to date."""
    assert not encoding.ATTRIBUTES & {
        *store.read(results / "slow.h5", "friction"),
        *store.read(results / "study.h5", "models"),
    }
    assert not encoding.ATTRIBUTES & {*store.attributes(results / "study.h5", "models/2_coulomb")}
    content = {"default": 3, "signal": "x", "axes": [1]}
    path = results / "other.h5"
    store.write(path, {"a": GroupContent(content)})
    assert store.read(path, "a") == content
    path.unlink()


def test_files_without_marks_stay_current_and_are_marked_when_written(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(results.parent, tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "study_results")
    with monkeypatch.context() as before:  # as an earlier version wrote them
        before.setattr("frictrack.flow.store.encoding.mark_data", lambda group, kind: None)
        before.setattr("frictrack.flow.store.mark_default", lambda file: None)
        Session(open_study(tmp_path / "study.toml")).bring_up_to("motion")
    path = tmp_path / "study_results" / "slow.h5"
    old = path.read_bytes()
    run = Session(open_study(tmp_path / "study.toml")).runs[0]
    assert all(run.is_current(stage) for stage in ("displacement", "filtered", "motion"))
    assert path.read_bytes() == old
    run.get("friction")
    with h5py.File(path, locking=False) as file:
        assert [name for name, group in file.items() if "NX_class" in group.attrs] == ["friction"]
        assert "default" not in file.attrs
    assert store.check(path) is None
    np.testing.assert_array_equal(store.read(path, "motion")["v"], store.read(results / "slow.h5", "motion")["v"])


def test_links_are_not_followed(results: Path, tmp_path: Path) -> None:
    """A model that is a link into another file is left alone, and so is that file."""
    other, path = tmp_path / "other.h5", tmp_path / "study.h5"
    shutil.copy(results / "study.h5", other)
    with h5py.File(path, "w") as file:
        file["models/9"] = h5py.ExternalLink("other.h5", "/models/2_coulomb")
        file["displacement"] = h5py.ExternalLink("other.h5", "/models/2_coulomb/curves/000_slow")
        encoding.mark_default(file)
        assert {name: str(value) for name, value in file.attrs.items()} == {"NX_class": "NXroot"}
    assert other.read_bytes() == (results / "study.h5").read_bytes()
