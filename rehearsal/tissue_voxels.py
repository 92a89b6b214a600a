"""The tissue of every voxel of a patient, classified once and then read from a file."""

import numpy as np

from scenes.anatomy import Grid, LoadedAnatomy
from scenes.tissue_classes.corrections import with_corrections
from scenes.tissue_classes.tissue_map import CODE, TissueMap, codes_of_labels, tissue_arrays
from sim.stored_arrays import stored
from ultrasound.acoustics import TissueVoxels, check_tissues


def tissue_voxels(
    labels: Grid, anatomy: LoadedAnatomy, ct: Grid, draws: bool, origin: np.ndarray
) -> TissueVoxels:
    """The tissue of each voxel, relative to an origin (3,) [mm]: as labelled, and as classified from
    the CT.

    ``draws``: also what no CT shows.
    """
    tissues_of_ct = stored_tissue_map(labels, anatomy, ct, draws)
    shift = np.eye(4)
    shift[:3, 3] = origin
    tissues = {code: name for name, code in CODE.items()}
    return TissueVoxels(tissues_of_ct.hu, tissues_of_ct.codes, tissues, tissues_of_ct.index_from_mm @ shift)


def stored_tissue_map(labels: Grid, anatomy: LoadedAnatomy, ct: Grid, draws: bool) -> TissueMap:
    """As ``tissue_map``, but computed only once for the same anatomy, and with its corrections.

    Raises TissueError.
    """
    check_tissues(anatomy.tissues | anatomy.corrected_tissues)
    codes = codes_of_labels(labels.voxels, anatomy.tissues)
    classified = TissueMap(
        *stored(tissue_arrays, ct.voxels, codes, anatomy.organ, ct.index_from_mm, int(draws))
    )
    own = anatomy.corrections
    if own is None:
        return classified
    return with_corrections(classified, own.voxels, own.index_from_mm, anatomy.corrected_tissues)
