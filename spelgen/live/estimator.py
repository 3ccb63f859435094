"""The online estimator of payload, friction drift and external torques, updated with each sample.

It needs positions, velocities and torques, but no accelerations.
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from spelgen.dynamics.body_regressor import load_body, regressor_of
from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import is_stateful
from spelgen.errors import RunError
from spelgen.fitting.fitted import Fit
from spelgen.live.contact import ContactObserver, ContactState
from spelgen.live.filters import Block, Blocks, JointFilters, PayloadEstimate
from spelgen.live.intake import Intake, Refusal, balance_along
from spelgen.live.levels import noise_levels
from spelgen.live.momentum import Balance
from spelgen.live.noise import NoiseLevels
from spelgen.live.payload import NO_REPORT, Payload, find_payload
from spelgen.live.tuning import TUNING
from spelgen.logs.trajectory import Trajectory
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """Estimates of the online estimator after a sample.

    Attributes:
        t: Time of the sample [s].
        refusal: "used", or the reason why the sample was refused or only partly used.
        contact: External torques, their thresholds, and the force at the tip.
        payload: Last reported payload.
        load_changed: True if a change of the payload was detected at this sample.
        friction_scale: Current friction divided by the friction of the model, (n,) [1].
        disturbance: Slow torque that neither model nor payload explains, (n,) [Nm, N].
    """

    t: float
    refusal: Refusal
    contact: ContactState
    payload: Payload
    load_changed: bool
    friction_scale: np.ndarray
    disturbance: np.ndarray


class Estimator:
    """Online estimator of payload, friction drift and external torques, for a rigid-body model fitted to torques.

    ``step`` processes one measured sample, ``replay`` a log. Samples with values that are not finite, samples out of
    order and jumps are refused and counted in ``refused``.
    """

    def __init__(
        self,
        fit: Fit,
        *,
        levels: NoiseLevels | None = None,
        alarms_per_minute: float = TUNING.alarms_per_minute,
        compensate_external: bool = False,
    ) -> None:
        """Initialize the estimator for the model of a fit.

        Args:
            fit: fit of a rigid-body model to measured torques.
            levels: noise levels; by default the noise levels in the run folder, or noise levels that are estimated from
                the logs of the fit.
            alarms_per_minute: rate of false contact alarms [1/min].
            compensate_external: whether `torque` compensates all external torques, also of contacts and of loads that
                are not reported yet.

        Raises RunError for a model without rigid bodies or with position servos, and if there are no noise levels.
        """
        self.model = torque_model(fit)
        with torch.no_grad():
            self.prepared = self.model.prepare()
        self.levels = noise_levels(fit) if levels is None else levels
        self.alarms_per_minute, self.compensate_external = alarms_per_minute, compensate_external
        self.reach = bristle_reach(self.model)
        self.reset()

    def __repr__(self) -> str:
        return f"<Estimator of {self.model.n} joints, alarms_per_minute={self.alarms_per_minute:g}>"

    def reset(self) -> None:
        """Reset all estimates: payload, friction drift and friction state are unknown afterwards."""
        n = self.model.n
        self.intake = Intake(self.levels, self.reach)
        self.blocks = Blocks(self.levels.rest_speed)
        self.estimate = PayloadEstimate(self.levels)
        self.drift = JointFilters.of_drift(self.levels.drift)
        self.observer = ContactObserver(self.levels, self.alarms_per_minute)
        self.half: Block | None = None
        self.payload, self.reported = NO_REPORT, 0.0
        self.contact = ContactState(np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool), np.zeros(3))

    @property
    def refused(self) -> dict[str, int]:
        """{reason of a refusal: number of samples that were refused or only partly used for this reason}."""
        return {reason: count for reason, count in self.intake.counts.items() if count and reason != "used"}

    def step(self, t: float, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> EstimatorState:
        """Process a sample and return the estimates.

        Args:
            t: Time [s].
            q: Positions, (n,) [rad, m].
            qd: Velocities, (n,) [rad/s, m/s].
            tau: Measured torques, (n,) [Nm, N].
        """
        (state,) = self.steps(np.array([t], dtype=float), *(np.array([x], dtype=float) for x in (q, qd, tau)))
        return state

    def replay(self, log: Trajectory) -> list[EstimatorState]:
        """Process all samples of a log; return the estimates after each sample."""
        return list(self.steps(log.t, log.q, log.qd, log.tau))

    def steps(
        self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, tau: np.ndarray
    ) -> Iterator[EstimatorState]:
        """Process T samples; yield the estimates after each sample.

        Args:
            t: Times, (T,) [s].
            q: Positions, (T, n) [rad, m].
            qd: Velocities, (T, n) [rad/s, m/s].
            tau: Measured torques, (T, n) [Nm, N].
        """
        shape = (len(t), self.model.n)
        if not q.shape == qd.shape == tau.shape == shape:
            raise ValueError(
                f"got q, qd and tau {q.shape}, {qd.shape}, {tau.shape}, expected {shape}: {shape[1]} joints"
            )
        refusals, terms = balance_along(self.model, self.levels, self.intake, t, (q, qd, tau), self.prepared)
        for now, refusal, at in zip(t.tolist(), refusals, terms, strict=True):
            changed = at is not None and self._advance(now, at, refusal)
            a, d = self.drift.x.T
            yield EstimatorState(now, refusal, self.contact, self.payload, changed, 1 + a, d)

    def _advance(self, t: float, at: Balance, refusal: Refusal) -> bool:
        """Update all filters with a sample; return True if a change of the payload was detected.

        t: time [s]. at: terms of the momentum balance at the sample. refusal: "used", or the reason why the sample is
        only partly used.
        """
        if refusal != "used":
            self.blocks.restart()
            self.half = None
            if refusal == "gap":
                self.observer.restart()
        self.contact = self.observer.step(t, at, self.payload, self.drift.x)
        block = None if refusal == "saturated" else self.blocks.add(t, at)
        if block is not None:
            self.observer.end_block()
            self.drift.update(block, block.y - block.load @ self.payload.parameters)
            if self.half is not None:
                self.estimate.start(self.half.joined(block))
            self.half = block if self.half is None else None
        self.estimate.step()
        changed, self.estimate.changed = self.estimate.changed, False
        if changed or self.estimate.moved - self.reported >= TUNING.report:
            self.report()
        return changed

    def report(self) -> Payload:
        """Estimate the payload from the payload filter and return it; the estimator uses it from the next sample on.

        ``step`` calls this method after each second of motion and after a detected change of the payload.
        """
        main, before = self.estimate.filters[0], self.payload
        self.reported = self.estimate.moved
        payload = find_payload(
            main.x[:10], main.P[:10, :10], self.levels.load_variance, self.levels.load_quantile
        )
        is_new = before.status != "payload" and payload.status == "payload"
        if is_new and self.estimate.misfit > TUNING.misfit:
            payload = Payload("not yet", payload.log_odds, payload.limit)
        self.payload = payload
        if (before.status == "payload") != (self.payload.status == "payload"):
            # A payload is reported for the first time, or no longer. Until now the drift filter assumed a wrong payload
            # and attributed its torques to friction. It restarts with the friction scale of the payload filter.
            joints = slice(10, 10 + self.model.n)
            self.drift = JointFilters.of_drift(self.levels.drift)
            self.drift.x[:, 0] = main.x[joints]
            self.drift.P[:, 0, 0] = main.P.diagonal()[joints]
        return self.payload

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, ahead: float = 0.0) -> np.ndarray:
        """Return the torques that a motion requires with the estimated payload, friction and disturbance, (n,) [Nm, N].

        If the logs contain motor torques, motor torques are returned; otherwise joint torques.

        Args:
            q, qd, qdd: positions [rad, m], velocities [rad/s, m/s] and accelerations [rad/s^2, m/s^2], (n,) each.
            ahead: time from the last sample to the motion [s]. The torques contain a disturbance that decays during
                this time; if the time is longer than 0.3 s, the disturbance is omitted. The disturbance is the estimate
                of the drift filter or, with `compensate_external`, the torque residual of the momentum observer.
        """
        at = [torch.as_tensor(x, dtype=torch.float64) for x in (q, qd, qdd)]
        z = torch.from_numpy(self.intake.bounds.mean(axis=0))
        past = (z,) if is_stateful(self.model) else ()
        with torch.no_grad():
            cache = self.model.at(*at, prepared=self.prepared)
            torque = self.model.inverse_dynamics(cache, *at[1:], *past)
            friction = self.model.friction_torque(cache, at[1], *past)
            # The regressor of the payload has the ten columns of the body that carries it.
            first, parameters = 10 * load_body(self.model.chain), torch.from_numpy(self.payload.parameters)
            load = regressor_of(self.model.chain, *at)[..., first : first + 10] @ parameters
            decay = np.exp(-ahead / self.levels.drift.time_constant) * (ahead <= TUNING.disturbance_ahead)
            a, d = self.drift.x.T
            if self.compensate_external:
                # The disturbance d now contains the external torque, so that the returned torques compensate it. Errors
                # of measured torques may make d arbitrarily large; it is limited to the torque limits of the drives.
                limit, d = self.levels.effort, self.observer.baseline - self.contact.external_torque
                d = np.clip(d, -limit, limit)
            drift = torch.from_numpy(a) * friction + torch.from_numpy(d * decay)
            return (torque + self.model.input_torque(cache, load + drift)).numpy()


def torque_model(fit: Fit) -> RigidBodyDynamics:
    """Return a copy of the model of a fit for the estimator, in double precision.

    Raises RunError for a model that the estimator does not support: without rigid bodies, or with position servos.
    """
    if not isinstance(fit, Fit):
        raise RunError(
            repr(fit), element="estimator", expected="a fit: spelgen.fit(...) or spelgen.load_run(FOLDER)"
        )
    model = fit.model
    if not isinstance(model, RigidBodyDynamics):
        raise RunError(
            "a model without rigid bodies", element="estimator", expected="a fit of closed-form or hybrid",
            do="build the module with --preset hybrid and fit it",
        )  # fmt: skip
    if model.servo is not None:
        raise RunError("a fit to position commands", element="estimator", expected="a fit to torques")
    return copy.deepcopy(model).double().cpu().requires_grad_(False).eval()
