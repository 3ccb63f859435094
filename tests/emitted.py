"""Emitted modules for tests, generated from a URDF and imported from a file.

Models of `random_model` have random parameters. In models of `exact_model`, polynomials in cos q, sin q and q replace
the networks, so that M and V are exactly the URDF's.
"""

from __future__ import annotations

import hashlib
import importlib.util
import subprocess
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from flint import fmpq_mpoly
from polynomials import polynomials
from torch import nn

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.design import Design
from spelgen.emission.plan import derive_spec
from spelgen.emission.specify import generate
from spelgen.emission.text import module_text
from spelgen.spec import Options
from spelgen.structure.structure import Structure, derive

ROBOTS = Path(__file__).parents[1] / "robots"
GANTRY = """<robot name="gantry"><link name="base"/><link name="bridge"/><link name="trolley"/>
<joint name="along" type="prismatic"><parent link="base"/><child link="bridge"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
<joint name="across" type="prismatic"><parent link="bridge"/><child link="trolley"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint></robot>"""
"""Nothing of its M or V depends on q: no network is needed."""
FOLLOWED = """<robot name="followed">
  <link name="base"/>
  <link name="a"><inertial><origin xyz="0.2 0 0.1"/><mass value="2"/>
    <inertia ixx="0.1" ixy="0.01" ixz="0" iyy="0.1" iyz="0.02" izz="0.15"/></inertial></link>
  <link name="b"><inertial><origin xyz="0.1 0.1 0"/><mass value="1"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <link name="c"><inertial><origin xyz="0 0.1 0.1"/><mass value="1.5"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.15"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="2"/></joint>
  <joint name="follow" type="revolute"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
    <origin xyz="0.4 0 0"/><mimic joint="turn" multiplier="-2" offset="0.3"/>
    <limit lower="-2" upper="2" effort="10" velocity="2"/></joint>
  <joint name="slide" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
    <origin xyz="0 0.2 0" rpy="0.4 0 0"/><limit lower="0" upper="0.5" effort="10" velocity="1"/></joint>
</robot>"""
NETWORKS = Design(
    mass="derived", potential="derived", dissipation="per-joint", input="derived", memory="none", net="mlp",
    encoding="joint",
)  # fmt: skip
"""M and V by networks of the derived structure, without rigid bodies."""
SIX = ("two_link", "rpr", "six_dof", "scara", "panda", "ur10e")


def import_source(source: str, path: Path) -> ModuleType:
    """Write ``source`` to ``path`` and import it from there."""
    path.write_text(source, encoding="utf-8")
    name = f"{path.stem}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    # torch.compile finds the module in sys.modules
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def closed_forms(robots: Iterable[str], folder: Path) -> dict[str, tuple[ModuleType, Chain]]:
    """Return {name: (closed-form module, arm)} for the named robots and for `FOLLOWED`, an arm with a mimic joint."""
    urdf = folder / "followed.urdf"
    urdf.write_text(FOLLOWED, encoding="utf-8")
    made = {}
    for path in (*(ROBOTS / f"{name}.urdf" for name in robots), urdf):
        source = generate(path, preset="closed-form")
        made[path.stem] = import_source(source, folder / f"{path.stem}_closed_form.py"), load_arm(path).chain
    return made


def printed_without_structure(code: str, path: Path) -> str:
    """Run Python code with `path` as argument, in a process that cannot import spelgen.structure; return its output."""
    blocked = ("sympy", "flint", "spelgen.structure", "spelgen.emission.plan", "spelgen.arm.arm")
    program = f"import sys\nfor name in {blocked}:\n    sys.modules[name] = None\n{code}"
    run = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=False
    )
    assert not run.returncode, run.stderr
    return run.stdout


@cache
def built(
    robot: str,
    assume: str = "kinematics",
    preset: str = "hybrid",
    design: Design | None = None,
    *,
    standalone: bool = False,
) -> tuple[str, Structure]:
    """Return the text of a robot's emitted module, and the robot's derived structure of M and V.

    robot: name of a URDF in the folder robots. assume, preset, design: see `Options`. standalone: True for a module
    that does not import spelgen.
    """
    arm = _loaded(robot)
    spec = derive_spec(arm, Options(preset=preset, design=design, assume=assume))
    return module_text(spec, standalone=standalone), derive(arm.chain, assume)


@cache
def _loaded(robot: str) -> Arm:
    return load_arm(ROBOTS / f"{robot}.urdf")


def random_model(
    robot: str,
    folder: Path,
    *,
    seed: int,
    deviation: float | None = None,
    preset: str = "hybrid",
    design: Design | None = None,
) -> nn.Module:
    """Return the emitted model of a robot, with random parameters.

    robot: name of a URDF in the folder robots. seed, deviation: see ``randomise``. preset, design: see `Options`.
    """
    source = built(robot, preset=preset, design=design)[0]
    model = import_source(source, folder / f"{robot}_spel.py").Model(seed=seed)
    randomise(model, seed, deviation)
    return model


