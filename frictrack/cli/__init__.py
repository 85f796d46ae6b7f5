"""The command line: `frictrack COMMAND`. It computes nothing; it asks `flow` and shows what came."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from frictrack.errors import FrictrackError

# The matrices here are many and small: threads of the linear algebra would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 the work failed, 2 it was asked for wrongly."""
    from frictrack.cli import other_commands, study_commands  # noqa: F401, PLC0415 - so that importing this module costs nothing
    from frictrack.cli.common import app  # noqa: PLC0415

    try:
        app(args=None if argv is None else list(argv), prog_name="frictrack")
    except FrictrackError as e:
        _fail(str(e), 2 if e.usage else 1)
    except OSError as e:
        _fail(f"{e.filename or 'the system'}: {e.strerror or e}; what was finished before is kept", 1)
    except KeyboardInterrupt:
        _fail("stopped; what was finished before is kept", 1)


def _fail(sentence: str, code: int) -> None:
    line = " ".join(sentence.split())
    sys.stderr.write(f"frictrack: {line}\n")
    raise SystemExit(code)
