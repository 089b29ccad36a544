"""Flowcharts of a page as SVG, drawn at build time: the part of Mermaid's language that the pages use.

A chart is a block of lines `flowchart TD`, `subgraph NAME` ... `end` and `NODE --> NODE`. Nodes stand in layers, each
below all nodes that point to it; the order within a layer follows the nodes above.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from xml.sax.saxutils import escape

# Lengths in pixels of the drawing.
WIDTH, HEIGHT = 108.0, 34.0
GAP_X, GAP_Y = 26.0, 46.0
MARGIN = 18.0
HEADING = 24.0

_EDGE = re.compile(r"(\w+) --> (\w+)")


class DiagramError(ValueError):
    """A flowchart that cannot be drawn; the text names the line."""


@dataclass(slots=True)
class Group:
    """Nodes of one subgraph, and the edges between them as pairs (from, to)."""

    name: str
    edges: list[tuple[str, str]] = field(default_factory=list)

    def layers(self) -> list[list[str]]:
        """Return the nodes from the first layer to the last, each layer in its order from left to right.

        Raises: DiagramError: the edges form a circle.
        """
        above: dict[str, set[str]] = {}
        for start, end in self.edges:
            above.setdefault(start, set())
            above.setdefault(end, set()).add(start)
        depth: dict[str, int] = {}
        try:
            for node in TopologicalSorter(above).static_order():
                depth[node] = 1 + max((depth[other] for other in above[node]), default=-1)
        except CycleError as error:
            raise DiagramError(f"subgraph {self.name}: expected no circle, got {error.args[1]}") from error
        rows: list[list[str]] = [[] for _ in range(1 + max(depth.values(), default=-1))]
        for node in above:
            rows[depth[node]].append(node)
        place = {node: float(i) for row in rows for i, node in enumerate(row)}
        for row in rows[1:]:
            row.sort(key=lambda node: sum(place[other] for other in above[node]) / max(1, len(above[node])))
            place.update({node: float(i) for i, node in enumerate(row)})
        return rows


def groups_of(chart: str) -> list[Group]:
    """Read a flowchart.

    Raises: DiagramError: a line is not of the part of the language that can be drawn.
    """
    found: list[Group] = []
    first, *lines = [line.strip() for line in chart.strip().splitlines()]
    if first != "flowchart TD":
        raise DiagramError(f"expected flowchart TD, got {first!r}")
    inside = False
    for line in lines:
        edge = _EDGE.fullmatch(line)
        if line.startswith("subgraph ") and not inside:
            found.append(Group(line.removeprefix("subgraph ")))
            inside = True
        elif line == "end" and inside:
            inside = False
        elif edge and inside:
            found[-1].edges.append((edge[1], edge[2]))
        else:
            raise DiagramError(f"expected a subgraph of lines `A --> B`, got {line!r}")
    return found


def drawn(chart: str) -> str:
    """Return a flowchart as SVG, one subgraph beside the other.

    Raises: DiagramError: the chart cannot be drawn.
    """
    parts: list[str] = []
    left, bottom = MARGIN, 0.0
    for group in groups_of(chart):
        rows = group.layers()
        width = _row_width(max(rows, key=len, default=[])) + 2 * MARGIN
        height = HEADING + len(rows) * HEIGHT + max(0, len(rows) - 1) * GAP_Y + 2 * MARGIN
        parts += _frame(group, rows, left, width, height)
        left += width + MARGIN
        bottom = max(bottom, height)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {left:g} {bottom + 2 * MARGIN:g}" width="{left:g}" '
        'role="img" font-family="sans-serif" font-size="14" fill="none" stroke="currentColor">'
        '<defs><marker id="arrow" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0 8 4 0 8z" fill="currentColor" stroke="none"/></marker></defs>' + "".join(parts) + "</svg>"
    )


def _row_width(row: Sequence[str]) -> float:
    return len(row) * WIDTH + max(0, len(row) - 1) * GAP_X


def _frame(group: Group, rows: list[list[str]], left: float, width: float, height: float) -> list[str]:
    """Return the shapes of one subgraph: its frame and name, its edges, its nodes."""
    parts = [
        f'<rect x="{left:g}" y="{MARGIN:g}" width="{width:g}" height="{height:g}" rx="6" stroke-opacity="0.4"/>',
        _text(left + width / 2, MARGIN + HEADING - 4, group.name, bold=True),
    ]
    corner: dict[str, tuple[float, float]] = {}
    for depth, row in enumerate(rows):
        start = left + (width - _row_width(row)) / 2
        y = MARGIN + HEADING + MARGIN + depth * (HEIGHT + GAP_Y)
        corner.update({node: (start + i * (WIDTH + GAP_X), y) for i, node in enumerate(row)})
    for start_node, end_node in group.edges:
        (x0, y0), (x1, y1) = corner[start_node], corner[end_node]
        # From the lower edge of one node to the upper edge of the other, as a curve.
        x0, y0, x1 = x0 + WIDTH / 2, y0 + HEIGHT, x1 + WIDTH / 2
        bend = (y1 - y0) / 2
        curve = f"M{x0:g} {y0:g} C{x0:g} {y0 + bend:g} {x1:g} {y1 - bend:g} {x1:g} {y1:g}"
        parts.append(f'<path d="{curve}" marker-end="url(#arrow)"/>')
    for node, (x, y) in corner.items():
        parts.append(f'<rect x="{x:g}" y="{y:g}" width="{WIDTH:g}" height="{HEIGHT:g}" rx="4"/>')
        parts.append(_text(x + WIDTH / 2, y + HEIGHT / 2 + 5, node))
    return parts


def _text(x: float, y: float, text: str, *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    place = f'x="{x:g}" y="{y:g}" text-anchor="middle"'
    return f'<text {place} fill="currentColor" stroke="none"{weight}>{escape(text)}</text>'
