"""The command ``study hand``: a hand that moves fast and at random, by mouse, keys and a tracker, and one
that only looks: penetration, coupling, force, and whether the organ comes back.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rehearsal.configuration import PRESETS, Setup, scene_of
from rehearsal.live_settings import initial_settings
from rehearsal.measurements.tumour_measurements import penetration_of
from rehearsal.rehearsal import Rehearsal
from rehearsal.sources.user import Hand
from render.viewer import Controls
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene, with_options
from sim.device import start
from studies.harness import rehearsal_of
from studies.study import CHOSEN, Results, Study, number_option, quick_option, study_command
from studies.tables_and_panels import table_of
from ultrasound.array_contact import footprint, gap_to
from ultrasound.coverage import GRID_POINTS, Coverage
from ultrasound.probe_manipulator import advanced

SEED = 20261128
STEPS_S = 1 / 60, 1 / 15
# A hand keeps to what it does for so long; shares of the kinds of hands.
LEAST_S, LONGEST_S = 0.1, 1.0
KINDS, SHARES = ("mouse", "keys", "tracker"), (0.4, 0.3, 0.3)
# The jumps and turns of a tracker, and where it stays, from the organ's middle.
JUMP_MM, TURN_DEG, AROUND_MM = 50.0, 90.0, 60.0
# Greatest rates of keys and wheel.
KEY_MM_S, KEY_DEG_S = 60.0, 120.0
# At the end the transducer is away and the tissue comes to rest.
AWAY_MM, REST_S = 100.0, 2.0
# Every so many steps the coupling of the array is compared with its distance from the organ.
IMAGED = 10
# Positions of the array and of the surface that the image knows, on its grids.
COUPLING_MM = 1.5
# Points over the organ between which a mouse that only looks moves, at a speed.
LOOKS, LOOK_MM_S = 20, 150.0
COLUMNS = {
    "preset": "{setup}",
    "step, s": "1/{rate:.0f}",
    "steps": "{steps}",
    "penetration, mm": "{penetration_mm:.3f}",
    "99.9 %, mm": "{penetration_999_mm:.3f}",
    "coupled in air": "{coupled_apart}",
    "force, N": "{force_n:.2f}",
    "lag, mm": "{lag_mm:.1f}",
    "back, mm": "{back_mm:.3f}",
    "looking: force, N": "{look_force_n:.3f}",
    "shift, mm": "{look_shift_mm:.3f}",
}


@study_command(
    "hand",
    number_option(
        "--minutes",
        low=0.1,
        high=6000,
        default=6.0,
        help="Simulated minutes, shared among presets and steps.",
    ),
    quick_option("A few seconds of one preset."),
    scene=EMBEDDED,
    arch=CHOSEN,
)
def hand(study: Study, minutes: float, quick: bool) -> Results:
    """Move the probe of SCENE fast and at random, and look at what it does to the organ.

    The depth of the array face in the organ is measured after each step, by winding number.
    """
    setups = {"fast": PRESETS["neo-hookean"]["fast"]} if quick else _setups()
    steps_s = STEPS_S[:1] if quick else STEPS_S
    runs = [(name, setup, step_s) for name, setup in setups.items() for step_s in steps_s]
    length_s = 2.0 if quick else 60 * minutes / len(runs)
    rows = []
    with study.progress(len(runs), "run") as bar:
        for name, setup, step_s in runs:
            scene, anatomy = study.scene
            rows.append(dict(setup=name) | run_hand(scene, anatomy, setup, step_s, length_s, study.backend))
            bar.update()
    return Results(dict(arch=study.backend, runs=rows), table_of(COLUMNS, rows), rows)


def _setups() -> dict[str, Setup]:
    return dict(PRESETS["neo-hookean"]) | {"shape matching": PRESETS["shape-matching"]["fast"]}


def run_hand(
    scene: Scene, anatomy: LoadedAnatomy, setup: Setup, step_s: float, length_s: float, arch: str
) -> dict[str, Any]:
    """Figures of a time [s] of a random hand, and of one that only looks, with steps of a length [s]."""
    start(arch)
    scene = with_options(scene_of(scene, setup), {"solver.time_step_s": step_s})
    rehearsal = rehearsal_of(scene, anatomy)
    looking = look(rehearsal)
    rehearsal.reset()
    return dict(rate=1 / step_s) | fuzz(rehearsal, length_s) | looking


def fuzz(rehearsal: Rehearsal, length_s: float) -> dict[str, Any]:
    """A random hand for a time [s]; then away, and where the organ is compared with before."""
    rest, step_s = rehearsal.anatomy.vertices, rehearsal.case.scene.solver.time_step_s
    contact = ArrayCoupling(rehearsal)
    depths, forces, lags, apart = [], [], [], 0
    for number, (pose, presses) in enumerate(random_hand(rehearsal, length_s)):
        rehearsal.organ.advance(pose, presses)
        rehearsal.show()
        frame = rehearsal.frame
        depths.append(penetration_of(rehearsal.anatomy))
        lags.append(frame.lag_mm)
        forces.append(0.0 if frame.wrench is None else float(np.linalg.norm(frame.wrench[:3])))
        if number % IMAGED == 0:
            apart += contact.is_apart()
    is_finite = bool(np.isfinite(frame.positions).all())
    away = advanced(rehearsal.manipulator.home, -AWAY_MM)
    for _ in range(round(REST_S / step_s)):
        rehearsal.organ.advance(away)
    rehearsal.show()
    return dict(
        steps=len(depths),
        penetration_mm=round(max(depths), 4),
        penetration_999_mm=round(float(np.quantile(depths, 0.999)), 4),
        coupled_apart=int(apart),
        force_n=round(max(forces), 4),
        lag_mm=round(max(lags), 3),
        back_mm=round(float(np.linalg.norm(rehearsal.anatomy.vertices - rest, axis=1).max()), 4),
        finite=is_finite,
        fallbacks=rehearsal.organ.divergence_check.state.is_restored,
    )


def random_hand(rehearsal: Rehearsal, length_s: float) -> Iterator[tuple[np.ndarray, bool]]:
    """The poses (4, 4) that a random hand asks for, and whether it presses; the same each time."""
    random, step_s = np.random.default_rng(SEED), rehearsal.case.scene.solver.time_step_s
    manipulator = rehearsal.manipulator
    user, pose = Hand(manipulator), rehearsal.organ.pose
    still = Controls(initial_settings(rehearsal.case))
    left_s, kind, controls = 0.0, "mouse", still
    for _ in range(max(1, round(length_s / step_s))):
        if left_s <= 0.0:
            left_s, kind = random.uniform(LEAST_S, LONGEST_S), str(random.choice(KINDS, p=SHARES))
            controls = replace(still, **_act(rehearsal, random, kind, step_s))
            if kind == "tracker":
                pose = _jump(pose, random)
                manipulator.match(pose)
        left_s -= step_s
        if kind != "tracker":
            pose = user.pose(controls, pose, step_s)
        yield pose, kind == "tracker" or manipulator.state.presses


def _act(rehearsal: Rehearsal, random: np.random.Generator, kind: str, step_s: float) -> dict[str, Any]:
    """What a mouse or keys do in a step, as in ``Controls``: a place over the organ, pressed or not; or
    pushes, slides and turns.
    """
    if kind == "mouse":
        manipulator = rehearsal.manipulator
        goal = manipulator.vertices[random.integers(len(manipulator.vertices))]
        outward = manipulator.surface_normal(goal)
        ray = goal + 50 * outward, -outward
        return dict(ray=ray, press=bool(random.random() < 0.7))
    push, *slide = random.uniform(-1, 1, 3) * KEY_MM_S * step_s
    tilt, rock, rotate = random.uniform(-1, 1, 3) * KEY_DEG_S * step_s
    turns = dict(tilt_deg=tilt, rock_deg=rock, rotate_deg=rotate)
    return dict(push_mm=push, slide_mm=(slide[0], slide[1])) | turns


def _jump(pose: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A pose (4, 4) at the end of a jump and a turn from another."""
    jumped = pose.copy()
    shift = random.normal(size=3)
    jumped[:3, 3] += JUMP_MM * random.random() * shift / np.linalg.norm(shift)
    jumped[:3, 3] *= min(1.0, AROUND_MM / max(float(np.linalg.norm(jumped[:3, 3])), 1e-9))
    axis = random.normal(size=3)
    turn = np.radians(TURN_DEG) * random.random() * axis / np.linalg.norm(axis)
    jumped[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ pose[:3, :3]
    return jumped


class ArrayCoupling:
    """Whether the image is coupled where there is neither contact nor fluid between array and organ."""

    def __init__(self, rehearsal: Rehearsal) -> None:
        self.rehearsal = rehearsal
        self.coverage = Coverage(rehearsal.case.organ, None, 0.0)
        self.points = footprint(rehearsal.case.probe)

    def is_apart(self) -> bool:
        """Whether scanlines are coupled, though the whole array is further from the organ than the gap that
        couples.
        """
        anatomy, probe = self.rehearsal.anatomy, self.rehearsal.case.probe
        if anatomy.scanner is None:
            return False
        anatomy.find_plane(probe)
        gap_mm = self.rehearsal.case.scene.image.coupling_gap_mm
        touches = self.coverage.add(anatomy.scanner.plane.rest_grid(GRID_POINTS), probe, gap_mm)
        places = self.points @ anatomy.pose[:3, :3].T + anatomy.pose[:3, 3]
        distance_mm = gap_to(places, anatomy.vertices, anatomy.organ.faces)
        return bool(touches.any()) and distance_mm > gap_mm + COUPLING_MM


def look(rehearsal: Rehearsal, legs: int = LOOKS) -> dict[str, Any]:
    """Move a mouse over the organ without pressing: the greatest force [N] and shift of the tumour [mm]."""
    random, manipulator = np.random.default_rng(SEED), rehearsal.manipulator
    step_s = rehearsal.case.scene.solver.time_step_s
    middle, place, pose = _middle(rehearsal), manipulator.vertices[0], rehearsal.organ.pose
    forces, shifts = [0.0], [0.0]
    for goal in manipulator.vertices[random.integers(len(manipulator.vertices), size=legs)]:
        count = max(1, round(float(np.linalg.norm(goal - place)) / (LOOK_MM_S * step_s)))
        for share in np.arange(1, count + 1) / count:
            outward = manipulator.surface_normal(place + share * (goal - place))
            manipulator.point(place + share * (goal - place) + AWAY_MM * outward, -outward)
            pose = manipulator.pose_towards(manipulator.pose(), pose, step_s)
            rehearsal.organ.advance(pose, manipulator.state.presses)
            rehearsal.show()
            wrench = rehearsal.frame.wrench
            forces.append(0.0 if wrench is None else float(np.linalg.norm(wrench[:3])))
            shifts.append(float(np.linalg.norm(_middle(rehearsal) - middle)))
        place = goal
    return dict(look_force_n=round(max(forces), 4), look_shift_mm=round(max(shifts), 4))


def _middle(rehearsal: Rehearsal) -> np.ndarray:
    """The middle (3,) [mm] of the tumour, or of the organ without one."""
    anatomy = rehearsal.anatomy
    return (anatomy.vertices if anatomy.tumour is None else anatomy.tumour_vertices).mean(axis=0)
