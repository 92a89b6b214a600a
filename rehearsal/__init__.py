import sim  # noqa: F401  which keeps Taichi quiet, whoever imports it
