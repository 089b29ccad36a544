"""The site: built without warnings, readable from a folder, without any address on the network, and searchable."""

import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

from tests.support.browser import browser, needs_browser
from tests.support.commands import wait_for

ROOT = Path(__file__).resolve().parents[2]
BUILD_LIMIT_S = 60.0  # processor time: a busy machine takes longer by the clock

pytestmark = pytest.mark.slow

# What the browser loads by itself, by tag; a link (`a`) is not loaded.
LOADED = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "link": "href",
    "object": "data",
}
CSS_ADDRESS = re.compile(r"(?:url\(\s*['\"]?|@import\s+['\"])([^'\")\s]+)")
# Builds the site and prints the processor time.
BUILD = """
import resource, sys
from mkdocs.commands.build import build
from mkdocs.config import load_config
import logging
class Count(logging.Handler):
    texts = []
    def emit(self, record):
        self.texts.append(record.getMessage())
        print(record.getMessage(), file=sys.stderr)
logging.getLogger("mkdocs").addHandler(count := Count(logging.WARNING))
build(load_config("mkdocs.yml", site_dir=sys.argv[1], strict=True))
used = resource.getrusage(resource.RUSAGE_SELF)
import json
print(json.dumps({"cpu_s": used.ru_utime + used.ru_stime, "warnings": count.texts}))
"""


class Page(HTMLParser):
    """Addresses and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the addresses and the anchor of a tag."""
        given = dict(attrs)
        if (name := given.get("id")) is not None:
            self.anchors.add(name)
        if (
            tag in LOADED
            and (address := given.get(LOADED[tag]))
            and given.get("rel") != "canonical"
        ):
            self.loaded.append(address)
        if tag == "a" and (address := given.get("href")):
            self.links.append(address)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site once."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(folder)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={"PATH": "/nowhere", "NO_MKDOCS_2_WARNING": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["warnings"] == []
    assert report["cpu_s"] < BUILD_LIMIT_S
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    """Read all pages."""
    return {path: Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}


def test_every_document_is_a_page(site: Path, pages: dict[Path, Page]) -> None:
    """Each document of docs/ has a page, in the navigation; formulas are converted."""
    documents = {
        path.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        for path in (ROOT / "docs").rglob("*.md")
        if "site" not in path.parts
    }
    names = {path.relative_to(site).as_posix() for path in pages}
    assert {*documents, "index.html", "changelog.html"} <= names
    index = {urlparse(link).path for link in pages[site / "index.html"].links}
    assert documents <= index
    equations = [page.read_text(encoding="utf-8") for page in (site / "equations").glob("*.html")]
    assert sum(page.count("<math") for page in equations) > 300
    assert not any("\\(" in page for page in equations)


def test_nothing_is_loaded_from_the_network(site: Path, pages: dict[Path, Page]) -> None:
    """Pages and style sheets load only files of the site that exist."""
    found = [(path, address) for path, page in pages.items() for address in page.loaded]
    for sheet in site.rglob("*.css"):
        found += [
            (sheet, address) for address in CSS_ADDRESS.findall(sheet.read_text(encoding="utf-8"))
        ]
    assert len(found) > 100
    for path, address in found:
        parts = urlparse(address)
        if parts.scheme == "data" or address.startswith("#"):
            continue
        assert not parts.scheme, f"{path.name} loads {address}"
        assert not parts.netloc, f"{path.name} loads {address}"
        if path.name != "404.html":  # made for a server's root
            assert (path.parent / unquote(parts.path)).exists(), f"{path.name} loads {address}"


def test_links_lead_somewhere(site: Path, pages: dict[Path, Page]) -> None:
    """Links within the site lead to a file of it, and to an anchor of that page."""
    count = 0
    for path, page in pages.items():
        if path.name == "404.html":
            continue
        for address in page.links:
            parts = urlparse(address)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert target.exists(), f"{path.name} links to {address}"
            if parts.fragment and target in pages:
                assert unquote(parts.fragment) in pages[target].anchors | {"__"}, (
                    f"{path.name} links to {address}"
                )
            count += 1
    assert count > 1000


# Texts of formulas with marks of LaTeX, and equations whose box is smaller than their formula.
UNCONVERTED = r"""return [...document.querySelectorAll('math')].map((math) => math.textContent)
    .filter((text) => /[&\\\\\u0332]/.test(text))"""
CUT = """return [...document.querySelectorAll('.equation')].filter((equation) => {
    const boxes = [equation, ...equation.querySelectorAll('.formula')];
    return boxes.some((box) => box.scrollWidth > box.clientWidth || box.scrollHeight > box.clientHeight);
}).map((equation) => equation.id)"""
COUNT = "return document.querySelectorAll('.equation').length"


@needs_browser
def test_equations_are_drawn_whole(site: Path) -> None:
    """Every equation fits into its page, without scroll bars, and none has marks of LaTeX.

    They are drawn with the font of the site, which has brackets of any height.
    """
    with browser() as opened:
        opened.driver.set_window_size(1400, 900)
        for source in sorted((ROOT / "docs" / "equations").glob("*.md")):
            opened.driver.get((site / "equations" / f"{source.stem}.html").as_uri())
            assert wait_for(
                lambda: opened.driver.execute_script("return document.fonts.check('16px Formulas')")
            )
            count = source.read_text(encoding="utf-8").count("$$") / 2
            assert opened.driver.execute_script(COUNT) == count, source
            assert opened.driver.execute_script(UNCONVERTED) == [], source
            assert opened.driver.execute_script(CUT) == [], source


@needs_browser
def test_search_from_a_folder(site: Path) -> None:
    """The search finds "relaxation" in a page opened as a file.

    Nothing is requested, the console has no error.
    """
    with browser() as opened:
        opened.console()
        opened.driver.set_window_size(1400, 900)  # a narrow page hides the field behind a button
        opened.driver.get((site / "index.html").as_uri())
        field = opened.driver.find_element("css selector", "input[data-md-component=search-query]")
        assert wait_for(field.is_displayed)
        # Pasted: a busy browser also searches for the first letters of what is typed, and warns
        # that they are too few.
        opened.driver.execute_script("arguments[0].value = 'relaxation'", field)
        field.click()

        def results() -> list[str]:
            found = opened.driver.find_elements("css selector", ".md-search-result__item a")
            return [str(link.get_attribute("href")) for link in found]

        assert wait_for(lambda: any("keys.html" in link for link in results())), results()
        assert opened.hosts() == set()
        assert opened.console() == []
