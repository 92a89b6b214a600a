"""What a headless run measured, as ``report.json`` has it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import taichi as ti

from studies.rehearsal import Rehearsal
from version import VERSION


def timed(work: Callable, into_ms: list[float]):
    """Do some work, wait for the device, and add the milliseconds that it took."""
    start = perf_counter()
    result = work()
    ti.sync()
    into_ms.append(1000 * (perf_counter() - start))
    return result


def spread(values_ms: list[float]) -> dict[str, float]:
    """Mean, standard deviation, minimum, maximum and median."""
    v = np.array(values_ms)
    figures = dict(mean=v.mean(), sd=v.std(), min=v.min(), max=v.max(), median=np.median(v))
    return {name: round(float(value), 4) for name, value in figures.items()}


# How long a notice stands in the panel.
SHOWN_S = 4.0
# Keys that not every tissue model fills.
NOT_EVERYWHERE = dict(radius_mm=None, stiffness=None, clusters=0, memberships=0)


def counted(number: int, name: str) -> str:
    """A number of things: "1 substep", "3 substeps"."""
    return f"{number} {name}{'' if number == 1 else 's'}"


@dataclass
class Record:
    """Figures gathered while a rehearsal runs; the first step and slice, which compile, count as building."""

    build_s: float
    step_ms: list[float] = field(default_factory=list)
    slice_ms: list[float] = field(default_factory=list)
    finite: bool = True
    fallbacks: list[str] = field(default_factory=list)
    volume_ratio_min: float = 1.0
    max_penetration_mm: float = 0.0
    indentation_max_mm: float = 0.0

    def watch(self, rehearsal: Rehearsal) -> None:
        """Look at the state at the end of a step; the surfaces must be up to date."""
        if rehearsal.notice:
            self.fallbacks.append(rehearsal.notice)
        self.finite &= bool(np.isfinite(rehearsal.body.position.to_numpy()).all())
        self.volume_ratio_min = min(self.volume_ratio_min, rehearsal.volume_ratio())
        self.max_penetration_mm = max(self.max_penetration_mm, rehearsal.contacts.measure_penetration())
        self.indentation_max_mm = max(self.indentation_max_mm, rehearsal.indentation_mm())

    def report(self, rehearsal: Rehearsal, arch: str) -> dict:
        """Everything in one dictionary; times in ms are over all steps but the first, if there are more."""
        settings = rehearsal.settings
        return dict(
            version=VERSION,
            title=rehearsal.scene.title,
            arch=arch,
            **(NOT_EVERYWHERE | rehearsal.scene.tissue.model_dump() | rehearsal.model.counts()),
            tetrahedra=rehearsal.embedding.count,
            time_step_s=settings.time_step_s,
            substeps=settings.substeps,
            iterations=settings.iterations,
            probe=rehearsal.probe.transducer_name,
            probe_settings=rehearsal.probe.model_dump(by_alias=True),
            picture=rehearsal.scene.image.mode,
            rung=rehearsal.scene.image.rung,
            slice_width_mm=rehearsal.probe.extent_mm[0],
            slice_depth_mm=rehearsal.probe.depth_mm,
            steps=rehearsal.steps,
            ms_per_step=spread(self.step_ms[1:] or self.step_ms),
            ms_per_slice=spread(self.slice_ms[1:] or self.slice_ms),
            build_s=round(self.build_s, 3),
            finite=self.finite,
            expected_error_mm=rehearsal.expected_error_mm(),
            fallbacks=self.fallbacks,
            volume_ratio_min=round(self.volume_ratio_min, 6),
            max_penetration_mm=round(self.max_penetration_mm, 6),
            indentation_max_mm=round(self.indentation_max_mm, 4),
        )


def summary(report: dict) -> str:
    """The figures that matter, in a few lines for the terminal."""
    step, picture = report["ms_per_step"], report["ms_per_slice"]
    times = (
        f"{step['median']:.1f} ms a step, {picture['median']:.1f} ms a picture (medians of {report['steps']})"
    )
    return "\n".join(
        [
            f"model     {_model_line(report)}",
            f"step      1/{1 / report['time_step_s']:.0f} s in {counted(report['substeps'], 'substep')} of "
            f"{counted(report['iterations'], 'iteration')}",
            f"speed     {times} on {report['arch']}; built in {report['build_s']:.1f} s",
            f"probe     {report['probe']}; picture {report['picture']}, echo as far as {report['rung']}",
            f"press     {report['indentation_max_mm']:.2f} mm deep; least volume {100 * report['volume_ratio_min']:.1f} %; "
            f"penetration at most {report['max_penetration_mm']:.3f} mm; "
            f"{'all finite' if report['finite'] else 'NOT FINITE'}",
            f"error     {_error(report['expected_error_mm'])}",
            *(f"MIND      {text}" for text in report["fallbacks"]),
        ]
    )


def _error(expected_mm: float | None) -> str:
    if expected_mm is None:
        return "not known: study trade measured no settings like these"
    return f"{expected_mm:.2f} mm expected, the mean of beads with settings like these (study trade)"


class Notices:
    """Tells the user once, and shows for a while, what the guard had to put right."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._until = 0.0

    def tell(self, notice: str) -> None:
        """Take over a step's notice; most are empty."""
        if notice:
            self._tell(notice)
            self._until = perf_counter() + SHOWN_S

    @property
    def shown(self) -> str:
        """What the panel says now."""
        return "TISSUE PUT BACK" if perf_counter() < self._until else ""


def _model_line(report: dict) -> str:
    if report["model"] == "neo-hookean":
        return (
            f"neo-Hookean, E {report['young_kpa']:g} kPa, nu {report['poisson']:g}: {report['cells']} cells of "
            f"{report['cell_mm']:g} mm, {report['nodes']} nodes, {report['tetrahedra']} tetrahedra"
        )
    return (
        f"shape matching, stiffness {report['stiffness']:g}: {report['particles']} particles of "
        f"{report['radius_mm']:g} mm, {report['clusters']} clusters, {report['memberships']} memberships, "
        f"{report['tetrahedra']} tetrahedra"
    )
