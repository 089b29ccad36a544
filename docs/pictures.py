"""Draw the pictures of processes and frames: docs/images/architecture.svg and docs/images/frames.svg.

    python docs/pictures.py

The files are text, the same on every machine; a test compares them with what this program draws.
"""

import sys
from pathlib import Path
from xml.sax.saxutils import escape

FOLDER = Path(__file__).resolve().parent / "images"

INK, GREY, BLUE, RED, GREEN, PAPER = "#1f2430", "#6b7280", "#1d4ed8", "#b91c1c", "#047857", "#ffffff"
Point = tuple[float, float]


class Picture:
    """Shapes on a white ground; lengths in pixels, x to the right, y down."""

    def __init__(self, width: float, height: float, title: str) -> None:
        self._size = f"{width:g} {height:g}"
        self._width = width
        self._title = title
        self._shapes: list[str] = []

    def box(self, corner: Point, size: Point, lines: tuple[str, ...], colour: str = INK) -> None:
        """Draw a box with lines of text; the first one is bold."""
        (x, y), (width, height) = corner, size
        self._shapes.append(
            f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="6" fill="{PAPER}" stroke="{colour}" '
            'stroke-width="1.5"/>'
        )
        top = y + height / 2 - 9.0 * (len(lines) - 1) + 5
        for i, line in enumerate(lines):
            self.text((x + width / 2, top + 18.0 * i), line, bold=i == 0, size=15 if i == 0 else 13)

    def arrow(self, start: Point, end: Point, colour: str = INK, *, dashed: bool = False, both: bool = False) -> None:
        """Draw an arrow, dashed or with a head at both ends."""
        name = colour.lstrip("#")
        dash = ' stroke-dasharray="6 4"' if dashed else ""
        head = f' marker-start="url(#h{name})"' if both else ""
        self._shapes.append(
            f'<line x1="{start[0]:g}" y1="{start[1]:g}" x2="{end[0]:g}" y2="{end[1]:g}" stroke="{colour}" '
            f'stroke-width="1.6"{dash} marker-end="url(#h{name})"{head}/>'
        )

    def line(self, start: Point, end: Point, colour: str = INK, width: float = 1.5, *, dashed: bool = False) -> None:
        """Draw a line."""
        dash = ' stroke-dasharray="5 4"' if dashed else ""
        self._shapes.append(
            f'<line x1="{start[0]:g}" y1="{start[1]:g}" x2="{end[0]:g}" y2="{end[1]:g}" stroke="{colour}" '
            f'stroke-width="{width:g}"{dash}/>'
        )

    def dot(self, centre: Point, radius: float = 4.0, colour: str = INK) -> None:
        """Draw a point."""
        self._shapes.append(f'<circle cx="{centre[0]:g}" cy="{centre[1]:g}" r="{radius:g}" fill="{colour}"/>')

    def polygon(self, corners: tuple[Point, ...], fill: str) -> None:
        """Draw a filled polygon."""
        points = " ".join(f"{x:g},{y:g}" for x, y in corners)
        self._shapes.append(f'<polygon points="{points}" fill="{fill}" stroke="{INK}" stroke-width="1.5"/>')

    def text(
        self, place: Point, text: str, colour: str = INK, *, bold: bool = False, size: int = 13, anchor: str = "middle"
    ) -> None:
        """Write a line of text."""
        weight = ' font-weight="bold"' if bold else ""
        self._shapes.append(
            f'<text x="{place[0]:g}" y="{place[1]:g}" font-size="{size}" text-anchor="{anchor}" fill="{colour}"'
            f"{weight}>{escape(text)}</text>"
        )

    def symbol(self, place: Point, letter: str, index: str = "", colour: str = INK, *, behind: str = "") -> None:
        """Write a symbol in italics with its index, and text behind it."""
        lowered = f'<tspan dy="4" font-size="12">{escape(index)}</tspan>' if index else ""
        rest = (
            f'<tspan dy="{-4 if index else 0}" font-style="normal" font-size="13">{escape(behind)}</tspan>'
            if behind
            else ""
        )
        self._shapes.append(
            f'<text x="{place[0]:g}" y="{place[1]:g}" font-size="17" font-style="italic" font-family="serif" '
            f'fill="{colour}">{escape(letter)}{lowered}{rest}</text>'
        )

    def svg(self) -> str:
        """Return the picture as the text of a file."""
        heads = "".join(
            f'<marker id="h{colour.lstrip("#")}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" '
            f'markerHeight="8" orient="auto-start-reverse"><path d="M0 1 10 5 0 9z" fill="{colour}"/></marker>'
            for colour in (INK, GREY, BLUE, RED, GREEN)
        )
        shapes = "\n".join(self._shapes)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self._size}" width="{self._width:g}" '
            f'font-family="Helvetica, Arial, sans-serif" role="img">\n<title>{escape(self._title)}</title>\n'
            f'<defs>{heads}</defs>\n<rect width="100%" height="100%" fill="{PAPER}"/>\n{shapes}\n</svg>\n'
        )


