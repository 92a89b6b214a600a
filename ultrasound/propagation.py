"""Sound in tissue: what each scanline passes through, which interfaces reflect it, and how much of it
arrives.

1. ``_sample``: the tissue along each scanline.
2. ``_find_interfaces``: the steps of impedance, their echoes and what they let pass.
3. ``ApertureRays``: the amplitude that arrives at each sample, along several rays from the aperture.
"""

import numpy as np
import taichi as ti
import taichi.math as tm

from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from sim.taichi_internals import TASK
from ultrasound.acoustics import MAST_OFFSET, MAST_SLOPE, acoustic_values
from ultrasound.aperture_rays import ApertureRays
from ultrasound.beam import half_apertures_mm
from ultrasound.interface import (
    HARD,
    LEAST_REFRACTING,
    MIN_REFLECTION,
    Interface,
    Surface,
    diffuse,
    specular,
)
from ultrasound.plane_in_tissue import PlaneInTissue
from ultrasound.probe import BUILD_UP_MM, Probe
from ultrasound.pulse import DB_OF_NEPER, PATH_ENTRIES, PATH_STEP, SOUND_MM_US
from ultrasound.sampled_volume import SampledVolume

# Scanline samples between two tissue samples: the larger stride where it is no longer than a voxel.
STRIDES = (8, 4)
# Parallel planes that sample the slice thickness: offset in standard deviations of the beam, and weight of
# energy. Gauss-Hermite quadrature with three nodes, exact for what changes as a polynomial of fifth degree.
CENTRAL_PLANE = ((0.0, 1.0),)
THICK_PLANE = ((0.0, 2 / 3), (-(1.5**0.5), 1 / 6), (1.5**0.5, 1 / 6))
# The renal capsule's echo where the beam meets it squarely, the angle [rad] by which it falls to exp(-1/2),
# and the share of a mirror. An estimate: sonographers expect a thin bright line, which fades where the beam
# is more than 20 degrees off.
CAPSULE, CAPSULE_TILT, CAPSULE_MIRROR = 0.1, float(np.radians(10)), 0.85
# Of distances from the organ's surface, between the points at which they are known (``distance_volume``).
DISTANCE_ERROR_MM = 2.0
# What has less impedance is gas: in an empty crater no fluid stays.
LEAST_FLUID_MRAYL = 0.3


@ti.dataclass
class TissueSample:
    """Impedance, attenuation, backscatter and its anisotropy; the rest position [mm]; the map (3, 4) from
    the image plane to it.
    """

    tissue: tm.vec4
    rest: tm.vec3
    linear: ti.types.matrix(3, 4, ti.f32)


