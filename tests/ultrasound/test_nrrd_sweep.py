"""Sweeps as NRRD sequences of PLUS: read as PLUS writes them, and the same sweep as in a metafile."""

import gzip
import zlib

import numpy as np
import pytest
import SimpleITK as sitk
from test_sweep import PIXELS, QUARTER_TURN, SAMPLES, SCALED, tracked

from ultrasound.sweep import ORIENTATIONS, Sweep, SweepError, transform_text
from ultrasound.sweep_file import read_ground_truth, read_sweep, write_sweep

# As vtkIGSIONrrdSequenceIO writes it: its own fields in alphabetical order and padded, the user's like these,
# the frames' as keys.
PLUS = """NRRD0004
# Complete NRRD file format specification at:
# http://teem.sourceforge.net/nrrd/format.html
NephronNote: of: the user
dimension: 3
encoding: {encoding}
endian: little
kinds: domain domain                list
sizes: 4 3                             2
space dimension: 2
space directions: (1,0) (0,1) none
space origin: (0,0)
type: uint8
ultrasound image orientation:=MF
ultrasound image type:=BRIGHTNESS
Seq_Frame0000_FrameNumber:=7
Seq_Frame0000_ProbeToTrackerTransform:={turn}
Seq_Frame0000_ProbeToTrackerTransformStatus:=OK
Seq_Frame0000_Timestamp:=1.5
Seq_Frame0000_Status:=OK
Seq_Frame0001_FrameNumber:=8
Seq_Frame0001_ProbeToTrackerTransform:=1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
Seq_Frame0001_ProbeToTrackerTransformStatus:=INVALID
Seq_Frame0001_Timestamp:=1.75
Seq_Frame0001_Status:=INVALID

"""
IMAGES = PIXELS.astype(np.uint8)


def plus_file(path, encoding="raw", pixels=None, images=IMAGES, end="\n", **changed):
    """A sequence as PLUS writes it, with lines replaced (a part of each by another)."""
    text = PLUS.format(encoding=encoding, turn=transform_text(QUARTER_TURN))
    for old, new in changed.get("lines", {}).items():
        assert old in text
        text = text.replace(old, new)
    if pixels is None:
        pixels = images.tobytes() if encoding == "raw" else gzip.compress(images.tobytes())
    path.write_bytes(text.replace("\n", end).encode("latin-1") + pixels)
    return path


def assert_as_written(sweep):
    assert np.array_equal(sweep.images, IMAGES)
    assert sweep.times_s.tolist() == [1.5, 1.75]
    assert [sweep.is_image_ok(n) for n in range(2)] == [True, False]
    assert np.array_equal(sweep.transform("Probe", "Tracker", 0), QUARTER_TURN)
    assert sweep.transform("Probe", "Tracker", 1) is None
    assert sweep.frames[1]["FrameNumber"] == "8" and sweep.frames[1]["ImageStatus"] == "INVALID"
    assert sweep.fields == {
        "NephronNote": "of: the user",
        "UltrasoundImageOrientation": "MF",
        "UltrasoundImageType": "BRIGHTNESS",
    }


