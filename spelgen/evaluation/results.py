"""The results of an evaluation as people read them, in terminals and notebooks."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from html import escape

from spelgen.baselines.names import MODEL
from spelgen.evaluation.measurements import Measurements
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.verdict import verdict
from spelgen.labels import counted
from spelgen.listing import WIDTH


@dataclass(frozen=True, repr=False)
class Results(Measurements):
    """Show what `evaluate` measures: the same tables and verdict as `text` in a terminal and in a notebook."""

    def text(self) -> str:
        """Return every table for a terminal, the best of each row starred, then the verdict."""
        tables = [table.text() for table in result_tables(self)]
        judged = verdict(self)
        conclusion = textwrap.fill(f"{judged.sentence} {judged.because}", WIDTH, break_on_hyphens=False)
        return "\n\n".join([f"{self._heading()}; * marks the best of a row", *tables, conclusion])

    def __repr__(self) -> str:
        heading = self._heading()
        if self.horizons:
            last = self.horizons[-1]
            error = last.errors[MODEL].mean_relative_rms
            if error is not None:
                heading += f", relative RMS {error:.3g} after {last.name}"
        return f"<Results of {heading}>"

    def _repr_html_(self) -> str:
        tables = [table.listing().html() for table in result_tables(self)]
        return "".join([f"<p>{escape(verdict(self).sentence)}</p>", *tables])

    def _heading(self) -> str:
        return f"{self.robot} on {counted(len(self.trajectories), 'test trajectory')}"
