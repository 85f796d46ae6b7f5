"""Effects of a user: a formula in the study file, or a Python function.

    F * exp(-((x - x_c)/w)^2)

A formula is read by `simpleeval` along a list of what is allowed (numbers, names, + - * / ^, a dozen functions), never
by Python itself: no attribute, no call of anything else, and every number is a float, so that a power cannot hang. A
parameter is linear where the formula is a sum of such parameters times something.

    @ft.effect(F="N", x_c="m", w=("m", 1e-3, 0.1))
    def magnet(path, x_c, w):
        '''A magnet under the course pulls the mass in.'''
        return path.s * np.exp(-(((path.x - x_c) / w) ** 2))

Parameters that the function takes are non-linear. The others (F) are the coefficients of the columns that it returns.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import combinations
from typing import Any, Literal, NoReturn

import numpy as np
from simpleeval import SimpleEval

from frictrack.base.arguments import checked
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.units import is_coherent
from frictrack.effects.definition import CONSTANTS, Effect, Nonlinear, Parameter, Path
from frictrack.effects.ranges import Span, frequencies
from frictrack.effects.registry import DECLARED, is_library
from frictrack.records import Array

VARIABLES = ("t", "x", "v", "s", "L", "mass")  # of a `Path`; L is the load, s the direction of motion
FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "abs", "tanh")},
    "atan": np.arctan,
    "min": np.minimum,
    "max": np.maximum,
    "step": lambda z: np.heaviside(z, 0.5),
}
ARGUMENTS = {"min": 2, "max": 2}
OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: lambda base, power: np.power(np.asarray(base, dtype=float), power),
    ast.USub: np.negative,
    ast.UAdd: np.positive,
}
ALLOWED = re.compile(r"[\w\s.,()+*/^-]*", re.ASCII)
NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
LONGEST, DEEPEST, MOST_PARAMETERS = 500, 60, 10
FORMS = 3000  # tried in a scan over all non-linear parameters together
WHERE = '[[effect]] "{}": '
OPEN = (-np.inf, np.inf)
ZERO = -1
N_SCAN_VALUES = 41


@checked
def formula(
    name: str,
    text: str,
    *,
    units: Mapping[str, str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    acts_on: Literal["force", "measurement"] = "force",
) -> Effect:
    """The effect that a formula defines: N added to the friction force, or m to what the camera sees.

    The formula may use t (s since release), x (m), v (m/s), s (direction of motion, +1 or -1), L (normal load over its
    reference), mass (kg), g, pi and `FUNCTIONS`; every other name is a parameter. `units` and `bounds` are by
    parameter, SI. Raises FrictrackError (usage) for what is no such formula.
    """
    tree = _read(name, text)
    parameters = _parameters(tree)
    units, bounds = units or {}, bounds or {}
    _check(name, parameters, units, bounds)
    linear = _linear(tree, parameters)
    if not linear:
        _refuse(name, f'expected a parameter that multiplies the formula, as F in "F * ({text})", but it has none')
    searched = max(len(parameters) - len(linear), 1)
    count = int(FORMS ** (1 / searched))
    loads = {p: _loaded(name, tree, p, linear) for p in linear}
    made = [Parameter(p, units.get(p, "1"), bounds.get(p, OPEN), linear=True, loaded=loads[p]) for p in linear]
    for p in parameters:
        if p not in linear:
            unknown = (
                f"{WHERE.format(name)}expected bounds of {p}, which does not simply multiply the formula, or its unit, "
                f'but got neither; give units = {{{p} = "m"}} or bounds = {{{p} = [low, high]}}'
            )
            made.append(_searched(p, units.get(p, "1"), bounds.get(p, OPEN), count, unknown))
    return Effect(
        name=name,
        acts_on=acts_on,
        equation=("" if acts_on == "force" else "y: ") + " ".join(text.split()),
        parameters=tuple(made),
        columns=Formula(name, text, tuple(linear)),
        varies_with="xv",
        scales_with="load" if any(loads.values()) else "nothing",
        may_pull=True,
        what="An effect of your own, given as a formula.",
        source="the study file",
        formula=text,
    )


@dataclass(frozen=True)
class Formula:
    """Columns of a formula: one per linear parameter."""

    name: str
    text: str
    linear: tuple[str, ...]

    def __call__(self, path: Path, nonlinear: Nonlinear) -> Array:
        """What the formula is per unit of each linear parameter, shape (n, k).

        Raises FrictrackError where it is no finite number.
        """
        known = {name: getattr(path, name) for name in ("t", "x", "v", "s", "mass")} | {"L": path.load}
        if path.mass is None and re.search(r"\bmass\b", self.text):
            raise FrictrackError(
                f"{WHERE.format(self.name)}expected the mass of every run, which the formula uses; give mass"
            )
        known |= CONSTANTS | {name: value for name, value in nonlinear.items() if name not in self.linear}
        columns = np.empty((len(path.t), len(self.linear)))
        for j, one in enumerate(self.linear):
            columns[:, j] = self._evaluated(known | {name: float(name == one) for name in self.linear})
        if not np.all(np.isfinite(columns)):
            at = int(np.flatnonzero(~np.isfinite(columns).all(axis=1))[0])
            raise FrictrackError(
                f"{WHERE.format(self.name)}expected the formula to be a number along every run but it is none at "
                f"x = {path.x[at]:.4g} m, v = {path.v[at]:.4g} m/s, t = {path.t[at]:.4g} s; narrow its bounds"
            )
        return columns

    def _evaluated(self, names: Mapping[str, Any]) -> Any:
        evaluator = SimpleEval(operators=OPERATORS, functions=FUNCTIONS, names=dict(names))
        with np.errstate(all="ignore"):
            return evaluator.eval(self.text, previously_parsed=_tree(self.text))


@cache
def _tree(text: str) -> ast.expr:
    """The formula as a tree, ^ read as a power."""
    statement = SimpleEval.parse(" ".join(text.replace("^", "**").split()))
    if not isinstance(statement, ast.Expr):
        raise SyntaxError("no expression")
    return statement.value


def _refuse(name: str, what: str) -> NoReturn:
    raise UsageError(WHERE.format(name) + what)


def _read(name: str, text: str) -> ast.expr:
    """The checked tree of a formula; raises FrictrackError (usage) for anything that is not allowed."""
    if not text.strip() or len(text) > LONGEST:
        _refuse(name, f"expected a formula of 1 to {LONGEST} characters but got {len(text)}")
    if not ALLOWED.fullmatch(text):
        odd = next(c for c in text if not ALLOWED.fullmatch(c))
        step = "; write a step as (1 + tanh((x - c)/w))/2, or step(x - c) where c is known" if odd in "<>=" else ""
        _refuse(name, f'expected a formula of numbers, names, + - * / ^ and brackets but got "{odd}" in "{text}"{step}')
    try:
        tree = _tree(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        _refuse(name, f'expected a formula, as in "F * exp(-((x - x_c)/w)^2)", but got "{text}"')
    _walk(name, tree)
    return tree


def _walk(name: str, tree: ast.expr) -> None:
    """Look at every node of a tree, none deeper than `DEEPEST`."""
    nodes: list[tuple[ast.AST, int]] = [(tree, 0)]
    while nodes:
        node, depth = nodes.pop()
        if depth > DEEPEST:
            _refuse(name, f"expected a formula nested at most {DEEPEST} deep; break a long one into two effects")
        fault = _fault(node)
        if fault:
            _refuse(name, fault)
        nodes += [(child, depth + 1) for child in _inside(node)]


def _inside(node: ast.AST) -> list[ast.expr]:
    if isinstance(node, ast.BinOp):
        return [node.left, node.right]
    if isinstance(node, ast.UnaryOp):
        return [node.operand]
    return list(node.args) if isinstance(node, ast.Call) else []


def _fault(node: ast.AST) -> str:
    """What is wrong with one node; "" where nothing is."""
    if isinstance(node, ast.Call):
        return _call_fault(node)
    if isinstance(node, ast.BinOp | ast.UnaryOp):
        known = type(node.op) in OPERATORS
        return "" if known else "expected only + - * / ^ as operators but got another one"
    if isinstance(node, ast.Constant):
        number = node.value if isinstance(node.value, int | float) and not isinstance(node.value, bool) else np.inf
        return "" if abs(number) < 1e300 else f"expected a number but got {str(node.value)[:20]}"
    if isinstance(node, ast.Name):
        plain = NAME.fullmatch(node.id) and node.id not in FUNCTIONS and "__" not in node.id
        return "" if plain else f'expected the name of a variable or parameter but got "{node.id}"'
    return f"expected numbers, names, functions and + - * / ^ but got {_WORDS.get(type(node), 'something else')}"


_WORDS: dict[type, str] = {ast.Attribute: "an attribute (a dot behind a name)", ast.Tuple: "a comma outside a function"}


def _call_fault(node: ast.Call) -> str:
    if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
        asked = node.func.id if isinstance(node.func, ast.Name) else "something else"
        return f'expected a function among {", ".join(FUNCTIONS)} but got "{asked}"; a product needs a *'
    wanted = ARGUMENTS.get(node.func.id, 1)
    if node.keywords or len(node.args) != wanted:
        return f"expected {wanted} argument{'s' * (wanted > 1)} of {node.func.id} but got {len(node.args)}"
    return ""


def _parameters(tree: ast.expr) -> list[str]:
    """All names that are neither variables nor constants, as they are met in the text."""
    found = sorted((n.col_offset, n.id) for n in ast.walk(tree) if isinstance(n, ast.Name))
    known = (*VARIABLES, *CONSTANTS, *FUNCTIONS)
    return list(dict.fromkeys(name for _, name in found if name not in known))


def _check(
    name: str, parameters: Sequence[str], units: Mapping[str, str], bounds: Mapping[str, tuple[float, float]]
) -> None:
    if not parameters:
        _refuse(name, "expected a formula with at least one parameter to fit but all its names are variables")
    if len(parameters) > MOST_PARAMETERS:
        _refuse(name, f"expected at most {MOST_PARAMETERS} parameters but got {len(parameters)}")
    for key in (*units, *bounds):
        if key not in parameters:
            _refuse(name, f'unknown parameter "{key}"; the formula has {", ".join(parameters)}')
    for key, (low, high) in bounds.items():
        if not low < high:
            _refuse(name, f"bounds: expected the lower bound of {key} below the upper one but got [{low:g}, {high:g}]")
    for key, unit in units.items():
        if not is_coherent(unit):
            _refuse(name, f'units: expected an SI unit of {key}, such as "m" or "N s/m", but got "{unit}"')


Degree = int | None  # power in which some names multiply a term; ZERO where it vanishes with them, None where neither


def _linear(tree: ast.expr, parameters: Sequence[str]) -> list[str]:
    """As many parameters as the formula is a plain sum over, each times something; of equally many the first."""
    for size in range(len(parameters), 0, -1):
        for some in combinations(parameters, size):
            if _degree(tree, set(some)) == 1:
                return list(some)
    return []


def _loaded(name: str, tree: ast.expr, parameter: str, linear: Sequence[str]) -> bool:
    """Whether the column of a linear parameter carries the load L; raises where L does not simply multiply it."""
    degree = _degree(tree, {"L"}, set(linear) - {parameter})
    if degree is None:
        _refuse(name, "expected L, the load, to multiply a term as a whole, as in L * s * F")
    return degree == 1


def _degree(node: ast.expr, ones: Collection[str], zeros: Collection[str] = ()) -> Degree:
    """Power with which the names `ones` multiply an expression in which `zeros` are 0."""
    if isinstance(node, ast.Name):
        return ZERO if node.id in zeros else int(node.id in ones)
    if isinstance(node, ast.UnaryOp):
        return _degree(node.operand, ones, zeros)
    if isinstance(node, ast.Call):
        return 0 if all(_degree(a, ones, zeros) in (0, ZERO) for a in node.args) else None
    if isinstance(node, ast.BinOp):
        return _joined(node.op, _degree(node.left, ones, zeros), _degree(node.right, ones, zeros))
    return 0


def _joined(op: ast.operator, left: Degree, right: Degree) -> Degree:
    if left is None or right is None:
        return None
    if isinstance(op, ast.Add | ast.Sub):
        return max(left, right) if ZERO in (left, right) or left == right else None
    if isinstance(op, ast.Mult):
        both = ZERO if ZERO in (left, right) else left + right
        return both if both <= 1 else None
    if isinstance(op, ast.Div):
        return left if right == 0 else None
    return 0 if left == right == 0 else None


def _searched(p: str, unit: str, bounds: tuple[float, float], count: int, unknown: str) -> Parameter:
    """A non-linear parameter; refused with the sentence `unknown` where neither unit nor bounds say where it may be."""
    scan = Places(unit, bounds, count)
    if not scan.known:
        raise UsageError(unknown)
    return Parameter(p, unit, bounds, scan=scan, signed=unit == "m")


@dataclass(frozen=True)
class Places:
    """Scan of a parameter: evenly between its bounds (by ratio over more than a decade), else what the runs reach."""

    unit: str
    bounds: tuple[float, float]
    count: int

    @property
    def known(self) -> bool:
        """Whether there is anything to go by."""
        return bool(np.all(np.isfinite(self.bounds))) or self.unit in ("m", "s", "m/s", "Hz", "rad")

    def __call__(self, span: Span) -> Array:
        """Values worth trying."""
        low, high = self.bounds
        if np.all(np.isfinite(self.bounds)):
            wide = low > 0 and high > 10 * low
            return np.geomspace(low, high, self.count) if wide else np.linspace(low, high, self.count)
        if self.unit == "Hz":
            return frequencies(span)
        if self.unit == "rad":
            return np.arange(-6, 6) * np.pi / 6
        reach = {"m": (span.x_min, span.x_max), "s": (0.0, span.duration), "m/s": (span.v_min, span.v_max)}[self.unit]
        edges = np.linspace(*reach, min(self.count, 121) + 1)
        middle: Array = (edges[1:] + edges[:-1]) / 2  # never zero width at a round number
        inside = middle[(middle > low) & (middle < high)]
        return inside if len(inside) else middle


Declared = str | tuple[str, float, float] | Parameter  # unit; unit and bounds; or everything


@dataclass(frozen=True)
class FunctionColumns:
    """The function of a user, its result checked and brought to shape (n, k)."""

    function: Callable[..., Array]
    taken: tuple[str, ...]
    count: int

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the function by the place where it is found: in its module the effect has taken its name."""
        function = self.function
        if isinstance(getattr(sys.modules.get(function.__module__), function.__qualname__, None), Effect):
            function.__qualname__ += ".columns.function"
        return super().__reduce_ex__(protocol)

    def __call__(self, path: Path, nonlinear: Nonlinear) -> Array:
        """One column per coefficient."""
        made = np.asarray(self.function(path, **{name: nonlinear[name] for name in self.taken}), dtype=float)
        made = made[:, None] if made.ndim == 1 else made
        if made.shape != (len(path.t), self.count):
            name = getattr(self.function, "__name__", "the function")
            raise FrictrackError(
                f"{name}: expected columns of shape ({len(path.t)}, {self.count}), one for each coefficient, "
                f"but got {made.shape}"
            )
        return made


