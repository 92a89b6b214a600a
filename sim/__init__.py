import os
from pathlib import Path

# Set before any module imports Taichi: no banner, and no check for newer versions on the network.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
# Taichi ends the process where HOME is not set, as in a service.
os.environ.setdefault("HOME", str(Path.home()))
