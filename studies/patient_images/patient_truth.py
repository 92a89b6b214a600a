"""What a patient's CT, labels and surface show at places [mm], at the pixels of a B-mode image and at the
samples of its scanlines: the truth that images of the patient are compared with.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy import ndimage

from sim.fields import array_of
from sim.signed_distance import distance_grid
from ultrasound.acoustics import KIDNEY
from ultrasound.bmode import BMode
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
        """Values (...) at places (..., 3) [mm], linear between voxels."""
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
        """That of an anatomy whose kidney is labelled."""
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
        """Depths (scanlines,) from which on gas, bone, a stone or the CT's border hides what a probe at a
        pose (4, 4) shows; infinite where nothing does. Contrast agent hides nothing. What hides one scanline
        hides SHADOW_SCANLINES beside it.
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
    """Whether the label of a voxel is one of some tissues."""
    assert anatomy.labels is not None
    return np.isin(anatomy.labels, [value for value, tissue in anatomy.tissues.items() if tissue in tissues])


def contrast_agent(hu: np.ndarray, kidney: np.ndarray, median_hu: float) -> np.ndarray:
    """Mask of contrast agent in the collecting system of a kidney: dense pieces that begin inside its mask.

    None in a kidney that is not enhanced, where dense pieces are stones.
    """
    if median_hu <= ENHANCED_HU:
        return np.zeros_like(kidney)
    pieces, _ = ndimage.label(hu > median_hu + AGENT_ABOVE_HU)
    return np.isin(pieces, np.setdiff1d(pieces[kidney], 0))


