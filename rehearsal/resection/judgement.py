"""The figures of a cut that pathologist and surgeon ask for: margin, what was removed, and what was opened.

Margins are those of the Surface-Intermediate-Base score (Minervini et al. 2014) as distances: from each place
of the resection surface to the nearest point of the tumour; 0 where the cut is in the tumour (positive
margin).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rehearsal.resection.cut import Cut, faces_of
from scenes.anatomy import Grid
from scenes.solids import solid_of
from scenes.surfaces import signed_distance_from, volume_mm3

# The resection surface is measured in faces with edges of at most this length [mm].
FACE_MM, MOST_FACES = 0.75, 200_000
# Limits [mm] below which the area of the margin is reported.
MARGIN_LIMITS_MM = (1.0, 3.0, 5.0)
# Parts of an organ that are not parenchyma.
NOT_PARENCHYMA = ("tumour", "cyst", "urine", "vessel", "sinus")
VESSELS = ("artery", "vein", "vessel")
# Of a collecting system or vessels that nobody has outlined: that none was opened cannot be said.
NOT_LABELLED = "not labelled"
# Segmental vessels are narrower.
MAIN_VESSEL_MM = 5.0
# A cut that is no farther inside a surface runs along it.
SURFACE_ERROR_MM = 0.1
# A cut of less area through a vessel or the collecting system is within the error of their surfaces.
LEAST_OPENED_MM2 = 0.5


@dataclass(frozen=True)
class DividedVessel:
    """A vessel that the cut divides: its tissue, and its diameter there [mm]."""

    tissue: str
    diameter_mm: float


@dataclass(frozen=True)
class MarginMap:
    """Faces of the resection surface: middles (f, 3) [mm], areas (f,) [mm^2], and signed distances (f,)
    [mm] from the tumour.
    """

    middle: np.ndarray
    area_mm2: np.ndarray
    distance_mm: np.ndarray

    @property
    def margin_mm(self) -> np.ndarray:
        """Margin (f,) [mm], 0 where the cut is in the tumour."""
        return np.maximum(self.distance_mm, 0.0)

    @property
    def least_mm(self) -> float:
        """Least margin [mm], rounded as the report has it: the same in all places that show it with one
        digit.
        """
        return round(float(self.margin_mm.min()), 2)

    @property
    def mean_mm(self) -> float:
        """Mean margin [mm] over the surface."""
        return float(self.area_mm2 @ self.margin_mm / self.area_mm2.sum())

    def area_below(self, limit_mm: float) -> float:
        """Area [mm^2] with less margin than a limit."""
        return float(self.area_mm2[self.distance_mm < limit_mm].sum())

    @property
    def positive_mm2(self) -> float:
        """Area [mm^2] of the cut in the tumour."""
        return self.area_below(-SURFACE_ERROR_MM)


@dataclass(frozen=True)
class Judgement:
    """The figures of a cut. ``margin`` in the undeformed patient, ``margin_as_cut`` in the tissue as it was
    when it was cut.

    The collecting system and the vessels are None where the patient has none labelled.
    ``volume_change_percent`` is that of organ and specimen together, in the tissue as cut.
    """

    margin: MarginMap
    margin_as_cut: MarginMap
    specimen_ml: float
    tumour_left_ml: float
    parenchyma_removed_ml: float
    parenchyma_removed_percent: float
    collecting_system_opened_mm2: float | None
    vessels: tuple[DividedVessel, ...] | None
    volume_change_percent: float

    def warnings(self) -> list[str]:
        """What a surgeon would want to know at once."""
        warnings = []
        if self.margin.positive_mm2 > 0:
            warnings.append(
                f"the cut goes through the tumour over {shown(self.margin.positive_mm2, 'mm2')}; "
                f"{shown(self.tumour_left_ml, 'ml', 1)} of it left"
            )
        wide = [vessel for vessel in self.vessels or () if vessel.diameter_mm >= MAIN_VESSEL_MM]
        if wide:
            warnings.append(
                f"the cut divides a {wide[0].tissue} of {wide[0].diameter_mm:.1f} mm, as wide as a main "
                "vessel"
            )
        return warnings

    def report(self) -> dict:
        """The figures for ``report.json``."""
        margin, opened, vessels = self.margin, self.collecting_system_opened_mm2, self.vessels
        return dict(
            margin_min_mm=margin.least_mm,
            margin_mean_mm=round(margin.mean_mm, 2),
            margin_min_as_cut_mm=self.margin_as_cut.least_mm,
            margin_mean_as_cut_mm=round(self.margin_as_cut.mean_mm, 2),
            **{
                f"margin_below_{limit:g}_mm2": round(margin.area_below(limit), 1)
                for limit in MARGIN_LIMITS_MM
            },
            positive_margin_mm2=round(margin.positive_mm2, 1),
            tumour_left_ml=round(self.tumour_left_ml, 3),
            specimen_ml=round(float(self.specimen_ml), 3),
            parenchyma_removed_ml=round(self.parenchyma_removed_ml, 3),
            parenchyma_removed_percent=round(self.parenchyma_removed_percent, 2),
            collecting_system_opened_mm2=None if opened is None else round(opened, 1),
            vessels=None
            if vessels is None
            else [dict(tissue=v.tissue, diameter_mm=round(v.diameter_mm, 1)) for v in vessels],
            bed_mm2=round(float(margin.area_mm2.sum()), 1),
            volume_change_percent=round(self.volume_change_percent, 3),
        )


@dataclass(frozen=True)
class Carried:
    """Vertices (n, 3) [mm] of surfaces in the tissue as it was when it was cut."""

    organ: np.ndarray
    specimen: np.ndarray
    remnant: np.ndarray
    tumour: np.ndarray


def judge(
    cut: Cut,
    organ: trimesh.Trimesh,
    tumour: trimesh.Trimesh,
    parts: Mapping[str, trimesh.Trimesh],
    as_cut: Carried,
    labels: Grid | None = None,
    tissues: Mapping[int, str] | None = None,
) -> Judgement:
    """Judge a cut of an organ with a tumour and further parts, by tissue, all at rest [mm]; ``labels`` name
    the vessels.

    Raises PatientError for a part whose surface is no closed one.
    """
    surface = _small_faces(cut.resection_surface())
    removed, kept = _parenchyma_ml(cut, organ, {**parts, "tumour": tumour})
    tumour_then = trimesh.Trimesh(as_cut.tumour, tumour.faces, process=False)
    then = trimesh.Trimesh(as_cut.specimen, cut.specimen.faces, process=False)
    cut_then = faces_of(then, cut.on_specimen)
    both = volume_mm3(as_cut.specimen, cut.specimen.faces) + volume_mm3(as_cut.remnant, cut.remnant.faces)
    left = solid_of(tumour, "tumour") ^ solid_of(cut.remnant, "organ after the cut")
    return Judgement(
        margin=_margin_map(surface, tumour),
        margin_as_cut=_margin_map(_small_faces(cut_then), tumour_then),
        specimen_ml=cut.specimen.volume / 1000,
        tumour_left_ml=left.volume() / 1000,
        parenchyma_removed_ml=removed,
        parenchyma_removed_percent=100 * removed / (removed + kept),
        collecting_system_opened_mm2=_opened_mm2(surface, parts.get("urine")),
        vessels=divided_vessels(surface, parts.get("vessel"), labels, tissues or {}),
        volume_change_percent=100 * (both / volume_mm3(as_cut.organ, organ.faces) - 1),
    )


def _small_faces(surface: trimesh.Trimesh) -> trimesh.Trimesh:
    # Faces of damaged tissue may be huge.
    longest_mm = max(FACE_MM, float(np.sqrt(surface.area / MOST_FACES)))
    vertices, faces = trimesh.remesh.subdivide_to_size(
        surface.vertices, surface.faces, longest_mm, max_iter=30
    )
    return trimesh.Trimesh(vertices, faces, process=False)


def _margin_map(surface: trimesh.Trimesh, tumour: trimesh.Trimesh) -> MarginMap:
    middle = surface.triangles_center
    return MarginMap(middle, surface.area_faces, signed_distance_from(tumour, middle))


def _parenchyma_ml(
    cut: Cut, organ: trimesh.Trimesh, parts: Mapping[str, trimesh.Trimesh]
) -> tuple[float, float]:
    """Volume of parenchyma [ml] in the specimen, and in what remains."""
    healthy = solid_of(organ, "organ")
    for name in NOT_PARENCHYMA:
        if name in parts:
            healthy -= solid_of(parts[name], name)
    removed = (healthy ^ solid_of(cut.specimen, "specimen")).volume()
    return removed / 1000, (healthy.volume() - removed) / 1000


def _opened_mm2(surface: trimesh.Trimesh, part: trimesh.Trimesh | None) -> float | None:
    """Area [mm^2] of a surface inside a part, if there is one."""
    if part is None:
        return None
    inside = signed_distance_from(part, surface.triangles_center) < 0
    area = float(surface.area_faces[inside].sum())
    return area if area >= LEAST_OPENED_MM2 else 0.0


def divided_vessels(
    surface: trimesh.Trimesh,
    vessels: trimesh.Trimesh | None,
    labels: Grid | None,
    tissues: Mapping[int, str],
) -> tuple[DividedVessel, ...] | None:
    """The vessels that a surface of small faces divides, if there are any, the widest first; by ``labels``
    they are arteries or veins.
    """
    if vessels is None:
        return None
    middle, area = surface.triangles_center, surface.area_faces
    inside = np.flatnonzero(signed_distance_from(vessels, middle) < 0)
    if len(inside) == 0:
        return ()
    pairs = surface.face_adjacency[np.isin(surface.face_adjacency, inside).all(axis=1)]
    links = csr_array((np.ones(len(pairs)), pairs.T), shape=(len(area), len(area)))
    place = connected_components(links, directed=False)[1]
    vessels_cut = []
    for number in np.unique(place[inside]):
        faces = inside[place[inside] == number]
        if area[faces].sum() >= LEAST_OPENED_MM2:
            diameter = diameter_of_section(middle[faces], area[faces])
            vessels_cut.append(DividedVessel(_vessel_at(middle[faces], labels, tissues), diameter))
    return tuple(sorted(vessels_cut, key=lambda vessel: -vessel.diameter_mm))


def diameter_of_section(middle: np.ndarray, area_mm2: np.ndarray) -> float:
    """Diameter [mm] of a round vessel from its section: the short axis of the ellipse with the section's
    second moments.

    ``middle`` (f, 3) [mm] and ``area_mm2`` (f,) are its faces.
    """
    about = middle - area_mm2 @ middle / area_mm2.sum()
    moments = np.linalg.eigvalsh((about * area_mm2[:, None]).T @ about / area_mm2.sum())
    # Of an ellipse with the half axes a and b they are a^2 / 4 and b^2 / 4; across its plane the moment is
    # the least.
    return float(4 * np.sqrt(max(moments[1], 0.0)))


def _vessel_at(points: np.ndarray, labels: Grid | None, tissues: Mapping[int, str]) -> str:
    """The tissue of most points (n, 3) among arteries and veins; "vessel" where labels do not say it."""
    if labels is None:
        return "vessel"
    index = points @ labels.index_from_mm[:3, :3].T + labels.index_from_mm[:3, 3]
    index = np.clip(np.rint(index).astype(int), 0, np.array(labels.voxels.shape) - 1)
    names = [tissues.get(int(value), "") for value in labels.voxels[tuple(index.T)]]
    counts = {name: names.count(name) for name in VESSELS}
    return max(counts, key=counts.__getitem__) if any(counts.values()) else "vessel"


def drawn_mm(distance_mm: np.ndarray) -> np.ndarray:
    """Distances (n,) [mm] from the tumour as a picture has them: 0 where the cut runs along its surface,
    which is no positive margin.
    """
    return np.where((distance_mm < 0) & (distance_mm >= -SURFACE_ERROR_MM), 0.0, distance_mm)


def shown(value: float, unit: str, digits: int = 0) -> str:
    """A figure as it is written: what is too small for the last digit is not written as zero."""
    least = 10.0**-digits
    return f"< {least:g} {unit}" if 0 < value < least else f"{value:.{digits}f} {unit}"


def findings_of(judgement: Judgement) -> dict[str, str]:
    """Name -> figure with its unit, of a cut, for the window."""
    margin, opened = judgement.margin, judgement.collecting_system_opened_mm2
    findings = {
        "least margin": f"{margin.least_mm:.1f} mm",
        "positive margin": shown(margin.positive_mm2, "mm2"),
        "specimen": f"{judgement.specimen_ml:.1f} ml",
        "parenchyma": f"-{judgement.parenchyma_removed_ml:.1f} ml "
        f"({judgement.parenchyma_removed_percent:.1f} %)",
        "calyces opened": NOT_LABELLED if opened is None else f"{opened:.0f} mm2",
    }
    if judgement.vessels is None:
        findings["vessels cut"] = NOT_LABELLED
    elif judgement.vessels:
        widest = judgement.vessels[0]
        findings["vessels cut"] = f"{len(judgement.vessels)}, {widest.tissue} {widest.diameter_mm:.1f} mm"
    return findings
