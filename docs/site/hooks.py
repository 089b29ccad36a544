"""Steps of the site's build beside those of MkDocs.

README.md, CHANGELOG.md and SECURITY.md become pages, files outside docs/ that a page links to are
copied into the site, equations become MathML, which browsers draw themselves. A page that cannot be
converted ends the build.
"""

import html
import posixpath
import re
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import ziamath
from griffe import Extension, Object
from math_core import LatexError, LatexToMathML
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent.parent
# Pages made of other files, by their name in the site; links in these files start at the root of
# the project.
OUTSIDE = {
    "index.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "security.md": "SECURITY.md",
    "python-reference.md": "docs/site/python-reference.md",
}
FILES = "files/"  # copies of files outside docs/ that pages link to
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
# Formulas as the Markdown extension arithmatex leaves them.
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
CONVERTER = LatexToMathML()
# Browsers draw the combining line of bars above and below beside their letter.
BARS = re.compile(r"(<mo[^>]*>)\u0332(</mo></munder>|</mo></mover>)")
BAR_OF = {"</mo></munder>": "_", "</mo></mover>": "\u00af"}
# Few systems have a font with the tables for mathematics, without which brackets stay small.
MATH_FONT = Path(ziamath.__file__).parent / "fonts" / "STIXTwoMath-Regular.ttf"
TAG = re.compile(r"\\tag\{(\w+)\}")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages from outside docs/, the site's own style and script, and files that pages link to."""
    for name, source in OUTSIDE.items():
        files.append(
            File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8"))
        )
    for asset in sorted((FOLDER / "assets").iterdir()):
        files.append(File.generated(config, f"assets/{asset.name}", abs_src_path=str(asset)))
    files.append(File.generated(config, f"assets/{MATH_FONT.name}", abs_src_path=str(MATH_FONT)))
    linked = set()
    for file in files.documentation_pages():
        folder = PurePosixPath(file.src_uri).parent
        linked |= {
            posixpath.normpath(folder / _target(file, found[2]))
            for found in LINK.finditer(FENCE.sub("", file.content_string))
        }
    for target in sorted(target for target in linked if target.startswith(FILES)):
        files.append(
            File.generated(config, target, abs_src_path=str(ROOT / target.removeprefix(FILES)))
        )
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Point links at the files of the site."""
    return LINK.sub(lambda found: f"{found[1]}{_target(page.file, found[2])}{found[3]}", markdown)


def _target(file: File, target: str) -> str:
    """Return a link as the site needs it, relative to its page; copies of other files are in files/."""
    folder = PurePosixPath(file.src_uri).parent
    path = (ROOT / ("." if file.src_uri in OUTSIDE else "docs" / folder) / target).resolve()
    if not path.is_file() or not path.is_relative_to(ROOT):  # such as an address
        return target
    own = path.relative_to(ROOT).as_posix()
    for name, source in OUTSIDE.items():
        if own == source:
            return _relative(name, folder)
    is_inside = own.startswith("docs/images/") or (own.startswith("docs/") and path.suffix == ".md")
    return _relative(own.removeprefix("docs/") if is_inside else f"{FILES}{own}", folder)


def _relative(name: str, folder: PurePosixPath) -> str:
    """Return a file of the site as seen from a folder of it."""
    return posixpath.relpath(name, folder)


def on_page_content(page_html: str, page: Page, **_: object) -> str:
    """Convert formulas to MathML, numbered ones with their number and an anchor."""
    return FORMULA.sub(partial(_converted, page.file.src_uri), page_html)


def _converted(source: str, match: re.Match[str]) -> str:
    """Return the MathML of a formula on the page of a source file."""
    is_block = match[1] == "div"
    formula = html.unescape(match[2]).strip()
    if not is_block:
        return _mathml(source, formula, is_block=False)

    tag = TAG.search(formula)
    parts = "".join(
        _mathml(source, part, is_block=True) for part in _parts(TAG.sub("", formula).strip())
    )
    anchor = f' id="eq-{tag[1]}"' if tag else ""
    number = f'<span class="number">({tag[1]})</span>' if tag else ""
    return f'<div class="equation"{anchor}><div class="formula">{parts}</div>{number}</div>'


def _parts(formula: str) -> list[str]:
    """Return the parts of a formula between wide spaces, which may stand below each other."""
    if r"\begin{aligned}" in formula:
        return [formula]
    return [part.strip() for part in formula.split(r"\qquad") if part.strip()]


def _mathml(source: str, formula: str, *, is_block: bool) -> str:
    """Return the MathML of a formula, strictly: an unknown command ends the build."""
    try:
        mathml = CONVERTER.convert_with_local_state(formula, displaystyle=is_block)
    except LatexError as error:
        raise PluginError(f"{source}: expected a formula, got {formula!r}: {error}") from error
    return BARS.sub(lambda match: f"{match[1]}{BAR_OF[match[2]]}{match[2]}", mathml)


class ProjectDocstrings(Extension):
    """Rewrites docstrings for their parser.

    Examples as code, short sections such as `Raises: X` as paragraphs.
    """

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite the docstring of a module, class, function or attribute."""
        if obj.docstring is not None:
            text = re.sub(
                r"^>>> .*?(?=\n\s*\n|\Z)",
                r"\n```pycon\n\g<0>\n```",
                obj.docstring.value,
                flags=re.M | re.S,
            )
            obj.docstring.value = re.sub(
                r"^(Raises|Returns|Source): (?=.)", r"\n**\1:** ", text, flags=re.M
            )
