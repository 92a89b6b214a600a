"""The anatomy as a frame deforms it: surfaces, image plane, figures of a cut.

It needs no solver: the frame carries its points.
"""

from concurrent.futures import Future
from dataclasses import replace
from functools import partial

import numpy as np
import trimesh

from errors import PatientError
from rehearsal.build_solver import embedding_cell_mm
from rehearsal.case import Case
from rehearsal.loop.frame import Frame, RestGeometry
from rehearsal.resection.cut import Cut
from rehearsal.resection.drawn_cut import DrawnCut, drawn_cut
from rehearsal.resection.judgement import Carried, Judgement, judge
from rehearsal.resection.resection_state import Resection, cut_of
from rehearsal.resection.score_line import ResectionError
from rehearsal.tissue_voxels import tissue_voxels
from rehearsal.vessel_kinds import vessel_kinds
from scenes.anatomy import Grid, LoadedAnatomy
from scenes.surfaces import FineSurface, translated, volume_mm3
from sim.embedding import Embedding
from sim.fields import Field, array_of
from sim.skinning import Interpolation, Skin
from ultrasound.crater import Crater
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import ImagePlane
from ultrasound.scanned_anatomy import ScannedAnatomy, start_acoustics
from ultrasound.scanner import Scanner, plane_section, shows_ct

# Where the tumour protrudes, organ and tumour share a surface: the tumour's is drawn this far outside.
TUMOUR_LIFT_MM = 0.8
# Organ and support share a surface where they touch: the support is drawn this far inside.
SUPPORT_SUNK_MM = 0.4
# How far around the organ the surrounding tissue in the image moves with it.
SURROUNDINGS_MM = 25.0
# Points along each side of an image whose rest positions are computed.
REST_PLACES = 48
# Gap between the organ and the specimen beside it.
BESIDE_MM = 8.0


