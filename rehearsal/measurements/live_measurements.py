"""Live measurements: figures four times a second, and the coverage of the organ by the images so far."""

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from rehearsal.deformed_anatomy import DeformedAnatomy
from rehearsal.loop.command import Move
from rehearsal.loop.frame import LEAST_LAG_MM, Applied, Frame, Step
from rehearsal.loop.timeline import periods
from rehearsal.measurements.session_summary import SessionCourse
from rehearsal.measurements.tumour_measurements import Measurement, measure
from rehearsal.measurements.uncertainty_bands import UncertaintyBands
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.resection.judgement import findings_of
from rehearsal.sessions.packed_arrays import unpack_seen
from rehearsal.sessions.session_file import Log, SessionError, makes_state
from render.viewer import View, ViewSettings
from sim.surface_contact import SLIPS
from ultrasound.coverage import GRID_POINTS, Coverage, Gap
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ProbeManipulator
from ultrasound.scanner import B_MODE

MEASURE_S, COVERAGE_S = 0.25, 1 / 30
MARGIN_MM = 5.0
# With less than this share of the scanlines in contact the B-mode image shows nothing.
LEAST_CONTACT = 0.05
COMPRESSION = "compression"
# Commands after which the tissue is as it was before.
RESTORES = "undo", "redo", "reset", "go to"
# Digits of a recorded measurement, and of what the summary counts, so that the summary follows from the
# record.
DIGITS = 4


