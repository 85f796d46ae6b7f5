"""The searches against truths they did not make: closed forms, known optima, printed tables."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from frictrack.base.errors import FrictrackError
from frictrack.search import (
    DE,
    GA,
    METHODS,
    MGA,
    SGA,
    SearchResult,
    code_length,
    code_length_as_printed,
    minimise,
    search_method,
)
from frictrack.search.genetic import (
    crossover_probability,
    decode,
    encode,
    flip_bits,
    geometric_cooling,
    metropolis,
    mutation_as_printed,
    mutation_probability,
    one_point_crossover,
    random_genes,
    rank_fitness,
    roulette,
    tournament,
    universal_sampling,
)
from frictrack.search.method import distinct_optima

Array = np.ndarray


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def eq8(x: Array) -> Array:
    """Eq. 8 of the beam paper, to be maximised, with its sign turned."""
    return -(x[:, 0] * np.sin(10 * np.pi * x[:, 0]) + 2)


def sphere(x: Array) -> Array:
    return np.sum((x - 0.3) ** 2, axis=1)


def rastrigin(x: Array) -> Array:
    return 10 * x.shape[1] + np.sum(x**2 - 10 * np.cos(2 * np.pi * x), axis=1)


def himmelblau(x: Array) -> Array:
    """Himmelblau's function plus 1: four equal minima of 1."""
    a, b = x[:, 0], x[:, 1]
    return 1 + (a**2 + b - 11) ** 2 + (a + b**2 - 7) ** 2


HIMMELBLAU = np.array([[3.0, 2.0], [-2.805118, 3.131312], [-3.779310, -3.283186], [3.584428, -1.848126]])
EQ8_BOX = [[-1.0, 2.0]]


def eq8_truth() -> tuple[float, float]:
    """Where the derivative of Eq. 8 vanishes on its highest hump, and its value there."""
    w = 10 * np.pi
    x = brentq(lambda x: np.sin(w * x) + w * x * np.cos(w * x), 1.84, 1.86, xtol=1e-14)
    return x, x * np.sin(w * x) + 2


@pytest.fixture(params=sorted(METHODS))
def method(request: pytest.FixtureRequest) -> str:
    if request.param == "cmaes":
        pytest.importorskip("cma")
    return request.param


# ---- code


def test_three_bit_gray_code_is_the_textbook_one() -> None:
    genes = encode(np.arange(8)[:, None] / 7, 3)
    words = ["".join(map(str, row)) for row in genes]
    assert words == ["000", "001", "011", "010", "110", "111", "101", "100"]


@pytest.mark.parametrize("bits", [1, 7, 20, 52, 60])
def test_code_round_trip(bits: int) -> None:
    unit = np.vstack([rng().random((50, 3)), np.zeros((1, 3)), np.ones((1, 3))])
    back = decode(encode(unit, bits), bits)
    assert np.abs(back - unit).max() <= 0.5 / (2.0**bits - 1) + 1e-15
    assert np.all(back[-2] == 0)
    assert np.all(back[-1] == 1)


def test_chromosomes_survive_decoding() -> None:
    genes = random_genes(30, 4 * 20, rng())
    np.testing.assert_array_equal(encode(decode(genes, 20), 20), genes)


# ---- selection


def test_rank_fitness_is_linear_with_pressure_two() -> None:
    np.testing.assert_allclose(rank_fitness(np.array([5.0, 1.0, 9.0, 2.0, 7.0])), [1.0, 2.0, 0.0, 1.5, 0.5])


def test_equal_costs_share_their_rank_and_the_mean_stays_one() -> None:
    np.testing.assert_allclose(rank_fitness(np.array([3.0, 1.0, 3.0, np.inf])), [1.0, 2.0, 1.0, 0.0])
    np.testing.assert_allclose(rank_fitness(np.full(6, 4.0)), 1.0)


def test_universal_sampling_draws_the_expected_counts() -> None:
    """Baker 1987: every count is n f/sum(f) rounded down or up, and its mean is exactly that."""
    fitness = rank_fitness(rng(1).random(40))
    expected = 36 * fitness / fitness.sum()
    generator = rng(2)
    counts = np.array([np.bincount(universal_sampling(fitness, 36, generator), minlength=40) for _ in range(4000)])
    assert np.all(counts.sum(axis=1) == 36)
    assert np.all(counts >= np.floor(expected))
    assert np.all(counts <= np.ceil(expected))
    fraction = expected % 1
    np.testing.assert_allclose(
        counts.mean(axis=0), expected, atol=5 * np.sqrt((fraction * (1 - fraction)).max() / 4000)
    )


