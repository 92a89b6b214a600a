"""Colours of tissues, as atlases of anatomy have them: fat yellow, arteries red, veins blue, bile and
urine green to yellow.
"""

# Tissue -> red, green and blue (hexadecimal), of all that a voxel can be.
COLOURS = {
    "gas": "#8fb8d8",
    "fat": "#f2d84b",
    "fascia": "#ffffff",
    "soft-tissue": "#e0b8a8",
    "muscle": "#a63a33",
    "perimysium": "#f0a8c0",
    "liver": "#7a3b1e",
    "spleen": "#7b3f72",
    "bowel": "#c8834a",
    "bone": "#efe6c8",
    "metal": "#5a6a78",
    "fluid": "#4fd8e8",
    "kidney": "#b5525e",
    "cortex": "#e2705c",
    "medulla": "#8c2f4b",
    "arcuate": "#ff8fb0",
    "sinus": "#f7efa0",
    "urine": "#b6d33c",
    "stone": "#a9a9a9",
    "vessel": "#3a5fd0",
    "artery": "#e0202a",
    "vein": "#2438a8",
    "tumour": "#8fbf4d",
    "pseudocapsule": "#4e7a2f",
    "necrosis": "#46402f",
    "cyst": "#66c2f0",
}


def rgb_of(tissue: str) -> tuple[float, float, float]:
    """Red, green and blue of a tissue, 0 to 1."""
    digits = COLOURS[tissue]
    red, green, blue = (int(digits[n : n + 2], 16) / 255 for n in (1, 3, 5))
    return red, green, blue
