"""The separable engine: along a measured motion coefficients are linear. Truth from closed forms and from scipy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from frictrack import effects
from frictrack.effects import Path, Span, models
from frictrack.fit import ParameterLayout, fit
from frictrack.fit.global_search import PopulationMisfit, ReducedPopulationMisfit
from frictrack.fit.linearised import linearise
from frictrack.fit.separable.common_amplitudes import variable_projection
from frictrack.fit.separable.model import DataBlock, SeparableModel, displacement_block, double_integral, tiled_path
from frictrack.fit.separable.projected import ProjectedProblem, bounded_coefficients
from frictrack.fit.separable.varpro import ScanTable, VariableProjection
from frictrack.simulate import Conditions, simulate
from tests.runs import BASE, MASS, Spec, measured, study

N, FPS = 652, 4000.0
T = np.arange(N) / FPS
V = 0.05 + 5.35 * (1 - T / T[-1]) ** 1.2
X = np.concatenate([[0.0], np.cumsum((V[1:] + V[:-1]) / 2 / FPS)])
PATH = Path(t=T, x=X, v=V, s=np.ones(N))
SPAN = Span(duration=T[-1], x_min=0.0, x_max=X[-1], v_min=0.05, v_max=5.4, fps=FPS)


def force_block(run, path, friction, sigma):
    """A measured friction series (n,) of known noise, N, as data; forces map to it directly."""
    weight = 1.0 / np.broadcast_to(sigma, friction.shape)
    return DataBlock(run, path, friction * weight, lambda rows: rows * weight, np.zeros_like, friction / path.load)


def tustin(fc, fs, fv, vs):
    return fc + (fs - fc) * np.exp(-V / vs) + fv * V


def line(amplitude, frequency, phase):
    return amplitude * np.sin(2 * np.pi * frequency * T + phase)


def layout(model, **bounds):
    law = models.parse(model) if isinstance(model, str) else model
    return ParameterLayout(law, ("run",), (SPAN,))


def along(model, data, sigma=1.0):
    return SeparableModel(layout(model), [force_block(0, PATH, data, sigma)])


def numbers(made, state):
    p = made.law(state.nonlinear_values, state.coefficients)
    return dict(zip(made.layout.names, p, strict=True))


def cut(path, n):
    """The first n samples of a path."""
    return replace(path, t=path.t[:n], x=path.x[:n], v=path.v[:n], s=path.s[:n])


def best(model, data, start):
    """Least squares of the plain formula from a good start: the reference."""
    found = least_squares(lambda p: data - model(p), start, x_scale="jac", xtol=1e-12, ftol=1e-12)
    return 2 * found.cost


class TestBlocks:
    def test_double_integral_of_a_cubic_is_exact_on_an_uneven_grid(self):
        t = np.sort(np.random.default_rng(0).uniform(0, 1, 60))
        x = double_integral(t)(2 + 3 * t + 4 * t**2)
        exact = t**2 + t**3 / 2 + t**4 / 3
        line = np.column_stack([np.ones_like(t), t])
        left = (x - exact) - line @ np.linalg.lstsq(line, x - exact, rcond=None)[0]
        assert np.abs(left).max() < 1e-12

    def test_population_rows_are_integrated_alike(self):
        rows = np.random.default_rng(1).normal(size=(3, 2, N))
        twice = double_integral(T)
        assert np.array_equal(twice(rows)[2, 1], twice(rows[2, 1]))

    def test_frames_a_force_falls_out_of_the_displacement_of_a_slide(self):
        from tests.test_force import one_slide  # noqa: PLC0415

        problem = fit("tustin", [one_slide()]).solution.problem
        block = displacement_block(problem.pieces[0])
        made = SeparableModel(problem.layout, [block])
        state = VariableProjection(made)()
        assert state.misfit < 1.2 * len(block.data)


class TestBounded:
    def test_agrees_with_brute_force_over_active_sets(self):
        rng = np.random.default_rng(2)
        for _ in range(20):
            a, y = rng.normal(size=(20, 4)), rng.normal(size=20)
            low, high = np.array([0.0, -np.inf, 0.0, -0.1]), np.array([np.inf, 0.1, np.inf, 0.1])
            c, moving = bounded_coefficients(a.T @ a, a.T @ y, low, high)
            exact = least_squares(lambda q, a=a, y=y: a @ q - y, np.full(4, 0.05), bounds=(low, high), xtol=1e-14).x
            assert c == pytest.approx(exact, abs=2e-4)
            assert np.all((c >= low) & (c <= high))
            assert np.array_equal(moving, (c > low) & (c < high))


class TestSearch:
    def test_finds_the_least_squares_optimum_with_lines_off_the_grid(self):
        rng = np.random.default_rng(3)
        data = tustin(8, 14, 1.2, 0.4) + line(2.0, 60.37, 0.3) + line(0.4, 66.9, -1.0) + rng.normal(0, 1, N)
        made = along("atm1:2", data)
        state = VariableProjection(made)()
        truth = [8, 14, 1.2, 0.4, 2.0, 60.37, 0.3, 0.4, 66.9, -1.0]
        least = best(lambda p: tustin(*p[:4]) + line(*p[4:7]) + line(*p[7:]), data, truth)
        assert state.misfit <= 1.0005 * least

    def test_two_lines_within_half_a_rayleigh_cell(self):
        for seed in range(6):
            rng = np.random.default_rng(seed)
            data = tustin(8, 14, 1.2, 0.4) + line(2.0, 60.0, 0.3) + line(1.5, 63.0, 1.0) + rng.normal(0, 1, N)
            state = VariableProjection(along("atm1:2", data))()
            truth = [8, 14, 1.2, 0.4, 2.0, 60.0, 0.3, 1.5, 63.0, 1.0]
            least = best(lambda p: tustin(*p[:4]) + line(*p[4:7]) + line(*p[7:]), data, truth)
            assert state.misfit <= 1.001 * least

    def test_the_order_of_effects_does_not_matter(self):
        rng = np.random.default_rng(4)
        blow = 0.02 / (np.sqrt(2 * np.pi) * 4e-4) * np.exp(-(((T - 0.06) / 4e-4) ** 2) / 2)
        data = tustin(8, 14, 1.2, 0.4) + line(1.5, 77.0, 0.3) + blow + rng.normal(0, 0.5, N)
        found = []
        for order in (["vibration", "collision"], ["collision", "vibration"]):
            made = along(models.of(["coulomb", "stribeck", "viscous", *order]), data, 0.5)
            found.append(numbers(made, VariableProjection(made)()))
        for law in found:
            assert law["vibration.frequency"] == pytest.approx(77.0, abs=0.5)
            assert law["collision.time[run]"] == pytest.approx(0.06, abs=2e-4)

    def test_coefficients_keep_their_bounds(self):
        data = tustin(8, 6, 1.2, 0.4) + np.random.default_rng(5).normal(0, 0.1, N)  # a hook the wrong way round
        made = along("tustin", data, 0.1)
        assert numbers(made, VariableProjection(made)())["stribeck.F_s"] == 0.0

    def test_fixed_values_and_ties_are_kept(self):
        rng = np.random.default_rng(6)
        data = tustin(8, 14, 1.2, 0.4) + line(2.0, 50.0, 0.3) + line(1.0, 100.0, 1.0) + rng.normal(0, 1, N)
        law = models.atm1(2)
        changes = {"viscous": {"F_v": {"fixed": 1.0}}, "vibration:2": {"frequency": {"tie": "2*vibration.frequency"}}}
        law = models.Model(tuple(e.adjusted(**changes.get(e.name, {})) for e in law.effects))
        made = along(law, data)
        state = VariableProjection(made)()
        p = made.law(state.nonlinear_values, state.coefficients)
        values, _ = made.layout.values(p, 0)
        assert values["viscous"]["F_v"] == 1.0
        assert values["vibration:2"]["frequency"] == pytest.approx(2 * values["vibration"]["frequency"])
        assert values["vibration"]["frequency"] == pytest.approx(50.0, abs=0.5)
        assert state.misfit == pytest.approx(np.sum((data - law.force(PATH, values)) ** 2), rel=1e-9)

    def test_tables_serve_other_data_along_the_same_motion(self):
        rng = np.random.default_rng(7)
        made = along("atm1:1", np.zeros(N))
        search = VariableProjection(made)
        for frequency in (31.7, 250.3):
            state = search(tustin(8, 14, 1.2, 0.4) + line(1.0, frequency, 0.5) + rng.normal(0, 1, N))
            assert numbers(made, state)["vibration.frequency"] == pytest.approx(frequency, abs=1.0)


def printed(p):
    """ATM2, Eq. 4 of the first paper, every sum read with t: f_c f_s f_v v_s, then frequency and phase of each sine."""
    sines = [line(1.0, *q) for q in np.reshape(p[4:], (-1, 2))]
    half, decay = len(sines) // 2, np.exp(-V / p[3])
    return sum(sines[:half]) * p[0] * (1 - decay) + p[1] * decay + sum(sines[half:]) * p[2] * V


def drawn(rng, order=2):
    """A truth at random: in either sum one sine of a period or so, and faster ones."""
    f_c = rng.uniform(3, 15)
    p = [f_c, f_c + rng.uniform(1, 12), rng.uniform(0.3, 3), rng.uniform(0.15, 1.2)]
    for _ in range(2):
        for low, high in [(1.5, 10), *[(15, 190)] * (order - 1)]:
            p += [rng.uniform(low, high), rng.uniform(-np.pi, np.pi)]
    return np.array(p)


class TestTied:
    @pytest.mark.slow
    def test_atm2_as_printed_comes_to_the_least_squares_optimum_from_nothing(self):
        rng = np.random.default_rng(11)
        made = along("atm2:2", np.zeros(N))
        search = variable_projection(made)
        for _ in range(10):
            truth = drawn(rng)
            data = printed(truth) + rng.normal(0, 1, N)
            state = search(data)
            assert state.misfit <= 1.001 * best(printed, data, truth)
            values, _ = made.layout.values(made.law(state.nonlinear_values, state.coefficients), 0)
            assert state.misfit == pytest.approx(np.sum((data - made.layout.model.force(PATH, values)) ** 2), rel=1e-6)

    @pytest.mark.few(1)
    @pytest.mark.parametrize(
        "truth",
        [
            [10.5, 21.4, 2.39, 0.386, 4.1, 2.35, 15.9, 2.02, 8.3, -0.2, 68.0, -1.39],  # a fast wave of 2.6 periods
            [5.6, 16.8, 1.49, 0.934, 4.0, -1.53, 168.0, 0.0, 9.4, 2.09, 168.5, -1.71],  # two fast waves, nearly one
            [
                14.7,
                21.3,
                1.27,
                0.755,
                6.6,
                -1.65,
                159.0,
                2.34,
                6.4,
                0.67,
                146.0,
                1.19,
            ],  # one fast wave hides a slow one
        ],
    )
    def test_waves_that_can_be_confused_are_found(self, truth):
        truth = np.array(truth)
        data = printed(truth) + np.random.default_rng(14).normal(0, 1, N)
        assert variable_projection(along("atm2:2", data))().misfit <= 1.001 * best(printed, data, truth)

    @pytest.mark.parametrize("order", [1, 3])
    def test_other_orders(self, order):
        rng = np.random.default_rng(12)
        truth = drawn(rng, order)
        data = printed(truth) + rng.normal(0, 1, N)
        assert variable_projection(along(f"atm2:{order}", data))().misfit <= 1.001 * best(printed, data, truth)

    def test_bounds_and_fixed_values_are_kept(self):
        rng = np.random.default_rng(13)
        truth = np.array([8, 14, 1.2, 0.4, 4.0, 0.5, 38.0, 1.0, 6.0, -1.0, 75.0, 2.0])
        data = printed(truth) + rng.normal(0, 1, N)
        changes = {"v_s": {"fixed": 0.5}, "viscous_frequency_2": {"bounds": (20.0, 60.0)}}
        law = models.Model((effects.atm2(2).adjusted(**changes),))
        made = along(law, data)
        state = variable_projection(made)()
        values = made.layout.values(made.law(state.nonlinear_values, state.coefficients), 0)[0]["atm2:2"]
        assert values["v_s"] == 0.5
        assert 20 <= values["viscous_frequency_2"] <= 60

    def test_runs_share_all_but_their_phases(self):
        shared = {"f_c": 8.0, "f_s": 13.0, "f_v": 1.3, "v_s": 0.5, "sliding_frequency_1": 4.0}
        shared |= {"sliding_frequency_2": 38.0, "viscous_frequency_1": 5.0, "viscous_frequency_2": 75.0}
        phases = [k.replace("frequency", "phase") for k in shared if "frequency" in k]
        runs = []
        for name, duration, speed, own in (("a", 0.2, 5.0, (0.6, 0.1, -0.4, 2.0)), ("b", 0.17, 4.0, (-1, 2, 1, 0))):
            t = np.arange(round(duration * 4000)) / 4000
            values = {"atm2:2": shared | dict(zip(phases, own, strict=True))}
            slide = simulate(models.atm2(2), values, Conditions(MASS), t, (0.0, speed))
            runs.append(measured(t, slide.x, sigma=1e-6, name=name))
        alone = fit("atm2:2", runs[:1])
        assert alone.reduced_chi2 == pytest.approx(1.0, abs=0.2)
        assert any("nearly unidentifiable from these runs" in r for r in alone.estimates.remarks)
        both = fit("atm2:2", runs)
        assert both.reduced_chi2 == pytest.approx(1.0, abs=0.2)
        for name in ("f_c", "f_v", "v_s"):
            assert both.parameters[f"atm2:2.{name}"].value == pytest.approx(shared[name], rel=0.02)


class TestPopulations:
    @pytest.mark.parametrize("model", ["tustin", "atm1:2", "atm2:2"])
    def test_full_and_reduced_misfits_are_those_of_single_laws(self, model):
        rng = np.random.default_rng(8)
        data = tustin(8, 14, 1.2, 0.4) + rng.normal(0, 1, N)
        made = layout(model)
        block = force_block(0, PATH, data, 1.0)
        full, reduced = PopulationMisfit(made, [block]), ReducedPopulationMisfit(made, [block])
        low, high = (np.where(np.isfinite(b), b, d) for b, d in zip(made.bounds, (-3.0, 15.0), strict=True))
        points = (low + (high - low) * rng.random((50, len(low))))[:, full.searched]
        assert full(points) == pytest.approx(_one_by_one(made, points, data), rel=1e-9)
        some = points[:, [full.searched.index(i) for i in reduced.searched]]
        laws = reduced.law(some)
        assert reduced(some) == pytest.approx(_one_by_one(made, laws, data), rel=1e-7)
        assert np.all(reduced(some) <= full(points) * (1 + 1e-9))

    def test_priors_count_in_both_misfits(self):
        priors = {"coulomb": {"F_c": {"prior": (5.0, 0.1)}}, "stribeck": {"v_s": {"prior": (0.5, 0.05)}}}
        made = layout(models.Model(tuple(e.adjusted(**priors.get(e.name, {})) for e in models.tustin().effects)))
        data = tustin(8, 14, 1.2, 0.4)
        reduced = ReducedPopulationMisfit(made, [force_block(0, PATH, data, 1.0)])
        points = np.array([[0.4], [0.6]])
        laws = reduced.law(points)
        f_c, v_s = (laws[:, made.names.index(name)] for name in ("coulomb.F_c", "stribeck.v_s"))
        expected = _one_by_one(made, laws, data) + ((f_c - 5.0) / 0.1) ** 2 + ((v_s - 0.5) / 0.05) ** 2
        assert reduced(points) == pytest.approx(expected, rel=1e-7)

    def test_runs_of_other_length_load_and_mass_are_evaluated_together(self):
        law = models.atm1(1) + "slope"
        ties = {"viscous": {"F_v": {"tie": "0.2*coulomb.F_c"}}}
        law = models.Model(tuple(e.adjusted(**ties.get(e.name, {})) for e in law.effects))
        heavy = replace(cut(PATH, 400), load=1.7, mass_ratio=2.0)
        paths = (PATH, heavy, cut(PATH, 500))
        made = ParameterLayout(law, ("a", "b", "c"), (SPAN,) * 3)
        rng = np.random.default_rng(3)
        data = [rng.normal(0, 5, len(path.t)) for path in paths]
        blocks = [force_block(run, path, y, 0.5) for run, (path, y) in enumerate(zip(paths, data, strict=True))]
        misfit = PopulationMisfit(made, blocks, tau=0.03)
        points = np.abs(rng.normal(1, 0.3, (6, len(misfit.searched))))
        found, levels = misfit.evaluate(points)
        p = misfit.full_vectors(points)
        p[:, made.levels] = levels
        for i in range(len(p)):
            values = [made.values(p[i], run) for run in range(3)]
            forces = [
                law.force(replace(path, load=path.load * level), own)
                for path, (own, level) in zip(paths, values, strict=True)
            ]
            expected = sum(np.sum(((y - f) / 0.5) ** 2) for y, f in zip(data, forces, strict=True))
            variance = expected / misfit.independent  # of these data, fifty times the noise that was said
            assert found[i] == pytest.approx(expected + variance * np.sum(((levels[i] - 1) / 0.03) ** 2), rel=1e-3)
        assert levels.mean(axis=1) == pytest.approx(1.0)
        assert np.ptp(levels) > 1e-3

    def test_phases_are_not_searched(self):
        made = ReducedPopulationMisfit(layout("atm1:2"), [force_block(0, PATH, np.zeros(N), 1.0)])
        assert [made.layout.names[i] for i in made.searched] == [
            "stribeck.v_s",
            "vibration.frequency",
            "vibration:2.frequency",
        ]

    def test_reduced_coefficients_keep_their_bounds(self):
        data = tustin(8, 6, 1.2, 0.4)
        made = ReducedPopulationMisfit(layout("tustin"), [force_block(0, PATH, data, 1.0)])
        c = made.coefficients(np.linspace(0.1, 2.0, 30)[:, None])
        assert np.all(c[:, :2] >= 0)


def _one_by_one(made, laws, data):
    return [np.sum((data - made.model.force(PATH, made.values(p, 0)[0])) ** 2) for p in laws]


class TestRefinement:
    def test_derivatives_are_those_of_the_projected_residual(self):
        rng = np.random.default_rng(9)
        data = tustin(8, 14, 1.2, 0.4) + line(2.0, 60.0, 0.3) + rng.normal(0, 1, N)
        made = along("atm1:1", data)
        problem = ProjectedProblem(made, made.data)
        p = np.ones(len(made.layout.slots))
        p[made.free] = 0.7, 60.5
        state = problem.at(p)
        gradient = problem.tangent(state, made.free).gradient
        for j, i in enumerate(made.free):
            step = np.zeros_like(p)
            step[i] = 1e-4 * p[i]
            slope = (problem.at(p + step).misfit - problem.at(p - step).misfit) / (2 * step[i])
            assert -2 * gradient[j] == pytest.approx(slope, rel=1e-3)

    def test_a_number_at_the_side_of_its_box_does_not_stop_the_others(self):
        made = along("atm1:1", tustin(8, 14, 1.2, 0.4))
        problem = ProjectedProblem(made, made.data)
        state = problem.at(np.where(np.isin(np.arange(len(made.layout.slots)), made.free), 50.0, 1.0))
        free = made.free[:2]
        low = problem.low[free]
        state.nonlinear_values[free] = low + np.array([0.1, 5.0])
        tangent = replace(problem.tangent(state, free), gradient=np.array([-1.0, 0.5]))
        step, promised = problem._step(state, tangent, np.array([[1.0, -0.99], [-0.99, 1.0]]), 0.0)
        assert step == pytest.approx([-0.1, 0.5 - 0.099])  # the first goes to its side, the second's best beside that
        assert promised > 0


def test_an_effect_of_single_runs_without_a_grid_is_removed_and_placed_again():
    made = along(models.of(["coulomb", "viscous", "clock_rate"]), tustin(8, 8, 1.2, 0.4))
    search = VariableProjection(made)
    assert [(i.effect.name, i.run, len(i.grid.values)) for i in search.items] == [("clock_rate", 0, 1)]
    problem = search.problem(made.data)
    state = search.restart_effect(problem, search(), "clock_rate")
    assert state.misfit < 1e-9 * np.sum(made.data**2)
    assert not state.excluded.any()


@pytest.mark.parametrize("size", [1.0, 1e40])
def test_products_of_a_table_with_rows_of_any_size_are_finite_and_right(size):
    rng = np.random.default_rng(1)
    columns, rows = rng.standard_normal((4, 2, 500)).astype(np.float32), size * rng.standard_normal((3, 500))
    table = ScanTable([columns], [np.full((4, 2), size)], [np.array([0, 1])], np.zeros((4, 2, 2)))
    exact = size * np.einsum("km,gcm->kgc", rows, columns.astype(float))
    assert table.products([slice(0, 500)], rows) == pytest.approx(exact, rel=1e-3, abs=1e-4 * size**2)


@pytest.fixture(scope="module")
def two_lines():
    """A search for two sinusoids, its problem and its solution."""
    rng = np.random.default_rng(15)
    made = along("atm1:2", tustin(8, 14, 1.2, 0.4) + line(2.0, 61.0, 0.3) + line(1.0, 130.0, 1.0) + rng.normal(0, 1, N))
    search = VariableProjection(made)
    return search, ProjectedProblem(made, made.data), search()


def test_moves_let_the_other_parameters_follow_to_first_order(two_lines):
    search, problem, state = two_lines
    made = search.separable
    for item in search.items:
        mine, found = item.coefficients, search.moved(problem, state, item)
        ((place,),) = item.slots
        for g in range(0, len(found.gains), 40):
            values = state.nonlinear_values.copy()
            values[place] = found.grid.values[g, 0]
            rows = problem.at(values, problem.without(state, mine), {item.g}, mine).rows
            slopes = [_slope(problem, state, i) for i in made.free if i != place]
            columns = np.stack([*rows, *slopes], axis=1)
            columns /= np.linalg.norm(columns, axis=0)
            left = made.data - columns @ np.linalg.lstsq(columns, made.data, rcond=None)[0]
            assert state.misfit - found.gains[g] == pytest.approx(left @ left, rel=1e-4)


def _slope(problem, state, i):
    """Change of the modelled data (M,) per unit of a parameter, by finite differences at constant coefficients."""
    step = np.zeros_like(state.nonlinear_values)
    step[i] = 1e-4
    two = [problem.at(state.nonlinear_values + d).rows for d in (step, -step)]
    return state.coefficients @ (two[0] - two[1]) / (2 * step[i])


@pytest.fixture(scope="module")
def linearised():
    law = {name: BASE[name] for name in ("coulomb", "stribeck", "viscous")}
    specs = Spec(3.0, 1, 0.06), Spec(5.0, 1, 0.08), Spec(4.0, 2, 0.06), Spec(-4.0, 1, 0.06)
    runs, _ = study(models.of(law), law, specs=specs, sigma=1e-5, scatter=0.02, rng=np.random.default_rng(2))
    return linearise(fit([*law], runs).solution)


@pytest.mark.parametrize("name", ["patch", "texture"])
def test_normal_equations_are_those_of_differences_of_the_residual(linearised, name):
    """The gradient of the reduced misfit is exact: half its slope, for several runs with levels away from one."""
    old = linearised.solution.problem.layout
    layout = replace(old, model=old.model + effects.get(name))
    low, high = (np.clip(b, -2.0, 2.0) for b in layout.bounds)
    p = low + (high - low) * np.random.default_rng(0).uniform(0.3, 0.7, len(low))
    known = dict(zip(old.names, linearised.solution.p, strict=True))
    p = np.array([known.get(n, v) for n, v in zip(layout.names, p, strict=True)])
    p[layout.levels] = 1 + 0.1 * np.arange(len(layout.levels))
    separable = SeparableModel(layout, linearised.blocks)
    problem = ProjectedProblem(separable, separable.data)
    free = [*separable.free, *problem.levels]
    gradient = problem.tangent(problem.at(p), separable.free).gradient
    for position, i in enumerate(free):
        h = 1e-5 * max(abs(p[i]), 1e-3)
        below, above = (problem.at(p + sign * h * np.eye(len(p))[i]).misfit for sign in (-1, 1))
        slope = -0.5 * (above - below) / (2 * h)
        assert gradient[position] == pytest.approx(slope, rel=1e-3, abs=1e-4 * np.abs(gradient).max())


def test_only_the_last_short_path_of_a_population_is_kept() -> None:
    t = np.linspace(0.0, 1.0, 1000)
    path = Path(t=t, x=t, v=1 - t / 2, s=np.ones(1000), mass=0.35, load=1.0)
    short = tiled_path(path, 3)
    np.testing.assert_array_equal(short.x, np.tile(t, 3))
    assert short.starts == (0, 1000, 2000)
    assert tiled_path(path, 3) is short
    tiled_path(path, 5)
    assert tiled_path(path, 3) is not short  # only the last one is kept
    assert tiled_path(path, 50) is not tiled_path(path, 50)  # a long one takes megabytes
