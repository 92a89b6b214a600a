"""The ultrasound panel as on a scanner: images, ruler, focus, marker dot, settings, outline and caliper.
NumPy and Pillow.

Pixels count from the top left. Points of the image plane are (u, v) [mm]: u from the centre to the right, v
down from the face.
"""

import numpy as np
from PIL import Image, ImageDraw

from render.text import PLATE_PX, fitting_size, font, shortened, write, written_size
from render.viewer import View
from render.window_layout import WEDGE_WIDTH, Rect, WindowLayout

PANEL, FINDINGS, LINE = (8, 9, 11), (20, 24, 29), (44, 50, 58)
TEXT, QUIET = (222, 227, 232), (132, 142, 153)
MARK, ALERT, RECORDING = (64, 196, 255), (255, 176, 46), (240, 62, 50)
OUTLINE, OUTLINE_AT_REST, CALIPER = (237, 194, 71), (146, 121, 187), (151, 248, 154)
RESECTION_LINE = (88, 188, 254)
CROSS_PX, NUMBER_PX, NOTE_PX, HINT_PX, FIGURE_PX = 5, 16, 17, 14, 15
# Legend of the tumour's outlines.
LEGEND = (("tumour now", OUTLINE), ("in the CT", OUTLINE_AT_REST))

# A text, its size and its colour.
Written = tuple[str, int, tuple[int, int, int]]


def image_boxes(layout: WindowLayout, view: View) -> list[Rect]:
    """The boxes of a view's images."""
    return layout.image_boxes(len(view.images), view.width_mm, view.depth_mm)


def to_pixels(view: View, box: Rect, places_mm: np.ndarray) -> np.ndarray:
    """Columns and rows (..., 2), fractional, of points (..., 2) of the plane."""
    share = (places_mm + [view.width_mm / 2, view.above_mm]) / [view.width_mm, view.depth_mm]
    return share * [box.width, box.height] + [box.left, box.top]


def to_plane(view: View, box: Rect, column: float, row: float) -> tuple[float, float]:
    """The point of the plane [mm] at a pixel."""
    across, down = (column - box.left) / box.width, (row - box.top) / box.height
    return (across - 0.5) * view.width_mm, down * view.depth_mm - view.above_mm


def ruler_ticks(view: View, box: Rect) -> list[tuple[int, int | None]]:
    """Ticks every 5 mm of depth: (row in pixels, whole centimetres or None between them)."""
    ticks = []
    for half_cm in range(int((view.depth_mm - view.above_mm) / 5.0 + 1e-9) + 1):
        share = (view.above_mm + half_cm * 5.0) / view.depth_mm
        ticks.append((box.top + round(share * (box.height - 1)), half_cm // 2 if half_cm % 2 == 0 else None))
    return ticks


def paste_image(page: np.ndarray, box: Rect, image: np.ndarray) -> None:
    """Draw an image, uint8 (rows, columns) or (rows, columns, 3), into its box, resampled unless it has
    the size of the box.
    """
    if image.shape[:2] != (box.height, box.width):
        resized = Image.fromarray(image).resize((box.width, box.height), Image.Resampling.BILINEAR)
        image = np.asarray(resized)
    # Channel by channel is five times as fast as all three at once.
    for channel in range(3):
        page[box.slices][..., channel] = image if image.ndim == 2 else image[..., channel]


def draw_note(page: np.ndarray, layout: WindowLayout, box: Rect, note: str) -> None:
    """Write a note over the centre of an image; a second line is smaller, to fit."""
    px, (x, y) = layout.px, (box.left + box.width / 2, box.top + box.height / 2)
    text, _, hint = note.partition("\n")
    write(page, box, (x, y), text, px(NOTE_PX), QUIET)
    if hint:
        size = fitting_size([(hint,)], box.width - 3 * PLATE_PX, px(HINT_PX))
        write(page, box, (x, y + 1.5 * px(NOTE_PX)), hint, size, QUIET)


def draw_segments(
    page: np.ndarray, view: View, box: Rect, segments_mm: np.ndarray, colour, width: int = 1
) -> None:
    """Draw line segments (n, 2, 2) of the plane [mm] over an image, so many pixels wide, clipped to its
    box.
    """
    if len(segments_mm) == 0:
        return
    start, end = np.moveaxis(to_pixels(view, box, np.asarray(segments_mm, float)), 1, 0)
    count = int(np.ceil(np.abs(end - start).max())) + 1
    along = np.linspace(0.0, 1.0, count + 1)[:, None, None]
    beside = np.moveaxis(np.indices((width, width)), 0, -1).reshape(-1, 1, 1, 2) - (width - 1) // 2
    column, row = (np.floor(start + along * (end - start)).astype(int) + beside).reshape(-1, 2).T
    inside = (column >= box.left) & (column < box.right) & (row >= box.top) & (row < box.bottom)
    page[row[inside], column[inside], :3] = colour


def draw_caliper(page: np.ndarray, layout: WindowLayout, view: View, box: Rect) -> None:
    """Draw the caliper: a cross at each of its points, the line between them, and the distance beside it."""
    px, reach = layout.px(FIGURE_PX), layout.px(CROSS_PX)
    reach_mm = reach * np.array([view.width_mm / box.width, view.depth_mm / box.height])
    points, figure = np.array(view.caliper_mm, float).reshape(-1, 2), view.caliper
    crosses = [[point - reach_mm * axis, point + reach_mm * axis] for point in points for axis in np.eye(2)]
    line = [points] if len(points) == 2 else []
    draw_segments(page, view, box, np.array([*crosses, *line]), CALIPER, layout.line_width)
    if line and figure:
        start, end = to_pixels(view, box, points)
        write(page, box, beside(start, end, written_size(figure, px), box, reach), figure, px, CALIPER)


def beside(
    start: np.ndarray, end: np.ndarray, size: tuple[int, int], box: Rect, gap: int
) -> tuple[float, float]:
    """The centre of a text of a size [pixels] beside a line, ``gap`` away, on the side towards the centre of
    the box.
    """
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1.0)
    across = np.array([along[1], -along[0]]) if along.any() else np.array([1.0, 0.0])
    away = across * (gap + np.abs(across) @ size / 2)
    middle, inner = (start + end) / 2, np.array([box.left + box.width / 2, box.top + box.height / 2])
    x, y = middle + away if away @ (inner - middle) >= 0 else middle - away
    return float(x), float(y)


def draw_panel(draw: ImageDraw.ImageDraw, layout: WindowLayout, view: View) -> None:
    """Draw the panel without its images."""
    area, boxes, px = layout.panel, image_boxes(layout, view), layout.px
    draw.rectangle([area.left, area.top, area.right, area.bottom], fill=PANEL)
    draw.line([(area.left, 0), (area.left, area.bottom)], fill=LINE)
    left, width = area.left + px(16), area.width - 2 * px(16)
    probe, b_mode, ct = view.captions
    depth = f"Depth {(view.depth_mm - view.above_mm) / 10:.1f} cm"
    _draw_row(draw, left, width, px(22), (probe, px(17), TEXT), (depth, px(15), TEXT))
    _draw_row(draw, left, width, area.bottom - px(17), (b_mode, px(14), QUIET), (ct, px(14), QUIET))
    if view.outline_mm is not None:
        _draw_legend(draw, layout, boxes[0].left, max(box.bottom for box in boxes))
    _draw_ruler(draw, layout, view, boxes[0])
    _draw_scale(draw, layout, view, boxes[-1])
    for name, box in zip(view.images, boxes, strict=True):
        # The marker dot: local +x is to the right.
        x, y, radius = box.right - px(10), box.top - px(12), px(6)
        draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=MARK)
        # An image that is very deep is too narrow for its name.
        if box.left + font(px(15)).getlength(name) < x - radius:
            draw.text((box.left, y), name, font=font(px(15)), fill=TEXT, anchor="lm")


