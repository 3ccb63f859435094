"""A fleet -> one self-contained HTML page: which model is best for each arm, and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spelgen.files import write_text
from spelgen.fleet.fleet import FleetResults
from spelgen.fleet.ranking import winners
from spelgen.labels import counted, listed
from spelgen.listing import Listing
from spelgen.render.page import render_page


def write_fleet(fleet: FleetResults, listings: Sequence[Listing], path: Path) -> Path:
    """Write the page; return its path."""
    arms = len({result["robot"] for result in fleet.results})
    wins = [f"{name} of {count}" for name, count in winners(fleet).items()]
    text = render_page(
        "fleet.html.jinja",
        verdict=f"Smallest error on {counted(arms, 'arm')}: {listed(wins)}." if wins else "No run has ended.",
        runs=len(fleet.results),
        failures=len(fleet.failures),
        listings=listings,
    )
    return write_text(path, text)
