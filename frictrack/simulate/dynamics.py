"""The one integrator that the simulator and the fit share: m x'' = D(t) - F(x, v, t).

Gauss-Legendre collocation with three nodes per panel (order 6 at the panel edges; Hairer, Norsett & Wanner,
Solving Ordinary Differential Equations I, II.7). All panels are solved at once by Newton's method: linearised,
every panel is a 3 x 3 system and panels are chained by a triangular banded system. The same linear operator
returns sensitivities: how x responds to any small force along the solved motion.

A force with memory depends on the whole motion so far, which no slope at a node tells. Its response is found by a
Krylov method on directional differences of the law itself, the response without memory as preconditioner
(Newton-Krylov: Knoll & Keyes 2004, J. Comput. Phys. 193).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.panels import NODES, Linear, Motion6, Panels

__all__ = ["NODES", "Linear", "Motion6", "Panels", "Remembering", "Response", "settled", "slopes", "solve"]

MOST_STEPS = 30
RUNAWAY = 1e6  # m, beyond which there is no motion to speak of
SETTLING = 1e-6  # m, a Newton step below which the linear response is kept

STIR = 3e-9  # of the motion's own size: a change small enough for a difference of the law
KRYLOV = 80  # directions at most
ALIKE = 1e-12  # share of a direction that must be new
ACCURATE, ROUGH = 1e-7, 1e-4  # relative residual of a response with memory: of a sensitivity, of a Newton step
NEARLY = 1e-10  # m, to which a stretch is solved before the next one
STRETCH = 16  # panels solved at a time where all at once do not settle
SWEPT, NARROWEST = 64, 4  # panels that are first solved at a time under a law with memory, and fewest
MOST_TURNS = 25  # of an iteration that shall settle
SWEEP = 1e-12  # m, to which it shall
LEAST_MOVED = 2e-11  # m, relative beyond a metre: a law with memory has a kink at every reversal

Acceleration = Callable[[Array, Array, Array], Array]  # (x, v, t) -> x'', each (3 p,)


class Remembering:
    """The linear response of a motion under a law with memory, with the interface of `Linear`.

    `tangent(a, start)` (3 p,) is the change of the law's acceleration along a small change of the motion. What was
    learnt of it for one input is of use to the next.
    """

    def __init__(self, local: Linear, tangent: Callable[[Array, Array], Array]) -> None:
        self._local, self._tangent = local, tangent
        self._seen: list[tuple[Array, Array, Array]] = []  # orthonormal: input (3 p,), its accelerations, edge states

    def step(self, rest: Array) -> tuple[Array, Array]:
        """Node accelerations (3 p,) and edge positions (p + 1,) that make up for what is left of the equation."""
        a, edges = self.along(rest, np.zeros(2), ROUGH)
        return a, edges[:, 0]

    def respond(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Node accelerations (3 p, k) and edge states (p + 1, 2, k) for inputs g (3 p, k), start (2, k)."""
        pairs = [self.along(g[:, j], start[:, j]) for j in range(g.shape[1])]
        if not all(np.all(np.isfinite(edges)) for _, edges in pairs):
            raise FrictrackError("the motion could not be integrated: a small change of this law has no bounds")
        a = np.stack([p[0] for p in pairs], axis=1) if pairs else np.zeros_like(g)
        return a, np.stack([p[1] for p in pairs], axis=2) if pairs else self._local.respond(g, start)[1]

    def along(self, g: Array, start: Array, accuracy: float = ACCURATE) -> tuple[Array, Array]:
        """Node accelerations (3 p,) and edge states (p + 1, 2) for one input and start.

        Generalised conjugate residuals (Eisenstat, Elman & Schultz 1983, SIAM J. Numer. Anal. 20), preconditioned from
        the right; they begin with the directions of all inputs before. Not a number where the law runs off to infinity.
        """
        a, edges = (q[..., 0] for q in self._local.respond(np.zeros((len(g), 1)), start[:, None]))
        rest = g + self._tangent(a, start) - a if np.any(start) else g
        tolerance = accuracy * max(float(np.linalg.norm(g)), float(np.linalg.norm(a)))
        for seen in self._seen:
            a, edges, rest = _moved(a, edges, rest, seen)
        for _ in range(KRYLOV):
            size = float(np.linalg.norm(rest))
            if size <= tolerance:
                return a, edges
            found = self._learnt(rest / size)
            if found is None:
                break
            a, edges, rest = _moved(a, edges, rest, found)
        if not np.all(np.isfinite(rest)):
            return np.full_like(a, np.nan), np.full_like(edges, np.nan)
        return a, edges

    def _learnt(self, toward: Array) -> tuple[Array, Array, Array] | None:
        """The response in one direction more, orthogonal to all before; None where it holds nothing new."""
        a, edges = (q[..., 0] for q in self._local.respond(toward[:, None], np.zeros((2, 1))))
        w = a - self._tangent(a, np.zeros(2))
        whole = float(np.linalg.norm(w))
        for _ in range(2):  # twice is enough (Giraud & Langou 2003)
            for v, b, bent in self._seen:
                c = float(v @ w)
                w, a, edges = w - c * v, a - c * b, edges - c * bent
        size = float(np.linalg.norm(w))
        if not size > ALIKE * whole:
            return None
        self._seen.append((w / size, a / size, edges / size))
        return self._seen[-1]


