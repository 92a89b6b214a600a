"""The command ``study frames``: is a window in real time, and how soon does it show what the hand does?"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import psutil
from pydantic import Field

from rehearsal.commands.command_line import (
    ARGUMENT,
    ArchOptions,
    CommandError,
    QualityOptions,
    command,
)
from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.real_time.frame_times import FrameTimes
from rehearsal.real_time.start_times import StartTimes
from rehearsal.real_time.started_process import started_process
from render.display import display_available
from render.viewer import Controls
from render.vulkan_device import vulkan_devices
from scenes.scene import EMBEDDED
from studies.study import Results, write_results
from version import VERSION

if TYPE_CHECKING:
    from rehearsal.loop.command import Command
    from rehearsal.loop.frame import Frame, Step
    from rehearsal.run import RehearsalRun
    from rehearsal.window_loop import WindowLoop

# The scripted hand presses for a part of each period, while it drags the probe to and fro over the organ.
PRESS_PERIOD_S, PRESS_S = 3.0, 1.8
DRAG_PERIOD_S, DRAG_MM = 5.0, 12.0
# Distance of the mouse ray's origin from the organ.
FROM_MM = 60.0
# The first frames are not measured: kernels are loaded in them.
BEGIN_S = 2.0
MEMORY_EVERY_S = 60.0


class FrameOptions(QualityOptions, ArchOptions):
    """What is measured."""

    scene_sections: ClassVar = ("transducer", "image")

    scene: Annotated[Path, ARGUMENT] = EMBEDDED
    out: Path
    """Folder for the figures; the session is recorded there too."""
    seconds: float = Field(20.0, ge=2, le=36_000)
    """Seconds of the scripted press and drag."""
    rate: float | None = Field(None, ge=15, le=1000)
    """Steps a second, as for a haptic device [the scene's]; with a preset fast."""


class ScriptedHand:
    """A ``Source``: a script moves the probe by the clock in the user's stead, and quits after some seconds.

    ``times`` are those of the frames after BEGIN_S, of the last ones in a long run; ``load`` is the processor
    time that the processes have used since then, a second, and ``memory_mb`` what they have had, every
    MEMORY_EVERY_S. ``home`` (4, 4) is the transducer's pose where it just touches the organ.
    """

    def __init__(self, loop: "WindowLoop", home: np.ndarray, start: StartTimes, seconds: float) -> None:
        self.loop, self.start, self.seconds = loop, start, seconds
        self.first_picture_s = 0.0
        self.times = FrameTimes()
        self.load = 0.0
        self.memory_mb: list[float] = []
        self._user, self._home = loop.source, home
        self._began_s = 0.0
        self._used_s: float | None = None

    @property
    def status(self) -> str:
        """As ``Source.status``."""
        return self._user.status

    def commands(self, frame: "Frame", controls: Controls, elapsed_s: float) -> "Iterable[Command]":
        """As ``Source.commands``: the user's, with the script's ray and press."""
        self._measure()
        now_s, home = self._passed_s, self._home
        face = home[:3, 3] - self.loop.anatomy.case.size_mm[2] / 2 * home[:3, 2]
        aside = DRAG_MM * np.sin(2 * np.pi * now_s / DRAG_PERIOD_S) * home[:3, 0]
        ray = face + aside + FROM_MM * home[:3, 2], -home[:3, 2]
        led = replace(controls, ray=ray, press=now_s % PRESS_PERIOD_S < PRESS_S)
        return self._user.commands(frame, led, elapsed_s)

    def end(self) -> None:
        """Note the load so far, and quit. A second call does nothing."""
        if self._used_s is not None and self.load == 0.0:
            self.load = (self._used() - self._used_s) / (self._passed_s - BEGIN_S)
        self.loop.window.quit()

    @property
    def _passed_s(self) -> float:
        """Time since the first picture."""
        return perf_counter() - self._began_s if self._began_s else 0.0

    def _measure(self) -> None:
        """Measure what is due after a frame."""
        if not self._began_s and self.loop.times.ends_s:
            self._began_s = perf_counter()
            self.start.begin("Rehearsal")
            self.first_picture_s = self.start.now_s
        measured_s = self._passed_s - BEGIN_S
        if measured_s > 0 and self._used_s is None:
            self._used_s, self.loop.times = self._used(), self.times
        if self._used_s is not None and measured_s >= MEMORY_EVERY_S * len(self.memory_mb):
            self.memory_mb.append(sum(process.memory_info().rss for process in self._processes()) / 1e6)
        if measured_s > self.seconds:
            self.end()

    def _processes(self) -> list[psutil.Process]:
        this = psutil.Process()
        return [this, *this.children(recursive=True)]

    def _used(self) -> float:
        times = [process.cpu_times() for process in self._processes()]
        return sum(process.user + process.system for process in times)


@command(FrameOptions)
def frames(options: FrameOptions) -> None:
    """Measure pictures a second, pace and latency of SCENE in a window.

    A script presses and drags the probe by the clock.
    """
    if not display_available():
        raise CommandError("study frames: needs a display; on a machine without one start it under Xvfb")
    shared = {name: getattr(options, name) for name in FrameOptions.model_fields if name != "seconds"}
    hands: list[ScriptedHand] = []

    with started_process(True) as process:
        from rehearsal.opening import opened

        with opened(RehearseOptions(**shared), process) as run:

            def lead(loop: "WindowLoop") -> None:
                hands.append(ScriptedHand(loop, run.manipulator.home, run.start, options.seconds))
                loop.source = hands[0]

            run.in_window(prepare=lead)
            # Where the user has closed the window.
            hands[0].end()
            figures = figures_of(run, hands[0], options)
    write_results(options.out, "frames", Results(figures, summary(figures)))


def figures_of(run: "RehearsalRun", hand: ScriptedHand, options: FrameOptions) -> dict[str, Any]:
    """The figures of a run; times without the first BEGIN_S."""
    times, window, steps = hand.times, hand.loop.window, hand.times.steps
    layout, settings = window.layout, window.settings
    seconds = times.ends_s[-1][0] - times.ends_s[0][0]
    frames_per_s, real_time_factor = times.rates()
    scene = run.anatomy.case.scene
    return dict(
        version=VERSION,
        arch=run.arch,
        **scene.tissue.model_dump(),
        time_step_s=scene.solver.time_step_s,
        rate=options.rate,
        substeps=settings.solver.substeps,
        iterations=settings.solver.iterations,
        drivers=[device.name for device in vulkan_devices()],
        window=[layout.width, layout.height],
        picture=scene.image.mode,
        seconds=round(seconds, 2),
        frames_per_s=round(frames_per_s, 2),
        real_time_factor=round(real_time_factor, 4),
        latency_ms=spread_of(times.latency_ms),
        start_s=round(hand.first_picture_s, 2),
        start_stages_s=run.start.seconds(),
        stages_ms={name: spread_of(ms) for name, ms in times.stages_ms.items()},
        step_ms=spread_of(step.took_ms for step in steps),
        step_late_ms=spread_of(step.late_ms for step in steps),
        steps_per_s=round(len(steps) / sum(step.length_s for step in steps), 1),
        step_lengths_s=lengths_of(steps),
        iterations_least=min(step.iterations for step in steps),
        processor_s_per_s=round(hand.load, 3),
        memory_mb=[round(mb, 1) for mb in hand.memory_mb],
    )


def spread_of(values: Iterable[float]) -> dict[str, float]:
    """Median, 95th percentile and maximum."""
    known = np.fromiter(values, float)
    if len(known) == 0:
        return {}
    figures = dict(median=np.median(known), p95=np.percentile(known, 95), max=known.max())
    return {name: round(float(value), 2) for name, value in figures.items()}


def lengths_of(steps: Iterable["Step"]) -> dict[str, float]:
    """The share of the simulated time in steps of each length, by the length as a fraction of a second."""
    lengths: dict[float, float] = defaultdict(float)
    for step in steps:
        lengths[step.length_s] += step.length_s
    total = sum(lengths.values())
    return {f"1/{1 / length:.0f}": round(time / total, 3) for length, time in sorted(lengths.items())}


def summary(figures: dict[str, Any]) -> str:
    """The main figures for the terminal."""
    latency, step, late = figures["latency_ms"], figures["step_ms"], figures["step_late_ms"]
    stages = ", ".join(f"{name} {ms['median']:.1f}" for name, ms in figures["stages_ms"].items())
    lengths = ", ".join(
        f"{length} s {100 * share:.0f} %" for length, share in figures["step_lengths_s"].items()
    )
    start = ", ".join(f"{name.lower()} {seconds:.1f}" for name, seconds in figures["start_stages_s"].items())
    (width, height), drivers = figures["window"], ", ".join(figures["drivers"]) or "driver not known"
    return "\n".join(
        [
            f"pictures  {figures['frames_per_s']:.1f} a second in a window of {width} x {height} "
            f"({drivers}), real-time factor {figures['real_time_factor']:.3f}, "
            f"over {figures['seconds']:.0f} s",
            f"latency   {latency['median']:.0f} ms from an input to its picture, "
            f"95 % within {latency['p95']:.0f} ms",
            f"frame     medians in ms: {stages}",
            f"steps     {step['median']:.1f} ms each; of the simulated time {lengths}; "
            f"begun late by {late['median']:.2f} ms, 95 % within {late['p95']:.2f} ms, "
            f"at most {late['max']:.1f} ms",
            f"load      {figures['processor_s_per_s']:.2f} processor seconds a second; "
            f"memory {figures['memory_mb'][0]:.0f} MB, at the end {figures['memory_mb'][-1]:.0f} MB",
            f"start     {figures['start_s']:.1f} s to the first picture: {start}",
        ]
    )
