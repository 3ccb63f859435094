"""Predicted positions of windows as a function of the parameters, and their Jacobian by finite differences."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spelgen.dynamics.parameters import evaluate_with
from spelgen.dynamics.servo_rollout import Load, ServoDrives, advanced, balanced, servo_drives
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.servo.parameters import ParameterMap, ServoParameters
from spelgen.fitting.servo.tuning import TUNING
from spelgen.fitting.servo.windows import BodyLoad, MidpointMotion, ServoWindows, body_load


@dataclass(frozen=True, eq=False)
class ServoRollouts:
    """Rollouts of windows, in which each joint is integrated independently of the other joints.

    The joints are coupled only by the load of the bodies (gravity, inertia, Coriolis forces). Here, this load is
    computed along a fixed motion instead of the predicted motion, once for parameters x0. For other parameters x, the
    term Y (phi(x) - phi(x0)) is added to this load: phi(x) (10 B,) are the inertial parameters of B bodies, and Y is
    the torque regressor along the fixed motion.

    Since the joints are independent, one rollout with a parameter changed at all joints gives the derivatives of all
    joints. A parameter that joints share (body parameters, delay) needs a rollout of its own. All these rollouts form
    one batch.

    Shapes: P sets of parameters, W windows of K samples, K' samples of a window after the burn-in, S integration steps
    per sample interval, n joints, p parameters per joint, r coordinates of the bodies (see `ServoParameters`).

    Attributes:
        motion: the fixed motion.
        load: load along this motion for x0.
        inertial: phi(x0), (10 B,).
        difference_step: step of the finite differences.
    """

    model: ArmModel
    windows: ServoWindows
    parameters: ParameterMap
    motion: MidpointMotion
    load: BodyLoad
    inertial: Tensor
    difference_step: float = TUNING.difference_step

    @classmethod
    def of(cls, model: ArmModel, windows: ServoWindows) -> ServoRollouts:
        """Return the rollouts that start at the first measured positions and velocities of each window.

        The parameters x0, for which the load is computed (see the class), are the current parameters of the model.
        """
        q = windows.q.flatten(0, 1)
        parameters = ParameterMap(model, q[:: max(1, len(q) // TUNING.gravity_samples)])
        motion = windows.motion()
        inertial = parameters.inertial(parameters.prior_mean.bodies)
        return cls(model, windows, parameters, motion, body_load(model, motion), inertial)

    def linearized(self, x: ServoParameters, motion: MidpointMotion) -> ServoRollouts:
        """Write x to the model; return the rollouts with x as the new x0 and ``motion`` as the new fixed motion.

        The load of the bodies along the fixed motion (gravity, inertia, Coriolis forces) is recomputed for x. At
        parameters other than x0, a rollout adds Y (phi - phi(x0)) to this load, where Y is the torque regressor along
        the fixed motion, and phi are the inertial parameters of the bodies.
        """
        self.parameters.write(x)
        load, inertial = body_load(self.model, motion), self.parameters.inertial(x.bodies)
        return replace(self, motion=motion, load=load, inertial=inertial)

    def residual(self, x: ServoParameters) -> Tensor:
        """Return predicted minus measured positions for parameters x, (W, K', n) [rad, m].

        Each of the W windows has K' samples after the burn-in.
        """
        return self._errors(self._rollout_at(x)[0])[0]

    def predicted_motion(self, x: ServoParameters) -> MidpointMotion:
        """Return positions, velocities and accelerations at midpoints between samples, for `linearized`.

        The positions are measured. The velocities are the velocities of a rollout with parameters x, corrected by
        smoothed derivatives of measured minus predicted positions. The accelerations are derivatives of the velocities
        of the rollout, corrected by smoothed second derivatives. Smoothed derivatives of the measured positions,
        without a rollout, would attenuate fast motion.
        """
        q, qd = self._rollout_at(x)
        return self.windows.motion(q[0], qd[0])

    def jacobian(self, x: ServoParameters) -> tuple[Tensor, Tensor]:
        """Return derivatives of the `residual` with respect to the parameters of each joint and to shared parameters.

        The residual is (W, K', n): W windows, each with K' samples after the burn-in, and n joints.

        Returns:
            (p, W, K', n): derivatives of each joint's residual with respect to the p parameters of the same joint; zero
                for a parameter that is fixed at all joints.
            (r + 1, W, K', n): derivatives with respect to the parameters that all joints share, first the r coordinates
                of the body parameters, then the delay.
        """
        # rows: indices of the parameters that are fitted at one joint or more
        rows = x.active.any(dim=1).nonzero().squeeze(-1)
        p, r, step = len(rows), len(x.bodies), self.difference_step
        # The batch has p + r + 2 rollouts: one at x, and one per changed parameter: p joint parameters, each of which
        # is changed at all joints together, r body coordinates and the delay.
        joints = x.joints.expand(p + r + 2, -1, -1).clone()
        joints[torch.arange(p) + 1, rows] += step
        bodies = x.bodies.expand(p + r + 2, -1).clone()
        bodies[torch.arange(r) + p + 1, torch.arange(r)] += step
        commands = self.windows.commands(x.delay).expand(p + r + 1, -1, -1, -1, -1)
        delayed = self.windows.commands(x.delay + step).unsqueeze(0)
        q, _ = self._rollout(joints, bodies, torch.cat([commands, delayed]))
        errors = self._errors(q)
        derivatives = (errors[1:] - errors[0]) / step
        of_joints = torch.zeros(len(x.joints), *derivatives.shape[1:]).double()
        of_joints[rows] = derivatives[:p]
        return of_joints, derivatives[p:]

    def _errors(self, q: Tensor) -> Tensor:
        """Return predicted minus measured positions after the burn-in, (P, W, K', n) [rad, m].

        q: (P, W, K, n), positions predicted with P sets of parameters.
        """
        first = self.windows.burn_in + 1
        return q[:, :, first:] - self.windows.q[:, first:]

    def _rollout_at(self, x: ServoParameters) -> tuple[Tensor, Tensor]:
        """Return predicted positions and velocities of W windows, (1, W, K, n) each, for one set of parameters, x."""
        commands = self.windows.commands(x.delay)
        return self._rollout(x.joints.unsqueeze(0), x.bodies.unsqueeze(0), commands.unsqueeze(0))

    def _rollout(self, joints: Tensor, bodies: Tensor, commands: Tensor) -> tuple[Tensor, Tensor]:
        """Return predicted q [rad, m] and qd [rad/s, m/s], (P, W, K, n), for P sets of parameters and W windows.

        Args:
            joints: (P, p, n), values of `ServoParameters.joints`.
            bodies: (P, r), values of `ServoParameters.bodies`.
            commands: (P, W, K-1, S, n) [rad, m], commands at the S integration steps of each sample interval.
        """
        tensors = {name: tensor.detach() for name, tensor in self.parameters.named(joints).items()}
        # Inference mode saves 10 % of the time, since there are many small operations.
        with torch.inference_mode():
            drives, armature = evaluate_with(
                self.model, tensors, lambda model: (servo_drives(model), model.armature)
            )
            changes = torch.stack([self.parameters.inertial(x) - self.inertial for x in bodies])
            added = torch.einsum("wkni,pi->pwkn", self.load.regressor, changes)
            return self._integrate(drives, armature, added, commands)

    def _integrate(
        self, drives: ServoDrives, armature: Tensor, added: Tensor, commands: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Integrate all joints of W windows of K samples for P sets of parameters; return q and qd, (P, W, K, n) each.

        Args:
            drives: servos and friction of the P sets.
            armature: (P, 1, n) [kg m^2, kg].
            added: (P, W, K-1, n) [Nm, N], change of the load due to changed body parameters.
            commands: (P, W, K-1, S, n) [rad, m], commands at the S integration steps of each sample interval.
        """
        windows, load = self.windows, self.load
        h = windows.dt.unsqueeze(-1) / commands.shape[3]
        inertia, bias = load.inertia + armature.unsqueeze(-2), load.bias + added
        shape = (len(added), *windows.q[:, 0].shape)
        q, qd = windows.q[:, 0].expand(shape), windows.qd[:, 0].expand(shape)
        positions, velocities, state = [q], [qd], None
        for k in range(windows.q.shape[1] - 1):
            current = Load(inertia[:, :, k], bias[:, :, k], load.gravity[:, k], coupled=False)
            # The initial friction state is unknown. Initially, friction is assumed to balance the other torques; the
            # error of this assumption decays during the burn-in.
            if state is None:
                state = balanced(drives, q, qd, commands[:, :, k, 0], current)
            for u in commands[:, :, k].unbind(2):
                state = advanced(drives, state, u, current, h[:, k])
            positions.append(state.q)
            velocities.append(state.qd)
        return torch.stack(positions, dim=2), torch.stack(velocities, dim=2)
