"""What a study remembers besides its results: its changes, the tests made of its models, predictions of runs.

The log is ``.frictrack/log.jsonl`` in the folder of the results. Every line holds the command and the state before
and after it, so that a change can be undone. The number of lines is the revision of the study: a user whose page shows
an older revision is refused instead of overwriting the change of another user.

The probability that any effect named in the whole work on a study is false is bounded, however often it is diagnosed.
Every diagnosis tests the hypothesis that its model is complete. Diagnoses form sequences: a test continues a sequence
if it has the same data, and its model adds to the last model of the sequence only effects that the last test named. A
sequence is tested at one significance level alpha in every step: a false effect can be named only at its first
complete model, so all its steps together err with a probability of at most alpha (fixed-sequence testing). Any other
test (an alternative model, changed data, another seed) begins a new sequence at a smaller alpha. The probability that
any named effect is false is at most the sum of alpha over the sequences (Bonferroni).

A run that `frictrack plan` names is kept with the evidence that is expected of it. The first diagnosis of the same
model with exactly one run more fills in what was realised.

References
----------
Maurer, Hothorn & Lehmacher (1995), Multiple comparisons in drug clinical trials: a-priori ordered hypotheses.
Foster & Stine (2008), Alpha-investing, J. R. Statist. Soc. B 70, 429 (a level for every test, spent in turn).

"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar

from pydantic import AfterValidator, TypeAdapter

from frictrack.base.errors import FrictrackError
from frictrack.base.files import INTERNAL_FOLDER, append_line, lock_folder, make_internal_folder, replace_text

FILE_NAME = "log.jsonl"
_KEYS = ("rev", "at", "who", "do", "told", "before", "after")  # of a line in the log, in the order of `Change`


@dataclass
class Change:
    """One change of a study, and the state before and after it."""

    revision: int  # number of the change, from 1
    time: str  # local time in ISO 8601
    author: str  # where the command came from, as "cli" or "page"
    command: str  # command, arguments: name and arguments of the command; see `Session.apply`
    arguments: dict[str, Any] = field(default_factory=dict)
    # before, after: the parts of the state that changed: "toml", the text of the study file, or "current", the group
    # of the current model. A change without `before` cannot be undone
    before: dict[str, Any] = field(default_factory=dict)
    after: dict[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The command as one would type it."""
        return " ".join((self.command, *(str(value) for value in self.arguments.values() if value is not None)))

    def to_json(self) -> str:
        """Return the line of the log."""
        return json.dumps(dict(zip(_KEYS, vars(self).values(), strict=True)), ensure_ascii=False)

    @classmethod
    def from_json(cls, line: bytes) -> Change:
        """Read a line of the log."""
        names = dict(zip(_KEYS, (f.name for f in fields(cls)), strict=True))
        return _CHANGE.validate_python({names[key]: value for key, value in json.loads(line).items()})


_CHANGE = TypeAdapter(Change)


def undo_stacks(changes: Sequence[Change]) -> tuple[list[Change], list[Change]]:
    """Return the changes that can be undone, and those that can be redone; the next one is last in both lists.

    Parameters
    ----------
    changes
        All changes, oldest first.

    Raises
    ------
    ValueError
        If more is undone or redone than was done.

    """
    done: list[Change] = []
    undone: list[Change] = []
    for change in changes:
        if (change.command == "undo" and not done) or (change.command == "redo" and not undone):
            raise ValueError(f"change {change.revision} has nothing to {change.command}")
        if change.command == "undo":
            undone.append(done.pop())
        elif change.command == "redo":
            done.append(undone.pop())
        elif change.command == "restart":
            done, undone = [], []
        elif change.before:
            done, undone = [*done, change], []
    return done, undone


