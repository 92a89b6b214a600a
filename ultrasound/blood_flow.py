"""Blood flow at the CT's voxels: in labelled vessels by their kind and width, and in small vessels of the
parenchyma. NumPy.

``blood_flow.toml`` is the table. A vessel has a parabolic profile. Its direction is that of a potential flow
from, or to, its end far from the kidney.
"""

import json
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
from pyamg.classical import ruge_stuben_solver
from scipy import ndimage, sparse

from sim.stored_arrays import stored
from ultrasound.acoustics import KIDNEY, TissueVoxels, noise_of

TABLE = Path(__file__).parent / "blood_flow.toml"
# At each voxel: peak systolic velocity along the grid's axes [m/s], resistive index, and amplitude against
# blood in a vessel.
CHANNELS = 5
KNOWN_KINDS = ("vein", "artery")
KINDS = ("vessel", *KNOWN_KINDS)
WITH_SMALL_VESSELS = ("kidney", "cortex", "medulla", "tumour")
# Enhanced vessels without a label are of the kind of a labelled one up to this distance. Smaller bodies than
# this are noise.
SAME_KIND_MM, LEAST_VOXELS = 25.0, 20
# The potential in a vessel, and the depth below the capsule, are smoothed before they are differentiated
# [voxels].
POTENTIAL_SD, CAPSULE_SD = 1.0, 3.0
# Half width [voxels] of the neighbourhood whose greatest distance from the wall is a vessel's radius: wider
# ones have plug flow.
WIDEST = 3
# The end of a vessel is all that is so near to its furthest voxel.
END_MM = 1.5
# Noise of unit SD above this has small vessels: a quarter of the parenchyma.
SPARSE = 0.7
# One heartbeat [s], the time to its peak, and the time constant of the fall after it.
BEAT_S, SYSTOLE_S, FALL_S = 60 / 70, 0.09, 0.22


@cache
def flow_table() -> dict[str, dict]:
    """The values by kind of vessel, as in the file."""
    return tomllib.loads(TABLE.read_text("utf-8"))


def pulse_share(time_s: float) -> float:
    """How much of its pulsatile part the velocity has at a time: 0 at the end of diastole, 1 at the peak of
    systole.
    """
    phase = time_s % BEAT_S
    if phase < SYSTOLE_S:
        return float(np.sin(np.pi / 2 * phase / SYSTOLE_S) ** 2)
    end = np.exp(-(BEAT_S - SYSTOLE_S) / FALL_S)
    return float((np.exp(-(phase - SYSTOLE_S) / FALL_S) - end) / (1 - end))


def stored_flow(voxels: TissueVoxels) -> tuple[np.ndarray, np.ndarray]:
    """As ``blood_flow`` in float16, but computed only once from the same voxels."""
    texts = json.dumps(dict(voxels.tissues)), TABLE.read_text("utf-8")
    low, values = stored(_flow_of_texts, voxels.labels, *texts, voxels.spacing_mm)
    return low, values


