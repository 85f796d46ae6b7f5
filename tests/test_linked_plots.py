"""The linked plots and the film in Chromium, on a bare page with synthetic data of known truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import plots_page
import pytest
from browser import CHROMIUM, Tab

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")

COUNT = 400  # frames of a run
ROWS = COUNT * len(plots_page.RUNS)
LARGE = "Residual against time"
WAIT = 10_000  # ms
INNER = {"x": 72, "y": 24, "right": 12, "bottom": 36}  # px around the inner rectangle of a plot


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with plots_page.served(COUNT) as url:
        yield url


class PlotsPage:
    """The harness in a tab."""

    def __init__(self, tab: Tab, address: str, query: str = "") -> None:
        self.tab, self.page = tab, tab.page
        self.page.goto(address + query)
        self.page.wait_for_function("window.ready")
        self.until("document.querySelector('.fp-label').textContent !== ''")
        self.columns = plots_page.columns(COUNT)

    def js(self, text: str) -> Any:
        return self.page.evaluate(text)

    def until(self, condition: str) -> None:
        self.page.wait_for_function(condition, timeout=WAIT)

    def frames(self) -> None:
        """Wait until what was asked for is drawn."""
        self.js("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def at(self, plot: int, x: float, y: float) -> tuple[float, float]:
        """Place on the screen of a point, given as shares of the inner rectangle of a plot from the top left."""
        box = self.page.locator(".fp-plot").nth(plot).bounding_box()
        width, height = box["width"] - INNER["x"] - INNER["right"], box["height"] - INNER["y"] - INNER["bottom"]
        return box["x"] + INNER["x"] + x * width, box["y"] + INNER["y"] + y * height

    def drag(
        self, plot: int, start: tuple[float, float], end: tuple[float, float], key: str = "", steps: int = 3
    ) -> None:
        if key:
            self.page.keyboard.down(key)
        self.page.mouse.move(*self.at(plot, *start))
        self.page.mouse.down()
        self.page.mouse.move(*self.at(plot, *end), steps=steps)
        self.page.mouse.up()
        if key:
            self.page.keyboard.up(key)
        self.frames()

    def values(self, plot: int, x: float, y: float) -> tuple[float, float]:
        """Values at a place of a plot."""
        px, py = self.at(plot, x, y)
        found = self.js(f"""(() => {{ const p = grid.plots[{plot}], b = p.top.getBoundingClientRect(), a = p.axes;
            return [a.x.at({px} - b.x), a.y.at({py} - b.y)]; }})()""")
        return found[0], found[1]

    def inside(self, plot: int, start: tuple[float, float], end: tuple[float, float], x: str, y: str) -> np.ndarray:
        """Rows in a box, by NumPy."""
        (x0, y0), (x1, y1) = self.values(plot, *start), self.values(plot, *end)
        xs, ys = self.columns[x], self.columns[y]
        return (xs >= min(x0, x1)) & (xs <= max(x0, x1)) & (ys >= min(y0, y1)) & (ys <= max(y0, y1))

    @property
    def mask(self) -> np.ndarray:
        return np.array(self.js("Array.from(view.mask)"), dtype=bool)

    def pixels(self, canvas: str, plot: int, token: str, near: int = 0) -> int:
        """Pixels of a plot's canvas in the colour of a token; lines are blended with what is behind them."""
        return int(
            self.js(f"""(() => {{ const c = grid.plots[{plot}].{canvas};
            const p = grid.colours.packedOf(grid.colours.{token});
            const d = new Uint32Array(c.getContext("2d").getImageData(0, 0, c.width, c.height).data.buffer);
            const far = (v, s) => Math.abs(((v >> s) & 255) - ((p >> s) & 255));
            return d.reduce((n, v) => n + (v >>> 24 > 0 && far(v, 0) + far(v, 8) + far(v, 16) <= {near}), 0); }})()""")
        )


@pytest.fixture
def opened(tab: Callable[[], Tab], address: str) -> PlotsPage:
    return PlotsPage(tab(), address)


BOX = ((0.3, 0.1), (0.6, 0.6))


