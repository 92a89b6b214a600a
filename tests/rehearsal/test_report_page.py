"""The page of a session for colleagues: what is in it, and that a browser shows and prints it."""

import base64
import io
import json
import re
import shutil
import subprocess
from html import escape
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from coarse_patient import coarse_patient
from conftest import ROOT
from cut_ball import R, ball, circle, cut_by
from matplotlib.colors import to_rgb
from PIL import Image
from recorded_session import header, record_all

from rehearsal.commands.rehearse_options import RehearseOptions
from rehearsal.input_files import read_files
from rehearsal.loop.command import CutOut, Mark, Move, Undo
from rehearsal.measurements.live_measurements import LiveMeasurements
from rehearsal.measurements.session_summary import SessionCourse
from rehearsal.notices import Notices
from rehearsal.page.measurement_charts import (
    HEIGHT,
    LEFT,
    QUANTITIES,
    MeasurementCourse,
    chart,
    charts,
    ticks,
)
from rehearsal.page.page_files import ASIDE_DEG, aside, save_page_files
from rehearsal.page.page_pictures import image_png
from rehearsal.page.report_page import (
    DEFAULT_TITLE,
    MOST_ATTEMPTS,
    NOT_MODELLED,
    NOT_SHOWN,
    ModelView,
    ReportPage,
    margin_legend,
)
from rehearsal.page.rest_model import (
    COLOUR,
    GAMMA,
    GLTF_FROM_LPS,
    KIDNEY,
    SCORE,
    SPECIMEN,
    TUMOUR,
    TUMOUR_OF_SPECIMEN,
    glb,
    model_parts,
    tube,
)
from rehearsal.page.session_images import SessionImages, drawn
from rehearsal.resection.attempts import HEADINGS, AttemptFigureList, AttemptFigures, table_of
from rehearsal.resection.cut import CutSettings
from rehearsal.resection.operation import cut_command
from rehearsal.resection.proposal import line_around
from rehearsal.resection.resection_page import COLOURS, report_of, rows_of
from rehearsal.sessions.recorder import SessionRecorder, next_path
from rehearsal.sessions.session_file import Header, Log
from render.viewer import TextTable, View
from scenes.anatomy import LoadedAnatomy
from scenes.scene import EMBEDDED, Scene
from ultrasound.probe import load_probe
from ultrasound.scanner import B_MODE

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
OPTIONS = (
    *("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--hide-scrollbars", "--no-first-run", "--enable-logging=stderr", "--virtual-time-budget=3000"),
)
CANVAS = 243, 245, 247
TITLE = 'Left kidney <script>alert("1")</script> & more'


@pytest.fixture(scope="module")
def resected(one_device, tmp_path_factory):
    """The embedded patient after a cut: its anatomy, its figures, and the files of its page."""
    rehearsal, loaded = coarse_patient()
    case, anatomy = rehearsal.case, rehearsal.anatomy
    line = line_around(case.organ, case.tumour, 5.0, np.array([0.65, -0.75, 0.12]))
    for command in (Mark(places_mm=line.marks.tolist()), cut_command(anatomy, CutSettings(), None)):
        rehearsal.timeline.submit(command)
    assert not rehearsal.do().notices
    folder = tmp_path_factory.mktemp("Mustermann")
    session = folder / "session-007.jsonl"
    record_all(session)
    images = SessionImages()
    images.observe(view_of(np.full((40, 30), 90, np.uint8)), anatomy)
    figures = report_of(anatomy)
    summary = LiveMeasurements(anatomy, rehearsal.manipulator).summary()
    remarks = ["the side is <not> certain"]
    attempts = AttemptFigureList(anatomy)
    attempts.observe(anatomy.frame, case.probe)
    about = summary, images, figures, attempts.table(), remarks
    written = save_page_files(anatomy, loaded, session, *about)
    page = written[0].read_text("utf-8")
    return SimpleNamespace(anatomy=anatomy, figures=figures, written=written, page=page)


