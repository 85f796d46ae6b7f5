"""The papers' domain: accelerations after low-pass and double difference, the model through the same chain.

For a fixed cut-off the chain is a linear map K from the frames of a piece to accelerations. Measured minus modelled
acceleration is then K (y - y_model) and its sensitivities are K J: the displacement's problem, seen through K. The
residuals count alike, as in the papers; their noise does not (it grows with the square of the frequency), so the
deviations come from the sandwich H^-1 J' V J H^-1 with V = K diag(sigma^2) K' (White 1982, Econometrica 50).
Start position and speed are those that suit the displacement best: the chain hardly sees them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.stats import t as student

from frictrack.fit.simulated.pieces import MIN_FRAMES, Piece
from frictrack.fit.simulated.problem import Problem, Response
from frictrack.fit.simulated.solve import Solution, refine, settle_scatter
from frictrack.fit.sure.covariance import inverse
from frictrack.fit.sure.estimate import Estimates, estimates, told
from frictrack.fit.sure.quoted import quoted_values, shown
from frictrack.fit.unknowns.scatter import MIN_RUNS, restraint_rows
from frictrack.motion.filter import weights
from frictrack.motion.grid import frame_grid
from frictrack.motion.stencil import NODES, stencils
from frictrack.motion.structure import Structure
from frictrack.motion.system import Data, Factor
from frictrack.records import Array, Mask, Run

CERTAIN = 1.96  # standard deviations by which F_s - F_c, and twice by which v_s, must differ from zero


@dataclass(frozen=True)
class Chain:
    """Low-pass and double difference of one piece: a linear map from its n frames to m accelerations, m/s^2.

    The frames within the run's guard of either end are smoothed but not compared.
    """

    rows: NDArray[np.int64]  # place of every frame on the regular grid of N frames
    weight: Array  # of the smoother, (N,), 0 where a frame is missing
    factor: Factor  # the smoother
    second: csr_array  # second derivative at the compared frames, (m, N)
    sigma_a: Array  # noise of the accelerations, (m,)
    kept: NDArray[np.int64]  # the compared frames of the piece, (m,)
    cutoff: float  # Hz

    def apply(self, columns: Array) -> Array:
        """Accelerations (m, k) of displacements (n, k)."""
        full = np.zeros((len(self.weight), columns.shape[1]))
        full[self.rows] = columns
        out: Array = self.second @ self.factor.smooth(full)
        return out

    def transposed(self, columns: Array) -> Array:
        """K' times columns (m, k), shape (n, k)."""
        out: Array = (self.weight[:, None] * self.factor.answer(self.second.T @ columns))[self.rows]
        return out

    def only(self, rows: Mask) -> Chain:
        """The same chain, compared only at the marked frames (n,) of the piece."""
        use = rows[self.kept]
        return replace(self, second=self.second[use], sigma_a=self.sigma_a[use], kept=self.kept[use])


