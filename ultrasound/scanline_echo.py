"""What comes back along one line of the array: sound sent through the deformed tissue, reflected and scattered on its way."""

import taichi as ti
import taichi.math as tm

from ultrasound.image_plane import PlaneInTissue
from ultrasound.sampled_volume import SampledVolume
from ultrasound.speckle import Speckle

# The planes that a thick one is made of: how far off in standard deviations, the weight in a mean, and in a sum of noise that
# keeps its mean square.
MIDDLE = ((0.0, 1.0, 1.0),)
THICK = tuple((off, weight / 2.0, weight / 1.5**0.5) for off, weight in ((0.0, 1.0), (-1.2, 0.5), (1.2, 0.5)))
# What changes less from look to look is no interface.
LEAST_REFLECTION = 3e-4
# dB of a natural logarithm of amplitude.
DB = 8.685889638065037


@ti.dataclass
class Interface:
    """A step of impedance, which a CT blurs over some looks into the tissue.

    ``steps`` adds up what it reflects, ``middle`` and ``squarely`` its depth [mm] and how squarely it is met, each times that;
    ``thick`` is its width [mm]. ``before`` is the tissue before it, from ``begins`` [mm] on, where the sound was ``loud``.
    """

    steps: ti.f32
    middle: ti.f32
    squarely: ti.f32
    thick: ti.f32
    before: tm.vec3
    begins: ti.f32
    loud: ti.f32

    @ti.func
    def begin(self, tissue, depth_mm, loud):
        """Nothing yet, after some tissue."""
        self.steps, self.middle, self.squarely, self.thick = 0.0, 0.0, 0.0, 0.0
        self.before, self.begins, self.loud = tissue, depth_mm, loud

    @ti.func
    def add(self, step, depth_mm, square, way_mm):
        """One more step, met so squarely (root of the cosine) on a way through it."""
        self.steps += step
        self.middle += step * depth_mm
        self.squarely += step * square
        # Across the interface, however aslant the beam goes through it.
        self.thick += square * square * way_mm

    @ti.func
    def ends(self, step, most_mm):
        """Whether what comes next is no longer of it."""
        other = step * self.steps <= 0.0 or ti.abs(step) < LEAST_REFLECTION or self.thick > most_mm
        return self.steps != 0.0 and other

    @ti.func
    def reflection(self, after):
        """Share of the amplitude that it turns back, signed, between what was before it and what is after it [MRayl]."""
        return (after - self.before.x) / (after + self.before.x)

    @ti.func
    def depth_mm(self):
        """Its middle."""
        return self.middle / self.steps

    @ti.func
    def loudness(self, after, frequency_mhz):
        """Amplitude of its echo: one step at its middle, with the tissue before it up to there."""
        way_db = 2.0 * self.before.y * frequency_mhz * (self.depth_mm() - self.begins) / 10.0
        return ti.abs(self.reflection(after)) * self.loud * ti.exp(-way_db / DB) * self.squarely / self.steps


@ti.dataclass
class Look:
    """Impedance, attenuation and backscatter at a place, where its tissue was at rest [mm], and the map from the plane there."""

    tissue: tm.vec3
    rest: tm.vec3
    linear: ti.types.matrix(3, 4, ti.f32)


@ti.func
def known(impedance, other):
    """An impedance, or where there is none another."""
    return ti.select(impedance < 1e-6, other, impedance)