def test_a_drag_selects_what_numpy_finds_and_shows_it_in_all_plots(opened: PlotsPage) -> None:
    opened.drag(0, *BOX)
    truth = opened.inside(0, *BOX, "t", "left")
    assert truth.sum() > 20
    np.testing.assert_array_equal(opened.mask, truth)
    told = opened.js("told.selection")
    assert told["count"] == truth.sum()
    assert told["per_run"] == {name: truth[k * COUNT : (k + 1) * COUNT].sum() for k, name in enumerate(plots_page.RUNS)}
    assert all(opened.pixels("marks", k, "select") > 20 for k in range(5))
    opened.until(f"document.querySelector('.fp-live').textContent.startsWith('{truth.sum()} frames selected')")


def test_shift_adds_and_alt_subtracts(opened: PlotsPage) -> None:
    other, part = ((0.7, 0.2), (0.9, 0.9)), ((0.4, 0.0), (0.8, 0.5))
    opened.drag(0, *BOX)
    opened.drag(0, *other, key="Shift")
    both = opened.inside(0, *BOX, "t", "left") | opened.inside(0, *other, "t", "left")
    np.testing.assert_array_equal(opened.mask, both)
    opened.drag(0, *part, key="Alt")
    np.testing.assert_array_equal(opened.mask, both & ~opened.inside(0, *part, "t", "left"))
    opened.drag(1, *BOX)
    np.testing.assert_array_equal(opened.mask, opened.inside(1, *BOX, "x", "left"))


def test_a_selection_over_time_takes_all_values(opened: PlotsPage) -> None:
    opened.drag(3, (0.2, 0.45), (0.4, 0.55))
    low, high = opened.values(3, 0.2, 0)[0], opened.values(3, 0.4, 0)[0]
    t = opened.columns["t"]
    np.testing.assert_array_equal(opened.mask, (t >= low) & (t <= high))


def test_the_legend_hides_isolates_and_is_used_by_keyboard(opened: PlotsPage) -> None:
    page, button = opened.page, opened.page.get_by_role("button", name="v2", exact=True)
    button.click()
    opened.frames()
    assert button.get_attribute("aria-pressed") == "false"
    assert opened.pixels("base", 0, "runs[1]") == 0
    assert opened.pixels("base", 0, "runs[0]") > 100
    opened.drag(0, (0.01, 0.01), (0.99, 0.99))
    assert set(opened.js("told.selection")["per_run"]) == {"v1", "v3"}  # what is hidden is not selected
    button.dblclick()
    assert opened.js("told.hidden.runs") == ["v1", "v3"]
    assert opened.js("view.count") == 0
    button.dblclick()
    assert opened.js("told.hidden.runs") == []
    page.get_by_role("button", name="model", exact=True).focus()
    page.keyboard.press("Enter")
    opened.frames()
    assert opened.js("told.hidden.layers") == ["model"]
    assert opened.pixels("base", 4, "model") == 0
    page.keyboard.press("Shift+Enter")
    assert "model" not in opened.js("told.hidden.layers")
    assert "residual" in opened.js("told.hidden.layers")


def test_runs_have_colours_of_their_own_in_force_over_time(opened: PlotsPage) -> None:
    assert all(opened.pixels("base", 3, f"runs[{k}]", near=60) > 100 for k in range(3))
    packed = opened.js("[...grid.colours.runs, grid.colours.select, grid.colours.model].map((c) => c)")
    assert len(set(packed)) == len(packed)


def test_the_film_follows_the_run_under_the_cursor(opened: PlotsPage) -> None:
    opened.page.get_by_role("button", name="v3", exact=True).dblclick()
    asked = opened.js("window.asked")
    opened.page.mouse.move(*opened.at(0, 0.5, 0.5))
    opened.until("told.cursor && told.cursor.run === 'v3'")
    row = opened.js("told.cursor.row")
    frame = row - 2 * COUNT + plots_page.FRAMES_BEFORE
    assert opened.js("told.cursor.frame") == frame
    opened.until(f"document.querySelector('.fp-label').textContent.startsWith('v3 \\u00b7 frame {frame} of')")
    assert opened.js("window.asked") == asked + 1  # not the first frame of the other film too
    assert opened.js("filmView.canvas.getContext('2d').getImageData(5, filmView.canvas.height / 2, 1, 1).data[1]") == 3
    opened.page.mouse.move(5, 5)
    opened.page.wait_for_timeout(100)
    assert opened.js("view.cursor") == row  # the cursor stays


