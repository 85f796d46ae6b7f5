"""Keep what was predicted of every run that `frictrack plan` named, and the evidence after it was filmed.

The file ``.frictrack/predictions.json`` in the folder of the results has one entry per named run. The first diagnosis
of the same model with exactly one run more fills in what was realised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from frictrack.flow.kept_rows import KeptRows

FILE_NAME = "predictions.json"


class Predictions:
    """The runs that were named, in a file of the results.

    Parameters
    ----------
    folder
        Folder of the results.

    """

    def __init__(self, folder: Path) -> None:
        self._kept = KeptRows(folder, FILE_NAME, _read_row, dict, "predictions are kept from now on")

    @property
    def path(self) -> Path:
        """The file."""
        return self._kept.path

    @property
    def rows(self) -> list[dict[str, Any]]:
        """All entries, oldest first: JSON `predictions` of `frictrack history`.

        Raises `FrictrackError` if the file is damaged.
        """
        return self._kept.read()

    def record(self, named: Mapping[str, Any], model: Sequence[str], runs: Sequence[str]) -> None:
        """Keep the prediction of a named run; another one for the same model and runs replaces it.

        Parameters
        ----------
        named
            The run; see `frictrack.plan.next_run`.
        model
            Effects of the model.
        runs
            Names of the runs so far.

        """
        entry = {**named, "model": list(model), "runs": list(runs), "filmed": None, "realised": None}

        def with_entry(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
            others = [row for row in rows if (row["model"], row["runs"]) != (entry["model"], entry["runs"])]
            return [*others, entry]

        self._kept.change(with_entry)

    def resolve(self, diagnosis: Mapping[str, Any], runs: Sequence[str]) -> None:
        """Fill in the realised evidence of the run that was added since, from a new diagnosis.

        Parameters
        ----------
        diagnosis
            JSON of the diagnosis.
        runs
            Names of the runs that it used.

        """
        found = [resolve_prediction(row, diagnosis, runs) for row in self.rows]
        if any(row is not None for row in found):
            self._kept.change(lambda rows: [new or old for old, new in zip(rows, found, strict=True)])


def _read_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Read one entry of the file."""
    return {**row, "runs": list(row["runs"]), "model": list(row["model"])}


def resolve_prediction(
    row: Mapping[str, Any], diagnosis: Mapping[str, Any], runs: Sequence[str]
) -> dict[str, Any] | None:
    """Return an entry with its realised evidence; None if this diagnosis does not answer it.

    Of the explanations that were predicted for, the one that is best now counts as true. The prediction is the least
    over its rivals, and what was realised is the difference of BIC from that rival.

    Parameters
    ----------
    row
        The entry.
    diagnosis
        JSON of the diagnosis.
    runs
        Names of the runs that it used.

    """
    added = set(runs) - set(row["runs"])
    if row["realised"] is not None or row["model"] != list(diagnosis["model"]) or len(added) != 1:
        return None
    if set(row["runs"]) - set(runs):
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