class Propagation:
    """Sound along the scanlines of a probe, at tissue samples ``stride_of`` scanline samples apart.

    ``tissue_volume`` (.., 4) has impedance, attenuation, backscatter and its anisotropy
    (``acoustics.properties``), ``organ`` the signed distance from the organ's surface [mm], both at rest. An
    element transmits and receives only in contact: where the organ is in front of it, nearer than
    ``contact_gap_mm``, or, where ``contact`` is "tissue", anything but gas. ``around`` is the
    impedance [MRayl] of all that is outside the organ; None for what the CT shows there. With ``has_fluid``,
    what a scanline passes from the array to the organ, nearer than ``contact_gap_mm`` all the way, is
    irrigation fluid, but no gas.

    ``tissue`` and ``rest`` (scanlines, samples) are what is there; ``across`` is the rest direction across
    the image plane. ``depth`` is where a sample is [mm]; the scanner shows it where it would be if sound were
    as fast everywhere (SOUND_MM_US). ``amplitude`` of the round trip, and ``path`` [Np/MHz], its attenuation.
    ``echo`` holds for the sample behind an interface: amplitude reflected as a mirror (with its sign) and
    diffusely, depth [mm], and the sample where the tissue before it begins; ``capsule`` the same for the
    renal capsule, a thin layer that no CT shows.
    """

    def __init__(
        self,
        tissue_volume: SampledVolume,
        organ: SampledVolume,
        plane: PlaneInTissue,
        probe: Probe,
        voxel_mm: float,
        contact: str = "organ",
        contact_gap_mm: float = 1.5,
        around: float | None = None,
        has_fluid: bool = False,
    ) -> None:
        self.tissue_volume, self.organ, self.plane, self.voxel_mm = tissue_volume, organ, plane, voxel_mm
        # A CT blurs an interface by about a voxel to each side.
        self.interface_mm = 5.0 * voxel_mm
        self.by_organ, self.gap_mm = contact == "organ", contact_gap_mm
        self.organ_alone, self.around = around is not None, around or 0.0
        self.has_fluid, self.fluid = has_fluid, acoustic_values("fluid")
        self.surface = Surface()
        self.lines, samples = probe.number_of_scanlines, probe.number_of_samples_per_scanline
        self.most = samples // STRIDES[1] + 1
        shape = self.lines, self.most
        self.start, self.direction, self.element, self.facing = (
            zeros(self.lines, 2, within=1) for _ in range(4)
        )
        self.contact = zeros(self.lines)
        self.tissue, self.rest, self.across = (zeros(*shape, 3, within=1) for _ in range(3))
        self.echo, self.capsule = (zeros(*shape, 4, within=1) for _ in range(2))
        self.depth, self.passed, self.amplitude, self.path = (zeros(*shape) for _ in range(4))
        # Turned by refraction at a sample [rad].
        self.turn = zeros(*shape)
        # Half angle of the aperture [rad], SD of the beam across the image plane [mm] and amplitude of
        # harmonics, at each sample.
        self.aperture_angle, self.slice_sd, self.build_up = (zeros(self.most) for _ in range(3))
        self.speckle_db, self.echo_db = (zeros(PATH_ENTRIES) for _ in range(2))
        # Half angle of the aperture across the plane [rad]; of interfaces: amplitudes reflected as a mirror
        # and diffusely, slope, amplitudes scattered evenly by soft and by hard ones.
        self.reflection = zeros(6)
        self.rays = ApertureRays(self.lines, self.most)

    def stride_of(self, probe: Probe) -> int:
        """The scanline samples between two tissue samples."""
        return STRIDES[0] if STRIDES[0] * probe.sample_mm <= self.voxel_mm else STRIDES[1]

    def set_probe(self, probe: Probe, slice_sd_mm: np.ndarray) -> None:
        """Update the tables of a probe's settings; the SD of the beam across the plane is given at each
        sample.
        """
        step_mm = self.stride_of(probe) * probe.sample_mm
        depth = step_mm * np.arange(self.most)
        transmit, receive = half_apertures_mm(probe, np.maximum(depth, 0.5 * step_mm))
        receive = np.minimum(receive, probe.array_width_mm / 2)
        transmit = np.minimum(transmit, probe.array_width_mm / 2)
        angle = (
            np.arctan(transmit / probe.focus_mm) + np.arctan(receive / np.maximum(depth, 0.5 * step_mm))
        ) / 2
        pulse = probe.pulse
        start, direction = probe.scanlines()
        own = self.surface.slope, self.surface.scattered, self.surface.scattered_hard
        elevation = np.arctan(probe.element_height_mm / 2 / probe.elevation_focus_mm)
        self.rays.set_probe(probe, depth)
        fill(
            (self.start, start),
            (self.direction, direction),
            (self.element, probe.elements()),
            (self.facing, probe.face_normals()),
            (self.aperture_angle, angle),
            (self.slice_sd, slice_sd_mm),
            (
                self.build_up,
                (depth + 0.1) / (depth + BUILD_UP_MM) if probe.harmonics else np.ones_like(depth),
            ),
            (self.speckle_db, pulse.speckle_db),
            (self.echo_db, pulse.echo_db),
            (
                self.reflection,
                np.array([elevation, *self.surface.mirror_and_diffuse(probe.wavelength_mm), *own]),
            ),
        )

    def run(self, probe: Probe, thick: bool) -> None:
        """Propagate sound through the plane located last; ``thick`` averages the tissue over the slice
        thickness.
        """
        stride = self.stride_of(probe)
        count = probe.number_of_samples_per_scanline // stride + 1
        self._find_contact()
        if probe.transducer_geometry == "PHASED":
            # A phased array transmits every scanline with all of its elements.
            fill((self.contact, np.full(self.lines, array_of(self.contact).mean())))
        self._sample(thick, count, stride * probe.sample_mm)
        self._find_interfaces(count, stride * probe.sample_mm)
        self.rays.follow(self.contact, self.tissue, self.depth, self.passed, self.turn, count)
        self.rays.combine(self.build_up, count, self.amplitude, self.path)

    @kernel
    def _find_contact(self):
        """Set for each element of the array whether it is in contact."""
        for i in range(self.lines):
            # An organ is thicker than the gap: it is nearer where the end of the gap is in it. Of gas and
            # tissue in a voxel, half of the gap.
            place = self.element[i] + ti.static(1.0 if self.by_organ else 0.5) * self.gap_mm * self.facing[i]
            row, column = self.plane.pixel_near(place)
            rest = self.plane.rest_from_plane(row, column) @ tm.vec4(place, 0.0, 1.0)
            near = 0
            if ti.static(self.by_organ):
                near = self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0
            else:
                near = self.tissue_volume.sample(rest)[0] > 1.0
            self.contact[i] = ti.cast(near, ti.f32)

    @kernel
    def _sample(self, thick: ti.template(), count: int, step_mm: float):
        for n in range(self.lines * TASK):
            if n % TASK == 0:
                self.sample_scanline(thick, n // TASK, count, step_mm)

    @ti.func
    def sample_scanline(self, thick: ti.template(), line, count, step_mm):
        """Sample a scanline at even steps of time, which are as long as sound is fast in the tissue."""
        depth, in_front, parenchyma_before = 0.0, True, False
        # No surface of the organ is so near.
        clear_mm = 0.0
        for k in range(count):
            planes = ti.static(THICK_PLANE if thick else CENTRAL_PLANE)
            sample = self.tissue_at(planes, self.start[line] + depth * self.direction[line], self.slice_sd[k])
            self.capsule[line, k] = tm.vec4(0.0)
            is_parenchyma = sample.tissue.w > 0.5
            if k > 0 and (is_parenchyma or parenchyma_before):
                clear_mm -= (sample.rest - self.rest[line, k - 1]).norm()
                if clear_mm <= 0.0:
                    before, after = self.organ.sample(self.rest[line, k - 1]), self.organ.sample(sample.rest)
                    if before * after < 0.0:
                        self.add_capsule(line, k, sample, before / (before - after), step_mm)
                    clear_mm = ti.abs(after) - DISTANCE_ERROR_MM
            else:
                clear_mm = 0.0
            parenchyma_before = is_parenchyma
            if ti.static(self.has_fluid):
                if in_front:
                    distance = self.organ.sample(sample.rest)
                    # Where a scanline passes the organ at a distance, what is behind is the organ's
                    # surroundings, no fluid on it.
                    in_front = distance > 0.0 and distance <= self.gap_mm
                    if in_front and sample.tissue.x > LEAST_FLUID_MRAYL:
                        sample.tissue = tm.vec4(self.fluid)
            self.tissue[line, k] = sample.tissue.xyz
            if sample.tissue.w > 0.0:
                self.tissue[line, k].z *= self.anisotropy(sample, self.direction[line])
            self.rest[line, k] = sample.rest
            self.across[line, k] = sample.linear[:, 2]
            self.depth[line, k] = depth
            depth += step_mm * speed_ratio(sample.tissue.x)

    @ti.func
    def add_capsule(self, line, k, sample, share, step_mm):
        """Write the echo of the renal capsule, which a scanline passes at a share of the way to a sample."""
        normal = sample.linear[:, :3].transpose() @ self.organ.slope(sample.rest)
        cosine = ti.abs(normal.dot(tm.vec3(self.direction[line], 0.0))) / ti.max(normal.norm(), 1e-9)
        tilt = ti.acos(ti.min(cosine, 1.0))
        amplitude = CAPSULE * ti.exp(-0.5 * (tilt / CAPSULE_TILT) ** 2)
        mirror, diffuse = ti.static(CAPSULE_MIRROR, (1 - CAPSULE_MIRROR**2) ** 0.5)
        self.capsule[line, k] = tm.vec4(
            mirror * amplitude, diffuse * amplitude, (k - 1 + share) * step_mm, k - 1.0
        )

    @ti.func
    def is_fluid(self, line, k):
        """Whether a tissue sample is irrigation fluid."""
        return ti.abs(self.tissue[line, k].y - self.fluid[1]) < 1e-6

    @ti.func
    def anisotropy(self, sample, direction):
        """The factor of backscattered amplitude where the beam meets tubules, which run to the capsule, at an
        angle.

        Its mean over all directions, in dB, is 0.
        """
        tubule = self.organ.slope(sample.rest)
        along = sample.linear[:, 0] * direction.x + sample.linear[:, 1] * direction.y
        size = tubule.norm_sqr() * along.norm_sqr()
        squarely = 1.0 - tubule.dot(along) ** 2 / ti.max(size, 1e-12)
        return ti.exp(sample.tissue.w * (squarely - 2.0 / 3.0) / DB_OF_NEPER)

    @ti.func
    def place(self, line, k):
        """Where on the image plane (u, v) [mm] a tissue sample is, fractional."""
        first = ti.min(ti.cast(k, ti.i32), self.most - 2)
        depth = tm.mix(self.depth[line, first], self.depth[line, first + 1], k - first)
        return self.start[line] + depth * self.direction[line]

    @ti.func
    def tissue_at(self, planes: ti.template(), place, slice_sd):
        """The TissueSample at (u, v) of the image plane [mm]; backscatter is the root of its mean energy."""
        row, column = self.plane.pixel_near(place)
        linear = self.plane.rest_from_plane(row, column)
        rest = linear @ tm.vec4(place, 0.0, 1.0)
        tissue, within = tm.vec4(0.0), 0.0
        for off, weight in ti.static(planes):
            there = self.tissue_volume.sample(rest + (off * slice_sd) * linear[:, 2])
            tissue += weight * tm.vec4(there.x, there.y, there.z**2, there.w)
            within += ti.select(there.x > 1e-6, weight, 0.0)
        # Half of a slice beyond the CT is no tissue of half the impedance.
        tissue.x /= ti.max(within, 1e-6)
        tissue.z = ti.sqrt(tissue.z)
        if ti.static(self.organ_alone):
            if not (self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0):
                tissue = tm.vec4(self.around, 0.0, 0.0, 0.0)
        return TissueSample(tissue, rest, linear)  # type: ignore[call-arg]

    @kernel
    def _find_interfaces(self, count: int, step_mm: float):
        """Write ``echo`` and ``passed``, the amplitude that goes on at each sample, one way."""
        for n in range(self.lines * TASK):
            if n % TASK == 0:
                self.find_on_scanline(n // TASK, count, step_mm)

    @ti.func
    def find_on_scanline(self, line, count, step_mm):
        """Find the interfaces on a scanline."""
        direction = tm.vec3(self.direction[line], 0.0)
        interface = Interface()
        before = self.tissue[line, 0].x
        interface.begin(before, 0)
        self.passed[line, 0] = 1.0
        self.turn[line, 0] = 0.0
        self.echo[line, 0] = tm.vec4(0.0)
        for k in range(1, count):
            self.passed[line, k] = 1.0
            self.turn[line, k] = 0.0
            self.echo[line, k] = tm.vec4(0.0)
            after = self.tissue[line, k].x
            # Beyond the CT nothing is known: nothing reflects.
            after = ti.select(after < 1e-6, before, after)
            before = ti.select(before < 1e-6, after, before)
            step = (after - before) / ti.max(after + before, 1e-6)
            if interface.ends(step, self.interface_mm):
                self.end_interface(interface, line, k - 1, before, direction, step_mm)
                interface.begin(before, k - 1)
            if interface.steps == 0.0:
                interface.begin(before, k - 1)
            if ti.abs(step) >= MIN_REFLECTION:
                gradient = self.gradient_at(line, k)
                interface.add(step, (k - 0.5) * step_mm, gradient, direction, step_mm)
            before = after

    @ti.func
    def gradient_at(self, line, k):
        """The gradient (u, v, w) of impedance halfway before a sample, in the deformed tissue."""
        row, column = self.plane.pixel_near(self.place(line, k - 0.5))
        linear = self.plane.rest_from_plane(row, column)
        # Carried into the deformed tissue by the inverse transpose of the deformation gradient.
        rest = 0.5 * (self.rest[line, k - 1] + self.rest[line, k])
        return linear[:, :3].transpose() @ self.tissue_volume.gradient(rest)

    @ti.func
    def end_interface(self, interface, line, k, after, direction, step_mm):
        """Write the echo of an interface that ends at a sample, and what it lets pass."""
        depth = interface.middle / interface.steps
        reflection = interface.reflection(after)
        tilts, half_angle = interface.tilts(direction), self.aperture_angle[ti.cast(depth / step_mm, ti.i32)]
        across, slope = self.reflection[0], self.reflection[3]
        scattered = ti.select(ti.abs(reflection) > HARD, self.reflection[5], self.reflection[4])
        mirror = self.reflection[1] * specular(tilts.x, half_angle) * specular(tilts.y, across)
        rough = diffuse(tilts.x, half_angle, slope) * diffuse(tilts.y, across, slope)
        even = scattered**2 * ti.cos(tilts.x) * ti.cos(tilts.y)
        echo = reflection * tm.vec2(mirror, ti.sqrt(self.reflection[2] ** 2 * rough + even))
        self.echo[line, k] = tm.vec4(echo, depth, ti.cast(interface.begins, ti.f32))
        self.passed[line, k] = ti.sqrt(1.0 - reflection**2)
        if ti.abs(reflection) > LEAST_REFRACTING and ti.abs(reflection) < HARD:
            ratio = speed_ratio(after) / speed_ratio(interface.before)
            self.turn[line, k] = interface.refraction(direction, ratio)

    @ti.func
    def at_path(self, table: ti.template(), path):
        """An entry of a table of ``beam.AttenuatedPulse`` for an attenuation of the path [Np/MHz]."""
        at = ti.min(path / PATH_STEP, PATH_ENTRIES - 1.001)
        first = ti.cast(at, ti.i32)
        return tm.mix(table[first], table[first + 1], at - first)

    @ti.func
    def echo_amplitude(self, path: ti.template(), line, echo, step_mm):
        """The amplitude of a perfect reflector at an interface, and its path [Np/MHz].

        ``path`` is that of the tissue samples. The tissue before the interface attenuates up to its depth.
        """
        k = ti.cast(echo.w, ti.i32)
        before = path[line, k]
        further_mm = ti.max(echo.z - k * step_mm, 0.0) * speed_ratio(self.tissue[line, k].x)
        whole = before + 2.0 * self.tissue[line, k].y * further_mm / (10.0 * DB_OF_NEPER)
        # ``amplitude`` is that of speckle.
        more_db = self.at_path(self.echo_db, whole) - self.at_path(self.speckle_db, before)
        return self.amplitude[line, k] * ti.exp(more_db / DB_OF_NEPER), whole


@ti.func
def speed_ratio(impedance):
    """Speed of sound for an impedance [MRayl], relative to SOUND_MM_US; 1 where nothing is known.

    Density by Mast's fit of speed to density in soft tissue (2000), as ``acoustics.impedance_of_hu``.
    """
    density = 0.5 * (ti.sqrt(MAST_OFFSET**2 + 4.0e6 * MAST_SLOPE * impedance) - MAST_OFFSET)
    return ti.select(impedance < 1e-6, 1.0, (density + MAST_OFFSET) / (1000.0 * MAST_SLOPE * SOUND_MM_US))
