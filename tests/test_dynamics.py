"""The integrator against closed forms, scipy's order-8 Runge-Kutta and finite differences of itself."""

from __future__ import annotations

import numpy as np
import pytest
from runs import BASE, FPS, HIDDEN, MASS, SHIFTS, Slider, force, integrate
from scipy.integrate import solve_ivp

from frictrack.base.errors import FrictrackError
from frictrack.effects import Path, direction_of_motion, models
from frictrack.effects.library.presliding import bending
from frictrack.simulate import Conditions, simulate
from frictrack.simulate.dynamics import EdgeResponse, LinearResponse, Panels, response_with_memory, solve_motion
from frictrack.simulate.trajectory import interleave

NM = 1e-9


def solved(law, edges, start):
    panels = Panels(np.asarray(edges))
    return solve_motion(law, panels, start, np.zeros(len(panels.t)))


def frames(duration=0.1, fps=FPS):
    return np.arange(round(duration * fps) + 1) / fps


def test_constant_deceleration_is_a_parabola():
    t = frames()
    motion, _ = solved(lambda x, v, t: np.full_like(x, -20.0), t, (0.3, 4.0))
    np.testing.assert_allclose(motion.x_edge, 0.3 + 4 * t - 10 * t**2, atol=1e-14)
    np.testing.assert_allclose(motion.v_edge, 4 - 20 * t, atol=1e-13)
    nodes = motion.panels.t
    np.testing.assert_allclose(motion.x, 0.3 + 4 * nodes - 10 * nodes**2, atol=1e-14)
    np.testing.assert_allclose(motion.v, 4 - 20 * nodes, atol=1e-13)


def test_viscous_decay_and_harmonic_spring_follow_their_closed_forms():
    t = frames(0.4)
    motion, _ = solved(lambda x, v, t: -12.0 * v, t, (0.0, 4.0))
    np.testing.assert_allclose(motion.x_edge, 4 / 12 * (1 - np.exp(-12 * t)), atol=1e-12)
    omega = 2 * np.pi * 30
    motion, _ = solved(lambda x, v, t: -(omega**2) * x, t, (0.01, 2.0))
    np.testing.assert_allclose(motion.x_edge, 0.01 * np.cos(omega * t) + 2 / omega * np.sin(omega * t), atol=1e-11)


def test_drag_follows_its_logarithm_over_uneven_panels():
    edges = np.cumsum(np.r_[0.0, np.random.default_rng(0).uniform(1e-4, 6e-4, 300)])
    motion, _ = solved(lambda x, v, t: -2.0 * v * np.abs(v), edges, (0.0, 5.0))
    np.testing.assert_allclose(motion.x_edge, np.log1p(2.0 * 5.0 * edges) / 2.0, atol=1e-11)


@pytest.mark.parametrize("s", [1.0, -1.0])
@pytest.mark.parametrize(
    "hidden",
    [(), ("drag", "vibration"), ("texture", "spring", "slope"), ("load_modulation", "patch", "asymmetry")],
    ids=lambda names: "+".join(names) or "tustin",
)
def test_sums_of_effects_agree_with_runge_kutta_to_below_a_nanometre(hidden, s):
    values = BASE | {name: HIDDEN[name] for name in hidden}
    t, start = frames(), (0.0 if s > 0 else 0.6, s * 4.0)
    motion, _ = solved(lambda x, v, t: -force(values, x, v, t, s) / MASS, t, start)
    assert np.max(np.abs(motion.x_edge - integrate(values, Slider(), t, start))) < 0.1 * NM
    assert not any(name in SHIFTS for name in hidden)


def test_edges_converge_with_order_six():
    def law(x, v, t):
        return -(60.0**2) * np.sin(x) - 0.01 * v**3 + 40 * np.cos(90 * t)

    exact = solved(law, np.linspace(0, 0.2, 4001), (0.3, 2.0))[0].x_edge[-1]
    errors = [abs(solved(law, np.linspace(0, 0.2, n + 1), (0.3, 2.0))[0].x_edge[-1] - exact) for n in (16, 32, 64)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 6) < 0.5), orders


