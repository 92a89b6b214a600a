"""The port through which an instrument brings the probe to the organ."""

from pydantic import Field

from scenes.section import Direction, Length, Section, Vector3


class Trocar(Section):
    """A remote centre of motion: the shaft goes through ``at_mm``, within a cone, and bends at its end by a wrist.

    ``axis`` points into the body; without it, it is to what is to be seen. ``wrist_deg`` is how far the probe may look aside from
    the shaft: 0 for a stiff one. A scene without ``at_mm`` asks nothing of the way in.
    """

    at_mm: Vector3 | None = None
    axis: Direction | None = None
    cone_deg: float = Field(50.0, gt=0, le=90)
    wrist_deg: float = Field(90.0, ge=0, le=180)
    longest_mm: Length = 250.0
