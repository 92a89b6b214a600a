"""The rigid surrogate, against counting voxels one by one."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from plan_ball import SIZE, R, X, Y, Z, big_ball, case_of_ball, manipulator_on

from rehearsal.planning import rigid_surrogate
from rehearsal.planning.rigid_surrogate import RigidSurrogate
from rehearsal.planning.sweep_path import tilted
from rehearsal.planning.sweep_score import MEANS
from rehearsal.planning.sweep_trial import Trial
from scenes.scene import Scene, with_options
from sim.fields import field_of
from ultrasound.coverage import VOXEL_MM, Coverage
from ultrasound.probe import load_probe
from ultrasound.probe_manipulator import pose_at

pytestmark = pytest.mark.usefixtures("one_device")


GAP_MM, WARNING_MM = 1.5, 2.0
TUMOUR_MM, AT = 8.0, np.array([2.0, -3.0, 14.0])


def surrogate_of(probe) -> tuple[RigidSurrogate, Coverage]:
    """A surrogate of tissue that has not settled."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=TUMOUR_MM).apply_translation(AT)
    coverage = Coverage(big_ball(), ball)
    options = {"image.contact_gap_mm": GAP_MM, "transducer.compression_warning_mm": WARNING_MM}
    case = case_of_ball(scene=with_options(Scene(anatomy={}), options), probe=probe)
    anatomy = SimpleNamespace(skin=lambda places: SimpleNamespace(vertices=field_of(places, 1)))
    trial = SimpleNamespace(
        case=case,
        rehearsal=SimpleNamespace(anatomy=anatomy, reset=lambda: None),
        manipulator=manipulator_on(big_ball(), case.size_mm),
        sampled_places=coverage.voxel_centres("tumour"),
        held=lambda passes: np.concatenate(passes)[:, 0, 3] < 100.0,
    )
    trial.terms, trial.tried = partial(Trial.terms, trial), partial(Trial.tried, trial)
    return RigidSurrogate(trial), coverage


def path_over_the_tumour(length: float) -> np.ndarray:
    """Poses 1, 3 and 0.5 mm in the ball, the second tilted, the third turned; one above, one beside."""
    faces = np.array([[0, 0, R - 1], [0, -4, R - 3], [3, 0, R - 0.5], [0, 5, R + 3]])
    down = np.stack([pose_at(face, -Z, X, length) for face in faces])
    down[1] = tilted(down[1], length, 12.0)
    down[2] = pose_at(faces[2], -Z, X + Y, length)
    return np.concatenate([down, pose_at(R * Z + 60 * X, -Z, X, length)[None]])


def kind_with(poses: np.ndarray | None) -> SimpleNamespace:
    """A kind of pass whose only pass this is."""
    return SimpleNamespace(values=lambda parameters: {}, poses=lambda manipulator, values: poses)


@pytest.mark.parametrize("name", ["linear", "drop-in", "curvilinear"])
def test_the_surrogate_agrees_with_counting_voxels_one_by_one(name):
    probe = load_probe(name)
    found, coverage = surrogate_of(probe)
    length = float(probe.housing_mm[2])
    poses = path_over_the_tumour(length)
    tried = found.try_pass(kind_with(poses), np.arange(3.0))
    terms = SimpleNamespace(**dict(zip(MEANS, tried.sums / 5, strict=True)))
    assert tried.poses == 5 and np.array_equal(tried.parameters, np.arange(3.0))
    places = coverage.origin_mm + VOXEL_MM * np.argwhere(coverage.targets["tumour"])
    surely, perhaps = np.zeros(len(places), bool), np.zeros(len(places), bool)
    for pose in poses:
        slack = [shown_by(probe, pose, length, places, off) for off in (-0.3, 0.3)]
        surely |= slack[0]
        perhaps |= slack[1]
    assert (surely <= tried.seen).all() and (tried.seen <= perhaps).all() and 0.2 < tried.seen.mean() < 0.99
    assert perhaps.mean() - surely.mean() < 0.12
    deep = [max(depth_of_array(probe, pose, length).max(), 0.0) for pose in poses]
    # Distances between voxels are off by VOXEL^2 / 8 of the curvatures 2 / R, and the facets.
    off = VOXEL_MM**2 / 4 / R + 0.05
    assert terms.compression_mean_mm == pytest.approx(np.mean(deep), abs=off)
    assert terms.over_limit == pytest.approx(np.mean(np.array(deep) > WARNING_MM)) == 0.2
    touching = [(depth_of_array(probe, pose, length) >= -GAP_MM).mean() for pose in poses]
    assert terms.contact == pytest.approx(np.mean(touching), abs=1.5 / rigid_surrogate.ELEMENTS)
    faces = (poses @ [0.0, 0.0, -length / 2, 1.0])[:, :3]
    assert tried.path_mm == pytest.approx(np.linalg.norm(np.diff(faces, axis=0), axis=1).sum())


def shown_by(probe, pose: np.ndarray, length: float, places: np.ndarray, slack: float) -> np.ndarray:
    """Which places a picture shows, one after the other; slack [mm] widens all that decides."""
    shown = []
    for u, minus_w, z in (places - pose[:3, 3]) @ pose[:3, :3]:
        v, w = -z - length / 2, -minus_w
        if probe.radius_mm > 0:
            angle, along = (
                np.arctan2(u, v + probe.radius_mm),
                np.hypot(u, v + probe.radius_mm) - probe.radius_mm,
            )
            edges = np.radians([probe.theta_start_deg, probe.theta_stop_deg])
            aside = max(edges[0] - angle, angle - edges[1]) * probe.radius_mm
            element = probe.radius_mm * np.array([np.sin(angle), np.cos(angle) - 1])
        else:
            along, aside, element = v, abs(u) - probe.transducer_width_mm / 2, np.array([u, 0.0])
        at = pose @ [element[0], 0.0, -element[1] - length / 2, 1.0]
        shown.append(
            aside <= slack
            and -slack <= along <= probe.depth_mm + slack
            and abs(w) <= (probe.elevation_width_mm + VOXEL_MM) / 2 + slack / 10
            and np.linalg.norm(at[:3]) - R <= GAP_MM + slack
        )
    return np.array(shown)


def depth_of_array(probe, pose: np.ndarray, length: float) -> np.ndarray:
    """How deep elements all along the array are in the ball [mm]."""
    at = [pose @ [u, 0.0, -v - length / 2, 1.0] for u, v in probe.elements()]
    return R - np.linalg.norm(np.array(at)[:, :3], axis=1)


def test_a_pass_that_cannot_be_held_is_not_tried_and_the_same_pass_gives_the_same():
    found, _ = surrogate_of(load_probe("linear"))
    poses = path_over_the_tumour(SIZE[2])
    one, again = (found.try_pass(kind_with(poses), np.zeros(0)) for _ in range(2))
    assert np.array_equal(one.seen, again.seen) and np.array_equal(one.sums, again.sums)
    out_of_reach = poses.copy()
    out_of_reach[-1, 0, 3] = 101.0
    for beside in (None, out_of_reach):
        assert found.try_pass(kind_with(beside), np.zeros(0)) is None
    # It makes passes with fewer samples, and does not change the manipulator of the trials.
    assert len(found.manipulator.samples) < len(found.trial.manipulator.samples)
