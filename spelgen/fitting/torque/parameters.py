"""Parameters of rigid bodies, drives and friction, which a fit to torques estimates, as one vector x (K,).

The prior of x is Gaussian with the values before the fit as its mean. Errors of inertial parameters are independent
between links. Errors of armatures and of friction are correlated between joints: the initial values are derived from
the effort limits of the drives, which may all be wrong by a similar factor, for example if they are torques before the
gear. Such a parameter is therefore the product of a factor common to all joints and a factor of the single joint; the
common factor has the larger standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.body_regressor import load_body
from spelgen.dynamics.parameters import NamedTensors, parameter_table
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.torque.tuning import TUNING
from spelgen.logs.tuning import SAMPLES
from spelgen.runtime.body_chain import body_factor
from spelgen.runtime.motors import MotorInputs
from spelgen.settings.fits import Adaptation, GaussianPrior

if TYPE_CHECKING:
    from spelgen.fitting.torque.samples import SampleBlock, TorqueSamples

MIN_SPEED = SAMPLES.moving
RIGID_GROUPS = (
    "bodies", "friction_compensation", "gains", "armature", "offset", "sizes", "effects", "velocities",
    "load_dependence", "fractions",
)  # fmt: skip
"""Groups of parameters (see `ParameterInfo`) of bodies, drives and friction; all others are of residual terms, or of
position servos."""
SERVO_GROUPS = ("stiffness", "damping", "dead_zone", "delay")
"""Groups of the parameters of position servos, which models fitted to torques do not have."""
DAY_GROUPS = ("sizes", "effects", "velocities", "load_dependence", "fractions", "offset")
"""Groups of friction parameters and torque offsets, whose values differ from day to day."""
NEGLIGIBLE = -30.0  # logarithm of a negligible friction coefficient, relative to nominal friction


class ParameterVector:
    """Map from the K parameters of bodies, drives, servos and friction of a model to one vector x (K,), and back.

    groups: {name of a parameter: its group}. initial: {name: values when this object was created}.
    """

    def __init__(self, model: ArmModel) -> None:
        tensors = {**dict(model.named_parameters()), **dict(model.named_buffers())}
        self.groups: dict[str, str] = {}
        # the model's parameters and buffers that a fit may change
        self._tensors: dict[str, torch.Tensor] = {}
        self.initial: dict[str, torch.Tensor] = {}
        for name, info in parameter_table(model).items():
            if info.kind in (*RIGID_GROUPS, *SERVO_GROUPS):
                self.groups[name], self._tensors[name] = info.kind, tensors[name]
                self.initial[name] = tensors[name].detach().clone()
        (self.bodies,) = self.names("bodies")
        (self.compensation,) = self.names("friction_compensation")
        self._load_body = load_body(model.chain)
        self._lengths = [tensor.numel() for tensor in self.initial.values()]

    def names(self, *groups: str) -> list[str]:
        """Return the names of the parameters of the given groups."""
        return [name for name, group in self.groups.items() if group in groups]

    def unflatten(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return {name: view of the vector x (K,) in the shape of the parameter}."""
        blocks = zip(self.initial.items(), x.split(self._lengths), strict=True)
        return {name: block.view_as(tensor) for (name, tensor), block in blocks}

    def flatten(self, parameters: NamedTensors) -> torch.Tensor:
        """Return the parameters in a dict {name: values} as one vector (K,)."""
        return torch.cat([parameters[name].flatten() for name in self.initial])

    def write(self, x: torch.Tensor) -> None:
        """Copy the parameters x (K,) into the model."""
        with torch.no_grad():
            for name, values in self.unflatten(x).items():
                self._tensors[name].copy_(values)

    def mask(self, *groups: str) -> torch.Tensor:
        """Return a mask (K,), True for the parameters of the given groups."""
        tensors = self.initial.items()
        return (
            self.flatten({name: torch.full_like(x, self.groups[name] in groups) for name, x in tensors}) > 0
        )

    def free_mask(self, adapt: Adaptation | None, compensated: torch.Tensor) -> torch.Tensor:
        """Return a mask (K,), True for the parameters that a fit estimates.

        Args:
            adapt: "load": only the body of the last joint is free; "friction": only friction parameters and torque
                offsets, which vary from day to day (`DAY_GROUPS`); None or "unit" (another arm of the same type): all
                groups.
            compensated: (n,) joints whose friction compensation is free; it is fixed at all other joints.
        """
        if adapt == "load":
            free = self.mask()
            self.unflatten(free)[self.bodies][self._load_body] = True
            return free
        free = self.mask(*(DAY_GROUPS if adapt == "friction" else RIGID_GROUPS))
        self.unflatten(free)[self.compensation].copy_(compensated)
        return free