def randomise(model: nn.Module, seed: int, deviation: float | None = None) -> None:
    """Replace parameters of a model by normal random numbers with zero mean.

    deviation: standard deviation of all parameters except `raw_armature`, the logarithm of armature / nominal armature,
    whose standard deviation is always 1. None: 0.3 for residual terms and 1 / sqrt(fan-in) for networks, so that no
    term is negligible; other parameters are unchanged.
    """
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in model.named_parameters():
        draw = torch.randn(parameter.shape, dtype=parameter.dtype, generator=generator)
        if name.endswith("raw_armature"):
            parameter.data = draw
        elif deviation is not None:
            parameter.data = deviation * draw
        elif "residuals.raw" in name:
            parameter.data = 0.3 * draw
        elif "network" in name or "potential." in name or "residuals.mass." in name:
            # 1 / sqrt(fan-in); a unit of a Kolmogorov-Arnold layer has a parameter per input and grid point: its fan-in
            # is the number of inputs times the number of grid points
            inputs = parameter[0].numel() if parameter.dim() == 3 else parameter.shape[-1]
            parameter.data = draw * inputs**-0.5


def network_inputs(model: nn.Module, q: torch.Tensor) -> torch.Tensor:
    """Return the inputs of a model's networks at q (..., n): the encoding of positions, (..., encoded)."""
    owner = getattr(model, "residuals", model)
    encoded: torch.Tensor = owner.encoding(q)
    return encoded


def outputs_alone(network: nn.Module, encoded: torch.Tensor) -> torch.Tensor:
    """Return the raw outputs of a network, (..., outputs): no scales, means or sums of the model are applied."""
    count = len(network.biases[-1])
    layers = network.prepare(torch.eye(count, dtype=encoded.dtype), encoded.new_zeros(count))
    y: torch.Tensor = network(encoded, layers)[0]
    return y


def bounded(model: nn.Module, q: torch.Tensor) -> torch.Tensor:
    """Return a mask (...): True for states q (..., n) at which the model changes M to keep it positive definite."""
    part: torch.Tensor = model.at(q).intermediates[1]
    return part < 1


def frictionless(model: nn.Module) -> nn.Module:
    """Set the friction of a model to zero; return the model."""
    model.friction.nominal.zero_()
    return model


class ExactFunctions(nn.Module):
    """Polynomials in place of a network of an emitted model, so that the functions of the model are known exactly.

    The model computes a function as mean + scale y from a network output y, so y is (polynomial - mean) / scale here.
    """

    def __init__(
        self, functions: list[fmpq_mpoly], mean: torch.Tensor, scale: torch.Tensor, encoding: nn.Module
    ):
        super().__init__()
        self.mean, self.scale, self.n = mean, scale, len(encoding.center)
        self.encoding = encoding
        self.reach = torch.where(encoding.slope > 0, 1 / encoding.slope, 0.0)
        self.values = [_compiled(f) for f in functions]
        self.slopes = [
            [_compiled(f.derivative(3 * k + letter)) for k in range(self.n) for letter in range(3)]
            for f in functions
        ]

    def prepare(self, output_map: torch.Tensor, offset: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return output_map, offset

    def forward(
        self, encoded: torch.Tensor, layers: tuple[torch.Tensor, torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        output_map, offset = layers
        first, second = encoded.split(self.n, dim=-1)
        q = first * self.reach + self.encoding.center
        # variables of the polynomials, (..., 3 n): c1, s1, q1, c2, ...
        variables = torch.stack([first, second, q], dim=-1).flatten(-2)
        y = torch.stack([_evaluated(f, variables) for f in self.values], dim=-1)
        slopes = torch.stack(
            [torch.stack([_evaluated(d, variables) for d in row], dim=-1) for row in self.slopes], dim=-2
        )
        by_c, by_s, by_q = slopes.unflatten(-1, (self.n, 3)).unbind(dim=-1)
        jacobian = torch.cat([by_c * self.encoding.revolute + by_q * self.reach, by_s], dim=-1)
        y = (y - self.mean) / self.scale
        return y @ output_map.mT + offset, output_map @ (jacobian / self.scale.unsqueeze(-1))

    def vjp(self, jacobian: torch.Tensor, cotangent: torch.Tensor) -> torch.Tensor:
        return (cotangent.unsqueeze(-2) @ jacobian).squeeze(-2)

    def jvp(self, jacobian: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
        return (jacobian @ tangent.unsqueeze(-1)).squeeze(-1)


def exact_model(robot: str, folder: Path) -> nn.Module:
    """Return the robot's emitted model with the URDF's true dynamics and no friction.

    Exact polynomials replace the networks, and constants have their exact values.
    """
    source, structure = built(robot, design=NETWORKS)
    module = import_source(source, folder / f"{robot}_exact.py")
    model = frictionless(module.Model())
    mass = model.mass
    mass.nominal_armature.zero_()
    true = polynomials(_loaded(robot).chain, inertials=True)
    if structure.outputs:
        functions = [true.combination(output.functional) for output in structure.outputs]
        encoding = model.encoding
        mass.network = ExactFunctions(functions, mass.function_mean, mass.function_scale, encoding)
    if structure.potential:
        scale = model.scale[0]
        model.potential = ExactFunctions([true.potential], torch.zeros_like(scale), scale, model.encoding)
    constants = [true.combination(constant.functional) for constant in structure.constants]
    assert all(sum(c.degrees()) == 0 for c in constants), "a constant depends on q"
    values = torch.tensor([_float(c.leading_coefficient()) for c in constants], dtype=torch.float64)
    mass.raw_constants.data = values / mass.constant_scale
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