@pytest.mark.parametrize("encoding", ["raw", "gz", "gzip"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_what_plus_writes(tmp_path, encoding, end):
    assert_as_written(read_sweep(plus_file(tmp_path / "a.igs.nrrd", encoding, end=end)))
    # The content counts, not the name.
    assert_as_written(read_sweep(plus_file(tmp_path / "a.igs.mha", encoding, end=end)))


SHAPES = {
    "single slices of a volume": {"domain                list": "domain domain list", "4 3  ": "4 3 1  "},
    "time": {"list\n": "time\n"},
    "another word for the type": {"uint8": "unsigned char"},
    "fields in capitals": {"kinds:": "Kinds:", "sizes:": "SIZES:"},
    "the orientation as a field": {"ultrasound image orientation:=": "UltrasoundImageOrientation: "},
}


@pytest.mark.parametrize("lines", SHAPES.values(), ids=SHAPES)
def test_other_ways_to_write_the_same(tmp_path, lines):
    assert_as_written(read_sweep(plus_file(tmp_path / "a.nrrd", lines=lines)))


def test_pixels_in_several_gzip_members(tmp_path):
    """As PLUS leaves them where it appends to a file."""
    pixels = b"".join(gzip.compress(image.tobytes()) for image in IMAGES)
    assert_as_written(read_sweep(plus_file(tmp_path / "a.nrrd", "gz", pixels)))


def test_one_frame_has_no_list(tmp_path):
    lines = {
        "domain                list": "                    domain",
        "4 3                             2": "4        3",
    }
    path = plus_file(tmp_path / "a.nrrd", images=IMAGES[:1], lines=lines)
    text, _, pixels = path.read_bytes().partition(b"\n\n")
    kept = [line for line in text.split(b"\n") if not line.startswith(b"Seq_Frame0001")]
    path.write_bytes(b"\n".join(kept) + b"\n\n" + pixels)
    assert np.array_equal(read_sweep(path).images, IMAGES[:1])


@pytest.mark.parametrize("sizes", ["1 1 2", "0 0 2"])
def test_poses_alone(tmp_path, sizes):
    """PLUS writes an empty pixel for each, and no orientation."""
    lines = {
        "ultrasound image orientation:=MF\n": "",
        "ultrasound image type:=BRIGHTNESS\n": "",
        "4 3                             2": sizes,
    }
    sweep = read_sweep(plus_file(tmp_path / "a.nrrd", pixels=bytes(2), lines=lines))
    assert sweep.images.shape == (2, 0, 0) and len(sweep.times_s) == 2
    write_sweep(tmp_path / "b.nrrd", sweep)
    again = read_sweep(tmp_path / "b.nrrd")
    assert again.frames == sweep.frames and again.images.shape == (2, 0, 0)
    content = (tmp_path / "b.nrrd").read_bytes()
    assert b"sizes: 1 1 2\n" in content and b"orientation" not in content
    write_sweep(tmp_path / "c.mha", sweep)
    assert read_sweep(tmp_path / "c.mha").fields["ElementType"] == "MET_OTHER"


@pytest.mark.parametrize("orientation", ["UN", "FM"])
def test_orientations(tmp_path, orientation):
    stored = {"UN": IMAGES[:, ::-1, ::-1], "FM": IMAGES.transpose(0, 2, 1)}[orientation]
    rows, columns = stored.shape[1:]
    lines = {"orientation:=MF": f"orientation:={orientation}", "4 3   ": f"{columns} {rows}   "}
    sweep = read_sweep(plus_file(tmp_path / "a.nrrd", images=np.ascontiguousarray(stored), lines=lines))
    assert (
        np.array_equal(sweep.images, IMAGES)
        and ORIENTATIONS[sweep.fields["UltrasoundImageOrientation"]] == "MF"
    )


def made():
    """A sweep with all that is easily lost: names, spaces, colons, letters beyond ASCII, a frame without a
    pose.
    """
    frames = [
        tracked(ProbeToReference=SCALED) | {"Timestamp": "0.5", "ImageStatus": "OK", "Note": "  a: =b \xe4 "},
        tracked(ProbeToReference=None) | {"Timestamp": "1.0", "ImageStatus": "INVALID"},
    ]
    return Sweep(IMAGES, frames, {"TransducerName": "probe: 5 MHz", "type": "not the format's"})


def test_metafile_and_nrrd_are_one_sweep(tmp_path):
    first, other, last, again = (
        tmp_path / name for name in ("a.igs.mha", "b.igs.nrrd", "c.igs.mha", "d.igs.nrrd")
    )
    write_sweep(first, made())
    write_sweep(other, read_sweep(first))
    write_sweep(last, read_sweep(other))
    write_sweep(again, read_sweep(last))
    assert last.read_bytes() == first.read_bytes() and again.read_bytes() == other.read_bytes()
    sweep = read_sweep(other)
    assert sweep.frames == made().frames and np.array_equal(sweep.images, IMAGES)
    assert sweep.fields.items() >= made().fields.items()
    # PLUS's name of the status, and no field of a metafile.
    content = other.read_bytes()
    assert b"\nSeq_Frame0001_Status:=INVALID\n" in content
    assert not any(
        word in content for word in (b"ImageStatus", b"ElementType", b"DimSize", b"CompressedData")
    )
    assert zlib.decompress(content.partition(b"\n\n")[2], 31) == IMAGES.tobytes()


@pytest.mark.parametrize("sample", SAMPLES)
def test_what_plus_tracked_comes_back(data, tmp_path, sample):
    sweep = read_sweep(data / f"us/{sample}.igs.mha")
    write_sweep(tmp_path / "a.igs.nrrd", sweep)
    again = read_sweep(tmp_path / "a.igs.nrrd")
    assert again.frames == sweep.frames and np.array_equal(again.images, sweep.images)
    write_sweep(tmp_path / "b.igs.mha", again)
    assert read_sweep(tmp_path / "b.igs.mha").frames == sweep.frames


def test_simpleitk_reads_the_pixels(tmp_path):
    write_sweep(tmp_path / "a.nrrd", made())
    image = sitk.ReadImage(str(tmp_path / "a.nrrd"))
    pixels = sitk.GetArrayFromImage(image)
    assert np.array_equal(
        np.moveaxis(pixels, -1, 0) if image.GetNumberOfComponentsPerPixel() > 1 else pixels, IMAGES
    )
    assert image.GetMetaData("Seq_Frame0000_Timestamp") == "0.5"


def test_labels_beside_a_sweep(tmp_path):
    for name in ("a.igs.nrrd", "a-marks.igs.nrrd"):
        write_sweep(tmp_path / name, made())
    assert read_ground_truth(tmp_path / "a.igs.nrrd").frames == made().frames
    assert read_ground_truth(tmp_path / "a-marks.igs.nrrd") is None
    assert read_ground_truth(tmp_path / "a.igs.mha") is None


SQUEEZED = gzip.compress(IMAGES.tobytes())
HOSTILE = {
    "no end": (dict(lines={"Seq_Frame0001_Status:=INVALID\n\n": "x:=y\n"}, pixels=b""), "no empty line"),
    "no colon": (dict(lines={"endian: little": "endian little"}), "'endian little': expected name: value"),
    "twice": (dict(lines={"endian: little": "type: uint8"}), "'type': found twice"),
    "a frame's twice": (dict(lines={"Seq_Frame0001_Timestamp": "Seq_Frame0001_FrameNumber"}), "found twice"),
    "no frame's number": (
        dict(lines={"Seq_Frame0001_Status": "Seq_FrameX_Status"}),
        "expected Seq_Frame0000_Name",
    ),
    "a frame missing": (dict(lines={"  2\n": "  3\n"}), "sizes has 3 frames, but 2 have fields"),
    "no type": (dict(lines={"type: uint8\n": ""}), "type = '': expected uint8"),
    "16 bits": (dict(lines={"uint8": "uint16"}), "type = 'uint16': expected uint8"),
    "no orientation": (dict(lines={"ultrasound image orientation:=MF\n": ""}), "image orientation = ''"),
    "descending": (dict(lines={"orientation:=MF": "orientation:=MFD"}), "'MFD': expected MF or"),
    "colours": (dict(lines={"domain domain     ": "vector domain     "}), "kinds = .*expected domain "),
    "as 3D Slicer": (dict(lines={"domain domain                list": "list domain domain"}), "kinds = "),
    "no kinds": (dict(lines={"kinds: domain domain                list\n": ""}), "kinds = ''"),
    "two sizes": (dict(lines={"4 3   ": "4   "}), "sizes = .*expected columns rows frames"),
    "negative": (dict(lines={"4 3   ": "4 -3   "}), "sizes = .*expected columns rows frames"),
    "huge": (dict(lines={"4 3   ": "99999 99999   "}), "sizes = "),
    "volumes": (
        dict(lines={"domain                list": "domain domain list", "4 3   ": "4 1 3   "}),
        "expected images, not volumes",
    ),
    "another file": (dict(lines={"endian: little": "data file: ../other.raw"}), "right after the header"),
    "skipped bytes": (dict(lines={"endian: little": "byte skip: -1"}), "byte skip = '-1'"),
    "text": (dict(encoding="ascii"), "encoding = 'ascii': expected raw or gz or gzip"),
    "bzip2": (dict(encoding="bz2", pixels=b""), "encoding = 'bz2'"),
    "short": (dict(pixels=bytes(23)), "23 bytes of pixels: expected 24"),
    "long": (dict(pixels=bytes(25)), "25 bytes of pixels: expected 24"),
    "no gzip": (dict(encoding="gz", pixels=b"nonsense"), "not whole gzip data"),
    "cut off": (dict(encoding="gz", pixels=SQUEEZED[:-5]), "not whole gzip data"),
    "bad checksum": (dict(encoding="gz", pixels=SQUEEZED[:-8] + bytes(8)), "not whole gzip data"),
    "left over": (dict(encoding="gz", pixels=SQUEEZED + b"xxxx"), "not whole gzip data"),
    "fewer": (dict(encoding="gz", pixels=gzip.compress(bytes(23))), "23 bytes of pixels or more in "),
    "a bomb": (dict(encoding="gz", pixels=gzip.compress(bytes(10_000_000))), "25 bytes of pixels or more"),
}


@pytest.mark.parametrize("changed, words", HOSTILE.values(), ids=HOSTILE.keys())
def test_damaged_files_are_refused_in_words(tmp_path, changed, words):
    path = plus_file(tmp_path / "damaged.igs.nrrd", **changed)
    with pytest.raises(SweepError, match=words) as caught:
        read_sweep(path)
    assert str(caught.value).startswith("damaged.igs.nrrd: ") and len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["a=b", "a:b", "#a", "a ", "a\nb"])
def test_a_name_that_would_be_another_is_not_written(tmp_path, name):
    with pytest.raises(SweepError, match="expected one line, no : or = or # in the name"):
        write_sweep(tmp_path / "a.nrrd", Sweep(IMAGES, [{name: "x"}, {}], {}))
    assert not list(tmp_path.iterdir())
