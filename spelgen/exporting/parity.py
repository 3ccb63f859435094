"""Whether what was exported gives what the torch model gives: the largest difference at random states."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from spelgen.arm.arm import Coordinate
from spelgen.dynamics.tip import tip_kinematics
from spelgen.errors import RunError
from spelgen.exporting.trained import Trained
from spelgen.structure.nominal import working_range

if TYPE_CHECKING:
    from spelgen.loaded_arm import LoadedArm

STATES = 200
_TIP_TOLERANCE = 3e-6  # pytorch-kinematics rounds offsets to float32
_USUAL_SPEED = {"revolute": 1.0, "prismatic": 0.3}  # rad/s, m/s where the URDF names none

Values = dict[str, np.ndarray]
Called = Callable[[str, Values], Mapping[str, np.ndarray]]
"""What was exported: an entry point's name and its inputs, (states, n) each, to its outputs, (states, ...)."""


@dataclass(frozen=True)
class Parity:
    """The largest difference to the torch model by entry point, relative to the largest value, and what is allowed."""

    differences: dict[str, float]
    tolerance: float
    states: int

    @property
    def summary(self) -> str:
        """One sentence."""
        of_model = [name for name in self.differences if not name.startswith("tip_")]
        worst = max(of_model, key=lambda name: self.differences[name])
        return (
            f"{self.states} random states: at most {self.differences[worst]:.1e} ({worst}) from the torch module, "
            f"relative to the largest value; {self.tolerance:.0e} is allowed"
        )

    def require(self) -> Parity:
        """Itself. Raises RunError where a difference is larger than allowed."""
        for name, difference in self.differences.items():
            if not difference <= self._allowed(name):
                raise RunError(
                    f"{name} differs from the model by {difference:.1e}",
                    element="parity check",
                    expected=f"at most {self._allowed(name):.0e} of the largest value",
                    do="nothing was written; please report this with the run folder",
                )
        return self

    def _allowed(self, name: str) -> float:
        return max(self.tolerance, _TIP_TOLERANCE) if name.startswith("tip_") else self.tolerance


def check_parity(
    called: Called,
    trained: Trained,
    names: Sequence[str],
    tolerance: float,
    *,
    memory: int = 0,
    states: int = STATES,
    dtype: Any = np.float64,
) -> Parity:
    """``called`` held against the torch model at random states, at each of these entry points. Raises RunError.

    memory: numbers of friction's. dtype: of what ``called`` is given, to which the states are rounded.
    """
    random = random_inputs(trained.arm.arm.coordinates, states, memory)
    inputs = {key: value.astype(dtype).astype(np.float64) for key, value in random.items()}
    exact = copy.deepcopy(trained.model).double().cpu().requires_grad_(False)
    differences: dict[str, float] = {}
    for name in names:
        expected, found = reference(name, exact, trained.arm, inputs), called(name, inputs)
        differences[name] = max(relative(found[key], value) for key, value in expected.items())
    return Parity(differences, tolerance, states).require()


def random_inputs(coordinates: Sequence[Coordinate], states: int, memory: int = 0, seed: int = 0) -> Values:
    """States over the joints' ranges at their usual speeds, with torques of the size of friction and gravity."""
    random = np.random.default_rng(seed)
    speed = np.array([c.velocity or _USUAL_SPEED[c.kind] for c in coordinates])
    q = np.stack([random.uniform(*working_range(c), states) for c in coordinates], axis=-1)
    qd, qdd, dq = (size * speed * random.standard_normal(q.shape) for size in (0.5, 2.0, 0.05))
    z = 1e-4 * random.standard_normal((states, memory))
    tau = 10.0 * random.standard_normal(q.shape)
    u = q + 0.3 * random.standard_normal(q.shape)
    return {"q": q, "qd": qd, "qdd": qdd, "tau": tau, "z": z, "dq": dq, "u": u}


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    """The largest difference, relative to the largest value; NaN where one is NaN."""
    if not expected.size:
        return 0.0
    size = np.abs(expected).max()
    with np.errstate(invalid="ignore"):
        return float(np.abs(found - expected).max() / (size if size > 0 else 1.0))


def reference(name: str, model: Any, arm: LoadedArm, inputs: Values) -> dict[str, np.ndarray]:
    """What the torch model says of an entry point, by output."""
    q, qd, qdd, tau, dq = (torch.from_numpy(inputs[key]) for key in ("q", "qd", "qdd", "tau", "dq"))
    z = torch.from_numpy(inputs["z"]).unflatten(-1, (model.n, -1)) if inputs["z"].size else None
    kept = () if z is None else (z,)
    with torch.no_grad():
        if name.startswith("tip_"):
            tip = tip_kinematics(arm)
            found = {"pose": tip.pose(q)} if name == "tip_pose" else {"jacobian": tip.jacobian(q)}
        elif name == "servo_torque":
            found = {"tau": model.servo(torch.from_numpy(inputs["u"]), q, qd)}
        elif name == "energy":
            kinetic = 0.5 * (model.momentum(q, qd) * qd).sum(dim=-1)
            found = {"energy": torch.stack([kinetic, model.potential_energy(q)], dim=-1)}
        elif name == "friction_step":
            found = {"z_next": q[:, :0] if z is None else model.memory_after(z, dq).flatten(-2)}
        elif name == "friction_memory":
            found = {"z_start": q[:, :0] if z is None else model.memory(qd).flatten(-2)}
        elif name.endswith("derivatives"):
            found = _derivatives(name, model, q, qd, qdd if name.startswith("inverse") else tau, *kept)
        else:
            found = {key: value(model, q, qd, qdd, tau, kept) for key, value in [_VALUES[name]]}
    return {key: value.numpy() for key, value in found.items()}


_VALUES: dict[str, tuple[str, Callable[..., torch.Tensor]]] = {
    "inverse_dynamics": ("tau", lambda m, q, qd, qdd, tau, z: m.inverse_dynamics(q, qd, qdd, *z)),
    "forward_dynamics": ("qdd", lambda m, q, qd, qdd, tau, z: m.forward_dynamics(q, qd, tau, *z)),
    "mass_matrix": ("mass", lambda m, q, qd, qdd, tau, z: m.mass_matrix(q)),
    "bias": ("bias", lambda m, q, qd, qdd, tau, z: m.nonlinear_effects(q, qd)),
    "gravity": ("gravity", lambda m, q, qd, qdd, tau, z: m.gravity(q)),
    "friction": ("friction", lambda m, q, qd, qdd, tau, z: m.friction_torque(q, qd, *z)),
    "momentum": ("momentum", lambda m, q, qd, qdd, tau, z: m.momentum(q, qd)),
}


def _derivatives(name: str, model: Any, *states: torch.Tensor) -> dict[str, torch.Tensor]:
    """By automatic differentiation, of all states at once: none of them has a part in what becomes of the others."""
    function = getattr(model, name.removesuffix("_derivatives"))
    keys = ("dtau_dq", "dtau_dqd") if name.startswith("inverse") else ("dqdd_dq", "dqdd_dqd", "dqdd_dtau")
    given = [x.clone().requires_grad_() for x in states[: len(keys)]]
    with torch.enable_grad():
        outputs = function(*given, *states[len(keys) :]).sum(dim=0)
        rows = [torch.autograd.grad(x, given, retain_graph=True, materialize_grads=True) for x in outputs]
    by_state = zip(*rows, strict=True)
    return {key: torch.stack(columns, dim=-2) for key, columns in zip(keys, by_state, strict=True)}