def architecture() -> str:
    """Return the picture of the processes of a run and the messages between them."""
    picture = Picture(880, 470, "Processes of a run and the messages between them")
    picture.box((330, 20), (220, 62), ("coordinator", "clock, roster, links"))
    picture.box((30, 180), (220, 84), ("plant", "dynamics, actuators,", "wind, noise"))
    for name, y in (("agent 1", 120), ("agent 2", 220), ("agent N", 326)):
        picture.box((610, y), (240, 62), (name, "estimator, MPC, QP"), BLUE)
    picture.text((730, 310), "...", BLUE, bold=True, size=18)
    picture.arrow((690, 184), (690, 218), BLUE, both=True)
    picture.text((702, 206), "plan: state, inputs", BLUE, anchor="start")
    picture.box((330, 390), (220, 62), ("recorder", "run.mcap: every message"), GREY)
    picture.arrow((330, 66), (190, 180))
    picture.text((232, 112), "tick")
    picture.arrow((550, 44), (670, 118), GREY, dashed=True)
    picture.text((632, 74), "roster, link, control", GREY, anchor="start")
    picture.arrow((612, 132), (520, 84), BLUE)
    picture.text((538, 116), "plan", BLUE)
    picture.arrow((250, 204), (608, 204), GREEN)
    picture.text((420, 196), "measurement", GREEN)
    picture.arrow((608, 240), (252, 240), BLUE)
    picture.text((420, 258), "plan: inputs for its UAVs", BLUE)
    picture.arrow((160, 264), (328, 410), GREY, dashed=True)
    picture.arrow((700, 388), (552, 428), GREY, dashed=True)
    picture.text((655, 424), "report", GREY)
    picture.text((200, 360), "plant state", GREY)
    return picture.svg()


def frames() -> str:
    """Return the picture of frames, vectors and rods, seen from the right: x forward, z down, y out of the page."""
    picture = Picture(880, 520, "Frames, payload, rods and UAVs, seen along the y axis")
    origin, centre = (90.0, 290.0), (450.0, 400.0)
    uavs = ((300.0, 130.0), (620.0, 130.0))
    points = ((320.0, 352.0), (580.0, 352.0))
    picture.polygon(((300, 352), (600, 352), (600, 448), (300, 448)), "#e5e7eb")
    picture.arrow(origin, (170, 290), RED)
    picture.arrow(origin, (90, 370), RED)
    picture.symbol((174, 295), "x", colour=RED)
    picture.symbol((98, 376), "z", colour=RED)
    picture.text((110, 274), "inertial frame I", RED)
    picture.symbol((36, 340), "g", colour=RED)
    picture.arrow((28, 310), (28, 362), RED)
    picture.arrow(origin, (444, 399), GREY, dashed=True)
    picture.symbol((228, 326), "r", "0", GREY)
    picture.dot(centre)
    picture.arrow(centre, (530, 400))
    picture.arrow(centre, (450, 478))
    picture.symbol((534, 406), "x", "P")
    picture.symbol((458, 484), "z", "P")
    picture.text((390, 438), "payload frame P", size=13)
    picture.symbol((500, 438), "m", "0", behind=",")
    picture.symbol((534, 438), "J", "0")
    for i, (uav, point) in enumerate(zip(uavs, points, strict=True), start=1):
        x, y = uav
        picture.arrow(centre, point, GREEN)
        picture.line(uav, point, INK, 3.0)
        picture.dot(point, 5.0, GREEN)
        middle = ((x + point[0]) / 2, (y + point[1]) / 2)
        picture.symbol((middle[0] + 10, middle[1] + 6), "l", str(i))
        start = (x + (point[0] - x) * 0.08 - 16, y + (point[1] - y) * 0.08 + 14)
        picture.arrow(start, (start[0] + (point[0] - x) * 0.3, start[1] + (point[1] - y) * 0.3), BLUE)
        picture.symbol((start[0] - 26, start[1] + 40), "e", str(i), BLUE)
        picture.line((x - 52, y), (x + 52, y), INK, 4.0)
        for side in (-46, 46):
            picture.line((x + side, y), (x + side, y - 12), INK, 2.0)
            picture.line((x + side - 24, y - 12), (x + side + 24, y - 12), INK, 2.0)
        picture.dot(uav, 5.0)
        picture.arrow((x, y - 4), (x, y - 90), RED)
        picture.symbol((x + 10, y - 74), "\u2212f", str(i), RED)
        picture.symbol((x + 37, y - 74), "R", str(i), RED)
        picture.symbol((x + 57, y - 74), "k", colour=RED)
        picture.arrow((x + 56, y), (x + 112, y))
        picture.symbol((x + 116, y + 6), "x", f"B{i}")
        picture.symbol((x - 106, y + 24), "m", str(i), behind=",")
        picture.symbol((x - 72, y + 24), "J", str(i))
    picture.symbol((392, 366), "\u03c1", "1", GREEN)
    picture.symbol((534, 386), "\u03c1", "2", GREEN)
    notes = (
        "e: unit vector along the rod, from UAV",
        "to attachment point, in frame P.",
        "\u03c1: attachment point, in frame P.",
        "Body axes: x forward, y right, z down.",
        "Thrust acts along -z of the UAV.",
    )
    for i, note in enumerate(notes):
        picture.text((622, 372 + 20.0 * i), note, GREY, anchor="start")
    return picture.svg()


PICTURES = {"architecture.svg": architecture, "frames.svg": frames}


def main() -> None:
    """Write the files."""
    for name, draw in PICTURES.items():
        (FOLDER / name).write_text(draw(), encoding="utf-8")
        sys.stdout.write(f"{FOLDER / name}\n")


if __name__ == "__main__":
    main()
