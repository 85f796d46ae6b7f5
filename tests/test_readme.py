"""The README: short, its links lead somewhere, its Python example runs and names what the sample data lack."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
sys.path.insert(0, str(ROOT / "docs" / "generators"))

from run_pages import blocks  # noqa: E402 - the generators of the documentation are no package


def test_it_is_read_in_minutes():
    lines = README.splitlines()
    assert len(lines) <= 120
    assert len(README.split()) <= 1200
    assert max(map(len, lines)) < 120


def test_every_link_leads_to_a_file():
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert len(links) > 20
    assert [link for link in links if not link.startswith("https://") and not (ROOT / link).exists()] == []


@pytest.mark.slow
def test_the_example_on_arrays_runs(capsys):
    (example,) = (block for block in blocks(README) if block.language == "python")
    names = {}
    exec(example.text, names)
    verdict, place, *_ = capsys.readouterr().out.splitlines()
    assert verdict == "missing ['patch']"
    assert f"# {verdict}" in README
    assert place.endswith(" ± 0.00012 m")
    assert f"# {place}" in README
    held_out = names["ft"].compare([names["fit"], names["better"]]).to_dataframe()["heldout_rms_um"]
    assert held_out.iloc[1] < 0.35 * held_out.iloc[0]
