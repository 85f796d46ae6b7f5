"""The comparison of outputs with those stored before a rewrite."""

import json
import math
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "pipelines" / "benchmarks" / "frozen"


@pytest.fixture(scope="module")
def frozen():
    sys.path.insert(0, str(FOLDER.parent))
    try:
        import frozen.__main__ as module  # noqa: PLC0415
    finally:
        sys.path.remove(str(FOLDER.parent))
    return module


STORED = {"verdict": "missing", "words": "a long sentence", "F": [1.0, float("nan")], "cpu_s": 3.0, "ok": True}


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({}, 0),
        ({"F": [1.0 + 1e-10, float("nan")]}, 0),
        ({"F": [1.0 + 1e-8, float("nan")]}, 1),
        ({"F": [1.0, 0.0]}, 1),
        ({"F": [1.0]}, 1),
        ({"verdict": "complete"}, 1),
        ({"words": "a plainer one"}, 0),
        ({"cpu_s": 9.0}, 0),
        ({"ok": False}, 1),
        ({"new": 1}, 1),
    ],
)
def test_a_difference_is_found_where_a_value_changed(frozen, change, count):
    assert len(list(frozen.differences(STORED, STORED | change, texts=False))) == count


def test_sentences_are_compared_where_asked(frozen):
    assert list(frozen.differences(STORED, STORED | {"words": "another one"}, texts=True)) == [
        "/words: 'a long sentence' -> 'another one'"
    ]


def test_every_case_is_stored(frozen):
    for name in frozen.CASES:
        stored = json.loads((FOLDER / "outputs" / f"{name}.json").read_text(encoding="utf-8"))
        assert stored
        assert not any(isinstance(v, float) and math.isnan(v) for v in stored.values() if not isinstance(v, dict))
