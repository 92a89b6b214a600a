"""Tracked sweeps: what PLUS wrote comes back line for line, chains of transforms as by hand."""

import zlib

import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ultrasound.sweep import (
    ORIENTATIONS,
    Sweep,
    SweepError,
    load_constants,
    matrix_of,
    transform_fields,
    transform_text,
)
from ultrasound.sweep_file import SweepWriter, read_sweep, write_sweep

SAMPLES = ("NwirePhantomFreehand", "SpinePhantomFreehand", "SlidingProbeTrackingData")
SPINE_XML = "us/PlusDeviceSet_SpinePhantomFreehandReconstructionOnly.xml"
PIXELS = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
QUARTER_TURN = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1.0]])
SCALED = np.array([[0.5, 0, 0, 1], [0, 0.25, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])


def parts_of(path) -> tuple[list[bytes], bytes]:
    """Lines of the header, and the pixels as they stand in the file."""
    header, end, pixels = path.read_bytes().partition(b"ElementDataFile = LOCAL\n")
    return (header + end).splitlines(keepends=True), pixels


def file_of(path, pixels=bytes(12), raw="", **changed):
    """A small metafile of one frame of 4 x 3 pixels, with fields changed, or left out where None; ``raw``
    comes before the end.
    """
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "DimSize": "4 3 1",
        "Kinds": "domain domain list",
        "ElementType": "MET_UCHAR",
        "UltrasoundImageOrientation": "MF",
        "Seq_Frame0000_Timestamp": "1.5",
    } | changed
    end = {"ElementDataFile": fields.pop("ElementDataFile", "LOCAL")}
    lines = [f"{name} = {text}\n" for name, text in (fields | end).items() if text is not None]
    lines.insert(-1, raw)
    path.write_bytes("".join(lines).encode("latin-1") + pixels)
    return path


def frame_of(**fields) -> Sweep:
    return Sweep(np.zeros((1, 0, 0), np.uint8), [{name: str(text) for name, text in fields.items()}], {})


def tracked(**matrices) -> dict[str, str]:
    """Fields of a frame whose transforms are OK."""
    return {key: text for named in matrices.items() for key, text in transform_fields(*named).items()}


@pytest.mark.parametrize("sample", SAMPLES)
def test_what_plus_wrote_comes_back_line_for_line(data, tmp_path, sample):
    source, copy = data / f"us/{sample}.igs.mha", tmp_path / "copy.igs.mha"
    sweep = read_sweep(source)
    write_sweep(copy, sweep)
    (before, pixels), (after, copied) = parts_of(source), parts_of(copy)
    size = next((index for index, line in enumerate(before) if line.startswith(b"CompressedDataSize")), None)
    if size is not None:
        assert int(after[size].split()[2]) == len(copied)
        assert len(after[size]) == len(before[size])
        assert zlib.decompress(copied) == zlib.decompress(pixels) == sweep.images.tobytes()
        before[size] = after[size]
    assert after == before
    assert np.array_equal(read_sweep(copy).images, sweep.images)


def test_a_chain_is_the_product_of_its_transforms(tmp_path):
    sweep = frame_of(**tracked(ImageToProbe=SCALED, ProbeToTracker=QUARTER_TURN, ReferenceToTracker=SCALED))
    # Pixel (4, 8): in Probe (3, 4, 3), in Tracker (10 - 4, 20 + 3, 33), in Reference ((6 - 1) / 0.5, (23 - 2)
    # / 0.25, 30).
    assert sweep.transform("Image", "Tracker", 0) @ [4, 8, 0, 1] == pytest.approx([6, 23, 33, 1])
    assert sweep.transform("Image", "Reference", 0) @ [4, 8, 0, 1] == pytest.approx([10, 84, 30, 1])
    assert sweep.transform("Reference", "Image", 0) @ [10, 84, 30, 1] == pytest.approx([4, 8, 0, 1])
    assert np.array_equal(sweep.transform("Probe", "Probe", 0), np.eye(4))


