"""How `spelgen simulate` makes logs: the motion, and how it is seen."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from spelgen.settings.values import Count, Group, Inputs, NonNegative, Number, Positive, Share, Whole


class SimulationSettings(Group):
    """How `spelgen simulate` makes logs.

    protocol: random-inputs; tracking: controlled motions, see `TrackingSettings`; prescribed: motions that are
        performed exactly, torques by inverse dynamics. Without a protocol and `inputs`: tracking, of fewer and longer
        trajectories than these (`ControlledSimulation`).
    trajectories: number, each from its own initial position, at rest.
    duration: of each [s]. sample_rate: of samples and of the inputs, which are held in between [Hz].
    inputs: the torques each actuated joint draws from, every sample anew [Nm].
    test_fraction: part of the trajectories kept for testing; with tracking, of each trajectory, its end.
    presliding: of prescribed motions: the displacement over which dry friction builds up after a reversal (hysteresis)
        [rad]; a tenth of it [m] for prismatic joints; 0: none.
    torque_noise: of prescribed motions: standard deviation of white noise, relative to that of each joint's torque.
    positions: joint -> (lowest, highest) initial position [rad]; not given: its limits, +-pi if continuous.
    coulomb_smoothing_velocity: width of the tanh in place of Coulomb friction's jump [rad/s].
    delay: of the commands of position servos [s], whose motions are of their own kind, see `simulation.servo_motions`.
    """

    protocol: Literal["random-inputs", "tracking", "prescribed"] = "random-inputs"
    trajectories: Count = 64
    duration: Positive = 1.0
    sample_rate: Positive = 20.0
    inputs: Inputs = (-2.0, -1.0, 0.0, 1.0, 2.0)
    test_fraction: Share = 0.5
    positions: dict[str, tuple[Number, Number]] | None = None
    coulomb_smoothing_velocity: Positive = 0.05
    presliding: NonNegative = 0.0
    torque_noise: NonNegative = 0.0
    delay: NonNegative = 0.02
    seed: Whole = 0

    @field_validator("positions")
    @classmethod
    def _ordered(cls, value: dict[str, tuple[float, float]] | None) -> dict[str, tuple[float, float]] | None:
        for name, (lowest, highest) in (value or {}).items():
            if lowest > highest:
                raise ValueError(f"the lowest position of {name!r} first, then the highest")
        return value


class ControlledSimulation(SimulationSettings):
    """Defaults of arms that are controlled where nobody says how they are driven: fewer and longer trajectories."""

    protocol: Literal["random-inputs", "tracking", "prescribed"] = "tracking"
    trajectories: Count = 4
    duration: Positive = 8.0
    sample_rate: Positive = 125.0
    test_fraction: Share = 0.25


class ServoSimulation(SimulationSettings):
    """Defaults of arms under position servos."""

    trajectories: Count = 6
    duration: Positive = 20.0
    sample_rate: Positive = 50.0
    test_fraction: Share = 0.34


class TrackingSettings(Group):
    """How an arm moves and is seen in `simulation.protocol: tracking`.

    amplitude [rad; m], frequency [Hz]: of each joint's sine about the middle of `simulation.positions`, where `paths`
        are not excitation; unless said, less amplitude where the range is narrow.
    paths: "same": all trajectories follow one closed path, each beginning further on; "own": each has phases of
    its own, so that its test part lies where no training part was; "excitation": each goes its own way from rest to
    rest, through five frequencies, as `spelgen excite` begins its search with.
    control: "pid" of each joint by itself, or "computed-torque", which knows the arm: for arms that fall otherwise.
    bandwidths: of the controllers of the first, second, ... trajectory, then over again [Hz].
    control_rate: of the controllers, which hold their torques; simulation.sample_rate is a multiple of it [Hz].
    resolution: of the encoders [rad; m]. cutoff: of the zero-phase low-pass on their positions [Hz].
    """

    amplitude: Positive = 0.5235987755982988
    frequency: Positive = 0.125
    paths: Literal["same", "own", "excitation"] = "same"
    control: Literal["pid", "computed-torque"] = "pid"
    bandwidths: Annotated[tuple[Positive, ...], Field(min_length=1)] = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5)
    control_rate: Positive = 125.0
    resolution: Positive = 4.8e-5
    cutoff: Positive = 30.0

    @model_validator(mode="after")
    def _used(self) -> Self:
        sines = {"amplitude", "frequency"} & self.model_fields_set
        if self.paths == "excitation" and sines:
            raise ValueError(f"{' and '.join(sorted(sines))} of sines, beside paths: excitation")
        return self
