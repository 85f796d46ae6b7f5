"""Automatic targets among other things: one small film of each kind, drawn by the tracking benchmark."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from frictrack.base.errors import FrictrackError
from frictrack.tracking import track
from frictrack.tracking.detection import resolve_target

sys.path.insert(0, str(Path(__file__).parents[1] / "pipelines" / "benchmarks"))

from tracking.automatic import _error, _on, judge
from tracking.obstructed import DISTURBANCES, DrawnFilm, scene

SMALL = {"frames": 40, "shape": (96, 320)}
ROLLING = {"frames": 60, "shape": (96, 320), "disc": True, "motion": "slide", "disturbances": [], "quality": None}


def found(film):
    """What is found without a given target: "body", "choices", or where and why not."""
    try:
        box, frame = resolve_target(DrawnFilm(film.frames))
    except FrictrackError as e:
        boxes = re.findall(r"target = \[(\d+), (\d+), (\d+), (\d+)\](?: with template = (\d+))?", str(e))
        on = [_on(film.body, [float(q) for q in b[:4]], int(b[4] or 0)) for b in boxes]
        return "choices" if len(on) in (2, 3) and any(on) else str(e)
    return "body" if _on(film.body, box, frame) else f"{box} in frame {frame}"


@pytest.mark.few(10)
@pytest.mark.parametrize("disc", [False, True], ids=["block", "disc"])
@pytest.mark.parametrize("look", ["textured", "plain", "marked"])
@pytest.mark.parametrize("kind", DISTURBANCES)
def test_the_body_is_found_among(kind, look, disc):
    film = scene(3, disturbances=[kind], look=look, motion="slide", disc=disc, **SMALL)
    assert found(film) in ("body", "choices")


@pytest.mark.parametrize("motion", ["accelerate", "bounce", "oscillate"])
def test_a_body_that_rests_first_or_bounces_back(motion):
    film = scene(5, disturbances=["hand", "wall"], look="textured", motion=motion, disc=False, **SMALL)
    assert found(film) in ("body", "choices")


@pytest.mark.parametrize("seed", [1142, 1196], ids=["a scale that shakes", "a shadow that passes"])
def test_the_body_is_named_beside(seed):
    """Three still points were taken as none, so that scale and body were one; a shadow hid the body that it passes."""
    assert found(scene(seed)) == "choices"


@pytest.mark.slow
def test_the_marks_of_a_rolling_disc_are_followed_through_turns():
    film = scene(2, look="marked", **ROLLING)
    assert np.ptp(film.body.angle) > np.pi
    result = track(DrawnFilm(film.frames))
    known = np.flatnonzero(result.found)
    assert len(known) > 50
    turned, true = (np.unwrap(q[known]) for q in (result.angle, film.body.angle))
    assert np.ptp(turned - true) < 0.05
    assert np.nanstd(_error(film, result)[known, 0]) < 0.05


@pytest.mark.slow
def test_the_rotation_of_a_plain_disc_is_said_to_be_unseen():
    film = scene(6, look="plain", slope=0.0, **ROLLING)  # shading that turns with it would be a mark that is not seen
    result = track(DrawnFilm(film.frames))
    assert any("how far it turns is not seen" in note for note in result.notes)
    assert np.nanmax(np.abs(result.angle)) == 0
    assert np.nanmin(result.sigma_angle) > 1
    assert len(result.outline) == 24  # its whole outline is the target
    assert np.ptp(np.array(result.outline), axis=0) == pytest.approx(2 * film.body.half + 3, abs=2)
    assert np.nanstd(_error(film, result)[:, 0]) < 0.04


@pytest.mark.slow
@pytest.mark.parametrize(("wall", "seed"), [("brick", 3), ("plank", 5)])
def test_a_faint_body_is_tracked_or_refused_but_no_empty_place_is(wall, seed):
    """Bricks look alike, and a plain region slides along the grain of a plank."""
    plain = {"look": "plain", "disc": False, "motion": "accelerate", "disturbances": [], "quality": None}
    film = scene(seed, wall=wall, contrast=14, frames=60, shape=(64, 240), **plain)
    assert judge(film).outcome in ("right", "refused", "choices")


@pytest.mark.slow
def test_a_hand_over_the_first_frame_is_not_learnt():
    """Twenty of ninety frames, at rest, have a hand over a quarter of the body, which is not in the learnt picture."""
    film = scene(
        6, frames=90, shape=(96, 320), look="textured", motion="slide", disc=False, disturbances=[], quality=None
    )
    stack, (x, y), (w, h) = film.frames.copy(), film.body.centre[0], film.body.half
    part = slice(int(y - h) - 4, int(y)), slice(int(x - w) - 4, int(x))
    stack[:20, *part] = 200
    rectangle = [int(x - w) + 3, int(y - h) + 3, int(2 * w) - 6, int(2 * h) - 6]
    clean, other = (track(DrawnFilm(one), rectangle) for one in (film.frames, stack))
    assert np.corrcoef(clean.picture.ravel(), other.picture.ravel())[0, 1] > 0.98


def test_a_second_body_at_the_edge_is_asked_for_where_the_first_is_there_too():
    """A bracket that passes at the upper edge was followed alone, since the body's shadow reaches the lower one."""
    assert judge(scene(1145)).outcome == "choices"
