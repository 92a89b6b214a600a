"""Draft segmentation of a kidney without labels: region growing from a seed, for the user to check.

No threshold separates every kidney from its neighbours, so several HU bands are tried, each with openings of
several radii. The region most like a kidney is returned: convex, with an edge in HU along its surface. The
bands are tried a second time around the HU of that region, so that the HU at the seed matter less. If no
region is plausible, the seed is refused with the reason.
"""

from collections.abc import Iterator

import numpy as np
import SimpleITK as sitk
from scipy import ndimage

from errors import PatientError
from scenes.patients.kidney_regions import FAT_HU, LEAST_EDGE, LEAST_SOLIDITY, Region
from scenes.patients.patient_directions import components
from scenes.patients.readers.label_maps import LabelMap, Segment, box_of
from scenes.volumes.lazy_volume import LazyVolume
from scenes.volumes.voxel_grid import VoxelGrid

DRAFT = Segment("kidney (draft, region growing)", None, "kidney", None)
REACH_MM = 110.0  # around the seed: a kidney is 9 to 13 cm long and the seed may be at its pole
WORKING_MM = 2.0
VOXEL_ML = WORKING_MM**3 / 1000.0
PARENCHYMA_HU = (-10.0, 350.0)  # from unenhanced and noisy to pyramids in the excretory phase
AIR_BELOW_HU = -200.0
# Lower threshold of a region, between fat and seed: low where fat surrounds it, high where muscle, liver or
# spleen touches.
LOW_SHARES = (0.45, 0.55, 0.65, 0.75, 0.85, 0.92)
SAME_LEVEL = 0.05  # half a step of these shares
ABOVE_SEED_HU = 150.0  # from a seed in the medulla to the cortex
UNENHANCED_HU = 90.0  # below it the neighbours are brighter
NARROW_LOW_SHARES, NARROW_ABOVE_HU = (0.55, 0.75), (15.0, 25.0, 40.0)
OPENINGS, CLOSING = (2, 3, 4, 6), 2  # radii in voxels of WORKING_MM
SEED_BALL_MM, OFF_SEED_MM = 4.5, 6.0
VOLUME_ML = (40.0, 450.0)
ONE_SIDE_MM = 15.0  # what touches a region has its middle farther out, unless it is all around
BORDER = f"the border of the CT, or {REACH_MM:g} mm from the seed"
ELSEWHERE = "if the seed is in a kidney, give a point farther from there, or draw labels"


def draft_segmentation(ct: LazyVolume, seed_mm: np.ndarray) -> LabelMap:
    """The kidney around a seed, on the CT's grid; deterministic.

    It uses tissue and shape, not anatomy: from a seed in another compact organ surrounded by fat, it returns
    that organ. ``ct`` is a scalar volume [HU], read within REACH_MM of the seed; ``seed_mm`` (3,) is a point
    in the parenchyma, LPS. Raises PatientError where the seed is not in kidney tissue, or no region around it
    is like a kidney.
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
    """The best region (z, y, x). Raises PatientError where it is not like a kidney."""
    hounsfield = sitk.GetArrayFromImage(tissue)
    start = _start(tissue, hounsfield, seed)
    away = _distance(hounsfield, start)
    level = _level(hounsfield, away)
    masks, regions = _grown(tissue, hounsfield, away, level)
    if regions:
        first = max(regions, key=lambda region: region.rank)
        # A seed near the surface, in a pyramid or in noise has not the HU of the organ.
        organ = float(np.median(hounsfield[first.inside]))
        if abs(organ - level) > SAME_LEVEL * (level - FAT_HU):
            _, again = _grown(tissue, hounsfield, _distance(hounsfield, first.deepest()), organ)
            regions += [region for region in again if away[region.inside].min() <= OFF_SEED_MM]
    best = max(regions, key=lambda region: region.rank, default=None)
    if best is None or not (best.is_kidney and best.is_whole):
        raise _refusal(seed, *_why_none(VoxelGrid.of(tissue), hounsfield, start, masks, regions))
    return best.inside


def _start(tissue: sitk.Image, hounsfield: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """The voxel (x, y, z) near the seed with the most soft tissue around it. Raises PatientError where the
    seed is in none.

    In thick voxels, the cortex near the surface has the HU of the fat beside it.
    """
    index = np.rint(VoxelGrid.of(tissue).index(seed[None])[0]).astype(int)
    at = np.clip(index, 0, np.array(tissue.GetSize()) - 1)
    away = _distance(hounsfield, at)
    least, most = PARENCHYMA_HU
    soft = ((hounsfield >= least) & (hounsfield <= most)).astype(np.float32)
    # Of equal ones the nearest: no distance outweighs one voxel of the 27.
    share = np.where(away <= OFF_SEED_MM, ndimage.uniform_filter(soft, 3) - away / 1000, -1.0)
    start = np.array(np.unravel_index(np.argmax(share), share.shape))[::-1]
    level, here = _level(hounsfield, _distance(hounsfield, start)), float(hounsfield[tuple(at[::-1])])
    # Less than half of the seed's own voxel is the tissue beside it.
    is_beside = here > most or here < 0.5 * (FAT_HU + level)
    _check_parenchyma(here if is_beside else level, seed)
    return start


def _level(hounsfield: np.ndarray, away: np.ndarray) -> float:
    return float(np.median(hounsfield[away <= SEED_BALL_MM]))


def _distance(voxels: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Distance [mm] from a voxel (x, y, z) to all (z, y, x)."""
    z, y, x = ((np.arange(n) - at) ** 2 for n, at in zip(voxels.shape, start[::-1], strict=True))
    return WORKING_MM * np.sqrt(z[:, None, None] + y[:, None] + x)


