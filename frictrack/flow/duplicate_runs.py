"""Find runs of a study that are the same recording, by the content of their files or by their values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from frictrack.flow.pipeline import RunPipeline
from frictrack.records import Displacement
from frictrack.sampling import copies


def find_duplicate_runs(pipelines: Sequence[RunPipeline]) -> dict[str, str]:
    """Return a note for every run that is the same recording as an earlier one, by the name of the run."""
    displacements = {pipeline.run.name: pipeline.get("displacement") for pipeline in pipelines}
    films = {pipeline.run.name: pipeline.get("recording").hash for pipeline in pipelines if pipeline.run.video}
    return duplicate_notes(displacements, films)


def duplicate_notes(displacements: Mapping[str, Displacement], contents: Mapping[str, str]) -> dict[str, str]:
    """Return a note for every run that repeats an earlier one.

    Parameters
    ----------
    displacements
        Displacement by name of the run.
    contents
        Hash of the film by name of the run, if it is known.

    """
    names = list(displacements)
    pairs = [(names[i], names[j]) for i, j in copies(list(displacements.values()))]
    found: dict[str, str] = {}
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            if other not in found and ((one, other) in pairs or _same_content(contents.get(one), contents.get(other))):
                found[other] = (
                    f'the same recording as run "{one}": it counts twice, so that deviations are too small and a '
                    "held-out error too low; remove one of them"
                )
    return found


def _same_content(one: str | None, other: str | None) -> bool:
    return one is not None and one == other
