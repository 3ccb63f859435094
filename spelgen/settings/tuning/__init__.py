"""Tuned numbers of each room: frozen dataclasses whose fields have a unit, a meaning and a source."""
