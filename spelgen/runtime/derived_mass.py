"""Mass matrices M(q) of network models: structured (``DerivedMass``, ``ConstantMass``) and ``DenseMass``.

In ``DerivedMass``, M = sum_j f_j(q) B_j + sum_k c_k A_k + armature has learned functions f_j and trained
constants c_k; the constant matrices B_j and A_k are derived from the kinematics of the arm, with the minimum
number of functions and constants. M of ``ConstantMass`` does not depend on q. ``DenseMass`` uses no
structure: all entries of M are functions of the positions of all joints.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.networks import MaskedNetwork
from spelgen.runtime.parts import Entries, Intermediates, Layers, Rows
from spelgen.runtime.rows import Constant, Function, Joint, vector


class LinearMass(nn.Module):
    """Base class of mass matrices M(q) whose entries are linear in functions f_j(q) and in constants c_k.

    This class has the trained constants c_k and the armature (rotor inertia, added to the diagonal of M).
    Derived classes add the learned functions f_j(q), or have none.
    """

    parameter_groups = (
        ("raw_constants", "mass_constants", "kg m^2, kg m, kg"),
        ("raw_armature", "armature", "kg m^2, kg"),
    )

    def __init__(
        self,
        joints: Sequence[Joint],
        entries: Entries,
        *,
        constants: Sequence[Constant],
        functions: Sequence[Function] | None = None,
    ) -> None:
        super().__init__()
        self.entries = entries
        self.constant_scale = nn.Buffer(vector(x.scale for x in constants))
        if functions is not None:
            self.function_mean = nn.Buffer(vector(f.mean for f in functions))
            self.function_scale = nn.Buffer(vector(f.scale for f in functions))
        self.raw_constants = nn.Parameter(vector(x.initial / x.scale for x in constants))
        self.nominal_armature = nn.Buffer(vector(joint.armature for joint in joints))
        # `raw_armature`: logarithm of armature / nominal armature, (n,).
        self.raw_armature = nn.Parameter(torch.zeros_like(self.nominal_armature))

    def armature(self) -> Tensor:
        """Return the rotor inertia on the joint side, which is added to diag(M), (n,) [kg m^2, kg]."""
        return self.nominal_armature * self.raw_armature.exp()

    def constants(self) -> Tensor:
        """Return the trained constants c_k of the entries of M, (constants,) [kg m^2, kg m, kg]."""
        return self.constant_scale * self.raw_constants


class ConstantMass(LinearMass):
    """A mass matrix M, (..., n, n), that does not depend on q, for example of a gantry.

    M is ``entries(*constants)`` plus the armature on the diagonal. ``entries`` is a function in the emitted
    module that places the constants in the matrix. The constants are absolute values of the trained
    parameters, since a negative constant could make M indefinite.
    """

    def constants(self) -> Tensor:
        """Return the trained constants of the entries of M, all > 0, (constants,) [kg m^2, kg m, kg]."""
        return self.constant_scale * (self.raw_constants.abs() + 1e-6)

    def prepare(self) -> Tensor:
        """Return M, (n, n) [kg m^2, kg m, kg], as the parameter cache: it depends on parameters only."""
        return self.entries(*self.constants().unbind()) + torch.diag(self.armature())

    def forward(self, encoded: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return M, (..., n, n), and as intermediate values the encoding of q, (..., 2 n), unchanged.

        M is the parameter cache ``parameters``, (n, n), expanded to the batch dimensions of ``encoded``,
        the encoding of q. The derivatives of M are zero, so ``kinetic_vjp`` uses only the shape of the
        encoding.
        """
        return parameters.expand(*encoded.shape[:-1], *parameters.shape), encoded

    def kinetic_vjp(self, qd: Tensor, intermediates: Tensor) -> Tensor:
        """Return zeros, (..., 2 n): the gradient of 1/2 qd^T M qd for a constant M.

        The gradient is with respect to the encoding of q (see ``JointEncoding``), ``intermediates``,
        which has the same shape.
        """
        return torch.zeros_like(intermediates)

    def jvp(self, rate: Tensor, intermediates: Tensor) -> Tensor:
        """Return zeros, (..., n, n): the time derivative of M, which does not depend on q.

        rate: time derivative of the encoding of q (see ``JointEncoding``), (..., 2 n); it gives the
        shape.
        """
        n = len(self.raw_armature)
        return rate.new_zeros(*rate.shape[:-1], n, n)


