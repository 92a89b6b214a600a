"""The report of a run without a window: ``report.json`` and its summary."""

from dataclasses import dataclass, field

import numpy as np

from rehearsal.configuration import STEP, Setup
from rehearsal.loop.frame import Frame
from rehearsal.measurements.tumour_measurements import penetration_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.result_files import counted, spread
from rehearsal.speed_accuracy import expected_error_mm, load_points
from scenes.tissue import TISSUES
from sim.surface_contact import SLIPS
from version import VERSION

# Keys that some tissue models leave open.
NOT_EVERYWHERE = dict(radius_mm=None, stiffness=None, clusters=0, memberships=0)


def numerical_error_of(rehearsal: Rehearsal) -> float | None:
    """Mean bead error [mm] on other kidneys, of known material, that ``study trade`` measured with similar
    settings; None if there are none.
    """
    case, step = rehearsal.case, rehearsal.organ.settings
    changed = {name: getattr(step, name) for name in STEP}
    setup = Setup(case.scene.tissue, case.scene.solver.model_copy(update=changed))
    return expected_error_mm(load_points(), setup)


@dataclass
class Tally:
    """Figures of a running rehearsal; the first step and image, which compile kernels, are not timed."""

    build_s: float
    step_ms: list[float] = field(default_factory=list)
    slice_ms: list[float] = field(default_factory=list)
    finite: bool = True
    fallbacks: list[str] = field(default_factory=list)
    volume_ratio_min: float = 1.0
    penetration_mm: float = 0.0
    max_penetration_mm: float = 0.0
    max_lag_mm: float = 0.0
    indentation_max_mm: float = 0.0
    force_max_n: float = 0.0

    def add(self, rehearsal: Rehearsal, frame: Frame) -> None:
        """Add a frame of a rehearsal that shows it."""
        self.step_ms += [step.took_ms for step in frame.steps]
        self.fallbacks += [step.notice for step in frame.steps if step.notice]
        # After a rollback the tissue is restored, but the tool only with the next step.
        if not frame.steps or frame.restored:
            return
        self.finite &= bool(np.isfinite(frame.positions).all())
        if not self.finite:
            return
        self.volume_ratio_min = min(self.volume_ratio_min, rehearsal.anatomy.volume_ratio())
        self.penetration_mm = penetration_of(rehearsal.anatomy)
        self.max_penetration_mm = max(self.max_penetration_mm, self.penetration_mm)
        self.max_lag_mm = max(self.max_lag_mm, frame.lag_mm)
        self.indentation_max_mm = max(self.indentation_max_mm, rehearsal.indentation_mm())
        if frame.wrench is not None:
            self.force_max_n = max(self.force_max_n, float(np.linalg.norm(frame.wrench[:3])))

    def report(self, rehearsal: Rehearsal, arch: str) -> dict:
        """The report; times [ms] without the first step, None if nothing was timed; no figures of tissue
        that is not finite.
        """
        case, settings = rehearsal.case, rehearsal.organ.settings
        frame = rehearsal.frame
        wrench = frame.wrench if self.finite else None
        return dict(
            version=VERSION,
            title=case.scene.title,
            arch=arch,
            **(
                NOT_EVERYWHERE
                | case.scene.tissue.model_dump(exclude={"parts"})
                | rehearsal.organ.model.counts()
            ),
            parts={
                part.name: dict(young_kpa=part.material.young_kpa, poisson=part.material.poisson)
                for part in rehearsal.organ.parts_of_tissue
            },
            tetrahedra=rehearsal.anatomy.embedding.count,
            time_step_s=case.scene.solver.time_step_s,
            substeps=settings.substeps,
            iterations=settings.iterations,
            probe=case.probe.transducer_name,
            probe_settings=case.probe.model_dump(by_alias=True),
            picture=case.scene.image.mode,
            detail_level=case.scene.image.detail_level,
            slice_width_mm=case.probe.extent_mm[0],
            slice_depth_mm=case.probe.depth_mm,
            steps=rehearsal.organ.steps,
            ms_per_step=_times(self.step_ms),
            ms_per_slice=_times(self.slice_ms),
            build_s=round(self.build_s, 3),
            finite=self.finite,
            numerical_error_mm=numerical_error_of(rehearsal),
            fallbacks=self.fallbacks,
            volume_ratio_min=round(self.volume_ratio_min, 6) if self.finite else None,
            penetration_mm=round(self.penetration_mm, 6) if self.finite else None,
            max_penetration_mm=round(self.max_penetration_mm, 6) if self.finite else None,
            max_lag_mm=round(self.max_lag_mm, 4),
            indentation_max_mm=round(self.indentation_max_mm, 4) if self.finite else None,
            force_max_n=None if wrench is None else round(self.force_max_n, 4),
            probe_force_n=None if wrench is None else [round(v, 4) for v in wrench[:3].tolist()],
            probe_torque_n_mm=None if wrench is None else [round(v, 3) for v in wrench[3:].tolist()],
            sliding_share=_rounded(frame.sliding_share if self.finite else None),
            friction_ratio=_rounded(frame.friction_ratio if self.finite else None),
        )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def _times(ms: list[float]) -> dict[str, float] | None:
    return spread(ms[1:] or ms) if ms else None


