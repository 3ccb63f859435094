"""Let units of the same arm learn from one another: fitted each by itself and all together, then each again near what
all have in common, as near as units were found to be; and compare them, from unit to unit and from day to day.

Empirical Bayes: the deviations of the prior are those of the units' own fits from the common one. They are first
guesses, from which the fit of a unit goes away as its logs ask (see `fitting/gaussian_prior.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.dynamics.parameters import parameter_table
from spelgen.fitting.fitted import load_run
from spelgen.fitting.gaussian_prior import prior_field
from spelgen.fitting.run_folder import RunFolder
from spelgen.fleet.jobs import Job
from spelgen.fleet.prepare import PreparedArm
from spelgen.fleet.schema import Fleet
from spelgen.loaded_arm import load_arm
from spelgen.settings.fits import GaussianPrior

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

CLOSED_FORM = "closed-form"
SHARED = "closed-form, units"  # the name of runs that know the other units
LEAST_DEVIATION = 0.02  # of the prior: two units are never known to be the same
DRIVES = {"coulomb": "Nm, N", "viscous": "Nm s/rad, N s/m", "armature": "kg m^2, kg"}


@dataclass(frozen=True)
class Quantity:
    """A quantity of each unit. values: (units, labels). common: (labels,), of the fit to all units. spread: (labels,),
    standard deviation over units.
    """

    name: str
    unit: str
    labels: tuple[str, ...]
    values: list[list[float]]
    common: list[float]
    spread: list[float]


@dataclass(frozen=True)
class Units:
    """Arms of the same URDF, in the order of the days of their logs."""

    arm: str
    names: tuple[str, ...]
    days: tuple[str | None, ...]
    quantities: tuple[Quantity, ...]


def pooled_jobs(separate: Sequence[Job], arms: Mapping[str, PreparedArm], folder: Path) -> list[Job]:
    """Return, for each arm of several units and each split, the fit to the logs of all units."""
    pooled = []
    for jobs in _by_arm(separate, arms):
        first = jobs[0]
        name = f"all-{first.urdf.stem}-{arms[first.robot].group[:4]}"
        train: tuple[Path, ...] = ()
        test: tuple[Path, ...] = ()
        for job in jobs:
            train, test = (*train, *job.train), (*test, *job.test)
        update = {"robot": name, "folder": folder / "runs" / name / first.folder.name}
        data = "+".join(job.data for job in jobs)
        pooled.append(first.model_copy(update=update | {"train": train, "test": test, "data": data}))
    return pooled


def unit_jobs(separate: Sequence[Job], pooled: Sequence[Job], arms: Mapping[str, PreparedArm]) -> list[Job]:
    """Return, for each unit, the fit that starts from the common one and stays as near as units are to one another."""
    near = []
    for jobs in _by_arm(separate, arms):
        common = _common_fit(jobs, pooled)
        if common is None:
            continue
        kinds = {name: x.kind for name, x in parameter_table(load_run(common.folder).model).items()}
        prior = spread([_weights(job) for job in jobs], _weights(common), kinds)
        for job in jobs:
            name = job.folder.name.replace(CLOSED_FORM, f"{CLOSED_FORM}-units")
            update = {"preset": SHARED, "folder": job.folder.with_name(name)}
            near.append(job.model_copy(update=update | {"source": common.folder, "prior": prior}))
    return near


def spread(
    units: Sequence[Mapping[str, torch.Tensor]], common: Mapping[str, torch.Tensor], kinds: Mapping[str, str]
) -> GaussianPrior:
    """Return the prior of a unit about the common weights.

    By kind of weight it is the root mean square of the distance of units from them, the median of the units. All joints
    together move no more than each by itself. kinds: of weights by name, see `dynamics.parameters`.
    """
    names: dict[str, list[str]] = {}
    for name in common:
        field = prior_field(kinds.get(name, ""))
        if field in GaussianPrior.model_fields and field != "friction_compensation":
            names.setdefault(field, []).append(name)
    deviations = {field: 0.0 for field in GaussianPrior.model_fields if field.startswith("shared_")}
    for kind, of_kind in names.items():
        squares = []
        for unit in units:
            distances = torch.cat([(unit[name] - common[name]).flatten() for name in of_kind])
            squares.append(distances.square().mean())
        # the median: one odd unit must not loosen the prior of all
        deviations[kind] = max(float(torch.stack(squares).median().sqrt()), LEAST_DEVIATION)
    return GaussianPrior(**deviations)


def compare_units(
    separate: Sequence[Job], pooled: Sequence[Job], arms: Mapping[str, PreparedArm], fleet: Fleet
) -> list[Units]:
    """Return the units of each arm beside one another, after their own fits (first split)."""
    compared = []
    for jobs in _by_arm([job for job in separate if job.split == 0], arms):
        common = _common_fit(jobs, pooled)
        if common is None:
            continue
        jobs = sorted(jobs, key=lambda job: _day(fleet, job))
        models = [load_run(job.folder).model for job in (*jobs, common)]
        quantities = []
        for name, unit in DRIVES.items():
            if hasattr(models[0], name):
                rows = np.array([getattr(model, name).detach().numpy() for model in models])
                quantities.append(_quantity(name, unit, tuple(models[0].joint_names), rows))
        quantities.append(_base_parameters(common, models))
        days = tuple(_day(fleet, job) or None for job in jobs)
        names = tuple(job.robot for job in jobs)
        compared.append(Units(common.urdf.stem, names, days, tuple(quantities)))
    return compared


def _day(fleet: Fleet, job: Job) -> str:
    """Return the day of a unit's logs, "" where the fleet's file does not name it."""
    day: date | None = fleet.robots[job.robot].day
    return "" if day is None else day.isoformat()


def _base_parameters(common: Job, models: Sequence[EmittedModel]) -> Quantity:
    """Return the base parameters of the bodies: of ten parameters a body, all that motion shows."""
    base = load_arm(common.urdf, common.joints, common.tip).base_parameters
    rows = []
    for model in models:
        inertial = model.inertial_parameters.detach().numpy().ravel()
        row = []
        for parameter in base:
            row.append(sum(float(weight) * inertial[k] for k, weight in parameter.weights))
        rows.append(row)
    labels = tuple(parameter.name for parameter in base)
    return _quantity("base parameters", "kg, kg m, kg m^2", labels, np.array(rows))


def _quantity(name: str, unit: str, labels: tuple[str, ...], rows: np.ndarray) -> Quantity:
    """Return the quantity of rows (units + 1, labels): those of the units and, last, the common ones."""
    values = rows[:-1]
    # ddof 1: units are few
    deviation = values.std(axis=0, ddof=1)
    return Quantity(name, unit, labels, values.tolist(), rows[-1].tolist(), deviation.tolist())


def _by_arm(separate: Sequence[Job], arms: Mapping[str, PreparedArm]) -> list[list[Job]]:
    """Return the jobs of each arm and split that has several units."""
    groups: dict[tuple[str, int], list[Job]] = {}
    for job in separate:
        groups.setdefault((arms[job.robot].group, job.split), []).append(job)
    return [jobs for jobs in groups.values() if len(jobs) > 1]


def _common_fit(jobs: Sequence[Job], pooled: Sequence[Job]) -> Job | None:
    """Return the fit to all of these units."""
    first = jobs[0].train
    for job in pooled:
        if job.train[: len(first)] == first:
            return job
    return None


def _weights(job: Job) -> dict[str, torch.Tensor]:
    run = RunFolder(job.folder)
    return run.load_state(run.weights)
