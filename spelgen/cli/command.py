"""How the help of a command looks, and what a mistake in its words is answered with."""

from __future__ import annotations

import re
from difflib import get_close_matches
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, get_args

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup
from typer.models import OptionInfo

if TYPE_CHECKING:
    from click import Context

UsageError: type[Exception] = typer.BadParameter.__mro__[1]
METAVARS: dict[object, str] = {int: "N", float: "X", str: "TEXT", Path: "FILE"}


def name_values(annotation: object) -> None:
    """Give an annotated option the name of its values that people read: N, X, FILE, or the choices."""
    kind, *metadata = get_args(annotation) or (annotation,)
    for alternative in get_args(kind):
        if alternative is not NoneType and NoneType in get_args(kind):
            kind = alternative
            break
    for info in metadata:
        if isinstance(info, OptionInfo) and info.metavar is None and kind is not bool:
            info.metavar = METAVARS.get(kind) or "|".join(map(str, get_args(kind)))


class _Readable:
    """Common behaviour of a command and of the group of all commands, in front of typer's class."""

    params: list[Any]

    def get_help(self, ctx: Context) -> str:
        """Return the help."""
        for parameter in self.params:
            # typer prints the type of an argument behind its name, which reads as one word too many
            if isinstance(parameter, TyperArgument):
                vars(parameter)["display_type"] = lambda ctx: ""  # an argument's name says its type
        text: str = super().get_help(ctx)  # type: ignore[misc]
        return text

    def collect_usage_pieces(self, ctx: Context) -> list[str]:
        """Return the names as they are, optional ones in brackets."""
        pieces: list[str] = super().collect_usage_pieces(ctx)  # type: ignore[misc]
        return [re.sub(r"[{}]", "", piece).replace("......", "...") for piece in pieces]

    def make_context(self, *arguments: Any, **options: Any) -> Context:
        """Read the words of the command line; add to the message of a mistake what may have been meant."""
        try:
            context: Context = super().make_context(*arguments, **options)  # type: ignore[misc]
        except UsageError as error:
            _suggest(error)
            raise
        return context


class Command(_Readable, TyperCommand):  # type: ignore[misc]  # typer's own types do not agree with click's
    """A command."""


class Group(_Readable, TyperGroup):  # type: ignore[misc]
    """All commands."""


def _suggest(error: Any) -> None:
    """Add to the message of a usage error the option or the choice that may have been meant."""
    # click lists all that is similar: one suggestion is enough
    nearest = list(getattr(error, "possibilities", None) or [])[:1]
    if nearest:
        error.possibilities = []
    error.message = error.message.replace("Value error, ", "")
    # click has no suggestion for values of a choice, which are misspelt as often as options
    choice = re.fullmatch(r"'(.*)' is not one of (.*)\.", error.message, re.DOTALL)
    if choice:
        choices = re.findall(r"'([^']*)'", choice[2])
        nearest = [repr(name) for name in get_close_matches(choice[1], choices, n=1)]
        error.message = f"{choice[1]!r} is none of {', '.join(choices)}."
    if nearest:
        error.message = f"{error.message.rstrip('.')}. Did you mean {nearest[0]}?"