def joint_torque(model: ArmModel, samples: SampleBlock) -> torch.Tensor:
    """Return the measured joint torque, (T, n) [Nm, N]: the input matrix of the model times the logged torque."""
    with torch.no_grad():
        torque: torch.Tensor = samples.tau @ model.input_matrix(samples.q[:1])[0].mT
    return torque


def set_initial_gains(model: ArmModel, samples: TorqueSamples, deviation: float) -> float:
    """Correct initial motor gains that are wrong by a large factor; return the prior width of all trained gains.

    Settings without `gear` have the initial gain 1, but a current in A may have a gain of 100 Nm/A. For each joint, the
    measured torque (logged torque times initial gain) is regressed on the rigid-body torque of the initial parameters,
    together with friction and an offset. The gain is divided by the coefficient of the rigid-body torque. Joints
    without a significant coefficient have the median coefficient of the others.

    A corrected gain depends on the masses in the URDF, and has their relative error. The prior of the gains is
    therefore widened: the prior of all bodies then determines the common scale of gains and masses.

    Args:
        model: model whose motor gains are corrected.
        samples: T samples with torques as logged, (T, n): in Nm or N, or in another unit such as A for motor currents.
        deviation: prior standard deviation of the logarithm of a gain. A gain is changed only if the magnitude of the
            coefficient's logarithm exceeds three of these standard deviations.

    Returns:
        Prior standard deviation of the logarithm of a gain: `deviation` if no gain was changed, otherwise
            `TorqueTuning.max_width`, which is larger.
    """
    inputs, (q, qd, qdd, *_) = model.inputs, samples.columns
    if not isinstance(inputs, MotorInputs) or inputs.raw_gains is None:
        return deviation
    with torch.no_grad():
        # `inverse_dynamics` returns torques as logged. They are converted to joint torques by the initial gains.
        joint = model.inverse_dynamics(q, qd, qdd) @ model.input_matrix(q[:1])[0].mT
        rigid = joint - model.friction_torque(q, qd)
        # columns: (joints, T, 4), the regressor of each joint whose gain is trained: rigid-body torque, velocity, sign
        # of the velocity, and 1 for the offset.
        columns = torch.stack([rigid, qd, qd.sign(), torch.ones_like(qd)], dim=-1).transpose(0, 1)[
            inputs.gain_rows
        ]
        torque = joint_torque(model, samples.columns).mT[inputs.gain_rows].unsqueeze(-1)
        inverse = torch.linalg.pinv(columns, rcond=1e-9)
        weights = inverse @ torque
        correlated = max(1.0, TUNING.correlation_time / samples.interval)
        variance = (torque - columns @ weights).square().mean(dim=(1, 2)) * inverse[:, 0].square().sum(dim=1)
        slope = weights[:, 0, 0]
        known = slope > TUNING.min_significance * (correlated * variance).sqrt()
        if not known.any():
            return deviation
        factors = -torch.where(known, slope, slope[known].median()).log()
        wrong = factors.abs() > 3 * deviation
        inputs.raw_gains.add_(torch.where(wrong, factors, 0.0))
        return TUNING.max_width if wrong.any() else deviation