def test_the_worst_is_never_drawn() -> None:
    generator = rng()
    drawn = {i for _ in range(500) for i in universal_sampling(np.array([0.0, 1.0, 2.0, 0.0]), 3, generator)}
    assert drawn == {1, 2}


# ---- variation


def test_crossover_swaps_tails_behind_one_cut() -> None:
    parents = np.array([[0] * 12, [1] * 12] * 200, dtype=np.uint8)
    children = one_point_crossover(parents, 1.0, rng())
    first, second = children[::2].astype(int), children[1::2].astype(int)
    np.testing.assert_array_equal(first + second, 1)  # nothing lost
    assert np.all(np.count_nonzero(np.diff(first, axis=1), axis=1) == 1)  # one cut each
    assert np.all(first[:, 0] == 0)
    assert set(first.sum(axis=1)) == set(range(1, 12))  # every place is cut
    np.testing.assert_array_equal(parents[0], 0)  # parents untouched


def test_crossover_happens_with_its_probability() -> None:
    parents = np.array([[0] * 12, [1] * 12] * 4000, dtype=np.uint8)
    crossed = one_point_crossover(parents, 0.7, rng())[::2].any(axis=1).mean()
    assert crossed == pytest.approx(0.7, abs=5 * np.sqrt(0.21 / 4000))
    np.testing.assert_array_equal(one_point_crossover(parents[:5], 0.0, rng()), parents[:5])


def test_bits_flip_with_the_probability_of_their_row() -> None:
    rates = np.array([0.0, 0.035, 0.5, 1.0])
    flipped = flip_bits(np.zeros((4, 100_000), dtype=np.uint8), rates, rng()).mean(axis=1)
    np.testing.assert_allclose(flipped, rates, atol=5 * 0.5 / np.sqrt(100_000))
    assert flipped[0] == 0
    assert flipped[3] == 1


def test_metropolis_accepts_a_rise_with_its_boltzmann_factor() -> None:
    for rise, T in ((0.0, 1.0), (-5.0, 1.0), (1.0, 1.0), (1.0, 0.5), (3.0, 1.0)):
        share = metropolis(np.full(20_000, 10.0 + rise), np.full(20_000, 10.0), T, rng()).mean()
        assert share == pytest.approx(min(1.0, np.exp(-rise / T)), abs=0.02)
    bad = np.array([np.inf])
    assert not metropolis(bad, np.zeros(1), 1.0, rng())
    assert metropolis(np.zeros(1), bad, 1.0, rng())
    assert metropolis(bad, bad, 1.0, rng())
    assert metropolis(np.zeros(1), np.zeros(1), 0.0, rng())


def test_cooling_is_geometric() -> None:
    assert [geometric_cooling(g, 100, 2.0, 1e-4) for g in (0, 50, 100)] == pytest.approx([2.0, 0.02, 2e-4])


# ---- Eqs. 5-7, by hand


def test_eq5_crossover_probability() -> None:
    assert crossover_probability(0, 0.05, 0.4) == pytest.approx(0.9)
    assert crossover_probability(20, 0.05, 0.4) == pytest.approx(1 / (1 + np.e) + 0.4)
    assert crossover_probability(10**6, 0.05, 0.4) == pytest.approx(0.4)
    assert crossover_probability(0, 0.05, 0.7) == 1.0


def test_eq6_mutation_probability() -> None:
    """tanh(0.1 * 20 / 2) = (e^2 - 1)/(e^2 + 1) = 0.761594; f_max = 2, f_avg = 1."""
    fitness = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    expected = [0.2, 0.2, 0.2, 0.2 * 0.761594 * 0.5, 0.0]
    np.testing.assert_allclose(mutation_probability(20, fitness, 0.1, 0.2), expected, rtol=1e-6)


def test_eq6_as_printed() -> None:
    """Targets 0, 2, 4, 10: f_avg = 4, f_max = 10; f = f_avg belongs to the constant; a lone 6 shows the bracket."""
    target = np.array([0.0, 2.0, 4.0, 10.0])
    np.testing.assert_allclose(mutation_as_printed(20, target, 0.1, 0.05), [0.05, 0.05, 0.05, 0.0])
    target = np.array([0.0, 0.0, 6.0, 10.0])
    np.testing.assert_allclose(mutation_as_printed(20, target, 0.1, 0.05), [0.05, 0.05, 0.761594 * 2 / 3, 0.0], 1e-6)
    np.testing.assert_allclose(mutation_as_printed(20, np.full(3, -np.inf), 0.1, 0.05), 0.05)


