"""Options of a command from a dataclass, by tyro; its errors as one line."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro

from warp_gi.errors import OptionError
from warp_gi.files import user_path

Options = TypeVar("Options")

_PLAIN = (
    (r"Error parsing settings\.([\w.]+): ", r"\1: "),
    (r"Error parsing sun: ", ""),
    (r"Error parsing (--[\w.-]+): invalid literal for int\(\) with base 10: ", r"\1 must be a whole number, got "),
    (r"Error parsing (--[\w.-]+): could not convert string to float: ", r"\1 must be a number, got "),
    (
        r"Error parsing (--[\w.-]+): no type matching (\S+) could be instantiated from (\S+)\. .*",
        r"\1 must be \2, got \3",
    ),
)
"""Patterns in what tyro says, and plainer words."""


def flag(metavar: str, default: str, *aliases: str) -> object:
    """Return how tyro shows a flag: what stands for its value, and its default in words."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})", aliases=aliases)


def value_given(arguments: Sequence[str], name: str) -> str | None:
    """Return the value of the flag ``name``, the last one if there are several; None if there is none."""
    value = None
    for argument, after in itertools.zip_longest(arguments, arguments[1:]):
        flag_name, equals, own = argument.partition("=")
        if flag_name == name:
            value = own if equals else after
    return value


def parse_options(
    options: type[Options],
    command: str,
    arguments: Sequence[str],
    description: str | None = None,
    default: Options | None = None,
) -> Options:
    """Return ``options`` filled from the command line.

    ``default`` are the options without any arguments; the estimators among its fields decide which settings there are.
    ``description`` None is the docstring of the class. Raises OptionError for options that are unknown, missing or
    cannot be read.
    """
    _check_empty(arguments)
    settings: dict[str, Any] = {} if default is None else {"default": default, "config": (tyro.conf.AvoidSubcommands,)}
    report = io.StringIO()
    try:
        with contextlib.redirect_stderr(report):
            given = tyro.cli(options, prog=f"warp-gi {command}", args=arguments, description=description, **settings)
            return _at_home(given)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise OptionError(_first_error(report.getvalue(), command)) from None


def _check_empty(arguments: Sequence[str]) -> None:
    """Raise OptionError for an argument that is empty, which would read as if it had been left out."""
    for before, argument in zip(["", *arguments], arguments, strict=False):
        flag_name, equals, value = argument.partition("=")
        if not argument or (flag_name.startswith("--") and equals and not value):
            place = f" after {before}" if not argument and before else f" of {flag_name}" if equals else ""
            raise OptionError(
                f"the argument{place} is empty (a variable that is not set?); give a value, or leave it out"
            )


def _at_home(options: Options) -> Options:
    """Return options with the home of the user for ``~`` in paths; shells leave it where it is quoted or after =."""
    for one in dataclasses.fields(options):  # type: ignore[arg-type]
        value = getattr(options, one.name)
        if isinstance(value, Path):
            setattr(options, one.name, user_path(value))
        elif isinstance(value, str) and value.startswith("~"):
            setattr(options, one.name, str(user_path(value)))
        elif isinstance(value, tuple) and any(isinstance(item, Path) for item in value):
            setattr(options, one.name, tuple(user_path(item) for item in value))
    return options


def _first_error(report: str, command: str) -> str:
    """Return what tyro's framed report says: its first part, and the first suggestion if it makes one.

    Where stdout does not take lines that are not ASCII, the frame is hyphens, with the title as a part of its own.
    """
    lines = [line.strip("│ ") for line in report.splitlines() if not line.startswith(("╭", "╰"))]
    parts = [part for part in re.split(r"^[─-]{3,}$", "\n".join(lines), flags=re.MULTILINE) if part.strip()]
    told = parts[1:] if len(parts) > 1 and "╭" not in report else parts
    message = re.sub(r"\s+", " ", told[0]).strip().rstrip(". ") if told else "options that cannot be read"
    for pattern, words in _PLAIN:
        message = re.sub(pattern, words, message)
    suggestion = re.search(r"Perhaps you meant:\s+(--[\w.-]+)", "\n".join(told))
    hint = f"; did you mean {suggestion.group(1)}?" if suggestion else ""
    return f"{message}{hint} (see warp-gi {command} --help)"
