"""The page of a rehearsal for colleagues: one HTML file in which all is, also what is drawn."""

import base64
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from rehearsal.resection.judgement import MARGIN_LIMITS_MM
from rehearsal.resection.resection_page import COLOURS, rows_of
from render.viewer import TextTable
from version import VERSION

FOLDER = Path(__file__).parent
DEFAULT_TITLE = "Rehearsal"
# Sentences of docs/limitations.md.
NOT_MODELLED = (
    "No breathing, no heartbeat, no pneumoperitoneum. The kidney lies as in the CT, at its phase of breath.",
    "A cut is made at once, along the scored line, without instruments, bleeding, suction or suture.",
    "Tissue does not tear, bleed, swell, or become soft without blood.",
    "Clamping has no time: warm ischaemia is not computed.",
    "The margin is measured in the patient at rest: it is as good as the segmentation.",
    "The stiffness of this patient: it is a typical value, and the patient's own is not known.",
    "The picture is computed from the CT. What the CT does not show, the picture cannot show.",
)
# So many attempts fit on the page.
MOST_ATTEMPTS = 6
SHOWN = ' class="shown"'
NOT_SHOWN = "None of them is shown on this page: the kidney is not cut at the end."
MARGIN_NAMES = (
    "in the tumour",
    *(f"margin below {limit:g} mm" for limit in MARGIN_LIMITS_MM),
    f"{MARGIN_LIMITS_MM[-1]:g} mm and more",
)


@dataclass(frozen=True)
class ModelView:
    """How the 3D view begins: from the direction of an ``eye`` (3,) in LPS, with the parts named in
    ``lifted`` moved by ``lift_mm`` along ``lift`` (3,). ``colours`` are those of the parts.
    """

    eye: Sequence[float]
    colours: dict[str, str]
    translucent: bool = False
    lifted: Sequence[str] = ()
    lift: Sequence[float] = (0.0, 0.0, 0.0)
    lift_mm: float = 0.0


@dataclass(frozen=True)
class ReportPage:
    """What a page shows: pictures as PNG, the parts as a binary glTF, charts as SVG, the figures of the
    resection as ``resection_page.report_of`` has them, the attempts of the session, and rows of a name and a
    value each.
    """

    title: str
    model: bytes
    view: ModelView
    still: bytes
    ct: bytes | None = None
    images: Sequence[tuple[str, bytes]] = ()
    resection: dict[str, Any] | None = None
    attempts: TextTable | None = None
    tumour: Sequence[tuple[str, str]] = ()
    session: Sequence[tuple[str, str]] = ()
    charts: Sequence[str] = ()
    remarks: Sequence[str] = ()

    def html(self) -> str:
        """The page."""
        return Template((FOLDER / "page.html").read_text("utf-8")).substitute(
            title=escape(self.title or DEFAULT_TITLE),
            version=escape(VERSION),
            style=(FOLDER / "page.css").read_text("utf-8").strip(),
            remarks=self._remarks(),
            still=_base64(self.still),
            legend=margin_legend() if self.resection else "",
            first="\n".join(self._first()),
            second="\n".join(self._second()),
            model=_base64(self.model),
            # No text of it may end the element that contains it.
            view=json.dumps(vars(self.view)).replace("<", "\\u003c"),
            viewer=(FOLDER / "model_viewer.js").read_text("utf-8").strip(),
        )

    def _remarks(self) -> str:
        lines = "".join(f"<p>{escape(text)}</p>" for text in self.remarks)
        return f'<div class="warning">{lines}</div>' if lines else ""

    def _first(self) -> Iterable[str]:
        """What is below the kidney on the first A4 page."""
        if self.resection is not None:
            # The warnings are at the top.
            rows = [row for row in rows_of(self.resection) if row[0] != "import"]
            yield _section("Resection", table(rows))
        # The figures of a single attempt are those of the resection.
        if self.attempts is not None and len(self.attempts.rows) > (self.attempts.marked is not None):
            yield _section("Attempts", attempt_table(self.attempts))
        if self.tumour:
            yield _section("Complexity of the tumour", table(self.tumour))
        if self.session:
            yield _section("Session", f'<div class="short">{table(self.session)}</div>')

    def _second(self) -> Iterable[str]:
        """The second A4 page."""
        if self.ct is not None:
            middle = "tumour" if self.tumour else "kidney"
            yield _section(f"CT through the middle of the {middle}", picture(self.ct, "CT slices"))
        if self.images:
            figures = "".join(
                f"<figure>{picture(image, caption)}<figcaption>{escape(caption)}</figcaption></figure>"
                for caption, image in self.images
            )
            yield _section("Ultrasound, simulated", f'<div class="images">{figures}</div>')
        if self.charts:
            yield _section("Measurements over time", f'<div class="charts">{"".join(self.charts)}</div>')
        sentences = "".join(f"<li>{escape(text)}</li>" for text in NOT_MODELLED)
        yield _section("Not modelled", f"<ul>{sentences}</ul>")


def attempt_table(attempts: TextTable) -> str:
    """The attempts, of more than MOST_ATTEMPTS the last; the one that the page shows is marked."""
    first = max(0, len(attempts.rows) - MOST_ATTEMPTS)
    head = "".join(f"<th>{escape(text)}</th>" for text in attempts.headings)
    rows = "".join(
        f"<tr{SHOWN if number == attempts.marked else ''}>"
        f"{''.join(f'<td>{escape(text)}</td>' for text in row)}</tr>"
        for number, row in enumerate(attempts.rows)
        if number >= first or number == attempts.marked
    )
    marked = "Shown on this page: the attempt in bold." if attempts.marked is not None else NOT_SHOWN
    earlier = (
        f" Listed of {len(attempts.rows)}: the last {MOST_ATTEMPTS}, and the one shown." if first else ""
    )
    return (
        f'<table class="attempts"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
        f'<p class="about">{marked}{earlier}</p>'
    )


def table(rows: Sequence[tuple[str, str]]) -> str:
    """A table of names and values."""
    body = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table><tbody>{body}</tbody></table>"


def margin_legend() -> str:
    """The colours of the cut surface."""
    entries = "".join(
        f'<span><i style="background:{colour}"></i>{escape(name)}</span>'
        for colour, name in zip(COLOURS, MARGIN_NAMES, strict=True)
    )
    return f'<div class="legend">{entries}</div>'


def picture(image: bytes, text: str) -> str:
    """A PNG as an element; ``text`` is for readers who cannot see it."""
    return f'<img src="data:image/png;base64,{_base64(image)}" alt="{escape(text)}">'


def _section(title: str, content: str, kind: str = "") -> str:
    return f"<section{f' class={kind}' if kind else ''}>\n<h2>{escape(title)}</h2>\n{content}\n</section>"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
