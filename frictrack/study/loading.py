"""Read a study file into a frozen `Study`; all faults are reported at once, each with its table and line."""

from __future__ import annotations

import math
import os
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from frictrack.base.errors import UsageError, describe_fault, suggest
from frictrack.base.files import MAX_NAME_LENGTH, is_file_name, read_small_text
from frictrack.settings.costs import DEFAULT_COSTS, Costs
from frictrack.settings.priors import Prior
from frictrack.study import schema

TABLES = {name: (get_args(f.annotation) or (f.annotation,))[0] for name, f in schema.StudyFile.model_fields.items()}
NO_RUN = (
    "expected at least one [[run]] but got none; `frictrack init FOLDER` writes an example, and `frictrack plan STUDY` "
    "lists which runs to film"
)
ALLOWED_FOLDERS_VARIABLE = "FRICTRACK_OUTPUTS"  # environment: folders (as in PATH) outside of a study for its results
ARRAY_TABLES = {"run": "name", "effect": "effect"}  # tables that occur several times -> key that identifies one
RESERVED_NAME = "study"  # name of the file with the results of all runs
MAX_STUDY_BYTES = 1 << 19  # a study file of a thousand runs has 100 kB
MAX_DOTS_PER_LINE = 50  # outside of texts and numbers; the time to parse a dotted key grows with the square of them
MAX_FAULTS = 50  # that are listed
_HEADER = re.compile(r"""\s*\[+\s*["']?([\w-]+)["']?\s*([.\]])""")  # of a table, or with a dot of a part of it
_KEY = re.compile(r"""\s*["']?([\w-]+)["']?\s*[.=]""")
_NO_KEY = re.compile(r'"(?:[^"\\]|\\.)*"|\'[^\']*\'|#.*|\d\.\d')


@dataclass(frozen=True)
class Study:
    """A study file, read and checked."""

    path: Path  # path, name: the study file, and the name of the study
    name: str
    model: str | tuple[str, ...]  # the first model: a name, or names of effects
    output: Path  # folder of the results
    runs: tuple[schema.RunTable, ...]  # runs, effects: the ``[[run]]`` and ``[[effect]]`` tables
    effects: tuple[schema.EffectTable, ...] = ()
    # mass in ``[study]``, kg, with its standard deviation: forces are quoted at its load
    mass: schema.Value | None = None
    fps: float | None = None  # fps, scale: frame rate (Hz) and scale in ``[camera]``, for a plan without runs
    scale: Any = None
    # prior, prior_file: the law of another set-up, as a prior, and its file; None without one
    prior: Prior | None = None
    prior_file: Path | None = None
    # conditions in which the studies of a campaign differ, by name
    conditions: Mapping[str, float | str] = field(default_factory=dict)
    functions: tuple[str, ...] = ()  # functions of z in ``[study]``, for formulas
    costs: Costs = DEFAULT_COSTS  # costs of the next experiment
    search: schema.SearchTable | None = None  # how models are fitted; None without a table ``[search]``
    # what its runs still need before they can be measured; empty unless the study was read with `allow_incomplete`
    incomplete: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """The folder of the study file, to which its paths are relative."""
        return self.path.parent


def load(path: str | Path, *, allow_incomplete: bool = False) -> Study:
    """Read a study file.

    Parameters
    ----------
    path
        The file, or a folder with a ``study.toml``.
    allow_incomplete
        Accept a study without runs, and runs without mass or scale.

    Raises
    ------
    FrictrackError
        (usage) With all faults: what was expected, what came, in which line.

    """
    path = Path(path)
    path = path / "study.toml" if path.is_dir() else path
    return parse(path, _read(path), allow_incomplete=allow_incomplete)


def parse(path: Path, text: str, *, allow_incomplete: bool = False) -> Study:
    """Read the text of a study file, which need not be on the disk.

    Parameters
    ----------
    path
        Path of the study file; paths in the text are relative to its folder.
    text
        The text.
    allow_incomplete
        Accept a study without runs, and runs without mass or scale; see `Study.incomplete`.

    Raises
    ------
    FrictrackError
        (usage) With all faults.

    """
    raw = read_toml(path.name, text)
    reader = _Reader(text, raw)
    study = reader.study(path)
    faults = _sentences(reader.faults) + ([] if allow_incomplete else _sentences(reader.lacks))
    if faults or study is None:
        more = ["there may be more faults"] if len(faults) >= MAX_FAULTS else []
        raise UsageError(f"{path.name}: " + "; ".join(faults[:MAX_FAULTS] + more))
    return study