class DerivedMass(LinearMass):
    """A mass matrix M(q), (..., n, n), that is linear in learned functions of q and in trained constants.

    M is ``entries(*functions, *constants)`` plus the armature on the diagonal. ``entries`` is a function in
    the emitted module that places functions and constants in the matrix; the functions are outputs of
    ``network``.

    For some q and parameters M may be indefinite. The model therefore uses M' = C + t (M - C), which is
    positive definite for all q and all parameters. C = L L^T is a constant matrix: ``entries`` with the
    nominal mean of each function (``Function.mean``) and the initial constants, without armature.
    ``margin`` is between 0 and 1.

    - If M - margin C is positive definite, t is 1, and M' equals M.
    - Otherwise t is the largest of 1/2, 1/4, 1/8, ... with t |M - C| <= 1 - margin, where |X| is an upper
      bound of the spectral norm of L^-1 X L^-T. The eigenvalues of L^-1 M' L^-T = 1 + t L^-1 (M - C) L^-T
      are then at least ``margin``.

    Since t is piecewise constant, the derivatives of M' are t times the derivatives of M. The zeros of M
    and the linear relations between entries of M are valid for C, and therefore also for M'.
    """

    def __init__(
        self,
        joints: Sequence[Joint],
        entries: Entries,
        *,
        functions: Sequence[Function],
        constants: Sequence[Constant],
        network: MaskedNetwork,
        margin: float,
    ) -> None:
        super().__init__(joints, entries, constants=constants, functions=functions)
        self.network = network
        center = self._by_outputs()[-1].detach()
        # `center` is the constant matrix C of the class, `smallest` is `margin` times C. If M -
        # `smallest` is not positive definite, `forward` replaces M by M' = C + t (M - C), with a factor t
        # < 1.
        self.center, self.smallest = nn.Buffer(center), nn.Buffer(margin * center)
        size = center.diagonal().rsqrt()
        relative = size.unsqueeze(-1) * size
        eigenvalue = torch.linalg.eigvalsh(relative * center)[0]
        # The spectral norm of L^-1 X L^-T, with L L^T = C, has the upper bound |X| = ||D X D||_F / s.
        # Here D = diag(C)^(-1/2), and s is the smallest eigenvalue of D C D. `forward` compares |X| for X
        # = M - C with 1 - margin: with unit_ij = D_ii D_jj / s / (1 - margin), |X| / (1 - margin) is the
        # Frobenius norm of the elementwise product of `unit` and X.
        self.unit = nn.Buffer(relative / eigenvalue / (1 - margin))

    def _by_outputs(self) -> Tensor:
        """Return the coefficients of M as an affine function of the network outputs, (outputs + 1, n, n).

        For each output the matrix is dM / d output; the last matrix is M at zero outputs, without armature.
        """
        # A learned function f_k of M is mean_k + scale_k * output_k, with the network output k. Column k
        # of `functions`, (functions, outputs + 1), is the derivative of all functions with respect to
        # output k. The last column has the means.
        functions = torch.cat([torch.diag(self.function_scale), self.function_mean.unsqueeze(-1)], dim=1)
        constants = F.pad(self.constants().unsqueeze(-1), (len(functions), 0))
        return self.entries(*functions.unbind(), *constants.unbind())

    def prepare(self) -> Layers:
        """Return the parameter cache: network layers whose outputs are the n^2 entries of M."""
        rows = self._by_outputs()
        # The linear map from the learned functions to the entries of M is multiplied into the weights of the
        # last layer, which saves an operation per evaluation.
        offset = rows[-1] + torch.diag(self.armature())
        return self.network.prepare(rows[:-1].flatten(1).mT, offset.flatten())

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, tuple[Intermediates, Tensor]]:
        """Return the mass matrix M'(q), (..., n, n), and intermediate values for its derivatives.

        M' = C + t (M - C), with the nominal mass matrix C and the factor t(q) of the class, is positive
        definite. The intermediate values are the values of the network's layers, and t, (...). encoded:
        encoding of q, (..., 2 n), by ``JointEncoding``. layers: parameter cache.
        """
        rows, intermediates = self.network.forward(encoded, layers)
        mass = rows.reshape(*rows.shape[:-1], *self.center.shape)
        fraction = self.fraction(mass.detach())
        return torch.lerp(self.center, mass, fraction[..., None, None]), (intermediates, fraction)

    def fraction(self, mass: Tensor) -> Tensor:
        """Return the factor t of M' = C + t (M - C), (...), for the matrices M in ``mass``, (..., n, n).

        t is 1 if M - margin C is positive definite, with the nominal mass matrix C and a margin below 1.
        Otherwise t is 1/2, 1/4, ...: small enough that M' is positive definite (see the class).
        """
        # For a batch with an indefinite matrix, cholesky would raise an error; cholesky_ex reports which
        # matrices are indefinite.
        indefinite = torch.linalg.cholesky_ex(mass - self.smallest).info != 0
        # `norm` is |M - C| / (1 - margin), see `unit`. The factor t of M' = C + t (M - C) is the largest
        # of 1/2, 1/4, ... for which the product of t and `norm` is at most 1.
        norm = torch.linalg.vector_norm(self.unit * (mass - self.center), dim=(-2, -1))
        return torch.where(indefinite, torch.exp2(-torch.ceil(torch.log2(norm)).clamp(min=1.0)), 1.0)

    def kinetic_vjp(self, qd: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return the gradient of 1/2 qd^T M' qd with respect to the encoding of q, (..., 2 n).

        M' = C + t (M - C) is the positive definite mass matrix of the class: M is the network's matrix, C
        the constant nominal matrix, and t the factor (1, 1/2, 1/4, ...). The encoding of q is cos q and
        sin q (see ``JointEncoding``). qd: velocities, (..., n). intermediates: second result of
        ``forward`` at q.
        """
        network, fraction = intermediates
        # The network's outputs are the entries of M, and M' = C + t (M - C) has dM' = t dM: C is constant
        # and t piecewise constant. The gradient of 1/2 qd^T M' qd with respect to the entries of M is
        # therefore t/2 qd qd^T.
        half = 0.5 * fraction.unsqueeze(-1) * qd
        return self.network.vjp(network, (half.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2))

    def jvp(self, rate: Tensor, intermediates: tuple[Intermediates, Tensor]) -> Tensor:
        """Return the rate of change of the positive definite mass matrix C + t (M - C), (..., n, n).

        It is t times the rate of change of the network's matrix M: the nominal matrix C is constant, and
        the factor t (1, 1/2, 1/4, ...) changes only in steps. rate: time derivative of the encoding of q
        (see ``JointEncoding``), (..., 2 n) [1/s]. intermediates: second result of ``forward`` at q.
        """
        network, fraction = intermediates
        rows = fraction.unsqueeze(-1) * self.network.jvp(network, rate)
        return rows.reshape(*rows.shape[:-1], *self.center.shape)


class DenseIntermediates(NamedTuple):
    """Intermediate values of ``DenseMass.forward``, from which the derivatives of M are computed.

    M is (U^-1 A)^T diag(1 / e) U^-1 A. A network gives e > 0 and the factor U, a lower triangular matrix
    with ones on the diagonal; A is constant (see ``DenseMass``).
    """

    network: Intermediates
    factor: Tensor  # U of `DenseMass` without its diagonal of ones, (..., 3 n, 3 n)
    moved: Tensor  # U^-1 A, from which M is computed with e, (..., 3 n, n)
    scale: Tensor  # e, the diagonal factor of `DenseMass`, (..., 3 n)


def nominal_factor(joints: Sequence[Joint], mean: Rows) -> Tensor:
    """Return C of ``DenseMass``, (3 n, 3 n): C C^T is the inverse of the nominal large matrix.

    The large matrix of ``DenseMass`` has a row for the x, y and z axis of each joint. The block of the z
    axes is the nominal M. A row of an x or y axis has only a diagonal entry, equal to the diagonal entry of
    the same joint's z axis.

    Args:
        joints: joints of the arm, whose nominal armature is added to M.
        mean: lower triangle, by rows, of the mean of M over random positions, for the nominal bodies and
            without armature [kg m^2, kg m, kg].
    """
    n = len(joints)
    mass = torch.zeros(n, n, dtype=torch.float64)
    row, column = torch.tril_indices(n, n)
    mass[row, column] = mass[column, row] = vector(x for entries in mean for x in entries)
    mass += torch.diag(vector(joint.armature for joint in joints))
    everywhere = torch.diag(mass.diagonal().repeat_interleave(3))
    everywhere[2::3, 2::3] = mass
    factor: Tensor = torch.linalg.cholesky(torch.linalg.inv(everywhere))
    return factor


class DenseMass(nn.Module):
    """A mass matrix M(q), (..., n, n), without structure: the block of the z axes of a larger matrix.

    The large matrix, (..., 3 n, 3 n), has a row and a column for the x, y and z axis of each joint, as in the
    model of Duong et al. (IEEE T-RO 40:3695, 2024). The inverse of the large matrix is C U diag(e) U^T
    C^T. C is the constant ``nominal_factor``. A network with the encoding of q as input gives U, which is
    lower triangular with ones on the diagonal, and e > 0: a Cholesky factorisation without square roots.
    Joints rotate about or move along their z axes only, so M is the block of the z axes: (U^-1 A)^T
    diag(1 / e) U^-1 A, where A has the columns of C^-1 that belong to z axes, (3 n, n).
    """

    def __init__(self, joints: Sequence[Joint], *, mean: Rows, network: MaskedNetwork) -> None:
        super().__init__()
        self.size = 3 * len(joints)
        factor = nominal_factor(joints, mean)
        self.nominal = nn.Buffer(factor)
        self.moving = nn.Buffer(torch.linalg.inv(factor)[:, 2::3])
        row, column = torch.tril_indices(self.size, self.size, -1)
        # Indices of the entries below the diagonal of the lower triangular factor U (see the class), in
        # row-major order.
        self.below = nn.Buffer(row * self.size + column)
        # `initial` is added to the outputs of the network. At zero outputs, U of the class is the
        # identity and each entry of e is softplus(log(exp(1) - 1)) = 1: M is then the nominal mass
        # matrix.
        initial = vector([0.0] * len(row) + [math.log(math.e - 1)] * self.size)
        self.initial = nn.Buffer(initial)
        self.network = network

    def prepare(self) -> Layers:
        """Return the parameter cache: layers of the network that gives the triangular U and the vector e.

        M is computed from U and e (see the class).
        """
        return self.network.prepare(torch.diag(0 * self.initial + 1), self.initial)

    def inverse(self, encoded: Tensor, layers: Layers) -> Tensor:
        """Return C U diag(e) U^T C^T, (..., 3 n, 3 n), the inverse of the large matrix that contains M.

        The large matrix has a row and a column for the x, y and z axis of each joint; M is its block of
        the z axes. C is the constant ``nominal_factor``. The network gives U, lower triangular with ones
        on the diagonal, and e > 0, (..., 3 n).
        encoded: encoding of q, (..., 2 n). layers: parameter cache.
        """
        factor, scale = self._factor(self.network.forward(encoded, layers)[0])
        lower = self.nominal @ (factor + torch.eye(self.size).to(factor))
        return (lower * scale.unsqueeze(-2)) @ lower.mT

    def _factor(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Return U without its diagonal of ones, (..., 3 n, 3 n), and the vector e, (..., 3 n).

        U is lower triangular, and M = (U^-1 A)^T diag(1 / e) U^-1 A with the constant A of the class.
        raw: outputs of the network, (..., outputs): the entries of U below its diagonal, and
        softplus^-1(e).
        """
        entries, scale = raw.tensor_split((len(self.below),), dim=-1)
        return self._lower(entries), F.softplus(scale)

    def _lower(self, entries: Tensor) -> Tensor:
        """Return the strictly lower triangular matrix, (..., 3 n, 3 n), with the given entries.

        entries: entries below the diagonal in row-major order, (..., 3 n (3 n - 1) / 2).
        """
        rows = entries.new_zeros(*entries.shape[:-1], self.size * self.size)
        rows = rows.index_copy(-1, self.below, entries)
        return rows.reshape(*entries.shape[:-1], self.size, self.size)

    @staticmethod
    def _unit_solved(factor: Tensor, right: Tensor, upper: bool = False) -> Tensor:
        solution: Tensor = torch.linalg.solve_triangular(factor, right, upper=upper, unitriangular=True)
        return solution

    def forward(self, encoded: Tensor, layers: Layers) -> tuple[Tensor, DenseIntermediates]:
        """Return M(q), (..., n, n), and intermediate values for the derivatives of M.

        encoded: encoding of q, (..., 2 n). layers: parameter cache.
        """
        raw, intermediates = self.network.forward(encoded, layers)
        factor, scale = self._factor(raw)
        # M is computed from U^-1 A, the solution of a triangular system (see the class). An inversion of
        # C U diag(e) U^T C^T would lose twice as many digits: its condition number is the square of the
        # condition number of C U diag(e)^(1/2).
        moved = self._unit_solved(factor, self.moving)
        mass = moved.mT @ (moved / scale.unsqueeze(-1))
        return mass, DenseIntermediates(intermediates, factor, moved, scale)

    def kinetic_vjp(self, qd: Tensor, intermediates: DenseIntermediates) -> Tensor:
        """Return the gradient of 1/2 qd^T M qd with respect to the encoding of q, (..., 2 n).

        The encoding is defined in ``JointEncoding``. intermediates: second result of ``forward`` at q.
        """
        _, factor, moved, scale = intermediates
        speed = moved @ qd.unsqueeze(-1)
        momentum = speed / scale.unsqueeze(-1)
        # M = (U^-1 A)^T diag(1 / e) U^-1 A, see the class: A is constant, and the network gives e > 0 and
        # the lower triangular U (`factor`). The kinetic energy T = 1/2 qd^T M qd is therefore the sum of
        # w^2 / (2 e), with w = U^-1 A qd (`speed`). With p = w / e (`momentum`), dT/dU = -U^-T p w^T and
        # dT/de = -p^2 / 2.
        by_factor = -self._unit_solved(factor.mT, momentum, upper=True) @ speed.mT
        by_entry = by_factor.flatten(-2).index_select(-1, self.below)
        # For e = softplus(s) of a network output s, de/ds = 1 - exp(-e) = -expm1(-e).
        by_scale = 0.5 * momentum.squeeze(-1) ** 2 * torch.expm1(-scale)
        cotangent = torch.cat([by_entry, by_scale], dim=-1)
        return self.network.vjp(intermediates.network, cotangent)

    def jvp(self, rate: Tensor, intermediates: DenseIntermediates) -> Tensor:
        """Return dM/dt, (..., n, n).

        rate: time derivative of the encoding of q (see ``JointEncoding``), (..., 2 n) [1/s].
        intermediates: second result of ``forward`` at q.
        """
        _, factor, moved, scale = intermediates
        pushed = self.network.jvp(intermediates.network, rate)
        entries, raw_rate = pushed.tensor_split((len(self.below),), dim=-1)
        # M is (U^-1 A)^T diag(1 / e) U^-1 A with a constant A. The differential of U^-1 A is -U^-1 dU
        # U^-1 A.
        turned = self._unit_solved(factor, self._lower(entries) @ moved)
        by_factor = moved.mT @ (turned / scale.unsqueeze(-1))
        by_scale = raw_rate * torch.expm1(-scale) / scale**2
        return moved.mT @ (moved * by_scale.unsqueeze(-1)) - by_factor - by_factor.mT
