"""An identification as one self-contained HTML page."""

from __future__ import annotations

from spelgen.identification.identification import Identification
from spelgen.loaded_arm import LoadedArm
from spelgen.render.arm_section import arm_section, matrix
from spelgen.render.page import render_page
from spelgen.render.parameters import base_table


def page(found: Identification, arm: LoadedArm) -> str:
    """The page about ``found``: what was determined and how surely, the arm, and the torque that is left."""
    told = found.to_dict()
    words = [each["determined"] for each in told["base_parameters"]]
    never = [name for name, how in told["identifiability"].items() if how == "never"]
    return render_page(
        "identification.html.jinja",
        robot=found.arm.name,
        quality=found.quality(),
        sure=sum(word in ("firm", "fair") for word in words),
        count=len(words),
        never=never,
        residuals=found.listings()[0],
        parameters=base_table(None, arm, told),
        cells=matrix(arm.arm, arm.structure),
        arm=arm_section(arm.arm, arm.robot.path, identified=told),
        heading=found.heading(),
        notes=found.diagnostics,
    )