@ti.data_oriented
class Beams:
    """Echoes (lines, samples), ``real`` and ``imaginary``, of every line; arguments as ``BMode``."""

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
        # An interface is blurred in a CT by about a voxel to each side.
        self.interface_mm = 5.0 * voxel_mm
        self.by_organ, self.gap_mm = contact == "organ", contact_gap_mm
        self.organ_alone, self.around = around is not None, around or 0.0
        self.speckle = Speckle()
        self.lines, self.samples = shape
        self.start, self.direction, self.element = (ti.Vector.field(2, ti.f32, self.lines) for _ in range(3))
        self.touching = ti.field(ti.i32, self.lines + 1)
        self.real, self.imaginary = (ti.field(ti.f32, shape) for _ in range(2))
        # What the point-spread function makes of speckle of unit mean square, by sample.
        self.loudness = ti.field(ti.f32, self.samples)

    @ti.kernel
    def touch(self, pixel_mm: tm.vec2, first_mm: tm.vec2):
        """Elements that touch, counted from the first on: ``touching[i]`` of those before i."""
        ti.loop_config(serialize=True)
        for i in range(self.lines):
            place = self.element[i]
            if ti.static(not self.by_organ):
                place.y += 0.5 * self.gap_mm
            row, column = self.plane.pixel_near(place, pixel_mm, first_mm)
            rest = self.plane.map_of(row, column) @ tm.vec4(place, 0.0, 1.0)
            near = 0
            if ti.static(self.by_organ):
                near = self.plane.is_tissue(row, column) and self.organ.sample(rest) <= self.gap_mm
            else:
                near = self.tissue.sample(rest)[0] > 1.0
            self.touching[i + 1] = self.touching[i] + near

    @ti.func
    def look(self, planes: ti.template(), place, pixel_mm, first_mm, elevation_sd: ti.f32):
        """What is at a place (u, v) of the plane."""
        row, column = self.plane.pixel_near(place, pixel_mm, first_mm)
        linear = self.plane.map_of(row, column)
        rest = linear @ tm.vec4(place, 0.0, 1.0)
        found = tm.vec3(0.0)
        for off, weight, _ in ti.static(planes):
            found += weight * self.tissue.sample(rest + (off * elevation_sd) * linear[:, 2])
        if ti.static(self.organ_alone):
            if not (self.plane.is_tissue(row, column) and self.organ.sample(rest) <= 0.0):
                found = tm.vec3(self.around, 0.0, 0.0)
        return Look(found, rest, linear)  # type: ignore[call-arg]

    @ti.kernel
    def send(
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
        """Send sound along every line and write what comes back, a detail_level (its index) up the ladder; ``touch`` comes before.

        The tissue is looked at every ``stride`` samples. A line uses ``aperture`` elements a mm of depth to each side.
        """
        planes = ti.static(THICK if detail_level == 2 else MIDDLE)
        stride_mm = stride * sample_mm
        for line in range(self.lines):
            start, direction = self.start[line], self.direction[line]
            for i in range(self.samples):
                self.real[line, i] = 0.0
            near = self.look(planes, start, pixel_mm, first_mm, elevation_sd)
            loss_db, passed, loud = 0.0, 1.0, 1.0
            interface = Interface()
            interface.begin(near.tissue, 0.0, loud)
            for k in range(self.samples // stride):
                depth = k * stride_mm
                place = start + (depth + stride_mm) * direction
                far = self.look(planes, place, pixel_mm, first_mm, elevation_sd)
                # Beyond the CT nothing is known: nothing scatters, nothing reflects.
                far.tissue.x = known(far.tissue.x, near.tissue.x)
                near.tissue.x = known(near.tissue.x, far.tissue.x)
                before, after = near.tissue, far.tissue
                step = (after.x - before.x) / ti.max(after.x + before.x, 1e-6)
                if interface.ends(step, self.interface_mm):
                    at = interface.depth_mm()
                    echo = interface.loudness(before.x, frequency_mhz) * self.heard(line, at, aperture)
                    self.reflect(detail_level, line, at, echo, sample_mm, axial_sd)
                    passed *= 1.0 - interface.reflection(before.x) ** 2
                    interface.begin(before, depth, loud)
                if interface.steps == 0.0:
                    interface.begin(before, depth, loud)
                if ti.abs(step) >= LEAST_REFLECTION:
                    square = self.squareness(0.5 * (near.rest + far.rest), far.linear, direction)
                    interface.add(step, depth + 0.5 * stride_mm, square, stride_mm)
                # There and back, over the stride in cm.
                loss_db += (before.y + after.y) * frequency_mhz * stride_mm / 10.0
                loud_far = passed * ti.exp(-loss_db / DB)
                heard = self.heard(line, depth + 0.5 * stride_mm, aperture)
                loudness = tm.vec3(loud, loud_far, heard)
                self.scatter_between(
                    detail_level, stride, line, k, near, far, loudness, axial_sd, elevation_sd
                )
                near, loud = far, loud_far

    @ti.func
    def scatter_between(
        self,
        detail_level: ti.template(),
        stride: ti.template(),
        line,
        k,
        near,
        far,
        loudness,
        axial_sd,
        elevation_sd,
    ):
        """Write the samples of stride ``k``: what scatters there, ``loudness`` the sound at its ends and the share of it that is heard."""
        for j in range(stride):
            t = (j + 0.5) / stride
            rest, across = tm.mix(near.rest, far.rest, t), tm.mix(near.linear[:, 2], far.linear[:, 2], t)
            echo = self.scatter(detail_level, rest, across, axial_sd, elevation_sd)
            echo *= loudness.z * tm.mix(loudness.x, loudness.y, t) * tm.mix(near.tissue.z, far.tissue.z, t)
            self.real[line, stride * k + j] = self.real[line, stride * k + j] + echo.x
            self.imaginary[line, stride * k + j] = echo.y

    @ti.func
    def scatter(self, detail_level: ti.template(), rest, across, axial_sd, elevation_sd):
        """Echo (2,) of scatterers at a place at rest [mm], of unit mean square; without speckle the root of that."""
        echo = tm.vec2(ti.static(1.0 if detail_level == 0 else 0.0), 0.0)
        for off, _, weight in ti.static(((), MIDDLE, THICK)[detail_level]):
            echo += weight * self.speckle.at(rest + (off * elevation_sd) * across, axial_sd)
        return echo

    @ti.func
    def heard(self, line, depth_mm, aperture):
        """Share of the elements that a line uses at a depth which touch tissue."""
        half = ti.min(ti.cast(depth_mm * aperture, ti.i32), self.lines)
        first, last = ti.max(line - half, 0), ti.min(line + half + 1, self.lines)
        return (self.touching[last] - self.touching[first]) / ti.cast(last - first, ti.f32)

    @ti.func
    def squareness(self, rest, linear, direction):
        """Root of the cosine between beam and the normal of an interface: Lambert's law for the intensity (Wein 2008)."""
        # The gradient at rest, carried into the deformed tissue by the inverse transpose of the deformation gradient.
        slope = linear[:, :3].transpose() @ self.tissue.slope(rest)
        # An interface thinner than the way from look to look has no slope halfway: taken as square.
        square, steep = 1.0, slope.norm()
        if steep > 1e-9:
            square = ti.sqrt(ti.abs(slope.x * direction.x + slope.y * direction.y) / steep)
        return square

    @ti.func
    def reflect(self, detail_level: ti.template(), line, depth_mm, loud, sample_mm, axial_sd):
        """Add the echo of an interface to a line, as wide as the pulse; what makes speckle louder leaves it as it is."""
        at, reach = depth_mm / sample_mm - 0.5, ti.ceil(3.5 * axial_sd / sample_mm, ti.i32)
        first = ti.max(ti.floor(at, ti.i32) - reach, 0)
        last = ti.min(ti.floor(at, ti.i32) + reach + 1, self.samples - 1)
        for i in range(first, last + 1):
            off = (i - at) * sample_mm / axial_sd
            echo = loud * ti.exp(-0.5 * off * off)
            if ti.static(detail_level > 0):
                echo /= self.loudness[i]
            self.real[line, i] = self.real[line, i] + echo