class CommandHistory:
    """The log of one study."""

    def __init__(self, folder: Path, author: str = "python", expected_revision: int | None = None) -> None:
        self.folder = folder
        self.author = author
        self.expected_revision = expected_revision

    @property
    def path(self) -> Path:
        """The log."""
        return self.folder / INTERNAL_FOLDER / FILE_NAME

    @property
    def changes(self) -> list[Change]:
        """All changes, oldest first. An incomplete last line, as a power cut leaves it, is ignored.

        Raises `FrictrackError` if the log is damaged.
        """
        try:
            lines = self.path.read_bytes().split(b"\n")[:-1]
        except FileNotFoundError:
            return []
        try:
            return [Change.from_json(line) for line in lines]
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as e:
            raise FrictrackError(self._damaged) from e

    @property
    def _damaged(self) -> str:
        return f"{self.path} is damaged; move it away, the models tried are not in it"

    @property
    def revision(self) -> int:
        """Number of changes so far."""
        return len(self.changes)

    def undo_stacks(self) -> tuple[list[Change], list[Change]]:
        """Return the changes that can be undone, and those that can be redone; see `undo_stacks`."""
        try:
            return undo_stacks(self.changes)
        except ValueError as e:
            raise FrictrackError(self._damaged) from e

    def check_revision(self) -> None:
        """Raise `FrictrackError` if the study is not at the expected revision."""
        if self.expected_revision is None:
            return
        changes = self.changes
        if self.expected_revision != len(changes):
            last = changes[-1] if changes else Change(0, "", "somebody", "restart")
            raise FrictrackError(
                f"the study was changed meanwhile ({last.author}: {last.text}); reload it, then repeat the command"
            )

    @contextmanager
    def record(self, command: str, **arguments: Any) -> Iterator[Change]:
        """Lock the study, yield a change to be completed, and write it to the log if the block succeeds."""
        with lock_folder(self.folder):
            self.check_revision()
            if self.path.is_symlink():
                raise FrictrackError(f"expected the log {self.path} but it is a link to another place; remove the link")
            time = datetime.now().astimezone().isoformat(timespec="seconds")
            change = Change(self.revision + 1, time, self.author, command, arguments)
            yield change
            append_line(self.path, change.to_json())
            self.expected_revision = None if self.expected_revision is None else change.revision


Row = TypeVar("Row")
ALPHA_FIRST = 0.01  # of the first sequence of tests
MIN_ALPHA = 0.001  # of a later one; a smaller level would take many more draws


class KeptRows(Generic[Row]):
    """Rows in ``.frictrack/<file_name>`` of the folder of the results."""

    file_name: ClassVar[str]
    kind: ClassVar[Any]  # of a row
    after_loss: ClassVar[str]  # what follows from deleting a damaged file

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.path = folder / INTERNAL_FOLDER / self.file_name

    @property
    def rows(self) -> list[Row]:
        """All rows, oldest first; raises `FrictrackError` if the file is damaged."""
        try:
            return TypeAdapter(list[self.kind]).validate_json(self.path.read_bytes(), strict=True)  # type: ignore[name-defined]
        except FileNotFoundError:
            return []
        except ValueError as e:
            raise FrictrackError(f"{self.path} is damaged; delete it, and {self.after_loss}") from e

    def _change(self, change: Callable[[list[Row]], list[Row]]) -> None:
        """Replace the rows by what `change` makes of them, while no other process changes them."""
        make_internal_folder(self._folder)
        with lock_folder(self._folder):
            rows: list[Any] = change(self.rows)
            entries = [row if isinstance(row, dict) else asdict(row) for row in rows]
            replace_text(self.path, json.dumps(entries, indent=0))


@dataclass(frozen=True)
class CompletenessTest:
    """One diagnosis of one model, as the budget of significance counts it."""

    key: str  # hash of model, data and seed; the same diagnosis again is no new test
    data: str  # hash of the runs
    model: tuple[str, ...]  # names of the effects
    sequence: int  # number of the sequence of tests, from 1
    alpha: float  # significance level
    named: tuple[str, ...] | None = None  # effects that were significant; None before the verdict is known
    verdict: str = ""  # the verdict; "" before it is known

    def allows(self, data: str, model: Collection[str]) -> bool:
        """Return whether a test of another model continues this one."""
        added = set(model) - set(self.model)
        is_larger = bool(added) and set(model) > set(self.model)
        return is_larger and self.data == data and added <= set(self.named or ())


def sequence_alpha(number: int) -> float:
    """Return the significance level of a sequence of tests.

    Levels of the later ones fall so that their sum is at most that of the first, until the smallest level is reached.

    Examples
    --------
    >>> [round(sequence_alpha(number), 5) for number in (1, 2, 3, 4, 9)]
    [0.01, 0.005, 0.00167, 0.001, 0.001]

    """
    return ALPHA_FIRST if number == 1 else max(ALPHA_FIRST / (number * (number - 1)), MIN_ALPHA)


def alpha_spent(tests: Sequence[CompletenessTest]) -> float:
    """Return the sum of the levels of all sequences: it bounds the probability that any effect named is false."""
    return sum({test.sequence: test.alpha for test in tests}.values())


def plan_test(tests: Sequence[CompletenessTest], key: str, data: str, model: Sequence[str]) -> CompletenessTest:
    """Return the test of a model, with its sequence and its level."""
    same = next((test for test in tests if test.key == key), None)
    if same is not None:
        return same
    last = {test.sequence: test for test in tests}
    continued = next((test for test in last.values() if test.allows(data, model)), None)
    number = continued.sequence if continued else len(last) + 1
    return CompletenessTest(key, data, tuple(model), number, sequence_alpha(number))


