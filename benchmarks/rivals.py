"""Other methods of the field, for `leaderboard.py`: figaroh, MuJoCo sysid, Gaussian processes, networks.

Packages: figaroh (with Pinocchio) and `mujoco[sysid]`, in an environment of their own that has this checkout in
PYTHONPATH; all others need PyTorch only. Each method gets the training samples of the leaderboard; settings are chosen
by the error in held-out blocks of these samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from figaroh_identification import figaroh_dynamics
from torch import Tensor, nn
from torch.func import grad, jvp

import spelgen
from spelgen.exporting.mjcf_export import mjcf_text
from spelgen.exporting.rigid_body_projection import rigid_body_projection
from spelgen.logs.dynamics_samples import DynamicsSamples

if TYPE_CHECKING:
    from leaderboard import Problem

Torque = Callable[[DynamicsSamples], np.ndarray]


class Prediction(NamedTuple):
    """A fitted method as functions of samples: torque, (T, n) [Nm, N], and its standard deviation (None: unknown)."""

    torque: Torque
    std: Torque | None = None


Method = Callable[["Problem"], Prediction]

WIDTHS, DECAYS = (32, 128), (1e-4, 1e-1)  # candidates for networks: units per hidden layer, weight decay
EPOCHS, PATIENCE, BATCH = 400, 30, 512
SMOOTHING = 0.02  # [rad/s] width of tanh(qd / width), the Coulomb friction of networks and Gaussian processes
SYSID_SAMPLES = 600  # samples for MuJoCo's sysid: few, as it computes inverse dynamics one sample at a time
# samples of the Gaussian process; samples, steps and learning rate of the fit of its hyperparameters
GP_SAMPLES, GP_TRAINING, GP_STEPS, GP_RATE = 1500, 300, 100, 0.05


def figaroh(problem: Problem) -> Prediction:
    """Fit figaroh's weighted least squares (`figaroh_identification.py`); return its prediction."""
    dynamics = figaroh_dynamics(problem.arm.chain, problem.arm.settings, problem.samples)
    return Prediction(lambda x: dynamics.inverse_dynamics(*tensors(x)))


def tensors(x: DynamicsSamples) -> tuple[Tensor, Tensor, Tensor]:
    """Return q, qd and qdd of samples as tensors, (T, n) each."""
    q, qd, qdd = (torch.from_numpy(np.ascontiguousarray(column)) for column in (x.q, x.qd, x.qdd))
    return q, qd, qdd


def subset(samples: Sequence[DynamicsSamples], count: int) -> DynamicsSamples:
    """Return at most `count` evenly spread samples of all trajectories."""
    columns = [np.concatenate([getattr(x, name) for x in samples]) for name in ("q", "qd", "qdd", "tau")]
    rows = np.unique(np.linspace(0, len(columns[0]) - 1, count).round().astype(int))
    return DynamicsSamples("subset", *(column[rows] for column in columns))