def view_of(image: np.ndarray, **changed) -> View:
    return View(np.eye(4), {B_MODE: image}, **(dict(width_mm=30.0, depth_mm=40.0) | changed))


def page_of(**changed) -> ReportPage:
    values = dict(title="", model=b"glTF", view=ModelView((0.0, -1.0, 0.0), {}), still=b"png")
    return ReportPage(**(values | changed))


def picture_of(width: int, height: int) -> bytes:
    return image_png(Image.new("RGB", (width, height), "gray"))


def text_between(page: str, start: str, end: str) -> str:
    return page.partition(start)[2].partition(end)[0]


def model_in(page: str) -> bytes:
    return base64.b64decode(text_between(page, 'id="model">', "</script>"))


def loaded_glb(data: bytes) -> trimesh.Scene:
    return trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)


def places(vertices: np.ndarray) -> np.ndarray:
    """Distinct vertices in an order of their own."""
    return np.unique(np.asarray(vertices, np.float32), axis=0)


# Content


def test_the_page_has_the_figures_of_the_resection(resected):
    for name, value in rows_of(resected.figures):
        assert f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" in resected.page
    assert "R.E.N.A.L." in resected.page and "PADUA" in resected.page
    assert "<p>the side is &lt;not&gt; certain</p>" in resected.page
    assert f"<h1>{resected.anatomy.case.scene.title}</h1>" in resected.page
    assert "B-mode, after the cut, 30 x 40 mm" in resected.page
    assert margin_legend() in resected.page


def attempts_of(count: int, present: int | None, points: float | None = None) -> TextTable:
    """Attempts whose figures follow from their number."""
    technique = "enucleoresection"
    figures = [
        AttemptFigures(n, technique, 5.0, n + 0.1, n + 0.2, n + 0.3, 10.0 * n, n, points, points)
        for n in range(1, count + 1)
    ]
    return table_of(figures, present)


def rows_in(page: str) -> list[tuple[bool, list[str]]]:
    """Of each row of the table of attempts whether it is marked, and its texts."""
    rows = re.findall(
        r"<tr( class=\"shown\")?>(.*?)</tr>", text_between(page, 'class="attempts">', "</table>")
    )
    return [(bool(mark), re.findall(r"<t[hd]>(.*?)</t[hd]>", row)) for mark, row in rows]


def test_all_attempts_are_in_a_table_and_the_shown_one_is_marked(resected):
    (_, heads), *rows = rows_in(page_of(resection=resected.figures, attempts=attempts_of(3, 2, 4.5)).html())
    assert heads == [*HEADINGS, "points (plan 4.5)"]
    assert [mark for mark, _ in rows] == [False, True, False]
    figures = [
        ["enucleoresection", "5", f"{n}.1", f"{n}.2", f"{n}.3", f"{10 * n}", f"{n}"] for n in (1, 2, 3)
    ]
    assert [texts for _, texts in rows] == [
        [str(n), *row, "4.5"] for n, row in zip((1, 2, 3), figures, strict=True)
    ]


def test_an_attempt_is_in_the_table_where_the_page_does_not_show_it_alone(resected):
    # The figures of the only cut are those of the resection.
    assert rows_in(resected.page) == []
    assert rows_in(page_of(attempts=attempts_of(0, None)).html()) == []
    undone = page_of(attempts=attempts_of(1, None)).html()
    assert [mark for mark, _ in rows_in(undone)] == [False, False] and NOT_SHOWN in undone


def test_of_many_attempts_the_last_and_the_shown_one_are_there(resected):
    page = page_of(resection=resected.figures, attempts=attempts_of(30, 4)).html()
    numbers = [texts[0] for _, texts in rows_in(page)[1:]]
    assert numbers == ["4", *map(str, range(31 - MOST_ATTEMPTS, 31))]
    assert f"Listed of 30: the last {MOST_ATTEMPTS}, and the one shown." in page


