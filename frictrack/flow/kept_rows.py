"""Keep the rows of a table in a JSON file of the results; several processes may change it in turn."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

from frictrack.errors import FrictrackError
from frictrack.files import INTERNAL_FOLDER, lock_folder, make_internal_folder, replace_text

Row = TypeVar("Row")


class KeptRows(Generic[Row]):
    """Rows in ``.frictrack/NAME`` of the folder of the results.

    Parameters
    ----------
    folder
        Folder of the results.
    name
        Name of the file.
    read_row
        Make a row of an entry; a damaged one raises ValueError, TypeError, KeyError or AttributeError.
    write_row
        Make an entry of the file of a row.
    afterwards
        What follows when a damaged file is deleted, as the end of a sentence.

    """

    def __init__(
        self,
        folder: Path,
        name: str,
        read_row: Callable[[Any], Row],
        write_row: Callable[[Row], dict[str, Any]],
        afterwards: str,
    ) -> None:
        self._folder, self._name = folder, name
        self._read_row, self._write_row, self._afterwards = read_row, write_row, afterwards

    @property
    def path(self) -> Path:
        """The file."""
        return self._folder / INTERNAL_FOLDER / self._name

    def read(self) -> list[Row]:
        """Return all rows, oldest first.

        Raises
        ------
        FrictrackError
            If the file is damaged.

        """
        try:
            return [self._read_row(entry) for entry in json.loads(self.path.read_text(encoding="utf-8"))]
        except FileNotFoundError:
            return []
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as e:
            raise FrictrackError(f"{self.path} is damaged; delete it, and {self._afterwards}") from e

    def change(self, change: Callable[[list[Row]], list[Row]]) -> None:
        """Replace the rows by what `change` makes of them, while no other process changes them."""
        make_internal_folder(self._folder)
        with lock_folder(self._folder):
            rows = [self._write_row(row) for row in change(self.read())]
            replace_text(self.path, json.dumps(rows, indent=0))
