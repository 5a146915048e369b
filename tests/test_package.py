# SPDX-License-Identifier: Apache-2.0
"""The package as others get it: sdist, wheel made of it, a new environment, another folder."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from email import message_from_bytes
from email.message import Message
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path

import pytest
import yaml
from markdown_it import MarkdownIt
from packaging.requirements import Requirement

import ohmskin
from places import ROOT

# The view needs the extra of its name.
IMPORT_ALL = """
import importlib, pkgutil, ohmskin
for module in pkgutil.walk_packages(ohmskin.__path__, "ohmskin."):
    if not module.name.startswith(("ohmskin.view.", "ohmskin.cli.view", "ohmskin.__main__")):
        importlib.import_module(module.name)
assert (ohmskin.cli.board._FIRMWARE / "uno.hex").is_file()
"""


BUILD = (sys.executable, "-m", "hatchling", "build", "-d")


def run(*command: str | Path, place: Path, **variables: str) -> str:
    # Nothing of this checkout, nor of this environment, may help.
    foreign = ("PYTHON", "OHMSKIN")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=place,
        env=kept | variables,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def link_requirements(of: Distribution, place: Path) -> None:
    """Link what a package needs, and what that needs, from this environment into another."""
    for text in of.requires or []:
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            needed = distribution(requirement.name)
            for name in {file.parts[0] for file in needed.files or []} - {".."}:
                if not (place / name).exists():
                    (place / name).symlink_to(needed.locate_file(name))
            link_requirements(needed, place)


def metadata_of_wheel(place: Path, source: Path, url: str | None) -> Message:
    """Of a wheel that is built of `source` with OHMSKIN_URL."""
    variables = {} if url is None else {"OHMSKIN_URL": url}
    run(*BUILD, place, "-t", "wheel", place=source, **variables)
    (wheel,) = place.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        return message_from_bytes(archive.read(name))


def body(metadata: Message) -> str:
    described = metadata.get_payload(decode=True)
    assert isinstance(described, bytes)
    return described.decode()


def links_of(markdown: str) -> list[str]:
    """Addresses of links and pictures, as a parser that is not ours sees them."""
    tokens = MarkdownIt().enable("table").parse(markdown)
    inside = [token for each in tokens for token in each.children or ()]
    both = [token.attrs.get("href") or token.attrs.get("src") for token in inside]
    return [str(link) for link in both if link]


def test_without_an_address_the_readme_is_packaged_as_it_is(tmp_path: Path) -> None:
    readme = (ROOT / "README.md").read_text()
    for number, url in enumerate((None, "")):
        metadata = metadata_of_wheel(tmp_path / str(number), ROOT, url)
        assert body(metadata).strip() == readme.strip()
        assert metadata["Description-Content-Type"] == "text/markdown"
        assert metadata.get_all("Project-URL") is None
        assert metadata.get_all("Dynamic") is None


def test_with_an_address_all_links_are_below_it_and_lead_to_files(tmp_path: Path) -> None:
    url = "https://example.org/ohmskin"
    readme = (ROOT / "README.md").read_text()
    metadata = metadata_of_wheel(tmp_path, ROOT, f"{url}/")
    before, after = links_of(readme), links_of(body(metadata))
    assert len(before) > 20
    assert after == [f"{url}/{link}" for link in before]
    assert all((ROOT / link).is_file() for link in before)
    assert metadata.get_all("Project-URL") == [
        f"Homepage, {url}",
        f"Documentation, {url}/docs",
        f"Source, {url}",
        f"Issues, {url}/issues",
        f"Changelog, {url}/CHANGELOG.md",
    ]
    assert metadata.get_all("Dynamic") is None


def test_an_address_that_is_none_is_refused(tmp_path: Path) -> None:
    build = (*BUILD, tmp_path, "-t", "wheel")
    for url in ("example.org/ohmskin", "ftp://example.org", "https://a b"):
        variables = {**os.environ, "OHMSKIN_URL": url}
        done = subprocess.run(build, cwd=ROOT, env=variables, capture_output=True, text=True)
        assert done.returncode != 0
        assert "OHMSKIN_URL is" in done.stderr
        assert "unset it" in done.stderr
    assert not list(tmp_path.iterdir())


def test_what_repeats_the_version_says_that_of_the_package() -> None:
    """Package, firmware and emulated boards take it from host/ohmskin/version.py."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == ohmskin.__version__
    newest = re.search(r"^## (\S+), ", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None
    assert newest[1] == ohmskin.__version__
    for page in sorted((ROOT / "docs").glob("*.md")):
        said = re.findall(r"\bfirmware (\d+\.\d+\.\d+)", page.read_text())
        assert set(said) <= {ohmskin.__version__}, page.name


def test_the_citation_names_the_package_and_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (citation["title"], citation["license"]) == ("ohmskin", "Apache-2.0")
    (paper,) = citation["references"]
    assert paper["title"] in " ".join((ROOT / "docs/paper.md").read_text().replace("*", "").split())
    assert [author["family-names"] for author in paper["authors"]] == ["Su", "Wu", "Wen", "Liu"]


def test_sdist_and_wheel_run_the_demo_with_what_they_require_alone(tmp_path: Path) -> None:
    run(*BUILD, tmp_path, "-t", "sdist", place=ROOT)
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
        archive.extractall(tmp_path, filter="data")
    for needed in (
        *("firmware/src/main.cpp", "protocol/frames.toml", "platformio.ini", "Makefile"),
        *("tests/data/README.md", "docs/calibrate.md", "tools/setup.sh", "LICENSE", "CITATION.cff"),
        ".github/ISSUE_TEMPLATE/bug.md",
    ):
        assert needed in names
    source = tmp_path / sdist.name.removesuffix(".tar.gz")
    (source / "host/ohmskin/firmware").mkdir()  # as `make wheel` does
    (source / "host/ohmskin/firmware/uno.hex").touch()
    run(*BUILD, tmp_path, "-t", "wheel", place=source)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        packed = archive.namelist()
    assert {"ohmskin/protocol/frames.toml", "ohmskin/protocol/layouts/2FED.toml"} <= set(packed)
    assert "ohmskin/view/page/index.html" in packed
    assert not any(name.startswith(("tests/", "docs/", "firmware/")) for name in packed)

    place = tmp_path / "new"
    venv.create(place)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", place)
    run(*pip, "install", "-q", "--no-deps", "--no-index", wheel, place=tmp_path)
    (packages,) = place.glob("lib/python*/site-packages")
    (installed,) = distributions(name="ohmskin", path=[str(packages)])
    link_requirements(installed, packages)
    binaries = place / "bin"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    out = run(binaries / "ohmskin", "demo", "--seconds", "1", place=elsewhere)
    assert "no ghost" in out
    assert "0 missed, 0 damaged" in out
    run(binaries / "python", "-c", IMPORT_ALL, place=elsewhere)


def test_make_setup_installs_files_that_are_known() -> None:
    """Each by version and hash; what the host needs is among what development needs."""
    pins = {}
    for name in ("host", "all", "avr-gcc"):
        text = (ROOT / f"tools/pins/{name}.txt").read_text().replace("\\\n", "")
        lines = [line for line in text.splitlines() if not line.startswith("#")]
        assert all(re.match(r"\S+==[^\s*]+ .*--hash=sha256:[0-9a-f]{64}", line) for line in lines)
        pins[name] = dict(line.split()[0].split("==") for line in lines)
    assert pins["host"].items() <= pins["all"].items()
    for text in distribution("ohmskin").requires or []:
        requirement = Requirement(text)
        if requirement.name != "ohmskin":
            assert requirement.specifier.contains(pins["all"][requirement.name])
    assert not re.findall(r"platform = .*[\^~>*]", (ROOT / "platformio.ini").read_text())


@pytest.mark.parametrize(
    ("told", "code"), [({}, 0), ({"CI": "true"}, 1), ({"OHMSKIN_NO_SKIP": "1"}, 1)]
)
def test_no_integration_is_left_out_in_silence(told: dict[str, str], code: int) -> None:
    """Where there is no Python 3.12, which ROS 2 needs."""
    nowhere = {"PATH": "/nowhere", "HOME": "/nowhere"}
    command = [shutil.which("bash") or "bash", ROOT / "tools" / "test_world.sh", "ros2"]
    done = subprocess.run(command, capture_output=True, text=True, env=nowhere | told, cwd=ROOT)
    assert done.returncode == code
    assert "test-world: ros2: 0 passed: needs Python 3.12" in done.stdout
