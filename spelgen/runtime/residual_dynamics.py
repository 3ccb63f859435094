"""Rigid bodies with residual terms."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from spelgen.runtime.residual_terms import ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics, RigidConfiguration, RigidParameters


class ResidualDynamics(RigidBodyDynamics):
    """Rigid bodies with residual terms in M, V and friction; ``residuals`` is None if they were removed."""

    residuals: ResidualTerms | None

    def __init__(self, *, residuals: ResidualTerms, **rigid: Any) -> None:
        super().__init__(**rigid)
        self.residuals = residuals

    def prepare(self) -> RigidParameters:
        """Return the parameter cache; valid until a parameter changes."""
        prepared = super().prepare()
        if self.residuals is None:
            return prepared
        return prepared._replace(residual=self.residuals.prepare(prepared.armature))

    def configuration(self, q: Tensor, prepared: RigidParameters) -> RigidConfiguration:
        """Return all that depends on q, (..., n), only."""
        cache = super().configuration(q, prepared)
        if self.residuals is None:
            return cache
        residual = self.residuals.at(q, prepared.residual)
        return cache._replace(mass=cache.mass + residual.mass, varied=residual.friction, residual=residual)

    def potential_energy(self, q: Tensor | RigidConfiguration, z: Tensor | None = None) -> Tensor:
        """Return V(q) and the elastic energy of the bristles, (...) [J]."""
        cache: RigidConfiguration = self.at(q)
        energy = super().potential_energy(cache, z)
        return energy if self.residuals is None else energy + self.residuals.energy(cache.residual)

    def gravity(self, q: Tensor | RigidConfiguration) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        cache: RigidConfiguration = self.at(q)
        if self.residuals is None:
            return cache.gravity
        return cache.gravity - self.residuals.gradient(cache.residual, 0 * cache.gravity)

    def lagrangian_gradient(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        cache: RigidConfiguration = self.at(q, qd)
        gradient = super().lagrangian_gradient(cache, qd)
        return gradient if self.residuals is None else gradient + self.residuals.gradient(cache.residual, qd)

    def nonlinear_effects(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque, (..., n)."""
        cache: RigidConfiguration = self.at(q, qd)
        torque = super().nonlinear_effects(cache, qd)
        return torque if self.residuals is None else torque + self.residuals.nonlinear(cache.residual, qd)