def summary(report: dict) -> str:
    """The main figures, in a few lines for the terminal."""
    measured = {"step": report["ms_per_step"], "image": report["ms_per_slice"]}
    times = ", ".join(f"{ms['median']:.1f} ms per {name}" for name, ms in measured.items() if ms is not None)
    shown = f"image {report['picture']}, B-mode at detail level {report['detail_level']}"
    return "\n".join(
        [
            f"model     {TISSUES[report['model']].report_line.format(**report)}, {report['tetrahedra']} "
            "tetrahedra",
            *([f"parts     {_parts(report['parts'])}"] if report["parts"] else []),
            f"step      1/{1 / report['time_step_s']:.0f} s in {counted(report['substeps'], 'substep')} of "
            f"{counted(report['iterations'], 'iteration')}",
            f"speed     {times} (medians of {report['steps']}) on {report['arch']}; built in "
            f"{report['build_s']:.1f} s",
            f"probe     {report['probe']}; {shown if measured['image'] else 'no images'}",
            f"press     {_press(report)}",
            f"numerical {_error(report['numerical_error_mm'])}",
            *(f"WARNING   {text}" for text in report["fallbacks"]),
        ]
    )


def _parts(parts: dict[str, dict[str, float]]) -> str:
    return ", ".join(
        f"{name} {part['young_kpa']:g} kPa (nu {part['poisson']:g})" for name, part in parts.items()
    )


def _press(report: dict) -> str:
    if not report["finite"]:
        return "NOT FINITE: the tissue diverged, and there are no figures of it"
    return (
        f"indentation {report['indentation_max_mm']:.2f} mm at most{_force(report['force_max_n'])}"
        f"{_slip(report['sliding_share'])}; "
        f"least volume {100 * report['volume_ratio_min']:.1f} %; "
        f"penetration at most {report['max_penetration_mm']:.3f} mm; all finite; the probe at most "
        f"{report['max_lag_mm']:.1f} mm behind the hand"
    )


def _force(most_n: float | None) -> str:
    return "" if most_n is None else f", force {most_n:.2f} N at most"


def _slip(share: float | None) -> str:
    if share is None or share <= SLIPS:
        return ""
    return f", {100 * share:.0f} % of the contact slides"


def _error(expected_mm: float | None) -> str:
    if expected_mm is None:
        return "error not known: study trade measured no similar settings"
    return (
        f"error {expected_mm:.2f} mm: mean bead error with similar settings on virtual kidneys (study "
        "trade), not the error on this one"
    )
