"""A run folder's module is a program. It is run only where it is the very text that spelgen itself writes."""

from __future__ import annotations

from pathlib import Path

from spelgen.errors import RunError, SpelgenError
from spelgen.pipeline import rebuilt
from spelgen.spec import parse_facts, read_source


def require_own_module(module: Path, urdf: Path) -> None:
    """Raise RunError unless the module is what its facts and the URDF beside it give, by this version of spelgen."""
    source = read_source(module)
    facts = parse_facts(source, module)
    why, keeps = (
        "there is no URDF beside it to write it anew from",
        "; fit(arm=...) and train --robot keep one",
    )
    if urdf.is_file():
        try:
            if rebuilt(facts, urdf) == source:
                return
            keeps, why = "", "it is not what spelgen writes for the URDF beside it"
        except SpelgenError as error:
            keeps, why = "", f"it cannot be written anew ({error})"
    raise RunError(
        f"a module that may do anything when it is run: {why}", file=module,
        do="read it, then say --trust (in Python: trust=True), or build it again and start a new run" + keeps,
    )  # fmt: skip
