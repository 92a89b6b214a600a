"""Parts of a labelled tumour: its pseudocapsule, and what takes up no contrast agent."""

import numpy as np
from scipy import ndimage

# Parts that are so much darker than the tumour's median are necrotic; thickness of the pseudocapsule.
NECROSIS_BELOW_MEDIAN_HU, PSEUDOCAPSULE_MM = 40.0, 1.0


def lesion_parts(hu: np.ndarray, tumour: np.ndarray, spacing_mm: np.ndarray) -> dict[str, np.ndarray]:
    """Masks (nx, ny, nz) of parts of a tumour by tissue; the pseudocapsule is at least one voxel thick."""
    if not tumour.any():
        return {}
    depth = ndimage.distance_transform_edt(tumour, sampling=spacing_mm)
    rim = tumour & (depth <= max(PSEUDOCAPSULE_MM, spacing_mm.min()) + 1e-6)
    necrosis = tumour & (hu < np.median(hu[tumour]) - NECROSIS_BELOW_MEDIAN_HU)
    return {"pseudocapsule": rim, "necrosis": necrosis}
