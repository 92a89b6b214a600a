"""The tissue of every voxel around a kidney: labels where there are any, and the CT's HU, place and contrast
phase elsewhere.

What no CT shows (pyramids without enhancement, the renal fascia) is drawn on request, and marked.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import SimpleITK as sitk
import trimesh
from scipy import ndimage

from scenes.tissue_classes.bones import bones, spine_middle
from scenes.tissue_classes.collecting_system import (
    DensePieces,
    agent_in_bone,
    dense_pieces,
    pelvis_without_agent,
)
from scenes.tissue_classes.drawn_anatomy import MOST_MM, draw_fascia, draw_perimysium, draw_pyramids
from scenes.tissue_classes.fine_grid import (
    FAR_MM,
    SURFACE_MM,
    Box,
    SurfaceGrid,
    box_around,
    fine_factors,
    fine_index_from_mm,
    refined,
    refined_labels,
    surface_box,
)
from scenes.tissue_classes.kidney_parts import kidney_parts
from scenes.tissue_classes.lesion_parts import lesion_parts
from scenes.tissue_classes.surroundings import METAL_ABOVE_HU, Place, surroundings
from scenes.tissue_classes.vessels import arterial_aorta, with_branches

# In the order of their codes.
TISSUES = (
    *(
        "gas",
        "fat",
        "fascia",
        "soft-tissue",
        "muscle",
        "perimysium",
        "liver",
        "spleen",
        "bowel",
        "bone",
        "metal",
        "fluid",
    ),
    *("kidney", "cortex", "medulla", "arcuate", "sinus", "urine", "stone", "vessel", "artery", "vein"),
    *("tumour", "pseudocapsule", "necrosis", "cyst"),
)
CODE = {name: code for code, name in enumerate(TISSUES, 1)}
PARENCHYMA = ("kidney", "cortex", "medulla")
# Behind the fat in which the renal fascia is.
BEHIND_FASCIA = ("muscle", "liver", "spleen")
# A hollow of the kidney is where no ball of this radius fits in.
CONCAVITY_MM = 15.0
MARGIN_MM = MOST_MM + 4.0


@dataclass(frozen=True)
class TissueMap:
    """Tissue of each voxel (nx, ny, nz): ``codes`` of TISSUES from 1, uint8, on a grid that ``index_from_mm``
    (4, 4) gives.

    ``hu`` int16 is on the same grid. ``drawn`` is what no CT shows.
    """

    codes: np.ndarray
    hu: np.ndarray
    drawn: np.ndarray
    index_from_mm: np.ndarray

    def mask(self, *tissues: str) -> np.ndarray:
        """Whether a voxel is of one of some tissues."""
        return of_tissues(self.codes, *tissues)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """All that it has, in the order of its fields."""
        return self.codes, self.hu, self.drawn, self.index_from_mm


@dataclass(frozen=True)
class KidneyShape:
    """In a ``box`` of a grid: distances [mm] from the organ's surface, and from it with its hollows
    filled; negative inside.
    """

    box: Box
    distance_mm: np.ndarray
    outer_mm: np.ndarray

    @classmethod
    def of(cls, organ: trimesh.Trimesh, index_from_mm: np.ndarray, shape: tuple[int, ...]) -> "KidneyShape":
        """That of a surface [mm] on a grid."""
        grid = SurfaceGrid(organ, MARGIN_MM)
        box = surface_box(organ, index_from_mm, shape, MARGIN_MM)
        both = grid.distance, _outer_distance(grid.distance)
        return cls(box, *(grid.at_voxels(values, box, index_from_mm) for values in both))

    @property
    def inside(self) -> np.ndarray:
        """Whether a voxel of the box is in the organ."""
        return self.distance_mm < 0

    @property
    def hollow(self) -> np.ndarray:
        """Whether a voxel of the box is in a hollow of the organ."""
        return (self.outer_mm < 0) & (self.distance_mm >= 0)


def tissue_map(
    hu: np.ndarray,
    labels: np.ndarray,
    organ: trimesh.Trimesh,
    index_from_mm: np.ndarray,
    draws: bool = True,
) -> TissueMap:
    """The tissue of each voxel of a CT ``hu`` (nx, ny, nz) [HU] around a kidney.

    ``labels`` are codes of TISSUES on the same grid (``codes_of_labels``), 0 without; ``organ`` is a surface
    [mm]; ``index_from_mm`` (4, 4) is from patient coordinates, LPS. With ``draws`` also what no CT shows.
    """
    spacing = np.linalg.norm(np.linalg.inv(index_from_mm[:3, :3]), axis=0)
    factors = fine_factors(spacing)
    own = refined_labels(labels, factors, spacing)
    sharp, smooth = refined(hu, factors), refined(_median(hu, spacing), factors)
    to_index = fine_index_from_mm(index_from_mm, factors)
    shape = KidneyShape.of(organ, to_index, own.shape)
    both = _bones_and_arteries(hu, labels, index_from_mm)
    bone, artery = (refined(mask & (labels == 0), factors) > 0.5 for mask in both)
    box = shape.box
    dense = _dense(sharp[box], own[box], artery[box], shape, float(np.prod(spacing / factors)) / 1000)
    bone[box] &= ~agent_in_bone(bone[box], dense.urine)
    place = Place(to_index, np.asarray(organ.center_mass), dense.is_enhanced)
    codes = np.zeros(own.shape, np.uint8)
    inside = np.zeros(own.shape, bool)
    inside[box] = shape.inside
    _write(codes, surroundings(smooth, inside, bone & ~inside, box, place))
    # A clip is thinner than what a median leaves.
    _write(codes, {"vessel": artery & ~inside, "metal": (sharp > METAL_ABOVE_HU) & ~inside})
    drawn = np.zeros(own.shape, bool)
    kidney = shape.inside & np.isin(own[box], [0, CODE["kidney"]])
    _write(codes[box], kidney_parts(smooth[box], kidney, shape.hollow, -shape.outer_mm))
    pelvis = pelvis_without_agent(smooth[box], kidney, shape.inside, shape.outer_mm, place.spacing_mm)
    _write(codes[box], {"urine": dense.urine | (pelvis & ~of_tissues(codes[box], "bone"))})
    if draws:
        drawn[box] = _draw(codes[box], kidney, shape, place.spacing_mm)
        layers = draw_perimysium(of_tissues(codes, "muscle"), place.spacing_mm)
        codes[layers] = CODE["perimysium"]
        drawn |= layers
    _write_labels(codes, own, sharp, place.spacing_mm)
    _write(codes[box], {"stone": dense.stone})
    drawn[box] &= ~dense.stone
    drawn &= (own == 0) | (own == CODE["kidney"])
    return TissueMap(codes, np.rint(sharp).astype(np.int16), drawn, to_index)


def dense_pieces_of_kidney(
    hu: np.ndarray, labels: np.ndarray, organ: trimesh.Trimesh, index_from_mm: np.ndarray
) -> tuple[DensePieces, np.ndarray]:
    """The dense pieces that ``tissue_map`` finds in the same CT, and the transform (4, 4) from mm to their
    indices.
    """
    spacing = np.linalg.norm(np.linalg.inv(index_from_mm[:3, :3]), axis=0)
    factors = fine_factors(spacing)
    own = refined_labels(labels, factors, spacing)
    to_index = fine_index_from_mm(index_from_mm, factors)
    shape = KidneyShape.of(organ, to_index, own.shape)
    box = shape.box
    _, artery = _bones_and_arteries(hu, labels, index_from_mm)
    artery = refined(artery, factors) > 0.5
    pieces = _dense(
        refined(hu, factors)[box], own[box], artery[box], shape, float(np.prod(spacing / factors)) / 1000
    )
    # Stones, and other labels than the whole kidney's, are written over contrast agent.
    shown = replace(pieces, urine=pieces.urine & ~pieces.stone & np.isin(own[box], [0, CODE["kidney"]]))
    to_index[:3, 3] -= [a.start for a in box]
    return shown, to_index


def codes_of_labels(labels: np.ndarray, tissues: Mapping[int, str]) -> np.ndarray:
    """Labels as codes of TISSUES, uint8, 0 where a label has no tissue."""
    table = np.zeros(max(int(labels.max()), *tissues, 0) + 1, np.uint8)
    for value, tissue in tissues.items():
        table[value] = CODE[tissue]
    return table[labels.astype(np.intp)]


def of_tissues(codes: np.ndarray, *tissues: str) -> np.ndarray:
    """Whether codes are of one of some tissues."""
    return np.isin(codes, [CODE[name] for name in tissues])


def _median(hu: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """The median of each voxel and its neighbours: noise goes, edges stay.

    Thick slices are not mixed.
    """
    radius = [0 if mm > 2 * spacing_mm.min() else 1 for mm in spacing_mm]
    image = sitk.GetImageFromArray(np.rint(hu).astype(np.int16, order="C"))
    return sitk.GetArrayFromImage(sitk.Median(image, radius[::-1]))


def _outer_distance(distance_mm: np.ndarray) -> np.ndarray:
    """Distances [mm] from a surface whose hollows are filled, on the grid of a SurfaceGrid: closing by a
    ball.
    """
    near = distance_mm <= CONCAVITY_MM
    # From the middles of points: half of their distance is not known.
    inside = ndimage.distance_transform_edt(near, sampling=SURFACE_MM) - SURFACE_MM / 2
    return np.minimum(distance_mm, np.where(near, CONCAVITY_MM - inside, FAR_MM)).astype(np.float32)


def _bones_and_arteries(
    hu: np.ndarray, labels: np.ndarray, index_from_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Masks of bones, and of the aorta with its branches where these are as bright: in the arterial phase."""
    mm_from_index = np.linalg.inv(index_from_mm)
    spacing = np.linalg.norm(mm_from_index[:3, :3], axis=0)
    bone = bones(hu, spacing)
    spine = spine_middle(bone)
    if spine is None:
        return bone, np.zeros(hu.shape, bool)
    aorta = arterial_aorta(hu, mm_from_index, mm_from_index[:3, :3] @ spine + mm_from_index[:3, 3])
    if not aorta.any():
        return bone, aorta
    bone = bones(np.where(aorta, 0, hu), spacing)
    return bone, with_branches(hu, aorta, bone | (labels > 0))


