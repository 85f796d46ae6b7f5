"""The wheel: it works without a checkout of the project, with sample films, data and types."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

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


def test_the_samples_come_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    code = "import frictrack as ft; print(ft.samples.copy_films('study')); print(len(ft.samples.runs()))"
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(installed)!r}); {code}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["study/study.toml", "4"]
    assert (tmp_path / "study" / "fast.avi").stat().st_size > 1e6
