"""What a package index, a citation manager and a newcomer read: one version, one address."""

import os
import re
import shutil
import subprocess
import tomllib
from importlib.metadata import version
from pathlib import Path

import yaml

import shapepose_fg

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
WORKFLOW = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))


def test_the_version_is_that_of_the_installed_package():
    assert shapepose_fg.__version__ == version("shapepose-fg")
    assert "__version__" in dir(shapepose_fg)
    assert CITATION["version"] == PROJECT["version"]


def test_every_address_is_in_the_same_repository():
    repository = PROJECT["urls"]["Repository"]
    assert CITATION["repository-code"] == repository
    assert all(url.startswith(repository) for url in PROJECT["urls"].values())
    assert f"git clone {repository} " in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_the_citation_has_what_the_format_requires():
    assert {"cff-version", "message", "title", "authors"} <= CITATION.keys()
    paper = CITATION["references"][0]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert paper["title"] in readme
    assert all(f"{who['family-names']}, {who['given-names']}" in readme for who in paper["authors"])


def step(word: str, folder: Path, tag: str, repository: str) -> int:
    """Exit code of the release's step whose commands contain a word, run in a folder."""
    (found,) = [each["run"] for each in WORKFLOW["jobs"]["build"]["steps"] if word in str(each)]
    names = {"GITHUB_SERVER_URL": "https://github.com", "GITHUB_REPOSITORY": repository}
    environment = {**os.environ, **names, "GITHUB_REF_NAME": tag}
    command = ["bash", "-ec", found]
    return subprocess.run(command, cwd=folder, env=environment, check=False).returncode


def test_only_the_version_of_the_tag_is_published_and_only_from_its_own_repository():
    tag, own = f"v{PROJECT['version']}", PROJECT["urls"]["Repository"].split("/", 3)[3]
    assert step("grep -qx", ROOT, tag, own) == 0
    assert step("grep -qx", ROOT, "v99.0", own) != 0
    assert step("grep -qx", ROOT, tag, "somebody/else") != 0


def test_links_of_the_published_readme_need_no_other_file(tmp_path):
    shutil.copy(ROOT / "README.md", tmp_path)
    where = PROJECT["urls"]["Repository"].split("/", 3)[3]
    assert step("sed -i", tmp_path, "v0.1.0", where) == 0
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    before = (ROOT / "README.md").read_text(encoding="utf-8")
    links, old = (re.findall(r"(!?)\[[^]]*\]\(([^)]*)\)", each) for each in (text, before))
    assert len(links) == len(old) > 20
    for (picture, link), (_, as_it_was) in zip(links, old, strict=True):
        kind = "raw" if picture else "blob"
        external = as_it_was.startswith(("#", "https://"))
        there = f"https://github.com/{where}/{kind}/v0.1.0/{as_it_was}"
        assert link == (as_it_was if external else there)


def test_a_release_is_tested_before_it_is_published_without_a_token():
    jobs = WORKFLOW["jobs"]
    said = [step.get("run", "") for step in jobs["build"]["steps"]]
    assert any("make test" in line for line in said)
    assert any("check_package.py" in line for line in said)
    assert jobs["publish"]["needs"] == "build"
    assert jobs["publish"]["permissions"] == {"id-token": "write"}
    assert "secrets." not in (ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8")


def test_the_tests_that_ci_names_exist():
    """With several processes pytest runs nothing if a path is gone, and does not name it."""
    text = (ROOT / ".ci/run").read_text("utf-8")
    folders = [
        each for names in re.findall(r"tests/\{([\w,]+)\}", text) for each in names.split(",")
    ]
    named = re.findall(r"tests/\w[\w/.]*", text) + [f"tests/{each}" for each in folders]
    assert len(named) > 10
    assert [each for each in named if not (ROOT / each).exists()] == []
