"""A case: a scene's anatomy at rest, its probe and its press.

It does not change, and holds neither solver nor CT.
"""

from dataclasses import dataclass

import numpy as np
import trimesh

from rehearsal.configuration import probe_of
from scenes.anatomy import Grid, LoadedAnatomy, press_on
from scenes.scene import PlaneShape, Press, Scene
from scenes.surfaces import translated
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import (
    ImagePlane,
    ProbeManipulator,
    image_plane,
    pose_at,
    pose_of_image_plane,
    touching,
)

TUMOUR = "tumour"


@dataclass(frozen=True)
class Case:
    """What is rehearsed. Positions are mm relative to ``origin`` (3,), the middle of the resting organ (LPS).

    ``parts`` are surfaces in the organ by tissue, the tumour apart; ``shapes`` are the rigid ones around it,
    relative to the patient (LPS); ``press`` has a value for all that the scene leaves open. ``fat_mm``
    (faces,) is that of ``LoadedAnatomy``.
    """

    scene: Scene
    probe: Probe
    origin: np.ndarray
    organ: trimesh.Trimesh
    tumour: trimesh.Trimesh | None
    parts: dict[str, trimesh.Trimesh]
    shapes: tuple[PlaneShape | trimesh.Trimesh | Grid, ...]
    press: Press
    fat_mm: np.ndarray | None

    @property
    def gravity_direction(self) -> np.ndarray:
        """Unit vector (3,)."""
        direction = np.array(self.scene.gravity.direction)
        return direction / np.linalg.norm(direction)

    @property
    def lateral(self) -> np.ndarray:
        """Unit vector (3,) to the side of the patient that the kidney is on, as seen from the middle of the
        scanner, in which patients lie: x = 0.
        """
        return np.array([np.copysign(1.0, self.origin[0]), 0.0, 0.0])

    @property
    def size_mm(self) -> np.ndarray:
        """The transducer's size (3,)."""
        return np.array(self.probe.housing_mm)

    @property
    def press_pose(self) -> np.ndarray:
        """The transducer's pose (4, 4) of the scripted press before it is moved to contact."""
        target = np.array(self.press.target_mm) - self.origin
        return pose_at(target, np.array(self.press.direction), np.array(self.press.lateral), self.size_mm[2])

    def image_plane(self, pose: np.ndarray, probe: Probe | None = None) -> ImagePlane:
        """The image plane of a transducer at a pose (4, 4), of the extent of the probe or of the probe
        with other settings.
        """
        return image_plane(pose, self.size_mm[2], *(probe or self.probe).extent_mm)

    def probe_in_patient(self, pose: np.ndarray) -> np.ndarray:
        """The pose (4, 4) of the probe in the patient (LPS), in PLUS's axes, of a transducer at a pose (4,
        4).
        """
        return shifted(self.image_plane(pose).world_from_plane, self.origin)

    def transducer_at(self, probe: np.ndarray) -> np.ndarray:
        """The transducer's pose (4, 4) where the probe, in PLUS's axes, is at a pose (4, 4) in the patient
        (LPS).
        """
        return pose_of_image_plane(shifted(probe, -self.origin), self.size_mm[2])

    def manipulator(self, settled: np.ndarray) -> ProbeManipulator:
        """The manipulator over the settled surface (n, 3) [mm] of the organ, with the transducer just
        touching it.
        """
        faces, radius = np.array(self.organ.faces, np.int64), self.probe.radius_mm
        normals = np.array(trimesh.Trimesh(settled, faces, process=False).vertex_normals)
        lateral, speed = np.array(self.press.lateral), self.scene.transducer.speed_mm_s
        manipulator = ProbeManipulator(
            settled, faces, normals, self.size_mm, self.press_pose, lateral, radius, speed
        )
        manipulator.home = touching(self.press_pose, self.size_mm, manipulator.samples, radius)
        return manipulator


def case_of(scene: Scene, anatomy: LoadedAnatomy, probe: Probe | None = None) -> Case:
    """The case of a scene, with its probe or another one. Raises ProbeError."""
    origin = anatomy.organ.bounds.mean(axis=0)
    gravity = np.array(scene.gravity.direction) / np.linalg.norm(scene.gravity.direction)
    return Case(
        scene,
        probe or probe_of(scene),
        origin,
        translated(anatomy.organ, -origin),
        anatomy.tumour and translated(anatomy.tumour, -origin),
        {tissue: translated(part, -origin) for tissue, part in anatomy.parts.items()},
        anatomy.shapes,
        press_on(scene.press, anatomy, gravity),
        anatomy.fat_mm,
    )


def shifted(pose: np.ndarray, by_mm: np.ndarray) -> np.ndarray:
    """A pose (4, 4) moved by (3,) [mm]."""
    moved = pose.copy()
    moved[:3, 3] += by_mm
    return moved
