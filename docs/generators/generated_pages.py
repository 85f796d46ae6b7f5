"""Write all generated pages of the documentation: the reference and the gallery of effects."""

from __future__ import annotations

import sys
from pathlib import Path

from command_line import write_command_line
from gallery import make_gallery
from hdf5 import write_hdf5
from json_reference import write_json_reference
from python_api import write_python_api
from scene_file import write_scene_file
from sphinx.application import Sphinx
from study_file import write_study_file

DOCS = Path(__file__).resolve().parents[1]
REFERENCE = DOCS / "reference" / "generated"
GALLERY = DOCS / "gallery" / "effects"
QUICK = ("texture",)  # effects that a quick build simulates: the front page shows their pictures


def write_generated_pages(app: Sphinx, *_: object) -> None:
    """Write all pages; Sphinx calls it before it looks for sources. What has not changed is not made again.

    `sphinx-build -t quick` simulates few effects of the gallery; all texts and links are there.
    """
    for write in (
        write_command_line,
        write_study_file,
        write_json_reference,
        write_hdf5,
        write_scene_file,
        write_python_api,
    ):
        sys.stderr.write(f"reference: {write.__name__.removeprefix('write_')}\n")
        write(REFERENCE)
    make_gallery(GALLERY, QUICK if app.tags.has("quick") else None)
