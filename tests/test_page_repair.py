"""A film whose target is covered by a hand and lost in a flash is mended on the page; the repairs are taken back."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
from browser import CHROMIUM, Open, Serve, Server, Tab
from test_repair import COVERED, FLASH, STUDY, errors, pictures

from frictrack.flow import Session, open_study
from frictrack.records import Track

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")


@pytest.fixture
def hand(tmp_path: Path, serve: Serve) -> Server:
    tifffile.imwrite(tmp_path / "hand.tif", pictures(), photometric="minisblack")
    (tmp_path / "study.toml").write_text(STUDY)
    return serve(tmp_path / "study.toml")


def suspects(page: Tab) -> list[str]:
    return page.page.locator(".ui-spans:not(.mended) button").all_inner_texts()  # at one moment, while the list changes


def final_track(study: Path) -> Track:
    (pipeline,) = Session(open_study(study)).runs
    return pipeline.final_track


@pytest.mark.slow
def test_hand_and_flash_are_mended_in_two_clicks_each(hand: Server, tab: Open) -> None:
    bytes_before = hand.study.read_bytes()
    page = tab().open(hand)
    page.click("Track every film")
    page.page.locator(".ui-spans button").first.wait_for()
    found = suspects(page)
    assert len(found) == 2
    for span, words in zip((COVERED, FLASH), found, strict=True):
        first, last = (int(k) for k in re.findall(r"\d+", words)[:2])
        assert span.start <= first + 6
        assert last <= span.stop
    before = final_track(hand.study)
    assert np.nanmax(np.abs(errors(before))) > 10.0  # px: the copy in the hand was followed
    for _ in range(2):
        page.page.locator(".ui-spans:not(.mended) button").first.click()
        page.click("Interpolate")
        left = len(suspects(page))
        page.until(lambda left=left: len(suspects(page)) < left)
        page.idle()
    assert page.page.locator(".ui-spans.mended li").count() == 2
    page.picture("4_hand_mended")
    after = final_track(hand.study)
    assert np.max(np.abs(errors(after))) < 0.01
    for _ in range(2):
        page.click("Undo").hears("Undone")
        page.page.wait_for_timeout(400)
    page.until(lambda: hand.study.read_bytes() == bytes_before)
    again = final_track(hand.study)
    np.testing.assert_array_equal(again.x_px, before.x_px)
    assert not page.faults
