"""The echo signal of each scanline: a pulse travels through the deformed tissue, is attenuated, reflected and scattered."""

import taichi as ti
import taichi.math as tm

from ultrasound.image_plane import PlaneInTissue
from ultrasound.sampled_volume import SampledVolume
from ultrasound.speckle import Speckle

# Parallel planes that sample the slice thickness: offset in standard deviations, weight in a mean, and weight in a sum of noise
# that preserves its mean square.
CENTRAL_PLANE = ((0.0, 1.0, 1.0),)
THICK_PLANE = tuple(
    (offset, weight / 2.0, weight / 1.5**0.5) for offset, weight in ((0.0, 1.0), (-1.2, 0.5), (1.2, 0.5))
)
# A smaller relative change of impedance between two samples is no interface.
MIN_REFLECTION = 3e-4
# Decibels per neper of amplitude.
DB = 8.685889638065037


@ti.dataclass
class Interface:
    """A step of impedance that the CT blurs over several tissue samples.

    ``steps`` is the sum of the reflections; ``middle`` and ``incidence`` are depth [mm] and incidence factor, weighted by them;
    ``thickness`` is in mm. ``before`` is the tissue in front of it, from depth ``begins`` [mm], where the pulse has ``amplitude``.
    """

    steps: ti.f32
    middle: ti.f32
    incidence: ti.f32
    thickness: ti.f32
    before: tm.vec3
    begins: ti.f32
    amplitude: ti.f32

    @ti.func
    def begin(self, tissue, depth_mm, amplitude):
        """Reset to no reflection, behind the given tissue."""
        self.steps, self.middle, self.incidence, self.thickness = 0.0, 0.0, 0.0, 0.0
        self.before, self.begins, self.amplitude = tissue, depth_mm, amplitude

    @ti.func
    def add(self, step, depth_mm, incidence, path_mm):
        """Add one step of impedance over a part of the path."""
        self.steps += step
        self.middle += step * depth_mm
        self.incidence += step * incidence
        # Thickness along the normal, not along the beam.
        self.thickness += incidence * incidence * path_mm

    @ti.func
    def ends(self, step, max_mm):
        """Whether the next step no longer belongs to this interface."""
        other = step * self.steps <= 0.0 or ti.abs(step) < MIN_REFLECTION or self.thickness > max_mm
        return self.steps != 0.0 and other

    @ti.func
    def reflection(self, after):
        """Reflection coefficient of amplitude between the impedance before it and the one after it [MRayl]."""
        return (after - self.before.x) / (after + self.before.x)

    @ti.func
    def depth_mm(self):
        """Depth of its centre."""
        return self.middle / self.steps

    @ti.func
    def echo(self, after, frequency_mhz):
        """Amplitude of its echo, as one step at its centre; the tissue before it attenuates up to there."""
        path_db = 2.0 * self.before.y * frequency_mhz * (self.depth_mm() - self.begins) / 10.0
        return (
            ti.abs(self.reflection(after))
            * self.amplitude
            * ti.exp(-path_db / DB)
            * self.incidence
            / self.steps
        )


@ti.dataclass
class TissueSample:
    """Impedance, attenuation and backscatter; the rest position [mm]; the map (3, 4) from the image plane to it."""

    tissue: tm.vec3
    rest: tm.vec3
    linear: ti.types.matrix(3, 4, ti.f32)


@ti.func
def impedance_or(impedance, other):
    """The impedance, or the other where it is not known."""
    return ti.select(impedance < 1e-6, other, impedance)


