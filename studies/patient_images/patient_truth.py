"""What a patient's CT, labels and surface show at places [mm]: the truth that B-mode images of the patient
are compared with.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

from sim.signed_distance import distance_grid
from ultrasound.acoustics import KIDNEY
from ultrasound.probe import Probe
from ultrasound.sampled_volume import AIR_HU, FAR_MM
from ultrasound.scanned_anatomy import ScannedAnatomy

LESIONS = ("tumour", "cyst", "stone")
PARENCHYMA = ("kidney", "cortex", "medulla")
# Behind what has fewer or more HU, nothing is to be seen.
GAS_HU, BONE_HU = -300.0, 300.0
# A kidney whose median is above the first has taken up contrast agent; what is above the median by the second
# is the agent itself.
ENHANCED_HU, AGENT_ABOVE_HU = 80.0, 130.0
SURFACE_MM, SURFACE_REACH_MM = 1.0, 8.0
# A shadow is wider by so many scanlines to each side.
SHADOW_SCANLINES = 2


@dataclass(frozen=True)
class Volume:
    """Values (nx, ny, nz) on the grid of ``index_from_mm`` (4, 4), and the value outside it."""

    values: np.ndarray
    index_from_mm: np.ndarray
    outside: float

    def at(self, places: np.ndarray) -> np.ndarray:
        """Return values (...) at places (..., 3) [mm], linear between voxels."""
        at = places @ self.index_from_mm[:3, :3].T + self.index_from_mm[:3, 3]
        return ndimage.map_coordinates(
            self.values, np.moveaxis(at, -1, 0), order=1, cval=self.outside, output=np.float32
        )


@dataclass(frozen=True)
class PatientTruth:
    """A patient at rest.

    ``hu``; signed distances [mm], negative inside, from the labelled kidney with sinus and lesions as far as
    these are labelled, from its parenchyma, from contrast agent in its collecting system, and from the
    organ's surface. ``median_hu`` is that of the parenchyma, ``voxel_mm`` the longest edge of the CT's
    voxels.
    """

    hu: Volume
    kidney_mm: Volume
    parenchyma_mm: Volume
    agent_mm: Volume
    surface_mm: Volume
    median_hu: float
    voxel_mm: float

    @classmethod
    def of(cls, anatomy: ScannedAnatomy) -> "PatientTruth":
        """Return that of an anatomy whose kidney is labelled."""
        kidney = _labelled(anatomy, *KIDNEY, *LESIONS)
        parenchyma = _labelled(anatomy, *PARENCHYMA)
        median = float(np.median(anatomy.hu[parenchyma]))
        masks = kidney, parenchyma, contrast_agent(anatomy.hu, kidney, median)
        from_mm = anatomy.index_from_mm
        kidney_mm, parenchyma_mm, agent_mm = (
            Volume(signed_distance_of(mask, anatomy.voxel_mm), from_mm, FAR_MM) for mask in masks
        )
        return cls(
            Volume(anatomy.hu, from_mm, AIR_HU),
            kidney_mm,
            parenchyma_mm,
            agent_mm,
            surface_distance(anatomy.organ),
            median,
            float(anatomy.voxel_mm.max()),
        )

    def hidden_from_mm(self, probe: Probe, world_from_plane: np.ndarray) -> np.ndarray:
        """Return the depths (scanlines,) from which on gas, bone, a stone or the CT's border hides what a
        probe at a pose (4, 4) shows; infinite where nothing does. Contrast agent hides nothing. What hides
        one scanline hides SHADOW_SCANLINES beside it.
        """
        depth = sample_depths(probe)
        places = on_scanlines(probe, world_from_plane, depth)
        hu = self.hu.at(places)
        # Beside the agent, voxels are dense by partial volume.
        is_agent = self.agent_mm.at(places) <= self.voxel_mm
        hard = (hu < GAS_HU) | ((hu > BONE_HU) & ~is_agent)
        first = np.where(hard.any(axis=1), depth[hard.argmax(axis=1)], np.inf)
        return ndimage.minimum_filter1d(first, 2 * SHADOW_SCANLINES + 1, mode="nearest")


def _labelled(anatomy: ScannedAnatomy, *tissues: str) -> np.ndarray:
    """Return whether the label of a voxel is one of some tissues."""
    assert anatomy.labels is not None
    return np.isin(anatomy.labels, [value for value, tissue in anatomy.tissues.items() if tissue in tissues])


def contrast_agent(hu: np.ndarray, kidney: np.ndarray, median_hu: float) -> np.ndarray:
    """Return the mask of contrast agent in the collecting system of a kidney: dense pieces that begin inside
    its mask.

    None in a kidney that is not enhanced, where dense pieces are stones.
    """
    if median_hu <= ENHANCED_HU:
        return np.zeros_like(kidney)
    pieces, _ = ndimage.label(hu > median_hu + AGENT_ABOVE_HU)
    return np.isin(pieces, np.setdiff1d(pieces[kidney], 0))


def signed_distance_of(mask: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Return distances [mm] from a mask, negative inside, whose zero is halfway between voxels (Raya & Udupa
    1990, IEEE Trans Med Imaging 9, 32: between thick slices its contour has no stairs); FAR_MM where it is
    empty.
    """
    if not mask.any():
        return np.full(mask.shape, FAR_MM, np.float32)
    outside, inside = (ndimage.distance_transform_edt(each, sampling=spacing_mm) for each in (~mask, mask))
    return (outside - inside).astype(np.float32)


def surface_distance(surface: trimesh.Trimesh) -> Volume:
    """Return signed distances [mm] from a closed surface, negative inside, around it; FAR_MM beyond."""
    distance, low = distance_grid(surface.vertices, surface.faces, SURFACE_MM, SURFACE_REACH_MM)
    from_mm = np.diag([*[1 / SURFACE_MM] * 3, 1.0])
    from_mm[:3, 3] = -low / SURFACE_MM
    return Volume(distance, from_mm, FAR_MM)


def sample_depths(probe: Probe) -> np.ndarray:
    """Return the depths (samples,) [mm] at which the samples of a scanline are shown."""
    return (np.arange(probe.number_of_samples_per_scanline) + 0.5) * probe.sample_mm


def on_scanlines(probe: Probe, world_from_plane: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """Return places (scanlines, n, 3) [mm] at depths (n,) along the scanlines of a probe at a pose (4, 4)."""
    start, direction = probe.scanlines()
    place = start[:, None] + depth_mm[:, None] * direction[:, None]
    return place @ world_from_plane[:3, :2].T + world_from_plane[:3, 3]
