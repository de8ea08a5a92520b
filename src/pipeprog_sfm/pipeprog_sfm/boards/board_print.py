# SPDX-License-Identifier: Apache-2.0
"""Boards as PDF pages to print at true size."""

from __future__ import annotations

from collections.abc import Sequence

from pipeprog_camera.errors import InputError
from pipeprog_sfm.boards.board import Board

# Width and height upright, mm.
PAPERS = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}

QUIET = 0.75  # dark rim around the circles, in radii: wide enough for the local threshold that finds them
EDGE = 6.0  # mm that printers leave white
RULER = 100.0  # mm
STRIP = 16.0  # mm below the board, for the ruler and the line of text
POINTS_PER_MM = 72 / 25.4
KAPPA = 0.5522847498  # control points of a quarter circle: 0.03 % of the radius off, 0.01 mm at 40 mm


def board_pdf(boards: Sequence[Board], paper: str) -> bytes:
    """A PDF with one page a board: white circles on black, and a ruler to check the print with.

    Args:
        boards: boards to print.
        paper: a key of PAPERS; turned to landscape where the board needs it.

    Raises:
        InputError: the paper is unknown, or a board does not fit on it (the text names one that it fits on).
    """
    size = next((name for name in PAPERS if name.lower() == paper.lower()), None)
    if size is None:
        raise InputError(f"paper '{paper}' is unknown: use one of {', '.join(PAPERS)}")
    return _document([_page(board, size) for board in boards])


def _plate(board: Board) -> tuple[float, float, float, float]:
    """Left, bottom, width and height of the dark plate in the board's frame, mm."""
    rim = (1 + QUIET) * 1000 * board.circle_radius
    low, high = 1000 * board.centres.min(0) - rim, 1000 * board.centres.max(0) + rim
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


def _fitting(width: float, height: float, paper: str) -> tuple[float, float] | None:
    """Width and height of the page, mm, as the plate fits on it, or None."""
    short, long = PAPERS[paper]
    for page in ((short, long), (long, short)):
        if max(width, RULER) <= page[0] - 2 * EDGE and height + STRIP <= page[1] - 2 * EDGE:
            return page
    return None


def _page(board: Board, paper: str) -> tuple[float, float, str]:
    """Width and height of the page, mm, and what is drawn on it."""
    left, bottom, width, height = _plate(board)
    page = _fitting(width, height, paper)
    if page is None:
        fits = [name for name in PAPERS if _fitting(width, height, name)]
        remedy = f"print it on {fits[0]}" if fits else "have it printed as a plate, or make it smaller"
        raise InputError(f"board {board.name} ({width:g} x {height:g} mm) does not fit on {paper}: {remedy}")
    x0, y0 = (page[0] - width) / 2, EDGE + STRIP + (page[1] - 2 * EDGE - STRIP - height) / 2
    drawing = [
        f"{POINTS_PER_MM:.9f} 0 0 {POINTS_PER_MM:.9f} 0 0 cm",
        f"0 g {x0:.4f} {y0:.4f} {width:.4f} {height:.4f} re f",
    ]
    drawing.append("1 g")
    drawing += [
        _disc(x0 + 1000 * x - left, y0 + 1000 * y - bottom, 1000 * board.circle_radius) for x, y, _ in board.centres
    ]
    start = (page[0] - RULER) / 2
    drawing.append(f"0 g 0 G 0.2 w {start:.4f} {EDGE + 6:.4f} m {start + RULER:.4f} {EDGE + 6:.4f} l S")
    for tick in range(int(RULER) + 1):
        length = 4.0 if tick % 10 == 0 else 2.5 if tick % 5 == 0 else 1.5
        drawing.append(f"{start + tick:.4f} {EDGE + 6:.4f} m {start + tick:.4f} {EDGE + 6 + length:.4f} l S")
    text = (
        f"Board {board.name}: print at 100 %, then this ruler is {RULER:g} mm long. Measure the centres of the print."
    )
    escaped = text.encode("ascii", "replace").decode().replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    drawing.append(f"BT /F 3 Tf {EDGE + 2:.4f} {EDGE:.4f} Td ({escaped}) Tj ET")
    return page[0], page[1], "\n".join(drawing)


def _disc(x: float, y: float, radius: float) -> str:
    bend = KAPPA * radius
    path = [f"{x + radius:.4f} {y:.4f} m"]
    ax, ay = 1.0, 0.0
    for _ in range(4):
        bx, by = -ay, ax
        corners = (
            (x + radius * ax + bend * bx, y + radius * ay + bend * by),
            (x + radius * bx + bend * ax, y + radius * by + bend * ay),
            (x + radius * bx, y + radius * by),
        )
        path.append(" ".join(f"{px:.4f} {py:.4f}" for px, py in corners) + " c")
        ax, ay = bx, by
    return "\n".join([*path, "f"])


def _document(pages: Sequence[tuple[float, float, str]]) -> bytes:
    """The pages as a PDF 1.4 file."""
    kids = " ".join(f"{4 + 2 * number} 0 R" for number in range(len(pages)))
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    for number, (width, height, drawing) in enumerate(pages):
        box = f"0 0 {width * POINTS_PER_MM:.4f} {height * POINTS_PER_MM:.4f}"
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Resources << /Font << /F 3 0 R >> >> "
            f"/Contents {5 + 2 * number} 0 R >>"
        )
        objects.append(f"<< /Length {len(drawing)} >>\nstream\n{drawing}\nendstream")
    document, offsets = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        offsets.append(len(document))
        document += f"{number} 0 obj\n{body}\nendobj\n".encode("ascii")
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    size = len(objects) + 1
    return document + (
        f"xref\n0 {size}\n0000000000 65535 f \n{table}trailer\n<< /Size {size} /Root 1 0 R >>\n"
        f"startxref\n{len(document)}\n%%EOF\n"
    ).encode("ascii")
