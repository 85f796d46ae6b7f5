"""Sets of effects beside a model: which are proposed and refined, and which of them replaces another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from few_effects import use_few_effects
from runs import BASE, MASS, Spec, measured, study
from scipy.integrate import solve_ivp

from frictrack import samples
from frictrack.diagnose import diagnose, explanations
from frictrack.diagnose.conclusion import Conclusion
from frictrack.diagnose.examination import Examination, examine
from frictrack.diagnose.explanations import Explanation, Explanations, alternatives_of, find_rivals, names_in_place_of
from frictrack.diagnose.formulas import FormulaSearch
from frictrack.diagnose.model_selection import information_criterion, parameter_penalty
from frictrack.diagnose.pairs import gains_of_pairs, try_pair
from frictrack.diagnose.search import FinishedSearch, RefinedCandidate
from frictrack.effects import LIBRARY, models
from frictrack.fit import Fit, fit
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import linearise, measured_series
from frictrack.fit.stepwise import baseline_misfit, scan_effect, try_effect
from frictrack.records import Run
from frictrack.search import EvaluationBudget

LAW = ["coulomb", "viscous"]
SPECS = tuple(Spec(v, 1, 0.06) for v in (3.0, 5.0, 7.0, 4.0, -6.0))
FEW = (*LAW, "drag", "spring", "slope", "asymmetry")
LEVEL = 0.005
PAIR = frozenset({"drag", "spring"})
DRAG, SPRING = {"c": 0.02}, {"k": 1.8, "x_0": -0.1}  # along these runs they nearly cancel


def runs_with(specs: tuple[Spec, ...] = SPECS, **hidden: dict[str, float]) -> list[Run]:
    """Runs of Coulomb and viscous friction with hidden effects."""
    law = {name: BASE[name] for name in LAW} | hidden
    return list(study(models.of(law), law, specs, sigma=5e-6, rng=np.random.default_rng(1))[0])


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """A library of six effects."""
    use_few_effects(monkeypatch, FEW)


@pytest.fixture(scope="module")
def cancelling() -> Fit:
    """A law without drag and a spring."""
    return fit(LAW, runs_with(drag=DRAG, spring=SPRING))


Begun = tuple[Explanations, Examination, Explanation]


@pytest.fixture
def begun(few: None, cancelling: Fit) -> Begun:
    """All effects proposed alone beside that law, with its examination and the empty set."""
    examined = examine(cancelling.solution, (), np.random.default_rng(0), LEVEL)
    space = Explanations(cancelling.solution)
    return space, examined, space.begin(examined, examined.scanned)


@pytest.mark.usefixtures("few")
def test_two_effects_that_nearly_cancel_are_named_together(cancelling: Fit) -> None:
    found = diagnose(cancelling, quick=True)
    assert (found.verdict, set(found.missing)) == ("missing", PAIR)
    pair, one = (information_criterion(fit([*LAW, *n], cancelling.runs).solution) for n in (PAIR, {"drag"}))
    assert found.candidates[0].delta_bic + found.candidates[1].delta_bic == pytest.approx(
        information_criterion(cancelling.solution) - pair, abs=0.1
    )
    assert pair < one - 20  # each of them explains far less alone


@pytest.mark.usefixtures("few")
def test_two_effects_of_which_neither_is_significant_alone_are_named() -> None:
    fitted = fit(LAW, runs_with(drag=DRAG, spring={"k": 2.3, "x_0": -0.1}))
    examined = examine(fitted.solution, (), np.random.default_rng(0), LEVEL)
    assert examined.leaves_misfit
    assert min(p for name, p in examined.p.items() if name != "viscous.F_v") > LEVEL
    found = diagnose(fitted, quick=True)
    assert set(found.missing) == PAIR
    assert found.verdict in ("missing", "ambiguous")


@pytest.mark.slow
def test_one_effect_that_imitates_the_sum_of_two_gives_way_to_them(
    cancelling: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that is slow leaves no significant misfit, but it explains far less by the BIC."""
    use_few_effects(monkeypatch, (*FEW, "clock_rate"))
    pair, clock = (fit([*LAW, *n], cancelling.runs).solution for n in (PAIR, {"clock_rate"}))
    assert information_criterion(pair) < information_criterion(clock) - 40
    assert not examine(clock, (), np.random.default_rng(0), LEVEL).something_is_missing
    found = diagnose(cancelling, quick=True)
    assert PAIR in [set(found.missing), *(set(one["effects"]) for one in found.alternatives)]