def test_the_shortest_chain_is_taken():
    turn, shift = QUARTER_TURN, SCALED
    sweep = frame_of(**tracked(AToB=turn, AToC=shift, BToE=turn, CToD=shift, DToE=shift))
    assert np.array_equal(sweep.transform("A", "E", 0), turn @ turn)
    assert np.array_equal(sweep.transform("B", "D", 0), np.linalg.inv(shift) @ turn)


@pytest.mark.parametrize("name, start", [("ToolToTracker", "Tool"), ("StylusTopToTracker", "StylusTop")])
def test_a_to_within_a_word_is_none(name, start):
    sweep = frame_of(**tracked(**{name: SCALED}))
    assert np.array_equal(sweep.transform(start, "Tracker", 0), SCALED)


def test_the_spine_with_its_calibration(data):
    sweep = read_sweep(data / "us/SpinePhantomFreehand.igs.mha")
    sweep.constant = load_constants(data / SPINE_XML)
    assert list(sweep.constant) == ["ImageToProbe", "PhantomToReference"]
    assert sweep.constant["ImageToProbe"][0] == pytest.approx([-0.00157821, 0.0785919, -0.00803285, 15.3978])
    for frame in (0, 20):
        fields = sweep.frames[frame]
        probe, reference = (
            np.array(fields[f"{name}ToTrackerTransform"].split(), float).reshape(4, 4)
            for name in ("Probe", "Reference")
        )
        expected = np.linalg.inv(reference) @ probe @ sweep.constant["ImageToProbe"]
        assert sweep.transform("Image", "Reference", frame) == pytest.approx(expected, abs=1e-9)
        phantom = np.linalg.inv(sweep.constant["PhantomToReference"]) @ expected
        assert sweep.transform("Image", "Phantom", frame) == pytest.approx(phantom, abs=1e-9)


@pytest.mark.parametrize(
    "status", [{}, {"AToBTransformStatus": "INVALID"}, {"AToBTransformStatus": "MISSING"}]
)
def test_a_status_that_is_not_ok_is_none(status):
    fields = {"AToBTransform": transform_text(SCALED), **status}
    assert frame_of(**fields).transform("B", "A", 0) is None


def test_names_that_no_chain_joins_are_reported():
    sweep = frame_of(**tracked(ImageToProbe=SCALED))
    with pytest.raises(
        SweepError, match="frame 0: no chain of transforms from Image to World, of ImageToProbe$"
    ):
        sweep.transform("Image", "World", 0)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1 0 0",
        "a " * 16,
        "nan " * 16,
        "1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1",
        "1 0 0 0 0 1 0 inf 0 0 1 0 0 0 0 1",
    ],
)
def test_a_transform_that_is_none(text):
    sweep = frame_of(AToBTransform=text, AToBTransformStatus="OK")
    with pytest.raises(
        SweepError, match=r"^frame 0: AToBTransform = .*expected sixteen finite numbers.*[^\n]$"
    ):
        sweep.transform("A", "B", 0)


def test_a_transform_without_an_inverse():
    sweep = frame_of(**tracked(AToB=np.diag([1.0, 1, 0, 1])))
    assert sweep.transform("A", "B", 0)[2, 2] == 0
    with pytest.raises(SweepError, match="AToB has no inverse"):
        sweep.transform("B", "A", 0)


@pytest.mark.parametrize("text", ["", "soon", "nan", "inf"])
def test_a_timestamp_that_is_none(text):
    with pytest.raises(SweepError, match="frame 0: Timestamp = .*expected a finite number"):
        _ = frame_of(Timestamp=text).times_s


def test_images_and_frames_go_together():
    with pytest.raises(SweepError, match=r"expected uint8 \(1, rows, columns\)"):
        Sweep(PIXELS, [{}], {})