def test_eq7_code_length() -> None:
    """L_const = 10, d = 0.2, s = 50, G_max = 200: the paper's setting for Table 6."""
    at = [0, 24, 25, 75, 125, 159, 160, 200]
    assert [code_length(g, 200, 10, 0.2, 50) for g in at] == [10, 10, 11, 12, 13, 13, 20, 20]
    assert [code_length_as_printed(g, 200, 10, 0.2, 50) for g in at] == [55, 55, 30, 22, 18, 18, 20, 20]
    assert np.mean([code_length(g, 200, 10, 0.2, 50) for g in range(200)]) == pytest.approx(13.3, abs=0.05)
    assert np.mean([code_length_as_printed(g, 200, 10, 0.2, 50) for g in range(200)]) == pytest.approx(27.2, abs=0.2)


# ---- the contract of every method


def test_finds_the_maximum_of_eq8(method: str) -> None:
    x, f = eq8_truth()
    assert (round(x, 6), round(f, 6)) == (1.850547, 3.850274)  # what the notes state
    found = minimise(eq8, EQ8_BOX, method=method, rng=rng(3), max_evaluations=7240)
    assert -found.cost == pytest.approx(f, abs=1e-5)
    assert found.x[0] == pytest.approx(x, abs=1e-4)


def test_finds_the_minimum_of_a_bowl(method: str) -> None:
    found = minimise(sphere, [[-5, 4]] * 3, method=method, rng=rng(1), max_evaluations=6000)
    np.testing.assert_allclose(found.x, 0.3, atol=5e-3)


@pytest.mark.few(2)
def test_finds_the_lowest_of_a_hundred_minima(method: str) -> None:
    runs = [
        minimise(rastrigin, [[-5.12, 4.7]] * 2, method=method, rng=rng(seed), max_evaluations=10_000)
        for seed in range(3)
    ]
    found = min(runs, key=lambda run: run.cost)
    assert found.cost < 1e-3  # the next minimum lies at 0.995
    np.testing.assert_allclose(found.x, 0, atol=2e-3)


def test_same_seed_same_result_and_no_global_state(method: str) -> None:
    def run(seed: int) -> SearchResult:
        return minimise(rastrigin, [[-5, 4]] * 3, method=method, rng=rng(seed), max_evaluations=1500)

    before = np.random.get_state()[1].tobytes()  # noqa: NPY002 - what must not be touched
    first, again, other = run(5), run(5), run(6)
    assert np.random.get_state()[1].tobytes() == before  # noqa: NPY002
    np.testing.assert_array_equal(first.x, again.x)
    np.testing.assert_array_equal(first.history, again.history)
    assert not np.array_equal(first.x, other.x)


@pytest.mark.few(8)
@pytest.mark.parametrize("budget", [1, 7, 40, 41, 503])
def test_budget_is_never_exceeded(method: str, budget: int) -> None:
    asked: list[Array] = []

    def cost(x: Array) -> Array:
        asked.append(x)
        return rastrigin(x)

    box = np.array([[-5.0, 4.0], [2.0, 3.0]])
    found = minimise(cost, box, method=method, rng=rng(), max_evaluations=budget)
    points = np.concatenate(asked)
    assert len(points) == found.evaluations == budget
    assert found.reason == "evaluations"
    assert np.all((points >= box[:, 0]) & (points <= box[:, 1]))
    assert found.cost == rastrigin(points).min()
    np.testing.assert_array_equal(found.x, points[np.argmin(rastrigin(points))])


def test_history_tells_the_last_improvement(method: str) -> None:
    seen: list[tuple[int, float]] = []

    def watch(generation: int, x: Array, cost: float) -> None:
        assert rastrigin(x[None])[0] == cost
        seen.append((generation, cost))

    found = minimise(rastrigin, [[-5, 4]] * 2, method=method, rng=rng(), max_evaluations=900, callback=watch)
    assert [g for g, _ in seen] == list(range(found.generations + 1))
    np.testing.assert_array_equal(found.history, [c for _, c in seen])
    assert np.all(np.diff(found.history) <= 0)
    assert found.history[-1] == found.cost
    assert found.generation_of_last_improvement == np.argmax(found.history == found.cost)