@pytest.mark.parametrize(("pairs", "names"), [(24, PAIR), (0, None)])
def test_a_pair_is_proposed_whatever_its_effects_explain_alone(
    begun: Begun, pairs: int, names: frozenset[str] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explanations, "N_CENTRES", 0)  # no set is proposed beside a smaller one
    monkeypatch.setattr(explanations, "N_PAIRS", pairs)
    space, *_ = begun
    space.grow(1)
    space.grow(2)
    assert next((one.names for one in space.laws(2)), None) == names


def test_a_set_is_proposed_beside_a_smaller_one(begun: Begun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(explanations, "N_PAIRS", 0)
    space, *_ = begun
    space.grow(1)
    space.grow(2)
    best = space.laws(2)[0]
    assert best.names == PAIR
    assert best.centre is not None
    assert len(best.centre.effects) == 1


SAME_WAY = SPECS[:4]  # the constant force of a spring is in the law here


@pytest.mark.parametrize("specs", [SPECS, SAME_WAY], ids=["both directions", "one direction"])
def test_the_gain_of_a_pair_is_what_a_fit_of_both_gains(specs: tuple[Spec, ...]) -> None:
    """Drag and a spring have linear parameters only."""
    law = linearise(fit(LAW, runs_with(specs, drag={"c": 0.1}, spring={"k": 10.0, "x_0": -0.1})).solution)
    series = measured_series(law)
    drag, spring = (
        try_effect(law, LIBRARY[n], scan_effect(law, LIBRARY[n], series), series.coordinates[:, 0])
        for n in ("drag", "spring")
    )
    gain = baseline_misfit(law) - try_pair(law, drag, spring).misfit
    assert gain > 200 + baseline_misfit(law) - min(drag.misfit, spring.misfit)
    assert gains_of_pairs(law, [drag, spring]) == {("drag", "spring"): pytest.approx(gain, rel=0.05)}


def test_a_special_case_of_the_best_is_simulated_whatever_it_promises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along the measured motion a law with one parameter more may make up for what this leaves out."""
    use_few_effects(monkeypatch, (*LAW, "drag", "power_law_viscosity"))
    start = fit(LAW, runs_with(drag={"c": 0.1})).solution
    tested, space = examine(start, (), np.random.default_rng(0), LEVEL), Explanations(start)
    space.begin(tested, tested.scanned)
    drag = frozenset({"drag"})
    space.known[drag] = replace(space.known[drag], criterion=space.known[drag].criterion + 150, excess=0.0)
    space.grow(1)
    assert space.laws(1)[0].names == drag


def test_what_is_not_simulated_explains_less_than_the_best(begun: Begun, cancelling: Fit) -> None:
    space, _, empty = begun
    space.grow(1)
    best = space.laws(1)[0]
    left_out = [one for one in space.of_size(1) if one.solution is None]
    assert left_out
    for one in left_out:
        law = fit([*LAW, *one.names], cancelling.runs).solution
        assert empty.criterion - information_criterion(law) < best.evidence(empty)


def test_a_chain_divides_the_evidence_among_the_effects(begun: Begun, cancelling: Fit) -> None:
    space, _, empty = begun
    space.grow(1)
    space.grow(2)
    whole = space.refine_fully(space.laws(2)[0])
    chain = space.chain(whole)
    assert [len(one.effects) for one in chain] == [0, 1, 2]
    assert chain[1].names < chain[2].names
    shares = [after.evidence(before) for before, after in pairwise(chain)]
    fitted = fit([*LAW, *PAIR], cancelling.runs).solution
    assert sum(shares) == pytest.approx(empty.criterion - information_criterion(fitted), abs=0.05)


def test_one_effect_more_must_be_significant_beside_the_others(begun: Begun) -> None:
    space, *_ = begun
    space.grow(1)
    space.grow(2)
    drag, whole = space.known[frozenset({"drag"})], space.known[PAIR]
    examined = examine(drag.law, (), np.random.default_rng(0), LEVEL)
    assert space.better(drag, examined) is whole
    strict = replace(examined, level=0.0)
    assert whole.criterion < drag.criterion - 20
    assert space.better(drag, strict) is not whole


def test_the_penalty_of_the_parameters_is_no_gain(begun: Begun) -> None:
    space, *_ = begun
    space.grow(1)
    space.grow(2)
    drag, whole = space.known[frozenset({"drag"})], space.known[PAIR]
    penalties = [parameter_penalty(one.law.problem.layout, one.law.problem) for one in (drag, whole)]
    gain = information_criterion(drag.law) - penalties[0] - information_criterion(whole.law) + penalties[1]
    assert whole.gain(drag, LIBRARY["spring"]) == pytest.approx(gain, abs=1e-6)


def test_a_handicap_is_a_part_of_what_a_set_promises_and_of_what_it_explains(few: None, cancelling: Fit) -> None:
    examined = examine(cancelling.solution, (), np.random.default_rng(0), LEVEL)
    plain, other = (
        Explanations(cancelling.solution, (), lambda e, h=h: h if e.name == "drag" else 0.0) for h in (0.0, 15.0)
    )
    drag, spring = frozenset({"drag"}), frozenset({"spring"})
    for space in (plain, other):
        space.begin(examined, examined.scanned)
    assert other.known[drag].criterion == pytest.approx(plain.known[drag].criterion + 15.0)
    assert other.known[spring].criterion == pytest.approx(plain.known[spring].criterion)
    refined = [space._refined(space.known[drag]) for space in (plain, other)]
    assert refined[1].criterion == pytest.approx(refined[0].criterion + 15.0, abs=0.01)


@pytest.mark.parametrize(("granted", "unrefined"), [(np.inf, False), (0.0, True)])
def test_promising_sets_are_marked_where_the_budget_is_spent(
    few: None, cancelling: Fit, granted: float, *, unrefined: bool
) -> None:
    examined = examine(cancelling.solution, (), np.random.default_rng(0), LEVEL)
    start = replace(cancelling.solution, problem=cancelling.solution.problem.with_budget(EvaluationBudget(granted)))
    space = Explanations(start)
    space.begin(examined, examined.scanned)
    space.refine(1)
    marked = {next(iter(one.names)) for one in space.of_size(1) if one.is_unrefined}
    assert ("drag" in marked) is unrefined
    assert bool(space.laws(1)) is not unrefined


Made = Callable[..., Explanation]


@pytest.fixture
def made(cancelling: Fit) -> tuple[Explanations, Made]:
    """Sets with given criteria, as if they had been simulated."""
    space = Explanations(cancelling.solution)

    def enter(criterion: float, *names: str, **more: Any) -> Explanation:
        one = Explanation(tuple(LIBRARY[n] for n in names), criterion, solution=cancelling.solution)
        space.known[one.names] = replace(one, **more)
        return space.known[one.names]

    return space, enter


@pytest.fixture
def nothing_passes(cancelling: Fit) -> Examination:
    """An examination in which no further effect is significant."""
    examined = examine(cancelling.solution, (), np.random.default_rng(0), LEVEL)
    return replace(examined, level=0.0)


@pytest.mark.parametrize(("behind", "is_needless"), [(-1.0, True), (0.0, True), (3.0, False)])
def test_an_effect_that_explains_nothing_beside_the_others_is_removed(
    made: tuple[Explanations, Made], nothing_passes: Examination, behind: float, *, is_needless: bool
) -> None:
    space, enter = made
    best, pair, alone = enter(-80.0, "lens"), enter(-100.0, "drag", "slope"), enter(-100.0 + behind, "drag")
    enter(-20.0, "slope")
    assert space.better(best, nothing_passes) is (alone if is_needless else pair)


@pytest.mark.parametrize(("criterion", "replaces"), [(-89.0, False), (-91.0, True)])
def test_other_effects_replace_the_best_only_if_they_explain_decisively_more(
    made: tuple[Explanations, Made], nothing_passes: Examination, criterion: float, *, replaces: bool
) -> None:
    space, enter = made
    best, pair = enter(-80.0, "lens"), enter(criterion, "drag", "slope")
    assert space.better(best, nothing_passes) is (pair if replaces else None)


def test_of_sets_that_explain_the_same_the_one_with_fewer_nonlinear_parameters_is_taken(
    made: tuple[Explanations, Made], nothing_passes: Examination
) -> None:
    space, enter = made
    best, plain = enter(-80.0, "lens"), enter(-100.0, "drag", "slope")
    enter(-101.0, "texture", "slope")
    assert space.better(best, nothing_passes) is plain
    wave = enter(-110.0, "texture", "slope")
    assert space.better(best, nothing_passes) is wave


def test_a_set_with_an_objection_replaces_nothing(made: tuple[Explanations, Made], nothing_passes: Examination) -> None:
    space, enter = made
    best = enter(-80.0, "lens")
    enter(-200.0, "drag", "slope", objection="more than the weight")
    assert space.better(best, nothing_passes) is None


def test_a_rival_set_is_named_with_the_effects_in_place_of_each(made: tuple[Explanations, Made]) -> None:
    space, enter = made
    best, near = enter(-100.0, "drag", "slope"), enter(-95.0, "drag", "asymmetry")
    enter(-97.0, "power_law_viscosity", "slope")  # contains drag
    enter(-99.0, "thermal", "slope", objection="more than the weight")
    rivals = find_rivals(best, space.of_size(2))
    assert rivals == [near]
    assert names_in_place_of("slope", best, rivals) == ("asymmetry",)
    assert names_in_place_of("drag", best, rivals) == ()
    (other,) = alternatives_of(best, rivals)
    assert other == {"effects": ["asymmetry", "drag"], "delta_bic": 5.0}
    assert alternatives_of(enter(-100.0, "slope"), [enter(-99.0, "asymmetry")]) == []  # named beside it


@pytest.mark.usefixtures("few")
def test_a_set_that_the_runs_cannot_exclude_is_an_alternative() -> None:
    found = diagnose(fit(LAW, runs_with(drag={"c": 0.03}, slope={"F": 0.3})), quick=True)
    assert (found.verdict, set(found.missing)) == ("ambiguous", {"drag", "slope"})
    slope = next(c for c in found.candidates if c.effect == "slope")
    assert "asymmetry" in slope.indistinguishable_from
    assert ["asymmetry", "drag"] in [one["effects"] for one in found.alternatives]


@pytest.mark.parametrize(("together", "verdict"), [(0.5, "missing"), (2.0, "unexplained")])
def test_effects_are_named_if_the_model_with_all_of_them_predicts_better(
    few: None, cancelling: Fit, together: float, verdict: str
) -> None:
    """The first effect alone may predict worse, while the others are still missing."""
    alone, whole = (fit([*LAW, *names], cancelling.runs).solution for names in (["drag"], ["drag", "spring"]))
    first, last = (examine(s, (), np.random.default_rng(0), LEVEL) for s in (cancelling.solution, whole))
    found = [RefinedCandidate(LIBRARY[n], law, 100.0, 0.001) for n, law in (("drag", alone), ("spring", whole))]
    tried = [replace(found[0], passes=True)]
    generators = np.random.default_rng(0).spawn(2)
    conclusion = Conclusion(
        cancelling,
        FinishedSearch(
            cancelling.solution, first, last, tried, found, generators, FormulaSearch.of(cancelling.solution)
        ),
    )

    def heldout(law: Solution) -> tuple[float, float, str]:
        return 1.0, together if law is whole else 2.0, "run by run"

    vars(conclusion)["_heldout"] = heldout
    assert conclusion.verdict.candidates[0].heldout_after == 2.0
    assert conclusion.verdict.verdict == verdict


PLACE, WIDTH = 0.357, 0.014  # of a worn place, m; the fastest mass stops 9 mm before its middle


def slide_to_rest(
    speed: float, force: Callable[[float, float], float], *, fps: float = 4000, sigma: float = 1e-6, last: float = 0.05
) -> Run:
    """A slide of 0.4 kg that ends at a `last` speed, m/s; SciPy's integrator."""

    def rests(_: float, state: np.ndarray) -> float:
        return abs(float(state[1])) - last

    rests.terminal = True  # type: ignore[attr-defined]
    slide = solve_ivp(
        lambda _, state: [state[1], -force(*state) / 0.4],
        (0.0, 1.0),
        [0.0, speed],
        rtol=1e-10,
        atol=1e-12,
        events=rests,
        dense_output=True,
    )
    t = np.arange(0, slide.t[-1], 1 / fps)
    noise = np.random.default_rng(int(10 * abs(speed)))
    return measured(t, slide.sol(t)[0], sigma=sigma, mass=0.4, name=f"{speed}", rng=noise)


@pytest.mark.slow
def test_a_worn_place_that_the_mass_stops_before_is_found_beyond_what_it_passed() -> None:
    """Its middle was clipped to one step of the scan beyond the course; a second patch took what was left."""

    def worn(x: float, v: float) -> float:
        return float(5.0 + 0.9 * v + 1.9 * np.exp(-(((x - PLACE) / WIDTH) ** 2) / 2))

    runs = [slide_to_rest(speed, worn) for speed in (3.5, 2.8, 2.2)]
    assert max(run.displacement.x.max() for run in runs) < PLACE - 0.5 * WIDTH
    found = fit([*LAW, "patch"], runs)
    for name, truth in (("F", 1.9), ("x_c", PLACE), ("w", WIDTH)):
        estimate = found.parameters[f"patch.{name}"]
        assert abs(estimate.value - truth) < 4 * estimate.std
    assert diagnose(fit(LAW, runs), quick=True, rng=0).missing == ["patch"]


def test_a_place_much_narrower_than_the_course_is_fitted() -> None:
    """It was clipped to a two-hundredth of the course, and two collisions explained more."""

    def bumpy(x: float, v: float) -> float:
        return float(1.5 + 0.2 * v + 5.0 * np.exp(-(((x - 0.45) / 0.002) ** 2) / 2))

    runs = [slide_to_rest(speed, bumpy, fps=2000, sigma=3e-6, last=0.3) for speed in (3.0, 2.5, 2.2)]
    found = fit([*LAW, "patch"], runs)
    for name, truth in (("F", 5.0), ("x_c", 0.45), ("w", 0.002)):
        estimate = found.parameters[f"patch.{name}"]
        assert abs(estimate.value - truth) < 4 * estimate.std
    assert found.reduced_chi2 == pytest.approx(1, abs=0.15)


@pytest.mark.usefixtures("few")
def test_a_constant_force_that_friction_levels_imitate_is_found() -> None:
    """Two runs forth and two back: another level of friction each way is a constant force."""

    def tilted(x: float, v: float) -> float:
        return float(1.4 * np.sign(v) + 0.2 * v + 0.08)

    bare = fit(LAW, [slide_to_rest(speed, tilted, fps=1000, sigma=5e-6) for speed in (3.0, 2.0, -3.0, -2.0)])
    assert bare.solution.tau > 0.03
    found = diagnose(bare, quick=True, rng=0)
    assert found.missing == ["slope"]
    assert found.candidates[0].indistinguishable_from == ("asymmetry",)


# whole studies with the whole library; the motions come from SciPy's integrator

PLAN = ((2.5, 1), (4.0, 1), (6.0, 1), (4.0, 2), (-2.5, 1), (-5.5, 1))  # start speed m/s, mass over the reference
FPS = 4000.0
Force = Callable[[float, float, float, float], float]  # of place, velocity, direction and load


def slides(
    force: Force,
    plan: tuple[tuple[float, float], ...] = PLAN,
    *,
    mass: float = MASS,
    frames: int = 260,
    late: float = 0.0,
) -> list[Run]:
    """Runs under a force, seen with noise of 3 um until they are slow by a clock that gets late."""
    out = []
    for i, (speed, ratio) in enumerate(plan):
        clock = np.arange(frames) / FPS

        def rate(_: float, y: np.ndarray, ratio: float = ratio, s: float = np.sign(speed)) -> list[float]:
            return [y[1], -force(y[0], y[1], s, ratio) / (mass * ratio)]

        def is_slow(_: float, y: np.ndarray) -> float:
            return float(abs(y[1]) - 0.05)

        is_slow.terminal = True  # type: ignore[attr-defined]
        t = clock + late * clock**2 / 2
        solved = solve_ivp(
            rate, (0.0, t[-1]), [0.0, speed], t_eval=t, rtol=1e-10, atol=1e-13, max_step=5e-4, events=is_slow
        )
        seen = clock[: len(solved.t)]
        rng = np.random.default_rng(i)
        out.append(measured(seen, solved.y[0], sigma=3e-6, mass=mass * ratio, name=f"r{i}", rng=rng))
    return out


def sets_of(fitted: Fit) -> list[frozenset[str]]:
    """The effects that a diagnosis names, and the sets that it cannot exclude."""
    found = diagnose(fitted, quick=True)
    assert found.verdict in ("missing", "ambiguous")
    return [frozenset(found.missing), *(frozenset(one["effects"]) for one in found.alternatives)]


@pytest.mark.slow
def test_the_true_pair_is_named_and_not_one_that_imitates_it() -> None:
    """On an inclined course with air drag; asymmetry with a spring explains less."""
    runs = slides(lambda x, v, s, load: 4.0 * load * s + 0.5 * v + 0.4 * load + 0.06 * v * abs(v))
    named, *others = sets_of(fit(LAW, runs))
    assert named == {"drag", "slope"}
    assert frozenset({"asymmetry", "spring"}) not in others


@pytest.mark.slow
def test_a_pair_is_found_where_one_of_it_alone_leaves_the_model_far_from_the_data() -> None:
    """Fitted with the curve alone, the sample slides are missed by far more than along the measured motion."""
    assert sets_of(fit(LAW, samples.runs())) == [frozenset({"patch", "stribeck"})]


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.02, 0.1])
def test_two_effects_that_each_explain_nothing_in_place_of_one_are_found(late: float) -> None:
    """Flash weakening imitates a late clock with air drag; drag in its place is of no use without the clock."""

    def force(x: float, v: float, s: float, load: float) -> float:
        return s * load * (4.0 + 0.3 * np.sin(2 * np.pi * x / 0.05)) + 0.5 * v + 0.01 * v * abs(v)

    runs = slides(force, late=late)
    imitation, true = (
        fit([*LAW, "texture", *more], runs).solution for more in (["flash_weakening"], ["drag", "timebase"])
    )
    assert information_criterion(true) < information_criterion(imitation)
    assert frozenset({"drag", "timebase", "texture"}) in sets_of(fit(LAW, runs))


@pytest.mark.slow
def test_a_spring_that_imitates_drag_and_log_velocity_is_not_named() -> None:
    def force(x: float, v: float, s: float, load: float) -> float:
        return load * (0.9 + 0.44 * np.exp(-v / 0.64) + 0.0172 * np.log(v / 1e-6)) + 0.113 * v + 0.0013 * v * v

    plan = ((2.1, 1.0), (3.8, 1.0), (5.4, 1.0), (7.0, 1.0), (4.6, 0.5), (4.6, 2.0))
    assert frozenset({"drag", "log_velocity"}) in sets_of(fit("tustin", slides(force, plan, mass=0.22, frames=900)))