@pytest.mark.parametrize("status, ok", [("OK", True), ("INVALID", False), (None, True)])
def test_an_images_status(status, ok):
    sweep = Sweep(PIXELS[:1], [{} if status is None else {"ImageStatus": status}], {})
    assert sweep.is_image_ok(0) == ok


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_every_orientation_becomes_mf(tmp_path, orientation):
    upright, far_first = PIXELS[0], PIXELS[0].T
    stored = {  # by what the column's index grows towards, and the row's
        "MF": upright,
        "MN": upright[::-1],
        "UF": upright[:, ::-1],
        "UN": upright[::-1, ::-1],
        "FM": far_first,
        "FU": far_first[::-1],
        "NM": far_first[:, ::-1],
        "NU": far_first[::-1, ::-1],
    }[orientation[:2]]
    rows, columns = stored.shape
    source = file_of(
        tmp_path / "in.igs.mha",
        stored.tobytes(),
        DimSize=f"{columns} {rows} 1",
        UltrasoundImageOrientation=orientation,
    )
    sweep = read_sweep(source)
    assert np.array_equal(sweep.images, [upright])
    assert ORIENTATIONS[sweep.fields["UltrasoundImageOrientation"]] == "MF"
    write_sweep(tmp_path / "out.igs.mha", sweep)
    again = read_sweep(tmp_path / "out.igs.mha")
    assert np.array_equal(again.images, [upright])
    assert again.fields["DimSize"] == "4 3 1"
    assert again.fields["UltrasoundImageOrientation"] == ("MFA" if orientation == "MFA" else "MF")


@pytest.mark.parametrize("end", ["", "\r"])
def test_bytes_beyond_ascii_and_spaces_stay(tmp_path, end):
    source = file_of(tmp_path / "in.igs.mha", Note="  Grüße\xa0= \x85 " + end, Seq_Frame0000_FrameNumber="7 ")
    write_sweep(tmp_path / "out.igs.mha", read_sweep(source))
    lines, pixels = parts_of(tmp_path / "out.igs.mha")
    assert f"Note =   Grüße\xa0= \x85 {end}\n".encode("latin-1") in lines
    assert b"Seq_Frame0000_FrameNumber = 7 \n" in lines
    assert zlib.decompress(pixels) == bytes(12)


def written(path, **fields):
    """A sweep of moving transforms, the second unseen, as its writer makes it; the first image is not
    valid.
    """
    with SweepWriter(path, fields) as writer:
        for frame in range(3):
            probe = None if frame == 1 else QUARTER_TURN * [1, 1, 1, frame] + np.diag([0.0, 0, 0, 1 - frame])
            more = {"Timestamp": repr(frame / 3), "FrameNumber": str(frame)}
            more["ImageStatus"] = "OK" if frame else "INVALID"
            image = (PIXELS[0] + np.uint8(frame)) * np.uint8(frame > 0)
            writer.append(image, transform_fields("ProbeToReference", probe) | more)
    return path


def test_the_header_of_a_new_sweep(tmp_path):
    lines, pixels = parts_of(written(tmp_path / "new.igs.mha", Note="a"))
    wanted = f"""ObjectType = Image
NDims = 3
AnatomicalOrientation = RAI
BinaryData = True
BinaryDataByteOrderMSB = False
CenterOfRotation = 0 0 0
CompressedData = True
CompressedDataSize = {len(pixels)}
DimSize = 4 3 3
Kinds = domain domain list
ElementSpacing = 1 1 1
ElementType = MET_UCHAR
Offset = 0 0 0
TransformMatrix = 1 0 0 0 1 0 0 0 1
UltrasoundImageOrientation = MF
UltrasoundImageType = BRIGHTNESS
Note = a
"""
    frames = (
        ("0 -1 0 0 1 0 0 0 0 0 1 0 0 0 0 1", "OK", "0.0", "INVALID"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "INVALID", "0.3333333333333333", "OK"),
        ("0 -1 0 20 1 0 0 40 0 0 1 60 0 0 0 1", "OK", "0.6666666666666666", "OK"),
    )
    for number, (matrix, status, time, image) in enumerate(frames):
        wanted += f"""Seq_Frame000{number}_ProbeToReferenceTransform = {matrix}
Seq_Frame000{number}_ProbeToReferenceTransformStatus = {status}
Seq_Frame000{number}_Timestamp = {time}
Seq_Frame000{number}_FrameNumber = {number}
Seq_Frame000{number}_ImageStatus = {image}
"""
    assert b"".join(lines).decode() == wanted + "ElementDataFile = LOCAL\n"


