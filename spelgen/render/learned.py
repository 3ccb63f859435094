"""What a trained model has learned that is a plain number: the constants of its mass matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.render.plots import INERTIA_UNITS

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


@dataclass(frozen=True)
class Constant:
    """A trained constant: what it is, where it enters M, its value before training and after, in that
    entry's unit.
    """

    what: str
    where: str
    start: float
    learned: float
    unit: str


@dataclass(frozen=True)
class Learned:
    """parameters: how many numbers were trained. constants: those of M, none where the preset has none."""

    parameters: int
    constants: tuple[Constant, ...]


def read_learned(run: RunFolder) -> Learned:
    """What the best model of a run has learned. Raises ModuleError or RunError when it cannot be read."""
    before: Any = run.load_module()
    after: Any = trained_model(run)
    found = []
    if hasattr(after, "mass") and hasattr(after.mass, "constants"):
        basis = after.mass.constant_basis.reshape(-1, after.n, after.n)
        values = zip(basis, _constants(before), _constants(after), strict=True)
        found += [_constant(*each, after.joint_types) for each in values]
    return Learned(sum(parameter.numel() for parameter in after.parameters()), tuple(found))


def _constants(model: EmittedModel) -> list[float]:
    dynamics: Any = model
    return list(dynamics.mass.constants().tolist())


def _constant(basis: torch.Tensor, start: float, learned: float, joint_types: Sequence[str]) -> Constant:
    entries = [(i, j) for i, j in basis.tril().nonzero().tolist()]
    where = " ".join(
        f"{_factor(basis[i, j].item(), k == 0)}M{entry_index(i, j)}" for k, (i, j) in enumerate(entries)
    )
    unit = INERTIA_UNITS.get(" ".join(joint_types[k] for k in entries[0]), "kg m")
    return Constant("links", where, start, learned, unit)


def entry_index(row: int, column: int) -> str:
    """`21` for row 1, column 0: how an entry of a matrix is called."""
    return f"{row + 1}{column + 1}" if row < 9 else f"({row + 1},{column + 1})"


def _factor(value: float, first: bool) -> str:
    """`2 `, `- 0.5 `, `+ `: a coefficient in a sum of entries."""
    sign = ("-" if first else "- ") if value < 0 else ("" if first else "+ ")
    return sign if abs(value) == 1 else f"{sign}{abs(value):.4g} "