def test_a_title_is_text_and_nothing_else():
    page = page_of(title=TITLE).html()
    assert "<script>alert" not in page and page.count(escape(TITLE)) == 2
    assert f"<h1>{DEFAULT_TITLE}</h1>" in page_of().html()


def test_a_name_of_a_part_cannot_end_its_element():
    view = ModelView((0.0, -1.0, 0.0), {"</script><b>": "#ffffff"})
    text = text_between(page_of(view=view).html(), 'id="view">', "</script>")
    assert json.loads(text)["colours"] == {"</script><b>": "#ffffff"}


def test_the_title_of_the_command_line_is_that_of_window_report_and_page():
    assert read_files(RehearseOptions(scene=EMBEDDED, title=TITLE)).scene.title == TITLE
    scene = read_files(RehearseOptions(scene=EMBEDDED)).scene
    assert scene.title not in ("", TITLE)


def test_nothing_is_loaded_and_no_folder_is_named(resected):
    assert "://" not in resected.page and "Mustermann" not in resected.page
    assert "session-007" not in resected.page and str(Path.home()) not in resected.page
    sources = re.findall(r"""\b(?:src|href)=["']?([^"'>\s]{0,22})""", resected.page)
    assert len(sources) >= 3 and set(sources) == {"data:image/png;base64,"}
    assert re.findall(r"url\(|@import|fetch\(|XMLHttp", resected.page) == []


def test_what_is_not_modelled_is_said_as_in_the_documents():
    limits = " ".join((ROOT / "docs" / "limitations.md").read_text("utf-8").replace("**", "").split())
    for sentence in NOT_MODELLED:
        text = sentence.replace("The picture is", "It is")
        assert all(part in limits for part in re.split(r"(?<=,) |[.:] |\.$", text)), sentence
        assert escape(sentence) in page_of().html()


# The kidney


def test_files_have_the_number_of_the_session(resected):
    names = [path.name for path in resected.written]
    assert names == [
        *("report-007.html", "kidney-007.glb", "specimen-007.glb"),
        *("kidney-007.stl", "specimen-007.stl", "score-007.stl"),
    ]


def test_a_page_without_its_session_is_not_replaced(tmp_path):
    assert next_path(tmp_path).name == "session-001.jsonl"
    (tmp_path / "report-004.html").touch()
    (tmp_path / "session-002.jsonl").touch()
    assert next_path(tmp_path).name == "session-005.jsonl"


def test_the_model_of_the_page_has_the_vertices_of_the_anatomy_in_the_patient(resected):
    scene, cut, case = loaded_glb(model_in(resected.page)), resected.anatomy.cut, resected.anatomy.case
    assert {KIDNEY, SCORE, SPECIMEN, TUMOUR_OF_SPECIMEN} == set(scene.geometry)
    for name, surface in ((KIDNEY, cut.remnant), (SPECIMEN, cut.specimen)):
        np.testing.assert_array_equal(
            places(scene.geometry[name].vertices), places(surface.vertices + case.origin)
        )
        assert scene.geometry[name].area == pytest.approx(surface.area, rel=1e-5)
        transform = scene.graph.get(name)[0]
        np.testing.assert_allclose(transform, GLTF_FROM_LPS, atol=1e-12)
    of_files = [loaded_glb(path.read_bytes()) for path in resected.written if path.suffix == ".glb"]
    assert [set(each.geometry) for each in of_files] == [{KIDNEY, SCORE}, {SPECIMEN, TUMOUR_OF_SPECIMEN}]


def test_glb_has_the_head_up_the_front_forward_and_the_left_to_the_right_in_m():
    left, front, head = (GLTF_FROM_LPS[:3, :3] @ axis for axis in ((1, 0, 0), (0, -1, 0), (0, 0, 1)))
    np.testing.assert_allclose([left, front, head], 0.001 * np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]]))
    assert np.linalg.det(GLTF_FROM_LPS[:3, :3]) > 0