def test_frame_by_frame_and_at_once_give_the_same_bytes(tmp_path):
    one = written(tmp_path / "one.igs.mha").read_bytes()
    assert written(tmp_path / "one.igs.mha").read_bytes() == one
    sweep = read_sweep(tmp_path / "one.igs.mha")
    write_sweep(tmp_path / "two.igs.mha", sweep)
    assert (tmp_path / "two.igs.mha").read_bytes() == one
    # A sweep that no file was read for gets the same header.
    write_sweep(tmp_path / "three.igs.mha", Sweep(sweep.images, sweep.frames, {}))
    assert (tmp_path / "three.igs.mha").read_bytes() == one


def test_simpleitk_reads_the_pixels(tmp_path):
    path = written(tmp_path / "new.mha")
    assert np.array_equal(sitk.GetArrayFromImage(sitk.ReadImage(path)), read_sweep(path).images)


def test_poses_alone_are_written_as_plus_does(tmp_path):
    frames = [tracked(ProbeToReference=SCALED) | {"Timestamp": text} for text in ("0.5", "1.0")]
    write_sweep(tmp_path / "poses.igs.mha", Sweep(np.zeros((2, 0, 0), np.uint8), frames, {}))
    sweep = read_sweep(tmp_path / "poses.igs.mha")
    assert sweep.images.shape == (2, 0, 0)
    names = ("DimSize", "ElementType", "CompressedData", "UltrasoundImageOrientation", "UltrasoundImageType")
    assert [sweep.fields[name] for name in names] == ["0 0 2", "MET_OTHER", "False", "XX", "XX"]
    assert "CompressedDataSize" not in sweep.fields


def test_more_frames_than_four_digits_count(tmp_path):
    path = tmp_path / "long.igs.mha"
    with SweepWriter(path, {}) as writer:
        for frame in range(10_002):
            writer.append(np.full((1, 1), frame % 251, np.uint8), {"Timestamp": repr(frame / 100)})
        assert writer.count == 10_002
    sweep = read_sweep(path)
    assert b"\nSeq_Frame9999_Timestamp = 99.99\n" in path.read_bytes()
    assert b"\nSeq_Frame10001_Timestamp = 100.01\n" in path.read_bytes()
    assert np.array_equal(sweep.images.ravel(), np.arange(10_002) % 251)
    assert np.array_equal(sweep.times_s, np.arange(10_002) / 100)


@given(
    arrays(
        np.float64, (3, 4), elements=st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=False)
    )
)
@settings(max_examples=20, deadline=None)
def test_the_text_of_a_transform_is_exact(upper):
    matrix = np.vstack([upper, [0, 0, 0, 1]])
    text = transform_text(matrix)
    assert np.array_equal(matrix_of(text, "it"), matrix)
    assert "-0" not in text.split()


TEXTS = st.text(st.characters(max_codepoint=255, exclude_characters="\n"), max_size=20)
NAMES = st.sampled_from(["Timestamp", "AToBTransform", "Seq_Frame0000_x", "Two words", "é", "_"])


@given(st.lists(st.dictionaries(NAMES, TEXTS, min_size=1), min_size=1, max_size=4), st.data())
@settings(max_examples=20, deadline=None)
def test_whatever_stands_in_a_sweep_comes_back(tmp_path_factory, frames, data):
    images = data.draw(arrays(np.uint8, (len(frames), 3, 2)))
    path = tmp_path_factory.mktemp("sweep") / "any.igs.mha"
    write_sweep(path, Sweep(images, frames, {"Note": "a"}))
    again = read_sweep(path)
    assert again.frames == frames
    assert [list(fields) for fields in again.frames] == [list(fields) for fields in frames]
    assert np.array_equal(again.images, images)
