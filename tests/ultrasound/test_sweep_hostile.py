"""Sweeps that cannot be: damaged files and wrong frames are refused in words, and leave all as it was."""

import zlib

import numpy as np
import pytest
from test_sweep import PIXELS, SCALED, file_of, written

from ultrasound.sweep import SweepError, load_constants, transform_fields, transform_text
from ultrasound.sweep_file import SweepWriter, read_sweep

SQUEEZED = zlib.compress(bytes(12))
HOSTILE = {
    "no such element": (dict(ElementType="MET_USHORT"), "ElementType = 'MET_USHORT': expected MET_UCHAR"),
    "element type gone": (dict(ElementType=None), "ElementType = ''"),
    "colour": (dict(ElementNumberOfChannels="3"), "ElementNumberOfChannels = '3': expected 1"),
    "descending": (
        dict(UltrasoundImageOrientation="MFD"),
        "UltrasoundImageOrientation = 'MFD': expected MF or",
    ),
    "orientation unknown": (dict(UltrasoundImageOrientation="XX"), "UltrasoundImageOrientation = 'XX'"),
    "orientation gone": (dict(UltrasoundImageOrientation=None), "UltrasoundImageOrientation = ''"),
    "four dimensions": (dict(NDims="4"), "NDims = '4'"),
    "a vector": (dict(Kinds="vector domain domain"), "Kinds = "),
    "text pixels": (dict(BinaryData="False"), "BinaryData = 'False'"),
    "compressed somehow": (dict(CompressedData="Perhaps"), "CompressedData = 'Perhaps'"),
    "another file": (dict(ElementDataFile="other.raw"), "ElementDataFile = 'other.raw': expected LOCAL"),
    "no end": (dict(ElementDataFile=None, pixels=b""), "no ElementDataFile = LOCAL"),
    "no sweep": (dict(ObjectType="Mesh"), "expected a tracked one .*begins with ObjectType = Image"),
    "no size": (dict(DimSize=None), "DimSize = ''"),
    "size of two": (dict(DimSize="4 3"), "DimSize = '4 3'"),
    "size of words": (dict(DimSize="4 3 one"), "DimSize = '4 3 one'"),
    "negative": (dict(DimSize="4 3 -1"), "DimSize = '4 3 -1'"),
    "huge": (dict(DimSize="99999 99999 1"), "DimSize = '99999 99999 1'"),
    "digits beyond int": (dict(DimSize="4 3 " + "9" * 5000), "DimSize = "),
    "no frame": (dict(DimSize="4 3 0"), "DimSize = '4 3 0'"),
    "poses for ever": (dict(DimSize="0 0 999999999"), "DimSize has 999999999 frames, but 1 have fields"),
    "too few frames": (dict(DimSize="4 3 2"), "DimSize has 2 frames, but 1 have fields"),
    "too many frames": (dict(Seq_Frame0001_A="b"), "DimSize has 1 frames, but 2 have fields"),
    "a gap": (dict(DimSize="4 3 2", Seq_Frame0002_A="b"), "2 have fields, the last is 2"),
    "no number": (dict(Seq_FrameABCD_A="b"), "'Seq_FrameABCD_A': expected Seq_Frame0000_Name"),
    "no field": (dict(Seq_Frame0000="b"), "'Seq_Frame0000': expected"),
    "twice": (dict(raw="NDims = 3\n"), "'NDims'.*twice"),
    "no equals": (dict(raw="what is this\n"), "'what is this.n': expected Name = value"),
    "no name": (dict(raw=" = 3\n"), "expected Name = value"),
    "short": (dict(pixels=bytes(11)), "11 bytes of pixels: expected 12"),
    "long": (dict(pixels=bytes(13)), "13 bytes of pixels: expected 12"),
}


def squeezed(pixels: bytes, size: str | None = None) -> dict:
    return dict(pixels=pixels, CompressedData="True", CompressedDataSize=size or str(len(pixels)))


HOSTILE |= {
    "no zlib": (squeezed(b"nonsense"), "zlib data"),
    "bad checksum": (squeezed(SQUEEZED[:-1] + b"x"), "zlib data"),
    "cut off": (squeezed(SQUEEZED[:-4]), "expected 12"),
    "size too small": (squeezed(SQUEEZED, "3"), "CompressedDataSize = '3'"),
    "size none": (squeezed(SQUEEZED, "some"), "CompressedDataSize = 'some'"),
    "left over": (squeezed(SQUEEZED + b"x"), "expected 12"),
    "a bomb": (squeezed(zlib.compress(bytes(10_000_000))), "bytes .* for 12"),
    "a small bomb": (
        squeezed(zlib.compress(bytes(10_000))),
        "13 bytes of pixels or more in the zlib data: expected 12",
    ),
    "fewer": (squeezed(zlib.compress(bytes(11))), "11 bytes of pixels or more in the zlib data: expected 12"),
}


@pytest.mark.parametrize("changed, words", HOSTILE.values(), ids=HOSTILE.keys())
def test_damaged_files_are_refused_in_words(tmp_path, changed, words):
    path = file_of(tmp_path / "damaged.igs.mha", **changed)
    with pytest.raises(SweepError, match=words) as caught:
        read_sweep(path)
    assert str(caught.value).startswith("damaged.igs.mha: ")
    assert len(str(caught.value).splitlines()) == 1
    assert str(tmp_path) not in str(caught.value)


