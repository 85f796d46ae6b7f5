"""Write the reference of the command line from the program itself."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path
from textwrap import dedent
from typing import Any

import typer
from page_text import code, prose, table, write_page

from frictrack.cli import study_commands, utility_commands  # noqa: F401 - they define the commands
from frictrack.cli.common import app

_HEAD = """# Command line

Every command, as `frictrack COMMAND --help` prints it. `frictrack --version` prints the version.

Commands that take a study file accept `--json`: they then print one JSON object, described in [JSON](json.md). Progress
goes to the standard error. The exit code is 0 for success, 1 if the work failed, and 2 if the command or the study file
is wrong.

"""


def write_command_line(folder: Path) -> None:
    """Write the page of all commands into a folder.

    Parameters
    ----------
    folder
        Folder of the generated pages.

    """
    write_page(folder / "command_line.md", command_line_page())


def command_line_page() -> str:
    """Return the page as Markdown."""
    commands = dict(all_commands())
    rows = [[f"[`{name}`](#{_anchor(name)})", prose(_first_line(command))] for name, command in commands.items()]
    sections = (_section(name, command) for name, command in commands.items())
    return _HEAD + table(["command", "what it does"], rows) + "\n" + "\n".join(sections)


def all_commands() -> Iterator[tuple[str, Any]]:
    """Yield name and command of every command that the program has, without hidden ones."""
    yield from _commands_of(typer.main.get_command(app), "frictrack")


def _commands_of(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if command.hidden:
            continue
        full = f"{prefix} {name}"
        if hasattr(command, "commands"):
            yield from _commands_of(command, full)
        else:
            yield full, command


def _anchor(name: str) -> str:
    return name.replace(" ", "-")


def _first_line(command: Any) -> str:
    return " ".join(cleandoc(command.help or "").split("\n\n")[0].split())


def _section(name: str, command: Any) -> str:
    """Return the section of one command: what it does, usage, arguments and options, examples."""
    context = typer.Context(command, info_name=name)
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    paragraphs = [prose(" ".join(part.split())) for part in cleandoc(command.help or "").split("\n\n")]
    records = [param.get_help_record(context) for param in command.get_params(context)]
    rows = [[_option(left), prose(text)] for left, text in filter(None, records)]
    parts = [
        f"({_anchor(name)})=\n",
        f"## {name.removeprefix('frictrack ')}\n",
        "\n\n".join(paragraphs) + "\n",
        f"```text\n{usage}\n```\n",
        table(["argument or option", "meaning"], rows),
    ]
    return "\n".join(parts) + _examples(command)


def _examples(command: Any) -> str:
    """Return the examples at the end of a command's help; click marks their block with a backspace."""
    text = cleandoc((command.epilog or "").replace("\b", "")).strip().removeprefix("Examples:")
    return f"\nExamples:\n\n```sh\n{dedent(text).strip()}\n```\n" if text else ""


def _option(left: str) -> str:
    return code(" ".join(left.split()))
