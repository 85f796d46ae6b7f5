"""How often a statistical test draws: a few times by default, as often as its figure needs with the slow tests."""

from __future__ import annotations

from typing import Any

import pytest


def few_or_many(few: Any, many: Any) -> list[Any]:
    """Values of one `parametrize`: the first by default, the second with `pytest -m slow`."""
    return [few, pytest.param(*(many if isinstance(many, tuple) else (many,)), marks=pytest.mark.slow)]
