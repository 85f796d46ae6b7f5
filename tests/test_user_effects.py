"""Effects of a user's own: a declared function in Python, and a formula that cannot run code."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from cost import within
from runs import BASE, HIDDEN, Spec, study

import frictrack as ft
from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import DECLARED, Path, Span, formula, models, settings
from frictrack.fit import restore, state
from frictrack.records import GRAVITY

SPAN = Span(duration=0.12, x_min=0.0, x_max=0.4, v_min=0.5, v_max=4.0, fps=4000.0)
PATCH = "L * s * F * exp(-((x - x_c)/w)^2 / 2)"
IN_METRES = {"F": "N", "x_c": "m", "w": "m"}


def path_of(s=1.0, load=1.2, mass=0.7):
    t = np.linspace(0, 0.12, 60)
    return Path(t, 0.05 + 4 * t, s * (4 - 30 * t), np.full(60, s), load, 1.5, mass=mass)


@pytest.fixture
def _undeclared():
    before = dict(DECLARED)
    yield
    DECLARED.clear()
    DECLARED.update(before)


# --- formulas


SAME = {
    "coulomb": ("F_c * L * s", {"F_c": "N"}, {}),
    "viscous": ("F_v * v", {"F_v": "N s/m"}, {}),
    "drag": ("c * v * abs(v)", {"c": "N s^2/m^2"}, {}),
    "stribeck": ("F_s * L * s * exp(-(abs(v)/v_s)^delta)", {"F_s": "N", "v_s": "m/s"}, {"delta": (0.5, 2.0)}),
    "patch": (PATCH, IN_METRES, {}),
    "texture": ("L*s*amplitude*sin(2*pi*x/period + phase)", {"period": "m", "phase": "rad"}, {}),
    "vibration": ("amplitude*sin(2*pi*frequency*t + phase)", {"frequency": "Hz", "phase": "rad"}, {}),
}


@pytest.mark.few(6)
@pytest.mark.parametrize("name", SAME)
@pytest.mark.parametrize("s", [1.0, -1.0])
def test_a_formula_equals_the_librarys_own_effect(name, s):
    text, units, bounds = SAME[name]
    mine, library = formula("mine", text, units=units, bounds=bounds), effects.get(name)
    values = (HIDDEN | BASE)[name]
    path = path_of(s)
    np.testing.assert_allclose(mine.columns(path, values), library.columns(path, values), rtol=1e-12, atol=1e-15)
    assert [p.name for p in mine.linear] == [p.name for p in library.linear]
    assert [p.loaded for p in mine.linear] == [p.loaded for p in library.linear]
    assert mine.scales_with == library.scales_with


@pytest.mark.parametrize(
    ("text", "linear", "nonlinear", "truth"),
    [
        ("a*x + b", "ab", "", lambda p: 1.3 * p.x - 0.7),
        ("k*(x - z)", "k", "z", lambda p: 1.3 * (p.x - 0.3)),
        ("-(a + b*x)/2 + c*v^2", "abc", "", lambda p: -(1.3 - 0.7 * p.x) / 2 + 0.4 * p.v**2),
        ("a*b*x", "a", "b", lambda p: 1.3 * 0.3 * p.x),
        ("F*exp(-b*x)", "F", "b", lambda p: 1.3 * np.exp(-0.3 * p.x)),
        ("a*t/(1 + b*t)", "a", "b", lambda p: 1.3 * p.t / (1 + 0.3 * p.t)),
        ("F*sin(q*t) + G*cos(q*t)", "FG", "q", lambda p: 1.3 * np.sin(0.3 * p.t) - 0.7 * np.cos(0.3 * p.t)),
        ("step(t - z/6)*J", "J", "z", lambda p: 1.3 * (p.t > 0.05)),
        ("min(x, z)*F - max(t, z)*F", "F", "z", lambda p: 1.3 * (np.minimum(p.x, 0.3) - np.maximum(p.t, 0.3))),
        ("-F^1 * 2^-x^2", "", "F", None),
    ],
)
def test_linear_parameters_are_found(text, linear, nonlinear, truth):
    bounds = dict.fromkeys(nonlinear, (0.1, 1.0))
    if not linear:
        with pytest.raises(FrictrackError, match="expected a parameter that multiplies the formula"):
            formula("mine", text, bounds=bounds)
        return
    made = formula("mine", text, bounds=bounds)
    assert [p.name for p in made.linear] == list(linear)
    assert [p.name for p in made.nonlinear] == list(nonlinear)
    path = path_of()
    columns = made.columns(path, dict.fromkeys(nonlinear, 0.3))
    np.testing.assert_allclose(columns @ [1.3, -0.7, 0.4][: len(linear)], truth(path), rtol=1e-12, atol=1e-14)


def test_a_formula_knows_the_run_and_the_constants():
    made = formula("weight", "mu * mass * g", units={"mu": "1"})
    np.testing.assert_allclose(made.columns(path_of(mass=0.7), {})[:, 0], 0.7 * GRAVITY)


HOSTILE = [
    "__import__('os').system('touch owned')",
    "F.__class__.__mro__",
    "F*x.real",
    "F*(lambda: 1)()",
    "F*[c for c in ().__class__.__base__.__subclasses__()][0]",
    "F*open(1)",
    "F*eval(1)",
    "F*exec(x)",
    "F*getattr(x, y)",
    "F*'a'*1000000000",
    "F; x",
    "F := x",
    "F if x else 1",
    "F and x",
    "F*x > 2",
    "F*exp(*x)",
    "F*exp(x=1)",
    "F*exp(x, 2)",
    "F*exp",
    "exp",
    "F*True",
    "F*1e400",
    "F*1j",
    "F*" + "9" * 400,
    "F*" + "-" * 300 + "x",
    "F*" + "exp(" * 100 + "x" + ")" * 100,
    "F**" * 90 + "2",
    "F*" + "x*" * 1000 + "x",
    "F x",
    "F*(x",
    "F//2",
    "F%2",
    "F@x",
    "F*~x",
    "F, x",
    "F*__builtins__",
    "F*x.__y",
    "await F",
    "yield F",
    "F*π",
    "",
    "   ",
    "2*x",
]


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: text[:24] or "empty")
def test_a_hostile_formula_is_refused_in_one_sentence_and_at_once(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with within(10), pytest.raises(FrictrackError) as caught:
        formula("mine", text)
    assert str(caught.value).startswith('[[effect]] "mine": ')
    assert "\n" not in str(caught.value)
    assert caught.value.usage
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["9^9^9^9^9*F", "F*exp(exp(exp(exp(x))))^9999999", "F*10^300*10^300"])
def test_a_power_cannot_hang_it_is_no_number_instead(text):
    made = formula("mine", text)
    with within(10), pytest.raises(FrictrackError, match="to be a number along every run but it is none at x ="):
        made.columns(path_of(), {})


@pytest.mark.parametrize(
    ("text", "keys", "said"),
    [
        ("F*x", {"units": {"G": "N"}}, 'unknown parameter "G"; the formula has F'),
        ("F*x", {"bounds": {"k": (0, 1)}}, 'unknown parameter "k"; the formula has F'),
        ("F*exp(-x/w)", {"units": {"w": "mm"}}, 'expected an SI unit of w, such as "m" or "N s/m", but got "mm"'),
        ("F*exp(-x/w)", {"units": {"w": "wibble"}}, 'expected an SI unit of w, such as "m" or "N s/m", but got "wib'),
        ("F*exp(-k*x)", {}, "expected bounds of k, which does not simply multiply the formula, or its unit"),
        ("exp(a*x)", {"bounds": {"a": (0, 1)}}, 'expected a parameter that multiplies the formula, as F in "F * (exp('),
        ("F*L + G/L", {}, "expected L, the load, to multiply a term as a whole"),
        (
            "F*expp(x)",
            {},
            "expected a function among sin, cos, tan, exp, log, sqrt, abs, tanh, atan, min, max, step but",
        ),
        ("F*$x", {}, 'expected a formula of numbers, names, + - * / ^ and brackets but got "$" in "F*$x"'),
        ("+".join("abcdefhijkl"), {}, "expected at most 10 parameters but got 11"),
    ],
)
def test_a_formula_that_makes_no_law_is_told_why(text, keys, said):
    with pytest.raises(FrictrackError) as caught:
        formula("mine", text, **keys)
    assert said in str(caught.value)


def test_a_comparison_is_answered_with_how_a_step_is_written():
    with pytest.raises(FrictrackError, match=r"write a step as \(1 \+ tanh"):
        formula("mine", "F * s * (x > x_c)", units={"x_c": "m"})


@pytest.mark.usefixtures("_undeclared")
def test_a_place_of_which_a_force_has_no_slope_is_said_to_need_one():
    @effects.effect(F="N", x_c=("m", 0.05, 0.25))
    def kerb(path, x_c):
        """A step of the friction at one place."""
        return path.s * (path.x > x_c)

    t = np.arange(0, 0.1, 1 / 2000)  # two speeds, decelerated by 4 m/s^2 before 0.12 m and by 5 behind it
    runs = []
    for v in (2.0, 3.0):
        reached = (v - np.sqrt(v**2 - 2 * 4.0 * 0.12)) / 4.0
        u = np.maximum(t - reached, 0.0)
        x = v * t - 2.0 * t**2 - 0.5 * u**2
        seen = x + 2e-6 * np.random.default_rng(0).standard_normal(len(t))
        runs.append(ft.Run.from_arrays(t, seen, mass=0.5, name=f"{v:g} m/s"))
    found = ft.fit(["coulomb", kerb], runs)
    assert found.parameters["kerb.F"].value == pytest.approx(0.5, abs=0.02)
    assert "no slope" in found.parameters["kerb.x_c"].reason  # and not: up to its bound the misfit rises by nothing


@pytest.mark.parametrize("unit", ["9**9**9**9**9", "m^9999999999", "1" * 5000, "__import__('os')", "m; s", "m*" * 3000])
def test_a_hostile_unit_or_tie_is_refused_at_once(unit):
    with within(25):
        with pytest.raises(FrictrackError, match="expected an SI unit of F"):
            formula("mine", "F*x", units={"F": unit})
        with pytest.raises(FrictrackError, match="tie: expected another parameter for F_c"):
            settings.read_settings({"effect": "coulomb", "tie": {"F_c": unit * 10}}).applied(effects.get("coulomb"))


@pytest.mark.parametrize("unit", ["N s^2/m^2", "N/m^3", "1/s", "kg m/s", "J", "W/K", "rad/s"])
def test_units_of_the_si_are_taken(unit):
    assert formula("mine", "F*x", units={"F": unit}).linear[0].unit == unit


def test_scans_of_a_formula_keep_to_bounds_or_to_what_the_runs_reach():
    made = formula("mine", PATCH, units=IN_METRES, bounds={"w": (1e-3, 0.1)})
    x_c, w = made.parameter("x_c").scan(SPAN), made.parameter("w").scan(SPAN)
    assert 0 < x_c.min() < x_c.max() < 0.4
    np.testing.assert_allclose([w[0], w[-1]], [1e-3, 0.1])
    assert len(x_c) * len(w) <= 3000
    assert np.ptp(np.diff(np.log(w))) < 1e-9  # by ratio, over two decades


def test_a_formula_is_fitted_as_the_librarys_effect_is():
    runs, _ = study("coulomb,viscous,patch", _patched(), sigma=1e-5, specs=(Spec(6.0), Spec(-5.5)))
    mine = formula("magnet", PATCH, units=IN_METRES, bounds={"w": (1e-3, 0.1)})
    ours = ft.fit(models.of(["coulomb", "viscous", mine]), runs).parameters
    library = ft.fit("coulomb,viscous,patch", runs).parameters
    for name in ("F", "x_c", "w"):
        known, found = library[f"patch.{name}"], ours[f"magnet.{name}"]
        assert abs(found.value - known.value) < 1e-3 * known.std
        assert found.std == pytest.approx(known.std, rel=1e-4)
        assert abs(found.value - HIDDEN["patch"][name]) < 4 * known.std


def _patched():
    return {"coulomb": BASE["coulomb"], "viscous": BASE["viscous"], "patch": HIDDEN["patch"]}


def test_a_fit_with_a_formula_comes_back_from_its_state():
    runs, _ = study("coulomb,viscous,patch", _patched(), sigma=1e-5, specs=(Spec(6.0),))
    mine = formula("magnet", PATCH, units=IN_METRES, bounds={"w": (1e-3, 0.1)})
    fitted = ft.fit(models.of(["coulomb", "viscous", mine]), runs)
    back = restore(runs, state(fitted))
    assert back.model == fitted.model
    np.testing.assert_array_equal(back.solution.p, fitted.solution.p)
    assert back.parameters["magnet.x_c"].std == pytest.approx(fitted.parameters["magnet.x_c"].std, rel=1e-9)


# --- declared functions


def declare():
    @ft.effect(F="N", x_c="m", w=("m", 1e-3, 0.1), scales_with="load")
    def magnet(path, x_c, w):
        """A magnet under the course."""
        return path.load * path.s * np.exp(-(((path.x - x_c) / w) ** 2) / 2)

    return magnet


@pytest.mark.usefixtures("_undeclared")
def test_a_declared_function_is_an_effect_by_its_name():
    magnet = declare()
    path = path_of()
    values = HIDDEN["patch"]
    np.testing.assert_array_equal(magnet.columns(path, values), effects.get("patch").columns(path, values))
    assert [(p.name, p.unit, p.linear, p.loaded) for p in magnet.parameters] == [
        ("F", "N", True, True),
        ("x_c", "m", False, False),
        ("w", "m", False, False),
    ]
    assert magnet.what == "A magnet under the course."
    assert models.parse("coulomb,magnet").effects[1] is magnet
    assert (models.tustin() + "magnet:2").names[-1] == "magnet:2"
    assert "magnet" in effects.known()
    assert "magnet" in [e["name"] for e in effects.catalogue()]
    assert magnet.equation == "F magnet(x_c, w)"


@pytest.mark.usefixtures("_undeclared")
def test_a_declared_effect_is_fitted_and_must_be_declared_again_when_its_fit_comes_back():
    runs, _ = study("coulomb,viscous,patch", _patched(), sigma=1e-5, specs=(Spec(6.0), Spec(-5.5)))
    fitted = ft.fit(models.of(["coulomb", "viscous", declare()]), runs)
    for name in ("F", "x_c", "w"):
        found = fitted.parameters[f"magnet.{name}"]
        assert abs(found.value - HIDDEN["patch"][name]) < 4 * found.std
    saved = state(fitted)
    again = restore(runs, saved).parameters["magnet.F"]  # the motion is solved again, to rounding
    assert again.value == pytest.approx(fitted.parameters["magnet.F"].value, rel=1e-12)
    DECLARED.clear()
    with pytest.raises(FrictrackError, match=r'"magnet".*must be declared again with @frictrack.effect'):
        restore(runs, saved)


DECLARATION = """
import frictrack as ft