def test_printed_surfaces_are_closed_and_have_the_volumes_of_the_cut(resected):
    cut = resected.anatomy.cut
    kidney, specimen, score = (trimesh.load_mesh(path) for path in resected.written if path.suffix == ".stl")
    assert kidney.volume == pytest.approx(cut.remnant.volume, rel=1e-4)
    assert specimen.volume == pytest.approx(1000 * resected.figures["specimen_ml"], rel=1e-3)
    assert [surface.is_watertight for surface in (kidney, specimen, score)] == [True] * 3
    middle = cut.line.points.mean(axis=0) + resected.anatomy.case.origin
    assert np.abs(score.bounds.mean(axis=0) - middle).max() < 5.0


def fake_anatomy(cut=None, tumour=None, marks=()) -> SimpleNamespace:
    about = dict(scene=Scene(anatomy={}), probe=load_probe("linear"))
    case = SimpleNamespace(organ=ball(R), tumour=tumour, origin=np.array([10.0, -20.0, 30.0]), **about)
    resection = SimpleNamespace(points=lambda: np.array(marks).reshape(-1, 3))
    left = None if cut is not None else tumour
    return SimpleNamespace(case=case, cut=cut, tumour=left, frame=SimpleNamespace(resection=resection))


def test_the_cut_surface_has_the_colour_of_the_distance_from_the_tumour():
    """Of two balls, one inside the other and off its middle, by their radii; a ball is within 0.1 mm of its
    surface.
    """
    middle, radius = np.array([2.5, 0.0, 0.0]), 9.0
    cut = cut_by(ball(R), ball(13.0))
    parts = model_parts(fake_anatomy(cut, ball(radius, tuple(middle))))
    origin = np.array([10.0, -20.0, 30.0])
    mesh = loaded_glb(glb(parts)).geometry[SPECIMEN]
    colours = np.asarray(mesh.visual.vertex_attributes["color"])[mesh.faces[:, 0], :3] / 255
    away = np.linalg.norm(mesh.triangles_center - origin - middle, axis=1) - radius
    limits = np.array([0.0, 1.0, 3.0, 5.0])
    certain = np.abs(away[:, None] - limits).min(axis=1) > 0.1
    expected = np.array([to_rgb(colour) for colour in COLOURS])[np.digitize(away, limits)]
    assert certain.mean() > 0.8 and len(set(np.digitize(away[certain], limits))) >= 3
    assert np.abs(colours[certain] - expected[certain] ** GAMMA).max() <= 0.5 / 255 + 1e-6


def test_a_kidney_that_is_not_cut_shows_the_tumour_in_it():
    parts = model_parts(fake_anatomy(tumour=ball(9.0), marks=circle()))
    assert set(parts) == {KIDNEY, TUMOUR, SCORE} == set(loaded_glb(glb(parts)).geometry)
    # Too few marks for a line.
    assert set(model_parts(fake_anatomy(marks=circle()[:2]))) == {KIDNEY}
    opacity = []
    for translucent in ((), (KIDNEY,)):
        data = glb(parts, translucent)
        tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
        kidney = next(mesh for mesh in tree["meshes"] if mesh["name"] == KIDNEY)["primitives"][0]
        opacity.append(tree["materials"][kidney["material"]]["pbrMetallicRoughness"]["baseColorFactor"][3])
    assert opacity[0] == 1.0 and 0.2 < opacity[1] < 0.8


def test_an_organ_without_tumour_ct_or_a_step_has_a_page(tmp_path):
    anatomy, session = fake_anatomy(), tmp_path / "session-012.jsonl"
    loaded = LoadedAnatomy(organ=ball(R), tumour=None, ct=None, shapes=())
    SessionRecorder(session, header(), Notices()).close({})
    summary = SessionCourse(8.0).summary({}, [], 0)
    written = save_page_files(anatomy, loaded, session, summary, SessionImages(), None, table_of([]), [])
    assert [path.name for path in written] == ["report-012.html", "kidney-012.glb", "kidney-012.stl"]
    page = written[0].read_text("utf-8")
    assert f"<h1>{DEFAULT_TITLE}</h1>" in page
    assert re.findall(r"<h2>(.*?)</h2>", page) == ["Kidney", "Session", "Not modelled"]