@ti.data_oriented
class Scanlines:
    """Echo signals (scanlines, samples), ``real`` and ``imaginary``, of all scanlines; arguments as for ``BMode``."""

    def __init__(
        self,
        tissue: SampledVolume,
        organ: SampledVolume,
        plane: PlaneInTissue,
        shape: tuple[int, int],
        voxel_mm: float,
        contact: str,
        contact_gap_mm: float,
        around: float | None,
    ) -> None:
        self.tissue, self.organ, self.plane = tissue, organ, plane
        # A CT blurs an interface by about a voxel to each side.
        self.interface_mm = 5.0 * voxel_mm
        self.by_organ, self.gap_mm = contact == "organ", contact_gap_mm
        self.organ_alone, self.around = around is not None, around or 0.0
        self.speckle = Speckle()
        self.count, self.samples = shape
        self.start, self.direction, self.element = (ti.Vector.field(2, ti.f32, self.count) for _ in range(3))
        self.contacts_before = ti.field(ti.i32, self.count + 1)
        self.real, self.imaginary = (ti.field(ti.f32, shape) for _ in range(2))
        # Factor by sample that restores unit mean square of speckle after the point-spread function.
        self.speckle_gain = ti.field(ti.f32, self.samples)

    @ti.kernel
    def find_contact(self, pixel_mm: tm.vec2, first_mm: tm.vec2):
        """Count the array elements in contact: ``contacts_before[i]`` is the number among the elements before i."""
        ti.loop_config(serialize=True)
        for i in range(self.count):
            place = self.element[i]
            if ti.static(not self.by_organ):
                place.y += 0.5 * self.gap_mm
            row, column = self.plane.pixel_near(place, pixel_mm, first_mm)
            rest = self.plane.rest_from_plane(row, column) @ tm.vec4(place, 0.0, 1.0)
            near = 0
            if ti.static(self.by_organ):
                near = self.plane.is_tissue(row, column) and self.organ.sample(rest) <= self.gap_mm
            else:
                near = self.tissue.sample(rest)[0] > 1.0
            self.contacts_before[i + 1] = self.contacts_before[i] + near

    @ti.func
    def sample_tissue(self, planes: ti.template(), place, pixel_mm, first_mm, elevation_sd: ti.f32):
        """The TissueSample at (u, v) of the image plane [mm]."""
        row, column = self.plane.pixel_near(place, pixel_mm, first_mm)
        linear = self.plane.rest_from_plane(row, column)
        rest = linear @ tm.vec4(place, 0.0, 1.0)
        found = tm.vec3(0.0)
        for off, weight, _ in ti.static(planes):
            found += weight * self.tissue.sample(rest + (off * elevation_sd) * linear[:, 2])
        if ti.static(self.organ_alone):
            if not (self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0):
                found = tm.vec3(self.around, 0.0, 0.0)
        return TissueSample(found, rest, linear)  # type: ignore[call-arg]

    @ti.kernel
    def simulate(
        self,
        detail_level: ti.template(),
        stride: ti.template(),
        pixel_mm: tm.vec2,
        first_mm: tm.vec2,
        sample_mm: float,
        frequency_mhz: float,
        aperture: float,
        axial_sd: float,
        elevation_sd: float,
    ):
        """Write the echo signal of every scanline, at a detail level (its index); needs ``find_contact`` before.

        The tissue is sampled every ``stride`` samples. ``aperture`` is in elements to each side, per mm of depth.
        """
        planes = ti.static(THICK_PLANE if detail_level == 2 else CENTRAL_PLANE)
        stride_mm = stride * sample_mm
        for line in range(self.count):
            start, direction = self.start[line], self.direction[line]
            for i in range(self.samples):
                self.real[line, i] = 0.0
            near = self.sample_tissue(planes, start, pixel_mm, first_mm, elevation_sd)
            loss_db, transmitted, amplitude = 0.0, 1.0, 1.0
            interface = Interface()
            interface.begin(near.tissue, 0.0, amplitude)
            for k in range(self.samples // stride):
                depth = k * stride_mm
                place = start + (depth + stride_mm) * direction
                far = self.sample_tissue(planes, place, pixel_mm, first_mm, elevation_sd)
                # Beyond the CT nothing is known: nothing scatters, nothing reflects.
                far.tissue.x = impedance_or(far.tissue.x, near.tissue.x)
                near.tissue.x = impedance_or(near.tissue.x, far.tissue.x)
                before, after = near.tissue, far.tissue
                step = (after.x - before.x) / ti.max(after.x + before.x, 1e-6)
                if interface.ends(step, self.interface_mm):
                    at = interface.depth_mm()
                    echo = interface.echo(before.x, frequency_mhz) * self.contact_fraction(line, at, aperture)
                    self.add_reflection(detail_level, line, at, echo, sample_mm, axial_sd)
                    transmitted *= 1.0 - interface.reflection(before.x) ** 2
                    interface.begin(before, depth, amplitude)
                if interface.steps == 0.0:
                    interface.begin(before, depth, amplitude)
                if ti.abs(step) >= MIN_REFLECTION:
                    incidence = self.incidence_factor(0.5 * (near.rest + far.rest), far.linear, direction)
                    interface.add(step, depth + 0.5 * stride_mm, incidence, stride_mm)
                # Both directions, over the stride in cm.
                loss_db += (before.y + after.y) * frequency_mhz * stride_mm / 10.0
                amplitude_far = transmitted * ti.exp(-loss_db / DB)
                contact = self.contact_fraction(line, depth + 0.5 * stride_mm, aperture)
                levels = tm.vec3(amplitude, amplitude_far, contact)
                self.add_scatter(detail_level, stride, line, k, near, far, levels, axial_sd, elevation_sd)
                near, amplitude = far, amplitude_far

    @ti.func
    def add_scatter(
        self,
        detail_level: ti.template(),
        stride: ti.template(),
        line,
        k,
        near,
        far,
        levels,
        axial_sd,
        elevation_sd,
    ):
        """Write the scattered signal of stride ``k``; ``levels`` are the amplitude at its two ends and the contact fraction."""
        for j in range(stride):
            t = (j + 0.5) / stride
            rest, across = tm.mix(near.rest, far.rest, t), tm.mix(near.linear[:, 2], far.linear[:, 2], t)
            echo = self.scatter(detail_level, rest, across, axial_sd, elevation_sd)
            echo *= levels.z * tm.mix(levels.x, levels.y, t) * tm.mix(near.tissue.z, far.tissue.z, t)
            self.real[line, stride * k + j] = self.real[line, stride * k + j] + echo.x
            self.imaginary[line, stride * k + j] = echo.y

    @ti.func
    def scatter(self, detail_level: ti.template(), rest, across, axial_sd, elevation_sd):
        """Speckle (2,) at a rest position [mm], of unit mean square; the constant 1 at the level without speckle."""
        echo = tm.vec2(ti.static(1.0 if detail_level == 0 else 0.0), 0.0)
        for off, _, weight in ti.static(((), CENTRAL_PLANE, THICK_PLANE)[detail_level]):
            echo += weight * self.speckle.at(rest + (off * elevation_sd) * across, axial_sd)
        return echo

    @ti.func
    def contact_fraction(self, line, depth_mm, aperture):
        """Fraction of the active aperture of a scanline at a depth that is in contact."""
        half = ti.min(ti.cast(depth_mm * aperture, ti.i32), self.count)
        first, last = ti.max(line - half, 0), ti.min(line + half + 1, self.count)
        return (self.contacts_before[last] - self.contacts_before[first]) / ti.cast(last - first, ti.f32)

    @ti.func
    def incidence_factor(self, rest, linear, direction):
        """Root of the cosine between beam and interface normal: Lambert's law for the intensity (Wein 2008)."""
        # The gradient at rest is carried into the deformed tissue by the inverse transpose of the deformation gradient.
        slope = linear[:, :3].transpose() @ self.tissue.slope(rest)
        # An interface thinner than the distance between samples has no gradient halfway: perpendicular incidence is assumed.
        factor, steep = 1.0, slope.norm()
        if steep > 1e-9:
            factor = ti.sqrt(ti.abs(slope.x * direction.x + slope.y * direction.y) / steep)
        return factor

    @ti.func
    def add_reflection(self, detail_level: ti.template(), line, depth_mm, amplitude, sample_mm, axial_sd):
        """Add the echo of an interface to a scanline, as wide as the pulse and not scaled by ``speckle_gain``."""
        at, reach = depth_mm / sample_mm - 0.5, ti.ceil(3.5 * axial_sd / sample_mm, ti.i32)
        first = ti.max(ti.floor(at, ti.i32) - reach, 0)
        last = ti.min(ti.floor(at, ti.i32) + reach + 1, self.samples - 1)
        for i in range(first, last + 1):
            off = (i - at) * sample_mm / axial_sd
            echo = amplitude * ti.exp(-0.5 * off * off)
            if ti.static(detail_level > 0):
                echo /= self.speckle_gain[i]
            self.real[line, i] = self.real[line, i] + echo
