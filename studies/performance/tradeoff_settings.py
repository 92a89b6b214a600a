"""The settings that ``study trade`` tries: model, resolution, substeps, iterations and relaxation."""

from rehearsal.configuration import PRESETS, Setup, setup_of

CELLS_MM = (10.0, 8.0, 6.0, 5.0, 4.0, 3.5, 3.0, 2.5, 2.0)
CELL_ITERATIONS = (1, 2, 4, 8, 12, 20)
RADII_MM = (2.2, 2.5, 2.7, 3.0, 3.3, 4.0, 5.0)
# Substeps and iterations; the paper's first.
SUBSTEPS_ITERATIONS = ((3, 9), (1, 9), (3, 3), (1, 27), (3, 27))
# The paper's Table 3: the best stiffness for each radius.
PAPER = tuple(
    setup_of("shape-matching", radius_mm=radius, stiffness=stiffness)
    for radius, stiffness in ((2.2, 0.95), (2.5, 0.6), (2.7, 0.5), (3.0, 0.45), (3.3, 0.35))
)
QUICK = (
    setup_of("neo-hookean", cell_mm=8.0, iterations=4),
    *(PRESETS["neo-hookean"][name] for name in ("fast", "balanced")),
    PRESETS["shape-matching"]["fast"],
    PAPER[-1],
)


def setups(quick: bool) -> list[Setup]:
    """All settings, each once, those of one model and size together."""
    if quick:
        return _sorted(list(QUICK))
    balanced = PRESETS["neo-hookean"]["balanced"]
    cells = [
        setup_of("neo-hookean", cell_mm=cell, iterations=iterations)
        for cell in CELLS_MM
        for iterations in CELL_ITERATIONS
    ]
    around = [balanced.but(relaxation_factor=factor) for factor in (1.0, 1.4, 1.9)]
    around += [balanced.but(substeps=substeps) for substeps in (2, 4)]
    particles = [
        setup_of("shape-matching", radius_mm=radius, substeps=substeps, iterations=iterations)
        for radius in RADII_MM
        for substeps, iterations in SUBSTEPS_ITERATIONS
    ]
    stiff = [setup_of("shape-matching", radius_mm=radius, stiffness=1.0) for radius in (2.7, 3.3, 5.0)]
    relaxed = [setup_of("shape-matching", radius_mm=radius, relaxation_factor=1.5) for radius in (2.7, 3.3)]
    named = [setup for presets in PRESETS.values() for setup in presets.values()]
    return _sorted([*cells, *around, *particles, *stiff, *relaxed, *PAPER, *named])


def _sorted(given: list[Setup]) -> list[Setup]:
    return sorted(dict.fromkeys(given), key=lambda setup: (setup.model, -setup.size_mm))
