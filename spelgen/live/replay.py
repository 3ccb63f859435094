"""Estimates of payload, contacts and friction drift along recorded logs, for `spelgen estimate`."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from spelgen.dynamics.tip_frame import load_frame
from spelgen.emission.specify import arm_of_spec
from spelgen.errors import LogError
from spelgen.fitting.fitted import Fit, required_spec
from spelgen.labels import torque_units, torques_text
from spelgen.listing import WIDTH
from spelgen.live.estimator import Estimator, EstimatorState
from spelgen.live.payload import Payload
from spelgen.live.tuning import TUNING
from spelgen.logs.checks import check, joint_kinds
from spelgen.logs.trajectory import Trajectory, require_torques

LIMITS = "if limits of the URDF are wrong, correct them and train again"
FOREIGN = """  external torques exceed their thresholds in most of the log: check that it is a log of this arm, and the
units, senses and zeros of its positions and torques"""

REASONS = {
    "jump": f"jumps, or {TUNING.jump:g} times faster than the training logs",
    "gap": f"after a gap or {TUNING.restart} refused samples",
    "saturated": "torque at its limit",
}
"""Texts for users of the reasons of `live.intake.Refusal` that are not clear by themselves."""


@dataclass(frozen=True)
class ContactEvent:
    """A contact in a log: consecutive samples at which external torques exceed their thresholds.

    Attributes:
        begin: time of the first sample, from the start of the log [s].
        end: time of the last sample [s].
        joints: names of the joints whose external torque exceeds the threshold.
        torques: largest external torque of each of these joints [Nm, N].
        force: largest estimated force at the tip [N].
        is_load: True if a load causes the torques: its report is during the contact, or directly after it.
    """

    begin: float
    end: float
    joints: tuple[str, ...]
    torques: tuple[float, ...]
    force: float
    is_load: bool


@dataclass(frozen=True, eq=False)
class LogEstimate:
    """The estimates of payload, contacts and friction drift along a log.

    Attributes:
        log: The log.
        states: Estimates after each sample.
        units: {joint: unit of its torque, Nm or N}.
        payload: Estimated payload at the end of the log, in the frame of a link, see `at_tip`.
        since: Time at which a payload was first reported [s]; None without a payload.
        changes: Times of changes of the payload [s], see `load_changes`.
        contacts: Contacts along the log.
        drift: {joint: relative difference of friction at the end of the log from friction of the model [%]}.
        refused: {reason: number of samples that were refused or only partly used}.
        limits: {joint whose torque reaches its limit: text with the largest torque and the limit [Nm, N]}.
    """

    log: Trajectory
    units: dict[str, str]
    states: list[EstimatorState]
    payload: Payload
    since: float | None
    changes: tuple[float, ...]
    contacts: tuple[ContactEvent, ...]
    drift: dict[str, float]
    refused: dict[str, int]
    limits: dict[str, str]

    def to_dict(self) -> dict[str, object]:
        """Return the estimates as content of a JSON file: times [s], payload, contacts, friction drift [%]."""
        return {
            "log": self.log.name, "seconds": self.log.duration, "payload": payload_content(self.payload),
            "payload_since": self.since, "load_changes": list(self.changes),
            "contacts": [vars(contact) for contact in self.contacts], "friction_drift_percent": self.drift,
            "refused": self.refused, "torques_at_limit": [f"{joint} {text}" for joint, text in self.limits.items()],
        }  # fmt: skip

    def torques(self, event: ContactEvent) -> str:
        """Return the joints of a contact with their largest external torques, as text with units."""
        texts = {joint: f"{torque:+.3g}" for joint, torque in zip(event.joints, event.torques, strict=True)}
        return torques_text(texts, self.units)

    def text(self) -> str:
        """Return the estimates as text for users, with a line per contact."""
        lines = [f"{self.log.name}: {payload_sentence(self.payload)}"]
        if self.since is not None and self.since not in self.changes:
            lines.append(f"  a payload was reported first at {self.since:.1f} s")
        lines += [f"  another load at {at:.1f} s" for at in self.changes]
        for event in self.contacts:
            name = "load before its report" if event.is_load else "contact"
            span = f"{event.begin:.2f} to {event.end:.2f} s"
            lines.append(f"  {name} at {span}: {self.torques(event)}; {event.force:.3g} N at the tip")
        if not self.contacts:
            lines.append("  no contact")
        if np.mean([state.contact.touched.any() for state in self.states]) > 0.5:
            lines.append(FOREIGN)
        drift = ", ".join(f"{joint} {percent:+.1f} %" for joint, percent in self.drift.items())
        lines.append(f"  friction at the end, relative to the model: {drift}")
        if self.refused:
            refused = "; ".join(f"{count} {REASONS.get(name, name)}" for name, count in self.refused.items())
            lines.append(f"  samples that were not used, or only in part: {refused}")
        if self.limits:
            lines.append(f"  largest torques: {torques_text(self.limits, self.units)}; {LIMITS}")
        return "\n".join(textwrap.fill(line, WIDTH, subsequent_indent="    ") for line in lines)


def payload_content(payload: Payload) -> dict[str, object]:
    """Return a payload as content of a JSON file; with values and 95 % intervals if `Payload.status` is "payload"."""
    content: dict[str, object] = {"status": payload.status, "log_odds_of_no_payload": payload.log_odds}
    if np.isfinite(payload.limit):
        content["mass_limit"] = payload.limit
    if payload.status == "payload":
        fields = [f"{name}{end}" for name in ("mass", "center", "inertia") for end in ("", "_interval")]
        content |= {
            name: np.asarray(vars(payload)[name]).tolist() for name in (*fields, "parameters", "frame")
        }
    return content


def payload_sentence(payload: Payload) -> str:
    """Return a text for users: mass and centre of mass of a payload with 95 % intervals.

    Without a reported payload, the text has the upper limit of its mass instead.
    """
    if payload.status == "payload":
        low, high = payload.mass_interval
        center = ", ".join(
            f"{value:.3f} ({first:.3f} to {last:.3f})"
            for value, (first, last) in zip(payload.center, payload.center_interval, strict=True)
        )
        mass = f"payload of {payload.mass:.3f} kg ({low:.3f} to {high:.3f})"
        return f"{mass}, centre of mass {center} m in the frame of {payload.frame}"
    limit = f"at most {payload.limit:.2g} kg" if np.isfinite(payload.limit) else "record motion of the joints"
    is_none = payload.status == "no payload"
    return f"{'no payload' if is_none else 'not determined yet whether there is a payload'} ({limit})"


def replay(fit: Fit, logs: Sequence[Trajectory], alarms_per_minute: float | None = None) -> list[LogEstimate]:
    """Return the estimates of payload, contacts and friction drift along each log; each log starts a new estimate.

    Args:
        fit: fit of an arm's model to torques.
        logs: logs of the same arm.
        alarms_per_minute: rate of false contact alarms [1/min]; None: default.

    Raises LogError for logs that cannot be used, such as positions in degrees or torques in other units.
    """
    require_torques(logs)
    joints, results = fit.model.joint_names, []
    units = torque_units(joints, fit.model.joint_types)
    check(logs, joints, joint_kinds(fit.model.joints))
    estimator = Estimator(fit, alarms_per_minute=alarms_per_minute or TUNING.alarms_per_minute)
    for log in logs:
        estimator.reset()
        states = estimator.replay(log)
        unused = sum(estimator.refused.values())
        largest, limit = np.abs(log.tau).max(axis=0), estimator.levels.effort * estimator.levels.saturation
        pairs = zip(joints, largest.tolist(), limit.tolist(), strict=True)
        limits = {joint: f"{top:.3g} (limit {most:.3g})" for joint, top, most in pairs if top >= most}
        if unused > len(log) / 2:
            counts = ", ".join(f"{count} {reason}" for reason, count in estimator.refused.items())
            do = "check that it is a log of this arm, and its units: torques in Nm, positions in rad"
            do += f"; largest torques: {torques_text(limits, units)}; {LIMITS}" if limits else ""
            raise LogError(
                f"{unused} of {len(log)} samples that the estimator cannot use ({counts})", element=log.name,
                expected="torques below the limits and speeds as in the training logs, at least every 0.25 s",
                do=do,
            )  # fmt: skip
        times = log.t - log.t[0]
        reported = times[[state.payload.status == "payload" for state in states]].tolist()
        drift = np.round(100 * (states[-1].friction_scale - 1), 2).tolist()
        changes = tuple(times[load_changes(states)].tolist())
        results.append(LogEstimate(
            log=log, units=units, states=states, payload=at_tip(fit, states[-1].payload),
            since=reported[0] if reported else None, changes=changes,
            contacts=tuple(contact_events(states, joints, [*reported[:1], *changes])),
            drift=dict(zip(joints, drift, strict=True)), refused=estimator.refused, limits=limits,
        ))  # fmt: skip
    return results


def carried_payload(fit: Fit, logs: Sequence[Trajectory]) -> tuple[Payload, list[str]]:
    """Return the payload of an arm, estimated from several logs, and the names of logs in which the load changes."""
    estimator, begin, changed = Estimator(fit), 0.0, []
    for log in logs:
        t = log.t - log.t[0] + begin
        # The logs are processed as one recording with pauses. Each pause exceeds `TUNING.gap`, so that the estimator
        # resets the friction state.
        begin = float(t[-1]) + 2 * TUNING.gap
        if load_changes(estimator.replay(replace(log, t=t))):
            changed.append(log.name)
    return at_tip(fit, estimator.report()), changed


def at_tip(fit: Fit, payload: Payload) -> Payload:
    """Return a payload in the frame of the tip link (see `load_frame`), or unchanged for a fit without a URDF."""
    if payload.status != "payload" or fit.urdf is None or not fit.urdf.exists():
        return payload
    return payload.at_link(*load_frame(arm_of_spec(required_spec(fit.model), fit.urdf)))


def load_changes(states: Sequence[EstimatorState]) -> list[int]:
    """Return the indices of the samples at which the payload changes.

    They are the samples at which the estimator detected a change (`load_changed`). A change is omitted if no payload
    was reported before it and the last status after it is "no payload": it is due to errors of the model.

    states: estimates after each sample of a log.
    """
    changed = [k for k, state in enumerate(states) if state.load_changed]
    # The changes divide the log into segments of constant load. The last estimate of a segment uses all its samples and
    # is the most accurate.
    ends = [*(k - 1 for k in changed), len(states) - 1]
    reports = [states[end].payload.status for end in ends]
    return [
        k
        for k, (previous, next_report) in zip(changed, pairwise(reports), strict=True)
        if previous == "payload" or next_report != "no payload"
    ]


def contact_events(
    states: Sequence[EstimatorState], joints: Sequence[str], reports: Sequence[float]
) -> list[ContactEvent]:
    """Return the contacts in a log; contacts separated by less than `TUNING.merged` seconds are one contact.

    The torque of a payload that is not reported yet counts as an external torque, so it is a contact with `is_load`.

    states: estimates after each sample of the log. joints: names of the joints. reports: times at which a payload is
    reported first or changes, from the start of the log [s].
    """
    touching = [state for state in states if state.contact.touched.any()]
    ends = np.flatnonzero(np.diff([state.t for state in touching]) > TUNING.merged) + 1
    events = []
    for first, last in pairwise([0, *ends.tolist(), len(touching)] if touching else []):
        group = touching[first:last]
        torques = np.array([state.contact.external_torque for state in group])
        touched = np.array([state.contact.touched for state in group])
        named = np.flatnonzero(touched.any(axis=0)).tolist()
        # `peaks` are the samples of the largest external torque of each joint in contact, among the samples at which
        # the torque exceeds the threshold of the joint.
        peaks = np.where(touched, np.abs(torques), 0.0).argmax(axis=0)[named]
        force = float(max(np.linalg.norm(state.contact.force) for state in group))
        begin, end = group[0].t - states[0].t, group[-1].t - states[0].t
        names, largest = tuple(joints[k] for k in named), tuple(torques[peaks, named].tolist())
        is_load = any(begin < at < end + TUNING.merged for at in reports)
        events.append(ContactEvent(begin, end, names, largest, force, is_load))
    return events