@checked
def effect(
    *,
    acts_on: Literal["force", "measurement"] = "force",
    scales_with: Literal["nothing", "load", "mass"] = "nothing",
    about: Mapping[str, Any] | None = None,
    **parameters: Declared,
) -> Callable[[Callable[..., Array]], Effect]:
    """Declare a function as an effect, which its name stands for from then on in models, studies and commands.

    Parameters
    ----------
    acts_on : {"force", "measurement"}
        Whether the columns are forces, N, or errors of the measured position, m.
    scales_with : {"nothing", "load", "mass"}
        What carries its size from one run to another. With "load" the function multiplies by ``path.load``.
    about : mapping, optional
        Further fields of `Effect`, which the effects of the library have too: `looks_like`, `confirm`, `invariant`,
        `plausible`, `describe` and so on.
    **parameters
        Every parameter by its unit, by (unit, lowest, highest), or as a `Parameter`. Those that the function takes are
        non-linear; each of the others is the coefficient of one column (n, k) that the function returns.

    Returns
    -------
    callable
        A decorator that returns the `Effect`. Its `what` is the docstring of the function.

    Raises
    ------
    FrictrackError
        For a name of the library, a parameter without a unit, no coefficient, or an unknown field in `about`.

    Examples
    --------
    >>> import numpy as np
    >>> @effect(F="N", x_c="m", w=("m", 1e-3, 0.1), about={"invariant": "a magnet keeps its place"})
    ... def magnet(path, x_c, w):
    ...     '''A magnet under the course pulls the mass in.'''
    ...     return path.s * np.exp(-(((path.x - x_c) / w) ** 2))
    >>> magnet.equation, magnet.invariant
    ('F magnet(x_c, w)', 'a magnet keeps its place')
    >>> del DECLARED["magnet"]

    """

    def declare(function: Callable[..., Array]) -> Effect:
        name = function.__name__
        taken = tuple(inspect.signature(function).parameters)[1:]
        linear = [p for p in parameters if p not in taken]
        _check_declared(name, taken, linear, parameters)
        loaded = scales_with == "load"
        made = tuple(_declared_parameter(name, p, parameters[p], p in linear, loaded) for p in (*linear, *taken))
        found = Effect(
            name=name,
            acts_on=acts_on,
            equation=("y: " * (acts_on == "measurement"))
            + " + ".join(f"{p} {name}({', '.join(taken)})" for p in linear),
            parameters=made,
            columns=FunctionColumns(function, taken, len(linear)),
            scales_with=scales_with,
            may_pull=True,
            what=inspect.getdoc(function) or "An effect of your own.",
            source="declared in Python",
        )
        DECLARED[name] = replace(found, **_checked_fields(name, about or {}))
        return DECLARED[name]

    return declare


