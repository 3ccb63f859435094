"""How the help of a command looks, and how a mistake in its words is told."""

from __future__ import annotations

import os
import re
import sys
from difflib import get_close_matches
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup
from typer.models import OptionInfo

UsageError: type[Exception] = typer.BadParameter.__mro__[1]
METAVARS = {int: "N", float: "X", str: "TEXT", Path: "FILE"}
BOLD, CYAN, PLAIN = "\x1b[1m", "\x1b[36m", "\x1b[0m"


def readable(annotation: Any) -> None:
    """Give an annotated option the name of its values that people read: N, X, FILE, or the choices."""
    kind, *about = get_args(annotation) or (annotation,)
    kind = next(
        (each for each in get_args(kind) if each is not NoneType and NoneType in get_args(kind)), kind
    )
    for info in about:
        if isinstance(info, OptionInfo) and info.metavar is None and kind is not bool:
            info.metavar = METAVARS.get(kind) or "|".join(map(str, get_args(kind)))


def in_colour() -> bool:
    """Whether stdout is a terminal that shows colours, and nobody said NO_COLOR (no-color.org)."""
    return sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


class _Told:
    """What commands and the group of all commands have in common."""

    params: list[Any]

    def get_help(self, ctx: Any) -> str:
        """The help, coloured on terminals."""
        for param in self.params:
            if isinstance(param, TyperArgument):
                param.display_type = lambda ctx: ""  # type: ignore[method-assign]  # its name says it
        text: str = super().get_help(ctx)  # type: ignore[misc]
        if not in_colour():
            return text
        text = re.sub(r"^(\w+:)", rf"{BOLD}\1{PLAIN}", text, flags=re.MULTILINE)
        return re.sub(
            r"^(  (?:-\S*(?:,? \S+)*|[a-z]\S*))(?=  |$)", rf"{CYAN}\1{PLAIN}", text, flags=re.MULTILINE
        )

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Names as they are, optional ones in brackets."""
        pieces: list[str] = super().collect_usage_pieces(ctx)  # type: ignore[misc]
        return [re.sub(r"[{}]", "", piece).replace("......", "...") for piece in pieces]

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """Read the words of the command line; what is wrong is told with what may have been meant."""
        try:
            return super().make_context(*args, **kwargs)  # type: ignore[misc]
        except UsageError as error:
            _suggest(error)
            raise


class Command(_Told, TyperCommand):
    """A command."""


class Group(_Told, TyperGroup):
    """All commands."""


def _suggest(error: Any) -> None:
    """Add to the message of a usage error the option or the choice that may have been meant."""
    nearest = list(getattr(error, "possibilities", None) or [])[:1]
    if nearest:
        error.possibilities = []
    error.message = error.message.replace("Value error, ", "")
    choice = re.fullmatch(r"'(.*)' is not one of (.*)\.", error.message, re.DOTALL)
    if choice:
        known = re.findall(r"'([^']*)'", choice[2])
        nearest = [repr(each) for each in get_close_matches(choice[1], known, n=1)]
        error.message = f"{choice[1]!r} is none of {', '.join(known)}."
    if nearest:
        error.message = f"{error.message.rstrip('.')}. Did you mean {nearest[0]}?"
