"""A release: one version, citation, changelog, licences of the libraries, and the tests on other machines."""

import re
import shutil
import subprocess
import sys
from importlib.metadata import requires

import pytest
from conftest import ROOT
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from test_session import header

from rehearsal.run import replay_warning
from rehearsal.sessions.session_file import SESSION_FORMAT
from scenes.scene import AnatomyFiles, Scene, scene_text
from version import FORMAT, PROJECT, VERSION

# Licences that a program under Apache-2.0 can use, as packages name them.
COMPATIBLE_LICENCES = {
    *("MIT", "MIT License", "MIT-CMU", "0BSD", "Zlib", "CC0-1.0", "PSF-2.0", "MPL-2.0"),
    *("BSD License", "BSD-2-Clause", "BSD-3-Clause", "Apache-2.0", "Apache Software License"),
    *("Python Software Foundation License", "Mozilla Public License 2.0 (MPL 2.0)"),
}
# LGPL: used as a separate library.
LGPL_PACKAGES = {"pygame-ce": "GNU Library or Lesser General Public License (LGPL)"}
# Parts of the igl wheel under the GPL or not for commercial use.
FORBIDDEN_IMPORTS = r"igl[. ]+(import )?(copyleft|triangle)"


def text(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


def pinned(name: str) -> dict[str, str]:
    """The version of each package in a file of requirements."""
    pins = [line.split("==") for line in text(name).splitlines() if re.match(r"[A-Za-z]", line)]
    return {canonicalize_name(package): version for package, version in pins}


def third_party() -> dict[str, tuple[str, str, str]]:
    """Version, licence and address of each package in the table of THIRD_PARTY.md."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text("THIRD_PARTY.md").splitlines()]
    table = [row for row in rows if len(row) == 4][2:]
    return {canonicalize_name(name): (version, licence, url) for name, version, licence, url in table}


def workflow() -> str:
    return text(".github/workflows/test.yml")


def dry_run(target: str, *variables: str) -> str:
    """The commands that make would run, for an environment that does not exist."""
    if shutil.which("make") is None:
        pytest.skip("no make here")
    command = ["make", "-n", "-B", "--no-print-directory", target, *variables]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_version_is_the_same_everywhere(tmp_path):
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION) and f'version = "{VERSION}"' in text("pyproject.toml")
    done = subprocess.run(
        [sys.executable, str(ROOT / "app.py"), "--version"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, f"nephron, version {VERSION}\n", "")


def test_files_have_the_format_of_the_major_version():
    written = scene_text(Scene(anatomy=AnatomyFiles(phantom=True))), header().model_dump_json()
    assert f"{FORMAT}." == VERSION[:2] and f"nephron_scene = {FORMAT}\n" in written[0]
    # Sessions are those of the next one.
    assert SESSION_FORMAT == FORMAT + 1 and f'"nephron_session":{SESSION_FORMAT},' in written[1]


def test_citation_and_changelog_have_this_version():
    released = re.findall(r"^## \[(\d[^]]*)\] - (\d{4}-\d\d-\d\d)$", text("CHANGELOG.md"), re.MULTILINE)
    cited = dict(re.findall(r"^([a-z-]+): (.+)$", text("CITATION.cff"), re.MULTILINE))
    assert released[0] == (VERSION, cited["date-released"]) and cited["version"] == VERSION
    assert cited["license"] == PROJECT["license"]


def test_the_citation_has_the_references_of_the_method():
    references = text("CITATION.cff").partition("\nreferences:\n")[2]
    cited = text("docs/method.md").partition("\n## References\n")[2]
    doi = r"10\.\d{4,}/[^\s)]+"
    assert sorted(re.findall(doi, references)) == sorted(re.findall(doi, cited)) != []
    assert references.count("  - type: ") == len(re.findall(r"^- ", cited, re.MULTILINE))


def test_a_replay_by_another_version_or_on_another_backend_is_reported():
    recorded = header()
    assert replay_warning(recorded, "x64") == ""
    assert "recorded on x64, replayed on cuda" in replay_warning(recorded, "cuda")
    recorded.version = VERSION
    assert replay_warning(recorded, "x64") == ""
    recorded.version = "0.9"
    for arch in ("x64", "cuda"):
        assert f"recorded by version 0.9, replayed by {VERSION}" in replay_warning(recorded, arch)


def test_third_party_list_has_every_pinned_package_with_its_version():
    table, pins = third_party(), pinned("requirements.txt")
    assert len(pins) > 20 and {name: table[name][0] for name in pins} == pins


def test_third_party_list_has_the_dependencies_of_the_pinned_packages():
    # Their own dependencies are not pinned and can change.
    asked = [Requirement(line) for name in pinned("requirements.txt") for line in requires(name) or []]
    now = [each for each in asked if each.marker is None or each.marker.evaluate({"extra": ""})]
    assert len(now) > 30 and {canonicalize_name(each.name) for each in now} <= set(third_party())


def test_every_licence_is_compatible_and_has_an_address():
    for name, (_, licence, url) in third_party().items():
        assert (
            LGPL_PACKAGES.get(name) == licence or set(re.split(" AND | OR ", licence)) <= COMPATIBLE_LICENCES
        ), name
        assert url.startswith("http"), name


def test_gpl_parts_of_libigl_are_not_loaded():
    code = "import igl, sys; print(*(name for name in sys.modules if name.startswith('igl.')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["igl.pyigl_core"]
    folders = ("scenes", "sim", "ultrasound", "render", "rehearsal", "studies")
    sources = [ROOT / "app.py", *(path for folder in folders for path in (ROOT / folder).rglob("*.py"))]
    assert len(sources) > 100
    assert not [path for path in sources if re.search(FORBIDDEN_IMPORTS, path.read_text("utf-8"))]


def test_ci_tests_every_supported_python():
    supported = SpecifierSet(PROJECT["requires-python"])
    every = [f"3.{minor}" for minor in range(8, 30) if f"3.{minor}" in supported]
    matrices = re.findall(r"python: \[(.+)\]", workflow())
    assert [re.findall(r"[\d.]+", each) for each in matrices] == [every, every]
    first, last = (minor.replace(".", ", ") for minor in (every[0], every[-1]))
    assert f"({first}) <= sys.version_info[:2] <= ({last})" in text("Makefile")


def test_ci_runs_the_same_commands_as_a_developer():
    used = re.findall(r"uses: (\S+)", workflow())
    assert used and all(re.fullmatch(r"actions/[a-z-]+@v\d+\.\d+\.\d+", each) for each in used)
    assert set(re.findall(r"run: make (\w+)", workflow())) == {"run", "test", "audit"}
    assert text(".ci/run").splitlines()[1:] == ["set -e", 'cd "$(dirname "$0")/.."', "make test"]


@pytest.mark.parametrize("target", ["run", "test", "audit", "licences"])
def test_make_uses_the_paths_of_windows(target):
    here, windows = (dry_run(target, f"OS={system}") for system in ("", "Windows_NT"))
    assert "/bin/" in here and "Scripts" not in here
    assert windows == re.sub(r"(\.venv|\.cache/\w+)/bin/", r"\1/Scripts/", here)


def test_audit_covers_every_requirements_file_and_is_strict():
    audited = next(line for line in dry_run("audit").splitlines() if "pip-audit " in line)
    assert "--strict" in audited and "-r requirements.txt" in text("requirements-dev.txt")
    assert {path.name for path in ROOT.glob("requirements*.txt")} == {
        "requirements.txt",
        *re.findall(r"-r (\S+)", audited),
    }
    assert set(pinned("requirements-release.txt")) == {"pip-audit", "pip-licenses"}