def _flow_of_texts(
    labels: np.ndarray | None, tissues: str, table: str, spacing_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    tissue_of_label = {int(label): tissue for label, tissue in json.loads(tissues).items()}
    low, values = blood_flow(
        np.zeros((1, 1, 1), np.uint8) if labels is None else labels, tissue_of_label, spacing_mm
    )
    return low, values.astype(np.float16)


def blood_flow(
    labels: np.ndarray, tissue_of_label: Mapping[int, str], spacing_mm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The index (3,) of the first voxel of a box that contains all flow, and the flow in it (nx, ny, nz,
    CHANNELS) float32.

    The kind of a vessel is its label's, or that of a labelled one nearby. The box has at least one voxel.
    """
    masks = {
        name: np.isin(labels, [v for v, tissue in tissue_of_label.items() if tissue == name])
        for name in (*KINDS, *KIDNEY, "tumour")
    }
    _add_of_same_kind(masks, spacing_mm)
    kidney = np.logical_or.reduce([masks[name] for name in (*KIDNEY, "tumour")])
    flowing = np.logical_or.reduce([masks[name] for name in (*KINDS, *WITH_SMALL_VESSELS)])
    box = _box(flowing)
    part = {name: mask[box] for name, mask in masks.items()}
    values = np.zeros((*part["artery"].shape, CHANNELS), np.float32)
    for tissue in WITH_SMALL_VESSELS:
        if part[tissue].any():
            _add_small_vessels(values, flow_table()["small"][tissue], part[tissue], kidney[box], spacing_mm)
    # Vessels within the kidney have their ends away from its surface: it is not counted.
    inner = ndimage.binary_erosion(kidney[box])
    away = _distance_from(inner, spacing_mm)
    for kind in KINDS:
        if part[kind].any():
            own = _box(part[kind])
            _add_vessels(values[own], flow_table()[kind], part[kind][own], away[own], spacing_mm)
    return np.array([axis.start for axis in box]), values


def _box(mask: np.ndarray) -> tuple[slice, ...]:
    """The box around a mask, one voxel wider; one voxel of an empty one."""
    boxes = ndimage.find_objects(mask.astype(np.uint8))
    box = boxes[0] if boxes else (slice(0, 1),) * 3
    return tuple(slice(max(a.start - 1, 0), min(a.stop + 1, n)) for a, n in zip(box, mask.shape, strict=True))


def _add_of_same_kind(masks: dict[str, np.ndarray], spacing_mm: np.ndarray) -> None:
    """Change vessels of unknown kind near one of a known kind to that kind."""
    unknown = masks["vessel"]
    kinds = np.zeros(unknown.shape, np.uint8)
    for code, kind in enumerate(KNOWN_KINDS, start=1):
        kinds[masks[kind]] = code
    if not (kinds.any() and unknown.any()):
        return
    distance, nearest = ndimage.distance_transform_edt(kinds == 0, sampling=spacing_mm, return_indices=True)
    near = unknown & (distance <= SAME_KIND_MM)
    for code, kind in enumerate(KNOWN_KINDS, start=1):
        masks[kind] = masks[kind] | (near & (kinds[tuple(nearest)] == code))
    masks["vessel"] = unknown & ~near


def _add_small_vessels(
    values: np.ndarray, table: dict, where: np.ndarray, kidney: np.ndarray, spacing_mm: np.ndarray
) -> None:
    """Add flow from the middle of the kidney to its surface, in clusters."""
    depth = _distance_to_border(kidney, spacing_mm)
    outward = -_direction(ndimage.gaussian_filter(depth, CAPSULE_SD), spacing_mm)
    share = np.clip(noise_of(where.shape, table["distance_mm"] / 4 / spacing_mm) - SPARSE, 0, 1)
    velocity = outward * (np.float32(table["peak_cm_s"] / 100) * share)[..., None]
    _write(values, table, where, velocity)


def _add_vessels(
    values: np.ndarray, table: dict, where: np.ndarray, away: np.ndarray, spacing_mm: np.ndarray
) -> None:
    """Add flow along the vessels of one kind, by the distance [mm] from the kidney."""
    body, potential = _potential(where, away, spacing_mm)
    inside = ndimage.gaussian_filter(body.astype(np.float32), POTENTIAL_SD)
    smooth = ndimage.gaussian_filter(potential, POTENTIAL_SD) / np.maximum(inside, 1e-3)
    direction = _direction(smooth, spacing_mm) * (1 if table["towards_kidney"] else -1)
    # From the middle of a voxel to the face of the next.
    wall = _distance_to_border(where, spacing_mm) - spacing_mm.mean() / 2
    radius = ndimage.maximum_filter(wall, 2 * WIDEST + 1)
    peak = np.interp(radius, table["radius_mm"], table["peak_cm_s"]) / 100
    profile = 1 - (1 - np.clip(wall / np.maximum(radius, 1e-6), 0, 1)) ** 2
    _write(values, table, where & body, direction * (peak * profile)[..., None])


def _distance_from(kidney: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """The distance [mm] from the kidney; without one, from the middle."""
    if kidney.any():
        return ndimage.distance_transform_edt(~kidney, sampling=spacing_mm)
    middle = (np.array(kidney.shape) - 1) / 2
    return np.linalg.norm((np.moveaxis(np.indices(kidney.shape), 0, -1) - middle) * spacing_mm, axis=-1)


def _distance_to_border(mask: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """The distance [mm] of the voxels of a mask to the nearest outside it, float32."""
    distance = ndimage.distance_transform_edt(np.pad(mask, 1), sampling=spacing_mm)
    return distance[1:-1, 1:-1, 1:-1].astype(np.float32)


def _potential(where: np.ndarray, away: np.ndarray, spacing_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mask of the connected vessels, and a potential in them whose gradient leads from each one's end far
    from the kidney.

    It is that of a flow which enters at that end, runs along the walls and is lost evenly on its way: its
    divergence is -1. ``away`` is the distance from the kidney.
    """
    parts, count = ndimage.label(ndimage.binary_dilation(where))
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    large = [n for n in range(1, count + 1) if sizes[n] >= LEAST_VOXELS]
    body, potential = np.isin(parts, large), np.zeros(where.shape, np.float32)
    furthest = np.full(count + 1, np.inf)
    furthest[large] = ndimage.maximum(away, parts, large) if large else []
    unknown = body & (away <= furthest[parts] - END_MM)
    if unknown.any():
        laplacian = _laplacian(body, spacing_mm)
        free = unknown[body]
        system = laplacian[free][:, free]
        # In long vessels, conjugate gradients without a multigrid take thousands of steps.
        multigrid = ruge_stuben_solver(sparse.csr_matrix(system))
        potential[unknown] = multigrid.solve(np.ones(free.sum()), tol=1e-5, accel="cg")
    return body, potential


def _laplacian(body: np.ndarray, spacing_mm: np.ndarray) -> sparse.csr_array:
    """Minus the Laplacian of the voxels of a mask, through whose border nothing flows [1/mm2]."""
    index = np.full(body.shape, -1)
    index[body] = np.arange(body.sum())
    joined = []
    for axis, spacing in enumerate(spacing_mm):
        one, next_one = np.moveaxis(index, axis, 0)[:-1], np.moveaxis(index, axis, 0)[1:]
        both = (one >= 0) & (next_one >= 0)
        joined.append((one[both], next_one[both], np.full(both.sum(), spacing**-2.0)))
    first, second, weight = (np.concatenate(arrays) for arrays in zip(*joined, strict=True))
    size = int(body.sum())
    pairs = sparse.coo_array((weight, (first, second)), (size, size)).tocsr()
    pairs = pairs + pairs.T
    return sparse.csr_array(sparse.diags(pairs.sum(axis=1)) - pairs)


def _direction(potential: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """The unit direction (nx, ny, nz, 3) in which a potential rises; 0 where it does not."""
    gradient = [
        np.gradient(potential, spacing, axis=axis) if potential.shape[axis] > 1 else np.zeros(potential.shape)
        for axis, spacing in enumerate(spacing_mm)
    ]
    along = np.stack(gradient, axis=-1)
    size = np.linalg.norm(along, axis=-1, keepdims=True)
    return np.where(size > 1e-6, along / np.maximum(size, 1e-6), 0)


def _write(values: np.ndarray, table: dict, where: np.ndarray, velocity: np.ndarray) -> None:
    values[where, :3] = velocity[where]
    values[where, 3] = table["resistive_index"]
    values[where, 4] = 10 ** (table["blood_db"] / 20)