def signed_distance_of(mask: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Distances [mm] from a mask, negative inside, whose zero is halfway between voxels (Raya & Udupa 1990,
    IEEE Trans Med Imaging 9, 32: between thick slices its contour has no stairs); FAR_MM where it is empty.
    """
    if not mask.any():
        return np.full(mask.shape, FAR_MM, np.float32)
    outside, inside = (ndimage.distance_transform_edt(part, sampling=spacing_mm) for part in (~mask, mask))
    return (outside - inside).astype(np.float32)


def surface_distance(surface: trimesh.Trimesh) -> Volume:
    """Signed distances [mm] from a closed surface, negative inside, around it; FAR_MM beyond."""
    distance, low = distance_grid(surface.vertices, surface.faces, SURFACE_MM, SURFACE_REACH_MM)
    from_mm = np.diag([*[1 / SURFACE_MM] * 3, 1.0])
    from_mm[:3, 3] = -low / SURFACE_MM
    return Volume(distance, from_mm, FAR_MM)


def sample_depths(probe: Probe) -> np.ndarray:
    """Depths (samples,) [mm] at which the samples of a scanline are shown."""
    return (np.arange(probe.number_of_samples_per_scanline) + 0.5) * probe.sample_mm


def on_scanlines(probe: Probe, world_from_plane: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """Places (scanlines, n, 3) [mm] at depths (n,) along the scanlines of a probe at a pose (4, 4)."""
    start, direction = probe.scanlines()
    place = start[:, None] + depth_mm[:, None] * direction[:, None]
    return place @ world_from_plane[:3, :2].T + world_from_plane[:3, 3]


# The kidney's surroundings are what is so near to it; fat has these HU.
NEAR_MM = 12.0
FAT_HU = -150.0, -30.0
# Nearer to the array is its own vibration, deeper no longer the kidney.
DEPTHS_MM = 4.0, 45.0


@dataclass(frozen=True)
class PictureTruth:
    """Masks (rows, columns) of an image's pixels.

    ``kidney``: labelled as kidney, its sinus or lesion, at whatever depth, seen or not. ``seen``: reached by
    the scanlines, not behind gas, bone or stones. The others are what of the seen at DEPTHS_MM, without
    contrast agent, is parenchyma (``judged_kidney``), not kidney but within NEAR_MM of it (``surroundings``),
    and of these has FAT_HU (``fat``).
    """

    kidney: np.ndarray
    seen: np.ndarray
    judged_kidney: np.ndarray
    surroundings: np.ndarray
    fat: np.ndarray


def picture_truth(
    patient: PatientTruth, probe: Probe, world_from_plane: np.ndarray, shape: tuple[int, int]
) -> PictureTruth:
    """The truth of an image of a shape (rows, columns) at a pose (4, 4)."""
    place = pixel_places(probe, shape)
    world = place @ world_from_plane[:3, :2].T + world_from_plane[:3, 3]
    hu, distance = patient.hu.at(world), patient.kidney_mm.at(world)
    line, depth = probe.beam_coordinates(*np.moveaxis(place, -1, 0))
    nearest = np.clip(np.rint(line), 0, probe.number_of_scanlines - 1).astype(int)
    reached = (line >= -0.5) & (line <= probe.number_of_scanlines - 0.5) & (depth >= 0)
    seen = reached & (depth < patient.hidden_from_mm(probe, world_from_plane)[nearest])
    judged = seen & (depth >= DEPTHS_MM[0]) & (depth <= DEPTHS_MM[1]) & (patient.agent_mm.at(world) > 0)
    kidney = distance < 0
    surroundings = judged & ~kidney & (distance <= NEAR_MM)
    fat = surroundings & (hu >= FAT_HU[0]) & (hu <= FAT_HU[1])
    parenchyma = judged & (patient.parenchyma_mm.at(world) < 0)
    return PictureTruth(kidney, seen, parenchyma, surroundings, fat)


def pixel_places(probe: Probe, shape: tuple[int, int]) -> np.ndarray:
    """Places (rows, columns, 2) (u, v) [mm] of the centres of an image's pixels."""
    to_probe = probe.image_to_probe(*shape)
    u = np.arange(shape[1]) * to_probe[0, 0] + to_probe[0, 3]
    v = np.arange(shape[0]) * to_probe[1, 1] + to_probe[1, 3]
    return np.stack(np.meshgrid(u, v), axis=-1)


@dataclass(frozen=True)
class ScanlineTruth:
    """Arrays (scanlines, samples) of one image, before the grey map, with gain and TGC.

    ``power`` is the mean square of the echo, linear. ``surface_mm`` is the signed distance of the sample's
    tissue from the organ's surface, negative inside, ``incidence_deg`` the angle between scanline and normal
    of that surface. ``parenchyma_mm`` and ``agent_mm`` as ``PatientTruth``; ``seen`` is not behind gas, bone
    or stones. ``depth_mm`` (samples,).
    """

    power: np.ndarray
    depth_mm: np.ndarray
    surface_mm: np.ndarray
    incidence_deg: np.ndarray
    parenchyma_mm: np.ndarray
    agent_mm: np.ndarray
    hu: np.ndarray
    seen: np.ndarray


def scanline_truth(
    patient: PatientTruth, probe: Probe, world_from_plane: np.ndarray, bmode: BMode
) -> ScanlineTruth:
    """The truth of the image that was rendered last, at a pose (4, 4)."""
    depth, place = sample_depths(probe), rest_of_samples(bmode, probe)
    along = probe.scanlines()[1] @ world_from_plane[:3, :2].T
    return ScanlineTruth(
        10 ** (array_of(bmode.decibel).astype(float) / 10),
        depth,
        patient.surface_mm.at(place),
        incidence_deg(patient, place, along),
        patient.parenchyma_mm.at(place),
        patient.agent_mm.at(place),
        patient.hu.at(place),
        depth < patient.hidden_from_mm(probe, world_from_plane)[:, None],
    )


def rest_of_samples(bmode: BMode, probe: Probe) -> np.ndarray:
    """Where the tissue of each sample is at rest (scanlines, samples, 3) [mm]: the speed of sound displaces
    what is shown.
    """
    at = (np.arange(bmode.samples) + 0.5) / bmode.sound.stride_of(probe)
    first = at.astype(int)
    rest, share = array_of(bmode.sound.rest), (at - first)[:, None]
    return rest[:, first] * (1 - share) + rest[:, first + 1] * share


def incidence_deg(patient: PatientTruth, place: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Angles (scanlines, samples) between scanlines of directions (scanlines, 3) and the normal of the
    organ's surface at places.
    """
    half = np.eye(3)
    normal = np.stack(
        [patient.surface_mm.at(place + step) - patient.surface_mm.at(place - step) for step in half], axis=-1
    )
    length = np.maximum(np.linalg.norm(normal, axis=-1), 1e-9)
    cosine = np.abs(np.einsum("lsk,lk->ls", normal, along)) / length
    return np.degrees(np.arccos(np.minimum(cosine, 1.0)))
