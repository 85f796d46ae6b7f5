"""Match the columns of a table by name: exactly, by a name with a unit, or by a guess that the user confirms."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise

from frictrack.base.errors import result_or_none
from frictrack.base.units import parse_quantity
from frictrack.study.schema import COLUMNS as RECORD_COLUMNS
from frictrack.study.schema import POINT_COLUMNS

_LABEL = r"(?:(?:run|trial|set|data set|versuch|messung|essai)\s*#?\s*\w+|#?\d+)"
UNIT = re.compile(
    rf"[(\[（]\s*([^()\[\]（）]*[^\W\d_°][^()\[\]（）]*?|°)\s*[)\]）](?=\s*$|\s+{_LABEL}\s*$)", re.IGNORECASE
)
"""Unit in a header: "pos (mm)", "Position [mm]", "Time (s) Run #1"; or the size of a count: "encoder (5 um)"."""
_LAST_WORD_UNIT = re.compile(r"(?<=\w)\s*(?:_|/|\s(?:in|en)\s)\s*(m?s|[µu]s|[mcµun]?m|[mk]?N|px)$")
"""Unit without brackets: "Weg / mm", "time in ms", "force_N"."""
# What tells one of several runs in a table: "Data Set 1: Time (s)", "Time (s) Run #1", and a repeated "Time (s).1".
_RUN_LABEL = re.compile(rf"^.*:|^{_LABEL}(?=[\s,;_-])|\b{_LABEL}$|\s*#?\d+$|\.\d+$|[ _][a-h]$", re.IGNORECASE)
_COUNT = re.compile(
    r"\s*/?\s*\b(counts?|cts?|inc(rements?)?|inkremente?|pulses?|imp(ulse)?|ticks?|digits?|lsb|steps?)\b", re.I
)
_WRITTEN_OUT = re.compile(r"[A-Z][a-z]{4,}")  # "Meters", as LabVIEW has it
_DEGREES = ("deg", "°", "degree", "degrees", "Grad")
# Units of a position that is an angle, in rad.
ANGLES = {"rad": 1.0, "mrad": 1e-3, "rev": math.tau, "turns": math.tau} | dict.fromkeys(_DEGREES, math.pi / 180)
# Usual names of a column, in English, German, French, Spanish, Chinese and Japanese; "/x" ends those of one program.
_USUAL_NAMES = {
    "t": re.compile(r"t|time|times?tamps?|elapsed time|time stamp|zeit(stempel)?|micros|millis|temps|tiempo|时间|時間"),
    "x": re.compile(
        r"x|pos(ition)?|x[ _]?pos(ition)?|pos(ition)?[ _]?x|disp(lacement)?|d[ée]placement|distance|weg|.*/x|x_target"
        r"|verschiebung|位移|位置|距离|変位"
    ),
    "y": re.compile(r"y|y[ _]?pos(ition)?|pos(ition)?[ _]?y|.*/y"),
    "friction": re.compile(r"friction([ _]force)?|reib(ungs)?kraft|tangential[ _](force|kraft)|摩擦力"),
    "drive": re.compile(r"driv(e|ing)([ _]force)?|antriebs?(kraft)?|zugkraft|pull(ing)?[ _]force|驱动力"),
}
# Of a turning speed.
TURNS = re.compile(r"rpm|drehzahl|(r|rev|u|1)/min|min\^?-1|rps|1/s|hz|(rad|deg|°)/s", re.IGNORECASE)
_NAMES_OF_POINTS = {
    "v": re.compile(
        r"v|(sliding |set )?(speed|velocity)|v_m_s|(gleit)?geschwindigkeit|vitesse|velocidad|速度|rpm|drehzahl"
    ),
    "friction": re.compile(r"f|f_?[frtx]|(friction|tangential|mean)?[ _]?(force|friction)|friction_n|reibkraft|摩擦力"),
    "mu": re.compile(
        r"mu|[µμ]|co?f|cof|(friction coefficient|coefficient of friction)|reibwert|reib(ungs)?zahl|摩擦系数"
    ),
    "sigma_friction": re.compile(r"std|sd|sigma(_f(riction)?)?(_n)?|uncertainty|error|standard deviation"),
    "load": re.compile(r"load|normal (load|force)|f_?[nz]|load_n|normalkraft|last"),
}
REQUIRED = ("t", "x")
COLUMNS = RECORD_COLUMNS | POINT_COLUMNS
CAMERA_UNITS = {"px": "m", "frames": "s"}  # units that only the camera knows, and the unit they stand for
CAMERA_WORDS = {"frame": "frames", "pixel": "px", "pixels": "px"}


def stated_unit(header: str) -> str | None:
    """Return the unit that a header states, or None.

    Examples
    --------
    >>> stated_unit("Position (mm)"), stated_unit("Weg / mm"), stated_unit("force_N"), stated_unit("mass_A")
    ('mm', 'mm', 'N', None)
    >>> stated_unit("encoder (counts)"), stated_unit("encoder (5 um/count)"), stated_unit("stamp (Frame)")
    (None, '5 um', 'frames')

    """
    found = UNIT.search(header) or _LAST_WORD_UNIT.search(header)
    unit = _COUNT.sub("", found[1]).strip() if found else ""
    unit = unit.lower() if _WRITTEN_OUT.fullmatch(unit) else unit
    return CAMERA_WORDS.get(unit, unit) or None


def unit_size(unit: str, si: str, what: str) -> float:
    """Return the size of a unit, or of a count such as "5 um", in an SI unit; an angle for a length is in rad.

    Examples
    --------
    >>> unit_size("5 um", "m", "encoder"), unit_size("rad", "m", "angle")
    (5e-06, 1.0)

    """
    number, name = _number_and_unit(unit)
    if si == "m" and name in ANGLES:
        return ANGLES[name] * float(number or 1)
    return parse_quantity(f"{number or 1} {name}", si, what)[0]


def _number_and_unit(size: str) -> tuple[str, str]:
    unit = size.lstrip("0123456789.,")
    return size[: len(size) - len(unit)], unit.strip()


def is_angle(header: str) -> bool:
    """Return whether a column of positions holds angles, by its unit."""
    return _number_and_unit(stated_unit(header) or "")[1] in ANGLES


def radius(header: str) -> tuple[float, float] | None:
    """Return the radius, m, of a wheel whose angle a column holds, and the angle, rad, that the header counts by.

    Examples
    --------
    >>> radius("Wheel (25 mm/rad)"), radius("Wheel (deg)")
    ((0.025, 1.0), None)

    """
    length, _, angle = (stated_unit(header) or "").partition("/")
    size = ANGLES.get(angle.strip())
    return None if size is None else (unit_size(length, "m", header) / size, size)


def is_speed(header: str) -> bool:
    """Return whether a column holds speeds, by its unit.

    Examples
    --------
    >>> is_speed("speed (mm/s)"), is_speed("x (mm)"), is_speed("v")
    (True, False, False)

    """
    unit = stated_unit(header)
    return unit is not None and "/" in unit and may_hold(header, "v")


def base_name(header: str) -> str:
    """Return a header without its unit.

    Examples
    --------
    >>> base_name("Position (mm)"), base_name("Weg / mm")
    ('Position', 'Weg')

    """
    return _LAST_WORD_UNIT.sub("", UNIT.sub("", header)).strip()


def quantity(header: str) -> str:
    """Return what a column holds, in small letters: its header without its unit and the label of a run.

    Examples
    --------
    >>> quantity("Data Set 1: Time (s)"), quantity("Position (m) Run #2"), quantity("x")
    ('time', 'position', 'x')

    """
    return _RUN_LABEL.sub("", base_name(header).casefold()).strip()


def runs_of_columns(present: Sequence[str]) -> list[dict[str, str]]:
    """Return the columns of every run of a table that holds several, side by side; empty if it does not.

    Every column of times begins a run; each run has a column of positions.

    Examples
    --------
    >>> runs_of_columns(["t 1 (s)", "x 1 (mm)", "t 2 (s)", "x 2 (mm)"])
    [{'t': 't 1 (s)', 'x': 'x 1 (mm)'}, {'t': 't 2 (s)', 'x': 'x 2 (mm)'}]

    """
    clocks = [i for i, header in enumerate(present) if _USUAL_NAMES["t"].fullmatch(quantity(header))]
    labelled = [
        h for h in present if re.search(rf"\b{_LABEL}$", base_name(h), re.I) and stated_unit(h) and may_hold(h, "x")
    ]
    if len(clocks) == 1 and len(labelled) > 1 and len({re.sub(r"\w+$", "", base_name(h)) for h in labelled}) == 1:
        return [{"t": present[clocks[0]], "x": header} for header in labelled]  # one clock for all
    blocks = [present[i:j] for i, j in pairwise([*clocks, len(present)])]
    lengths = [next((h for h in block if stated_unit(h) and may_hold(h, "x")), None) for block in blocks]
    found = [guess_columns(block, quantity) for block in blocks]
    for columns, header in zip(found, lengths, strict=True):
        if header is not None:
            columns.setdefault("x", header)
    whole = len(found) > 1 and all(run.keys() >= set(REQUIRED) for run in found)
    return found if whole else []


def guess_points(present: Sequence[str]) -> dict[str, str]:
    """Guess the columns of points (v, F) at constant speeds, by usual names, else by units; empty if it holds none.

    Examples
    --------
    >>> guess_points(["speed (mm/s)", "COF", "load (N)"])
    {'v': 'speed (mm/s)', 'mu': 'COF', 'load': 'load (N)'}
    >>> guess_points(["t (s)", "speed (mm/s)", "force (N)"])
    {}

    """
    if any(_USUAL_NAMES[k].fullmatch(quantity(h)) and may_hold(h, k) for k in REQUIRED for h in present):
        return {}
    found = {}
    for key, names in _NAMES_OF_POINTS.items():
        named = [h for h in present if names.fullmatch(base_name(h).casefold()) and (key == "v" or may_hold(h, key))]
        if len(named) == 1:
            found[key] = named[0]
    for key in ("v",) if "mu" in found else ("v", "friction"):
        in_unit = [h for h in present if h not in found.values() and UNIT.search(h) and may_hold(h, key)]
        if key not in found and len(in_unit) == 1:
            found[key] = in_unit[0]
    if not ("v" in found and found.keys() & {"friction", "mu"}):
        return {}
    if "friction" in found:
        found.pop("mu", None)
    elif "sigma_friction" in found:
        found["sigma_mu"] = found.pop("sigma_friction")
    unit, sigma = UNIT.search(found.get("friction", "")), found.get("sigma_friction", "")
    if sigma and unit and not UNIT.search(sigma):
        found["sigma_friction"] = f"{sigma} ({unit[1]})"  # that of what it is the deviation of
    return found


def is_named_speed(header: str) -> bool:
    """Return whether a column holds speeds along the course, by its unit or its usual name."""
    return is_speed(header) or bool(_NAMES_OF_POINTS["v"].fullmatch(header.casefold()) and not TURNS.fullmatch(header))


def find_header(written: str, present: Sequence[str]) -> str | None:
    """Return the header of the table that a name means, or None.

    Examples
    --------
    >>> find_header("pos (mm)", ["t", "pos"]), find_header("pos", ["t", "pos (mm)"]), find_header("x", ["t"])
    ('pos', 'pos (mm)', None)
    >>> find_header("U (35 N)", ["U (V)"]), find_header("U (N)", ["U (V)"])
    ('U (V)', None)

    """
    if written in present:
        return written
    base = UNIT.sub("", written).strip()
    if base != written and base in present:
        return base
    of_size = radius(written) or _number_and_unit(stated_unit(written) or "")[0]  # "U (35 N)" of "U (V)": N per volt
    alike = [header for header in present if base_name(header) == (base if of_size else written)]
    return alike[0] if len(alike) == 1 else None


def guess_columns(present: Sequence[str], name: Callable[[str], str] = base_name) -> dict[str, str]:
    """Guess time, position, height and friction by the usual names; a name that could be two columns is left out.

    Examples
    --------
    >>> guess_columns(["Time (ms)", "Position (mm)", "F"])
    {'t': 'Time (ms)', 'x': 'Position (mm)'}

    """
    found = {}
    for key, names in _USUAL_NAMES.items():
        alike = [h for h in present if names.fullmatch(name(h).casefold()) and may_hold(h, key)]
        alike = [h for h in alike if name(h).casefold() == key] or alike  # "X" beside a "Distance"
        if len(alike) == 1 or (alike and key in REQUIRED and alike[0].endswith("/X")):
            found[key] = alike[0]
    return found


def unnamed_force(heads: Sequence[str], named: Collection[str]) -> str | None:
    """Return the first header of a force along the course that no short name stands for; None if there is none."""
    forces = (h for h in heads if h not in named and stated_unit(h) and may_hold(h, "friction"))
    return next((h for h in forces if not re.match(r"normal|load|f_?[nz]\b", base_name(h), re.IGNORECASE)), None)


def may_hold(header: str, key: str) -> bool:
    """Return whether the unit of a column, if it states one, is that of a short name.

    Examples
    --------
    >>> may_hold("Laser (mm)", "x"), may_hold("Force (N)", "x"), may_hold("Force", "x")
    (True, False, True)

    """
    unit = stated_unit(header)
    if unit is None or CAMERA_UNITS.get(unit) == COLUMNS[key][1]:
        return True
    return result_or_none(unit_size, unit, COLUMNS[key][1], header) is not None


def has_units(columns: Mapping[str, str]) -> bool:
    """Return whether every header states its unit, or needs none."""
    return all(_with_unit(key, header) == header for key, header in columns.items())


def columns_line(columns: Mapping[str, str]) -> str:
    """Return the line of a study file that names columns; the SI unit stands where the header has none.

    Examples
    --------
    >>> columns_line({"t": "Time (ms)", "x": "pos"})
    'columns = {t = "Time (ms)", x = "pos (m)"}'

    """
    cells = (f"{key} = {json.dumps(_with_unit(key, header), ensure_ascii=False)}" for key, header in columns.items())
    return f"columns = {{{', '.join(cells)}}}"


def _with_unit(key: str, header: str) -> str:
    standard, si = COLUMNS[key]
    needs_none = TURNS.fullmatch(header) or si == "1" or (header == standard and key in POINT_COLUMNS)
    return header if stated_unit(header) or needs_none else f"{header} ({si})"