def mujoco_sysid(problem: Problem) -> Prediction:
    """Fit inertias, damping, friction loss, armature and offset by MuJoCo's sysid; return the torque of its model.

    Inertias are pseudo-inertia matrices. The residual is the torque residual of inverse dynamics, divided by the
    standard deviation of each joint's torque, on a subset of the samples. The initial values are the URDF's.
    """
    import mujoco
    from mujoco import sysid

    model = spelgen.build(problem.fold.urdf, "closed-form")
    spec = mujoco.MjSpec.from_string(mjcf_text(rigid_body_projection(model, problem.arm))[0].decode())
    compiled, names = spec.compile(), problem.arm.chain.joint_names
    samples = subset(problem.samples, SYSID_SAMPLES)
    scale = np.maximum(samples.tau.std(axis=0), 1e-3 * samples.tau.std(axis=0).max())
    parameters = sysid.ParameterDict()
    bounds = {
        "mass_bound_mult": np.array([0.01, 100.0]), "stretch_bound_mult": np.array([0.01, 100.0]),
        "ipos_bound_off": np.array([-1.0, 1.0]), "shear_bound_off": np.array([-1.0, 1.0]),
    }  # fmt: skip
    for k in range(1, compiled.nbody):
        body = compiled.body(k).name

        def set_inertia(changed: Any, parameter: Any, body: str = body) -> None:
            _set_inertia(changed.body(body), sysid.model_modifier.pi_from_theta(parameter.value))

        parameters.add(
            sysid.body_inertia_param(
                spec, compiled, body, sysid.InertiaType.Pseudo, modifier=set_inertia, **bounds
            )
        )
    for name, range_ in zip(names, scale, strict=True):

        def set_drive(changed: Any, parameter: Any, name: str = name) -> None:
            joint = changed.joint(name)
            damping, joint.frictionloss, joint.armature = parameter.value
            joint.damping = [damping, 0.0, 0.0]  # (d0, d1, d2) of the torque (d0 + d1 |qd| + d2 qd^2) qd

        parameters.add(
            sysid.Parameter(
                f"{name}_drive", [0.1 * range_] * 3, [0.0] * 3, [10 * range_] * 3, modifier=set_drive
            )
        )
    parameters.add(sysid.Parameter("offset", 0 * scale, -10 * scale, 10 * scale))

    def torque(x: DynamicsSamples, values: Any) -> np.ndarray:
        """Return the torque by MuJoCo's inverse dynamics plus the torque offset of each joint, (T, n) [Nm].

        x: samples. values: `ParameterDict` of inertias, drive constants and offsets.
        """
        changed = sysid.apply_param_modifiers(values, spec.copy())
        data, rows = mujoco.MjData(changed), []
        for q, qd, qdd in zip(x.q, x.qd, x.qdd, strict=True):
            data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
            mujoco.mj_inverse(changed, data)
            rows.append(data.qfrc_inverse.copy())
        return np.array(rows) + values["offset"].value

    def residual(x: np.ndarray, values: Any) -> tuple[list[np.ndarray], None, None]:
        """Return [residuals], None, None for k parameter vectors; `sysid.optimize` needs a result of this form.

        x: (P, k), a parameter vector per column; or (P,). values: `ParameterDict` of `sysid`, overwritten with each
        vector. residuals: (S n, k) or (S n,) [1], torque residuals of S samples and n joints, divided by `scale`, the
        standard deviation of each joint's torque.
        """
        columns = []
        for vector in x.reshape(len(x), -1).T:
            values.update_from_vector(vector)
            columns.append(((torque(samples, values) - samples.tau) / scale).ravel())
        return [np.stack(columns, axis=1).reshape(-1, *x.shape[1:])], None, None

    best, _ = sysid.optimize(parameters, residual, optimizer="mujoco", verbose=False, max_iters=50)
    return Prediction(lambda x: torque(x, best))


def _set_inertia(body: Any, parameters: np.ndarray) -> None:
    """Set the inertia of a body of an MjSpec from its parameters (13,): m, m c, and I about the origin, 3 x 3.

    The function of mujoco.sysid 4.0.0 for this purpose sets the orientation to NaN, and MuJoCo 4.0.0 rejects such a
    body.
    """
    mass, moment, inertia = parameters[0], parameters[1:4], parameters[4:].reshape(3, 3)
    center = moment / mass
    about_center = inertia - mass * (center @ center * np.eye(3) - np.outer(center, center))
    body.explicitinertial = True
    body.mass, body.ipos, body.iquat = mass, center, (1.0, 0.0, 0.0, 0.0)
    body.inertia[:] = 0.0  # MuJoCo requires that the diagonal inertia is zero if `fullinertia` is set
    body.fullinertia[:] = about_center[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].reshape(body.fullinertia.shape)