def results_folder(path: Path) -> Path:
    """Return the folder of the results of a study file, even if its recordings are missing.

    Raises
    ------
    FrictrackError
        (usage) If the file cannot be read.

    """
    head = read_toml(path.name, _read(path)).get("study", {})
    return _output(path, str(head.get("output", "")) if isinstance(head, dict) else "")


def _output(path: Path, output: str) -> Path:
    return path.parent / (output or f"{path.stem}_results")


def read_toml(name: str, text: str) -> dict[str, Any]:
    """Read the tables of a TOML text.

    Parameters
    ----------
    name
        Name of the file, for messages.
    text
        The text.

    Raises
    ------
    FrictrackError
        (usage) If the text is not TOML, or has more dots in a line than can be parsed in short time.

    """
    for number, line in enumerate(text.splitlines(), 1):
        if line.count(".") > MAX_DOTS_PER_LINE and _NO_KEY.sub("", line).count(".") > MAX_DOTS_PER_LINE:
            raise UsageError(f"{name} is not valid TOML: line {number} has too many dots")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as e:  # a number of more digits than Python reads, brackets without end
        raise UsageError(f"{name} is not valid TOML: {e}{_toml_hint(str(e), text)}") from e


TOML_HINTS = (  # a usual mistake in a line -> what to write instead
    ("[“”„«»‘’]", 'texts stand in plain quotes: "0.35 kg"'),
    (r"\\", "write paths with / instead of \\"),
    (r"=\s*[+-]?[\d.]+\s*[A-Za-zµ]", 'a number with a unit is a text in quotes: mass = "0.35 kg"'),
    (r"=\s*[+-]?\d+,\d", "write a decimal point instead of the comma"),
    (r"=\s*[A-Za-z/.]", 'texts stand in quotes: video = "a.avi"'),
)


def _toml_hint(message: str, text: str) -> str:
    """Return what to write instead, for the usual mistakes in the line that an error names."""
    found = re.search(r"at line (\d+)", message)
    lines = text.splitlines()
    line = lines[int(found[1]) - 1] if found and int(found[1]) <= len(lines) else ""
    return next((f"; {hint}" for pattern, hint in TOML_HINTS if re.search(pattern, line)), "")


def _read(path: Path) -> str:
    if path.exists() and path.suffix != ".toml":
        way = f"frictrack run {shlex.quote(path.name)} --mass 0.35kg --scale 0.5mm/px --fps 4000"
        raise UsageError(f"expected a study file (.toml) but got {path.name}; `{way}` makes one")
    if not path.exists():
        there = [p.name for p in path.parent.glob("*.toml")] if path.parent.is_dir() else []
        new = f"`frictrack init {shlex.quote(str(path.parent))}` writes one"
        hint = suggest(path.name, there) if there else new
        raise UsageError(f"expected a study file {path} but there is none; {hint}")
    if not path.is_file():
        raise UsageError(f"expected a study file but {path} is none")
    return read_small_text(path, MAX_STUDY_BYTES, "a study file")


