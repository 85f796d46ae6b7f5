"""Write the conda recipe of a release, from pyproject.toml and the source distribution.

    python pipelines/release/conda_recipe.py dist/frictrack-0.1.0.tar.gz > dist/recipe.yaml
    rattler-build build --recipe dist/recipe.yaml

The requirements are those of pyproject.toml, so that the two cannot differ.
"""

from __future__ import annotations

import hashlib
import sys
import tomllib
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
CONDA_NAMES = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}  # where they differ from PyPI's
URL = "https://pypi.org/packages/source/f/frictrack/frictrack-${{ version }}.tar.gz"


def conda_recipe(project: dict[str, Any], source: bytes) -> dict[str, Any]:
    """Return the recipe (format of rattler-build, schema 1) of a project table and the bytes of its source archive."""
    (command,) = project["scripts"]
    python = f"python {project['requires-python']}"
    return {
        "schema_version": 1,
        "context": {"version": project["version"]},
        "package": {"name": project["name"], "version": "${{ version }}"},
        "source": {"url": URL, "sha256": hashlib.sha256(source).hexdigest()},
        "build": {
            "number": 0,
            "noarch": "python",
            "script": "${{ PYTHON }} -m pip install . -vv --no-deps --no-build-isolation",
            "python": {"entry_points": [f"{command} = {project['scripts'][command]}"]},
        },
        "requirements": {
            "host": [python, "pip", "hatchling"],
            "run": [python, *map(_conda_requirement, project["dependencies"])],
        },
        "tests": [
            {"python": {"imports": [project["name"]], "pip_check": False}},  # OpenCV's name differs
            {"script": [f"{command} --version", f"{command} demo"]},
        ],
        "about": {
            "summary": project["description"],
            "license": project["license"],
            "license_file": project["license-files"],
        },
    }


def _conda_requirement(requirement: str) -> str:
    name, relation, version = requirement.partition(">=")
    return f"{CONDA_NAMES.get(name, name)} {relation}{version}"


if __name__ == "__main__":
    table = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    yaml.safe_dump(conda_recipe(table, Path(sys.argv[1]).read_bytes()), sys.stdout, sort_keys=False)
