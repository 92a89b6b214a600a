"""One scene assembled: the body under its probe, advanced and imaged step by step.

The window, the headless run and every study use this class, so that they compute the same.
"""

from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

import numpy as np
import taichi as ti
import trimesh

from errors import PatientError
from rehearsal.build_solver import embedding_cell_mm
from rehearsal.pressed_organ import OrganState, PressedOrgan
from rehearsal.resection.cut import Cut, check_hilum, cut_organ, hilum_of, part_left
from rehearsal.resection.judgement import Carried, Judgement, judge
from rehearsal.resection.resection_state import NO_RESECTION, Resection
from rehearsal.resection.score_line import LEAST_MARKS, ResectionError, ScoreLine, score_line
from rehearsal.tissue_voxels import tissue_voxels
from scenes.anatomy import Grid, LoadedAnatomy
from scenes.scene import Scene
from scenes.surfaces import translated, volume_mm3
from scenes.terminal import ReportProgress, no_progress
from sim.embedding import Embedding
from sim.fields import array_of
from sim.skinning import Skin
from ultrasound.crater import Crater
from ultrasound.probe import Probe
from ultrasound.probe_manipulator import (
    ImagePlane,
    ManipulatorState,
    ProbeManipulator,
    advanced,
    image_plane,
    touching,
)
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
TUMOUR = "tumour"
# Cuts of this many states are kept, for undo and redo.
KEPT_CUTS = 4


@dataclass(frozen=True)
class RehearsalState(OrganState):
    """What changes: the state of the organ and its transducer, of the transducer's manipulator, and of the resection."""

    manipulator: ManipulatorState
    resection: Resection = NO_RESECTION


