"""Fits of an arm's model to logs; the results are written to a run folder."""
