import os

import sim  # noqa: F401  which keeps Taichi quiet, whoever imports it

# Mesa's driver of the processor takes a quarter less time for the window's image if it does not filter it;
# the image needs no filter, because it has the window's pixels. Set before the driver is loaded.
os.environ.setdefault("LP_PERF", "no_linear,no_mip_linear,no_mipmaps")