def test_a_selection_over_several_runs_shows_the_frame_at_the_cursor(opened: PlotsPage) -> None:
    opened.drag(2, (0.05, 0.05), (0.85, 0.95))
    assert len(opened.js("told.selection.per_run")) == 3
    row = opened.js("view.cursor")
    assert opened.mask[row]
    end = opened.values(2, 0.85, 0.95)
    chosen = np.flatnonzero(opened.mask)
    a = opened.js("({kx: grid.plots[2].axes.x.k, ky: grid.plots[2].axes.y.k})")
    far = (a["kx"] * (opened.columns["v"] - end[0])) ** 2 + (a["ky"] * (opened.columns["left"] - end[1])) ** 2
    assert row == chosen[np.argmin(far[chosen])]
    opened.until(f"filmView.film.run === '{plots_page.RUNS[row // COUNT]}'")


def test_a_click_pins_the_cursor_and_a_film_moves_it(opened: PlotsPage) -> None:
    opened.page.mouse.click(*opened.at(0, 0.3, 0.5))
    pinned = opened.js("view.cursor")
    opened.page.mouse.move(*opened.at(0, 0.8, 0.5))
    opened.frames()
    assert opened.js("view.cursor") == pinned
    opened.page.get_by_role("button", name="Next frame").click()
    opened.until(f"view.cursor === {pinned + 1}")
    opened.page.get_by_role("slider", name="Frame", exact=True).focus()
    opened.page.keyboard.press("Home")
    opened.until("filmView.pictureNumber === 0")
    assert opened.js("view.cursor") == pinned + 1  # the motion has not begun in that frame


def test_axes_are_rescaled_only_if_the_data_changed_much(opened: PlotsPage) -> None:
    opened.drag(0, (0.3, 0.2), (0.6, 0.9), key="z")
    zoom = "[grid.plots[0].zoom.x, grid.plots[0].zoom.y].map((axis) => [axis.low, axis.high])"
    before = opened.js(zoom)
    assert opened.js("grid.plots[3].zoom.x.low === grid.plots[0].zoom.x.low")  # the same quantity
    opened.js("load('?size=1&seed=1')")
    opened.until("view.column('left')[0] !== 0")
    opened.frames()
    assert opened.js(zoom) == before  # nearly the same range: the zoom stays
    opened.js("load('?size=0.1&seed=1')")
    opened.until("grid.plots[0].homeAxes.y.high < 2")
    opened.frames()
    assert opened.js("grid.plots[0].zoom.y") is None  # the residual is ten times as small
    assert opened.js("grid.plots[0].zoom.x.low > 0")
    low, high = opened.js("[grid.plots[0].axes.y.low, grid.plots[0].axes.y.high]")
    left = plots_page.columns(COUNT, 0.1, 1)["left"]
    assert low < left.min() < left.max() < high < 2 * left.max()


def test_only_plots_with_new_data_are_drawn_again(opened: PlotsPage) -> None:
    opened.js("""(() => { window.drawn = grid.plots.map(() => 0);
        grid.plots.forEach((p, i) => { const draw = p.draw; p.draw = () => { drawn[i]++; draw.call(p); };
            p.each.base.call = () => p.draw(); }); window.canvas = grid.plots[0].base; })()""")
    opened.js("load('')")
    opened.frames()
    assert opened.js("drawn") == [0] * 5
    opened.js("""view.setScene(view.scene, { ...view.columns, F: view.columns.F.map((v) => v + 0.01) })""")
    opened.frames()
    assert opened.js("drawn") == [0, 0, 0, 1, 1]
    opened.drag(0, *BOX)
    opened.js("view.setCandidate({ with: view.column('left').map((v) => v / 3) }, { name: 'texture' })")
    opened.frames()
    assert opened.js("drawn") == [0, 0, 0, 1, 1]
    assert opened.js("window.canvas === grid.plots[0].base")


