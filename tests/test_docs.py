"""README and docs: links, pictures, commands, names in the code and examples are valid."""

import ast
import contextlib
import io
import re
import shlex
import tomllib
from functools import cache
from pathlib import Path
from typing import get_args

import click
import pytest
import taichi as ti
from conftest import ROOT

import app
from rehearsal.loop.command import Recorded
from rehearsal.planning.plan_file import Plan, PlannedSweep
from rehearsal.sessions.session_file import LINES, Header
from rehearsal.tracking.pose_file import load_poses, load_timed_poses
from scenes.import_findings import GridFindings, ImportFindings, ImportWarning, SurfaceFindings
from scenes.scene import Image, Scene, Trocar
from scenes.tissue import NeoHookeanTissue, ShapeMatchingTissue
from ultrasound.probe import Probe

DOCS = ROOT / "docs"
PAGES = (ROOT / "README.md", *sorted(DOCS.glob("*.md")))
FOLDERS = ("docs", "rehearsal", "render", "scenes", "sim", "studies", "tests", "ultrasound")
PICTURES = (".png", ".webp", ".gif", ".jpg", ".svg")
LINK = re.compile(r"\]\(([^)\s]+)\)")
CODE = re.compile(r"`([^`\n]+)`")
# A file, and a name in it: sim/solver.py: Solver.predict
PLACE = re.compile(r"([\w/.-]+\.py): ([\w.]+)")
METHOD = re.compile(r"([A-Z]\w+)\.(\w+)")

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def text(page: Path) -> str:
    return page.read_text("utf-8")


def prose(page: Path) -> str:
    """A page without its fenced and indented blocks."""
    unfenced = re.sub(r"^```.*?^```", "", text(page), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"^ {4}.*$", "", unfenced, flags=re.MULTILINE)


def links(page: Path) -> list[str]:
    return [link for link in LINK.findall(prose(page)) if "://" not in link]


def anchors(page: Path) -> set[str]:
    """The anchors of a page, as GitHub makes them from its headings."""
    headings = re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def example(page: str, language: str) -> str:
    """The only fenced block of a language on a page."""
    (block,) = re.findall(rf"^```{language}\n(.*?)^```", text(DOCS / page), flags=re.DOTALL | re.MULTILINE)
    return block


# Links and pictures


@each_page
def test_link_targets_exist(page):
    for link in links(page):
        name, _, place = link.partition("#")
        target = page.parent / name if name else page
        assert target.is_file(), f"{page.name}: {link}"
        assert not place or place in anchors(target), f"{page.name}: {link}"


def linked(page: Path) -> set[Path]:
    return {(page.parent / link.partition("#")[0]).resolve() for link in links(page)}


def test_every_picture_is_used():
    pictures = {path for path in DOCS.iterdir() if path.suffix in PICTURES}
    assert pictures - set.union(*map(linked, PAGES)) == set()


def test_the_index_links_every_page_and_the_readme_links_the_index():
    assert set(DOCS.glob("*.md")) - linked(DOCS / "README.md") == {DOCS / "README.md"}
    assert DOCS / "README.md" in linked(ROOT / "README.md")


def test_every_example_file_is_named():
    named = "".join(map(text, PAGES))
    assert all(
        f"docs/{path.name}" in named for path in DOCS.iterdir() if path.suffix not in (*PICTURES, ".md")
    )


def test_the_readme_has_its_picture_and_first_commands_before_more():
    headings = re.findall(r"^#+ (.+)$", text(ROOT / "README.md"), flags=re.MULTILINE)
    assert headings[-1] == "More" and len(headings) == len(set(headings))
    before = text(ROOT / "README.md").partition("\n## More\n")[0]
    assert (DOCS / "press.webp").resolve() in linked(ROOT / "README.md")
    for command in ("make run", "make test", "python app.py import", "python app.py rehearse"):
        assert command in before
    assert (DOCS / "press.webp").stat().st_size < 4_000_000


# Commands


def command_lines() -> list[tuple[str, str]]:
    """(page, the arguments of python app.py), from code blocks and text."""
    found = []
    for page in PAGES:
        for line in re.findall(r"python app\.py ?([^`\n]*)", text(page)):
            found.append((page.name, re.split(r"\s+#|\s>\s", line)[0].strip()))
    return found


def command_of(arguments: list[str]) -> tuple[click.Command, list[str]]:
    """The command of a line, and its arguments."""
    command: click.Command = app.cli
    while isinstance(command, click.Group) and arguments and not arguments[0].startswith("-"):
        found = command.get_command(click.Context(command), arguments[0])
        assert found is not None, f"no command {arguments[0]}"
        command, arguments = found, arguments[1:]
    return command, arguments


@cache
def commands() -> list[click.Command]:
    """All commands and groups."""
    found: list[click.Command] = [app.cli]
    for each in found:
        if isinstance(each, click.Group):
            found += [command_of([*_path(each), name])[0] for name in each.list_commands(click.Context(each))]
    return found


def _path(group: click.Group) -> list[str]:
    return [] if group is app.cli else [str(group.name)]


def options(command: click.Command) -> set[str]:
    return {name for each in command.params for name in (*each.opts, *each.secondary_opts)} | {"--help", "-h"}


def test_command_lines_are_valid():
    lines = command_lines()
    assert len(lines) > 40
    for page, line in lines:
        command, arguments = command_of(shlex.split(line))
        try:
            if isinstance(command, click.Group):
                assert set(arguments) <= options(command)
            else:
                command.make_context("", arguments)
        except (click.ClickException, AssertionError) as error:
            pytest.fail(f"{page}: app.py {line}: {error}")


