"""Rendering of results as charts, tables and HTML pages."""
