"""The page for everybody: axe-core, the keyboard alone, themes, widths and zoom.

Screenshots go to `FRICTRACK_ARTEFACTS`, when set.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from browser import CHROMIUM, Open, Serve, Server, Tab
from page_client import Client

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
TABS = ("Film", "Compare", "Motion", "Model", "History")
SAMPLES = Path(__file__).parent.parent / "sample_videos"
WIDER = """() => {
    const scrolls = (n) => n && n !== document.body && (/(auto|scroll|hidden)/.test(getComputedStyle(n).overflowX) || scrolls(n.parentElement));
    return [...document.querySelectorAll("body *")].filter((n) => {
        const box = n.getBoundingClientRect();
        return box.width && box.height && box.right > innerWidth + 1 && !n.closest("option, .ui-hidden, .fp-live") && !scrolls(n.parentElement);
    }).map((n) => `${n.tagName}.${n.className}: ${(n.textContent || "").trim().slice(0, 40)}`);
}"""  # noqa: E501 - JavaScript
OVERLAPS = """() => {
    const seen = [...document.querySelectorAll("button, input, select, .ui-field-head, h2, h3")].filter((n) => {
        const box = n.getBoundingClientRect();
        return box.width > 1 && box.height > 1 && !n.closest(".ui-hidden, .ui-drop, dialog, .fp-film, .fp-timeline") && n.checkVisibility({ visibilityProperty: true });
    });
    const clipped = (n) => {
        const box = n.getBoundingClientRect();
        let { left, top, right, bottom } = box;
        for (let p = n.parentElement; p; p = p.parentElement) {
            if (getComputedStyle(p).overflow === "visible") continue;
            const q = p.getBoundingClientRect();
            left = Math.max(left, q.left); top = Math.max(top, q.top); right = Math.min(right, q.right); bottom = Math.min(bottom, q.bottom);
        }
        return { left, top, right, bottom };
    };
    const boxes = seen.map((n) => [n, clipped(n)]).filter(([, b]) => b.right - b.left > 2 && b.bottom - b.top > 2), found = [];
    for (let i = 0; i < boxes.length; i++) for (let j = i + 1; j < boxes.length; j++) {
        const [m, a] = boxes[i], [n, b] = boxes[j];
        if (m.contains(n) || n.contains(m)) continue;
        const w = Math.min(a.right, b.right) - Math.max(a.left, b.left), h = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
        if (w > 2 && h > 2) found.push(`${m.textContent || m.id} over ${n.textContent || n.id}`);
    }
    return found;
}"""  # noqa: E501 - JavaScript
CUT = """() => [...document.querySelectorAll(".ui-button span, .ui-tabs button, .ui-segments span, h2, h3, .ui-echo, "
    + ".ui-parameter-value, .ui-scroll")]
    .filter((n) => n.checkVisibility() && n.scrollWidth > n.clientWidth + 1 && getComputedStyle(n).display !== "inline")
    .map((n) => n.textContent)"""
RING = """() => {
    const n = document.activeElement, style = getComputedStyle(n);
    return [n.tagName, n.textContent.trim().slice(0, 30), style.outlineStyle, parseFloat(style.outlineWidth)];
}"""


@pytest.fixture
def empty(tmp_path: Path, serve: Serve) -> Server:
    return serve(tmp_path)


def themed(chromium: Any, theme: str, width: int = 1440, height: int = 900) -> Tab:
    """A tab in a theme and of a size."""
    context = chromium.new_context(viewport={"width": width, "height": height}, color_scheme=theme)
    return Tab(context.new_page())


def ready(page: Tab, title: str) -> None:
    page.to(title)
    if title in ("Film", "Compare", "Motion"):
        page.page.locator(".fp-plot").first.wait_for()
    page.page.wait_for_timeout(250)


def serious(page: Tab) -> list[str]:
    """What axe-core finds serious or critical."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    found = axe.run(page.page).response["violations"]
    return [f"{one['id']}: {one['nodes'][0]['target']}" for one in found if one["impact"] in ("serious", "critical")]


@pytest.mark.slow
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing_serious(theme: str, sample: Server, empty: Server, chromium: Any) -> None:
    page = themed(chromium, theme)
    page.open(empty)
    page.button("Open the sample study").wait_for()
    page.picture(f"13_start_{theme}")
    assert serious(page) == []
    page.open(sample)
    for title in TABS:
        ready(page, title)
        page.picture(f"13_{title}_{theme}")
        assert serious(page) == [], title
    page.page.keyboard.press("?")
    page.page.get_by_role("dialog").wait_for()
    assert serious(page) == []
    assert page.page.evaluate("document.documentElement.dataset.theme") == theme
    page.page.context.close()