@each_page
def test_options_in_the_text_exist(page):
    known = set.union(*map(options, commands()))
    for code in CODE.findall(prose(page)):
        if re.match(r"(python|pip|make)\b", code):
            continue
        words = code.split()
        named = words[0] in app.COMMANDS
        of = options(command_of([words[0]])[0]) if named else known
        for option in re.findall(r"(?<!\S)--[a-z][\w-]*", code):
            assert option in of, f"{page.name}: {code}"


def test_help_lines_are_not_truncated():
    for each in commands():
        if isinstance(each, click.Group):
            shown = each.get_help(click.Context(each, terminal_width=80))
            assert "..." not in shown.partition("Commands:")[2]
            assert max(map(len, shown.splitlines())) <= 80


# Names in the code


@cache
def names_in(file: Path) -> frozenset[str]:
    """Functions, classes and methods of a source file."""
    names = set()
    for node in ast.parse(text(file)).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{each.name}" for each in node.body if isinstance(each, ast.FunctionDef)}
    return frozenset(names)


@each_page
def test_named_files_and_folders_exist(page):
    # A file named in a heading is made by following the page.
    made = {
        name
        for heading in re.findall(r"^#.*$", prose(page), flags=re.MULTILINE)
        for name in CODE.findall(heading)
    }
    for code in CODE.findall(prose(page)):
        name = code.split(":")[0]
        if name.partition("/")[0] in FOLDERS and "/" in name and " " not in name and name not in made:
            assert (ROOT / name).exists(), f"{page.name}: {code}"


@each_page
def test_named_functions_and_classes_exist(page):
    named = CODE.findall(prose(page))
    for file, name in (found.groups() for code in named if (found := PLACE.fullmatch(code))):
        assert name in names_in(ROOT / file), f"{page.name}: {file}: {name}"
    methods = {
        name for folder in FOLDERS for file in (ROOT / folder).rglob("*.py") for name in names_in(file)
    }
    for code in named:
        assert not METHOD.fullmatch(code) or code in methods, f"{page.name}: {code}"


def test_the_method_names_its_functions():
    assert len(PLACE.findall(text(DOCS / "method.md"))) > 20


def test_the_index_answers_where_is_with_a_file_and_a_function():
    answers = text(DOCS / "README.md").partition("## Where is ...")[2]
    for subject in ("friction law", "key press", "caliper", "DICOM series", "tumour"):
        (*_, last) = [row for row in answers.splitlines() if subject in row] or [""]
        assert PLACE.search(last), subject


# Examples and formats


def test_the_example_of_a_probe_is_valid():
    probe = Probe.model_validate(tomllib.loads(example("adding-a-probe.md", "toml")))
    assert probe.housing_mm[0] >= probe.transducer_width_mm


def test_the_example_of_a_scene_is_valid():
    scene = Scene.model_validate(tomllib.loads(example("adding-a-tool.md", "toml")))
    assert [shape.kind for shape in scene.shape] == ["mesh", "plane"]


def test_the_example_of_a_tool_presses_tissue():
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            exec(compile(example("adding-a-tool.md", "python"), "rod.py", "exec"), {})
    finally:
        ti.reset()
    depth_mm = float(re.findall(r"at most ([\d.]+) mm", printed.getvalue())[0])
    # The tissue is in contact, with at most a few times the depth at which the pressure equals Young's
    # modulus.
    assert 0.01 < depth_mm < 0.5


def test_the_notices_that_the_docs_explain_are_those_of_the_window():
    sources = "".join(
        text(file) for folder in ("rehearsal", "render") for file in (ROOT / folder).rglob("*.py")
    )
    explained = set(re.findall(r"\*([A-Z]+(?: [A-Z]+)+)\*", "".join(map(text, DOCS.glob("*.md")))))
    assert len(explained) >= 3
    for notice in explained:
        assert f'"{notice}' in sources, notice


def test_the_coupling_gap_in_the_docs_is_the_default():
    named = f"`image.contact_gap_mm` of the scene ({Image().contact_gap_mm} mm)"
    assert named in " ".join(text(DOCS / "ultrasound.md").split())


def test_the_example_poses_can_be_read():
    assert len(load_poses(DOCS / "poses.json")) == 3
    press = load_timed_poses(DOCS / "press.json")
    assert press.length_s == 4.0
    # First and last pose are the same, so that the animation loops without a jump.
    assert (press.poses[0] == press.poses[-1]).all()


def section(heading: str) -> set[str]:
    """The names in code of one section of the page on formats."""
    part = re.split(rf"^## {heading}$", text(DOCS / "data-formats.md"), flags=re.MULTILINE)[1]
    return set(CODE.findall(part.partition("\n## ")[0]))


@pytest.mark.parametrize(
    ("heading", "models"),
    [
        ("Scene", [NeoHookeanTissue, ShapeMatchingTissue, Trocar]),
        ("Session", [Header, *LINES.values(), *get_args(Recorded)]),
        ("Plan", [Plan, PlannedSweep]),
        ("Findings of an import", [ImportFindings, ImportWarning, GridFindings, SurfaceFindings]),
    ],
)
def test_data_formats_list_every_key(heading, models):
    keys = {key for model in models for key, field in model.model_fields.items() if not field.exclude}
    if heading == "Scene":
        keys |= {"title"}
        for name, field in Scene.model_fields.items():
            keys |= set(getattr(field.annotation, "model_fields", {}))
            assert name in ("nephron_scene", "title", "shape", "uncertainty") or f"[{name}]" in section(
                heading
            )
    assert keys <= section(heading), keys - section(heading)
