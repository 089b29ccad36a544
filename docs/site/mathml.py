"""Equations of a page as MathML, which browsers draw themselves: no script and no font is loaded."""

import html
import re

from latex2mathml.converter import convert

# Formulas as the Markdown extension arithmatex leaves them.
_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_DISPLAY = re.compile(r'<div class="arithmatex">\\\[(.*?)\\\]</div>', re.DOTALL)
_TAG = re.compile(r"\\tag\{(\w+)\}")
# A function's name that the converter does not know.
_ARGUMENT = re.compile(r"\\arg(?![A-Za-z])")
_COMMAND = re.compile(r"\\[A-Za-z]+")


class FormulaError(ValueError):
    """A formula that cannot be converted; the text names the page and the formula."""


def with_mathml(page: str, source: str) -> str:
    """Return the HTML of a page with MathML in the place of each formula.

    Args:
        page: HTML with formulas as arithmatex writes them.
        source: Name of the page, for errors.
    Raises: FormulaError: the converter does not know a command of a formula.
    """

    def inline(found: re.Match[str]) -> str:
        return _mathml(found[1], "inline", source)

    def display(found: re.Match[str]) -> str:
        formula = html.unescape(found[1])
        tag = _TAG.search(formula)
        body = _mathml(_TAG.sub("", formula), "block", source)
        number = f'<span class="number">({tag[1]})</span>' if tag else ""
        place = f' id="eq-{tag[1]}"' if tag else ""
        return f'<div class="equation"{place}>{body}{number}</div>'

    return _INLINE.sub(inline, _DISPLAY.sub(display, page))


def _mathml(formula: str, display: str, source: str) -> str:
    """Return one formula as MathML.

    Raises: FormulaError: the converter does not know a command of the formula.
    """
    text = _ARGUMENT.sub(r"\\mathrm{arg}", html.unescape(formula).strip())
    try:
        converted = convert(text, display=display)
    except Exception as error:
        raise FormulaError(f"{source}: expected a formula, got {text!r}: {error}") from error
    unknown = _COMMAND.findall(re.sub(r"<[^>]*>", "", html.unescape(converted)))
    if unknown:
        raise FormulaError(f"{source}: expected known commands, got {', '.join(unknown)} in {text!r}")
    return converted