class Rehearsal(PressedOrgan):
    """A scene on the device: the organ under its probe, its surfaces, its images, and the manipulator that moves the probe.

    ``progress`` is called with what is being built; ``needs_b_mode`` prepares the B-mode image meanwhile. Without
    ``settles`` the organ is as it was segmented until ``take_settled``, for where another process brings it to rest.
    ``geometry_version`` counts how often the surfaces were built anew: by a cut, or its end.
    """

    geometry_version = 0

    def __init__(
        self,
        scene: Scene,
        anatomy: LoadedAnatomy,
        probe: Probe | None = None,
        progress: ReportProgress = no_progress,
        needs_b_mode: bool = False,
        settles: bool = True,
        serial: bool | None = None,
    ) -> None:
        scanned, acoustics = None, None
        if anatomy.ct is not None:
            origin = anatomy.organ.bounds.mean(axis=0)
            scanned = scanned_anatomy(
                translated(anatomy.organ, -origin), anatomy.ct, anatomy, origin, scene.image.atlas
            )
            acoustics = start_acoustics(scanned) if needs_b_mode else None
        progress("Building the model: tissue and contacts")
        super().__init__(scene, anatomy, probe, serial)
        self.resection = NO_RESECTION
        self.score: ScoreLine | None = None
        self.score_fault = ""
        self._score_points: Skin | None = None
        self._cuts: dict[Resection, Cut] = {}
        self._judgements: dict[Resection, Judgement | None] = {}
        self.judgement_fault = ""
        self._labels = anatomy.labels, anatomy.tissues
        self.whole_tumour = anatomy.tumour and translated(anatomy.tumour, -self.origin)
        self.whole_parts = {tissue: translated(part, -self.origin) for tissue, part in anatomy.parts.items()}
        meshes = [shape for shape in anatomy.shapes if isinstance(shape, trimesh.Trimesh)]
        self.supports = [_shrunk(translated(mesh, -self.origin), SUPPORT_SUNK_MM) for mesh in meshes]
        progress("Building the model: surfaces")
        self._build_surfaces(self._remains(None))
        self._build_scanner(scanned, acoustics)
        if settles:
            progress("Building the model: the tissue comes to rest")
        self.take_settled(self.settle() if settles else self.snapshot_of_organ())

    def take_settled(self, state: OrganState) -> None:
        """Begin with the organ at rest and the transducer just touching."""
        self.restore_organ(state)
        self.divergence_check.set_initial_state()
        self.update_surfaces()
        self.pose = self._press_pose()
        self.manipulator = self._manipulator()
        self.pose = self.manipulator.pose()
        self.settled = self.snapshot()

    def _remains(self, cut: Cut | None) -> dict[str, trimesh.Trimesh]:
        """What a cut leaves of the tumour and the other parts that are drawn, by tissue. Raises PatientError."""
        # The sinus surrounds the other parts, and would hide them.
        parts = {tissue: part for tissue, part in self.whole_parts.items() if tissue != "sinus"}
        left = {tissue: part_left(part, cut) for tissue, part in parts.items()}
        if self.whole_tumour is not None:
            left[TUMOUR] = part_left(self.whole_tumour, cut, is_within=True)
        return {tissue: part for tissue, part in left.items() if part is not None}

    def _build_surfaces(self, remains: dict[str, trimesh.Trimesh]) -> None:
        """The surfaces that move with the tissue: of the organ, and of its tumour and other parts by tissue."""
        self.tumour = remains.get(TUMOUR)
        self.parts = {tissue: part for tissue, part in remains.items() if tissue != TUMOUR}
        self.organ_skin = Skin(self.model, self.organ.vertices)
        self.tumour_skin = self._tumour_border = None
        if self.tumour is not None:
            self._tumour_border = Skin(self.model, self.tumour.vertices)
            drawn = self.tumour.vertices + TUMOUR_LIFT_MM * self.tumour.vertex_normals
            self.tumour_skin = Skin(self.model, drawn)
        self.part_skins = {tissue: Skin(self.model, part.vertices) for tissue, part in self.parts.items()}

    def _build_scanner(self, scanned: ScannedAnatomy | None, acoustics: Future[np.ndarray] | None) -> None:
        image = self.scene.image
        margin = SURROUNDINGS_MM if shows_ct(image.outside) else 0.0
        self.embedding = Embedding(self.model, self.organ, embedding_cell_mm(self.scene.tissue), margin)
        self.scanner = None
        if scanned is not None:
            around = image.outside, image.contact, image.coupling_gap_mm
            self.scanner = Scanner(scanned, self.embedding, self.probe, image.pixels, *around, acoustics)

    def _manipulator(self) -> ProbeManipulator:
        settled = array_of(self.organ_skin.vertices).astype(float)
        faces = np.array(self.organ.faces, np.int64)
        normals = np.array(trimesh.Trimesh(settled, faces, process=False).vertex_normals)
        lateral, radius = np.array(self.press.lateral), self.probe.radius_mm
        speed = self.scene.transducer.speed_mm_s
        manipulator = ProbeManipulator(
            settled, faces, normals, self.size_mm, self.pose, lateral, radius, speed
        )
        manipulator.home = touching(self.pose, self.size_mm, manipulator.samples, radius)
        return manipulator

    def scripted_pose(self, time_s: float) -> np.ndarray:
        """The transducer's pose at a time of the scripted press: touching at first, then deeper stage by stage."""
        depths = [0.0, *self.press.indentations_mm]
        stage = time_s / self.scene.solver.time_step_s / self.press.stage_steps
        return self.pose_at_depth(float(np.interp(stage, np.arange(len(depths)), depths)))

    def pose_at_depth(self, depth_mm: float) -> np.ndarray:
        """The transducer's pose at a depth of the scripted press."""
        return advanced(self.manipulator.home, depth_mm)

    def script_length_s(self) -> float:
        """Duration of the scripted press [s]."""
        return len(self.press.indentations_mm) * self.press.stage_steps * self.scene.solver.time_step_s

    def pose_towards(self, goal: np.ndarray) -> np.ndarray:
        """The transducer's next pose towards a goal (4, 4): at most at the scene's speed, and not through the organ."""
        return self.manipulator.pose_towards(goal, self.pose, self.settings.time_step_s)

    def snapshot(self, manipulator: ManipulatorState | None = None) -> RehearsalState:
        """A copy of the present state, with the manipulator's present state or another one."""
        organ = self.snapshot_of_organ()
        return RehearsalState(
            organ.solver,
            organ.divergence,
            organ.pose,
            organ.steps,
            manipulator or self.manipulator.state,
            self.resection,
        )

    def restore(self, state: RehearsalState) -> None:
        """Restore a state; the steps that follow give the same bits as before."""
        # First the tissue that is there: contact points that the cut moves lose their friction, which the state then restores.
        self.set_resection(state.resection)
        self.restore_organ(state)
        self.manipulator.state = state.manipulator

    def set_resection(self, resection: Resection) -> None:
        """Have these marks of the score and this cut. Raises ResectionError, before anything has changed."""
        if resection == self.resection:
            return
        cut = None if resection.cut is None else self._cut_of(resection)
        if cut is not self.cut:
            self.apply_cut(cut)
        if resection.marks != self.resection.marks:
            self._set_score(resection.points())
        self.resection = resection

    def _set_score(self, marks: np.ndarray) -> None:
        """The line through marks (n, 3), which moves with the tissue; ``score_fault`` says why there is none."""
        self.score, self.score_fault = None, ""
        if len(marks) >= LEAST_MARKS:
            try:
                self.score = score_line(self.whole_organ, marks)
            except ResectionError as error:
                self.score_fault = str(error)
        shown = marks if self.score is None else np.concatenate([self.score.points, self.score.marks])
        self._score_points = Skin(self.model, shown) if len(marks) else None

    def score_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Present places [mm] of the score: points (k, 3) of the closed line, and its marks (n, 3)."""
        if self._score_points is None:
            return np.zeros((0, 3)), np.zeros((0, 3))
        self._score_points.update()
        points = array_of(self._score_points.vertices).astype(float)
        on_line = 0 if self.score is None else len(self.score.points)
        return points[:on_line], points[on_line:]

    def _cut_of(self, resection: Resection) -> Cut:
        """The cut of a resection. Raises ResectionError."""
        if resection not in self._cuts and resection.cut is not None:
            line = score_line(self.whole_organ, resection.points())
            tumour = np.zeros((0, 3)) if self.whole_tumour is None else np.asarray(self.whole_tumour.vertices)
            seen = tumour[resection.cut.seen_of(len(tumour))]
            made = cut_organ(self.whole_organ, line, resection.cut.settings, seen)
            check_hilum(made, self.whole_organ, hilum_of(self.scene.attachment, self.origin))
            self._cuts = dict([*self._cuts.items(), (resection, made)][-KEPT_CUTS:])
        return self._cuts[resection]

    def apply_cut(self, cut: Cut | None) -> None:
        # Before anything changes: a part's surface may be one that cannot be cut.
        remains = self._remains(cut)
        super().apply_cut(cut)
        self._build_surfaces(remains)
        self.geometry_version += 1
        self.embedding.skin.attach_again()
        if self.scanner is not None:
            crater = None if cut is None else Crater(cut.specimen, cut.settings.filling)
            self.scanner.volumes.set_crater(crater)
        if self._score_points is not None:
            self._score_points.attach_again()

    def carried_then(self, points: np.ndarray) -> np.ndarray:
        """Where points (n, 3) [mm] of the whole organ at rest were when it was cut. Raises ResectionError without a cut."""
        request = self.resection.cut
        if request is None:
            raise ResectionError("nothing was cut yet")
        return self.model.whole_lattice.carried(  # type: ignore[attr-defined]
            np.asarray(points, float), request.nodes_mm
        )

    def specimen_beside(self) -> np.ndarray:
        """Vertices (n, 3) [mm] of the specimen as it was cut, beside the end of the organ that is nearer to it. Raises ResectionError."""
        if self.cut is None:
            raise ResectionError("nothing was cut yet")
        vertices = self.carried_then(self.cut.specimen.vertices)
        long_axis = np.array(self.press.lateral)
        organ, own = np.asarray(self.whole_organ.vertices) @ long_axis, vertices @ long_axis
        side = 1.0 if own.mean() >= organ.mean() else -1.0
        reach = (side * organ).max() - (side * own).min()
        return vertices + side * (reach + BESIDE_MM) * long_axis

    @property
    def judgement(self) -> Judgement | None:
        """The figures of the cut; None without a cut, without a tumour to judge by, or where ``judgement_fault`` says why there are none."""
        cut, tumour, key = self.cut, self.whole_tumour, self.resection
        if cut is None or tumour is None:
            return None
        if key not in self._judgements:
            surfaces = (self.whole_organ, cut.specimen, cut.remnant, tumour)
            as_cut = Carried(*(self.carried_then(each.vertices) for each in surfaces))
            labels, tissues = self._labels
            moved = labels and Grid(labels.voxels, labels.index_from_mm @ shift_by(self.origin))
            given = cut, self.whole_organ, tumour, self.whole_parts, as_cut, moved, tissues
            self.judgement_fault = ""
            try:
                self._judgements = {key: judge(*given)}
            except PatientError as error:
                self._judgements, self.judgement_fault = {key: None}, f"no figures of the cut: {error}"
        return self._judgements[key]

    def update_surfaces(self) -> None:
        """Move the drawn surfaces with the body."""
        self.organ_skin.update()
        if self.tumour_skin is not None:
            self.tumour_skin.update()
        for skin in self.part_skins.values():
            skin.update()

    def find_plane(self, probe: Probe) -> None:
        """Locate the image plane in the tissue without computing an image."""
        if self.scanner is not None:
            self.scanner.locate(self.image_plane(probe))

    def image_plane(self, probe: Probe | None = None) -> ImagePlane:
        """The present image plane, of the extent of the probe or of the probe with other settings."""
        return image_plane(self.pose, self.size_mm[2], *(probe or self.probe).extent_mm)

    def rest_grid(self) -> np.ndarray | None:
        """Rest positions (n, n, 3) [mm] of a grid over the last image; None without a CT."""
        return None if self.scanner is None else self.scanner.plane.rest_grid(REST_PLACES)

    def tumour_outline(self, at_rest: bool = False) -> np.ndarray | None:
        """The tumour's outline on the image plane, deformed or as in the CT: segments (n, 2, 2) on the plane [mm].

        None without a tumour.
        """
        if self.tumour is None:
            return None
        plane = self.image_plane()
        vertices = np.asarray(self.tumour.vertices) if at_rest else self.tumour_vertices()
        return plane_section(vertices, self.tumour.faces, np.linalg.inv(plane.world_from_plane))

    def tumour_vertices(self) -> np.ndarray:
        """Present vertices (n, 3) [mm] of the tumour's surface; empty without a tumour."""
        if self._tumour_border is None:
            return np.zeros((0, 3))
        self._tumour_border.update()
        return array_of(self._tumour_border.vertices).astype(float)

    def indentation_mm(self) -> float:
        """Depth of the transducer below the settled surface [mm]; negative above it."""
        return self.manipulator.indentation_mm(self.pose)

    def volume_ratio(self) -> float:
        """Volume inside the deformed surface relative to the one at rest."""
        carried = array_of(self.organ_skin.vertices)
        return float(volume_mm3(carried, self.organ.faces) / self.organ.volume)

    def reset(self) -> None:
        """Restore the start: tissue settled, transducer just touching."""
        self.restore(self.settled)
        ti.sync()


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
    given = organ, ct.voxels, ct.index_from_mm @ shift, label_values, anatomy.tissues, tumour
    return ScannedAnatomy(*given, classify)
