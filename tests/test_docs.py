"""The documentation is current, its links lead somewhere, and it builds."""

import re
from pathlib import Path

import processkit
import pytest
from browserkit import said_at

from emb_daemon import __version__
from emb_daemon.cli.main import COMMANDS

_ROOT = Path(__file__).parent.parent
_PAGES = [*sorted(_ROOT.glob("docs/*.md")), _ROOT / "README.md", _ROOT / "CHANGELOG.md"]
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


#: What a reader finds who opens the pages as files, by what is typed: addresses of the results.
_SEARCH = """<script>
(async function () {
  var found = {};
  for (var words of ["resolv", "mapping.yaml", "clamp: force?", "xyzzy"]) {
    document.getElementById("mkdocs-search-query").value = words;
    await searchPages();
    found[words] = Array.from(document.querySelectorAll("#mkdocs-search-results a")).map(a => a.getAttribute("href"));
  }
  document.title = JSON.stringify(found);
})();
</script>"""


def _anchors(path: Path) -> set[str]:
    """Anchors of a page's headings, as Markdown renderers make them."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def _prose(path: Path) -> str:
    return "\n".join(line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("    "))


@pytest.mark.parametrize("script", ["generate.py", "completion.py"])
def test_what_is_generated_is_current(script):
    """Otherwise: python docs/generate.py; python docs/completion.py."""
    result = processkit.python(_ROOT / "docs" / script, "--check")
    assert result.returncode == 0, result.stderr or f"docs/{script} has to be run again"


def test_tests_that_pages_name_exist():
    tests = "\n".join(path.read_text(encoding="utf-8") for path in _ROOT.glob("tests/**/*.py"))
    named = {name for page in _PAGES for name in re.findall(r"\.py::(\w+)|`::(\w+)`", page.read_text(encoding="utf-8"))}
    assert len(named) > 50
    assert not {name for name in map("".join, named) if not re.search(rf"(def|class) {name}\b", tests)}


@pytest.mark.parametrize("page", _PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link in _LINK.findall(_prose(page)):
        if link.startswith(("http://", "https://")):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor:
            assert anchor in _anchors(target), f"{page.name}: {link}"


def test_every_page_is_in_the_navigation():
    navigation = (_ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in _ROOT.glob("docs/*.md"):
        assert page.name in navigation


def test_every_key_of_the_files_has_a_meaning():
    for name in ("calibration.md", "configuration.md", "mapping.md", "campaign.md"):
        rows = [line for line in (_ROOT / "docs" / name).read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
        assert len(rows) > 8 and all(row.split(" | ")[-1].strip(" |") for row in rows)


@pytest.mark.parametrize("page", ["safety.md", "threats.md"])
def test_tests_that_a_promise_names_exist(page):
    """`::test` without a file is of the file named last."""
    file, named = "", 0
    text = (_ROOT / "docs" / page).read_text(encoding="utf-8")
    for path, test in re.findall(r"`(?:tests/)?((?:target/)?test_\w+\.py)?(?:::(\w+(?:::\w+)?))?`", text):
        file, named = path or file, named + 1
        source = (_ROOT / "tests" / file).read_text(encoding="utf-8")
        for word in filter(None, test.split("::")):
            assert re.search(rf"^ *(def|class) {word}\b", source, re.MULTILINE), f"{file}::{test}"
    assert named > 15


def test_every_failure_has_a_test():
    table = (_ROOT / "docs" / "safety.md").read_text(encoding="utf-8").partition("| failure |")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    assert len(rows) > 50
    for row in rows:
        assert len(row) == 4 and re.search(r"`.*(test_|studies/).*`|the same", row[-1]), row[0]


def test_commands_in_the_documentation_exist():
    named = {word for page in _PAGES for word in re.findall(r"\bemb-daemon ([a-z]+)\b", page.read_text(encoding="utf-8"))}
    assert {"monitor", "replay", "diagnose"} <= named <= set(COMMANDS)


def test_the_site_builds(tmp_path):
    pytest.importorskip("mkdocs", reason="NOT RUN: the docs extra is not installed")
    arguments = ["build", "--strict", "--quiet", "--config-file", _ROOT / "mkdocs.yml", "--site-dir", tmp_path / "site"]
    result = processkit.python("-m", "mkdocs", *arguments)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "site" / "calibration.html").is_file()
    found = said_at(tmp_path / "site" / "page.html", (tmp_path / "site" / "index.html").read_text(encoding="utf-8"), _SEARCH)
    assert any(page.startswith("./wire.html") for page in found["resolv"])
    assert any(page.startswith("./mapping.html") for page in found["mapping.yaml"][:3])
    assert found["clamp: force?"] and not found["xyzzy"]


def test_the_changelog_contains_this_version():
    assert f"## {__version__}" in (_ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_every_test_file_has_a_test_that_is_no_trial(request):
    if request.config.option.file_or_dir or request.config.option.keyword:
        pytest.skip("only some of the tests were asked for")
    quick = {item.path for item in request.session.items if "trial" not in item.keywords}
    assert quick == {*_ROOT.glob("tests/test_*.py")}