def status_image(layout: WindowLayout, status: str) -> np.ndarray:
    """The status over the images, uint8, shape of layout.status."""
    box, px = layout.status, layout.px
    image = Image.new("RGB", (box.width, box.height), PANEL)
    text = shortened(status, px(17), box.width)
    middle = box.width // 2, box.height // 2
    ImageDraw.Draw(image).text(middle, text, font=font(px(17)), fill=ALERT, anchor="mm")
    return np.asarray(image)


def _draw_row(draw: ImageDraw.ImageDraw, x: int, width: int, y: int, left: Written, right: Written) -> None:
    """Draw two texts at both ends of a row; the left one is shortened to fit."""
    text, size, colour = right
    draw.text((x + width, y), text, font=font(size), fill=colour, anchor="rm")
    room = width - int(font(size).getlength(text)) - size
    text, size, colour = left
    draw.text((x, y), shortened(text, size, room), font=font(size), fill=colour, anchor="lm")


def _draw_legend(draw: ImageDraw.ImageDraw, layout: WindowLayout, x: int, bottom: int) -> None:
    px, y = layout.px, bottom + layout.px(12)
    for text, colour in LEGEND:
        draw.line([(x, y), (x + px(16), y)], fill=colour, width=px(2))
        x += px(22)
        draw.text((x, y), text, font=font(px(14)), fill=colour, anchor="lm")
        x += int(font(px(14)).getlength(text)) + px(16)


def _draw_ruler(draw: ImageDraw.ImageDraw, layout: WindowLayout, view: View, box: Rect) -> None:
    px, x = layout.px, box.left - layout.px(6)
    # Where centimetres are too small, number only every few of them.
    every = int(np.ceil(px(NUMBER_PX) / (10.0 * box.height / view.depth_mm)))
    for row, centimetres in ruler_ticks(view, box):
        length = px(5 if centimetres is None else 10)
        draw.line([(x - length, row), (x, row)], fill=QUIET if centimetres is None else TEXT)
        if centimetres and centimetres % every == 0:
            draw.text((x - px(15), row), str(centimetres), font=font(px(14)), fill=TEXT, anchor="rm")
        elif centimetres == 0:
            draw.text((x - px(15), row), "cm", font=font(px(14)), fill=QUIET, anchor="rm")
    if view.focus_mm is not None:
        row = to_pixels(view, box, np.array([0.0, view.focus_mm]))[1]
        draw.polygon([(x + px(4), row), (x - px(4), row - px(5)), (x - px(4), row + px(5))], fill=ALERT)


def _draw_scale(draw: ImageDraw.ImageDraw, layout: WindowLayout, view: View, box: Rect) -> None:
    """Draw the grey scale beside the image, white at the top, or that of Doppler."""
    px, colours = layout.px, view.scale_colours
    if colours is None:
        colours = np.repeat(np.arange(255, -1, -1)[:, None], 3, axis=1)
    height = min(px(128), box.height)
    left, right = box.right + px(12), box.right + px(19)
    for i in range(height):
        colour = tuple(colours[i * (len(colours) - 1) // max(1, height - 1)].tolist())
        draw.line([(left, box.top + i), (right, box.top + i)], fill=colour)
    for text, row, anchor in zip(view.scale, (box.top - px(2), box.top + height + px(2)), "ba", strict=True):
        draw.text(
            (box.right + px(WEDGE_WIDTH) - px(4), row),
            text,
            font=font(px(14)),
            fill=QUIET,
            anchor=f"r{anchor}",
        )