def test_a_candidate_is_drawn_with_its_label_in_the_plot_that_it_changes_most(opened: PlotsPage) -> None:
    opened.js("""view.setCandidate({ with: view.column('left').map((v) => v / 3) },
        { name: 'texture', plot: 'Residual against place', label: '3.2 to 0.7 um with texture' })""")
    opened.frames()
    inks = [opened.pixels("marks", k, "ink") for k in range(5)]
    assert inks[1] > 20
    assert inks[0] == inks[2] == 0
    assert all(opened.pixels("marks", k, "candidate") > 50 for k in range(3))
    assert opened.pixels("marks", 4, "candidate") == 0  # it says nothing of the force
    opened.page.get_by_role("button", name="candidate, with texture").click()
    opened.frames()
    assert opened.pixels("marks", 1, "candidate") == 0
    opened.page.get_by_role("button", name="candidate, with texture").click()
    opened.js("view.setCandidate(null)")
    opened.frames()
    assert opened.pixels("marks", 1, "candidate") == 0


def film_point(opened: PlotsPage, x: float, y: float) -> tuple[float, float]:
    """Place on the screen of a point of the film."""
    box = opened.page.locator(".fp-picture").bounding_box()
    p = opened.js("filmView.place")
    return box["x"] + p["left"] + (x + 0.5) * p["k"], box["y"] + p["top"] + (y + 0.5) * p["k"]


def test_a_quick_drag_right_after_the_choice_of_a_tool_draws(opened: PlotsPage) -> None:
    opened.page.mouse.move(*film_point(opened, 50, 20))
    opened.js("filmView.setTool('target')")
    opened.page.mouse.down()
    opened.page.mouse.move(*film_point(opened, 90, 70))
    opened.js("filmView.setTool('ruler')")  # while the drag is under way
    opened.page.mouse.up()
    drawn = opened.js("told.drawn")
    assert drawn["tool"] == "target"
    assert drawn["run"] == "v1"
    np.testing.assert_allclose(drawn["shape"], [50, 20, 40, 50], atol=0.6)
    opened.js("filmView.setTool('ruler')")
    opened.page.mouse.move(*film_point(opened, 10, 10))
    opened.page.mouse.down()
    opened.page.mouse.move(*film_point(opened, 210, 12))
    opened.page.mouse.up()
    np.testing.assert_allclose(opened.js("told.drawn.shape"), [[10, 10], [210, 12]], atol=0.6)


@pytest.mark.parametrize("end", ["Enter", "double click"])
def test_a_polygon_is_closed_by_enter_or_a_double_click(opened: PlotsPage, end: str) -> None:
    corners = [(40, 30), (100, 30), (120, 90), (50, 80)]
    opened.js("filmView.setTool('polygon')")
    opened.page.locator(".fp-picture").focus()
    for corner in corners[:-1]:
        opened.page.mouse.click(*film_point(opened, *corner))
        opened.page.wait_for_timeout(20)
    if end == "Enter":
        opened.page.mouse.click(*film_point(opened, *corners[-1]))
        opened.page.keyboard.press("Enter")
    else:
        opened.page.mouse.dblclick(*film_point(opened, *corners[-1]))
    drawn = opened.js("told.drawn")
    assert drawn["tool"] == "polygon"
    np.testing.assert_allclose(drawn["shape"], corners, atol=0.6)


def test_shapes_are_drawn_by_keyboard(opened: PlotsPage) -> None:
    opened.js("filmView.setTool('repair')")
    opened.page.locator(".fp-picture").focus()
    for key in (
        "ArrowLeft",
        "Shift+ArrowUp",
        "Enter",
        "Shift+ArrowRight",
        "Shift+ArrowRight",
        "Shift+ArrowDown",
        "Enter",
    ):
        opened.page.keyboard.press(key)
    assert opened.js("told.drawn") == {
        "tool": "repair",
        "shape": [159, 50, 20, 10],
        "frame": 0,
        "run": "v1",
        "file": None,
    }


def test_the_range_of_a_repair_is_dragged_and_moved_by_keys(opened: PlotsPage) -> None:
    opened.js("filmView.range = { from: 100, to: 200 }")
    end = opened.page.get_by_role("slider", name="Last frame of the range")
    box, line = end.bounding_box(), opened.page.locator(".fp-timeline").bounding_box()
    opened.page.mouse.move(box["x"] + 6, box["y"] + 10)
    opened.page.mouse.down()
    opened.page.mouse.move(line["x"] + 8 + (line["width"] - 16) * 300 / (COUNT + 9), box["y"] + 10, steps=3)
    opened.page.mouse.up()
    low, high = opened.js("told.moved.span")
    assert low == 100
    assert abs(high - 300) <= 1
    opened.page.get_by_role("slider", name="First frame of the range").focus()
    opened.page.keyboard.press("Shift+ArrowRight")
    assert opened.js("told.moved") == {"handle": "range", "span": [110, high], "run": "v1"}


