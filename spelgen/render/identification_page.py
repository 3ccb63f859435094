"""An identification as one self-contained HTML page."""

from __future__ import annotations

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.identification.identification import Identification
from spelgen.render.arm_section import arm_section, matrix
from spelgen.render.page import render_page
from spelgen.render.parameters import DETERMINED, base_table
from spelgen.render.plots import Record
from spelgen.structure.structure import derive


def page(identification: Identification, arm: ConfiguredArm) -> str:
    """The page about an identification: what was determined and how surely, the arm, and the torque that is left."""
    record: Record = identification.to_dict()
    words = [parameter["determined"] for parameter in record["base_parameters"]]
    never = [name for name, visibility in record["identifiability"].items() if visibility == "never"]
    return render_page(
        "identification.html.jinja",
        robot=identification.arm.name,
        quality=identification.quality(),
        sure=sum(word in DETERMINED for word in words),
        count=len(words),
        never=never,
        residuals=identification.listings()[0],
        parameters=base_table(None, arm, record),
        cells=matrix(arm.arm, derive(arm.arm)),
        arm=arm_section(arm.arm, arm.robot.path),
        heading=identification.heading(),
        notes=identification.diagnostics,
    )