def test_callback_stops(method: str) -> None:
    found = minimise(rastrigin, [[-5, 4]] * 2, method=method, rng=rng(), callback=lambda g, *_: g == 3)
    assert (found.generations, found.reason) == (3, "callback")


def test_stagnation_stops(method: str) -> None:
    found = minimise(lambda x: np.ones(len(x)), [[0, 1]] * 2, method=method, rng=rng(), stagnation=5)
    assert found.reason in ("stagnation", "converged")
    assert found.generation_of_last_improvement == 0
    assert found.evaluations < 20_000


def test_costs_that_are_not_numbers_lose(method: str) -> None:
    def holes(x: Array) -> Array:
        return np.where(x[:, 0] > 0.35, np.nan, sphere(x))

    found = minimise(holes, [[-1, 1]] * 2, method=method, rng=rng(), max_evaluations=3000)
    np.testing.assert_allclose(found.x, 0.3, atol=0.02)


@pytest.mark.parametrize("name", ["ga", "mga"])
def test_children_replace_the_worst_and_the_best_takes_over(name: str) -> None:
    """Children that are copies of their parents: in the end all are copies of the best of the first population."""
    asked: list[Array] = []
    copying: dict[str, dict[str, Any]] = {
        "ga": {"crossover": 0.0, "mutation": 0.0},
        "mga": {"a": 1e9, "b": 0.0, "p_const": 0.0, "bits": 20},
    }
    settings = {"population": 20, "gap": 0.1, **copying[name]}  # two children per generation
    minimise(
        lambda x: (asked.append(sphere(x)), sphere(x))[1],
        [[-1, 1]] * 2,
        method=name,
        rng=rng(),
        max_evaluations=500,
        **settings,
    )
    assert len(asked[0]) == 20
    np.testing.assert_array_equal(np.concatenate(asked[-10:]), asked[0].min())


# ---- settings, results, errors


def test_mga_changes_its_code_length_with_the_generation() -> None:
    """Early points lie on the 10-bit grid of the box, late ones off it, on the 20-bit grid."""

    def on_grid(x: Array, bits: int) -> bool:
        k = (x + 1) / 3 * (2**bits - 1)
        return np.allclose(k, np.rint(k), atol=1e-6)

    asked: list[Array] = []
    minimise(lambda x: (asked.append(x), eq8(x))[1], EQ8_BOX, method="mga", rng=rng(), max_evaluations=7240)
    assert on_grid(asked[0], 10)
    assert on_grid(asked[10], 10)
    assert on_grid(asked[-1], 20)
    assert not on_grid(asked[-1], 10)


@pytest.mark.parametrize("settings", [{}, {"bits": 20}])
def test_mga_as_printed_runs(settings: dict[str, Any]) -> None:
    found = minimise(eq8, EQ8_BOX, method="mga", rng=rng(1), max_evaluations=4000, as_printed=True, **settings)
    assert -found.cost > 3.6


def test_group_of_feasible_solutions() -> None:
    """All four minima of Himmelblau's function, none twice; a search that keeps its diversity visits them all."""
    found = minimise(himmelblau, [[-5, 5]] * 2, method="sa", rng=rng(0), max_evaluations=20_000, chains=32)
    assert len(found.optima) == 4
    order = [int(np.argmin(np.linalg.norm(found.optima - truth, axis=1))) for truth in HIMMELBLAU]
    assert sorted(order) == [0, 1, 2, 3]
    np.testing.assert_allclose(found.optima[order], HIMMELBLAU, atol=0.03)
    np.testing.assert_allclose(found.optima_costs, himmelblau(found.optima))
    assert found.optima_costs[0] == found.cost


