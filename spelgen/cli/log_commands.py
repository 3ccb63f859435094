"""Commands about logs: `excite` designs a motion, `simulate` simulates logs, `logs` checks logs."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, answer, note, progress_bar, refuse_warnings, say
from spelgen.cli.options import argument, option, output_option
from spelgen.errors import SpelgenError, SpelgenErrors
from spelgen.files import write_text
from spelgen.labels import counted

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm


@dataclass(frozen=True)
class MotionOptions:
    """Arguments of the function `spelgen.excite`, as options of a command."""

    duration: float = option("", "Duration [s].", min=2.0, max=600.0, default=30.0)
    sample_rate: float = option("", "Sample rate [Hz].", min=1.0, max=10000.0, default=100.0)
    harmonics: int | None = option(
        "", "Number of harmonics; default: 0.4 per second, at least 5.", min=2, max=100
    )
    reach: float = option("", "Fraction of the position range to use.", min=0.05, max=1.0, default=0.9)
    speed: float = option("", "Fraction of the velocity limits to use.", min=0.05, max=1.0, default=0.7)
    acceleration: str | None = option(
        "X|X,X,X", "Largest acceleration, of all joints or per joint [rad/s^2, m/s^2]."
    )
    start: str | None = option(
        "X,X,X",
        "Position before the motion [rad, m]. Default: zero, or the middle of a range without zero.",
        "--from",
    )
    surroundings: Path | None = option("FILE.yaml", "Floor, boxes and clearance, which the motion respects.")
    trials: int = option("", "Candidates of the search, after random ones.", min=1, default=100)
    seed: int = option("", "Seed of the search.", min=0, default=0)

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `spelgen.excite`; lists of numbers are converted from text."""
        acceleration = options.numbers(self.acceleration, "--acceleration")
        return vars(self) | {"acceleration": acceleration, "start": options.numbers(self.start, "--from")}


def excite(
    output: Path = output_option("FILE.csv", "Output file of the motion.", default=...),
    *,
    design: MotionOptions,
    chosen_arm: options.ArmOptions,
    trajectory: Path | None = option(
        "FILE", "Also write approach and motion as a JointTrajectory of ROS 2, in JSON or YAML."
    ),
    html: Path | None = option("FILE", "Also write a page that shows the motion."),
    force: bool = options.FORCE,
    format: options.TextOrJson = options.TEXT_OR_JSON,
) -> None:
    """Propose an excitation trajectory for identification.

    Collisions of the arm with itself and its surroundings are avoided if the URDF has collision geometry.
    """
    from spelgen.excitation.design import excite as design_motion

    for path in (output, trajectory, html):
        if path is not None:
            # Output files that exist already are reported before the search for a motion, because the search takes
            # minutes.
            options.require_free(path, force=force)
    arm = chosen_arm.load()
    with progress_bar("searching") as progress:
        motion = design_motion(arm, progress=progress, **design.arguments())
    written = [str(write_text(output, motion.csv()))]
    # The ROS trajectory is written in addition to the CSV file, which `simulate` reads.
    if trajectory is not None:
        written.append(str(write_text(trajectory, motion.joint_trajectory())))
    if html is not None:
        # Pages need packages that are slow to import, so they are imported only if a page is written.
        from spelgen.render.arm_pages import motion_page

        written.append(str(write_text(html, motion_page(motion, arm))))
    lines = [f"wrote {path}" for path in written]
    answer(format, {"files": written} | motion.to_dict(), motion.text(), *lines)