def limit_friction(model: ArmModel, samples: SampleBlock) -> None:
    """Limit the nominal friction of each drive to the standard deviation of the drive's torque in the samples.

    Nominal friction is derived from the effort limits of the URDF, which are placeholders in many files. The prior
    width of torque offsets is proportional to nominal friction. If nominal friction is far too large, offsets may
    absorb gravity torques.
    """
    rigid, motors = ParameterVector(model), motors_of(model)
    with torch.no_grad():
        drive_torque = joint_torque(model, samples) @ torch.linalg.inv(motors)
        limit = drive_torque.std(dim=0) / model.friction.nominal
        # The samples have no information on the friction of drives at rest and of drives without torque. Their nominal
        # friction gets the median factor of the other drives, since placeholders of a URDF are wrong by one factor.
        informative = (limit > 0) & ((samples.qd @ motors.mT).abs().amax(dim=0) > MIN_SPEED)
        common = limit[informative].median() if informative.any() else torch.inf
        limit = torch.where(informative, limit, common)
        scale = limit.clamp(max=1.0)
        model.friction.nominal *= scale
    parameters = dict(rigid.initial)
    for name in rigid.names("sizes", "effects"):
        parameters[name] = parameters[name].minimum(limit.log()) - scale.log()
    for name in rigid.names("offset", "friction_compensation"):
        parameters[name] = parameters[name] / scale
    rigid.write(rigid.flatten(parameters))


