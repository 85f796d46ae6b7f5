"""Repairs of mistracked frames: the study file, positions and their errors, undo, marks, and what a verdict rests on.

The film is drawn here, with exact positions: a hand with a copy of the target covers the target for 30 frames, and a
flash hides it for 10. Today's tracker follows the copy.
"""

from __future__ import annotations

import re
import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import tifffile
from film import FULL_WELL, READ_NOISE, Film, block_film, expose, speckle

import frictrack as ft
from frictrack.diagnose.data_faults import chi2_without
from frictrack.flow import Session, open_study, read_results
from frictrack.present.export import write as export_tables
from frictrack.records import Displacement, Motion, Track
from frictrack.settings.repairs import Repair, read_repairs, repair_codes
from frictrack.study import load

N, FPS, SHAPE, SIZE = 300, 4000.0, (128, 512), (60, 90)
COVERED, FLASH = range(100, 130), range(200, 210)
HIDDEN = {"from": 104, "to": 126, "how": "interpolate"}
FLASHED = {"from": FLASH[0], "to": FLASH[-1], "how": "interpolate"}
OTHER_FILMS = ("double_mass", "slow", "to_a_stop")
TARGET = [15, 34, 90, 60]
T = np.arange(N) / FPS
X = 60 + 5200.0 * T - 7000.0 * T**2  # px, of the middle of the target
STUDY = """[study]
mass = 0.35

[camera]
fps = 4000
scale = "0.5 mm/px"

[[run]]
video = "hand.tif"
target = [15, 34, 90, 60]
reference = "none"
"""


def hand_row(i: int) -> int:
    """Rows of the picture, from above, that the hand covers in a frame."""
    return min(14 * min(i - COVERED.start + 1, COVERED.stop - i), 104) if i in COVERED else 0


@cache
def pictures(seed: int = 0) -> np.ndarray:
    base = block_film(X, seed=seed, size=SIZE, shape=SHAPE, fps=FPS)
    skin = 170 + speckle((128, 140), np.random.default_rng(seed + 1), fwhm=12.0, contrast=12.0)
    skin[32:92, 40:130] = 128 + speckle((96, 128), np.random.default_rng(seed))[:60, :90]  # the copy that it holds

    def draw(i: int) -> np.ndarray:
        if i in FLASH:
            return np.full(SHAPE, 255, np.uint8)
        picture, depth, left = base.frame(i), hand_row(i), int(X[i]) - 70
        if depth:
            part = skin[-depth:] if depth < 80 else np.roll(skin, depth - 128, axis=0)[:depth]
            picture = picture.copy()
            picture[:depth, left : left + 140] = expose(part, np.random.default_rng([seed, i, 7]))
        return picture

    return np.stack([draw(i) for i in range(N)])


def hand_film(seed: int = 0) -> Film:
    shown = pictures(seed)
    return Film(lambda i: shown[i], N, SHAPE, FPS)


@cache
def tracked(seed: int = 0) -> tuple[Film, Track]:
    film = hand_film(seed)
    return film, ft.track(film, TARGET)


def near(i: int, off: tuple[float, float] = (0.0, 0.0)) -> list[float]:
    """A rectangle that a user draws round the target in frame i, not exactly."""
    return [float(X[i]) - 50 + off[0], 30 + off[1], 100.0, 70.0]


def repairs(off: tuple[float, float] = (0.0, 0.0)) -> list[dict]:
    return [HIDDEN, {"from": 127, "to": 129, "how": "track", "frame": 129, "target": near(129, off)}, FLASHED]


def errors(track: Track) -> np.ndarray:
    """Errors (n,) px; a constant is the choice of the point of the target."""
    off = track.x_px - X
    return off - np.nanmedian(off[:100])


def bound(i: int, seed: int = 0) -> float:
    """Cramer-Rao bound of x, px, from the pixels of the target that the hand leaves free in frame i.

    The grey values are fitted with position, gain and offset; their noise is shot noise, read noise and rounding.
    """
    y, step = (SHAPE[0] - 1) / 2, 0.25

    def clean(dx: float, dy: float) -> np.ndarray:
        film = block_film(np.full(2, X[i] + dx), np.full(2, y + dy), seed=seed, size=SIZE, shape=SHAPE, noise=False)
        return film.frame(0).astype(float)

    slopes = [(clean(*at) - clean(*(-v for v in at))) / (2 * step) for at in ((step, 0), (0, step))]
    rows, cols = np.ogrid[: SHAPE[0], : SHAPE[1]]
    shown = (np.abs(cols - X[i]) < SIZE[1] / 2) & (np.abs(rows - y) < SIZE[0] / 2) & (rows >= hand_row(i))
    grey, electrons = clean(0, 0)[shown], FULL_WELL / 255
    sigma = np.sqrt((grey * electrons + READ_NOISE**2) / electrons**2 + 1 / 12)
    design = np.stack([*(s[shown] for s in slopes), grey, np.ones(len(grey))], axis=1) / sigma[:, None]
    return float(np.sqrt(np.linalg.inv(design.T @ design)[0, 0]))


