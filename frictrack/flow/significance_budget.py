"""Bound the probability that any effect named in the whole work on a study is false, however often it is diagnosed.

Every diagnosis tests the hypothesis that its model is complete. Diagnoses form sequences: a test continues a sequence
if it has the same data, and its model adds to the last model of the sequence only effects that the last test named. A
sequence is tested at one significance level alpha in every step: a false effect can be named only at its first
complete model, so all its steps together err with a probability of at most alpha (fixed-sequence testing). Any other
test (an alternative model, changed data, another seed) begins a new sequence at a smaller alpha. The probability that
any named effect is false is at most the sum of alpha over the sequences (Bonferroni).

References
----------
Maurer, Hothorn & Lehmacher (1995), Multiple comparisons in drug clinical trials: a-priori ordered hypotheses.
Foster & Stine (2008), Alpha-investing, J. R. Statist. Soc. B 70, 429 (a level for every test, spent in turn).

"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from frictrack.flow.kept_rows import KeptRows

FILE_NAME = "tests.json"
ALPHA_FIRST = 0.01  # of the first sequence of tests
MIN_ALPHA = 0.001  # of a later one; a smaller level would take many more draws


@dataclass(frozen=True)
class CompletenessTest:
    """One diagnosis of one model, as the budget of significance counts it.

    Attributes
    ----------
    key
        Hash of model, data and seed; the same diagnosis again is no new test.
    data
        Hash of the runs.
    model
        Names of the effects.
    sequence
        Number of the sequence of tests, from 1.
    alpha
        Significance level.
    named
        Effects that were significant; None before the verdict is known.
    verdict
        The verdict; "" before it is known.

    """

    key: str
    data: str
    model: tuple[str, ...]
    sequence: int
    alpha: float
    named: tuple[str, ...] | None = None
    verdict: str = ""

    def allows(self, data: str, model: Collection[str]) -> bool:
        """Return whether a test of another model continues this one."""
        added = set(model) - set(self.model)
        is_larger = bool(added) and set(model) > set(self.model)
        return is_larger and self.data == data and added <= set(self.named or ())


def sequence_alpha(number: int) -> float:
    """Return the significance level of a sequence of tests.

    Levels of the later ones fall so that their sum is at most that of the first, until the smallest level is reached.

    Parameters
    ----------
    number
        Number of the sequence, from 1.

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
    """Return the test of a model, with its sequence and its level.

    Parameters
    ----------
    tests
        The tests so far, oldest first.
    key, data, model
        See `CompletenessTest`.

    """
    same = next((test for test in tests if test.key == key), None)
    if same is not None:
        return same
    last = {test.sequence: test for test in tests}
    continued = next((test for test in last.values() if test.allows(data, model)), None)
    number = continued.sequence if continued else len(last) + 1
    return CompletenessTest(key, data, tuple(model), number, sequence_alpha(number))


def named_effects(diagnosis: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the effects of which a diagnosis says that they are significant, and those of its formulas.

    Parameters
    ----------
    diagnosis
        JSON of the diagnosis.

    """
    level = diagnosis.get("alpha", ALPHA_FIRST) / 2  # earlier versions had this level alone
    names = [one["effect"] for one in diagnosis["candidates"] if one["p"] is not None and one["p"] < level]
    formulas = (diagnosis.get("unexplained") or {}).get("formulas", [])
    defined = ["unexplained"] if formulas else []
    return tuple(dict.fromkeys([*diagnosis["missing"], *diagnosis.get("leads", []), *names, *defined]))


class SignificanceBudget:
    """The tests that were made of the models of one study, in a file of the results.

    Parameters
    ----------
    folder
        Folder of the results.

    """

    def __init__(self, folder: Path) -> None:
        self._kept = KeptRows(folder, FILE_NAME, _read_test, asdict, "the tests are counted from now on")

    @property
    def path(self) -> Path:
        """The file."""
        return self._kept.path

    @property
    def tests(self) -> list[CompletenessTest]:
        """All tests of which the verdict is known, oldest first.

        Raises `FrictrackError` if the file is damaged.
        """
        return self._kept.read()

    def plan(self, key: str, data: str, model: Sequence[str]) -> CompletenessTest:
        """Return the next test; see `plan_test`."""
        return plan_test(self.tests, key, data, model)

    def record(self, test: CompletenessTest, diagnosis: Mapping[str, Any]) -> None:
        """Write a test with its verdict; the same test again replaces the earlier entry.

        Parameters
        ----------
        test
            The test, from `plan`.
        diagnosis
            JSON of the diagnosis.

        """
        done = replace(test, named=named_effects(diagnosis), verdict=str(diagnosis["verdict"]))

        def with_test(tests: list[CompletenessTest]) -> list[CompletenessTest]:
            known = test.key in [one.key for one in tests]
            return [done if one.key == test.key else one for one in tests] if known else [*tests, done]

        self._kept.change(with_test)

    def summary(self) -> dict[str, Any]:
        """Return the JSON of `frictrack history`: "tests", and "alpha_spent"."""
        tests = self.tests
        rows = [
            {
                "model": list(test.model),
                "alpha": test.alpha,
                "sequence": test.sequence,
                "verdict": test.verdict,
                "named": list(test.named or ()),
            }
            for test in tests
        ]
        return {"tests": rows, "alpha_spent": alpha_spent(tests)}


def _read_test(row: Mapping[str, Any]) -> CompletenessTest:
    """Read one entry of the file.

    Raises
    ------
    ValueError
        If a value has the wrong type.

    """
    names = [row["model"], row["named"]]
    texts = (row["key"], row["data"], row["verdict"], *names[0], *(names[1] or ()))
    if not all(isinstance(text, str) for text in texts):
        raise ValueError("expected names as text")
    if not (isinstance(row["sequence"], int) and isinstance(row["alpha"], int | float)):
        raise ValueError("expected numbers")
    return CompletenessTest(**{**row, "model": tuple(names[0]), "named": None if names[1] is None else tuple(names[1])})
