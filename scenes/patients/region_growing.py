"""Draft segmentation of a kidney without labels: region growing from a seed, for the user to check.

No threshold separates every kidney from its neighbours, so several HU bands are tried, each with openings of several
radii. The region most like a kidney is returned: convex, with an edge in HU along its surface. If none is plausible, the
seed is refused with the reason.
"""

from collections.abc import Iterator

import numpy as np
import SimpleITK as sitk
from scipy import ndimage
from scipy.spatial import ConvexHull

from errors import PatientError
from scenes.patients.readers.label_maps import LabelMap, Segment, box_of
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import VoxelGrid

DRAFT = Segment("kidney (draft, region growing)", None, "kidney", None)
REACH_MM = 110.0  # around the seed: a kidney is 9 to 13 cm long and the seed may be at its pole
WORKING_MM = 2.0
VOXEL_ML = WORKING_MM**3 / 1000.0
PARENCHYMA_HU = (-10.0, 350.0)  # from unenhanced and noisy to pyramids in the excretory phase
AIR_BELOW_HU, FAT_HU = -200.0, -100.0
# Lower threshold of a region, between fat and seed: low where fat surrounds it, high where muscle, liver or spleen touches.
LOW_SHARES = (0.45, 0.55, 0.65, 0.75, 0.85, 0.92)
ABOVE_SEED_HU = 150.0  # from a seed in the medulla to the cortex
UNENHANCED_HU = 90.0  # below it the neighbours are brighter
NARROW_LOW_SHARES, NARROW_ABOVE_HU = (0.55, 0.75), (15.0, 25.0, 40.0)
OPENINGS, CLOSING = (2, 3, 4, 6), 2  # radii in voxels of WORKING_MM
SEED_BALL_MM, OFF_SEED_MM = 4.5, 6.0
VOLUME_ML = (40.0, 450.0)
# A surface point is on an edge where the HU 2 to 4 mm outside differ by this share of the region's contrast to fat.
EDGE_SHARE = 0.25
# The kidneys of the development data are above both; spleen and kidney in one region are below the second.
LEAST_EDGE, LEAST_SOLIDITY = 0.75, 0.65
ELSEWHERE = "give a point deeper in the parenchyma, or draw labels"


def draft_segmentation(ct: LazyVolume, seed_mm: np.ndarray) -> LabelMap:
    """The kidney around a seed, on the CT's grid; deterministic.

    It uses tissue and shape, not anatomy: from a seed in another compact organ surrounded by fat, it returns that organ.

    Args:
        ct: scalar volume [HU]; read within REACH_MM of the seed.
        seed_mm: a point in the parenchyma, LPS [mm], shape (3,).

    Raises:
        PatientError: the seed is not in kidney tissue, or no region around it is like a kidney.
    """
    seed = np.asarray(seed_mm, float)
    _check_in(ct.grid, seed)
    box = ct.grid.box_around(seed - REACH_MM, seed + REACH_MM)
    image = ct.grid.part(box).image(ct.hounsfield(box))
    tissue = _working(image)
    share = VoxelGrid.of(tissue).image(_most_like_a_kidney(tissue, seed).astype(np.float32))
    # Linear: nearest neighbour would leave steps of WORKING_MM.
    on_ct = sitk.GetArrayFromImage(sitk.Resample(share, image, sitk.Transform(), sitk.sitkLinear)) >= 0.5
    return LabelMap.single(ct.grid.part(box), on_ct, DRAFT)


def _check_in(grid: VoxelGrid, seed: np.ndarray) -> None:
    index = grid.index(seed[None])[0]
    if not ((index >= -0.5) & (index <= np.array(grid.size) - 0.5)).all():
        spans = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in zip(*grid.bounds(), strict=True))
        advice = "give x,y,z in LPS mm (in RAS x and y have the other sign)"
        raise _refusal(seed, f"it is outside the CT, which spans {spans}", advice)