def _check_parenchyma(level: float, seed: np.ndarray) -> None:
    least, most = PARENCHYMA_HU
    if not least <= level <= most:
        tissue = ("air", "fat", "bone, stone or contrast agent")[(level >= AIR_BELOW_HU) + (level > most)]
        reason = f"it is in {tissue}, {level:.0f} HU, where a kidney has {least:g} to {most:g}"
        raise _refusal(seed, reason, "give a point in the parenchyma")


def _bands(level: float) -> list[tuple[float, float]]:
    """Lowest and highest HU of the regions to try, by the HU around the seed."""
    shares = [(share, ABOVE_SEED_HU) for share in LOW_SHARES]
    if level < UNENHANCED_HU:
        shares += [(share, above) for share in NARROW_LOW_SHARES for above in NARROW_ABOVE_HU]
    return [(FAT_HU + share * (level - FAT_HU), level + above) for share, above in shares]


def _grown(
    tissue: sitk.Image, hounsfield: np.ndarray, away: np.ndarray, level: float
) -> tuple[list[np.ndarray], list[Region]]:
    """All regions (z, y, x) around a start, and those with the volume of a kidney."""
    masks = [inside for low, high in _bands(level) for inside in _opened_regions(tissue, away, low, high)]
    least, most = VOLUME_ML
    return masks, [Region.of(inside, hounsfield) for inside in masks if least <= _ml(inside) <= most]


def _opened_regions(tissue: sitk.Image, away: np.ndarray, low: float, high: float) -> Iterator[np.ndarray]:
    """Regions (z, y, x) of a band of HU connected to the seed, separated at thin bridges; ``away`` is the
    distance to it [mm].

    sitk.ConnectedThreshold, erosion by sitk.SignedMaurerDistanceMap, then sitk.BinaryDilate of the core at
    the seed only; a plain opening would restore the neighbours' cores, too.
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
    """A core dilated within its body, with concavities (the sinus) closed and holes (calyces, stones)
    filled.
    """
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


def _why_none(
    grid: VoxelGrid, hounsfield: np.ndarray, start: np.ndarray, masks: list[np.ndarray], regions: list[Region]
) -> tuple[str, str]:
    """What was found instead of a kidney, and what to do."""
    if any(region.is_kidney for region in regions):
        advice = "give a point in the kidney, or choose a CT that shows all of it"
        return f"the region is cut off at {BORDER}", advice
    whole = [region for region in regions if region.is_whole]
    if whole:
        return _why_unlike(grid, max(whole, key=lambda region: region.rank)), ELSEWHERE
    large = [inside for inside in masks if _ml(inside) >= VOLUME_ML[0]]
    if large:
        return _where_it_leaks(grid, hounsfield, start, min(large, key=_ml)), ELSEWHERE
    most = max(map(_ml, masks), default=0.0)
    advice = "give a point in the parenchyma, not in a cyst, tumour or vessel, or draw labels"
    return f"the region has only {most:.0f} ml, where a kidney has at least {VOLUME_ML[0]:g}", advice


def _why_unlike(grid: VoxelGrid, region: Region) -> str:
    shape = f"the region of {_ml(region.inside):.0f} ml "
    if region.edge >= LEAST_EDGE:
        return (
            f"{shape}fills {region.solidity:.0%} of its convex hull, where a kidney fills at least "
            f"{LEAST_SOLIDITY:.0%}; it may be "
            "two organs"
        )
    return (
        f"{shape}has an edge on {region.edge:.0%} of its surface, where a kidney has at least "
        f"{LEAST_EDGE:.0%}; "
        f"{_towards(grid, region.open_side)}, tissue of like HU touches it"
    )


def _where_it_leaks(grid: VoxelGrid, hounsfield: np.ndarray, start: np.ndarray, leak: np.ndarray) -> str:
    away = np.argwhere(leak).mean(axis=0)[::-1] - start
    to = f"{_ml(leak):.0f} ml" if _ml(leak) > VOLUME_ML[1] else BORDER
    return (
        f"the region goes on {_towards(grid, away)} into tissue of {np.median(hounsfield[leak]):.0f} HU, "
        f"to {to}, where a kidney has "
        f"at most {VOLUME_ML[1]:g} ml"
    )


def _towards(grid: VoxelGrid, steps: np.ndarray) -> str:
    if np.linalg.norm(steps) * WORKING_MM < ONE_SIDE_MM:
        return "all around"
    return " and ".join(words for _, words in components(grid.direction @ steps))


def _refusal(seed: np.ndarray, reason: str, advice: str = ELSEWHERE) -> PatientError:
    return PatientError(f"no kidney at the seed {','.join(f'{x:g}' for x in seed)} mm: {reason}; {advice}")
