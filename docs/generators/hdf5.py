"""Write the reference of the results files: the page that the store keeps of its schema, with links instead of code."""

from __future__ import annotations

from pathlib import Path

from page_text import write_page

from frictrack.flow.schema import schema_page


def write_hdf5(folder: Path) -> None:
    """Write the page of the results files into a folder.

    Parameters
    ----------
    folder
        Folder of the generated pages.

    """
    write_page(folder / "hdf5.md", schema_page())