def test_linear_response_is_the_derivative_of_the_motion():
    panels = Panels(frames(0.08))
    nodes = panels.t

    def law(c):
        def acceleration(x, v, t):
            return -25.0 - 3 * v - 0.2 * v**3 - 900.0 * np.sin(8 * x) + c * np.sin(300 * t) * v

        return acceleration

    motion, linear = solve_motion(law(0.2), panels, (0.1, 3.0), np.zeros(len(nodes)))
    g = (np.sin(300 * nodes) * motion.v)[:, None]
    nodes_by_c, by_c = linear.respond(g, np.zeros((2, 1)))
    _, by_start = linear.respond(np.zeros((len(nodes), 2)), np.eye(2))

    def difference(step, c=0.0, x=0.0, v=0.0):
        ends = [solve_motion(law(0.2 + k * c), panels, (0.1 + k * x, 3.0 + k * v), motion.a)[0] for k in (step, -step)]
        return [(getattr(ends[0], name) - getattr(ends[1], name)) / (2 * step) for name in ("x_edge", "v_edge", "a")]

    for column, truth in (
        (by_c[:, :, 0], difference(1e-4, c=1.0)),
        (by_start[:, :, 0], difference(1e-5, x=1.0)),
        (by_start[:, :, 1], difference(1e-5, v=1.0)),
    ):
        np.testing.assert_allclose(column[:, 0], truth[0], atol=1e-5 * np.max(np.abs(truth[0])))
        np.testing.assert_allclose(column[:, 1], truth[1], atol=1e-5 * np.max(np.abs(truth[1])))
    # The response of the acceleration at the nodes: what moves there less the input itself.
    truth = difference(2e-3, c=1.0)[2]
    np.testing.assert_allclose(nodes_by_c[:, 0], truth, atol=2e-4 * np.max(np.abs(truth)))


def test_linear_response_of_a_free_mass_is_exact():
    panels = Panels(np.array([0.0, 0.1, 0.25, 0.3]))
    free = LinearResponse(panels, np.zeros(9), np.zeros(9))
    _, edges = free.respond(np.column_stack([np.ones(9), panels.t]), np.zeros((2, 2)))
    np.testing.assert_allclose(edges[:, 0, 0], panels.edges**2 / 2, atol=1e-15)
    np.testing.assert_allclose(edges[:, 0, 1], panels.edges**3 / 6, atol=1e-15)
    np.testing.assert_allclose(edges[:, 1, 1], panels.edges**2 / 2, atol=1e-15)


def test_a_law_without_a_motion_is_an_error_not_a_number():
    with pytest.raises(FrictrackError, match="the motion under this law could not be integrated"):
        solved(lambda x, v, t: np.sign(x) * 1e9 * np.cos(1e9 * x), frames(0.02), (0.0, 1.0))


def test_a_law_that_runs_away_is_an_error_and_no_warning():
    with pytest.raises(FrictrackError, match="could not be integrated"):
        solved(lambda x, v, t: 1e7 * np.exp(x**2) * v**3, frames(0.02), (1.0, 5.0))


class Bristle:
    """A mass under a drive, held by a contact that bends (closed form between reversals), and pushed by `push(t)`."""

    tolerance = 2e-11

    def __init__(self, panels, length=1e-4, push=np.zeros_like):
        self.panels, self.length, self.push = panels, length, push

    def bending(self, t, x, v, starts=(0,), begin=None):
        s = direction_of_motion(v)
        s[0] = 0.0
        return bending(Path(t, x, v, s, starts=starts, begin=begin), self.length, 1.0)

    def acceleration(self, t, v, w):
        return (4.0 * np.sin(2 * np.pi * 20 * t) - 2.0 * w - v) / MASS + self.push(t)

    def accelerations(self, motion):
        x, v = np.append(motion.x_edge[0], motion.x), np.append(motion.v_edge[0], motion.v)
        t = np.append(self.panels.edges[0], self.panels.t)
        return self.acceleration(t, v, self.bending(t, x, v))[1:]

    def linearised(self, motion):
        return self.accelerations(motion), response_with_memory(self, motion)

    def states(self, motion):
        pairs = (self.panels.t, self.panels.edges), (motion.x, motion.x_edge), (motion.v, motion.v_edge)
        return self.bending(*(interleave(*pair) for pair in pairs))[None, :-1:4]

    def within(self, x, v, states, heading):
        edges, nodes = self.panels.edges, self.panels.t.reshape(-1, 3)
        t = np.column_stack([edges[:-1], nodes, edges[1:]]).ravel()
        w = self.bending(t, x.T.ravel(), v.T.ravel(), tuple(range(0, len(t), 5)), states.T)
        return self.acceleration(t, v.T.ravel(), w).reshape(-1, 5)[:, 1:4].T, w[None, 4::5]

    def first_states(self, x, v):
        return np.zeros((1, 1))