def test_the_theme_can_be_chosen_and_stays(shared: Client, tab: Open) -> None:
    page = tab().open(shared.server)
    background = "getComputedStyle(document.body).backgroundColor"
    before = page.page.evaluate(background)
    page.click("Dark colours")
    assert page.page.evaluate(background) != before
    page.page.reload()
    page.button("Light colours").wait_for()
    assert page.page.evaluate("document.documentElement.dataset.theme") == "dark"


def test_tabs_are_tabs(shared: Client, tab: Open) -> None:
    page = tab().open(shared.server)
    tabs = page.page.get_by_role("tablist").get_by_role("tab")
    assert tabs.all_inner_texts() == [*TABS]
    tabs.first.click()
    page.page.keyboard.press("ArrowRight")
    assert tabs.nth(1).get_attribute("aria-selected") == "true"
    assert page.page.evaluate("document.activeElement.id") == "tab-compare"
    page.page.get_by_role("tabpanel", name="Compare").wait_for()
    page.page.keyboard.press("End")
    assert tabs.nth(4).get_attribute("aria-selected") == "true"


@pytest.mark.slow
def test_every_stop_of_the_keyboard_has_a_visible_ring(sample: Server, tab: Open) -> None:
    page = tab().open(sample)
    ready(page, "Compare")
    page.page.evaluate("document.activeElement.blur()")
    rings = []
    for _ in range(40):
        page.page.keyboard.press("Tab")
        rings.append(page.page.evaluate(RING))
    weak = [ring for ring in rings if ring[0] != "BODY" and (ring[2] == "none" or ring[3] < 2)]
    assert weak == []


def test_shortcuts_reach_every_view_and_the_help(shared: Client, tab: Open) -> None:
    page = tab().open(shared.server)
    for k, title in enumerate(TABS):
        page.page.keyboard.press(str(k + 1))
        page.page.get_by_role("tabpanel", name=title).wait_for()
    page.page.keyboard.press("?")
    page.page.get_by_role("dialog", name="Keyboard").wait_for()
    page.page.keyboard.press("Escape")
    page.page.get_by_role("dialog").wait_for(state="detached")


@pytest.mark.slow
def test_the_loop_with_the_keyboard_alone(tmp_path: Path, tab: Open, serve: Serve) -> None:
    shutil.copy(SAMPLES / "fast.avi", tmp_path)
    server = serve(tmp_path)
    page = tab().open(server)
    keys = page.page.keyboard
    page.button("Use this recording").wait_for()
    _tab_to(page, "Use this recording")
    keys.press("Enter")
    page.page.locator(".fp-label", has_text="frame").wait_for()
    for label, text in (("Mass", "0.35 kg"), ("Frame rate", "4000"), ("Scale", "0.5 mm/px")):
        _tab_to(page, label)
        keys.type(text)
        keys.press("Enter")
    keys.press("Control+Enter")
    page.page.locator(".ui-verdict:is(.good, .warn, .bad)").wait_for()
    page.idle()
    _tab_to(page, re.compile("^Add "))
    keys.press("Enter")
    page.page.locator(".ui-brief", has_text=re.compile(r"2\. ")).wait_for()
    page.idle()
    keys.press("Control+z")
    page.hears("Undone")
    page.page.locator(".ui-brief", has_text=re.compile(r"1\. ")).wait_for()


def _tab_to(page: Tab, name: str | re.Pattern[str]) -> None:
    """Press Tab until the focus is on the control of this name."""
    for _ in range(120):
        page.page.keyboard.press("Tab")
        found = page.page.evaluate(
            "(() => { const n = document.activeElement;"
            " return n.getAttribute('aria-label') || (n.labels && n.labels[0] || n).textContent.trim(); })()"
        )
        if found == name or (isinstance(name, re.Pattern) and name.search(found)):
            return
    raise AssertionError(f"the keyboard does not reach {name}")


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(800, 900), (1024, 768), (1440, 900), (2560, 1300)])
def test_nothing_overlaps_or_leaves_the_screen(width: int, height: int, sample: Server, chromium: Any) -> None:
    page = themed(chromium, "light", width, height)
    page.open(sample)
    for title in TABS:
        ready(page, title)
        page.picture(f"14_{width}_{title}")
        assert page.page.evaluate("document.documentElement.scrollWidth <= innerWidth"), title
        assert page.page.evaluate(WIDER) == [], title
        assert page.page.evaluate(OVERLAPS) == [], title
        assert page.page.evaluate(CUT) == [], title
    page.page.context.close()


@pytest.mark.slow
def test_motion_is_reduced_where_the_system_asks_for_it(sample: Server, chromium: Any) -> None:
    context = chromium.new_context(reduced_motion="reduce")
    page = Tab(context.new_page()).open(sample)
    page.page.evaluate("document.body.insertAdjacentHTML('beforeend', '<div class=ui-skeleton></div>')")
    style = "getComputedStyle(document.querySelector('body > .ui-skeleton'), '::after').animationName"
    assert page.page.evaluate(style) == "none"
    context.close()
