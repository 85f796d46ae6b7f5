"""The verdict from made-up evidence: each of its grounds decides in its place."""

from __future__ import annotations

from dataclasses import replace

import pytest

from frictrack.diagnose.power import Undetermined
from frictrack.diagnose.verdict import Grounds, judge

COULD_HIDE = Undetermined("drag", "it would not show", "film a faster run", limit=0.3)
NOT_DETERMINED = Undetermined("stribeck.v_s", "the runs never slow", "film a run to a stop", uncertainty=0.2)
EXPLAINED = Grounds(something_missing=True, n_found=1, error_ratio=0.5, reduced_chi2=8.0)


@pytest.mark.parametrize(
    ("grounds", "verdict"),
    [
        (Grounds(something_missing=False), "complete"),
        (Grounds(something_missing=False, gaps=[COULD_HIDE]), "undetermined"),
        (EXPLAINED, "missing"),
        (replace(EXPLAINED, n_found=3), "missing"),
        (replace(EXPLAINED, has_rivals=True), "ambiguous"),
        (replace(EXPLAINED, error_ratio=1.001), "missing"),  # no rise of the held-out error
        (replace(EXPLAINED, error_ratio=1.003), "unexplained"),
        (replace(EXPLAINED, misfit_left=True), "unexplained"),
        (replace(EXPLAINED, has_objection=True), "unexplained"),
        (replace(EXPLAINED, misfit_left=True, has_rivals=True), "unexplained"),
        (replace(EXPLAINED, n_found=0), "unexplained"),
        (replace(EXPLAINED, is_formula=True), "unexplained"),
        (replace(EXPLAINED, is_formula=True, gaps=[NOT_DETERMINED], error_ratio=0.95), "undetermined"),
        # what the runs leave open counts unless the evidence is decisive
        (replace(EXPLAINED, gaps=[COULD_HIDE]), "missing"),
        (replace(EXPLAINED, gaps=[COULD_HIDE], error_ratio=0.95), "missing"),
        (replace(EXPLAINED, gaps=[NOT_DETERMINED], error_ratio=0.89), "missing"),
        (replace(EXPLAINED, gaps=[COULD_HIDE, NOT_DETERMINED], error_ratio=0.91), "undetermined"),
        (replace(EXPLAINED, n_found=0, gaps=[NOT_DETERMINED]), "unexplained"),
        (replace(EXPLAINED, n_found=0, gaps=[COULD_HIDE], reduced_chi2=0.9), "undetermined"),
    ],
)
def test_the_verdict_follows_from_the_evidence(grounds: Grounds, verdict: str) -> None:
    assert judge(grounds) == verdict
