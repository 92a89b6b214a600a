"""Files that are numbered."""

from rehearsal.image_and_surface_files import IMAGE, SCREENSHOT
from rehearsal.result_files import next_number


def test_the_next_number_is_one_more_than_the_highest(tmp_path):
    assert next_number(tmp_path / "none", SCREENSHOT) == next_number(tmp_path, SCREENSHOT) == 1
    for name in (
        "screenshot-007.png",
        "screenshot-12.png",
        "screenshot-0x9.png",
        "my-screenshot-044.png",
        "screenshot-050.png.part",
        "013-ct.png",
    ):
        (tmp_path / name).touch()
    assert next_number(tmp_path, SCREENSHOT) == 8
    assert next_number(tmp_path, IMAGE) == 14


def test_numbers_go_on_after_three_digits(tmp_path):
    for name in ("screenshot-999.png", "screenshot-1000.png", "1000-no ct.png"):
        (tmp_path / name).touch()
    assert next_number(tmp_path, SCREENSHOT) == next_number(tmp_path, IMAGE) == 1001