def test_playing_reads_ahead_and_asks_for_one_frame_at_a_time(opened: PlotsPage) -> None:
    opened.js("""(() => { const fetch = filmView.frames.fetch; window.open_ = window.most = 0;
        filmView.frames.fetch = async (...a) => { most = Math.max(most, ++open_);
            try { return await fetch(...a); } finally { open_--; } }; })()""")
    opened.page.get_by_label("Speed").select_option("60")
    opened.page.get_by_role("button", name="Play").click()
    opened.until("filmView.number > 20")
    opened.page.get_by_role("button", name="Pause").click()
    assert opened.js("most") == 1
    assert opened.js("filmView.frames.kept.size <= 24")
    assert opened.js("filmView.frames.kept.size > 5")
    opened.js("for (let k = 0; k < 50; k++) filmView.show(100 + k)")
    opened.until("filmView.pictureNumber === 149")  # of many requests the last one wins
    assert opened.js("window.asked") < 60


def test_a_late_frame_does_not_replace_a_newer_one(opened: PlotsPage) -> None:
    opened.js("""(() => { const fetch = filmView.frames.fetch; filmView.show(7);
        filmView.frames.fetch = async (film, n) => { if (n === 50) await new Promise((done) => setTimeout(done, 200));
            return fetch(film, n); }; })()""")
    opened.until("filmView.pictureNumber === 7")
    opened.js("filmView.show(50); filmView.show(7)")  # which is kept
    opened.until("filmView.frames.kept.size >= 3 && !filmView.frames.busy")
    assert opened.js("filmView.pictureNumber") == 7


@pytest.mark.slow
def test_many_selections_leave_nothing_in_memory(opened: PlotsPage) -> None:
    session = opened.page.context.new_cdp_session(opened.page)
    session.send("HeapProfiler.enable")

    def heap_mb() -> float:
        session.send("HeapProfiler.collectGarbage")
        return float(session.send("Runtime.getHeapUsage")["usedSize"]) / 1e6

    brush = """(async (count) => { for (let i = 0; i < count; i++) {
        const plot = grid.plots[i % 5], low = (i * 7) % 60, time = [low, low + 30];
        view.beginBrush(); view.brush((mask) => plot.fillBox(mask, time, [-99, 99]), ["replace", "add"][i % 2]);
        view.point(view.chosen[0], "selection"); view.announce();
        if (i % 20 === 0) await new Promise(requestAnimationFrame); } })"""
    opened.js(f"{brush}(200)")
    before = heap_mb()
    opened.js(f"{brush}(2000)")
    assert heap_mb() - before < 1


def test_a_plot_is_moved_by_its_handle_or_by_keys(tab: Callable[[], Tab], address: str) -> None:
    opened = PlotsPage(tab(), address, f"?large={LARGE}")
    shown = "grid.placed.map((plot) => plot.spec.title)"
    usual = opened.js(shown)
    handle = opened.page.get_by_role("button", name=f"Move {usual[2]}", exact=True)
    handle.focus()
    box = handle.bounding_box()
    opened.page.mouse.move(box["x"] + 5, box["y"] + 5)
    opened.page.mouse.down()
    opened.page.mouse.move(*opened.at(opened.js("grid.plots.indexOf(grid.placed[0])"), 0.5, 0.5), steps=3)
    opened.page.mouse.up()
    moved = [usual[2], *usual[:2], *usual[3:]]
    assert opened.js(shown) == moved
    assert opened.js("told.layout") == {"order": moved, "alone": None}
    assert opened.js("[...grid.grid.children].map((n) => n.classList.contains('fp-large'))").index(True) == 0
    opened.page.keyboard.press("ArrowRight")
    assert opened.js(shown) == [usual[0], usual[2], usual[1], *usual[3:]]
    assert opened.js("document.activeElement.getAttribute('aria-label')") == f"Move {usual[2]}"
    opened.js("load('?')")  # the same study again
    assert opened.js(shown)[1] == usual[2]
    handle.dblclick()
    assert opened.js(shown) == usual