def test_the_score_is_a_tube_around_the_line():
    angle, radius = 2 * np.pi * np.arange(90) / 90, 0.7
    made = tube(np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), 0 * angle]), radius)
    assert made.is_watertight and made.euler_number == 0  # a torus
    across = np.hypot(np.hypot(*made.vertices[:, :2].T) - 20, made.vertices[:, 2])
    assert across.max() <= radius + 0.03
    # Eight sides of a circle have 90 % of its area, fewer less.
    assert 0.8 < made.volume / (2 * np.pi * 20 * np.pi * radius**2) < 0.95


def test_colours_of_parts_differ_from_each_other_and_from_those_of_the_margin():
    colours = [to_rgb(colour) for colour in {*COLOUR.values(), *COLOURS}]
    apart = np.abs(np.array(colours)[:, None] - np.array(colours)).max(axis=2) + np.eye(len(colours))
    assert apart.min() > 0.08


@pytest.mark.parametrize("towards", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0, -0.8)])
def test_the_first_view_after_a_cut_is_aside_of_the_specimen(towards):
    eye = aside(np.array(towards, float))
    assert np.linalg.norm(eye) == pytest.approx(1.0)
    assert eye @ towards == pytest.approx(np.cos(np.radians(ASIDE_DEG)))


# Images and measurements


def shown_at(time_s: float, is_cut: bool = False) -> SimpleNamespace:
    """An anatomy at a time, without a tumour."""
    frame = SimpleNamespace(time_s=time_s)
    return SimpleNamespace(frame=frame, cut=True if is_cut else None, tumour_outline=lambda: None)


def test_images_are_those_exported_or_the_last_before_and_after_the_cut():
    images, black = SessionImages(), np.zeros((8, 6), np.uint8)
    assert images.captioned(has_cut=False) == []
    images.observe(view_of(black + 1), shown_at(0.0))
    images.observe(view_of(black + 2), shown_at(1.0))
    images.observe(view_of(black + 3, notes={B_MODE: "NO CONTACT"}), shown_at(2.0))
    ((caption, image),) = images.captioned(has_cut=False)
    assert "last image" in caption and np.asarray(image).max() == 2
    images.observe(view_of(black + 4), shown_at(2.0, is_cut=True))
    shown = images.captioned(has_cut=True)
    assert [np.asarray(image).max() for _, image in shown] == [2, 4]
    assert ["before" in caption for caption, _ in shown] == [True, False]
    # Of a cut that was undone nothing is shown.
    assert len(images.captioned(has_cut=False)) == 1
    for number in range(6):
        images.export(f"{number:03d}", view_of(black + 10 + number))
    assert [np.asarray(image).max() for _, image in images.captioned(has_cut=True)] == [12, 13, 14, 15]
    images.clear()
    assert images.captioned(has_cut=True) == []


def test_an_image_has_square_pixels_and_its_lines_in_their_place():
    line = np.array([[[0.0, 0.0], [0.0, 40.0]]])
    view = view_of(np.zeros((8, 30), np.uint8), resection_mm=line, outline_mm=np.zeros((0, 2, 2)))
    image = np.asarray(drawn(view))
    assert image.shape[1] / image.shape[0] == pytest.approx(30 / 40, abs=0.01)
    columns = np.flatnonzero(image.any(axis=(0, 2)))
    assert np.abs(columns - image.shape[1] / 2).max() <= 2


