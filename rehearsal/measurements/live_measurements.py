"""What the window reads off a rehearsal while it goes on: figures four times a second, and what has been in the picture."""

from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from rehearsal.measurements.session_summary import SessionCourse
from rehearsal.measurements.tumour_measurements import Measurement, measure
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.rehearsal import Rehearsal
from rehearsal.sessions.packed_coverage import unpack_seen
from rehearsal.sessions.session import Session
from rehearsal.sessions.session_file import Log, SessionError
from render.viewer import Settings, View
from ultrasound.coverage import GRID_POINTS, Coverage, Gap
from ultrasound.probe import Probe
from ultrasound.scanner import B_MODE

READ_S, LOOK_S = 0.25, 1 / 30
MARGIN_MM = 5.0
# An echo of which no more than this share of the lines touches shows nothing.
BLACK_BELOW = 0.05
COMPRESSION = "compression"
# Of a reading in the record, and of what is counted by it, so that it can be counted by the record alone.
DIGITS = 4


class LiveMeasurements:
    """``reading`` is the latest; ``coverage`` is of the whole session; ``guide`` is the plan that is followed, if any."""

    def __init__(self, rehearsal: Rehearsal, guide: PlanGuidance | None = None) -> None:
        self.rehearsal, self.guide = rehearsal, guide
        self.margin_mm = MARGIN_MM if guide is None else guide.plan.margin_mm
        self._coverage: Coverage | None = None
        step_s = rehearsal.settings.time_step_s
        self._read_every, self._look_every = (max(1, round(s / step_s)) for s in (READ_S, LOOK_S))
        self._begin()

    def _begin(self) -> None:
        rehearsal = self.rehearsal
        self.course = SessionCourse(
            rehearsal.scene.transducer.compression_warning_mm, rehearsal.settings.time_step_s
        )
        self.reading: Measurement | None = None
        self._seen: dict[str, np.ndarray] = {}
        self._findings: dict[str, str] = {}
        self._touches = np.ones(rehearsal.probe.number_of_scanlines, bool)

    def restart(self) -> None:
        """Nothing was seen or done yet."""
        self._begin()
        self.coverage.clear()
        if self.guide is not None:
            self.guide.begin_anew()

    def recall(self, log: Log, until: int) -> bool:
        """Take over what the first moments of a session came to, where its file holds what was seen until then; whether it does.

        Raises SessionError.
        """
        if until not in log.seen:
            return until == 0
        seen = unpack_seen(log.seen[until])
        if seen.shape != self.coverage.seen.shape:
            raise SessionError(
                f"the session says of {seen.shape} voxels what was seen, expected {self.coverage.seen.shape}: it is damaged, or of "
                "another body"
            )
        self.coverage.seen = seen
        for moment, pose in enumerate(log.poses[:until], 1):
            for event in log.events.get(moment, []):
                if event.kind == "reading":
                    self.reading = _noted(event.value)
            is_way_back = bool(np.isnan(pose).any())
            if self.guide is not None and not is_way_back:
                self.guide.watch(pose)
            self._count(None if is_way_back else pose)
        self._show()
        return True

    def follow(self, guide: PlanGuidance) -> None:
        """Follow a plan from now on; the coverage so far is kept."""
        self.guide = guide
        if guide.plan.margin_mm != self.margin_mm:
            self.margin_mm, seen = guide.plan.margin_mm, self.coverage.seen
            self._coverage = self._new_coverage()
            self._coverage.seen = seen

    @property
    def coverage(self) -> Coverage:
        """The coverage of the whole session; computed only if somebody asks for it."""
        if self._coverage is None:
            self._coverage = self._new_coverage()
        return self._coverage

    def _new_coverage(self) -> Coverage:
        return Coverage(self.rehearsal.organ, self.rehearsal.tumour, self.margin_mm)

    def watch(self, session: Session, probe: Probe, pose: np.ndarray | None) -> None:
        """Look at a moment (its step's pose, None of a way back) whose pictures were taken, and note a new reading in the session."""
        # What was measure before a way back is not so any more.
        is_anew = pose is None or self.reading is None
        if (is_anew or session.step_index % self._look_every == 0) and self.rehearsal.scanner is not None:
            image = self.rehearsal.scene.image
            rest = self.rehearsal.scanner.plane.rest_grid(GRID_POINTS)
            self._touches = self.coverage.add(rest, probe, image.contact_gap_mm)
        if self.guide is not None:
            self.guide.go_with(session)
        if is_anew or session.step_index % self._read_every == 0:
            self.reading = measure(self.rehearsal, probe, self._touches)
            session.note("reading", self.figures())
            self._show()
        self._count(pose)

    def _count(self, pose: np.ndarray | None) -> None:
        if self.reading is not None:
            self.course.add(pose, round(self.reading.compression_mm, DIGITS))

    def _show(self) -> None:
        """What the window shows from now on."""
        surfaces = {"organ": self.rehearsal.organ, "tumour": self.rehearsal.tumour}
        self._seen = {
            name: self.coverage.is_seen(np.asarray(surface.vertices))
            for name, surface in surfaces.items()
            if surface is not None
        }
        self._findings = self.findings()

    def figures(self) -> dict[str, Any]:
        """The reading and the shares seen so far, rounded, for the record."""
        values = asdict(self.reading) if self.reading is not None else {}
        if self.rehearsal.scanner is not None:
            values |= {f"seen_{target}": self.coverage.fraction(target) for target in self.coverage.targets}
        if self.guide is not None:
            values |= self.guide.figures()
        return {
            name: None if value is None or not np.isfinite(value) else round(value, DIGITS)
            for name, value in values.items()
        }

    def summary(self, bookmarks: int = 0) -> dict[str, Any]:
        """How the rehearsal went so far."""
        gaps: list[Gap] = []
        if self.rehearsal.scanner is not None:
            gaps = self.coverage.gaps("margin" if "margin" in self.coverage.targets else "organ")
        return self.course.summary(self.figures(), gaps, bookmarks)

    @property
    def is_too_deep(self) -> bool:
        """Whether the tissue is squeezed by more than the scene's limit."""
        limit = self.rehearsal.scene.transducer.compression_warning_mm
        return self.reading is not None and self.reading.compression_mm > limit

    def onto(self, view: View, settings: Settings) -> View:
        """A view with what was measure."""
        status = view.status
        if self.is_too_deep and self.reading is not None and not status:
            status = f"TISSUE SQUEEZED BY {self.reading.compression_mm:.0f} mm"
        return replace(
            view,
            findings=self._findings,
            alert=COMPRESSION if self.is_too_deep else "",
            seen=self._seen if settings.show_seen else {},
            guidance=self.guide.guidance() if self.guide is not None else None,
            status=status,
            notes={B_MODE: "NO CONTACT"} if self._touches.mean() < BLACK_BELOW else {},
        )

    def findings(self) -> dict[str, str]:
        """Name -> figure with its unit."""
        return self._of_tissue() | (self.guide.findings() if self.guide is not None else {})

    def _of_tissue(self) -> dict[str, str]:
        reading = self.reading
        if reading is None:
            return {}
        found = {COMPRESSION: _mm(reading.compression_mm), "contact": f"{reading.contact_mm2:.0f} mm2"}
        if reading.to_tumour_mm is None:
            return found if self.rehearsal.scanner is None else found | {"organ seen": self._share("organ")}
        found |= {
            "to tumour": _mm(reading.to_tumour_mm),
            "tumour depth": _mm(reading.tumour_depth_mm),
            "tumour shift": _mm(reading.tumour_shift_mm),
            "in view": "not cut" if reading.in_view is None else f"{100 * reading.in_view:.0f} %",
            "margin": _mm(reading.margin_mm) if reading.in_view else "",
        }
        return found | {
            "tumour seen": self._share("tumour"),
            f"+{self.margin_mm:.0f} mm seen": self._share("margin"),
        }

    def _share(self, target: str) -> str:
        return f"{100 * self.coverage.fraction(target):.0f} %"


def _mm(length: float | None) -> str:
    """As the window shows it, without a minus before nothing; empty of none."""
    return "" if length is None else f"{round(length, 1) + 0.0:.1f} mm"


def _noted(values: dict[str, float | None]) -> Measurement:
    """A reading that a session's file has. Raises SessionError."""
    known = {each.name: values.get(each.name) for each in fields(Measurement)}
    if known["compression_mm"] is None or known["contact_mm2"] is None:
        raise SessionError("the session holds a reading without compression or contact: it is damaged")
    return Measurement(**known)  # type: ignore[arg-type]