class _Reader:
    """Check the tables of a study file and collect their faults."""

    def __init__(self, text: str, raw: dict[str, Any]) -> None:
        self.lines = _lines_of_keys(text)
        self.raw = raw
        self.faults: dict[str, list[str]] = {}  # where, by fault: several runs often have the same
        self.lacks: dict[str, list[str]] = {}  # the same of keys that a run needs before it can be measured

    def study(self, path: Path) -> Study | None:
        try:
            file = schema.StudyFile.model_validate(self.raw, context={"folder": path.parent})
        except ValidationError as e:
            faults = reversed(e.errors(include_url=False))
            first = {fault["loc"][: 2 + (fault["loc"][0] in ARRAY_TABLES)]: fault for fault in faults}  # of each key
            self.faults = {self._sentence(first[place]): [] for place in list(first)[: -MAX_FAULTS - 1 : -1]}
            return None
        where = f"[motion], {self._line('motion', 0, '')}"
        self.faults = {fault: [where] for fault in file.motion.filter_choice.faults()}
        if not file.run:
            self.lacks[NO_RUN] = []
        if self.faults:
            return None
        head, output = file.study, _output(path, file.study.output)
        merged = tuple(self._merged(i, run, file) for i, run in enumerate(file.run))
        if not _is_allowed(output, path.parent):
            came = f'"{head.output or output.name}", which is outside; choose another folder, or allow that one'
            fault = (
                f"expected an output inside the study's folder but got {came}: {ALLOWED_FOLDERS_VARIABLE}=FOLDER ..."
            )
            self.faults[fault] = [f"[study], {self._line('study', 0, 'output')}"]
        self._check_names(merged)
        self._check_prior(head, merged)
        prior = None if head.prior is None else Prior.read(head.prior)
        return Study(
            path=path,
            name=head.name or path.resolve().parent.name,
            model=head.model if isinstance(head.model, str) else tuple(head.model),
            output=output,
            runs=merged,
            effects=file.effect,
            mass=None if head.mass == "fit" else head.mass,
            fps=file.camera.fps,
            scale=file.camera.scale,
            prior=prior and prior.inflated(head.prior_scale, head.prior_scatter),
            prior_file=head.prior,
            conditions=head.conditions,
            functions=head.functions,
            costs=Costs(**file.costs.model_dump()),
            search=file.search,
            incomplete=tuple(_sentences(self.lacks)),
        )

    def _sentence(self, fault: Any) -> str:
        """Return a fault with the table and the line of its key; its place is table, number of an array table, key."""
        table, *rest = fault["loc"]
        index = rest.pop(0) if rest and table in ARRAY_TABLES else 0
        key = str(rest[0]) if rest else ""
        if table not in TABLES:
            return f'unknown table "{table}" ({self._line("", 0, table)}); {suggest(table, TABLES)}'
        if not rest and fault["type"] != "value_error":
            brackets = f"[[{table}]]" if table in ARRAY_TABLES else f"[{table}]"
            return f'expected "{table}" as a table {brackets} ({self._line(table, 0, "")})'
        where = f"{_title(table, index, self.raw[table])}, {self._line(table, index, key)}"
        if fault["type"] == "extra_forbidden":
            home = next((t for t, keys in TABLES.items() if key in keys.model_fields), None)
            hint = f"it belongs in [{home}]" if home else suggest(key, TABLES[table].model_fields)
            return f"{where}: {describe_fault(fault, rest)}; {hint}"
        return f"{where}: {describe_fault(fault, rest)}"

    def _merged(self, index: int, run: schema.RunTable, file: schema.StudyFile) -> schema.RunTable:
        """Return a run with the keys that it inherits."""
        where = f"{_title('run', index, self.raw['run'])}, {self._line('run', index, '')}"
        if (run.video is None) == (run.table is None):
            came = "neither" if run.video is None else "both"
            self.faults.setdefault(f'expected either video = "..." or table = "..." but got {came}', []).append(where)
            return run
        filtering = {} if run.filter else dict(file.motion)  # settings of one filter make no sense for another
        inherited = {"mass": file.study.mass, "plausible": file.study.plausible, **dict(file.camera), **filtering}
        update = {key: value for key, value in inherited.items() if getattr(run, key) is None}
        run = run.model_copy(update={**update, "name": run.name or run.source.stem})
        if run.table and schema.needs_film(run.scale):  # a board in the camera's view gives no scale of a table
            run = run.model_copy(update={"scale": None})
        for found, sentences in ((self.faults, _run_faults(run)), (self.lacks, _run_lacks(run))):
            for sentence in sentences:
                found.setdefault(sentence, []).append(where)
        return run

    def _check_names(self, runs: tuple[schema.RunTable, ...]) -> None:
        names: set[str] = set()
        for i, run in enumerate(runs):
            if run.name.casefold() in names:
                fault = f'expected every run to have its own name but got "{run.name}" twice'
                self.faults[fault] = [self._line("run", i, "name")]
            names.add(run.name.casefold())

    def _check_prior(self, head: schema.StudyTable, runs: tuple[schema.RunTable, ...]) -> None:
        where = f"[study], {self._line('study', 0, 'prior')}"
        if head.prior is not None and any(run.mass == "fit" for run in runs):
            self.faults[
                'expected a known mass with a prior but got mass = "fit": the values of the prior scale with the load; '
                "weigh the slider, or leave the prior out"
            ] = [where]
        if head.prior is None and (head.prior_scale, head.prior_scatter) != (1.0, 0.0):
            self.faults["expected prior = a file beside prior_scale and prior_scatter but got none"] = [where]

    def _line(self, table: str, index: int, key: str) -> str:
        """Return the line of a key, as ``line 12``; that of the table's header if the key is not found."""
        places = [(table, index, key), (table, index, "")] if table else [(key, 0, ""), ("", 0, key)]
        return f"line {next((self.lines[place] for place in places if place in self.lines), 1)}"


