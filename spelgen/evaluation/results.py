"""The results of an evaluation, shown in terminals and notebooks."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from html import escape

from spelgen.evaluation.measurements import Measurements
from spelgen.evaluation.tables import result_tables
from spelgen.labels import MODEL, counted
from spelgen.listing import WIDTH


@dataclass(frozen=True, repr=False)
class Results(Measurements):
    """Measurements of `evaluate`, shown as an assessment and tables in a terminal or a notebook."""

    def text(self) -> str:
        """Return the assessment and all tables as text; a star marks the smallest error of each row."""
        paragraphs = [f"{self._heading()}; * marks the best of a row"]
        paragraphs += [table.text() for table in result_tables(self)]
        if self.assessment is not None:
            words = f"{self.assessment.sentence} {self.assessment.because}"
            # Lines are not broken at hyphens: a text search would not find a name with a line break.
            paragraphs.insert(0, textwrap.fill(words, WIDTH, break_on_hyphens=False))
        return "\n\n".join(paragraphs)

    def __repr__(self) -> str:
        heading = self._heading()
        for last in self.horizons[-1:]:
            error = last.errors[MODEL].mean_relative_rms
            if error is not None:
                heading += f", relative RMS {error:.3g} after {last.name}"
        return f"<Results of {heading}>"

    def _repr_html_(self) -> str:
        sentence = "" if self.assessment is None else self.assessment.sentence
        tables = [table.listing().html() for table in result_tables(self)]
        return "".join([f"<p>{escape(sentence)}</p>", *tables])

    def _heading(self) -> str:
        return f"{self.robot} on {counted(len(self.trajectories), 'test trajectory')}"