class DeformedAnatomy:
    """The surfaces of a case, and what its scanner images, as the frame that was shown last deforms them.

    Each version of the geometry has skins of its own. ``start`` is the CT, classified in the background since
    then.
    """

    frame: Frame

    def __init__(
        self,
        case: Case,
        anatomy: LoadedAnatomy,
        interpolation: Interpolation,
        scanned: "ScannedCt | None" = None,
    ) -> None:
        self.case, self._labels = case, (anatomy.labels, anatomy.tissues)
        self._carrier = interpolation.carrier()
        meshes = [shape for shape in case.shapes if isinstance(shape, trimesh.Trimesh)]
        self.supports = [_shrunk(translated(mesh, -case.origin), SUPPORT_SUNK_MM) for mesh in meshes]
        self._judged: dict[Resection, tuple[Judgement | None, str]] = {}
        self._skins: dict[str, Skin] = {}
        self._fine: tuple[FineSurface, Skin] | None = None
        self.drawn_remnant: DrawnCut | None = None
        self._version = -1
        image = case.scene.image
        margin = SURROUNDINGS_MM if shows_ct(image.outside) else 0.0
        cell_mm = embedding_cell_mm(case.scene.tissue)
        self.embedding = Embedding(self._carrier, case.organ, cell_mm, margin)
        self.scanner: Scanner | None = None
        if scanned is not None:
            around = image.outside, image.contact, image.coupling_gap_mm
            inputs = scanned.anatomy, self.embedding, case.probe, image.pixels, *around, scanned.acoustics
            self.scanner = Scanner(*inputs)

    def show(self, frame: Frame) -> None:
        """Take over a frame: move the surfaces, and have those of its geometry where it is another one."""
        self.frame = frame
        self._carrier.move(frame.carriers)
        if frame.geometry.version != self._version:
            self._change_geometry(frame.geometry)
        for skin in self._skins.values():
            skin.update()

    def _change_geometry(self, geometry: RestGeometry) -> None:
        self._version, self._fine = geometry.version, None
        self._carrier.interpolation = geometry.interpolation
        self._skins = {"organ": Skin(self._carrier, geometry.organ.vertices)}
        self._skins |= {f"part {name}": self.skin(part.vertices) for name, part in geometry.parts.items()}
        if (tumour := geometry.tumour) is not None:
            self._skins["tumour"] = self.skin(tumour.vertices)
            self._skins["drawn tumour"] = self.skin(tumour.vertices + TUMOUR_LIFT_MM * tumour.vertex_normals)
        self.drawn_remnant, cut = None, geometry.cut
        if cut is not None:
            self.drawn_remnant = drawn_cut(cut.remnant, cut.on_remnant)
            self._skins["drawn organ"] = self.skin(self.drawn_remnant.vertices)
        self.embedding.skin.attach_again()
        if self.scanner is not None:
            crater = None if cut is None else Crater(cut.specimen, cut.settings.filling)
            self.scanner.volumes.set_crater(crater)

    def skin(self, points: np.ndarray) -> Skin:
        """Points (n, 3) [mm] of the tissue at rest that move with it; ``update`` takes them to the present
        frame.
        """
        return Skin(self._carrier, points)

    # At rest

    @property
    def geometry(self) -> RestGeometry:
        """Of the present frame."""
        return self.frame.geometry

    @property
    def organ(self) -> trimesh.Trimesh:
        """The organ's surface at rest: after a cut, of what remains."""
        return self.geometry.organ

    @property
    def tumour(self) -> trimesh.Trimesh | None:
        """The tumour's surface at rest, as far as a cut leaves it."""
        return self.geometry.tumour

    @property
    def cut(self) -> Cut | None:
        """The cut that was made."""
        return self.geometry.cut

    # Now

    @property
    def pose(self) -> np.ndarray:
        """The transducer's pose (4, 4)."""
        return self.frame.pose

    @property
    def vertices(self) -> np.ndarray:
        """Present vertices (n, 3) [mm] of the organ's surface."""
        return array_of(self._skins["organ"].vertices).astype(float)

    def fine_organ(self) -> tuple[FineSurface, np.ndarray]:
        """The organ's surface with each face divided in four, which follows a probe's edges more closely, and
        its present vertices (n, 3) [mm].
        """
        if self._fine is None:
            fine = FineSurface.of(self.organ)
            self._fine = fine, self.skin(fine.vertices)
        fine, skin = self._fine
        skin.update()
        return fine, array_of(skin.vertices).astype(float)

    @property
    def tumour_vertices(self) -> np.ndarray:
        """Present vertices (n, 3) [mm] of the tumour's surface; empty without a tumour."""
        if "tumour" not in self._skins:
            return np.zeros((0, 3))
        return array_of(self._skins["tumour"].vertices).astype(float)

    @property
    def drawn_organ(self) -> Field:
        """The vertices (n,) of the organ, after a cut those of ``drawn_remnant``, which move with each frame
        of this version.
        """
        return self._skins["organ" if self.drawn_remnant is None else "drawn organ"].vertices

    @property
    def drawn_tumour(self) -> Field | None:
        """The tumour's vertices (n,), slightly outside of it; None without a tumour."""
        return self._skins["drawn tumour"].vertices if "drawn tumour" in self._skins else None

    @property
    def drawn_parts(self) -> dict[str, Field]:
        """The vertices (n,) of other parts, by tissue."""
        return {name: self._skins[f"part {name}"].vertices for name in self.geometry.parts}

    def vessel_kinds(self) -> np.ndarray | None:
        """Artery, vein, or vessel where no label says which, of the vertices (n,) of the vessels; None
        without any.
        """
        vessels = self.geometry.parts.get("vessel")
        if vessels is None:
            return None
        return vessel_kinds(vessels.vertices, self._moved_labels(), self._labels[1])

    def find_plane(self, probe: Probe) -> None:
        """Locate the image plane in the tissue without computing an image."""
        if self.scanner is not None:
            self.scanner.locate(self.image_plane(probe))

    def image_plane(self, probe: Probe | None = None) -> ImagePlane:
        """The present image plane, of the extent of the probe or of the probe with other settings."""
        return self.case.image_plane(self.pose, probe)

    def probe_in_patient(self) -> np.ndarray:
        """The present pose (4, 4) of the probe in the patient (LPS), in PLUS's axes."""
        return self.case.probe_in_patient(self.pose)

    def rest_grid(self) -> np.ndarray | None:
        """Rest positions (n, n, 3) [mm] of a grid over the last image; None without a CT."""
        return None if self.scanner is None else self.scanner.plane.rest_grid(REST_PLACES)

    def tumour_outline(self, at_rest: bool = False) -> np.ndarray | None:
        """The tumour's outline on the image plane, deformed or as in the CT: segments (n, 2, 2) on the plane
        [mm].

        None without a tumour.
        """
        if self.tumour is None:
            return None
        vertices = np.asarray(self.tumour.vertices) if at_rest else self.tumour_vertices
        return plane_section(vertices, self.tumour.faces, np.linalg.inv(self.image_plane().world_from_plane))

    def volume_ratio(self) -> float:
        """Volume inside the deformed surface relative to the one at rest."""
        return float(volume_mm3(self.vertices, self.organ.faces) / self.organ.volume)

    # A cut

    def carried_then(self, points: np.ndarray, resection: Resection | None = None) -> np.ndarray:
        """Where points (n, 3) [mm] of the whole organ at rest were when it was cut, as the present resection
        or another one has it.

        Raises ResectionError without a cut.
        """
        request = (resection or self.frame.resection).cut
        if request is None:
            raise ResectionError("nothing was cut yet")
        return self.geometry.whole.carried(np.asarray(points, float), request.nodes_mm)  # type: ignore[attr-defined]

    def specimen_beside(self) -> DrawnCut:
        """The specimen as it was cut, beside the end of the organ that is nearer to it. Raises
        ResectionError.
        """
        if self.cut is None:
            raise ResectionError("nothing was cut yet")
        drawn = drawn_cut(self.cut.specimen, self.cut.on_specimen)
        return replace(drawn, vertices=self._beside(drawn.vertices))

    def _beside(self, points: np.ndarray) -> np.ndarray:
        """Where points (n, 3) [mm] of the specimen at rest are, beside the organ. Raises ResectionError."""
        if self.cut is None:
            raise ResectionError("nothing was cut yet")
        specimen = self.carried_then(self.cut.specimen.vertices)
        long_axis = np.array(self.case.press.lateral)
        organ, own = np.asarray(self.case.organ.vertices) @ long_axis, specimen @ long_axis
        side = 1.0 if own.mean() >= organ.mean() else -1.0
        reach = (side * organ).max() - (side * own).min()
        return self.carried_then(points) + side * (reach + BESIDE_MM) * long_axis

    def tumour_beside(self) -> np.ndarray:
        """Vertices (n, 3) [mm] of ``tumour_in_specimen``, in the specimen beside the organ."""
        tumour = self.tumour_in_specimen
        if tumour is None:
            return np.zeros((0, 3))
        # Where the tumour protrudes, specimen and tumour share a surface too.
        return self._beside(tumour.vertices + TUMOUR_LIFT_MM * tumour.vertex_normals)

    @property
    def tumour_in_specimen(self) -> trimesh.Trimesh | None:
        """The surface at rest of the tumour that was cut out; None without a cut or where none came with
        it.
        """
        return self.geometry.tumour_cut_out

    @property
    def judgement(self) -> Judgement | None:
        """The figures of the cut; None without a cut, without a tumour to judge by, or where
        ``judgement_fault`` says why there are none.
        """
        return self.judgement_of(self.frame.resection)[0]

    @property
    def judgement_fault(self) -> str:
        """Why there are no figures of the cut; empty where there are, or nothing was cut."""
        return self.judgement_of(self.frame.resection)[1]

    def judgement_of(self, resection: Resection) -> tuple[Judgement | None, str]:
        """The figures of a cut of this session, also of one that was undone; None without a cut or a tumour,
        and where the text says why there are none.
        """
        tumour = self.case.tumour
        if resection.cut is None or tumour is None:
            return None, ""
        if resection not in self._judged:
            try:
                self._judged[resection] = self._judge(resection, tumour), ""
            except (PatientError, ResectionError) as error:
                self._judged[resection] = None, f"no figures of the cut: {error}"
        return self._judged[resection]

    def _judge(self, resection: Resection, tumour: trimesh.Trimesh) -> Judgement | None:
        """Judge a cut, which is made anew where it is not the present one. Raises PatientError,
        ResectionError.
        """
        organ, is_present = self.case.organ, resection == self.frame.resection
        cut = self.cut if is_present else cut_of(resection, organ, tumour)
        if cut is None:
            return None
        surfaces = organ, cut.specimen, cut.remnant, tumour
        as_cut = Carried(*(self.carried_then(surface.vertices, resection) for surface in surfaces))
        return judge(cut, organ, tumour, self.case.parts, as_cut, self._moved_labels(), self._labels[1])

    def _moved_labels(self) -> Grid | None:
        """The labels, relative to the origin of the case."""
        labels = self._labels[0]
        return labels and Grid(labels.voxels, labels.index_from_mm @ shift_by(self.case.origin))


