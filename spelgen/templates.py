"""Templates -> text. Templates contain layout only; their content is computed in Python."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

_BESIDE_THE_CODE = Path(__file__).parent / "templates"  # in an installed package
_IN_THE_REPOSITORY = Path(__file__).parent.parent / "templates"


@cache
def _folder() -> Path:
    return _BESIDE_THE_CODE if _BESIDE_THE_CODE.is_dir() else _IN_THE_REPOSITORY


@cache
def _environment(autoescape: bool) -> Environment:
    return Environment(
        loader=FileSystemLoader(_folder()),
        undefined=StrictUndefined,
        autoescape=autoescape,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def render(template: str, **context: object) -> str:
    """Return the text of ``template`` with ``context``.

    An undefined name is an error, and HTML templates escape text.
    """
    return _environment(".html" in template).get_template(template).render(**context)


def read(name: str) -> str:
    """Return the text of a file in the folder of templates, which pages contain unchanged."""
    return (_folder() / name).read_text(encoding="utf-8")