def bristle_motion(t, start, guess=0.0, **law):
    panels = Panels(t)
    return solve_motion(Bristle(panels, **law), panels, start, np.full(len(panels.t), guess))


def test_a_law_with_memory_is_followed_through_reversals():
    t = frames(0.15)
    motion, _ = bristle_motion(t, (0.0, 0.0))

    def rate(t, z):
        push = 4.0 * np.sin(2 * np.pi * 20 * t) - 2.0 * z[2] - z[1]
        return [z[1], push / MASS, z[1] / 1e-4 * (1 - z[2] * np.sign(z[1]))]

    truth = solve_ivp(
        rate, (0, t[-1]), [0.0, 0.0, 0.0], method="LSODA", rtol=1e-11, atol=1e-13, max_step=2e-4, t_eval=t
    )
    assert np.sum(np.diff(np.sign(motion.v)) != 0) >= 3
    assert np.max(np.abs(motion.x_edge - truth.y[0])) < 100 * NM  # reversals fall between the nodes


def test_the_response_with_memory_is_the_derivative_of_the_motion():
    t = frames(0.08)
    motion, response = bristle_motion(t, (1e-4, 0.01))
    g = np.cos(150 * motion.panels.t)[:, None]
    by_c = response.edge_states(g)
    by_start = response.edge_states(np.zeros((len(g), 2)), np.eye(2))

    def moved(c, x, v):
        ends = [
            bristle_motion(t, (1e-4 + k * x, 0.01 + k * v), push=lambda t, k=k: k * c * np.cos(150 * t))[0]
            for k in (1, -1)
        ]
        return (ends[0].x_edge - ends[1].x_edge) / (2 * max(c, x, v))

    for made, truth in (
        (by_c[:, 0, 0], moved(1e-4, 0.0, 0.0)),
        (by_start[:, 0, 0], moved(0.0, 1e-7, 0.0)),
        (by_start[:, 0, 1], moved(0.0, 0.0, 1e-6)),
    ):
        np.testing.assert_allclose(made, truth, atol=2e-4 * np.max(np.abs(truth)))


def test_a_stiff_contact_that_sticks_first_is_followed():
    motion, _ = bristle_motion(frames(0.1), (0.0, 0.0), guess=30.0, length=1e-5)
    stuck = motion.panels.edges < 3e-3  # until the drive overcomes friction the contact only bends
    assert np.max(np.abs(motion.x_edge[stuck])) < 2e-5
    assert np.ptp(motion.x_edge) > 5e-4


def test_a_state_that_is_forgotten_entirely_still_responds_to_forces():
    """Under a_v = -1e4/s the state of the first edge falls below the smallest number; x'' = a_v v + g, v -> g/|a_v|."""
    panels = Panels(np.linspace(0.0, 1.0, 2001))
    damping = 1e4
    linear = LinearResponse(panels, np.zeros(6000), np.full(6000, -damping))
    response = EdgeResponse(linear)
    assert response.stiff
    x = response(np.ones((1, 2001)))[0]
    t = panels.edges
    np.testing.assert_allclose(x[100:], (t[100:] - 1 / damping) / damping, rtol=1e-3)


def test_a_law_without_a_value_at_rest_is_refused_in_words():
    law, values = models.of(["coulomb", "viscous"]), {"coulomb": {"F_c": np.nan}, "viscous": {"F_v": 0.1}}
    conditions = Conditions(mass=1.0, drive=lambda t: 5.0 * t)
    with pytest.raises(FrictrackError, match="no finite value there"):
        simulate(law, values, conditions, np.arange(200) / 1000, (0.0, 0.0))
