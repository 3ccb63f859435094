"""The surroundings of an arm, which its motions must not touch: a floor and boxes, from a YAML file."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from spelgen.settings.values import Group, Number, Positive
from spelgen.settings.yaml_document import read_document, validated


class Box(Group):
    """A box. size: edges [m]. xyz [m], rpy [rad]: pose of its centre in the frame of the root link, as in a URDF."""

    size: tuple[Positive, Positive, Positive]
    xyz: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    rpy: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)


class Surroundings(Group):
    """The surroundings of an arm, in the frame of its root link.

    Attributes:
        floor: Height z of the floor [m]; None: there is no floor.
        boxes: Boxes by name.
        clearance: Smallest allowed distance between links, and from links to floor and boxes [m].
    """

    floor: Number | None = None
    boxes: dict[str, Box] = Field(default_factory=dict)
    clearance: Positive = 0.01


def read_surroundings(path: Path) -> Surroundings:
    """Return the surroundings in a YAML file. Raises SettingsError, or SpelgenErrors for several errors."""
    document = read_document(path)
    return validated(Surroundings, document.value(), document)
