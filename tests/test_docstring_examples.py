"""The examples in the docstrings run and print what they say."""

import doctest
import pkgutil
from functools import cache
from importlib import import_module

import frictrack


def test_the_examples_of_all_modules_run(monkeypatch):
    monkeypatch.setattr(frictrack.samples, "runs", cache(frictrack.samples.runs))  # tracked once for all examples
    names = [m.name for m in pkgutil.walk_packages(frictrack.__path__, "frictrack.") if not m.name.endswith("__main__")]
    results = {name: doctest.testmod(import_module(name)) for name in names}
    assert [name for name, result in results.items() if result.failed] == []
    assert sum(result.attempted for result in results.values()) > 100
