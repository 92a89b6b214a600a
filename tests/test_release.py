"""What a release says of itself: its version in one place, citation, changelog, licences, and how it is tested elsewhere."""

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

from rehearsal.commands.option_checks import origin_in_words
from version import PROJECT, VERSION

# What a package says of its licence, of those that a program under Apache-2.0 can use.
COMPATIBLE = {
    *("MIT", "MIT License", "MIT-CMU", "0BSD", "Zlib", "CC0-1.0", "PSF-2.0", "MPL-2.0"),
    *("BSD License", "BSD-2-Clause", "BSD-3-Clause", "Apache-2.0", "Apache Software License"),
    *("Python Software Foundation License", "Mozilla Public License 2.0 (MPL 2.0)"),
}
# As libraries of their own.
LESSER = {"pygame-ce": "GNU Library or Lesser General Public License (LGPL)"}
# Their wheels have them, under the GPL and not for commercial use.
NOT_TO_BE_LOADED = r"igl[. ]+(import )?(copyleft|triangle)"


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
    """What make would do, without an environment of ours."""
    if shutil.which("make") is None:
        pytest.skip("no make here")
    command = ["make", "-n", "-B", "--no-print-directory", target, *variables]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_version_is_one(tmp_path):
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION) and f'version = "{VERSION}"' in text("pyproject.toml")
    done = subprocess.run(
        [sys.executable, str(ROOT / "app.py"), "--version"], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, f"nephron, version {VERSION}\n", "")


def test_citation_and_changelog_are_of_this_version():
    released = re.findall(r"^## \[(\d[^]]*)\] - (\d{4}-\d\d-\d\d)$", text("CHANGELOG.md"), re.MULTILINE)
    cited = dict(re.findall(r"^([a-z-]+): (.+)$", text("CITATION.cff"), re.MULTILINE))
    assert released[0] == (VERSION, cited["date-released"]) and cited["version"] == VERSION
    assert cited["license"] == PROJECT["license"]


def test_the_methods_that_the_docs_cite_are_references_of_the_citation():
    references = text("CITATION.cff").partition("\nreferences:\n")[2]
    cited = text("docs/method.md").partition("\n## References\n")[2]
    doi = r"10\.\d{4,}/[^\s)]+"
    assert sorted(re.findall(doi, references)) == sorted(re.findall(doi, cited)) != []
    assert references.count("  - type: ") == len(re.findall(r"^- ", cited, re.MULTILINE))


def test_a_replay_by_another_version_or_on_another_backend_is_told():
    recorded = header()
    assert origin_in_words(recorded, "x64") == ""
    assert "recorded on x64, replayed on cuda" in origin_in_words(recorded, "cuda")
    recorded.version = VERSION
    assert origin_in_words(recorded, "x64") == ""
    recorded.version = "0.9"
    for arch in ("x64", "cuda"):
        assert f"recorded by version 0.9, replayed by {VERSION}" in origin_in_words(recorded, arch)


def test_every_pin_stands_among_the_third_parties_with_its_version():
    table, pins = third_party(), pinned("requirements.txt")
    assert len(pins) > 20 and {name: table[name][0] for name in pins} == pins


def test_what_the_pins_ask_for_stands_there_too():
    # What that brings in turn has no pin, and may be more tomorrow.
    asked = [Requirement(line) for name in pinned("requirements.txt") for line in requires(name) or []]
    now = [each for each in asked if each.marker is None or each.marker.evaluate({"extra": ""})]
    assert len(now) > 30 and {canonicalize_name(each.name) for each in now} <= set(third_party())


def test_every_licence_goes_with_ours_and_has_an_address():
    for name, (_, licence, url) in third_party().items():
        assert LESSER.get(name) == licence or set(re.split(" AND | OR ", licence)) <= COMPATIBLE, name
        assert url.startswith("http"), name


def test_parts_of_libigl_under_the_gpl_are_not_loaded():
    code = "import igl, sys; print(*(name for name in sys.modules if name.startswith('igl.')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["igl.pyigl_core"]
    folders = ("scenes", "sim", "ultrasound", "render", "rehearsal", "studies")
    sources = [ROOT / "app.py", *(path for folder in folders for path in (ROOT / folder).rglob("*.py"))]
    assert len(sources) > 100
    assert not [path for path in sources if re.search(NOT_TO_BE_LOADED, path.read_text("utf-8"))]


def test_other_machines_test_every_python_that_is_supported():
    supported = SpecifierSet(PROJECT["requires-python"])
    every = [f"3.{minor}" for minor in range(8, 30) if f"3.{minor}" in supported]
    matrices = re.findall(r"python: \[(.+)\]", workflow())
    assert [re.findall(r"[\d.]+", each) for each in matrices] == [every, every]
    first, last = (minor.replace(".", ", ") for minor in (every[0], every[-1]))
    assert f"({first}) <= sys.version_info[:2] <= ({last})" in text("Makefile")


def test_other_machines_do_what_a_developer_does():
    used = re.findall(r"uses: (\S+)", workflow())
    assert used and all(re.fullmatch(r"actions/[a-z-]+@v\d+\.\d+\.\d+", each) for each in used)
    assert set(re.findall(r"run: make (\w+)", workflow())) == {"run", "test", "audit"}
    assert text(".ci/run").splitlines()[1:] == ["set -e", 'cd "$(dirname "$0")/.."', "make test"]


@pytest.mark.parametrize("target", ["run", "test", "audit", "licences"])
def test_make_finds_its_programs_on_windows_too(target):
    here, windows = (dry_run(target, f"OS={system}") for system in ("", "Windows_NT"))
    assert "/bin/" in here and "Scripts" not in here
    assert windows == re.sub(r"(\.venv|\.cache/\w+)/bin/", r"\1/Scripts/", here)


def test_audit_asks_for_everything_pinned_and_lets_nothing_unknown_pass():
    audited = next(line for line in dry_run("audit").splitlines() if "pip-audit " in line)
    assert "--strict" in audited and "-r requirements.txt" in text("requirements-dev.txt")
    assert {path.name for path in ROOT.glob("requirements*.txt")} == {
        "requirements.txt",
        *re.findall(r"-r (\S+)", audited),
    }
    assert set(pinned("requirements-release.txt")) == {"pip-audit", "pip-licenses"}
