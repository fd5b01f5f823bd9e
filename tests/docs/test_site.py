"""Documentation site and packaging: pages, drawings, examples of the how-to pages, versions, workflows."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from documents import CHECKOUT, DOCS, blocks

import wrf_mi
from wrf_mi import models
from wrf_mi.apps.checking.scene_findings import KINDS
from wrf_mi.receivers import registry as receivers

WORKFLOWS = sorted((CHECKOUT / ".github" / "workflows").glob("*.yml"))
PINNED = re.compile(r"[\w.-]+/[\w.-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+")


BUILD = """
import sys
import sphinx.ext.viewcode
from sphinx.cmd.build import main
from wrf_mi.apps.table import page

page.table_page = lambda *_: ""
sphinx.ext.viewcode.setup = lambda app: {}
sys.exit(main(sys.argv[1:]))
"""
"""Sphinx without the copies of modules, and without the table of radio fields, which `test_table` draws."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as `make docs-quick` builds it, without executing notebooks; a warning is an error."""
    folder = tmp_path_factory.mktemp("site")
    command = ["-q", "-b", "html", "-W", "--keep-going", "-D", "execute_notebooks=0", str(DOCS), str(folder)]
    done = subprocess.run([sys.executable, "-c", BUILD, *command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def test_site_is_built_without_warnings_and_lists_every_page(site):
    """Sphinx warns of pages without a place in the table of contents, and of links to nothing."""
    front = (site / "index.html").read_text(encoding="utf-8")
    for page in (*DOCS.glob("*.md"), *(DOCS / "howto").glob("*.md")):
        assert f'href="{page.relative_to(DOCS).with_suffix(".html")}"' in front or page.name == "index.md", page.name
    page = (site / "howto" / "mesh.html").read_text(encoding="utf-8")
    kinds = {kind for kind, (level, _) in KINDS.items() if level != "note"}
    assert kinds <= set(re.findall(r'class="pre">([\w-]+)<', page))
    for name in wrf_mi.__all__:
        assert (site / "api" / f"wrf_mi.{name}.html").exists(), name


def test_drawings_are_those_of_their_script():
    sys.path.insert(0, str(DOCS / "_extensions"))
    import stage_drawings

    names = {path.stem for path in stage_drawings.TARGET.glob("*.svg")}
    assert names == set(stage_drawings.DETAILS)
    for name in names:
        stored = (stage_drawings.TARGET / f"{name}.svg").read_text(encoding="utf-8")
        assert stored == stage_drawings.drawing(name), f"{name}: run {stage_drawings.__file__}"


def test_examples_of_how_to_pages_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = set(models.MODELS), set(receivers.RECEIVERS)
    names: dict[str, Any] = {"__name__": "how_to_pages"}
    module = type(sys)("how_to_pages")
    monkeypatch.setitem(sys.modules, "how_to_pages", module)  # where a dataclass looks for its types
    try:
        for page in ("own-data", "own-field", "extend"):
            exec("\n".join(blocks(DOCS / "howto" / f"{page}.md", "python")), names)
        run = wrf_mi.train("office", "nearest", out="run")
        scored_run = wrf_mi.score_predictions("laboratory", "mine.npz", "own", "mine", split="blocked")
        assert scored_run.metrics["n_test"] == 200
        assert wrf_mi.check_data("office").suspicions == ()
        assert wrf_mi.open_run("run").predict([[2.0, 3.0, 1.2]], "kitchen").mean.shape == (1,)
        assert run.metrics["abs_error_db"]["median"] < 5
        kind: Any = receivers.receiver_model("power-pixel", "spectrum")
        form = receivers.ObservationSpec("power-pixel", (4, 8))
        assert kind.of(form, run.record.receivers[0]).how == "power"
        assert names["main"]()["rows"]
        names["test_nearest_is_better_than_a_constant"](tmp_path / "test")
    finally:
        for registry, registered in ((models.MODELS, before[0]), (receivers.RECEIVERS, before[1])):
            for name in set(registry) - registered:
                del registry._known[name]


def test_versions_agree():
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == wrf_mi.__version__
    assert f"## {wrf_mi.__version__}\n" in (DOCS / "changelog.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_have_pinned_actions_few_rights_and_existing_targets(path):
    text = path.read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    assert content["permissions"] == {"contents": "read"}
    targets = re.findall(r"^([a-z-]+):", (CHECKOUT / "Makefile").read_text(), re.MULTILINE)
    for job in content["jobs"].values():
        assert job["timeout-minutes"] > 0
        for step in job["steps"]:
            words = step.get("run", "").split()
            assert not words or words[0] != "make" or set(words[1:]) <= set(targets), step
            assert not words or not words[0].startswith(".ci/") or (CHECKOUT / words[0]).exists(), step
    used = re.findall(r"uses: (.+)$", text, re.MULTILINE)
    assert used
    assert all(PINNED.fullmatch(action) for action in used), used


HOUSE = CHECKOUT / ".github"
FORMS = sorted((HOUSE / "ISSUE_TEMPLATE").glob("*.yml"))


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_issue_forms_have_the_keys_that_github_needs(path):
    """With other keys, or an identifier that is used twice, GitHub does not show the form."""
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert set(form) <= {"name", "description", "title", "labels", "assignees", "projects", "type", "body"}
    assert form["name"]
    assert form["description"]
    identifiers = [field["id"] for field in form["body"]]
    assert len(set(identifiers)) == len(identifiers)
    for field in form["body"]:
        assert field["type"] in {"input", "textarea", "dropdown", "checkboxes"}
        assert field["attributes"]["label"]
    assert any(field.get("validations", {}).get("required") for field in form["body"])


def test_links_of_house_files_lead_to_files():
    for page in HOUSE.glob("*.md"):
        for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
            assert (HOUSE / target).is_file(), f"{page.name}: {target}"


def test_container_has_all_that_the_package_is_built_from():
    text = (HOUSE / "Containerfile").read_text(encoding="utf-8")
    copied = [source for line in re.findall(r"^COPY (.+)$", text, re.MULTILINE) for source in line.split()[:-1]]
    assert all((CHECKOUT / source).exists() for source in copied)
    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    needed = settings["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    needed += ["pyproject.toml", "Makefile", ".ci", settings["project"]["readme"]]
    assert [path for path in needed if not any(Path(path).is_relative_to(source) for source in copied)] == []