def _lines_of_keys(text: str) -> dict[tuple[str, int, str], int]:
    """Return the lines of tables and their keys in a study file, by table, its index and key ("" for its header)."""
    found: dict[tuple[str, int, str], int] = {}
    counts: Counter[str] = Counter()
    table, index = "", 0
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            table, part = header[1], header[2] == "."
            index = max(counts[table] - part, 0)
            counts[table] += not part
            found.setdefault((table, index, ""), number)
        elif key := _KEY.match(line):
            found.setdefault((table, index, key[1]), number)
    return found


def _is_allowed(output: Path, folder: Path) -> bool:
    """Return whether a folder of results lies inside the study's folder (links resolved), or inside an allowed one."""
    allowed = [part for part in os.environ.get(ALLOWED_FOLDERS_VARIABLE, "").split(os.pathsep) if part]
    try:
        return any(output.resolve().is_relative_to(home.resolve()) for home in (folder, *map(Path, allowed)))
    except (ValueError, OSError, RuntimeError):  # a NUL, a name that is too long, links in a circle
        return False


def _sentences(found: Mapping[str, list[str]]) -> list[str]:
    """Say each fault after the first of the places that have it, and how many others there are."""
    more = {fault: len(places) - 1 for fault, places in found.items()}
    counts = {fault: f", and {n} more run{'s' * (n > 1)}" if n > 0 else "" for fault, n in more.items()}
    return [f"{places[0]}{counts[fault]}: {fault}" if places else fault for fault, places in found.items()]


def name_of_table(table: Mapping[str, Any], kind: str) -> str:
    """Return the name of a table; a run without a name has that of its recording."""
    name = table.get(ARRAY_TABLES[kind])
    return str(name) if name else Path(str(table.get("video") or table.get("table") or "")).stem


def _title(table: str, index: int, raw: Any) -> str:
    if table not in ARRAY_TABLES:
        return f"[{table}]"
    one = raw[index] if isinstance(raw[index], dict) else {}
    name = one.get("name") or one.get("effect")
    return f'[[{table}]] "{name}"' if name else f"[[{table}]] number {index + 1}"


def _run_lacks(run: schema.RunTable) -> list[str]:
    """Return what a film needs besides its frames before it can be measured."""
    lacks = {
        'expected a scale but got none; give scale = "0.5 mm/px" in [camera] or here': run.scale,
        'expected a mass but got none; give mass = "0.35 kg" in [study] or here': run.mass,
    }
    return [lack for lack, value in lacks.items() if run.video and value is None]


def _run_faults(run: schema.RunTable) -> list[str]:
    """Return the faults of one run that concern several keys."""
    wrong_name = not is_file_name(run.name) or run.name.casefold() == RESERVED_NAME
    undriven = run.mass == "fit" and not (run.drive or run.table)
    has_template, has_picture = run.template is not None, isinstance(run.target, Path)
    rate, cutoff = run.fps or math.inf, run.cutoff or 0.0
    tracks_table = run.table and any(one.how == "track" for one in run.repair)
    faults = {
        "expected a name that can be a file name on every system (letters, digits, spaces, .-_; at most "
        f'{MAX_NAME_LENGTH} characters) but got "{run.name[:MAX_NAME_LENGTH]}"': wrong_name,
        'expected a measured drive with mass = "fit" but got none; give drive = "drive.csv"': undriven,
        "expected a target with template (the number of its frame) but got none": has_template and run.target is None,
        "expected no template with a picture of the target: the picture is searched in all frames": has_template
        and has_picture,
        "expected columns only with a table": run.columns and run.video,
        **dict.fromkeys(run.filter_choice.faults(), True),
        f"expected cutoff below half the frame rate, {rate / 2:g} Hz, but got {cutoff:g} Hz": cutoff >= rate / 2,
        "expected a target with exclude (areas that do not belong to the target) but got none": run.exclude
        and run.target is None,
        "expected exclude and obstacles only with a video": (run.exclude or run.obstacles) and run.table,
        'expected how = "interpolate" or "leave_out" in the repair of a table but got "track": '
        "a table has no pictures": tracks_table,
    }
    return [fault for fault, is_so in faults.items() if is_so]