def named_effects(diagnosis: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the effects of which a diagnosis says that they are significant, and those of its formulas."""
    level = diagnosis.get("alpha", ALPHA_FIRST) / 2  # earlier versions had this level alone
    names = [one["effect"] for one in diagnosis["candidates"] if one["p"] is not None and one["p"] < level]
    defined = ["unexplained"] if (diagnosis.get("unexplained") or {}).get("formulas") else []
    return tuple(dict.fromkeys([*diagnosis["missing"], *diagnosis.get("leads", []), *names, *defined]))


class SignificanceBudget(KeptRows[CompletenessTest]):
    """The tests that were made of the models of one study, of which the verdict is known, in a file of the results."""

    file_name, kind, after_loss = "tests.json", CompletenessTest, "the tests are counted from now on"

    def record(self, test: CompletenessTest, diagnosis: Mapping[str, Any]) -> None:
        """Write a test, from `plan_test`, with its verdict; the same test again replaces the earlier entry."""
        done = replace(test, named=named_effects(diagnosis), verdict=str(diagnosis["verdict"]))

        def with_test(tests: list[CompletenessTest]) -> list[CompletenessTest]:
            known = test.key in [one.key for one in tests]
            return [done if one.key == test.key else one for one in tests] if known else [*tests, done]

        self._change(with_test)

    def summary(self) -> dict[str, Any]:
        """Return the JSON of `frictrack history`: "tests", and "alpha_spent"."""
        tests, keys = self.rows, ("model", "alpha", "sequence", "verdict", "named")
        rows = [{key: getattr(test, key) for key in keys} for test in tests]
        lists = [row | {"model": list(row["model"]), "named": list(row["named"] or ())} for row in rows]
        return {"tests": lists, "alpha_spent": alpha_spent(tests)}


def _prediction(row: dict[str, Any]) -> dict[str, Any]:
    if not {"runs", "model", "realised", "predictions"} <= row.keys():
        raise ValueError("expected the keys of a prediction")
    return row


class Predictions(KeptRows[dict[str, Any]]):
    """The runs that were named, in a file of the results; its rows are JSON `predictions` of `frictrack history`."""

    file_name, after_loss = "predictions.json", "predictions are kept from now on"
    kind = Annotated[dict[str, Any], AfterValidator(_prediction)]

    def record(self, named: Mapping[str, Any], model: Sequence[str], runs: Sequence[str]) -> None:
        """Keep the prediction of a named run; another one for the same model and runs replaces it."""
        entry = {**named, "model": list(model), "runs": list(runs), "filmed": None, "realised": None}

        def with_entry(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
            others = [row for row in rows if (row["model"], row["runs"]) != (entry["model"], entry["runs"])]
            return [*others, entry]

        self._change(with_entry)

    def resolve(self, diagnosis: Mapping[str, Any], runs: Sequence[str]) -> None:
        """Fill in the realised evidence of the run that was added since, from a new diagnosis."""
        found = [resolve_prediction(row, diagnosis, runs) for row in self.rows]
        if any(row is not None for row in found):
            self._change(lambda rows: [new or old for old, new in zip(rows, found, strict=True)])


def resolve_prediction(
    row: Mapping[str, Any], diagnosis: Mapping[str, Any], runs: Sequence[str]
) -> dict[str, Any] | None:
    """Return an entry with its realised evidence; None if this diagnosis does not answer it.

    Of the explanations that were predicted for, the one that is best now counts as true. The prediction is the least
    over its rivals, and what was realised is the difference of BIC from that rival.
    """
    added, removed = set(runs) - set(row["runs"]), set(row["runs"]) - set(runs)
    same_model = row["model"] == list(diagnosis["model"])
    if row["realised"] is not None or not same_model or len(added) != 1 or removed:
        return None
    gains = {c["effect"]: c["delta_bic"] for c in diagnosis["candidates"] if c["delta_bic"] is not None}
    known = [p for p in row["predictions"] if p["true"] in gains and p["rival"] in gains]
    best = max((p["true"] for p in known), key=lambda name: gains[name], default=None)
    least = min((p for p in known if p["true"] == best), key=lambda p: p["expected"], default=None)
    if least is None:
        return None
    gained = gains[least["true"]] - gains[least["rival"]]
    factor = gained / least["expected"] if least["expected"] > 0 and gained > 0 else None
    answer = {name: least[name] for name in ("true", "rival", "expected", "interval")}
    return {**row, "filmed": added.pop(), "realised": {**answer, "delta_bic": gained, "factor": factor}}