def _working(image: sitk.Image) -> sitk.Image:
    """HU as float32 on a grid of WORKING_MM along the CT's own axes, smoothed.

    sitk.BinShrink averages fine voxels; sitk.CurvatureFlow (Sethian 1996) removes noise and keeps edges.
    """
    # Metal and air would dominate partial volumes.
    image = sitk.Clamp(image, sitk.sitkInt16, -250, 600)
    lattice = zip(image.GetSize(), image.GetSpacing(), strict=True)
    image = sitk.BinShrink(image, [min(n, max(1, int(WORKING_MM / mm))) for n, mm in lattice])
    size = (np.array(image.GetSize()) - 1) * image.GetSpacing() // WORKING_MM + 1
    place = image.GetOrigin(), [WORKING_MM] * 3, image.GetDirection()
    image = sitk.Cast(image, sitk.sitkFloat32)
    image = sitk.Resample(image, size.astype(int).tolist(), sitk.Transform(), sitk.sitkLinear, *place)
    return sitk.CurvatureFlow(image, timeStep=0.0625, numberOfIterations=8)


def _most_like_a_kidney(tissue: sitk.Image, seed: np.ndarray) -> np.ndarray:
    """The best region (z, y, x). Raises PatientError where it is not plausible."""
    hounsfield = sitk.GetArrayFromImage(tissue)
    index = np.rint(VoxelGrid.of(tissue).index(seed[None])[0]).astype(int)
    start = np.clip(index, 0, np.array(tissue.GetSize()) - 1)
    away = _distance(hounsfield, start)
    level = float(np.median(hounsfield[away <= SEED_BALL_MM]))
    _check_parenchyma(level, seed)
    found = [one for low, high in _bands(level) for one in _opened_regions(tissue, away, low, high)]
    shapes = [(*_shape(inside, hounsfield), inside) for inside in found if _is_plausible(inside)]
    if not shapes:
        raise _refusal(seed, _why_none(found))
    edge, solidity, best = max(shapes, key=lambda shape: shape[0] * shape[1] ** 0.5)
    if edge < LEAST_EDGE or solidity < LEAST_SOLIDITY:
        raise _refusal(
            seed,
            f"the region of {_ml(best):.0f} ml fills {solidity:.0%} of its convex hull and has an edge on "
            f"{edge:.0%} of its surface, where a kidney has at least {LEAST_SOLIDITY:.0%} and {LEAST_EDGE:.0%}",
        )
    return best


