"""What the stress test of ``study stability`` does: some 290 cases for each tissue model, in words and
numbers.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

SIZES_MM = (1.0, 1.5, 2.2, 3.3, 5.0, 7.0, 10.0)
MODELS = ("neo-hookean", "shape-matching")
AXES = ("x", "y", "z")
PRESS = ("press", 12.38)
# A body or its shape has recovered within this mean distance.
RECOVERED_MM = 0.1


@dataclass(frozen=True)
class Subject:
    """Which body: the embedded ``kidney``, an ``ellipsoid``, ``one`` particle or cell, one ``cluster`` or
    ``two`` balls.

    ``size_mm`` is the particles' radius or the cells' width; masses within it differ by ``mass_ratio``.
    ``tissue`` is JSON: what of the section ``[tissue]`` differs from the scene's.
    """

    kind: str
    size_mm: float | None = None
    mass_ratio: float = 1.0
    tissue: str = ""


KIDNEY = Subject("kidney")


@dataclass(frozen=True)
class StressCase:
    """One stress test: the body, the settings of the step, the motion of the transducer and the initial
    state.

    ``settings`` are names of StepSettings, ``material`` young_kpa and poisson; ``probe`` and ``state`` are a
    name in ``stress_motion.PROBES`` and ``stress_motion.STATES`` and its numbers; ``gravity`` and
    ``heaviest`` multiply the scene's gravity and the mass of one node. Cases of one ``kind`` belong together.
    """

    kind: str
    extreme: str
    subject: Subject = KIDNEY
    settings: Mapping[str, Any] = field(default_factory=dict)
    material: Mapping[str, float] = field(default_factory=dict)
    probe: tuple = ("away",)
    state: tuple = ("settled",)
    gravity: float = 1.0
    heaviest: float = 1.0

    @property
    def name(self) -> str:
        """Kind and extreme; unique among the cases of a model."""
        return f"{self.kind}: {self.extreme}"


def cases_of(model: str) -> list[StressCase]:
    """All cases of a model, those of one body together."""
    return [
        *_step_settings(),
        *(_material() if model == "neo-hookean" else _cluster_stiffness()),
        *_gravity(),
        *_probes(),
        *_states(),
        *_small(),
        *_two(),
        *_masses(model),
        *_sizes(),
        *(_composed() if model == "neo-hookean" else ()),
    ]


def quick_cases_of(model: str) -> list[StressCase]:
    """The last and hardest case of each kind on the kidney, and the first of a particle or cell alone."""
    chosen: list[StressCase] = []
    for kind in dict.fromkeys(case.kind for case in cases_of(model)):
        of_kind = [case for case in cases_of(model) if case.kind == kind]
        if of_kind[0].subject.kind == "kidney":
            chosen.append(of_kind[-1])
        elif of_kind[0].subject.kind == "one":
            chosen += of_kind[:3]
    return chosen


def _step_settings() -> Iterator[StressCase]:
    def case(kind: str, extreme: str, iterations: int, **settings: Any) -> StressCase:
        settings["iterations"] = iterations
        return StressCase(kind, f"{extreme}, {iterations} iterations", settings=settings, probe=PRESS)

    for dt, n in product((1e-4, 1e-3, 1 / 240, 1 / 60, 1 / 30, 0.1, 0.3, 1.0), (1, 3, 10, 30, 100)):
        yield case("time step", f"{dt:.4g} s", n, time_step_s=dt)
    for factor, n in product((1.0, 1.25, 1.5, 1.75, 1.9, 2.0), (2, 10, 100)):
        yield case("over-relaxation", f"{factor:g}", n, relaxation_factor=factor)
    for substeps, n in product((1, 2, 5, 20, 100), (1, 10)):
        yield case("substeps", f"{substeps}", n, substeps=substeps)


def _material() -> Iterator[StressCase]:
    for poisson, n in product((0.0, 0.3, 0.45, 0.49, 0.499), (1, 8, 100)):
        material, settings = dict(poisson=poisson), dict(iterations=n)
        extreme = f"{poisson:g}, {n} iterations"
        yield StressCase("Poisson's ratio", extreme, material=material, settings=settings, probe=PRESS)
    for young, dt in product((0.01, 0.1, 1.0, 100.0, 1e4, 1e6), (1 / 240, 1 / 60, 0.1)):
        material, step = dict(young_kpa=young), dict(time_step_s=dt)
        extreme = f"{young:g} kPa, {dt:.4g} s"
        yield StressCase("Young's modulus", extreme, material=material, settings=step, probe=PRESS)


def _cluster_stiffness() -> Iterator[StressCase]:
    for stiffness, dt in product((0.0, 0.01, 0.25, 0.5, 0.75, 1.0), (1e-3, 1 / 240, 1 / 60, 0.1)):
        settings = dict(stiffness=stiffness, time_step_s=dt)
        yield StressCase("stiffness", f"{stiffness:g}, {dt:.4g} s", settings=settings, probe=PRESS)


def _gravity() -> Iterator[StressCase]:
    for times, dt in product((0.0, 0.1, 10.0, 100.0, 1000.0), (1e-3, 1 / 240, 1 / 60, 0.1, 1.0)):
        settings = dict(time_step_s=dt)
        yield StressCase("gravity", f"x {times:g}, {dt:.4g} s", settings=settings, gravity=times)


def _probes() -> Iterator[StressCase]:
    for depth, dt in product((2.0, 10.0, 20.0, 30.0, 40.0), (1e-3, 1 / 60, 0.1)):
        extreme, settings = f"{depth:g} mm deep, {dt:.4g} s", dict(time_step_s=dt)
        yield StressCase("teleported", extreme, settings=settings, probe=("teleport", depth))
    for gap, n in product((5.0, 1.0, 0.0, -2.0), (3, 30)):
        extreme, settings = f"to {gap:g} mm, {n} iterations", dict(iterations=n)
        yield StressCase("pressed flat", extreme, settings=settings, probe=("flat", gap))
    for speed, depth in product((0.1, 1.0, 10.0), (5.0, 15.0, 25.0)):
        extreme = f"{speed:g} m/s, {depth:g} mm deep"
        yield StressCase("swept", extreme, probe=("sweep", 1000 * speed, depth))
    for speed, (axis, name) in product((10.0, 100.0, 1000.0), enumerate(("lateral", "elevation", "long"))):
        yield StressCase("spun", f"{speed:g} rad/s, {name} axis", probe=("spin", speed, axis))
    for name, dt in product(("in and out", "jitter", "tumble"), (1e-3, 1 / 60, 0.1)):
        yield StressCase(name, f"{dt:.4g} s", settings=dict(time_step_s=dt), probe=(name,))


def _states() -> Iterator[StressCase]:
    for suffix, settings in (("", {}), (", 1 iteration", dict(iterations=1))):
        for kind, states in STATES.items():
            for extreme, state in states:
                yield StressCase(kind, extreme + suffix, settings=settings, state=state)


def _each_axis(extreme: str, name: str, along: float, across: float) -> list[tuple[str, tuple]]:
    """A state for each axis, with one number along that axis and another across it."""
    numbers = {axis: [along if other == axis else across for other in AXES] for axis in AXES}
    return [(extreme.format(axis), (name, *values)) for axis, values in numbers.items()]


STATES: dict[str, list[tuple[str, tuple]]] = {
    "collapsed": [
        *_each_axis("to a plane, {}", "scaled", 0.0, 1.0),
        *_each_axis("to a line, {}", "scaled", 1.0, 0.0),
        ("to a point", ("scaled", 0.0, 0.0, 0.0)),
    ],
    "mirrored": [
        *_each_axis("in {}", "scaled", -1.0, 1.0),
        ("through its middle", ("scaled", -1.0, -1.0, -1.0)),
    ],
    "scaled": [
        *_each_axis("x 5 in {}", "scaled", 5.0, 1.0),
        *_each_axis("x 0.2 in {}", "scaled", 1.0 - 0.8, 1.0),
        ("x 10", ("scaled", 10.0, 10.0, 10.0)),
        ("x 0.1", ("scaled", 0.1, 0.1, 0.1)),
    ],
    "scattered": [
        *((f"by {mm:g} mm", ("scattered", mm)) for mm in (1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)),
        ("over its box", ("boxed",)),
    ],
    "thrown": [
        *_each_axis("10 m/s, {}", "thrown", 1e4, 0.0),
        *_each_axis("10 m/s, -{}", "thrown", -1e4, 0.0),
        ("1000 m/s", ("thrown", 1e6, 0.0, 0.0)),
        ("each point apart, 1 m/s", ("heated", 1e3)),
        ("each point apart, 10 m/s", ("heated", 1e4)),
        *((f"turning 100 rad/s, {name}", ("turning", axis, 100.0)) for axis, name in enumerate(AXES)),
    ],
    "displaced": [
        ("20 mm into the support", ("lifted", -20.0)),
        ("200 mm under the support", ("lifted", -200.0)),
        ("1 km up", ("lifted", 1e6)),
        ("upside down", ("scaled", -1.0, -1.0, 1.0)),
        ("one point at 1 m", ("one out", 1e3)),
        ("one point at 1e30 mm", ("one out", 1e30)),
        ("not a number", ("nothing",)),
    ],
}


def _small() -> Iterator[StressCase]:
    for kind, subject in (("one alone", Subject("one")), ("one cluster", Subject("cluster"))):
        yield StressCase(kind, "at rest", subject)
        yield StressCase(kind, "pressed", subject, probe=("press", 3.0))
        yield StressCase(kind, "teleported into", subject, probe=("teleport", 3.0))
        for dt in (1e-4, 1.0):
            yield StressCase(kind, f"{dt:g} s, 1 iteration", subject, dict(time_step_s=dt, iterations=1))
        yield StressCase(kind, "gravity x 1000", subject, gravity=1000.0)
        yield StressCase(kind, "collapsed to a point", subject, state=("scaled", 0.0, 0.0, 0.0))
        yield StressCase(kind, "mirrored", subject, state=("scaled", 1.0, 1.0, -1.0))
        yield StressCase(kind, "scattered by 100 mm", subject, state=("scattered", 100.0))
        yield StressCase(kind, "thrown 10 m/s", subject, state=("thrown", 0.0, 0.0, -1e4))


def _two() -> Iterator[StressCase]:
    two, kind = Subject("two"), "two overlapping"
    for (extreme, share), n in product((("a quarter", 0.25), ("half", 0.5), ("wholly", 1.0)), (1, 9)):
        name, state = f"{extreme}, {n} iterations", ("overlapped", share)
        yield StressCase(kind, name, two, dict(iterations=n), state=state)
    yield StressCase(kind, "pressed together", two, probe=("press", 6.0))


def _masses(model: str) -> Iterator[StressCase]:
    probes = (("at rest", ("away",)), ("pressed", ("press", 6.0)))
    for power, (name, probe) in product(range(1, 7), probes):
        ratio, extreme = 10.0**power, f"1e{power}, {name}"
        if model == "neo-hookean":
            yield StressCase("mass ratio", extreme, Subject("ellipsoid", 5.0), probe=probe, heaviest=ratio)
        else:
            yield StressCase("mass ratio", extreme, Subject("ellipsoid", 3.3, ratio), probe=probe)


def _sizes() -> Iterator[StressCase]:
    press = ("press", 8.0)
    for size in SIZES_MM:
        subject = Subject("ellipsoid", size)
        yield StressCase("size", f"{size:g} mm, pressed", subject, probe=press)
        yield StressCase("size", f"{size:g} mm, 1 iteration", subject, dict(iterations=1), probe=press)
        yield StressCase("size", f"{size:g} mm, swept 10 m/s", subject, probe=("sweep", 1e4, 8.0))
        yield StressCase("size", f"{size:g} mm, scattered by 3 mm", subject, state=("scattered", 3.0))


def _composed() -> Iterator[StressCase]:
    """Kidneys with parts a thousand times stiffer and softer, with fluid, capsule and relaxation."""
    stiff, soft, fluid = dict(young_kpa=15000.0), dict(young_kpa=0.015), dict(young_kpa=0.3, poisson=0.499)
    relaxing = [dict(modulus_ratio=2.0, time_s=0.1), dict(modulus_ratio=1.0, time_s=0.5)]
    kinds: dict[str, dict[str, Any]] = {
        "tumour x 1000": dict(parts=dict(tumour=stiff)),
        "tumour x 0.001": dict(parts=dict(tumour=soft)),
        "fluid": dict(parts=dict(urine=fluid, tumour=fluid)),
        "capsule": dict(capsule_n_mm=2.0),
        "relaxation": dict(prony=relaxing),
        "all of it": dict(
            parts=dict(urine=fluid, tumour=stiff, sinus=soft), capsule_n_mm=2.0, prony=relaxing
        ),
    }
    for kind, tissue in kinds.items():
        subject = Subject("kidney", tissue=json.dumps(tissue))
        yield StressCase(kind, "pressed", subject, probe=PRESS)
        yield StressCase(kind, "pressed, 1 iteration", subject, dict(iterations=1), probe=PRESS)
        yield StressCase(kind, "pressed, 0.1 s", subject, dict(time_step_s=0.1), probe=PRESS)
        yield StressCase(kind, "gravity x 10", subject, gravity=10.0)
        yield StressCase(kind, "swept 1 m/s, 15 mm deep", subject, probe=("sweep", 1e3, 15.0))
        yield StressCase(kind, "collapsed to a plane", subject, state=("scaled", 1.0, 1.0, 0.0))
        yield StressCase(kind, "scattered by 10 mm", subject, state=("scattered", 10.0))
        yield StressCase(kind, "teleported 20 mm deep", subject, probe=("teleport", 20.0))
