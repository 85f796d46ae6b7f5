"""Run the command line `frictrack COMMAND`. It computes nothing: it calls `flow` and prints the result."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from frictrack.base.errors import FrictrackError

# The matrices are many and small: several threads of linear algebra would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line and exit.

    Exit codes: 0 success, 1 the work failed, 2 the command or the study file is wrong.
    """
    from frictrack.cli import study_commands, utility_commands  # noqa: F401, PLC0415 - keeps this import fast
    from frictrack.cli.common import app  # noqa: PLC0415

    first = Path(next(iter(sys.argv[1:] if argv is None else argv), ""))
    if first.suffix and first.is_file():
        _fail(f"expected a command but got the file {first}; `frictrack run {shlex.quote(str(first))}` analyses it", 2)
    try:
        app(args=None if argv is None else list(argv), prog_name="frictrack")
    except FrictrackError as e:
        _fail(str(e), 2 if e.usage else 1)
    except OSError as e:
        _fail(f"{e.filename or 'the system'}: {e.strerror or e}; finished results are kept", 1)
    except KeyboardInterrupt:
        _fail("stopped; finished results are kept", 1)


def _fail(sentence: str, code: int) -> None:
    line = " ".join(sentence.split())
    sys.stderr.write(f"frictrack: {line}\n")
    raise SystemExit(code)