def step_in_inertial_parameters(raw: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Return log-Cholesky parameters (B, 10) after a step along a straight line in the inertial parameters.

    The torque is linear in the inertial parameters. The linear model of a Gauss-Newton step is therefore exact along
    this line, in contrast to a straight line in the log-Cholesky parameters.

    The pseudo-inertia of a body is C S C^T with a constant matrix C and S = T T^T, where T is the upper triangular
    matrix `body_factor(raw)`. Let X be the first-order change of T by the step. The first-order change of S is then T
    (T^-1 X + (T^-1 X)^T) T^T. This change is added to S, or only a fraction of it if this is necessary for S to remain
    positive definite.

    Args:
        raw: (B, 10) log-Cholesky parameters of B bodies.
        step: (B, 10) change of the log-Cholesky parameters.
    """
    row, column = torch.triu_indices(4, 4)
    parameters, change = torch.zeros(2, len(raw), 4, 4).double()
    parameters[:, row, column], change[:, row, column] = raw, step
    # A complex-step derivative has no truncation error. Forward mode would import torch's compiler, which takes
    # seconds.
    epsilon = 1e-100
    perturbed = body_factor(torch.complex(parameters, epsilon * change))
    factor, factor_change = perturbed.real, perturbed.imag / epsilon
    relative = torch.linalg.solve_triangular(factor, factor_change, upper=True)
    added = relative + relative.mT
    # If the change of S = T T^T has overflowed, the fraction that keeps S positive definite cannot be computed. The
    # whole step is returned; the solver rejects it because of its cost.
    if not added.isfinite().all():
        return raw + step
    min_eigenvalue = torch.linalg.eigvalsh(added)[:, 0]
    fraction = (TUNING.body_step / (-min_eigenvalue).clamp(min=1e-12)).clamp(max=1.0)
    factor = factor @ upper_cholesky(torch.eye(4).double() + fraction[:, None, None] * added)
    return log_cholesky_parameters(factor)


def upper_cholesky(matrix: torch.Tensor) -> torch.Tensor:
    """Return the upper triangular U, (..., n, n), with U U^T equal to the matrix (..., n, n)."""
    lower: torch.Tensor = torch.linalg.cholesky(matrix.flip(-1, -2))
    return lower.flip(-1, -2)


def log_cholesky_parameters(factor: torch.Tensor) -> torch.Tensor:
    """Return the log-Cholesky parameters (B, 10) of B bodies from the upper triangular factors (B, 4, 4) of the bodies.

    This function is the inverse of `body_factor`.
    """
    scale = factor.diagonal(dim1=-2, dim2=-1)
    radii, mass = scale[:, :3].log(), scale[:, 3:].log()
    logarithms = torch.cat([radii - mass, 2 * mass], dim=-1)
    parameters = (factor / scale.unsqueeze(-1)).triu(1) + logarithms.diag_embed()
    row, column = torch.triu_indices(4, 4)
    return parameters[:, row, column]


SHARED = {
    "armature": "shared_armature",
    "sizes": "shared_sizes",
    "velocities": "shared_velocities",
    "fractions": "shared_fractions",
}
"""{option of `GaussianPrior`: option of the factor common to all joints}, both of them prior standard deviations."""


@dataclass(frozen=True, eq=False)
class ParameterPrior:
    """Prior of K parameters x: Student's t for the parameters of each body, Gaussian for all others.

    The links of a URDF are not equally wrong. With one Gaussian prior for all links, a link with placeholder values
    would keep wrong values, or would widen the prior of all links. The t distribution is represented as a Gaussian with
    an estimated width for each body.

    Attributes:
        rigid: map between the model and the vector x.
        widths: current standard deviation of each group of parameters; for bodies, the scale of the t distribution.
        hyperprior: initial standard deviation of each group, the center of the hyperprior of its width (see
            `update_widths`).
        mean: prior mean of x, (K,).
        body_widths: current standard deviation of the Gaussian of each body, (B,).
    """

    rigid: ParameterVector
    widths: GaussianPrior
    hyperprior: GaussianPrior
    mean: torch.Tensor
    body_widths: torch.Tensor

    @classmethod
    def of(cls, rigid: ParameterVector, widths: GaussianPrior) -> ParameterPrior:
        """Return the prior whose mean is the vector of the model's current parameters.

        rigid: layout of this vector, and its current values. widths: initial prior standard deviations of the groups of
        parameters.
        """
        body_widths = torch.full_like(rigid.initial[rigid.bodies][:, 0], widths.bodies)
        return cls(rigid, widths, widths, rigid.flatten(rigid.initial), body_widths)

    @property
    def plausible(self) -> bool:
        """Whether the masses of the URDF differ from the fitted masses by at most a factor of `TUNING.wrong_urdf`.

        The factor is estimated as exp(root mean square of `body_widths`): the logarithm of a mass is a parameter, and
        these prior standard deviations are re-estimated from the fitted parameters.
        """
        return float(self.body_widths.square().mean().sqrt().exp()) <= TUNING.wrong_urdf

    @cached_property
    def precision(self) -> torch.Tensor:
        """Inverse of the prior covariance of the K parameters, (K, K)."""
        covariance = prior_covariance(self.widths, self.rigid.initial, self.rigid.groups)
        bodies = self.rigid.mask("bodies")
        covariance[bodies, bodies] = self.body_widths.square().repeat_interleave(10)
        precision: torch.Tensor = torch.linalg.inv(covariance)
        return precision


def prior_covariance(
    widths: GaussianPrior, parameters: Mapping[str, torch.Tensor], groups: Mapping[str, str]
) -> torch.Tensor:
    """Return the prior covariance (K, K) of the flattened parameters.

    parameters: {name: values}, K values in total. groups: {name: parameter group}. widths: prior standard deviations of
    the groups, and of factors common to all joints, such as one factor of all armatures (see `SHARED`).
    """
    count = sum(x.numel() for x in parameters.values())
    matrix, friction, first = torch.zeros(count, count).double(), torch.zeros(count).double(), 0
    deviations: dict[str, float] = dict(widths)
    for name, x in parameters.items():
        rows = torch.arange(first, first + x.numel())
        option = groups[name]
        if option in ("effects", "load_dependence"):
            option = "sizes"
        matrix[rows, rows] = torch.full((len(rows),), deviations[option]).double().square()
        if option in SHARED:
            # The parameters are logarithms, and their prior has a random factor that is common to all joints. The
            # variance of its logarithm is added to all entries of the covariance matrix of these parameters. Bristle
            # fractions have one parameter per joint and bristle, (n, bristles): there is a separate common factor for
            # bristle 1 of all joints, bristle 2 of all joints, and so on.
            for of_joints in rows.view(len(x), -1).mT:
                matrix[of_joints[:, None], of_joints] += deviations[SHARED[option]] ** 2
        if groups[name] in ("sizes", "effects"):
            friction[rows] = widths.shared_friction
        first += x.numel()
    return matrix + friction.outer(friction)


def update_widths(prior: ParameterPrior, x: torch.Tensor, covariance: torch.Tensor) -> ParameterPrior:
    """Return the prior after one fixed-point step of evidence maximization for the widths of three groups.

    The groups are bodies, armatures and torque offsets. The width s of a group is the prior standard deviation of its k
    parameters, and d is the vector of their offsets x - prior mean. In Laplace's approximation, the marginal likelihood
    has its maximum at the fixed point of s^2 = |d|^2 / gamma, where gamma = k - tr(covariance) / s^2 is the effective
    number of parameters (MacKay, Bayesian Interpolation, Neural Computation 4:415, 1992). Here s^2 also has a scaled
    inverse chi-squared hyperprior with c = `degrees_of_freedom` degrees of freedom, whose scale is the square of the
    initial width s0. In addition, each body i has a width b_i. Its hyperprior has the same form, with s in place of s0;
    integrated over b_i, the prior of the body is a t distribution with c degrees of freedom and scale s (Lange, Little
    and Taylor, J. Am. Stat. Assoc. 84:881, 1989).

    The widths are updated in this order, with the current widths on the right, and limited by an upper bound:

    - bodies: s^2 = (sum of (s / b_i)^2 |d_i|^2 + c s0^2) / (sum of gamma_i + c), where gamma_i = 10 - tr(covariance of
      body i) / b_i^2.
    - body i: b_i^2 = (|d_i|^2 + c s^2) / (gamma_i + c), with the updated s.
    - armatures and torque offsets: s^2 = (|d|^2 + c s0^2) / (gamma + c).

    Args:
        prior: current prior.
        x: (K,) MAP estimate of the K parameters.
        covariance: (K, K) posterior covariance of x.
    """
    current, initial = dict(prior.widths), dict(prior.hyperprior)
    freedom, offset = prior.widths.degrees_of_freedom, x - prior.mean

    def width(squares: torch.Tensor, gamma: torch.Tensor, group: str, center: float) -> torch.Tensor:
        """Return the updated prior standard deviation, sqrt((squares + c center^2) / (gamma + c)), with an upper bound.

        c is the number of degrees of freedom of the hyperprior of the variance (see `update_widths`).

        Args:
            group: name of the group of parameters, for the upper bound.
            center: scale of the hyperprior: the group's initial standard deviation, or for a single body the updated
                standard deviation of all bodies.
            squares: sum of squares of x - prior mean.
            gamma: effective number of parameters, same shape as squares.
        """
        square = (squares + freedom * center**2) / (gamma.clamp(min=0.0) + freedom)
        return square.sqrt().clamp(max=max(TUNING.max_width, initial[group]))

    mask = prior.rigid.mask("bodies")
    squares = offset[mask].view(-1, 10).square().sum(dim=1)  # squares: (B,), |x - prior mean|^2 of each body
    gamma = 10 - covariance.diagonal()[mask].view(-1, 10).sum(dim=1) / prior.body_widths.square()
    relative = (current["bodies"] / prior.body_widths).square()
    updated = {"bodies": float(width((relative * squares).sum(), gamma.sum(), "bodies", initial["bodies"]))}
    body_widths = width(squares, gamma, "bodies", updated["bodies"])
    for group in ("armature", "offset"):
        mask = prior.rigid.mask(group)
        count = int(mask.sum())
        centring = torch.eye(count).double()
        if group in SHARED and count:
            # The prior of armatures has two standard deviations: one of a factor common to all joints, and one of
            # single joints. The latter is estimated here, from x - prior mean minus the mean of this difference over
            # the joints.
            centring -= 1 / count
        spread = centring @ covariance[mask][:, mask] @ centring
        gamma = centring.trace() - spread.trace() / current[group] ** 2
        squares = (centring @ offset[mask]).square().sum()
        updated[group] = float(width(squares, gamma, group, initial[group]))
    return replace(prior, widths=prior.widths.model_copy(update=updated), body_widths=body_widths)