class LiveMeasurements:
    """``latest`` is the last measurement, ``coverage`` that of the whole session, ``guide`` the guidance
    along a plan, ``bands`` how far measurements may differ, if any. ``note`` is called with each measurement
    and the number of its state.
    """

    def __init__(
        self,
        anatomy: DeformedAnatomy,
        manipulator: ProbeManipulator,
        guide: PlanGuidance | None = None,
        bands: UncertaintyBands | None = None,
    ) -> None:
        self.anatomy, self.manipulator, self.guide, self.bands = anatomy, manipulator, guide, bands
        self.note: Callable[[int, dict[str, Any]], None] = lambda number, reading: None
        self.margin_mm = MARGIN_MM if guide is None else guide.plan.margin_mm
        self._coverage: Coverage | None = None
        self._begin()

    def _begin(self) -> None:
        case = self.anatomy.case
        self.course = SessionCourse(case.scene.transducer.compression_warning_mm)
        # The last period of each in which it was done.
        self._measured = self._covered = -1
        self.latest: Measurement | None = None
        self._seen: dict[str, np.ndarray] = {}
        self._findings: dict[str, str] = {}
        self._touches = np.ones(case.probe.number_of_scanlines, bool)

    def restart(self) -> None:
        """Start a new session: no coverage, nothing to sum up."""
        self._begin()
        self.coverage.clear()
        if self.guide is not None:
            self.guide.restart()

    def recall(self, log: Log, until: int) -> bool:
        """Restore the measurements of a session's first states if its file holds the coverage until then;
        return whether it does.

        Raises SessionError.
        """
        if until not in log.seen:
            return until == 0
        seen = unpack_seen(log.seen[until])
        if seen.shape != self.coverage.seen.shape:
            raise SessionError(
                f"the session has a coverage of {seen.shape} voxels, expected {self.coverage.seen.shape}: it "
                "is damaged, or of "
                "another body"
            )
        self.coverage.seen = seen
        time_s = 0.0
        for number, command in log.commands:
            if number >= until:
                break
            # Each step counts with what was measured after it.
            for at in (number, number + makes_state(command)):
                if at in log.readings:
                    self.latest = _recorded_measurement(log.readings[at])
            if isinstance(command, Move):
                pose, length_s = log.poses[number], command.length_s or log.header.time_step_s
                if self.guide is not None:
                    self.guide.follow(pose)
                self.count(pose, length_s)
                time_s += length_s
            elif command.kind in RESTORES:
                self.count(None, 0.0)
        self._covered, self._measured = periods(time_s, COVERAGE_S), periods(time_s, MEASURE_S)
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
        return Coverage(self.anatomy.case.organ, self.anatomy.case.tumour, self.margin_mm)

    def observe(self, frame: Frame, probe: Probe) -> None:
        """Update the coverage by the image of a frame; measure where that is due, and after a rollback."""
        if frame.begins is not None:
            self.restart()
            frame = frame.of_session
        # After a rollback the latest measurement is out of date.
        is_due = bool(frame.restored) or self.latest is None
        if (
            is_due or periods(frame.time_s, COVERAGE_S) != self._covered
        ) and self.anatomy.scanner is not None:
            self._covered = periods(frame.time_s, COVERAGE_S)
            image = self.anatomy.case.scene.image
            rest = self.anatomy.scanner.plane.rest_grid(GRID_POINTS)
            self._touches = self.coverage.add(rest, probe, image.coupling_gap_mm)
        if self.guide is not None:
            self.guide.observe(frame)
        if is_due or periods(frame.time_s, MEASURE_S) != self._measured:
            self._measured = periods(frame.time_s, MEASURE_S)
            self.latest = measure(self.anatomy, probe, self._touches)
            self.note(frame.number, self.figures())
            self._show()
        for event in frame.events:
            if isinstance(event, Step):
                self.count(event.pose, event.length_s)
            elif isinstance(event, Applied) and event.restored is not None:
                self.count(None, 0.0)

    def count(self, pose: np.ndarray | None, length_s: float) -> None:
        """Count a step by its pose (4, 4) and its length [s], or a rollback by None, for the summary."""
        if self.latest is not None:
            force_n = self.latest.force_n
            self.course.add(
                pose,
                round(self.latest.compression_mm, DIGITS),
                length_s,
                None if force_n is None else round(force_n, DIGITS),
            )

    def _show(self) -> None:
        """Update what the window shows."""
        self._seen = {name: self.coverage.is_seen(points) for name, points in self._vertices().items()}
        self._findings = self.findings()

    def _vertices(self) -> dict[str, np.ndarray]:
        """The vertices at rest (n, 3) [mm] of the surfaces on which the coverage is shown."""
        surfaces = {"organ": self.anatomy.organ, "tumour": self.anatomy.tumour}
        return {
            name: np.asarray(surface.vertices) for name, surface in surfaces.items() if surface is not None
        }

    def figures(self) -> dict[str, Any]:
        """The latest measurement and the coverage so far, rounded, for the record."""
        values = asdict(self.latest) if self.latest is not None else {}
        if self.anatomy.scanner is not None:
            values |= {f"seen_{target}": self.coverage.fraction(target) for target in self.coverage.targets}
        if self.guide is not None:
            values |= self.guide.figures()
        return {
            name: None if value is None or not np.isfinite(value) else round(value, DIGITS)
            for name, value in values.items()
        }

    def summary(self, bookmarks: int = 0) -> dict[str, Any]:
        """The summary so far."""
        gaps: list[Gap] = []
        if self.anatomy.scanner is not None:
            gaps = self.coverage.gaps("margin" if "margin" in self.coverage.targets else "organ")
        return self.course.summary(self.figures(), gaps, bookmarks)

    @property
    def is_over_limit(self) -> bool:
        """Whether the tissue is compressed by more than the scene's limit."""
        limit = self.anatomy.case.scene.transducer.compression_warning_mm
        return self.latest is not None and self.latest.compression_mm > limit

    def onto(self, view: View, shown: ViewSettings) -> View:
        """A view with the measurements."""
        status, judgement = view.status, self.anatomy.judgement
        is_judged = judgement is not None and shown.phase != "Scan"
        if self.is_over_limit and self.latest is not None and not status:
            status = f"TISSUE COMPRESSED BY {self.latest.compression_mm:.0f} mm"
        return replace(
            view,
            findings=findings_of(judgement) if judgement is not None and is_judged else self._findings,
            alert=COMPRESSION if self.is_over_limit else "",
            seen=self._shown_coverage() if shown.show_seen else {},
            guidance=self.guide.guidance(shown.phase == "Scan") if self.guide is not None else None,
            status=status,
            notes={B_MODE: "NO CONTACT"} if self._touches.mean() < LEAST_CONTACT else {},
        )

    def _shown_coverage(self) -> dict[str, np.ndarray]:
        """What was imaged of each surface, unless a cut has changed the surface since."""
        vertices = self._vertices()
        return {name: seen for name, seen in self._seen.items() if len(vertices.get(name, ())) == len(seen)}

    def findings(self) -> dict[str, str]:
        """Name -> figure with its unit."""
        findings, plan = self._tissue_findings(), self.guide.figures() if self.guide is not None else {}
        if plan:
            off_mm, off_deg = plan["plan_off_mm"], plan["plan_off_deg"]
            findings["plan"] = f"{100 * (plan['plan_followed'] or 0.0):.0f} %"
            findings["off plan"] = "" if off_mm is None else f"{off_mm:.1f} mm {off_deg:.0f} deg"
        return findings

    def _tissue_findings(self) -> dict[str, str]:
        latest = self.latest
        if latest is None:
            return {}
        findings = {
            COMPRESSION: f"{_rounded(latest.compression_mm, 1)} mm",
            "contact": f"{latest.contact_mm2:.0f} mm2",
        }
        if latest.force_n is not None:
            findings["force"] = self._with_band("force_n", latest.force_n, "N", 2)
        if latest.lag_mm > LEAST_LAG_MM:
            findings["behind hand"] = f"{_rounded(latest.lag_mm, 1)} mm"
        if latest.sliding_share is not None and latest.sliding_share > SLIPS:
            findings["slip"] = f"{100 * latest.sliding_share:.0f} % of contact"
        if latest.to_tumour_mm is None:
            if self.anatomy.scanner is not None:
                findings["organ seen"] = self._share("organ")
            return findings
        findings |= {
            "to tumour": self._with_band("to_tumour_mm", latest.to_tumour_mm),
            "tumour depth": self._with_band("tumour_depth_mm", latest.tumour_depth_mm),
            "tumour shift": self._with_band("tumour_shift_mm", latest.tumour_shift_mm),
            "in view": "not cut" if latest.in_view is None else f"{100 * latest.in_view:.0f} %",
            "margin": self._with_band("margin_mm", latest.margin_mm) if latest.in_view else "",
        }
        return findings | {
            "tumour volume seen": self._share("tumour"),
            f"+{self.margin_mm:.0f} mm seen": self._share("margin"),
        }

    def _with_band(self, name: str, value: float | None, unit: str = "mm", digits: int = 1) -> str:
        """A figure with its unit and, where the scene has it, its 90 % band."""
        if value is None:
            return ""
        band = None
        if self.bands is not None:
            band = self.bands.around(name, value, self.manipulator.indentation_mm(self.anatomy.pose))
        if band is None:
            return f"{_rounded(value, digits)} {unit}"
        # Of these only a margin can be negative.
        low, high = band if name == "margin_mm" else (max(limit, 0.0) for limit in band)
        return f"{_rounded(value, digits)} ({_rounded(low, digits)} to {_rounded(high, digits)}) {unit}"

    def _share(self, target: str) -> str:
        return f"{100 * self.coverage.fraction(target):.0f} %"


def _rounded(value: float, digits: int) -> str:
    """A number with so many digits, never "-0.0"."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _recorded_measurement(values: dict[str, float | None]) -> Measurement:
    """A measurement of a session's file. Raises SessionError."""
    known = {figure.name: values.get(figure.name) for figure in fields(Measurement)}
    if known["compression_mm"] is None or known["contact_mm2"] is None:
        raise SessionError("the session holds a measurement without compression or contact: it is damaged")
    return Measurement(**known)  # type: ignore[arg-type]
