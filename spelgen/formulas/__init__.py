"""Closed forms of M(q) and V(q): expanded exactly, shortened, and written as text, as LaTeX and for SymPy."""
