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
    hint = ""
    if not urdf.is_file():
        reason = "there is no URDF beside it to write it anew from"
        hint = "; fit(arm=...) and train --robot keep one"
    else:
        try:
            if rebuilt(facts, urdf) == source:
                return
            reason = "it is not what spelgen writes for the URDF beside it"
        except SpelgenError as error:
            reason = f"it cannot be written anew ({error})"
    raise RunError(
        f"a module that spelgen cannot verify: {reason}", file=module,
        do="read it, then pass --trust (in Python: trust=True), or build it again and start a new run" + hint,
    )  # fmt: skip
