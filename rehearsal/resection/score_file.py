"""The score as a file that 3D Slicer reads: a closed curve of its markups, LPS, mm."""

from pathlib import Path

from rehearsal.case import Case
from rehearsal.resection.score_line import ScoreLine
from rehearsal.result_files import write_json

NAME = "score.mrk.json"
SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"


def save_score(case: Case, line: ScoreLine, out: Path, prefix: str = "") -> Path:
    """Write a score in the patient at rest (the CT); return the file. Raises OSError."""
    points = (line.points + case.origin).round(4).tolist()
    curve = dict(
        type="ClosedCurve",
        coordinateSystem="LPS",
        coordinateUnits="mm",
        controlPoints=[
            dict(id=f"{number}", label=f"score-{number}", position=point, positionStatus="defined")
            for number, point in enumerate(points, 1)
        ],
    )
    path = out / f"{prefix}{NAME}"
    write_json({"@schema": SCHEMA, "markups": [curve]}, path)
    return path