class InverseDynamicsKernel(nn.Module):
    """Geometrically inspired polynomial kernel (Dalla Libera and Carli, IEEE RA-L 5:24, 2020), with friction.

    It is the covariance of one joint's torque in two states:
    k = k1(a, a') prod_j k2(c_j, c_j') + k1(f, f'), with a = (qdd, qd qd^T), c_j = (cos q_j, sin q_j) or q_j, the
    inhomogeneous polynomial kernels k1, k2 of degree one and two, and friction features f of the joint.
    """

    def __init__(self, revolute: Sequence[bool], joint: int) -> None:
        super().__init__()
        n = len(revolute)
        self.revolute, self.joint = revolute, joint
        self.motion = nn.Parameter(torch.zeros(1 + n + n * (n + 1) // 2).double())
        # (2, n, 3) logarithms of the weights of 1, cos q and sin q. The kernel k2 of degree two is the product of two
        # kernels of degree one, each with its own weights per joint. The product of k2 over n joints has degree 2 n:
        # the initial weights of cos q and sin q are small, since otherwise the highest powers would dominate.
        self.position = nn.Parameter(torch.tensor([0.0, -3.0, -3.0]).double().repeat(2, n, 1))
        self.friction = nn.Parameter(torch.full((3,), -2.0).double())
        self.noise = nn.Parameter(torch.tensor(-4.0).double())

    def features(self, q: Tensor, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the features a (T, A), c (T, n, 3) and f (T, 3) of the kernel k (see the class) along a motion.

        - a = (1, qdd, qd_i qd_j for i <= j), of all joints.
        - c = (1, cos q, sin q) per turning joint, (1, q, 0) per sliding joint.
        - f = (1, qd, tanh(qd / `SMOOTHING`)) of the joint whose torque is modelled.

        q, qd, qdd: (T, n) each.
        """
        row, column = torch.triu_indices(q.shape[1], q.shape[1])
        one = torch.ones_like(q[:, :1])
        motion = torch.cat([one, qdd, qd[:, row] * qd[:, column]], dim=1)
        turns = torch.tensor(self.revolute)
        position = torch.stack(
            [torch.ones_like(q), torch.where(turns, q.cos(), q), torch.where(turns, q.sin(), 0 * q)], dim=2
        )
        own = qd[:, self.joint : self.joint + 1]
        return motion, position, torch.cat([one, own, torch.tanh(own / SMOOTHING)], dim=1)

    def forward(self, x: tuple[Tensor, ...], y: tuple[Tensor, ...]) -> Tensor:
        """Return the covariance (S, T) between the torques at S and at T samples, from their features x and y."""
        covariance: Tensor = (x[0] * self.motion.exp()) @ y[0].mT
        for weights in self.position:
            covariance = covariance * torch.einsum("snk,nk,tnk->nst", x[1], weights.exp(), y[1]).prod(dim=0)
        return covariance + (x[2] * self.friction.exp()) @ y[2].mT


def gaussian_process(problem: Problem) -> Prediction:
    """Fit a Gaussian process per joint; return the mean and the standard deviation of its torque predictions.

    The hyperparameters maximize the marginal likelihood of a subset of the samples.
    """
    revolute = [kind == "revolute" for kind in problem.arm.chain.joint_types]
    training, fitted = subset(problem.samples, GP_SAMPLES), subset(problem.samples, GP_TRAINING)
    deviation = [np.maximum(getattr(training, k).std(axis=0), 1e-9) for k in ("qd", "qdd")]
    mean, scale = training.tau.mean(axis=0), np.maximum(training.tau.std(axis=0), 1e-9)

    def inputs(x: DynamicsSamples) -> tuple[Tensor, Tensor, Tensor]:
        """Return q, qd / s_v and qdd / s_a of samples, (T, n) each.

        s_v and s_a are the standard deviations of velocity and acceleration in the training, each of the joint with the
        largest one.
        """
        q, qd, qdd = tensors(x)
        # The scales are common to all joints: the kernel has products of the velocities of two joints (Coriolis terms),
        # whose relative magnitudes a scale per joint would change.
        return q, qd / float(deviation[0].max()), qdd / float(deviation[1].max())

    processes: list[tuple[InverseDynamicsKernel, tuple[Tensor, ...], Tensor, Tensor]] = []
    for joint in range(len(revolute)):
        kernel = InverseDynamicsKernel(revolute, joint)
        optimizer = torch.optim.Adam(kernel.parameters(), lr=GP_RATE)
        few, target = kernel.features(*inputs(fitted)), _torque(fitted, mean, scale)[:, joint]
        for _ in range(GP_STEPS):
            optimizer.zero_grad()
            _negative_log_likelihood(kernel, few, target).backward()
            optimizer.step()
        with torch.no_grad():
            many = kernel.features(*inputs(training))
            factor = _factor(kernel, many)
            weights = torch.cholesky_solve(_torque(training, mean, scale)[:, joint, None], factor)[:, 0]
        processes.append((kernel, many, factor, weights))

    def moments(x: DynamicsSamples) -> np.ndarray:
        """Return the predictive mean and standard deviation of the torque at samples, (2, T, n) [Nm, N]."""
        parts = [
            _moments(process, inputs(x[k : k + 2000]))
            for k in range(0, len(x.q), 2000)
            for process in processes
        ]
        stacked = np.concatenate(
            [np.stack(parts[k : k + len(processes)], axis=2) for k in range(0, len(parts), len(processes))],
            axis=1,
        )
        return np.stack([mean + scale * stacked[0], scale * stacked[1]])

    return Prediction(lambda x: moments(x)[0], lambda x: moments(x)[1])


def _torque(x: DynamicsSamples, mean: np.ndarray, scale: np.ndarray) -> Tensor:
    return torch.from_numpy((x.tau - mean) / scale)


def _factor(kernel: InverseDynamicsKernel, x: tuple[Tensor, ...]) -> Tensor:
    noise = kernel.noise.exp() + 1e-6
    covariance = kernel(x, x)
    factor: Tensor = torch.linalg.cholesky(covariance + noise * torch.eye(len(covariance)).double())
    return factor


def _negative_log_likelihood(kernel: InverseDynamicsKernel, x: tuple[Tensor, ...], target: Tensor) -> Tensor:
    factor = _factor(kernel, x)
    white = torch.linalg.solve_triangular(factor, target[:, None], upper=False)
    return 0.5 * white.square().sum() + factor.diagonal().log().sum()


def _moments(process: tuple[Any, ...], inputs: tuple[Tensor, Tensor, Tensor]) -> np.ndarray:
    """Return the predictive mean and standard deviation, noise included, of a joint's standardized torque, (2, T).

    Args:
        process: kernel, training features, Cholesky factor of the training covariance, and weights of the mean.
        inputs: q, qd and qdd, (T, n) each; qd and qdd divided by their scales (see `gaussian_process`).
    """
    kernel, many, factor, weights = process
    with torch.no_grad():
        features = kernel.features(*inputs)
        cross = kernel(many, features)
        explained = torch.linalg.solve_triangular(factor, cross, upper=False).square().sum(dim=0)
        own = (features[0].square() * kernel.motion.exp()).sum(dim=1)
        for weights_of_position in kernel.position:
            own = own * (features[1].square() * weights_of_position.exp()).sum(dim=2).prod(dim=1)
        own = own + (features[2].square() * kernel.friction.exp()).sum(dim=1)
        variance = (own - explained).clamp(min=0) + kernel.noise.exp()
        return torch.stack([cross.mT @ weights, variance.sqrt()]).numpy()


@dataclass(frozen=True)
class NetworkSettings:
    """Units per hidden layer and weight decay of a network."""

    width: int
    decay: float


SETTINGS = tuple(NetworkSettings(width, decay) for width, decay in product(WIDTHS, DECAYS))


def network(training: Sequence[DynamicsSamples], known: Torque | None = None) -> Torque:
    """Return the torque of a network of q, qd and qdd, fitted to torques, or to the torque residual of `known`.

    known: torque function of another method, to which the network is added.
    """
    inputs = np.concatenate([np.concatenate([x.q, x.qd, x.qdd], axis=1) for x in training])
    mean, scale = (torch.from_numpy(x) for x in (inputs.mean(axis=0), inputs.std(axis=0) + 1e-9))
    residuals = [x.tau if known is None else x.tau - known(x) for x in training]

    def make(settings: NetworkSettings) -> tuple[nn.Module, Callable[..., Tensor]]:
        """Return a new network, and the function from q, qd and qdd (T, n) to standardized torques (T, n)."""
        layers = mlp(inputs.shape[1], residuals[0].shape[1], settings.width, nn.Tanh)
        return layers, lambda q, qd, qdd: layers((torch.cat([q, qd, qdd], dim=-1) - mean) / scale)

    learned = best_of(make, training, residuals)
    return learned if known is None else lambda x: learned(x) + known(x)


class DeepLagrangian(nn.Module):
    """Deep Lagrangian network (Lutter, Ritter and Peters, ICLR 2019), with viscous and Coulomb friction per joint.

    One network gives the Cholesky factor of M, one the potential energy V; both depend on cos q and sin q.
    """

    def __init__(self, joints: int, width: int) -> None:
        super().__init__()
        rows, columns = torch.tril_indices(joints, joints)
        entries = torch.eye(joints * joints).double()[rows * joints + columns]
        # (entries, n, n): matrix with a one at the place of each entry of the factor of M
        self.entries = entries.unflatten(-1, (joints, joints))
        self.factor = mlp(2 * joints, joints * (joints + 1) // 2, width, nn.Softplus)
        self.potential = mlp(2 * joints, 1, width, nn.Softplus)
        self.viscous, self.coulomb = (nn.Parameter(torch.zeros(joints).double()) for _ in range(2))

    def mass(self, q: Tensor) -> Tensor:
        """Return the mass matrix, (..., n, n), at q (..., n)."""
        entries = self.factor(torch.cat([q.cos(), q.sin()], dim=-1))
        lower = torch.tensordot(entries, self.entries, dims=1)
        return lower @ lower.mT + 1e-3 * torch.eye(q.shape[-1]).double()

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Return the standardized torque along q, qd, qdd, (..., n) each: (torque - mean) / standard deviation.

        Mean and standard deviation are of each joint's torque in the training samples (see `best_of`).
        """

        def lagrangian(x: Tensor) -> Tensor:
            """Return the Lagrangian T - V at positions x (..., n) and at qd of `forward`, summed over the batch."""
            kinetic = 0.5 * torch.einsum("...i,...ij,...j->...", qd, self.mass(x), qd)
            return (kinetic - self.potential(torch.cat([x.cos(), x.sin()], dim=-1))[..., 0]).sum()

        change = jvp(lambda x: torch.einsum("...ij,...j->...i", self.mass(x), qd), (q,), (qd,))[1]
        inertia = torch.einsum("...ij,...j->...i", self.mass(q), qdd)
        friction = self.viscous * qd + self.coulomb * torch.tanh(qd / SMOOTHING)
        return inertia + change - grad(lagrangian)(q) + friction


def deep_lagrangian(training: Sequence[DynamicsSamples]) -> Torque:
    """Return the torque of a Deep Lagrangian network that is fitted to the training torques."""

    def make(settings: NetworkSettings) -> tuple[nn.Module, Callable[..., Tensor]]:
        """Return a new network, and the function from q, qd and qdd (T, n) to standardized torques (T, n)."""
        model = DeepLagrangian(training[0].q.shape[1], settings.width)
        return model, model

    return best_of(make, training, [x.tau for x in training])


def mlp(inputs: int, outputs: int, width: int, activation: type[nn.Module]) -> nn.Sequential:
    """Return a network of double precision with two hidden layers of `width` units."""
    layers = [nn.Linear(inputs, width), activation(), nn.Linear(width, width), activation()]
    return nn.Sequential(*layers, nn.Linear(width, outputs)).double()


def best_of(
    make: Callable[[NetworkSettings], tuple[nn.Module, Callable[..., Tensor]]],
    training: Sequence[DynamicsSamples],
    torques: Sequence[np.ndarray],
) -> Torque:
    """Fit a network with each of `SETTINGS`; return the torque of the network with the smallest held-out error.

    Args:
        make: returns a new network with given settings, and its function of q, qd and qdd.
        training: samples of each recording; two of ten blocks of time are held out.
        torques: (T, n) [Nm, N] of each recording, to which the network is fitted.
    """
    states = [np.concatenate([getattr(x, k) for x in training]) for k in ("q", "qd", "qdd")]
    y = np.concatenate(torques)
    mean, scale = y.mean(axis=0), y.std(axis=0) + 1e-9
    # held out are blocks of time, not single samples, since adjacent samples are correlated
    out = np.arange(len(y)) * 10 // len(y) % 5 == 4
    seen, held = ([torch.from_numpy(x[rows]) for x in (*states, (y - mean) / scale)] for rows in (~out, out))
    best_loss, best = np.inf, None
    for settings in SETTINGS:
        torch.manual_seed(0)
        weights, model = make(settings)
        loss = early_stopped(weights, model, seen, held, settings.decay)
        if loss < best_loss:
            best_loss, best = loss, model
    if best is None:
        raise ArithmeticError("no network has a finite error")
    chosen = best

    def torque(x: DynamicsSamples) -> np.ndarray:
        """Return the torque of the best network at samples, (T, n) [Nm, N]."""
        with torch.no_grad():
            return np.asarray(chosen(*tensors(x)).numpy() * scale + mean)

    return torque


def early_stopped(
    weights: nn.Module, model: Callable[..., Tensor], seen: list[Tensor], held: list[Tensor], decay: float
) -> float:
    """Fit a network by AdamW with early stopping; return its smallest mean squared error on held-out samples.

    The network gets the weights that have this error.

    Args:
        weights: module with the parameters.
        model: function from q, qd and qdd (T, n) to standardized torques (T, n), of mean zero and variance one.
        seen: q, qd, qdd and the standardized torque of training samples, (T, n) each.
        held: likewise, of held-out samples.
        decay: weight decay of AdamW.
    """
    optimizer = torch.optim.AdamW(weights.parameters(), lr=1e-3, weight_decay=decay)
    best, kept, waits = np.inf, weights.state_dict(), 0
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(seen[0])).split(BATCH):
            optimizer.zero_grad()
            *given, target = (x[batch] for x in seen)
            (model(*given) - target).square().mean().backward()
            optimizer.step()
        with torch.no_grad():
            loss = float((model(*held[:3]) - held[3]).square().mean())
        waits = 0 if loss < best else waits + 1
        if loss < best:
            best, kept = loss, {name: value.clone() for name, value in weights.state_dict().items()}
        if waits > PATIENCE:
            break
    weights.load_state_dict(kept)
    return best


RIVALS: dict[str, Method] = {
    "figaroh": figaroh,
    "MuJoCo sysid": mujoco_sysid,
    "GP": gaussian_process,
    "DeLaN": lambda problem: Prediction(deep_lagrangian(problem.samples)),
    "network": lambda problem: Prediction(network(problem.samples)),
}
