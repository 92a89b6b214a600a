"""The tissue of every voxel of a patient, classified once and then read from a file."""

import json

import numpy as np
import trimesh

from scenes.anatomy import Grid, LoadedAnatomy
from scenes.tissue_classes.tissue_map import CODE, TissueMap, tissue_map
from sim.stored_arrays import stored
from ultrasound.acoustics import TissueVoxels


def tissue_voxels(anatomy: LoadedAnatomy, ct: Grid, draws: bool, origin: np.ndarray) -> TissueVoxels:
    """Return the tissue of each voxel, relative to an origin (3,) [mm], as labelled and as classified from the CT.

    ``draws``: also what no CT shows.
    """
    found = stored_tissue_map(anatomy, ct, draws)
    shift = np.eye(4)
    shift[:3, 3] = origin
    tissues = {code: name for name, code in CODE.items()}
    return TissueVoxels(found.hu, found.codes, tissues, found.index_from_mm @ shift)


def stored_tissue_map(anatomy: LoadedAnatomy, ct: Grid, draws: bool) -> TissueMap:
    """As ``tissue_map``, but computed only once for the same anatomy."""
    labels = np.zeros(ct.voxels.shape, np.uint8) if anatomy.labels is None else anatomy.labels.voxels
    tissues = json.dumps(anatomy.tissues)
    given = ct.voxels, labels.astype(np.uint8), tissues, anatomy.organ, ct.index_from_mm, int(draws)
    return TissueMap(*stored(_arrays, *given))


def _arrays(
    hu: np.ndarray,
    labels: np.ndarray,
    tissues: str,
    organ: trimesh.Trimesh,
    index_from_mm: np.ndarray,
    draws: int,
) -> tuple[np.ndarray, ...]:
    tissue_of_label = {int(label): tissue for label, tissue in json.loads(tissues).items()}
    found = tissue_map(hu, labels, tissue_of_label, organ, index_from_mm, bool(draws))
    return found.codes, np.rint(found.hu).astype(np.int16), found.drawn, found.index_from_mm