def simulate(
    output: Path = output_option("LOGS", "Folder for train and test logs.", default=...),
    *,
    chosen_arm: options.ArmOptions,
    seed: int | None = option("", "Random seed; default: the seed in the robot's settings.", min=0),
    as_built: int | None = option(
        "SEED", "Simulate an arm that differs from its URDF, drawn from this seed.", min=0
    ),
    motion: list[Path] | None = option(
        "FILE.csv", "A motion of `spelgen excite` to perform; repeatable. The last half is for testing."
    ),
    force: bool = options.FORCE,
) -> None:
    """Simulate training and test logs with Pinocchio.

    With --as-built, masses, centres of mass, friction and armature differ from the URDF as on a real arm;
    LOGS/as_built.urdf and .yaml are the truth, for `spelgen evaluate --truth`.
    """
    from spelgen.logs.read import write_logs
    from spelgen.simulation.as_built import as_built as make_as_built
    from spelgen.simulation.prescribed import read_motion
    from spelgen.simulation.simulate import simulate as simulate_arm

    arm = chosen_arm.load()
    names = arm.chain.joint_names
    motions = [read_motion(file, names) for file in motion or ()]
    truth = output / "as_built.urdf"
    paths = {role: output / f"{role}.parquet" for role in ("train", "test")}
    for path in [*paths.values(), *([] if as_built is None else [truth, truth.with_suffix(".yaml")])]:
        options.require_free(path, force=force)
    if as_built is not None:
        arm = make_as_built(arm, as_built, truth)
        say(f"wrote {truth} and as_built.yaml, the true arm")
    with progress_bar("simulating") as progress:
        logs = simulate_arm(arm, seed=seed, motions=motions, progress=progress)
    # Logs are written in SI units, with the joint names of the URDF as column names, so that they need no mapping.
    for path, trajectories in zip(paths.values(), (logs.train, logs.test), strict=True):
        if trajectories:
            write_logs(path, trajectories, names)
            count = counted(len(trajectories), "trajectory")
            say(f"wrote {path}: {count}, {sum(map(len, trajectories))} samples")


def logs(
    paths: list[Path] = argument("LOGS", "Log files or folders."),
    robot: Path = option("ROBOT.urdf", "URDF of the logged arm.", default=...),
    joints: str | None = options.JOINTS,
    tip: str | None = options.TIP,
    angle_tolerance: float = options.ANGLE_TOLERANCE,
    mapping: Path | None = options.MAPPING_FILE,
    format: options.TextOrJson = options.TEXT_OR_JSON,
    html: Path | None = option("FILE", "Also write an HTML page with plots."),
    suggest: Path | None = option("", "Write a mapping drafted from the column names of the first log."),
    force: bool = options.FORCE,
    accept: list[str] | None = options.ACCEPT,
    strict: bool = options.STRICT,
) -> None:
    """Check logs against the robot, and report their contents.

    The logs are not changed. The exit code is 1 if they cannot be used for training.
    """
    from spelgen.log_checks.check_logs import check_logs
    from spelgen.logs.read import read_bounded_logs

    # The mapping is loaded after the arm, because the names in the mapping are checked against the joints of the URDF.
    arm = options.ArmOptions(robot, joints, tip, angle_tolerance).load()
    # The mapping is suggested before the logs are read: logs with other column names cannot be read without a mapping.
    if suggest is not None:
        if suggest.resolve() == robot.with_suffix(".yaml").resolve():
            do = "name another file"
            raise SpelgenError("this file has the settings of the robot", file=suggest, do=do)
        options.require_free(suggest, force=force)
        mapping = _suggested(paths, arm, suggest)
    log_mapping = options.log_mapping(arm, mapping, accept)
    logs, notes = read_bounded_logs(paths, arm, log_mapping)
    result = check_logs(logs, arm, log_mapping)
    result = replace(result, findings=(*notes, *result.findings))
    if format == "text":
        say(result.text())
    else:
        say(json.dumps(result.to_dict(), indent=2))
    # The HTML page is also written for logs with errors, because charts may show the cause of an error.
    if html is not None:
        from spelgen.render.arm_pages import logs_page

        text = logs_page(result, arm.chain, arm.actuation.matrix())
        note(f"wrote {write_text(html, text)}")
    if result.errors:
        note(SpelgenErrors(result.errors))
    # Warnings with --strict and errors in the logs have the same exit code.
    if strict:
        refuse_warnings("", len(result.warnings))
    if result.errors:
        raise typer.Exit(FAILED)


def _suggested(paths: list[Path], arm: Arm, file: Path) -> Path:
    """Write a mapping for the columns of the first log to ``file``; return ``file``.

    Exits with 1 if a needed quantity, such as the position of a joint, has no matching column.
    """
    from spelgen.errors import collect
    from spelgen.logs.formats import log_files
    from spelgen.logs.suggest import suggest_mapping

    # Only the first log is read: a mapping is for logs that all have the same columns.
    logs, errors = log_files(paths)
    collect(errors)
    suggestion = suggest_mapping(logs[0], arm.chain.joint_names, commands=arm.settings.input == "position")
    say(f"wrote {write_text(file, suggestion.text)}; check it, then pass it by --mapping")
    if suggestion.missing:
        note(f"no column was found for {', '.join(suggestion.missing)}; write their names into {file}")
        raise typer.Exit(FAILED)
    return file
