"""The tables of an evaluation as one long CSV table: a row for each of their numbers, with all its digits."""

from __future__ import annotations

import csv
import io

from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import result_tables

HEAD = ("table", "row", "predictor", "value")


def csv_text(results: Results) -> str:
    """Return the numbers of all tables, which name the units; an empty value stands for one that is not known."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(HEAD)
    for table in result_tables(results):
        for row in table.rows:
            for predictor, value in row.values.items():
                writer.writerow((table.title, row.label, predictor, value))
    return file.getvalue()
