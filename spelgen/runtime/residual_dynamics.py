"""Rigid bodies, and what logs show beside them."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from spelgen.runtime.residual_terms import ResidualTerms
from spelgen.runtime.rigid_body_dynamics import Motion, RigidBodyDynamics, RigidPrepared


class ResidualDynamics(RigidBodyDynamics):
    """Rigid bodies with residual terms in M, V and friction; without them (None) they are bodies alone."""

    residuals: ResidualTerms | None

    def __init__(self, residuals: ResidualTerms, *rigid: Any) -> None:
        super().__init__(*rigid)
        self.residuals = residuals

    def prepare(self) -> RigidPrepared:
        """Return all that depends on the weights alone; holds until they change."""
        prepared = super().prepare()
        if self.residuals is None:
            return prepared
        return prepared._replace(residual=self.residuals.prepare(prepared.armature))

    def configuration(self, q: Tensor, prepared: RigidPrepared) -> Motion:
        """Return what depends on q alone."""
        pose = super().configuration(q, prepared)
        if self.residuals is None:
            return pose
        residual = self.residuals.at(q, prepared.residual)
        return pose._replace(mass=pose.mass + residual.mass, varied=residual.friction, residual=residual)

    def potential_energy(self, q: Tensor | Motion, z: Tensor | None = None) -> Tensor:
        """Return V(q) and what bristles store, (...) [J]."""
        pose: Motion = self.at(q)
        energy = super().potential_energy(pose, z)
        return energy if self.residuals is None else energy + self.residuals.energy(pose.residual)

    def gravity(self, q: Tensor | Motion) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        pose: Motion = self.at(q)
        if self.residuals is None:
            return pose.gravity
        return pose.gravity - self.residuals.gradient(pose.residual, 0 * pose.gravity)

    def lagrangian_gradient(self, q: Tensor | Motion, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        pose: Motion = self.at(q, qd)
        gradient = super().lagrangian_gradient(pose, qd)
        return gradient if self.residuals is None else gradient + self.residuals.gradient(pose.residual, qd)

    def nonlinear_effects(self, q: Tensor | Motion, qd: Tensor) -> Tensor:
        """Return the torque that holds qd steady without friction, (..., n)."""
        pose: Motion = self.at(q, qd)
        torque = super().nonlinear_effects(pose, qd)
        return torque if self.residuals is None else torque + self.residuals.nonlinear(pose.residual, qd)
