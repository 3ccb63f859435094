"""An arm's model at once: its module generated and loaded, all in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.design import Design
from spelgen.emission.loading import load_module
from spelgen.pipeline.generate import generate
from spelgen.pipeline.loaded_arm import LoadedArm
from spelgen.urdf.robot import Assume

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


def build(
    arm: LoadedArm | str | Path,
    preset: str | Path | Design = "hybrid",
    *,
    width: int = 64,
    depth: int = 2,
    assume: Assume = "kinematics",
    seed: int = 0,
) -> EmittedModel:
    """An instance of the model tailored to an arm, untrained; arguments and errors as for ``generate``.

    ``seed``: of the weights that it starts with. ``model.source`` is the text of its module, ``model.facts`` what
    it was made from.
    """
    return load_module(generate(arm, preset, width=width, depth=depth, assume=assume), seed=seed)