def test_measurements_have_the_simulated_time_of_their_state():
    still = Move(pose=np.eye(4))
    slow = Move(pose=np.eye(4), length_s=0.5)
    cut = CutOut(technique="enucleoresection", margin_mm=5.0, seen="")
    # The state of number 2 is that after two moves; undo makes a state, and takes no time.
    commands = [(0, still), (1, slow), (2, cut), (3, Undo()), (4, still)]
    log = Log(Header(anatomy="", scene={}, probe={}, arch="cpu", time_step_s=0.1), commands)
    log.readings = {number: {"force_n": float(number)} for number in (0, 1, 2, 4, 5)}
    course = MeasurementCourse.of(log)
    np.testing.assert_allclose(course.time_s, [0.0, 0.1, 0.6, 0.6, 0.7])
    np.testing.assert_array_equal(course.values["force_n"], [0, 1, 2, 4, 5])
    assert course.cuts_s == [0.6]
    made = charts(course, 8.0)
    assert len(made) == 1 and "force on the probe, N" in made[0] and ">cut<" in made[0]


def test_a_chart_has_its_values_at_their_height_and_gaps_where_there_are_none():
    values = {each.name: np.full(5, np.nan) for each in QUANTITIES}
    values["compression_mm"] = np.array([0.0, 4.0, np.nan, 8.0, 2.0])
    course = MeasurementCourse(np.arange(5.0), values, [])
    made = chart(QUANTITIES[0], course, limit=6.0)
    lines = [
        np.array([place.split(",") for place in line.split()], float)
        for line in re.findall(r'polyline class="line" points="([^"]+)"', made)
    ]
    assert [len(line) for line in lines] == [2, 2]
    (x0, zero), (x1, four) = lines[0]
    (x3, eight), _ = lines[1]
    assert x0 == LEFT and x3 - x0 == pytest.approx(3 * (x1 - x0), abs=0.2) and zero < HEIGHT
    assert zero - eight == pytest.approx(2 * (zero - four), abs=0.2) and eight < four < zero
    limit = float(re.search(r'class="limit" d="M[\d.]+ ([\d.]+)H', made)[1])
    assert zero - limit == pytest.approx(6 / 4 * (zero - four), abs=0.2)
    assert "limit" not in chart(QUANTITIES[0], course, limit=20.0)


def test_a_long_session_has_as_many_points_as_a_chart_can_show_with_its_peak():
    values = {each.name: np.full(20_001, 1.0) for each in QUANTITIES}
    values["force_n"][12_345] = 7.5
    made = chart(QUANTITIES[1], MeasurementCourse(np.arange(20_001) / 4, values, []))
    heights = [float(pair.split(",")[1]) for pair in re.search(r'points="([^"]+)"', made)[1].split()]
    assert len(heights) <= 1500 and sum(height < min(heights) + 0.1 for height in heights) == 1


@pytest.mark.parametrize("most", [0.001, 0.3, 1.0, 4.0, 4.1, 9.99, 10.0, 77.0, 3600.0])
def test_numbers_of_an_axis_are_even_and_reach_the_largest_value(most):
    made = ticks(most)
    assert made[0] == 0 and 2 <= len(made) <= 6 and made[-2] < most <= made[-1] * (1 + 1e-9)
    np.testing.assert_allclose(np.diff(made), made[1])
    assert f"{made[1]:.0e}"[0] in "125"


# In a browser


needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium here to open the page in")