class TestTheStudyFile:
    @pytest.mark.parametrize(
        ("one", "sentence"),
        [
            ({"from": 5, "to": 3, "how": "leave_out"}, "whose last frame follows the first but got 5 to 3"),
            ({"from": 5, "to": 9, "how": "guess"}, 'number 1 as "track", "interpolate" or "leave_out" but'),
            ({"from": 5, "to": 9, "how": "track"}, "but got none; draw the target in one of these frames"),
            ({"from": 5, "to": 9, "how": "interpolate", "frame": 6}, "target and frame only in a repair with how"),
            ({"from": 5, "to": 9, "how": "track", "frame": 10, "target": [1, 2, 9, 9]}, "from 5 to 9 but got frame 10"),
            ({"from": 5.5, "to": 9, "how": "leave_out"}, "expected from of number 1 as a whole number but got 5.5"),
            ({"from": 5, "to": 9, "until": 9, "how": "leave_out"}, 'unknown key "until" in number 1'),
        ],
    )
    def test_a_wrong_repair_is_refused_with_one_sentence(self, one, sentence):
        with pytest.raises(ft.FrictrackError, match=re.escape(sentence)):
            read_repairs([one])

    def test_overlapping_repairs_are_refused(self):
        with pytest.raises(ft.FrictrackError, match="frames 5 to 9 and frames 9 to 12 have frames in common"):
            read_repairs([{"from": 9, "to": 12, "how": "leave_out"}, {"from": 5, "to": 9, "how": "leave_out"}])

    def test_a_table_has_no_pictures(self, tmp_path):
        (tmp_path / "a.csv").write_text("t_s,x_m\n0,0\n1,1\n")
        repair = '{from = 0, to = 0, how = "track", target = [1, 1, 9, 9]}'
        (tmp_path / "study.toml").write_text(f'[study]\nmass = 1\n[[run]]\ntable = "a.csv"\nrepair = [{repair}]\n')
        with pytest.raises(ft.FrictrackError, match="a table has no pictures"):
            load(tmp_path / "study.toml")

    def test_a_repair_is_written_as_it_is_read(self):
        one = {"from": 5, "to": 9, "how": "track", "frame": 6, "target": (1.0, 2.0, 9.0, 9.0)}
        assert [r.to_dict() for r in read_repairs([one])] == [one]