def _moved(a: Array, edges: Array, rest: Array, seen: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """A response moved along a known direction as far as that explains what is left."""
    w, b, bent = seen
    c = float(w @ rest)
    return a + c * b, edges + c * bent, rest - c * w


Response = Linear | Remembering


@dataclass(frozen=True)
class _Law:
    """What is to be solved: the law, its panels and start; with memory the law is given the start before the nodes."""

    acceleration: Acceleration
    panels: Panels
    start: tuple[float, float]
    memory: bool

    def at(self, x: Array, v: Array, start: tuple[float, float] | None = None) -> Array:
        """Acceleration at the nodes, (3 p,)."""
        t = self.panels.t
        if not self.memory:
            return self.acceleration(x, v, t)
        x0, v0 = start or self.start
        whole = np.append(x0, x), np.append(v0, v), np.append(self.panels.edges[0], t)
        return self.acceleration(*whole)[1:]

    def local(self, x: Array, v: Array) -> tuple[Array, Linear]:
        """Acceleration at the nodes, and the response by its slopes in x and v there, by differences."""
        ex = 1e-7 * max(float(np.ptp(x)), 1e-3)
        ev = 1e-7 * max(float(np.max(np.abs(v))), 1e-3)
        f = self.at(x, v)
        # to and fro from panel to panel: where the way so far counts, a shift of the whole course would say nothing
        e = ex * (1 - 2 * (np.arange(len(x)) // 3 % 2)) if self.memory else ex
        return f, Linear(self.panels, (self.at(x + e, v) - f) / e, (self.at(x, v + ev) - f) / ev)

    def response(self, local: Linear, f: Array, x: Array, v: Array) -> Response:
        """The response about a motion x, v under which the law is f."""
        if not self.memory:
            return local
        size = np.array([max(float(np.ptp(x)), 1e-6), max(float(np.max(np.abs(v))), 1e-6)])

        def tangent(a: Array, start: Array) -> Array:
            dx, dv, _, _ = self.panels.integrate(a, float(start[0]), float(start[1]))
            largest = max(float(np.max(np.abs(dx))) / size[0], float(np.max(np.abs(dv))) / size[1])
            if not largest > 0:
                return np.zeros_like(f)
            e = STIR / largest
            begin = self.start[0] + e * float(start[0]), self.start[1] + e * float(start[1])
            return (self.at(x + e * dx, v + e * dv, begin) - f) / e

        return Remembering(local, tangent)


def solve(
    acceleration: Acceleration,
    panels: Panels,
    start: tuple[float, float],
    guess: Array,
    *,
    tolerance: float = 1e-13,
    memory: bool = False,
) -> tuple[Motion6, Response]:
    """Solve x'' = acceleration(x, v, t) from start = (x0, v0); guess is x'' at the nodes, shape (3 p,).

    A law with `memory` depends on the whole motion so far: it is given the start and the nodes, (1 + 3 p,), or as many
    of the first of them as are solved yet.
    Returns the motion and its linear response. Raises FrictrackError when Newton's method does not settle.
    """
    law = _Law(acceleration, panels, start, memory)
    guess = np.array(guess, dtype=float)
    with np.errstate(all="ignore"):  # a wild law runs off to infinity, which is answered below
        if memory:
            guess, tolerance = _swept(law, guess), max(tolerance, LEAST_MOVED)
        solved = _newton(law, guess, tolerance)
        if solved is None and memory:
            marched = _marched(law, guess)
            solved = None if marched is None else _newton(law, marched, tolerance)
    if solved is None:
        raise FrictrackError(
            "the motion under this law could not be integrated; check mass, drive and the sign of incline "
            "(positive where the course rises toward +x)"
        )
    return solved


def settled(
    law: Callable[[Array, Array], Array], panels: Panels, start: tuple[float, float], a: Array, within: float
) -> Motion6 | None:
    """The motion from a guess of its accelerations (3 p,) by the slopes of the moment; None where that does not settle.

    What a law remembers changes little within a few swings: its slopes at the nodes, taken anew once, are enough for
    an iteration that settles.
    """
    moved, linear = np.inf, None
    for k in range(MOST_TURNS):
        x, v, x_edge, v_edge = panels.integrate(a, *start)
        f = law(x, v)
        if linear is None or k == 1:
            ex, ev = 1e-7 * max(float(np.ptp(x)), 1e-3), 1e-7 * max(float(np.max(np.abs(v))), 1e-3)
            to_and_fro = ex * (1 - 2 * (np.arange(len(x)) // 3 % 2))
            linear = Linear(panels, (law(x + to_and_fro, v) - f) / to_and_fro, (law(x, v + ev) - f) / ev)
        step, edges = linear.step(f - a)
        last, moved = moved, float(np.max(np.abs(edges)))
        if not moved < min(2 * last, RUNAWAY):
            return None
        a = a + step
        if moved <= within:
            x, v, x_edge, v_edge = panels.integrate(a, *start)
            return Motion6(panels, x, v, a, x_edge, v_edge)
    return None


def slopes(
    acceleration: Acceleration,
    panels: Panels,
    motion: tuple[Array, Array],
    start: tuple[float, float] = (0.0, 0.0),
    *,
    memory: bool = False,
) -> tuple[Array, Linear]:
    """Acceleration (3 p,) along any motion (x, v) at the nodes, and the response by its slopes of the moment there."""
    return _Law(acceleration, panels, start, memory).local(*motion)


def _newton(law: _Law, a: Array, tolerance: float) -> tuple[Motion6, Response] | None:
    """Newton's iterations from node accelerations a (3 p,); None when they do not settle."""
    moved = np.inf
    for _ in range(MOST_STEPS):
        x, v, x_edge, v_edge = law.panels.integrate(a, *law.start)
        if moved > SETTLING or law.memory:  # near the solution the slopes no longer change
            f, local = law.local(x, v)
            response = law.response(local, f, x, v)
        else:
            f = law.at(x, v)
        step, edges = response.step(f - a)
        a = a + step
        moved = float(np.max(np.abs(edges)))
        if not max(moved, float(np.max(np.abs(x_edge)))) < RUNAWAY:
            return None
        if moved <= tolerance * max(1.0, float(np.max(np.abs(x_edge)))):
            x, v, x_edge, v_edge = law.panels.integrate(a, *law.start)
            return Motion6(law.panels, x, v, a, x_edge, v_edge), response
    return None


def _swept(law: _Law, a: Array) -> Array:
    """Better node accelerations (3 p,) under a law with memory, window after window as far as they settle."""
    a, done, window, total = a.copy(), 0, SWEPT, len(law.panels.h)
    x, v, start, edges = np.empty(0), np.empty(0), law.start, law.panels.edges
    while done < total:
        until = min(done + window, total)
        part, rows = replace(law, panels=Panels(edges[: until + 1])), slice(3 * done, 3 * until)

        def at(
            x_new: Array, v_new: Array, part: _Law = part, rows: slice = rows, way: tuple[Array, Array] = (x, v)
        ) -> Array:
            return part.at(np.append(way[0], x_new), np.append(way[1], v_new))[rows]

        motion = settled(at, Panels(edges[done : until + 1]), start, a[rows], SWEEP)
        if motion is None:
            window //= 2
            if window < NARROWEST:
                break
            continue
        a[rows], start = motion.a, (float(motion.x_edge[-1]), float(motion.v_edge[-1]))
        x, v, done = np.append(x, motion.x), np.append(v, motion.v), until
    return a


def _marched(law: _Law, a: Array) -> Array | None:
    """Node accelerations (3 p,) solved stretch after stretch: what comes later does not touch what came before."""
    done, stretch, total = 0, STRETCH, len(law.panels.h)
    a = a.copy()
    while done < total:
        until = min(done + stretch, total)
        part = replace(law, panels=Panels(law.panels.edges[: until + 1]))
        if done:
            a[3 * done : 3 * until] = a[3 * done - 1]
        found = _newton(part, a[: 3 * until], NEARLY)
        if found is None and stretch == 1:
            return None
        if found is None:
            stretch //= 2
            continue
        a[: 3 * until] = found[0].a
        done, stretch = until, min(2 * stretch, STRETCH)
    return a