def _checked_fields(name: str, about: Mapping[str, Any]) -> Mapping[str, Any]:
    allowed = {f.name for f in fields(Effect)} - {"name", "acts_on", "parameters", "columns", "scales_with", "formula"}
    unknown = [key for key in about if key not in allowed]
    if unknown:
        raise UsageError(f'{name}: about: unknown field "{unknown[0]}"; known are {", ".join(sorted(allowed))}')
    if about.get("memory") and about.get("state") is None:
        raise UsageError(
            f'{name}: about: expected a "state" beside "memory": a function of path and values that gives '
            "what the effect remembers at every sample, (n, k), from path.begin (P, k) at each of path.starts on"
        )
    return about


def _check_declared(name: str, taken: tuple[str, ...], linear: list[str], parameters: dict[str, Declared]) -> None:
    if is_library(name):
        raise UsageError(f'expected a name of its own for your effect but "{name}" is one of the library')
    lost = [p for p in taken if p not in parameters]
    if lost:
        raise UsageError(f'{name}: expected every parameter with its unit, as in {lost[0]}="m"')
    if not linear:
        raise UsageError(
            f'{name}: expected a coefficient of what it returns, such as F="N", which is no argument of the function'
        )


def _declared_parameter(name: str, p: str, declared: Declared, linear: bool, loaded: bool) -> Parameter:
    if isinstance(declared, Parameter):
        return Parameter(**vars(declared) | {"name": p, "linear": linear})
    unit, bounds = (
        (declared, OPEN) if isinstance(declared, str) else (declared[0], (float(declared[1]), float(declared[2])))
    )
    if linear:
        return Parameter(p, unit, bounds, linear=True, loaded=loaded)
    unknown = f'{name}: expected bounds of {p}, as in {p}=("{unit}", 0.0, 1.0)'
    return _searched(p, unit, bounds, N_SCAN_VALUES, unknown)