def test_distinct_optima_of_a_valley_and_an_island() -> None:
    """A chain of points down one slope is one optimum, a point apart another, one above 1 % none."""
    x = np.array([0.10, 0.115, 0.13, 0.145, 0.16, 0.80, 0.95])
    costs = np.array([1.0, 1.001, 1.002, 1.003, 1.004, 1.009, 1.011])
    optima, kept = distinct_optima(x[:, None], costs, np.zeros(1), np.ones(1))
    np.testing.assert_array_equal(optima[:, 0], [0.10, 0.80])
    np.testing.assert_array_equal(kept, [1.0, 1.009])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "gaa"}, 'expected a search among ga, mga, sa, sga, de, da, cmaes but got "gaa"'),
        ({"poulation": 3}, 'search ga: expected a setting among generations, .* mutation but got "poulation"'),
        ({"population": 2, "gap": 1.5, "bits": 99}, r"at least 4 but got 2; .* got 1.5; .* 60 but got 99"),
        ({"method": "mga", "l_const": 40}, "expected l_const as a number of at most 30 but got 40"),
        (
            {"method": "mga", "as_printed": True, "d": 0.1},
            "expected at most 60 bits but Eq. 7 as printed begins with 105",
        ),
        ({"selection": "best"}, 'expected selection as "universal", "roulette" or "tournament" but got "best"'),
        ({"mutation": "often"}, 'expected mutation as a number but got "often"'),
        (
            {"method": "mga", "as_printed": 1, "restarts": 1.5},
            "restarts as a whole .* got 1.5; expected as_printed as true",
        ),
        ({"P_m": 0.1, "mutation": 0.2}, "expected mutation once but got it twice"),
        ({"bounds": [0, 1]}, r"expected bounds of shape \(d, 2\) but got shape \(2,\)"),
        ({"bounds": [[0, 1], [2, 2]]}, r"expected finite lower < upper but got \[2, 2\] in row 1"),
        ({"max_evaluations": 0}, "expected max_evaluations of at least 1 but got 0"),
        ({"cost": lambda x: 1.0}, r"expected one cost per point, shape \(40,\), but got shape \(\)"),
    ],
)
def test_errors_say_what_came(change: dict[str, Any], message: str) -> None:
    call: dict[str, Any] = {"cost": sphere, "bounds": [[0, 1]] * 2, "method": "ga", "rng": rng()} | change
    with pytest.raises(FrictrackError, match=message):
        minimise(call.pop("cost"), call.pop("bounds"), **call)


def test_missing_cma_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(FrictrackError, match='search cmaes needs cma; pip install "cma"'):
        minimise(sphere, [[0, 1]], method="cmaes", rng=rng())


def test_settings_come_as_texts_and_as_the_papers_write_them() -> None:
    """One record for Python, command line and study file."""
    typed = search_method("mga", {"generations": "500", "P_const": "0.05", "L_const": "8", "as_printed": "false"})
    assert typed == MGA(generations=500, p_const=0.05, l_const=8)
    assert search_method("ga", {"P_c": 0.9, "P_m": "none", "L": 16}) == GA(crossover=0.9, bits=16)
    assert search_method("de", {"mutation": "0.4, 0.9"}) == DE(mutation=(0.4, 0.9))
    assert search_method(SGA(population=20), {"cooling": "linear"}) == SGA(population=20, cooling="linear")


def test_generations_count_whatever_they_cost(method: str) -> None:
    found = minimise(rastrigin, [[-5, 4]] * 2, method=method, rng=rng(), max_evaluations=50, generations=7)
    assert (found.generations, found.reason) == (7, "generations")
    assert found.settings["generations"] == 7


def test_chosen_settings_are_told() -> None:
    """G_max 200: a = 10/G_max and s = G_max/4; two parameters of 2 L_const bits: P_const = 4/40."""
    told = minimise(sphere, [[-1, 1]] * 2, method=MGA(generations=200), rng=rng()).settings
    assert (told["a"], told["s"], told["p_const"], told["c"]) == pytest.approx((0.05, 50.0, 0.1, 0.1))
    assert told["method"] == "mga"


def test_restarts_spend_the_budget_again_and_keep_the_best() -> None:
    def search(restarts: int) -> SearchResult:
        return minimise(rastrigin, [[-5, 4]] * 3, method=GA(restarts=restarts), rng=rng(4), max_evaluations=760)

    one, three = search(0), search(2)
    assert three.evaluations == 3 * one.evaluations == 3 * 760
    assert np.bincount(three.convergence.start).tolist() == [21, 21, 21]
    np.testing.assert_array_equal(three.history[:21], one.history)
    assert three.cost == three.history[-1] <= one.cost
    assert three.generation_of_last_improvement == np.argmax(three.history == three.cost)


@pytest.mark.parametrize("select", [roulette, tournament])
def test_selections_draw_in_proportion(select: Callable[..., Any]) -> None:
    """Linear ranking from 0 to 2, and a tournament of two: individual k of P is drawn (2 k + 1)/P^2 of all times."""
    n, fitness = 5, np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    share = np.bincount(select(fitness, 100_000, rng()), minlength=n) / 100_000
    np.testing.assert_allclose(share, fitness / 5 if select is roulette else (2 * np.arange(n) + 1) / n**2, atol=0.008)