def chain_of(run: Run, piece: Piece) -> Chain:
    """The chain of one piece at the cut-off of its run."""
    grid = frame_grid(piece.t)
    n, m = len(piece.t), run.motion.guard
    guard = min(m, n // 8, max((n - MIN_FRAMES) // 2, 0))
    inside = np.arange(guard, n - guard)
    kept = grid.frames[inside]
    weight = grid.spread(weights(piece.sigma, np.ones(n, dtype=bool)))
    smoother = Structure.low_pass(run.motion.cutoff, grid.interval).factored(Data(np.zeros(grid.n), weight))
    start, table = stencils(grid.n, grid.interval)
    noise = float(np.mean(piece.sigma**-2.0) ** -0.5)
    spread = noise * np.sqrt(smoother.passed(start, table[2:]))[0]
    columns = (start[kept, None] + np.arange(NODES)).ravel()
    second = csr_array(
        (table[2, kept].ravel(), (np.repeat(np.arange(len(kept)), NODES), columns)), shape=(len(kept), grid.n)
    )
    return Chain(grid.frames, weight, smoother, second, spread[kept], inside, run.motion.cutoff)


@dataclass(frozen=True)
class ForceResponse(Response):
    """A response seen through the chain; `plain` is the displacement's own."""

    plain: Response

    def start_step(self, step: Array) -> Array:
        """Change of (x0, v0) that the displacement asks for."""
        return self.plain.start_step(step)


class ForceProblem(Problem):
    """The problem of the displacement seen through the chains, one per piece, in units of one noise for all."""

    def __init__(self, problem: Problem, chains: Sequence[Chain]) -> None:
        super().__init__(problem.model, problem.layout, problem.pieces)
        self.chains = list(chains)
        self.noise = noise_of(chains)

    def _respond(self, i: int, p: Array, start: Array) -> Response:
        plain = super()._respond(i, p, start)
        both = plain.piece.coloured(np.column_stack([plain.jac, plain.r]))
        seen = self.chains[i].apply(both) / self.noise
        known = {name: getattr(plain, name) for name in Response.__dataclass_fields__}
        return ForceResponse(**known | {"jac": seen[:, :-1], "r": seen[:, -1], "r_full": seen[:, -1]}, plain=plain)

    def noise_in(self, responses: Sequence[Response], columns: Array) -> Array:
        """Noise of the displacement, frame by frame in units of sigma, that enters products with columns (M, k).

        The result Z (N, k) has Z'Z = columns' V columns.
        """
        out, at = [], 0
        for chain, response in zip(self.chains, responses, strict=True):
            mine = columns[at : at + len(response.r)]
            at += len(response.r)
            back = response.piece.coloured_transposed(chain.transposed(mine)) / self.noise
            out.append(back - response.q @ (response.q.T @ back))
        return np.concatenate(out)


def noise_of(chains: Sequence[Chain]) -> float:
    """Root mean square noise of all compared accelerations, m/s^2."""
    return float(np.sqrt(np.mean(np.concatenate([c.sigma_a for c in chains]) ** 2)))


def chains_of(runs: Sequence[Run], pieces: Sequence[Piece]) -> list[Chain]:
    """The chains of all pieces."""
    return [chain_of(runs[piece.run], piece) for piece in pieces]


def seen(solution: Solution, runs: Sequence[Run]) -> Solution:
    """The same law, linearised in the force domain."""
    problem = ForceProblem(solution.problem, chains_of(runs, solution.problem.pieces))
    held = np.zeros(len(solution.p), dtype=bool)
    return refine(problem, solution.p, solution.starts, tau=solution.tau, free=held, max_steps=0)


def solve_force(solution: Solution, runs: Sequence[Run]) -> Solution:
    """The law that minimises the squared acceleration residuals, from the best one of the displacement."""
    problem = ForceProblem(solution.problem, chains_of(runs, solution.problem.pieces))
    return settle_scatter(problem, solution.p, solution.starts, solution.tau or 0.03)


def at_rest(problem: Problem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
    """A given law in the displacement's domain: only the starts are fitted."""
    return refine(problem, p, starts, tau=tau, free=np.zeros(len(p), dtype=bool))


def reduced_chi2(solution: Solution) -> float:
    """Chi-squared over what the coloured noise leaves beside the fitted unknowns on average."""
    problem = solution.problem
    assert isinstance(problem, ForceProblem)
    z = problem.noise_in(solution.responses, solution.basis.u)
    return solution.chi2 / (len(solution.residual) - float(np.sum(z**2)))


def sandwich(solution: Solution) -> Array:
    """Covariance of the unknowns (P, P); the share of scattering levels is widened to Student's t as elsewhere."""
    problem = solution.problem
    assert isinstance(problem, ForceProblem)
    layout = problem.layout
    jac = solution.jac
    z = problem.noise_in(solution.responses, jac)
    rows = restraint_rows(layout, solution.tau or 0.03)
    bread, _ = inverse(np.vstack([jac, rows]))
    if len(layout.levels) < MIN_RUNS:
        return bread @ (z.T @ z) @ bread
    full = bread @ (z.T @ z + rows.T @ rows) @ bread
    held, _ = inverse(np.vstack([jac, rows * solution.tau / 1e-6]))
    fixed = held @ (z.T @ z) @ held
    widen = float(student.ppf(0.975, len(layout.levels) - 1) / 1.96) ** 2
    return fixed + widen * (full - fixed)


def linear_estimates(solution: Solution, covariance: Array | None = None) -> Estimates:
    """Parameters with deviations from the law linearised where it stands, best or not, in either domain.

    `covariance` (P, P) replaces the one that goes with the domain.
    """
    plain = estimates(solution, profile=False)
    if covariance is None:
        covariance = sandwich(solution) if isinstance(solution.problem, ForceProblem) else plain.covariance
    absent = {name: e.reason for name, e in plain.parameters.items() if e.value is None and e.reason}
    return told(solution, covariance, absent | _unsettled(solution, covariance))


def _unsettled(solution: Solution, covariance: Array) -> dict[str, str]:
    """Stribeck parameters that the linearised law does not settle, with the reason."""
    layout = solution.problem.layout
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    out: dict[str, str] = {}
    for effect in (e for e in layout.model.effects if e.kind == "stribeck" and layout.seeks(e.name, "F_s", "v_s")):
        rise, speed = layout.index(effect.name, "F_s"), layout.index(effect.name, "v_s")
        why = None
        if solution.p[rise] < CERTAIN * std[rise]:
            why = "F_s - F_c is not distinguishable from zero"
        elif solution.p[speed] < CERTAIN * std[speed]:
            why = "v_s is not bounded on both sides"
        if why:
            text = f"{why}; the slowest speed seen is {layout.span.v_min:.2g} m/s: film a run that slows to a stop"
            out |= {f"{effect.name}.{p.name}": text for p in effect.parameters if p.free}
    return out


def quoted(solution: Solution, p: Array) -> dict[str, float]:
    """Unknowns p (P,) of a law as they are quoted, by address; friction levels left out."""
    values = quoted_values(solution.problem, p)
    names = [solution.problem.layout.names[i] for i in shown(solution.problem.layout)]
    return dict(zip(names, map(float, values), strict=True))