def _dense(
    hu: np.ndarray, own: np.ndarray, artery: np.ndarray, shape: KidneyShape, voxel_ml: float
) -> DensePieces:
    """The dense pieces in what is not labelled, or labelled as parenchyma or sinus, and no artery."""
    unlabelled = ((own == 0) & ~artery) | of_tissues(own, *PARENCHYMA, "sinus")
    parenchyma = shape.inside & ((own == 0) | of_tissues(own, *PARENCHYMA))
    hidden = np.where(unlabelled, hu, -FAR_MM)
    # Beside labelled contrast agent, voxels are as bright by partial volume.
    beside = ndimage.maximum_filter(own == CODE["urine"], 3)
    pieces = dense_pieces(hidden, parenchyma, shape.inside | shape.hollow, voxel_ml)
    return DensePieces(pieces.urine, pieces.stone & ~(beside & pieces.is_enhanced), pieces.is_enhanced)


def _draw(codes: np.ndarray, kidney: np.ndarray, shape: KidneyShape, spacing_mm: np.ndarray) -> np.ndarray:
    """Draw pyramids in parenchyma of which the CT shows none, and the renal fascia; return where."""
    rest = of_tissues(codes, "kidney") & kidney
    goal = of_tissues(codes, "sinus", "urine") & (shape.outer_mm < 0)
    pyramids = draw_pyramids(rest, goal, -shape.outer_mm, spacing_mm)
    codes[rest], codes[pyramids] = CODE["cortex"], CODE["medulla"]
    fat = of_tissues(codes, "fat") & (shape.outer_mm > 0)
    fascia = draw_fascia(fat, of_tissues(codes, *BEHIND_FASCIA), shape.distance_mm, spacing_mm)
    codes[fascia] = CODE["fascia"]
    return rest | fascia


def _write(codes: np.ndarray, masks: Mapping[str, np.ndarray]) -> None:
    for name, where in masks.items():
        codes[where] = CODE[name]


def _write_labels(codes: np.ndarray, own: np.ndarray, hu: np.ndarray, spacing_mm: np.ndarray) -> None:
    """Write labels over what was classified, but for those of a whole kidney; and the parts of tumours."""
    labelled = (own > 0) & (own != CODE["kidney"])
    codes[labelled] = own[labelled]
    tumour = own == CODE["tumour"]
    if tumour.any():
        box = box_around(tumour, 1)
        _write(codes[box], lesion_parts(hu[box], tumour[box], spacing_mm))


def tissue_arrays(
    hu: np.ndarray, labels: np.ndarray, organ: trimesh.Trimesh, index_from_mm: np.ndarray, draws: int
) -> tuple[np.ndarray, ...]:
    """The arrays of ``tissue_map``, for a cache."""
    return tissue_map(hu, labels, organ, index_from_mm, bool(draws)).arrays