def test_plots_are_used_by_keyboard(opened: PlotsPage) -> None:
    top = opened.page.get_by_role("application", name="Residual against time")
    top.focus()
    for _ in range(3):
        opened.page.keyboard.press("ArrowRight")
    assert opened.js("view.cursor") == 3
    for _ in range(2):
        opened.page.keyboard.press("Shift+PageDown")
    assert opened.js("view.count") == 51
    opened.until("document.querySelector('.fp-live').textContent.startsWith('51 frames selected: 51 in v1')")
    home = opened.js("grid.plots[0].axes.x.span")
    opened.page.keyboard.press("+")
    assert opened.js("grid.plots[0].axes.x.span") == pytest.approx(0.8 * home)
    opened.page.keyboard.press("0")
    assert opened.js("grid.plots[0].axes.x.span") == pytest.approx(home)
    opened.page.keyboard.press("Escape")
    assert opened.js("view.count") == 0
    opened.page.get_by_role("application", name="Force against time").focus()
    opened.page.keyboard.press("]")
    moved = opened.js("told.moved")
    assert moved["handle"] == "free"
    assert moved["span"] == pytest.approx([10.0, opened.columns["t"][opened.js("view.cursor")]])


def test_dark_mode_draws_on_a_dark_ground(opened: PlotsPage) -> None:
    ground = "grid.plots[0].base.getContext('2d').getImageData(3, 3, 1, 1).data[0]"
    assert opened.js(ground) > 200
    opened.js("document.documentElement.dataset.theme = 'dark'")
    opened.until(f"{ground} < 60")
    assert opened.pixels("base", 0, "runs[0]") > 100
    opened.js("delete document.documentElement.dataset.theme")
    opened.until(f"{ground} > 200")


@pytest.mark.few(1)
@pytest.mark.parametrize(("width", "ratio"), [(800, 1), (2560, 1), (1280, 2)])
def test_plots_fit_their_page(chromium: Any, address: str, width: int, ratio: int) -> None:
    page = chromium.new_page(viewport={"width": width, "height": 900}, device_scale_factor=ratio)
    opened = PlotsPage(Tab(page), address, f"?large={LARGE.replace(' ', '%20')}")
    boxes = [plot.bounding_box() for plot in page.locator(".fp-plot").all()]
    assert all(box["x"] + box["width"] <= width + 1 for box in boxes)
    assert boxes[0]["height"] > 1.3 * boxes[1]["height"]
    assert opened.js("grid.plots[0].base.width") == pytest.approx(boxes[0]["width"] * ratio, abs=3)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.close()


@pytest.mark.slow
def test_destroy_leaves_no_listener_and_no_element(opened: PlotsPage) -> None:
    session = opened.page.context.new_cdp_session(opened.page)

    def listeners(expression: str) -> int:
        found = session.send("Runtime.evaluate", {"expression": expression})["result"]["objectId"]
        return len(session.send("DOMDebugger.getEventListeners", {"objectId": found})["listeners"])

    opened.js("filmView.play()")
    opened.js(
        "Object.assign(window, {old: [grid.plots[0].top, filmView.canvas, filmView.timeline.track, legend.root]})"
    )
    before = [listeners(f"old[{k}]") for k in range(4)]
    assert min(before) > 0
    on_window = listeners("window")
    opened.js("[filmView, legend, grid].forEach((part) => part.destroy())")
    assert [listeners(f"old[{k}]") for k in range(4)] == [0] * 4
    assert listeners("window") == on_window - 3  # keys and blur
    assert (
        opened.js("[...view.calls.values()].map((calls) => calls.size).filter(Boolean)") == [1] * 7
    )  # those of this test
    assert opened.js("document.querySelectorAll('[class^=fp-]').length") == 0
    asked = opened.js("window.asked")
    opened.page.wait_for_timeout(300)
    assert opened.js("window.asked") <= asked + 1  # it plays no more
    assert opened.js("filmView.frames.kept.size") == 0
