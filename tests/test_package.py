"""The wheel: it works without a checkout of the project, with sample films, data and types; the conda recipe."""

import hashlib
import os
import runpy
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the unpacked wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder], cwd=ROOT, check=True)
    (wheel,) = folder.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


def test_the_wheel_holds_the_package_and_nothing_else(installed: Path) -> None:
    assert {path.name.split("-")[0] for path in installed.iterdir()} == {"frictrack"}
    package = installed / "frictrack"
    assert (package / "py.typed").exists()
    assert (package / "samples" / "data" / "tribometer" / "LICENSE").exists()
    assert sorted(path.name for path in (package / "samples" / "films").glob("*.avi")) == [
        *("double_mass.avi", "fast.avi", "slow.avi", "to_a_stop.avi")
    ]


@pytest.mark.slow
def test_the_samples_come_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    code = "import frictrack as ft; print(ft.samples.copy_films('study')); print(len(ft.samples.runs()))"
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(installed)!r}); {code}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["study/study.toml", "4"]
    assert (tmp_path / "study" / "fast.avi").stat().st_size > 1e6


@pytest.mark.slow
def test_the_same_commit_gives_the_same_bytes(tmp_path: Path) -> None:
    """Copies in folders of other names, with other times and rights of their files, built at other times."""
    made: dict[str, list[str]] = {}
    for name, year in (("first", "1999"), ("another place", "2031")):
        copy = tmp_path / name
        shutil.copytree(ROOT / "frictrack", copy / "frictrack", ignore=shutil.ignore_patterns("__pycache__", "pages"))
        shutil.copytree(ROOT / "sample_videos", copy / "sample_videos")
        for file in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
            shutil.copy(ROOT / file, copy)
        moment = (int(year) - 1970) * 31_557_600
        for path in copy.rglob("*"):
            os.utime(path, (moment, moment))
            path.chmod(path.stat().st_mode & ~0o022 if year == "1999" else path.stat().st_mode | 0o020)
        subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", tmp_path / f"{year}"], cwd=copy, check=True)
        for built in (tmp_path / year).iterdir():
            made.setdefault(built.name, []).append(hashlib.sha256(built.read_bytes()).hexdigest())
    assert len(made) == 2
    for name, hashes in made.items():
        assert len(hashes) == 2
        assert len(set(hashes)) == 1, name


def test_the_conda_recipe_has_the_requirements_of_the_project() -> None:
    recipe = runpy.run_path(str(ROOT / "pipelines" / "release" / "conda_recipe.py"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    made = yaml.safe_load(yaml.safe_dump(recipe["conda_recipe"](project, b"archive")))
    run = dict(line.split(" ", 1) for line in made["requirements"]["run"])
    for requirement in project["dependencies"]:
        name, _, version = requirement.partition(">=")
        assert run.pop(recipe["CONDA_NAMES"].get(name, name)) == f">={version}"
    assert run == {"python": project["requires-python"]}
    assert made["source"]["sha256"] == hashlib.sha256(b"archive").hexdigest()
    assert made["build"]["python"]["entry_points"] == ["frictrack = frictrack.cli:main"]
