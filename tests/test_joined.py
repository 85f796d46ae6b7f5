"""Motions that are solved together are those of every run by itself, and effects vary with what they declare."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runs import BASE, EARLIER, HIDDEN, Spec, study
from test_reality import swinging

from frictrack import effects
from frictrack.effects import LIBRARY, Path, models
from frictrack.fit import fit
from frictrack.fit.pieces import JoinedPieces
from frictrack.simulate.dynamics import LinearResponse, Panels, solve_motion

LAW = ["coulomb", "stribeck", "viscous"]
SPECS = (Spec(3.0, 1, 0.06), Spec(5.0, 1, 0.08), Spec(4.0, 2, 0.06), Spec(-4.0, 1, 0.06))
POINTWISE = sorted(n for n, e in LIBRARY.items() if e.acts_on == "force" and e.varies_with is not None)


def path_of(n: int = 40) -> Path:
    t = np.linspace(0.01, 0.2, n)
    known = {"lift": np.sin(90 * t), "travelled": 0.02, "begins": 0.1, "earlier": (EARLIER,)}
    return Path(t=t, x=0.1 + 3 * t - t**2, v=3 - 2 * t, s=np.ones(n), **known)


def columns_of(effect, path):
    """Columns of an effect; a modifier changes columns of ones."""
    values = {p.name: HIDDEN.get(effect.name, {}).get(p.name, 0.5) for p in effect.nonlinear}
    inner = [np.ones((len(path.t), 2))] if effect.modifies else []
    return effect.columns(path, values, *inner)


@pytest.mark.few(8)
@pytest.mark.parametrize("name", POINTWISE)
def test_an_effect_varies_with_the_quantities_that_it_declares_at_each_sample_alone(name):
    effect, path = effects.get(name), path_of()
    columns = columns_of(effect, path)
    for quantity in "xv":
        moved = replace(path, **{quantity: getattr(path, quantity) * 1.01})
        changes = not np.array_equal(columns_of(effect, moved), columns)
        assert changes == (quantity in effect.varies_with)
    half = replace(path, **{q: getattr(path, q)[20:] for q in ("t", "x", "v", "s", "lift")})
    np.testing.assert_allclose(columns_of(effect, half), columns[20:], rtol=1e-13)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "added", [(), ("texture", "vibration"), ("load_modulation", "slope"), ("beam_vibration",), ("heating",)]
)
def test_runs_that_are_simulated_together_respond_as_each_of_them_alone(added):
    law = {name: BASE[name] for name in LAW}
    runs, _ = study(models.of(LAW), law, specs=SPECS, sigma=1e-5, scatter=0.02, rng=np.random.default_rng(2))
    runs = [replace(run, clamp_x=0.0, earlier=EARLIER[: i % 3]) for i, run in enumerate(runs)]
    found = fit(LAW, runs).solution
    model = found.problem.model
    for name in added:
        model = model + name
    layout = replace(found.problem.layout, model=model)
    known = dict(zip(found.problem.layout.names, found.p, strict=True))
    p = np.array([known.get(n, 0.1 * s.linear or 0.03) for n, s in zip(layout.names, layout.slots, strict=True)])
    problem = found.problem.rebuild(layout, found.problem.pieces)
    together, starts = problem.evaluate(p, found.starts), found.starts
    alone = [
        problem.rebuild(layout, [piece]).evaluate(p, [s])[0] for piece, s in zip(problem.pieces, starts, strict=True)
    ]
    assert len({piece.mass for piece in problem.pieces}) > 1
    for one, other in zip(together, alone, strict=True):
        assert one.active == other.active
        np.testing.assert_allclose(one.motion.x_edge, other.motion.x_edge, atol=2e-13)
        np.testing.assert_allclose(one.r_full, other.r_full, atol=1e-6)
        np.testing.assert_allclose(one.jac, other.jac, atol=1e-6 * np.abs(other.jac).max(axis=0).max())
        states = one.linear.edge_states(np.ones((len(one.motion.a), 1)))
        np.testing.assert_allclose(states, other.linear.edge_states(np.ones((len(one.motion.a), 1))), rtol=1e-6)


def test_two_motions_end_to_end_follow_their_closed_forms():
    t = np.linspace(0.0, 0.1, 101)
    panels = Panels.joined([Panels(t), Panels(0.5 * t)])
    starts = np.array([0.3, -0.2]), np.array([4.0, -2.0])
    motion, response = solve_motion(lambda x, v, t: -12.0 * v, panels, starts, np.zeros(len(panels.t)))
    for rows, time, x0, v0 in ((slice(0, 101), t, 0.3, 4.0), (slice(101, 202), 0.5 * t, -0.2, -2.0)):
        np.testing.assert_allclose(motion.x_edge[rows], x0 + v0 / 12 * (1 - np.exp(-12 * time)), atol=1e-13)
    assert isinstance(response, LinearResponse)
    moved = response.edge_states(np.zeros((len(panels.t), 1)), np.array([[0.0], [1.0]]))[:, 0, 0]
    np.testing.assert_allclose(moved[101:], (1 - np.exp(-6 * t)) / 12, atol=1e-13)


@pytest.mark.few(1)
@pytest.mark.parametrize("law", ["bouc_wen", "presliding", "friction_lag", "lugre", "rate_state_slip"])
def test_a_law_with_memory_that_is_continued_is_the_same_as_along_the_whole_motion(law):
    run = swinging(0, (-1.2, 0.0), seconds=0.6)
    start = fit(["viscous"] if law in {"lugre", "rate_state_slip"} else LAW, [run]).solution
    layout = replace(start.problem.layout, model=start.problem.model + law)
    known = dict(zip(start.problem.layout.names, start.p, strict=True))
    p = np.array([known.get(n, 1.5 if s.linear else 0.2) for n, s in zip(layout.names, layout.slots, strict=True)])
    problem = start.problem.rebuild(layout, start.problem.pieces)
    piece = problem.pieces[0]
    x, v, t = piece.x_hat, piece.v_hat, piece.panels.t
    begin = x[0] - v[0] * t[0], v[0], piece.panels.edges[0]
    x, v, t = (np.append(first, rest) for first, rest in zip(begin, (x, v, t), strict=True))
    whole = problem._law(JoinedPieces((piece,)), p)
    expected = whole.acceleration(x, v, t)
    assert np.ptp(expected - problem._law(JoinedPieces((piece,)), 0.7 * p).acceleration(x, v, t)) > 0.01
    continued = whole
    for first, last in ((0, 300), (300, 900), (900, len(t) - 1)):
        part = slice(first, last + 1)
        part = (x[part], v[part], t[part])
        # derivatives of the target at the joint know one sample less
        np.testing.assert_allclose(
            continued.acceleration(*part)[1:-2], expected[first + 1 : last - 1], atol=1e-3 * np.ptp(expected)
        )
        continued = continued.after(*part)
