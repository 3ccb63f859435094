"""A derived structure as one self-contained HTML page."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spelgen import __version__
from spelgen.inspection import Inspection, reach
from spelgen.labels import joint_ranges
from spelgen.templates import render
from spelgen.verify.agreement import Verification

if TYPE_CHECKING:
    from spelgen.formulas.formulas import Formulas

_WIDTH = 100  # of the closed forms


def page(found: Inspection, closed: Formulas | None = None, proof: Verification | None = None) -> str:
    """The page about ``found``, with the closed forms and the proof where they are given.

    It has no scripts and needs no other file; all that comes from the URDF is escaped.
    """
    text = None
    if closed:  # SymPy is read in only for formulas
        from spelgen.formulas.text import text as written

        text = written(closed, _WIDTH)
    return render(
        "inspection.html.jinja",
        version=__version__,
        found=found,
        rows=_rows(found),
        joints=[(each.name, each.kind, reach(each)) for each in found.arm.coordinates],
        closed=text,
        proof=proof,
    )


def _rows(found: Inspection) -> list[list[tuple[str, str]]]:
    """The whole symmetric M: of each entry its kind, and the joints it depends on."""
    n = len(found.structure.joints)
    cells = {(e.row, e.column): (e.kind, joint_ranges(e.joints)) for e in found.structure.entries}
    return [[cells[max(i, j), min(i, j)] for j in range(n)] for i in range(n)]