def browsed(page: Path, folder: Path, *options: str) -> list[str]:
    """Open a page without a screen; the lines of its console."""
    profile = f"--user-data-dir={folder / 'profile'}"
    done = subprocess.run(
        [str(BROWSER), *OPTIONS, profile, *options, page.as_uri()],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=120,
        check=True,
    )
    return [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def screenshot(page: str, folder: Path, name: str) -> tuple[np.ndarray, list[str]]:
    """The rows of the 3D view (rows, columns, 3), and the lines of the console."""
    file, picture = folder / f"{name}.html", folder / f"{name}.png"
    file.write_text(page, "utf-8")
    console = browsed(file, folder, f"--screenshot={picture}", "--window-size=900,900")
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    is_canvas = (np.abs(pixels - CANVAS).max(axis=2) <= 1).mean(axis=1) > 0.2
    rows = np.flatnonzero(is_canvas)
    return pixels[rows[0] : rows[-1] + 1], console


@needs_browser
def test_a_browser_shows_the_kidney_and_turns_it_with_the_mouse(resected, tmp_path):
    shown, console = screenshot(resected.page, tmp_path, "shown")
    assert console == [] and len(shown) > 400
    red, green, blue = np.moveaxis(shown, 2, 0)
    kidney = (red > green + 20) & (red > blue + 20)
    assert kidney.mean() > 0.03
    margin = (green > red + 30) | ((red > blue + 80) & (green > blue + 80))
    assert margin.mean() > 0.001
    drag = """<script>
        const view = document.querySelector("#viewer canvas");
        view.dispatchEvent(new PointerEvent("pointermove", { buttons: 1, movementX: 120, movementY: 30 }));
        view.dispatchEvent(new WheelEvent("wheel", { deltaY: -400, cancelable: true }));
        </script></body>"""
    turned, console = screenshot(resected.page.replace("</body>", drag), tmp_path, "turned")
    assert console == []
    changed = np.abs(turned[: len(shown)] - shown[: len(turned)]).max(axis=2) > 20
    assert changed.mean() > 0.02


@needs_browser
def test_an_error_on_the_page_is_noticed(resected, tmp_path):
    broken = resected.page.replace('id="model">', 'id="model">AAAA', 1)
    (tmp_path / "broken.html").write_text(broken, "utf-8")
    console = browsed(tmp_path / "broken.html", tmp_path, f"--screenshot={tmp_path / 'broken.png'}")
    assert len(console) == 1


def printed_pages(page: Path, folder: Path) -> int:
    """The number of pages in print."""
    pdf = folder / "page.pdf"
    assert browsed(page, folder, f"--print-to-pdf={pdf}", "--no-pdf-header-footer") == []
    return len(re.findall(rb"/Type\s*/Page\b", pdf.read_bytes()))


@needs_browser
def test_it_prints_on_two_pages_however_much_there_is(resected, tmp_path):
    assert printed_pages(resected.written[0], tmp_path) == 2
    vessels = [dict(tissue="artery", diameter_mm=3.0)] * 4
    less = dict(margin_min_mm=0.2, score_to_tumour_mm=2.5, tumour_seen_percent=53.0, vessels=vessels)
    less["import_warnings"] = ["one"]
    words = "text that is as long as a warning of an import that is not certain of a side and names a place, "
    rows = [("size", words), ("distance", words), ("R.E.N.A.L.", words), ("PADUA", 2 * words)]
    rows += [("estimated", words), ("not known", 2 * words)]
    values = {each.name: np.arange(9.0) for each in QUANTITIES}
    full = page_of(
        title=TITLE,
        model=model_in(resected.page),
        still=picture_of(990, 450),
        ct=picture_of(1210, 470),
        images=[(words, picture_of(480, 640))] * 4,
        resection=resected.figures | less,
        attempts=attempts_of(30, 4, 4.5),
        tumour=rows,
        session=[("duration", "10 s"), ("probe", "one"), ("compression", "1 mm"), ("volume seen", "all")],
        charts=charts(MeasurementCourse(np.arange(9.0), values, [3.0]), 8.0),
        remarks=[2 * words] * 3,
    )
    (tmp_path / "full.html").write_text(full.html(), "utf-8")
    assert printed_pages(tmp_path / "full.html", tmp_path) == 2
    more = page_of(model=model_in(resected.page), tumour=20 * rows)
    (tmp_path / "more.html").write_text(more.html(), "utf-8")
    assert printed_pages(tmp_path / "more.html", tmp_path) > 2
