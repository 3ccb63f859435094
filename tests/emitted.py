"""Emitted modules for tests: built from a URDF, imported by path, and filled with exact functions or random
weights.
"""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from flint import fmpq_mpoly
from torch import nn

from spelgen.emission.emit import emit
from spelgen.emission.plan import plan_model
from spelgen.pipeline import load
from spelgen.spec import Options
from spelgen.structure.structure import Structure, derive
from spelgen.structure.symbolic import polynomials

ROBOTS = Path(__file__).parents[1] / "robots"
GANTRY = """<robot name="gantry"><link name="base"/><link name="bridge"/><link name="trolley"/>
<joint name="along" type="prismatic"><parent link="base"/><child link="bridge"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
<joint name="across" type="prismatic"><parent link="bridge"/><child link="trolley"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint></robot>"""
"""Nothing of its M or V depends on q: no network is needed."""
SIX = ("two_link", "rpr", "six_dof", "scara", "panda", "ur10e")


def import_source(source: str, path: Path) -> ModuleType:
    """Write ``source`` to ``path`` and import it from there."""
    path.write_text(source, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def built(
    robot: str, assume: str = "kinematics", preset: str = "minimal", net: str | None = None
) -> tuple[str, Structure]:
    """Source and structure of one of the robots that come with spelgen."""
    loaded = load(ROBOTS / f"{robot}.urdf")
    structure = derive(loaded.arm, assume)
    options = Options(preset=preset, net=net, assume=assume)
    spec = plan_model(
        loaded.arm,
        structure,
        loaded.actuation,
        options,
        urdf=f"{robot}.urdf",
        urdf_sha256=loaded.robot.digest,
    )
    return emit(spec), structure


def random_model(
    robot: str,
    folder: Path,
    *,
    seed: int,
    deviation: float | None = None,
    preset: str = "minimal",
    net: str | None = None,
) -> nn.Module:
    """The robot's model with random weights, as ``randomise`` draws them."""
    source = built(robot, preset=preset, net=net)[0]
    model = import_source(source, folder / f"{robot}_spel.py").Model(seed=seed)
    randomise(model, seed, deviation)
    return model


def randomise(model: nn.Module, seed: int, deviation: float | None = None) -> None:
    """Draw every weight anew: with this standard deviation, or with the inverse root of a layer's inputs."""
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in model.named_parameters():
        draw = torch.randn(parameter.shape, dtype=parameter.dtype, generator=generator)
        if name == "rotor":
            parameter.data = draw
        elif deviation is not None:
            parameter.data = deviation * draw
        elif "network" in name:
            # a Kolmogorov-Arnold network has a grid of weights for each input
            inputs = parameter[0].numel() if parameter.dim() == 3 else parameter.shape[-1]
            parameter.data = draw * inputs**-0.5


def network_inputs(model: nn.Module, q: torch.Tensor) -> torch.Tensor:
    """What the networks of a model with or without waves read of q, (..., features)."""
    features = model._features(q)
    inputs: torch.Tensor = getattr(features, "own", features)
    return inputs


def frictionless(model: nn.Module) -> nn.Module:
    """The model without dissipation."""
    model.friction.size.zero_()
    return model


class ExactFunctions(nn.Module):
    """Stands in for a network: y = (polynomial - mean) / scale, with exact derivatives."""

    def __init__(self, functions: list[fmpq_mpoly], mean: torch.Tensor, scale: torch.Tensor, joints: tuple):
        super().__init__()
        self.mean, self.scale, self.n = mean, scale, len(joints)
        self.revolute = [joint.revolute for joint in joints]
        self.center = torch.tensor([joint.center for joint in joints], dtype=torch.float64)
        self.reach = torch.tensor([joint.reach for joint in joints], dtype=torch.float64)
        self.values = [_compiled(f) for f in functions]
        self.slopes = [
            [_compiled(f.derivative(3 * k + letter)) for k in range(self.n) for letter in range(3)]
            for f in functions
        ]

    def prepared(self, outlay: torch.Tensor, offset: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return outlay, offset

    def forward(
        self, features: torch.Tensor, laid_out: tuple[torch.Tensor, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        outlay, offset = laid_out
        cos, sin, *rest = features.split(self.n, dim=-1)
        q = rest[0] * self.reach + self.center if rest else torch.zeros_like(cos)
        variables = torch.stack([cos, sin, q], dim=-1).flatten(-2)  # (..., 3 n): c1, s1, q1, c2, ...
        y = torch.stack([_evaluated(f, variables) for f in self.values], dim=-1)
        slopes = torch.stack(
            [torch.stack([_evaluated(d, variables) for d in row], dim=-1) for row in self.slopes], dim=-2
        )
        by_c, by_s, by_q = slopes.unflatten(-1, (self.n, 3)).unbind(dim=-1)
        jacobian = torch.cat([by_c, by_s, by_q * self.reach] if rest else [by_c, by_s], dim=-1)
        y = (y - self.mean) / self.scale
        return y @ outlay.mT + offset, outlay @ (jacobian / self.scale.unsqueeze(-1))

    def pull(self, jacobian: torch.Tensor, cotangent: torch.Tensor) -> torch.Tensor:
        return (cotangent.unsqueeze(-2) @ jacobian).squeeze(-2)

    def push(self, jacobian: torch.Tensor, rate: torch.Tensor) -> torch.Tensor:
        return (jacobian @ rate.unsqueeze(-1)).squeeze(-1)


def exact_model(robot: str, folder: Path) -> nn.Module:
    """The robot's emitted model with the URDF's true values: exact functions for networks, exact constants,
    no friction.
    """
    source, structure = built(robot)
    module = import_source(source, folder / f"{robot}_exact.py")
    model = frictionless(module.Model())
    model.rotor_size.zero_()
    true = polynomials(load(ROBOTS / f"{robot}.urdf").arm, inertials=True)
    if structure.outputs:
        functions = [true.combination(output.reads) for output in structure.outputs]
        model.mass_network = ExactFunctions(functions, model.output_mean, model.output_scale, module.JOINTS)
    if structure.potential:
        scale = torch.tensor([module.POTENTIAL_SCALE], dtype=torch.float64)
        model.potential_network = ExactFunctions(
            [true.potential], torch.zeros_like(scale), scale, module.JOINTS
        )
    for series in ("mass_series", "potential_series"):  # the functions are whole without them
        if hasattr(model, series):
            getattr(model, series).size.zero_()
    constants = [true.combination(constant.reads) for constant in structure.constants]
    assert all(sum(c.degrees()) == 0 for c in constants), "a constant depends on q"
    values = torch.tensor([_float(c.leading_coefficient()) for c in constants], dtype=torch.float64)
    model.constants.data = values / model.constant_scale
    return model


def _compiled(polynomial: fmpq_mpoly) -> tuple[torch.Tensor, torch.Tensor]:
    terms = list(polynomial.terms())
    exponents = torch.tensor([e for e, _ in terms] or np.zeros((0, 0)), dtype=torch.float64)
    return exponents, torch.tensor([_float(c) for _, c in terms], dtype=torch.float64)


def _evaluated(compiled: tuple[torch.Tensor, torch.Tensor], variables: torch.Tensor) -> torch.Tensor:
    exponents, coefficients = compiled
    if not len(coefficients):
        return variables.new_zeros(variables.shape[:-1])
    return (variables.unsqueeze(-2) ** exponents).prod(dim=-1) @ coefficients


def _float(x: object) -> float:
    return int(x.p) / int(x.q)
