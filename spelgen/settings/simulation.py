"""Settings of `spelgen simulate`: motions, torques and measurement."""

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from spelgen.settings.yaml_document import Count, Group, Inputs, NonNegative, Place, Positive, Share, Whole


class SimulationSettings(Group):
    """Simulated logs.

    Attributes:
        protocol: random-inputs: random torques; tracking: controlled motions, see `tracking`; prescribed: exact
            motions with torques by inverse dynamics; default: tracking, and random-inputs if `inputs` are set.
        trajectories: Number of trajectories; each starts at rest from a random position.
        duration: Duration of each trajectory [s].
        sample_rate: Sample rate; random inputs are constant between samples [Hz].
        inputs: Torques from which random-inputs draws one per actuated joint and sample [Nm].
        positions: Lowest and highest initial position of each joint; default: its limits, +-pi without limits [rad].
        coulomb_smoothing_velocity: Velocity scale of the tanh that replaces the step of Coulomb friction [rad/s].
        test_fraction: Fraction of the trajectories that is used for testing; with tracking, the fraction at the end of
            each trajectory.
        presliding: Displacement over which dry friction builds up after a reversal (hysteresis) in prescribed motions;
            for prismatic joints, 0.1 m per rad of this value; 0: no hysteresis [rad].
        torque_noise: Standard deviation of the white torque noise of prescribed motions, divided by the standard
            deviation of each joint's torque.
        delay: Delay of the commands of position servos [s].
        seed: Seed of all random numbers.
    """

    protocol: Literal["random-inputs", "tracking", "prescribed"] = "random-inputs"
    trajectories: Count = 64
    duration: Positive = 1.0
    sample_rate: Positive = 20.0
    inputs: Inputs = (-2.0, -1.0, 0.0, 1.0, 2.0)
    test_fraction: Share = 0.5
    positions: dict[str, tuple[Place, Place]] | None = None
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
    """Defaults of simulations for which neither `protocol` nor `inputs` is set, so that controllers track motions."""

    protocol: Literal["random-inputs", "tracking", "prescribed"] = "tracking"
    trajectories: Count = 4
    duration: Positive = 8.0
    sample_rate: Positive = 125.0
    test_fraction: Share = 0.25


class ServoSimulation(SimulationSettings):
    """Defaults of simulations of arms with position servos."""

    trajectories: Count = 6
    duration: Positive = 20.0
    sample_rate: Positive = 50.0
    test_fraction: Share = 0.34


class TrackingSettings(Group):
    """Motion, control and measurement with `simulation.protocol: tracking`.

    Attributes:
        amplitude: Amplitude of each joint's sine about the middle of `simulation.positions`; the default is reduced
            for a joint with a smaller range [rad, m].
        frequency: Frequency of the sines [Hz].
        paths: "same": one closed path with a different first point per trajectory; "own": random phases per
            trajectory; "excitation": random paths of five frequencies from rest to rest, like the first candidates of
            `spelgen excite`.
        control: "pid": one independent controller per joint; "computed-torque": with the dynamics of the arm, for arms
            that PID control cannot support.
        bandwidths: Bandwidths of the controllers of successive trajectories, repeated cyclically [Hz].
        control_rate: Rate of the controllers; `simulation.sample_rate` must be an integer multiple of this rate [Hz].
        resolution: Resolution of the encoders [rad, m].
        cutoff: Cutoff frequency of the zero-phase low-pass filter on the measured positions [Hz].
    """

    amplitude: Annotated[Place, Field(gt=0)] = 0.5235987755982988
    frequency: Positive = 0.125
    paths: Literal["same", "own", "excitation"] = "same"
    control: Literal["pid", "computed-torque"] = "pid"
    bandwidths: Annotated[tuple[Positive, ...], Field(min_length=1)] = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5)
    control_rate: Positive = 125.0
    resolution: Positive = 4.8e-5
    cutoff: Positive = 30.0

    @model_validator(mode="after")
    def _used(self) -> Self:
        # `amplitude` and `frequency` with excitation motions are an error: they have no effect on these motions.
        sines = {"amplitude", "frequency"} & self.model_fields_set
        if self.paths == "excitation" and sines:
            raise ValueError(f"{' and '.join(sorted(sines))} of sines, with paths: excitation")
        return self