@ft.effect(F="N")
def pull(path):
    return path.t

def plain(path):
    return path.x

renamed = ft.effect(F="N")(plain)
"""


@pytest.mark.usefixtures("_undeclared")
def test_declared_and_written_effects_survive_pickle_and_copy(tmp_path, monkeypatch):
    (tmp_path / "my_effects.py").write_text(DECLARATION)
    monkeypatch.syspath_prepend(tmp_path)
    import my_effects  # noqa: PLC0415

    path, twice = path_of(), lambda one: pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(one))))
    for one in (my_effects.pull, my_effects.pull.called("pull:2"), my_effects.renamed, formula("pull", "F * t")):
        for again in (twice(one), copy.deepcopy(one)):
            np.testing.assert_array_equal(again.columns(path, {}), one.columns(path, {}))
    local = declare()
    assert copy.deepcopy(local).columns == local.columns


@pytest.mark.usefixtures("_undeclared")
def test_several_columns_and_effects_on_the_picture():
    @ft.effect(acts_on="measurement", a="m", b="m")
    def waves(path):
        return np.column_stack([np.sin(path.t), np.cos(path.t)])

    assert [p.name for p in waves.linear] == ["a", "b"]
    assert waves.acts_on == "measurement"
    assert waves.columns(path_of(), {}).shape == (60, 2)


@pytest.mark.usefixtures("_undeclared")
def test_a_declaration_that_does_not_go_together_is_told_why():
    def none(path, x_c):
        return path.x

    def texture(path):
        return path.x

    def short(path):
        return path.x[1:]

    with pytest.raises(FrictrackError, match='none: expected every parameter with its unit, as in x_c="m"'):
        ft.effect(F="N")(none)
    with pytest.raises(FrictrackError, match='none: expected a coefficient of what it returns, such as F="N"'):
        ft.effect(x_c="m")(none)
    with pytest.raises(FrictrackError, match='none: about: unknown field "keeps"; known are '):
        ft.effect(F="N", x_c="m", about={"keeps": "its place"})(none)
    with pytest.raises(FrictrackError, match='none: about: expected a "state" beside "memory"'):
        ft.effect(F="N", x_c="m", about={"memory": True})(none)
    with pytest.raises(FrictrackError, match=r'none: expected bounds of x_c, as in x_c=\("1", 0.0, 1.0\)'):
        ft.effect(F="N", x_c="1")(none)
    with pytest.raises(
        FrictrackError, match='expected a name of its own for your effect but "texture" is one of the lib'
    ):
        ft.effect(F="N")(texture)
    with pytest.raises(
        FrictrackError, match=r"short: expected columns of shape \(60, 1\), one for each coefficient, but"
    ):
        ft.effect(F="N")(short).columns(path_of(), {})