def test_convergence_of_copies_and_of_a_uniform_spread() -> None:
    """Copying: the diversity begins at that of uniform points, 1, and ends at 0; the mean ends at the best."""
    found = minimise(
        sphere, [[-1, 1]] * 2, method=GA(population=400, crossover=0, mutation=0, generations=60), rng=rng()
    ).convergence
    assert found.diversity[0] == pytest.approx(1.0, abs=0.1)
    assert found.diversity[-1] < 1e-12
    assert found.mean[0] == pytest.approx(2 * (1 / 3 + 0.09), rel=0.1)  # of (x - 0.3)^2 + (y - 0.3)^2 over the box
    assert found.mean[-1] == pytest.approx(found.best[-1], rel=1e-12)
    assert found.best[-1] == sphere(found.x[-1:])[0]
    assert np.all(found.mean >= found.best - 1e-12)
    np.testing.assert_array_equal(found.bounds, [[-1, 1]] * 2)


def test_an_interrupted_search_keeps_its_best_where_this_is_wanted() -> None:
    def until(x: Array) -> Array:
        calls.append(len(x))
        if len(calls) == 6:
            raise KeyboardInterrupt
        return sphere(x)

    calls: list[int] = []
    found = minimise(until, [[-1, 1]] * 2, method=GA(restarts=3), rng=rng(), keep_interrupted=True)
    assert (found.reason, found.generations, len(calls)) == ("interrupted", 4, 6)
    calls.clear()
    with pytest.raises(KeyboardInterrupt):
        minimise(until, [[-1, 1]] * 2, method="ga", rng=rng())


# ---- the paper's tables


def last_improvement(make: Callable[[int], SearchResult], seeds: int) -> tuple[float, float, float]:
    """Mean generation of the last improvement, its standard error, and the share of runs that missed 3.85025."""
    runs = [make(seed) for seed in range(seeds)]
    last = np.array([run.generation_of_last_improvement for run in runs])
    lost = np.mean([-run.cost < 3.85025 for run in runs])
    return float(last.mean()), float(last.std() / np.sqrt(seeds)), float(lost)


@pytest.mark.slow
def test_table_5_over_200_seeds() -> None:
    """GA 34.14, MGA 29.86 generations in print (50 runs of sd 20): the same order, and too near to tell apart."""

    def run(method: str, **settings: Any) -> Callable[[int], SearchResult]:
        return lambda seed: minimise(
            eq8, EQ8_BOX, method=method, rng=rng(seed), max_evaluations=40 + 36 * 200, **settings
        )

    ga, ga_error, ga_lost = last_improvement(run("ga"), 200)
    mga, mga_error, mga_lost = last_improvement(run("mga", bits=20), 200)
    print_error = 20 / np.sqrt(50)
    assert ga == pytest.approx(34.14, abs=3 * np.hypot(ga_error, print_error))
    assert mga == pytest.approx(29.86, abs=3 * np.hypot(mga_error, print_error))
    assert ga_lost == mga_lost == 0


@pytest.mark.slow
def test_table_6_ten_bits_suffice_for_3_8502() -> None:
    """The 10-bit grid holds 3.850263: the printed 3.6792 is no matter of resolution."""
    grid = np.arange(1024)[:, None] / 1023 * 3 - 1
    best = -eq8(grid).min()
    assert best == pytest.approx(3.850263, abs=1e-6)
    for seed in range(20):
        found = minimise(eq8, EQ8_BOX, method="ga", rng=rng(seed), max_evaluations=7240, bits=10)
        assert -found.cost == pytest.approx(best, abs=1e-12)


@pytest.mark.slow
def test_eq6_with_target_values_loses_runs() -> None:
    """As printed, with f the target value, the search loses 9-61 % of the runs (notes); as read here, none."""
    printed = last_improvement(
        lambda seed: minimise(
            eq8, EQ8_BOX, method="mga", rng=rng(seed), max_evaluations=7240, bits=20, as_printed=True
        ),
        100,
    )
    assert 0.05 < printed[2] < 0.61


def test_the_last_generation_is_that_which_survived() -> None:
    """The budget ends while children are evaluated; the mean is not that of children that Metropolis' rule refuses."""
    found = minimise(sphere, [[-1, 1]] * 3, method="sga", rng=rng(1), max_evaluations=8_000)
    assert found.reason == "evaluations"
    assert found.convergence.mean[-1] < 2 * found.convergence.mean[-2]
