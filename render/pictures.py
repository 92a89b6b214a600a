"""Pictures as files: slices and frames of a run, and its animation."""

from pathlib import Path

from PIL import Image

from render.viewer import View

PICTURES_A_SECOND = 10
ANIMATION_WIDTH = 720


def in_proportion(view: View) -> Image.Image:
    """The slice with square pixels, as wide as it was sampled."""
    picture = Image.fromarray(view.slice_image)
    height = round(picture.width * view.depth_mm / view.width_mm)
    return picture.resize((picture.width, height), Image.Resampling.BILINEAR)


def empty_folder(folder: Path) -> Path:
    """A folder without the pictures of an earlier run."""
    folder.mkdir(parents=True, exist_ok=True)
    for picture in folder.glob("[0-9]*.png"):
        picture.unlink()
    return folder


def smaller(picture: Image.Image) -> Image.Image:
    """A picture no wider than the animation."""
    width = min(ANIMATION_WIDTH, picture.width)
    return picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)


def save_animation(pictures: list[Image.Image], path: Path) -> None:
    """Write an animated GIF that repeats; one palette and dithering keep grey grey and rare colours alive."""
    coloured = [picture.convert("RGB") for picture in pictures]
    palette = coloured[-1].quantize(method=Image.Quantize.FASTOCTREE)
    first, *others = [picture.quantize(palette=palette) for picture in coloured]
    first.save(path, save_all=True, append_images=others, duration=1000 // PICTURES_A_SECOND, loop=0)
