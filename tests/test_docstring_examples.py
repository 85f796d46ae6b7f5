"""The examples in the docstrings run and print what they say."""

import doctest
import pkgutil
from functools import cache
from importlib import import_module

import frictrack


def test_the_examples_of_all_modules_run(monkeypatch):
    track = frictrack.track
    of_film = cache(lambda path: track(frictrack.open_recording(path)))
    monkeypatch.setattr(frictrack.samples, "runs", cache(frictrack.samples.runs))  # once for all examples, as the track
    monkeypatch.setattr(frictrack, "track", lambda film, **how: track(film, **how) if how else of_film(film.path))
    names = [m.name for m in pkgutil.walk_packages(frictrack.__path__, "frictrack.") if not m.name.endswith("__main__")]
    results = {name: doctest.testmod(import_module(name)) for name in names}
    assert [name for name, result in results.items() if result.failed] == []
    assert sum(result.attempted for result in results.values()) > 100
