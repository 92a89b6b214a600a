import os
from pathlib import Path

# Before Taichi is imported, by whichever module: no banner, and no look on the network for newer versions.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
# Without it, as of a service, Taichi ends the process where it looks for its cache.
os.environ.setdefault("HOME", str(Path.home()))
