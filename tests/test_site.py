"""docs/site/hooks.py: links between pages and files of the site, numbered equations, docstrings."""

import os
import warnings
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def hooks(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The steps of the build."""
    monkeypatch.syspath_prepend(ROOT / "docs" / "site")
    with warnings.catch_warnings():
        # ziamath finds its font by a function that Python 3.11 calls deprecated.
        warnings.simplefilter("ignore", DeprecationWarning)
        return import_module("hooks")


@pytest.mark.parametrize(
    ("page", "link", "target"),
    [
        ("index.md", "docs/scenario.md", "scenario.md"),
        ("scenario.md", "../README.md", "index.md"),
        ("development/places.md", "../flight.md", "../flight.md"),
        ("development/places.md", "../../CHANGELOG.md", "../changelog.md"),
        ("scenario.md", "../scenarios/paper.toml", "files/scenarios/paper.toml"),
        ("record/results.md", "../images/paper.png", "../images/paper.png"),
        ("scenario.md", "../deploy/hosts.toml", "files/deploy/hosts.toml"),
        ("scenario.md", "https://example.org/README.md", "https://example.org/README.md"),
        ("scenario.md", "mailto:a@example.org", "mailto:a@example.org"),
        ("scenario.md", "no-such-page.md", "no-such-page.md"),
        ("scenario.md", "../../outside.md", "../../outside.md"),
    ],
)
def test_links_are_those_of_the_site(hooks: Any, page: str, link: str, target: str) -> None:
    """Pages of the project are pages, other files copies; an anchor and what is outside the project stay."""
    file = SimpleNamespace(src_uri=page)
    found = hooks.on_page_markdown(f"see [here]({link}#part) now", SimpleNamespace(file=file))
    assert found == f"see [here]({target}#part) now"


def test_a_link_out_of_the_project_stays(hooks: Any, tmp_path: Path) -> None:
    """Also to a file that there is."""
    (tmp_path / "there.md").touch()
    link = os.path.relpath(tmp_path / "there.md", ROOT / "docs")
    assert hooks._target(SimpleNamespace(src_uri="scenario.md"), link) == link


def test_the_site_has_pages_assets_and_files_that_pages_link_to(
    hooks: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From outside docs/, each once; what stands in a block of code is no link."""

    class Files(list[tuple[str, dict[str, Any]]]):
        def documentation_pages(self) -> Any:
            """Return the pages, of which two link to the same file."""
            one = "[a](../scenarios/paper.toml) [b](flight.md)\n```\n[c](../Makefile)\n```\n"
            two = "[a](../../scenarios/paper.toml#x) [d](https://example.org)"
            texts = {"scenario.md": one, "record/results.md": two}
            return [
                SimpleNamespace(src_uri=name, content_string=text) for name, text in texts.items()
            ]

    generated = SimpleNamespace(generated=lambda _config, name, **how: (name, how))
    monkeypatch.setattr(hooks, "File", generated)
    found = dict(hooks.on_files(Files(), None))
    assets = {f"assets/{path.name}" for path in (ROOT / "docs" / "site" / "assets").iterdir()}
    font = f"assets/{hooks.MATH_FONT.name}"
    linked = {"files/scenarios/paper.toml"}
    assert found.keys() == hooks.OUTSIDE.keys() | assets | linked | {font}
    (file,) = linked
    assert found[file] == {"abs_src_path": str(ROOT / "scenarios" / "paper.toml")}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert found["index.md"] == {"content": readme}


def test_an_equation_has_its_number_and_anchor(hooks: Any) -> None:
    """Parts between wide spaces may stand below each other; a formula in a line has neither."""
    page = SimpleNamespace(file=SimpleNamespace(src_uri="equations.md"))
    block = r'<div class="arithmatex">\[ a = b, \qquad c = d \tag{63a} \]</div>'
    made = hooks.on_page_content(block, page)
    assert made.startswith('<div class="equation" id="eq-63a"><div class="formula"><math')
    assert made.endswith('<span class="number">(63a)</span></div>')
    assert made.count("<math") == 2
    inline = hooks.on_page_content(r'with <span class="arithmatex">\(x &lt; y\)</span>.', page)
    assert inline.startswith("with <math")
    assert "&lt;" in inline
    assert "equation" not in inline
    assert "display" in made
    assert "display" not in inline
    aligned = r"\begin{aligned} a &= b \qquad c \\ d &= e \end{aligned}"
    one = hooks.on_page_content(rf'<div class="arithmatex">\[ {aligned} \]</div>', page)
    assert one.startswith('<div class="equation"><div class="formula"><math')
    assert one.count("<math") == 1
    for bar, letter in ((r"\overline{x}", "\u00af"), (r"\underline{x}", "_")):
        drawn = hooks.on_page_content(rf'<span class="arithmatex">\({bar}\)</span>', page)
        assert f">{letter}</mo></m" in drawn
    with pytest.raises(Exception, match=r"equations\.md: expected a formula, got"):
        hooks.on_page_content(r'<span class="arithmatex">\(\unknown{x}\)</span>', page)


def test_docstrings_have_examples_and_short_sections(hooks: Any) -> None:
    """An example becomes a block of code, `Raises: X` a paragraph; a section with lines of its own stays."""
    text = "Return it.\n\n>>> 1 + 1\n2\n\nRaises: ValueError: no.\nArgs:\n    x: A number."
    docstring = SimpleNamespace(value=text)
    hooks.ProjectDocstrings().on_object(obj=SimpleNamespace(docstring=docstring))
    assert "```pycon\n>>> 1 + 1\n2\n```" in docstring.value
    assert "\n\n**Raises:** ValueError: no.\n" in docstring.value
    assert "\nArgs:\n    x: A number." in docstring.value
