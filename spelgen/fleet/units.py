"""Units of the same arm learn from one another: fitted each and all together, then each again near what all have in
common, as near as units were found to be; and what sets them apart, from unit to unit and from day to day.

Empirical Bayes: the deviations of the prior are those of the units' own fits from the common one. They are first
guesses, from which the fit of a unit goes away as its logs ask (see `fitting/gaussian_prior.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spelgen.fitting.fitted import load_run
from spelgen.fitting.gaussian_prior import KINDS
from spelgen.fitting.run_folder import RunFolder
from spelgen.fleet.jobs import Job
from spelgen.fleet.prepare import Prepared
from spelgen.fleet.schema import Fleet
from spelgen.loaded_arm import load_arm
from spelgen.settings.fits import GaussianPrior

CLOSED_FORM = "closed-form"
SHARED = "closed-form, units"  # how the runs are called that know the other units
LEAST = 0.02  # of the prior's deviations: two units are never known to be the same
DRIVES = {"coulomb": "Nm, N", "viscous": "Nm s/rad, N s/m", "armature": "kg m^2, kg"}


@dataclass(frozen=True)
class Units:
    """Arms of the same URDF. names, days: of the units. quantities: by name, with unit, the values of each unit and
    those of the common fit, for each of `labels`.
    """

    arm: str
    names: tuple[str, ...]
    days: tuple[str | None, ...]
    quantities: tuple[Quantity, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)


@dataclass(frozen=True)
class Quantity:
    """values: (units, labels); common: (labels,), of the fit to all units; spread: (labels,), standard deviation."""

    name: str
    unit: str
    labels: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]
    common: tuple[float, ...]
    spread: tuple[float, ...]


def pooled_jobs(own: Sequence[Job], prepared: Mapping[str, Prepared], folder: Path) -> list[Job]:
    """For each arm of several units, and each split, the fit to the logs of all units."""
    found = []
    for jobs in _by_arm(own, prepared):
        first, name = jobs[0], f"all-{jobs[0].urdf.stem}-{prepared[jobs[0].robot].group[:4]}"
        found.append(
            replace(
                first, robot=name, folder=folder / "runs" / name / first.folder.name,
                train=tuple(path for job in jobs for path in job.train),
                test=tuple(path for job in jobs for path in job.test),
                data="+".join(job.data for job in jobs),
            )
        )  # fmt: skip
    return found


def unit_jobs(own: Sequence[Job], pooled: Sequence[Job], prepared: Mapping[str, Prepared]) -> list[Job]:
    """For each unit the fit that starts from the common one and stays as near as units are to one another."""
    found = []
    for jobs in _by_arm(own, prepared):
        common = _of(jobs, pooled)
        if common is None:
            continue
        prior = spread([_weights(job) for job in jobs], _weights(common))
        for job in jobs:
            folder = job.folder.with_name(job.folder.name.replace(CLOSED_FORM, f"{CLOSED_FORM}-units"))
            found.append(replace(job, preset=SHARED, folder=folder, source=common.folder, prior=prior))
    return found


def spread(units: Sequence[Mapping[str, torch.Tensor]], common: Mapping[str, torch.Tensor]) -> GaussianPrior:
    """The prior of a unit about the common weights: by kind of weight the root mean square of how far units are from
    them, the middle one of the units. All joints together move no more than each by itself.
    """
    kinds = {name: kind for name in common for end, kind in KINDS.items() if name.endswith(end)}
    found: dict[str, float] = {}
    for kind in set(kinds.values()) - {"friction_compensation"}:
        names = [name for name in kinds if kinds[name] == kind]
        squares = [
            torch.cat([(unit[x] - common[x]).square().flatten() for x in names]).mean() for unit in units
        ]
        found[kind] = max(float(torch.stack(squares).median().sqrt()), LEAST)
    together = {name: 0.0 for name in GaussianPrior.model_fields if name.startswith("shared_")}
    return GaussianPrior(**found, **together)


def units_of(
    own: Sequence[Job], pooled: Sequence[Job], prepared: Mapping[str, Prepared], fleet: Fleet
) -> list[Units]:
    """What sets the units of each arm apart, after their own fits (first split)."""
    found = []
    for jobs in _by_arm([job for job in own if job.split == 0], prepared):
        common = _of(jobs, [job for job in pooled if job.result()])
        if common is None:
            continue
        days = {job.robot: fleet.robots[job.robot].day for job in jobs}
        jobs = sorted(jobs, key=lambda job: str(days[job.robot] or ""))
        models = [load_run(job.folder).model for job in (*jobs, common)]
        quantities = [
            _drives(name, unit, models) for name, unit in DRIVES.items() if hasattr(models[0], name)
        ]
        quantities.append(_base(common, models))
        told = tuple(None if (day := days[job.robot]) is None else day.isoformat() for job in jobs)
        found.append(Units(common.urdf.stem, tuple(job.robot for job in jobs), told, tuple(quantities)))
    return found


def _drives(name: str, unit: str, models: Sequence[Any]) -> Quantity:
    rows = np.array([getattr(model, name).detach().numpy() for model in models])
    return _quantity(name, unit, tuple(models[0].joint_names), rows)


def _base(common: Job, models: Sequence[Any]) -> Quantity:
    """The base parameters of the bodies: of ten parameters a body, all that motion shows."""
    base = load_arm(common.urdf, common.joints, common.tip).base_parameters
    rows = []
    for model in models:
        ten = model.inertial_parameters.detach().numpy().ravel()
        rows.append([sum(float(weight) * ten[k] for k, weight in each.weights) for each in base])
    return _quantity("base parameters", "kg, kg m, kg m^2", tuple(each.name for each in base), np.array(rows))


def _quantity(name: str, unit: str, labels: tuple[str, ...], rows: np.ndarray) -> Quantity:
    """Of the units' values and, last, the common ones."""
    values = rows[:-1]
    return Quantity(
        name, unit, labels, tuple(map(tuple, values.tolist())), tuple(rows[-1].tolist()),
        tuple(values.std(axis=0, ddof=1).tolist()),
    )  # fmt: skip


def _by_arm(own: Sequence[Job], prepared: Mapping[str, Prepared]) -> list[list[Job]]:
    """The jobs of each arm and split of which there are several units."""
    groups: dict[tuple[str, int], list[Job]] = {}
    for job in own:
        groups.setdefault((prepared[job.robot].group, job.split), []).append(job)
    return [jobs for jobs in groups.values() if len(jobs) > 1]


def _of(jobs: Sequence[Job], pooled: Sequence[Job]) -> Job | None:
    """The common fit of these units."""
    return next((x for x in pooled if x.train[: len(jobs[0].train)] == jobs[0].train), None)


def _weights(job: Job) -> dict[str, torch.Tensor]:
    run = RunFolder(job.folder)
    return run.load_state(run.weights)