def test_the_file_that_damage_is_done_to_is_whole(tmp_path):
    assert read_sweep(file_of(tmp_path / "a.mha")).times_s == 1.5
    assert read_sweep(file_of(tmp_path / "b.mha", **squeezed(SQUEEZED))).images.shape == (1, 3, 4)


def test_a_header_without_end_is_not_read_to_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr("ultrasound.sweep_file.HEADER_LIMIT", 1 << 16)
    path = tmp_path / "endless.igs.mha"
    with path.open("wb") as file:
        file.write(b"ObjectType = Image\nA = ")
        file.truncate(10 << 30)  # sparse
    with pytest.raises(SweepError, match=f"in the first {1 << 16} bytes"):
        read_sweep(path)


def test_what_is_no_file_is_refused(tmp_path):
    for path in (tmp_path / "none.igs.mha", tmp_path):
        with pytest.raises(SweepError, match=f"^{path.name}: "):
            read_sweep(path)


def test_after_an_exception_all_is_as_before(tmp_path):
    path = tmp_path / "a.igs.mha"
    path.write_text("what stood here")

    def images():
        yield PIXELS[0]
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"), SweepWriter(path, {}) as writer:
        list(map(writer.append, images(), [{}, {}]))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "what stood here"


def test_a_file_that_cannot_be_put_in_place_leaves_nothing(tmp_path):
    (tmp_path / "a.igs.mha").mkdir()
    with pytest.raises(OSError, match="irectory"):
        written(tmp_path / "a.igs.mha")
    assert [file.name for file in tmp_path.iterdir()] == ["a.igs.mha"]


def test_a_sweep_without_frames_is_none(tmp_path):
    with pytest.raises(SweepError, match="without frames"), SweepWriter(tmp_path / "a.igs.mha", {}):
        pass
    assert not list(tmp_path.iterdir())


REFUSED = {
    "of floats": ((PIXELS[0] / 2, {}), "image of float64"),
    "of colours": ((PIXELS, {}), r"image of uint8 \(2, 3, 4\): expected"),
    "empty": ((PIXELS[0, :0], {}), "image of uint8"),
    "of another size": ((PIXELS[0, :2], {}), r"expected uint8 \(3, 4\)"),
    "two lines": ((PIXELS[0], {"Note": "a\nDimSize = 1 1 1"}), "expected one line"),
    "equals": ((PIXELS[0], {"a=b": "c"}), "no = in the name"),
    "beyond Latin-1": ((PIXELS[0], {"Note": "\u03bcm"}), "beyond Latin-1"),
}


@pytest.mark.parametrize("arguments, words", REFUSED.values(), ids=REFUSED.keys())
def test_a_frame_refused_leaves_the_others(tmp_path, arguments, words):
    with SweepWriter(tmp_path / "a.igs.mha", {}) as writer:
        writer.append(PIXELS[0], {"A": "b"})
        with pytest.raises(SweepError, match=words):
            writer.append(*arguments)
    sweep = read_sweep(tmp_path / "a.igs.mha")
    assert len(sweep) == 1
    assert np.array_equal(sweep.images, PIXELS[:1])


@pytest.mark.parametrize("matrix", [SCALED[:3], SCALED * np.nan])
def test_what_is_no_transform_is_not_written(matrix):
    with pytest.raises(SweepError, match="expected sixteen finite numbers"):
        transform_fields("AToB", matrix)


def test_a_frame_beyond_the_limit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("ultrasound.sweep_file.PIXEL_LIMIT", 30)
    with SweepWriter(tmp_path / "a.igs.mha", {}) as writer:
        for _ in range(2):
            writer.append(PIXELS[0], {"A": "b"})
        with pytest.raises(SweepError, match="frame 2: more than 30 bytes"):
            writer.append(PIXELS[0], {"A": "b"})
    assert len(read_sweep(tmp_path / "a.igs.mha")) == 2


XML = "<PlusConfiguration><CoordinateDefinitions>{}</CoordinateDefinitions></PlusConfiguration>"
ONE = '<Transform From="Image" To="Probe" Matrix="{}"/>'


@pytest.mark.parametrize(
    "text, words",
    [
        ("no XML", "no XML"),
        ("<a/>", "no CoordinateDefinitions"),
        (XML.format(""), "no CoordinateDefinitions"),
        (XML.format(ONE.format("1 0")), "ImageToProbe Matrix = '1 0': expected sixteen"),
        (XML.format('<Transform To="Probe"/>'), "Transform 'ToProbe'"),
        (XML.format(ONE.format(transform_text(SCALED)) * 2), "Transform .*each pair once"),
        ('<?xml version="1.0" encoding="none"?><a/>', "no XML"),
        ('<?xml version="1.0" encoding="shift_jis"?><a/>', "no XML"),
        (" " * (1 << 22) + "<a/>", "more than 4 MB"),
    ],
)
def test_a_configuration_that_is_none(tmp_path, text, words):
    path = tmp_path / "plus.xml"
    path.write_text(text)
    with pytest.raises(SweepError, match=f"^plus.xml: {words}"):
        load_constants(path)
    with pytest.raises(SweepError, match=r"^none.xml: .*expected a PLUS configuration .*--scene"):
        load_constants(tmp_path / "none.xml")
