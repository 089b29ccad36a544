"""Steps of the site's build beside those of MkDocs.

README.md, CHANGELOG.md and SECURITY.md become pages, files outside docs/ that a page links to are copied into the site,
formulas become MathML. A page that cannot be converted ends the build.
"""

import re
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER))  # a hook is loaded by its path, without its package

from mathml import FormulaError, with_mathml  # noqa: E402

ROOT = FOLDER.parent.parent
# Pages made of other files, by their name in the site; links in these files start at the root of the project.
OUTSIDE = {
    "index.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "security.md": "SECURITY.md",
    "python-reference.md": "docs/site/python-reference.md",
}
TO_FOLDER = re.compile(r"\[([^\]\n]*)\]\(([^)\s#]+)\)")
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
# A link whose text is the name of a page.
NAMED = re.compile(r"\[(?:docs/)?[\w-]+\.md\](\((?:docs/)?([\w-]+\.md)(?:#[^)\s]*)?\))")
TITLE = re.compile(r"^# (.+)$", re.MULTILINE)
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages from outside docs/, the site's own style and script, and files that pages link to."""
    for name, source in OUTSIDE.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    for asset in sorted((FOLDER / "assets").iterdir()):
        files.append(File.generated(config, f"assets/{asset.name}", abs_src_path=str(asset)))
    linked = set()
    for file in files.documentation_pages():
        base = _base(file)
        linked |= {_target(base, found[2]) for found in LINK.finditer(FENCE.sub("", file.content_string))}
    for target in sorted(target for target in linked if target.startswith("files/")):
        files.append(File.generated(config, target, abs_src_path=str(ROOT / target.removeprefix("files/"))))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Point links at the files of the site, and name pages by their titles."""
    base = _base(page.file)
    if page.file.src_uri == "keys.md":
        page.meta["search"] = {"boost": 4}  # the definition of a key comes before pages that mention it

    def titled(found: re.Match[str]) -> str:
        page_file = ROOT / "docs" / found[2]
        title = TITLE.search(page_file.read_text(encoding="utf-8")) if page_file.exists() else None
        return f"[{title[1]}]{found[1]}" if title else found[0]

    def without_folder(found: re.Match[str]) -> str:
        is_folder = "://" not in found[2] and (ROOT / base / found[2]).is_dir()
        return found[1] if is_folder else found[0]  # a site has no lists of files

    def pointed(found: re.Match[str]) -> str:
        return f"{found[1]}{_target(base, found[2])}{found[3]}"

    return LINK.sub(pointed, NAMED.sub(titled, TO_FOLDER.sub(without_folder, markdown)))


def on_page_content(html: str, page: Page, **_: object) -> str:
    """Convert formulas."""
    try:
        return with_mathml(html, page.file.src_uri)
    except FormulaError as error:
        raise PluginError(str(error)) from error


def _base(file: File) -> str:
    """Return the folder at which the links of a page start."""
    return "." if file.src_uri in OUTSIDE else "docs"


def _target(base: str, target: str) -> str:
    """Return a link as the site needs it: all its pages are in one folder, copies of other files in files/."""
    path = (ROOT / base / target).resolve()
    if "://" in target or target.startswith("mailto:") or not path.is_file() or not path.is_relative_to(ROOT):
        return target
    own = path.relative_to(ROOT).as_posix()
    for name, source in OUTSIDE.items():
        if own == source:
            return name
    is_inside = own.startswith("docs/images/") or (own.startswith("docs/") and path.suffix == ".md")
    return own.removeprefix("docs/") if is_inside else f"files/{own}"
