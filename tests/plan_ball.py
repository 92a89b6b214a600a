"""A ball under a probe, and plans over it."""

from itertools import pairwise

import numpy as np
import trimesh

from rehearsal.case import Case
from rehearsal.loop.frame import Event, Frame
from rehearsal.planning.plan_file import LIFT_MM, Plan, PlannedSweep
from rehearsal.planning.plan_guidance import PlanGuidance
from rehearsal.planning.sweep_path import frame_towards
from rehearsal.planning.sweep_score import ScoreTerms
from scenes.scene import Press, Scene, Trocar
from ultrasound.probe import load_probe
from ultrasound.probe_manipulator import ProbeManipulator, advanced, image_plane, pose_at

R = 30.0
SIZE = np.array([16.0, 9.0, 20.0])
ORIGIN = np.array([100.0, -200.0, 300.0])
X, Y, Z = np.eye(3)
PROBE = load_probe("linear").model_copy(update=dict(housing_mm=tuple(SIZE)))
# The ball's facets lie up to 2.2^2 / (8 R) = 0.02 mm inside it, their normals half a degree off its radii.
FACET_MM, NORMAL_DEG = 0.03, 0.5
GOOD = ScoreTerms(
    seen=0.9,
    compression_mean_mm=1.0,
    compression_max_mm=2.0,
    over_limit=0.0,
    contact=0.8,
    incidence_deg=10.0,
    path_mm=60.0,
    time_s=6.0,
    reachable=1.0,
)


def manipulator_on(mesh: trimesh.Trimesh, size_mm: np.ndarray = SIZE) -> ProbeManipulator:
    """A hand over a settled surface, straight above its origin."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, np.int64)
    return ProbeManipulator(
        vertices, faces, np.array(mesh.vertex_normals), size_mm, pose_at(R * Z, -Z, X, size_mm[2]), X
    )


def big_ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=R)


BALL = big_ball()


def from_above() -> np.ndarray:
    return frame_towards(np.zeros(3), Z, X)


def faces_in(poses: np.ndarray, length_mm: float = SIZE[2]) -> np.ndarray:
    """The middles (n, 3) of the face, by matrices."""
    return (poses @ [0.0, 0.0, -length_mm / 2, 1.0])[:, :3]


def straight_pass(count: int, aside_mm: float = 0.0, step_mm: float = 1.0) -> np.ndarray:
    """Poses (n, 4, 4) that look down from the plane z = 0 and go on along y."""
    places = np.column_stack([np.full(count, aside_mm), step_mm * np.arange(count), np.zeros(count)])
    return np.stack([pose_at(place, -Z, X, SIZE[2]) for place in places])


def in_patient(poses: np.ndarray) -> list:
    """A pass as a plan has it: PLUS's axes, LPS."""
    placed = np.stack([image_plane(pose, SIZE[2], 1.0, 1.0).world_from_plane for pose in poses])
    placed[:, :3, 3] += ORIGIN
    return placed.tolist()


def sweep_of(*passes: np.ndarray, name: str = "two passes", seen: float = 0.75) -> PlannedSweep:
    parts = dict(vars(GOOD), seen=seen)
    return PlannedSweep(
        name=name,
        score=50.0,
        parts=parts,
        points=dict(seen=75.0),
        trials=8,
        passes=[in_patient(each) for each in passes],
        transfers=[
            in_patient(np.stack([advanced(one[-1], -LIFT_MM), advanced(other[0], -LIFT_MM)]))
            for one, other in pairwise(passes)
        ],
    )


def plan_of(*sweeps: PlannedSweep, **changes) -> Plan:
    values = dict(
        anatomy="a" * 16,
        target="margin",
        margin_mm=5.0,
        speed_mm_s=10.0,
        probe=load_probe("linear").model_dump(by_alias=True, mode="json"),
        trocar=Trocar(),
        model=dict(cell_mm=8.0, model="neo-hookean"),
        seed=1,
        why=["two passes: sees most"],
        sweeps=list(sweeps) or [sweep_of(straight_pass(4))],
    )
    return Plan(**(values | changes))


def case_of_ball(**changes) -> Case:
    """The ball in a patient, its middle at ORIGIN."""
    values = dict(
        scene=Scene(anatomy={}),
        probe=PROBE,
        origin=ORIGIN,
        organ=BALL,
        tumour=None,
        parts={},
        fat_mm=None,
        shapes=(),
        press=Press(direction=-Z, lateral=X),
    )
    return Case(**(values | changes))


def guide_over_ball(plan: Plan) -> PlanGuidance:
    """A guide over an organ that is far below all ways."""
    far = big_ball().apply_translation([0.0, 0.0, -1000.0])
    return PlanGuidance(case_of_ball(), manipulator_on(far), plan)


def frame_at(pose: np.ndarray, number: int = 0, time_s: float = 0.0, *events: Event) -> Frame:
    """A frame without tissue."""
    return Frame(number, time_s, pose, pose, np.zeros((0, 3), np.float32), geometry=None, events=events)