class TestAFilmWithAHand:
    @pytest.mark.slow
    def test_without_repair_the_copy_is_followed(self):
        track = tracked()[1]
        wrong = np.abs(errors(track)) > 1
        assert 15 < np.count_nonzero(wrong[COVERED]) <= 30
        assert np.nanmedian(track.sigma_px[wrong]) < 0.01  # stated with confidence
        assert not track.found[FLASH].any()

    def test_the_suspect_spans_are_those_of_hand_and_flash(self):
        first, second = ft.suspect_spans(tracked()[1])
        assert COVERED[0] <= first.first <= 108
        assert 120 <= first.last <= COVERED[-1] + 1
        assert (second.first, second.last) == (FLASH[0], FLASH[-1])

    @pytest.mark.parametrize("name", ["fast", *(pytest.param(n, marks=pytest.mark.slow) for n in OTHER_FILMS)])
    def test_clean_films_have_no_suspect_spans(self, name):
        film = ft.open_recording(ft.samples.films_folder() / f"{name}.avi")
        track = ft.track(film)
        last = int(np.flatnonzero(track.found)[-1]) - 20
        corner = np.rint([track.x_px[last], track.y_px[last]] - (np.array(track.target[2:]) - 1) / 2)
        backward = ft.track(film, [*corner, *track.target[2:]], template=last)
        assert ft.suspect_spans(track) == ()
        off = np.nanmedian(backward.x_px - track.x_px), np.nanmedian(backward.y_px - track.y_px)
        aligned = replace(backward, x_px=backward.x_px - off[0], y_px=backward.y_px - off[1])
        assert ft.suspect_spans(track, aligned) == ()

    @pytest.mark.slow
    def test_repaired_positions_reach_the_bound_where_the_target_is_visible(self):
        film, track = tracked()
        found = ft.repair(track, film, repairs())
        visible = [*range(100, 104), 127, 128, 129]
        ratio = [errors(found)[i] / bound(i) for i in (*visible, *range(10, 100, 9), *range(140, 200, 9))]
        assert found.found[visible].all()
        assert np.sqrt(np.mean(np.square(ratio[: len(visible)]))) < 1.5
        assert np.sqrt(np.mean(np.square(ratio))) < 1.5
        assert found.repaired.tolist() == [2 * (104 <= i <= 126 or i in FLASH) + (127 <= i <= 129) for i in range(N)]

    @pytest.mark.slow
    def test_interpolated_positions_agree_with_their_standard_deviations(self):
        film, track = tracked()
        found = ft.repair(track, film, repairs())
        for gap in (slice(104, 127), slice(FLASH[0], FLASH[-1] + 1)):
            zero = 1.25 * np.median(track.sigma_px[:100]) / 10  # of the median that `errors` subtracts
            z = errors(found)[gap] / np.hypot(found.sigma_px[gap], zero)
            assert np.sqrt(np.mean(z**2)) < 3.0  # the errors in one gap go together: one draw
        assert not found.found[104:127].any()
        assert not ft.calibrate(found, scale="0.5 mm/px").known[104:127].any()

    @pytest.mark.slow
    def test_the_drawn_rectangle_only_tells_where_to_look(self):
        film, track = tracked()
        again = [{"from": 20, "to": 60, "how": "track", "frame": 40}]
        for off in ((0.0, 0.0), (14.0, -11.0), (-20.3, 9.7)):
            found = ft.repair(track, film, [again[0] | {"target": near(40, off)}])
            change = (found.x_px - track.x_px)[20:61] / track.sigma_px[20:61]
            assert np.median(np.abs(change)) < 0.01
            assert np.max(np.abs(change)) < 0.5  # of a frame in which another pixel counts as covered
            assert found.sigma_px[20:61] == pytest.approx(track.sigma_px[20:61], rel=0.05)

    @pytest.mark.slow
    def test_a_target_that_is_not_there_is_said(self):
        film, track = tracked()
        with pytest.raises(ft.FrictrackError, match=r"frames 20 to 30: expected the target near .* not recognised"):
            ft.repair(track, film, [{"from": 20, "to": 30, "how": "track", "target": [400, 10, 90, 60]}])
        with pytest.raises(ft.FrictrackError, match="from 0 to 299 but got 290 to 300"):
            ft.repair(track, film, [{"from": 290, "to": 300, "how": "leave_out"}])
        with pytest.raises(ft.FrictrackError, match="inside the 512x128 px picture"):
            ft.repair(track, film, [{"from": 20, "to": 30, "how": "track", "target": [500, 10, 90, 60]}])
        with pytest.raises(ft.FrictrackError, match="measured frames before and after"):
            ft.repair(track, film, [{"from": 280, "to": 299, "how": "interpolate"}])


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study of the film, measured without and with repairs, and after undo."""
    folder = tmp_path_factory.mktemp("hand")
    tifffile.imwrite(folder / "hand.tif", pictures(), photometric="minisblack")
    path = folder / "study.toml"
    path.write_text(STUDY)
    return path


def measured(path, stage="motion"):
    session = Session(open_study(path))
    session.measure(stage)
    return session


class TestAStudy:
    @pytest.mark.slow
    def test_undo_restores_the_bytes_and_the_numbers_without_tracking_again(self, study, monkeypatch):
        before, first = study.read_bytes(), measured(study).runs[0]
        old = {name: first.get(name) for name in ("track", "displacement", "motion")}
        monkeypatch.setattr("frictrack.tracking.track", None)  # the film is not tracked again
        Session(open_study(study)).apply("edit", table="run", which="hand", key="repair", value=repairs())
        assert read_repairs(repairs()) == open_study(study).runs[0].repair
        began = time.process_time()
        repaired = measured(study).runs[0]
        assert time.process_time() - began < 10
        assert np.abs(errors(repaired.final_track)[COVERED]).max() < 0.05
        assert np.array_equal(repaired.get("track").x_px, old["track"].x_px, equal_nan=True)
        Session(open_study(study)).apply("undo")
        assert study.read_bytes() == before
        after = measured(study).runs[0]
        for name, record in old.items():
            for column in ("x_px", "sigma_px") if name == "track" else ("x",):
                assert np.array_equal(getattr(after.get(name), column), getattr(record, column), equal_nan=True)
        Session(open_study(study)).apply("redo")

    def test_repaired_frames_are_marked_through_to_newtons(self, study):
        if not open_study(study).runs[0].repair:
            Session(open_study(study)).apply("edit", table="run", which="hand", key="repair", value=repairs())
        session = measured(study, "friction")
        session.fit()
        results = read_results(open_study(study))
        run, model = results.runs[0], results.models[0]
        assert run.track.repaired[[103, 104, 128, 205]].tolist() == [0, 2, 1, 2]
        for record in (run.displacement, run.motion, run.friction):
            at = np.searchsorted(record.t, run.track.t[[103, 104, 128, 205]] - 1e-9)
            assert record.repaired[at].tolist() == [0, 2, 1, 2]
        assert all(
            set(np.unique(curve.repaired)) <= {0, 1} for curve in model.curves
        )  # interpolated frames are no data
        assert any("repaired by the user: frames 104 to 126 interpolated" in note for note in run.notes)
        assert any(note.startswith("repairs set from python at 20") for note in run.notes)
        table = next(path for path in export_tables(results, "csv") if path.stem == "hand")
        assert "repaired" in table.read_text().splitlines()[0].split(",")

    def test_results_without_repairs_have_no_marks(self):
        run = ft.samples.runs()[0]
        assert run.displacement.repaired is None
        assert run.motion.repaired is None


def test_rows_of_a_table_are_left_out(tmp_path):
    t = np.arange(200) / 1000
    x = 2.0 * t - 1.5 * t**2 + 1e-6 * np.random.default_rng(0).standard_normal(200)
    x[80:90] += 1e-3
    lines = "\n".join(f"{a:.6f},{b:.9f}" for a, b in zip(t, x, strict=True))
    (tmp_path / "a.csv").write_text(f"t_s,x_m\n{lines}\n")
    repair = '{from = 80, to = 89, how = "leave_out"}'
    (tmp_path / "study.toml").write_text(f'[study]\nmass = 0.4\n[[run]]\ntable = "a.csv"\nrepair = [{repair}]\n')
    run = measured(tmp_path / "study.toml").runs[0]
    assert not run.get("displacement").known[80:90].any()
    motion = run.get("motion")
    assert motion.repaired[79:91].tolist() == [0] + 10 * [3] + [0]
    assert np.abs(motion.x[80:90] - (2.0 * t - 1.5 * t**2)[80:90]).max() < 2e-6


CODES = np.where((np.arange(300) >= 120) & (np.arange(300) < 140), 1, 0).astype(np.int8)


def slide(*, wave: float = 0.0, bump: float = 0.0, codes=None, seed: int = 0, speed: float = 3.0) -> ft.Run:
    """A run of Coulomb and viscous friction, of a waviness over 30 mm, with a wrong repair of height `bump`, m."""
    steps, t = 20, np.arange(300) / 2000
    dt, x, v, course = 1 / 2000 / steps, 0.0, speed, []
    for _ in t:
        course.append(x)
        for _ in range(steps):  # midpoint rule
            half = v - (2.0 + 0.6 * v + wave * np.sin(2 * np.pi * x / 0.03)) / 0.35 * dt / 2
            a = -(2.0 + 0.6 * half + wave * np.sin(2 * np.pi * (x + v * dt / 2) / 0.03)) / 0.35
            x, v = x + half * dt, v + a * dt
    positions = np.array(course) + 1e-6 * np.random.default_rng(seed).standard_normal(300) + bump * (CODES == 1)
    nan, one = np.full(300, np.nan), np.ones(300)
    displacement = Displacement(t, positions, nan, nan, 1e-6 * one, nan, one == 1, repaired=codes)
    return ft.Run(displacement, ft.differentiate(ft.low_pass(displacement)), mass=0.35, name=f"v{speed:g}")


def diagnosis(**repaired) -> ft.Diagnosis:
    runs = [slide(codes=CODES, **repaired), slide(seed=1, speed=2.5, wave=repaired.get("wave", 0.0))]
    return ft.diagnose(ft.fit(["coulomb", "viscous"], runs), quick=True)


class TestTheVerdict:
    @pytest.mark.slow
    def test_a_wrong_repair_that_makes_an_effect_is_said(self):
        found = diagnosis(bump=20e-6)
        assert found.verdict in ("missing", "ambiguous", "unexplained")
        assert found.rests_on_repairs is not None
        assert found.rests_on_repairs.startswith('this verdict rests on 20 frames of run "v3" that were tracked again')
        assert found.summary()["rests_on_repairs"] == found.rests_on_repairs

    @pytest.mark.slow
    def test_a_right_repair_changes_nothing(self):
        found = diagnosis(wave=0.3)
        assert found.missing == ["texture"]
        assert found.rests_on_repairs is None

    def test_a_complete_model_rests_on_nothing(self):
        found = diagnosis()
        assert (found.verdict, found.rests_on_repairs) == ("complete", None)

    def test_leaving_rows_out_equals_a_fit_without_them(self):
        runs = [slide(codes=CODES, bump=5e-6), slide(seed=1, speed=2.5)]
        solution = ft.fit(["coulomb", "viscous"], runs).solution
        linear = chi2_without(solution, [run.motion.repaired for run in runs])
        kept = [np.ones(len(r.r_full), bool) for r in solution.responses]
        kept[0] = CODES[solution.responses[0].piece.frames] != 1
        # The same by one dense least-squares problem, in which the starts are unknowns like any other.
        width = len(solution.p) + 2 * len(kept)
        rows, right = [], []
        for k, (response, use) in enumerate(zip(solution.responses, kept, strict=True)):
            block = np.zeros((len(use), width))
            block[:, response.active] = response.jac
            block[:, len(solution.p) + 2 * k : len(solution.p) + 2 * k + 2] = response.q
            rows.append(block[use])
            right.append(response.r_full[use])
        matrix, vector = np.concatenate(rows), np.concatenate(right)
        matrix = matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        step = np.linalg.lstsq(matrix, vector, rcond=1e-10)[0]  # F_c and both levels are one direction too many
        assert linear == pytest.approx(float(np.sum((vector - matrix @ step) ** 2)), rel=1e-9)


@pytest.mark.slow
def test_interpolated_positions_are_calibrated_over_many_gaps():
    def draw(seed: int, gap: slice) -> np.ndarray:
        noise = 0.0013 * np.random.default_rng(seed).standard_normal((2, N))
        lost = np.where((np.arange(N) >= gap.start) & (np.arange(N) < gap.stop), np.nan, 0.0)
        one, reason = np.ones(N), np.where(np.isnan(lost), "hidden", "")
        track = Track(
            T, X + noise[0] + lost, 60 + noise[1] + lost, lost, 0.0013 * one, 0.0013 * one, one, reason,
        )  # fmt: skip
        found = ft.repair(track, None, [{"from": gap.start, "to": gap.stop - 1, "how": "interpolate"}])
        return ((found.x_px - X) / found.sigma_px)[gap]

    for gap in (slice(200, 210), slice(104, 127)):
        z = np.array([draw(seed, gap) for seed in range(40)])
        assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4
        assert np.mean(np.abs(z[:, z.shape[1] // 2]) > 3) <= 0.05


def test_the_slow_error_of_a_track_is_in_its_interpolated_positions_too():
    """No smoother averages it out: it adds to the variance of every bridged position, along x and y."""
    n, gap = 100, slice(50, 56)
    noise, one = 0.0013 * np.random.default_rng(0).standard_normal((2, n)), np.ones(n)
    exact = Track(T[:n], X[:n] + noise[0], 60 + noise[1], 0 * one, 0.0013 * one, 0.0013 * one, one, np.full(n, ""))
    bridge = [{"from": gap.start, "to": gap.stop - 1, "how": "interpolate"}]
    plain, slow = (ft.repair(replace(exact, systematic=error), None, bridge) for error in (0.0, 0.02))
    for name in ("sigma_px", "sigma_y_px"):
        more = getattr(slow, name)[gap] ** 2 - getattr(plain, name)[gap] ** 2
        np.testing.assert_allclose(more, 0.02**2, rtol=1e-6)


def test_a_mark_says_how_a_frame_was_repaired():
    repairs = [Repair(i, i, how) for i, how in enumerate(("track", "interpolate", "leave_out"))]
    assert repair_codes(repairs, 3).tolist() == [1, 2, 3]
    assert Motion.__dataclass_fields__["repaired"].default is None
