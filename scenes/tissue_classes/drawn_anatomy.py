"""What a CT does not show, drawn as atlases of anatomy have it: renal pyramids, the renal fascia, and the
layers of muscle.
"""

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from scenes.tissue_classes.fine_grid import cell_voxels, coarse_distance, refined

# Cortex over the pyramids, and the distance of the middles of their bases: 7 to 10 mm, and 7 to 18 pyramids
# in a kidney (Hansen, Nielsen &
# Ewertsen 2016, Diagnostics 6, 2).
CORTEX_MM, APART_MM = 6.0, 21.0
# Columns of cortex between pyramids, and the share of its base's radius that a pyramid has at its papilla.
COLUMN_MM, PAPILLA_SHARE = 2.5, 0.4
# A pyramid is at least so high.
LEAST_HEIGHT_MM = 4.0
# The fascia: in fat, so far from what is behind it, at least so far from the kidney and no farther than the
# third value.
BEFORE_MM, LEAST_MM, MOST_MM, OPENED_VOXELS = 3.0, 4.0, 20.0, 3
# Sheets of perimysium in muscle: distance, and where they are, as a threshold of noise of unit SD smoothed
# over this distance.
SHEETS_MM, SHEETS_ABOVE, SHEETS_OVER_MM, SEED = 4.0, -0.2, 4.0, 20151124


def draw_pyramids(
    parenchyma: np.ndarray, sinus: np.ndarray, depth_mm: np.ndarray, spacing_mm: np.ndarray
) -> np.ndarray:
    """Pyramids (nx, ny, nz) in parenchyma: cones with their bases CORTEX_MM below the surface, their papillae
    at the sinus.

    ``depth_mm`` is below the kidney's outer surface. Without a sinus, the papillae are at the deepest place.
    """
    pyramids = np.zeros(parenchyma.shape, bool)
    inner = parenchyma & (depth_mm > CORTEX_MM)
    shell = np.argwhere(inner & (depth_mm < CORTEX_MM + 1.5)) * spacing_mm
    if len(shell) == 0:
        return pyramids
    goal = sinus if sinus.any() else inner & (depth_mm > 0.9 * depth_mm[inner].max())
    papillae = cKDTree(np.argwhere(goal) * spacing_mm)
    at = np.argwhere(inner)
    place = at * spacing_mm
    bases = shell[_spread(shell)]
    _, nearest = papillae.query(bases)
    tips = papillae.data[nearest]
    relative = np.full(len(at), np.inf)
    for base, tip in zip(bases, tips, strict=True):
        axis = tip - base
        height = np.linalg.norm(axis)
        if height < LEAST_HEIGHT_MM:
            continue
        along = (place - base) @ (axis / height)
        away = np.linalg.norm(place - base - along[:, None] * (axis / height), axis=1)
        share = np.clip(along / height, 0.0, 1.0)
        radius = (APART_MM - COLUMN_MM) / 2 * (1 - (1 - PAPILLA_SHARE) * share)
        relative = np.minimum(relative, np.where(along < height - 1.0, away / radius, np.inf))
    pyramids[tuple(at[relative < 1.0].T)] = True
    return pyramids


def _spread(points: np.ndarray) -> list[int]:
    """Indices of points (n, 3) [mm] that are APART_MM from each other, each the farthest from those
    before.
    """
    chosen = [int(np.argmax(points @ [0.0, 0.0, 1.0]))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while distance.max() > APART_MM:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def draw_fascia(
    fat: np.ndarray, others: np.ndarray, from_kidney_mm: np.ndarray, spacing_mm: np.ndarray
) -> np.ndarray:
    """The renal fascia (nx, ny, nz): a sheet in the perirenal fat, one voxel thick, before what is behind the
    fat.
    """
    # Islands are nothing that fat has its fascia before.
    behind = ndimage.binary_opening(others, iterations=OPENED_VOXELS)
    sheet = np.abs(coarse_distance(~behind, spacing_mm) - BEFORE_MM) <= 0.5 * float(spacing_mm.max())
    return fat & sheet & (from_kidney_mm > LEAST_MM) & (from_kidney_mm < MOST_MM)


def draw_perimysium(muscle: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """Broken sheets (nx, ny, nz) of connective tissue in muscle, one voxel thick, parallel to its surface."""
    # Noise of one value a cell, between which it is interpolated.
    step = cell_voxels(spacing_mm)
    cells = -(-np.array(muscle.shape) // step)
    noise = np.random.default_rng(SEED).standard_normal(cells, dtype=np.float32)
    noise = ndimage.gaussian_filter(noise, SHEETS_OVER_MM / 2 / (spacing_mm * step))
    there = refined(noise / max(float(noise.std()), 1e-6), step)[tuple(slice(n) for n in muscle.shape)]
    sheets = muscle & (there > SHEETS_ABOVE)
    along = coarse_distance(muscle, spacing_mm)[sheets] % SHEETS_MM
    sheets[sheets] = np.abs(along - SHEETS_MM / 2) <= 0.5 * float(spacing_mm.mean())
    return sheets