def _distance(voxels: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Distance [mm] from a voxel (x, y, z) to all (z, y, x)."""
    z, y, x = ((np.arange(n) - at) ** 2 for n, at in zip(voxels.shape, start[::-1], strict=True))
    return WORKING_MM * np.sqrt(z[:, None, None] + y[:, None] + x)


def _check_parenchyma(level: float, seed: np.ndarray) -> None:
    least, most = PARENCHYMA_HU
    if not least <= level <= most:
        tissue = ("air", "fat", "bone, stone or contrast agent")[(level >= AIR_BELOW_HU) + (level > most)]
        found = f"it is in {tissue}, {level:.0f} HU, where a kidney has {least:g} to {most:g}"
        raise _refusal(seed, found, "give a point in the parenchyma")


def _bands(level: float) -> list[tuple[float, float]]:
    """Lowest and highest HU of the regions to try, by the HU around the seed."""
    shares = [(share, ABOVE_SEED_HU) for share in LOW_SHARES]
    if level < UNENHANCED_HU:
        shares += [(share, above) for share in NARROW_LOW_SHARES for above in NARROW_ABOVE_HU]
    return [(FAT_HU + share * (level - FAT_HU), level + above) for share, above in shares]


def _opened_regions(tissue: sitk.Image, away: np.ndarray, low: float, high: float) -> Iterator[np.ndarray]:
    """Regions (z, y, x) of a band of HU connected to the seed, separated at thin bridges; ``away`` is the distance to it [mm].

    sitk.ConnectedThreshold, erosion by sitk.SignedMaurerDistanceMap, then sitk.BinaryDilate of the core at the seed only; a
    plain opening would restore the neighbours' cores, too.
    """
    body = _connected(tissue, away, low, high, OFF_SEED_MM)
    depth = sitk.SignedMaurerDistanceMap(body, insideIsPositive=True, squaredDistance=False)
    for radius in OPENINGS:
        core = _connected(depth, away, radius - 0.9, 1e4, (radius + 1) * WORKING_MM)
        if sitk.GetArrayViewFromImage(core).any():
            yield _reconstructed(sitk.GetArrayViewFromImage(core), sitk.GetArrayViewFromImage(body), radius)


def _connected(image: sitk.Image, away: np.ndarray, low: float, high: float, off_mm: float) -> sitk.Image:
    """Voxels in a range, connected to the one of them closest to the seed; empty where that is too far."""
    voxels = sitk.GetArrayViewFromImage(image)
    distance = np.where((voxels >= low) & (voxels <= high), away, np.inf)
    z, y, x = (int(n) for n in np.unravel_index(np.argmin(distance), distance.shape))
    return sitk.ConnectedThreshold(image, [[x, y, z]] if distance[z, y, x] <= off_mm else [], low, high)


def _reconstructed(core: np.ndarray, body: np.ndarray, radius: int) -> np.ndarray:
    """A core dilated within its body, with concavities (the sinus) closed and holes (calyces, stones) filled."""
    if _ml(core) > VOLUME_ML[1]:
        return core > 0
    rim = radius + 2 * CLOSING + 1
    voxels = np.pad(core, rim)
    part = tuple(slice(a.start - rim, a.stop + rim) for a in box_of(voxels)[::-1])
    dilated = sitk.BinaryDilate(sitk.GetImageFromArray(voxels[part]), [radius] * 3)
    region = dilated & sitk.GetImageFromArray(np.pad(body, rim)[part])
    if _ml(sitk.GetArrayViewFromImage(region)) <= VOLUME_ML[1]:  # larger ones have leaked
        region = sitk.BinaryFillhole(sitk.BinaryMorphologicalClosing(region, [CLOSING] * 3))
    voxels[part] = sitk.GetArrayViewFromImage(region)
    return voxels[(slice(rim, -rim),) * 3] > 0


def _ml(inside: np.ndarray) -> float:
    return np.count_nonzero(inside) * VOXEL_ML


def _is_plausible(inside: np.ndarray) -> bool:
    """Whether a region has a kidney's volume and does not touch the border."""
    cut = any(inside.take(end, axis).any() for axis in range(3) for end in (0, -1))
    return not cut and VOLUME_ML[0] <= _ml(inside) <= VOLUME_ML[1]


def _shape(inside: np.ndarray, hounsfield: np.ndarray) -> tuple[float, float]:
    """Share of a region's surface on an edge, and share of its convex hull that it fills (solidity)."""
    near = ndimage.binary_dilation(inside)
    around = hounsfield[ndimage.binary_dilation(near) & ~near]
    middle = float(np.median(hounsfield[inside]))
    edge = np.abs(around - middle) > EDGE_SHARE * (middle - FAT_HU)
    hull = ConvexHull(np.argwhere(inside & ~ndimage.binary_erosion(inside)))
    # The hull of the voxel centres is half a voxel inside that of the voxels.
    return float(edge.mean()), float(np.count_nonzero(inside) / (hull.volume + 0.5 * hull.area))


def _why_none(found: list[np.ndarray]) -> str:
    largest = max((_ml(inside) for inside in found), default=0.0)
    if largest < VOLUME_ML[0]:
        return f"the region has only {largest:.0f} ml, where a kidney has at least {VOLUME_ML[0]:g}"
    return f"the region leaks beyond {VOLUME_ML[1]:g} ml or to the CT's border"


def _refusal(seed: np.ndarray, found: str, advice: str = ELSEWHERE) -> PatientError:
    return PatientError(f"no kidney at the seed {','.join(f'{x:g}' for x in seed)} mm: {found}; {advice}")