class ScannedCt:
    """The CT of an anatomy as the scanner needs it; ``acoustics`` are computed in the background from now
    on, where they are needed soon.
    """

    def __init__(self, case: Case, anatomy: LoadedAnatomy, ct: Grid, needs_b_mode: bool) -> None:
        self.anatomy = scanned_anatomy(case.organ, ct, anatomy, case.origin, case.scene.image.atlas)
        self.acoustics: Future[np.ndarray] | None = start_acoustics(self.anatomy) if needs_b_mode else None


def scanned_ct(case: Case, anatomy: LoadedAnatomy, needs_b_mode: bool = False) -> ScannedCt | None:
    """The CT of an anatomy for the scanner; None without one."""
    return None if anatomy.ct is None else ScannedCt(case, anatomy, anatomy.ct, needs_b_mode)


def _shrunk(mesh: trimesh.Trimesh, by_mm: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices - by_mm * mesh.vertex_normals, mesh.faces, process=False)


def shift_by(origin: np.ndarray) -> np.ndarray:
    """The affine map (4, 4) from places relative to an origin (3,) to the patient's."""
    shift = np.eye(4)
    shift[:3, 3] = origin
    return shift


def scanned_anatomy(
    organ: trimesh.Trimesh, ct: Grid, anatomy: LoadedAnatomy, origin: np.ndarray, draws: bool
) -> ScannedAnatomy:
    """The anatomy as the scanner needs it, relative to an origin; the organ is already moved there.

    ``draws``: also what no CT shows, as ``image.atlas`` of a scene says.
    """
    labels, shift = anatomy.labels, shift_by(origin)
    label_values = None if labels is None else labels.voxels.astype(np.int32)
    tumour = anatomy.tumour and translated(anatomy.tumour, -origin)
    classify = None if labels is None else partial(tissue_voxels, labels, anatomy, ct, draws, origin)
    inputs = organ, ct.voxels, ct.index_from_mm @ shift, label_values, anatomy.tissues, tumour
    return ScannedAnatomy(*inputs, classify)
