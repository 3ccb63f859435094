"""Results to charts, tables and HTML pages."""
