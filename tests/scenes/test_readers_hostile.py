"""Damaged and hostile files: refused in one line, in bounded memory, with nothing written and nothing read
elsewhere.
"""

import gzip
import resource
import shutil
import struct
import zipfile
import zlib

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_series import (
    Series,
    dicom_bytes,
    listing_dicomdir,
    refusal,
    save,
    zipped,
)
from pydicom.uid import DeflatedExplicitVRLittleEndian

from scenes.patients.readers import dicom_files
from scenes.patients.readers.ct_series import open_ct
from scenes.patients.readers.label_files import open_labels

MIB = 2**20
# What reading a refused file may take at its peak.
BOUND_MIB = 700


def peak_mib():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def files_in(folder):
    return sorted((str(file), file.stat().st_size) for file in folder.rglob("*"))


@pytest.fixture
def refused(tmp_path):
    """Refusal of a path that leaves the disk alone and the memory small."""

    def check(path, **options):
        before, peak = files_in(tmp_path), peak_mib()
        message = refusal(path, **options)
        assert files_in(tmp_path) == before
        assert peak_mib() - peak < BOUND_MIB
        return message

    return check


def image(kind=np.int16):
    made = sitk.GetImageFromArray(np.random.default_rng(5).integers(0, 900, (6, 10, 12)).astype(kind))
    made.SetSpacing((0.8, 0.7, 2.5))
    return made


def written(path, made=None, packed=False):
    sitk.WriteImage(image() if made is None else made, str(path), packed)
    return path


def replaced(path, old, new):
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return path


def inflating(file, honest=True):
    """A deflated file whose pixels are 320 MiB of zeros; a dishonest one says that its meta header is
    longer.
    """
    content = bytearray(file.read_bytes())
    meta = 144 + struct.unpack_from("<I", content, 140)[0]
    if not honest:
        struct.pack_into("<I", content, 140, 2**31 - 1)
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    start = packer.compress(zlib.decompress(content[meta:], -zlib.MAX_WBITS))
    start += packer.compress(struct.pack("<HHHHI", 0x7FE1, 0x10, 0x424F, 0, 20 * 16 * MIB)) + packer.flush(3)
    block = packer.compress(bytes(16 * MIB)) + packer.flush(3)
    file.write_bytes(bytes(content[:meta]) + start + block * 20)
    return file


class TestDicom:
    @pytest.mark.parametrize("share", [0.05, 0.2, 0.4, 0.6, 0.9, 0.999])
    def test_cut_off(self, tmp_path, refused, share):
        series = Series(tmp_path / "ct", size=(40, 30, 6))
        series.write()
        file = tmp_path / "ct" / "s1-2.dcm"
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
        message = refused(tmp_path / "ct", name="s1-")
        assert "s1-2.dcm" in message or "slice 2 (s1-1.dcm)" in message

    def test_empty_files_and_other_kinds_are_passed_over(self, tmp_path):
        series = Series(tmp_path)
        series.write()
        others = {
            "empty.dcm": b"",
            "text.dcm": b"Doe^Jane",
            "photo.dcm": b"\xff\xd8\xff\xe0\x00\x10JFIF" + bytes(400),
            "index.html": b"<html>" * 90,
            "viewer.exe": b"MZ" + bytes(500),
            "rt.jar": b"PK\3\4" + bytes(900),
            "s1-9.dcm.crdownload": bytes(300),
        }
        for name, content in others.items():
            (tmp_path / name).write_bytes(content)
        assert np.array_equal(open_ct(tmp_path).read(), series.hounsfield)

    @pytest.mark.parametrize("content", [b"", b"Doe^Jane", b"\xff\xd8\xff\xe0\x00\x10JFIF" + bytes(400)])
    def test_other_kinds(self, tmp_path, refused, content):
        (tmp_path / "a.dcm").write_bytes(content)
        assert "unknown kind of file" in refused(tmp_path / "a.dcm")

    @pytest.mark.parametrize("tags", [{"Rows": 60000, "Columns": 60000}, {"Rows": 8000, "Columns": 8000}])
    def test_claims_of_size(self, tmp_path, refused, tags):
        refused(Series(tmp_path / "ct").write(**tags), name="s1-")

    def test_far_place(self, tmp_path, refused):
        """A slice 6 m to the side would make a volume of a billion voxels."""
        series = Series(tmp_path / "ct")
        at = series.positions
        series.positions = lambda k: (
            at(k) + (k == 2) * 6000 * (series.direction[:, 0] + series.direction[:, 1])
        )
        refused(series.write())

    @pytest.mark.parametrize("honest", [True, False])
    def test_deflated_bomb(self, tmp_path, refused, honest, monkeypatch):
        monkeypatch.setattr(dicom_files, "MOST_INFLATED", 64 * MIB)
        save(Series(tmp_path).slice(0, syntax=DeflatedExplicitVRLittleEndian), tmp_path / "bomb.dcm")
        assert "inflates to more than" in refused(inflating(tmp_path / "bomb.dcm", honest))

    def test_deflated_medium(self, tmp_path, refused, monkeypatch):
        monkeypatch.setattr(dicom_files, "MOST_INFLATED", 64 * MIB)
        listed = listing_dicomdir(tmp_path / "cd", ["IM1"])
        data = pydicom.dcmread(listed)
        data.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
        data.save_as(listed)
        assert "inflates to more than" in refused(inflating(listed))

    def test_text_in_headers_is_not_repeated(self, tmp_path, refused):
        """A name where a number or a kind should be, and a line's end."""

        def odd(data, _):
            data["SeriesNumber"]._value = "Doe^Jane"

        Series(tmp_path / "ct").write(edit=odd)
        Series(tmp_path / "ct", number=5).write(Modality="Doe\nJane", SOPClassUID="1.2.3")
        assert "Doe" not in refused(tmp_path / "ct", series="77")
        notes = open_ct(tmp_path / "ct").notes
        assert all(note.isprintable() and "Doe" not in note and "Jane" not in note for note in notes)


class TestFiles:
    @pytest.mark.parametrize(
        ("ending", "old", "new"),
        [
            (".nrrd", b"sizes: 12 10 6", b"sizes: 60000 60000 60000"),
            (".nrrd", b"sizes: 12 10 6", b"sizes: 1000 1000 1000"),
            (".mha", b"DimSize = 12 10 6", b"DimSize = 60000 60000 60000"),
            (".mha", b"DimSize = 12 10 6", b"DimSize = 1000 1000 1000"),
        ],
    )
    @pytest.mark.parametrize("packed", [False, True])
    def test_claims_of_size(self, tmp_path, refused, ending, old, new, packed):
        assert (
            "claims" in refused(replaced(written(tmp_path / f"a{ending}", packed=packed), old, new)) or packed
        )

    @pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
    @pytest.mark.parametrize(
        "dim", [(3, 30000, 30000, 30000), (3, 1000, 1000, 1000), (3, -5, 10, 6), (3, 12, 10, 0)]
    )
    def test_claims_of_nifti(self, tmp_path, refused, ending, dim):
        plain = nibabel.Nifti1Image(np.zeros((12, 10, 6), np.int16), np.eye(4)).to_bytes()
        content = plain[:40] + struct.pack("<4h", *dim) + plain[48:]
        (tmp_path / f"a{ending}").write_bytes(gzip.compress(content) if ending.endswith("gz") else content)
        refused(tmp_path / f"a{ending}")

    @pytest.mark.parametrize("offset", [1e9, 1e20, np.inf, np.nan, -5])
    @pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
    def test_offsets_of_nifti(self, tmp_path, refused, ending, offset):
        plain = nibabel.Nifti1Image(np.zeros((12, 10, 6), np.int16), np.eye(4)).to_bytes()
        content = plain[:108] + struct.pack("<f", offset) + plain[112:]
        (tmp_path / f"a{ending}").write_bytes(gzip.compress(content) if ending.endswith("gz") else content)
        refused(tmp_path / f"a{ending}")

    def test_series_of_a_file(self, tmp_path, refused):
        assert "has no series" in refused(written(tmp_path / "a.mha"), series="3")

    def test_components_count_too(self, tmp_path, refused):
        """Segments of 3D Slicer are components of a voxel; so many fit into no file of this size."""
        path = written(tmp_path / "a.seg.nrrd", sitk.Compose(image(), image()), packed=True)
        replaced(path, b"sizes: 2 12 10 6", b"sizes: 40000 12 10 6")
        assert "claims" in refused(path, read=open_labels)

    @pytest.mark.parametrize("ending", [".nii.gz", ".nii", ".nrrd", ".mha"])
    @pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.98])
    def test_cut_off(self, tmp_path, refused, ending, share):
        path = written(tmp_path / f"a{ending}", packed=ending != ".nii")
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        refused(path)

    @pytest.mark.parametrize("ending", [".nii.gz", ".nrrd", ".mha"])
    def test_not_a_number(self, tmp_path, refused, ending):
        voxels = sitk.GetArrayFromImage(image(np.float32))
        voxels[2, 3, 4:6] = np.nan, np.inf
        assert "2 voxels are not finite" in refused(
            written(tmp_path / f"a{ending}", sitk.GetImageFromArray(voxels))
        )

    @pytest.mark.parametrize("ending", [".nii", ".nii.gz", ".nrrd", ".mha", ".mhd", ".nhdr"])
    @pytest.mark.parametrize("content", [b"", b"text", b"NRRD0005\nnonsense", bytes(500)])
    def test_nonsense(self, tmp_path, refused, ending, content):
        (tmp_path / f"a{ending}").write_bytes(content)
        refused(tmp_path / f"a{ending}")

    def test_sheared(self, tmp_path, refused):
        affine = np.diag([0.8, 0.7, 2.5, 1])
        affine[1, 2] = 0.7
        sheared = nibabel.Nifti1Image(np.zeros((12, 10, 6), np.int16), affine)
        sheared.set_qform(None, 0)
        nibabel.save(sheared, tmp_path / "a.nii")
        assert "sheared" in refused(tmp_path / "a.nii")
        path = written(tmp_path / "a.nrrd")
        assert "sheared" in refused(replaced(path, b"(0,0,2.5)", b"(0,0.7,2.4)"))
        path = written(tmp_path / "a.mha")
        matrix = b"TransformMatrix = 1 0 0 0 1 0 0 0 1"
        refused(replaced(path, matrix, b"TransformMatrix = 1 0 0 0 1 0 0 0.28 0.96"))

    def test_without_space(self, tmp_path, refused):
        path = written(tmp_path / "a.nrrd")
        replaced(path, b"space: left-posterior-superior", b"space dimension: 3")
        assert "has no space field" in refused(path)

    def test_not_one_volume(self, tmp_path, refused):
        assert "one 3D volume" in refused(written(tmp_path / "flat.mha", sitk.Image([8, 8], sitk.sitkInt16)))
        rgb = sitk.Image([8, 8, 8], sitk.sitkVectorUInt8, 3)
        assert "one number" in refused(written(tmp_path / "rgb.mha", rgb))
        films = nibabel.Nifti1Image(np.zeros((8, 8, 8, 2), np.int16), np.eye(4))
        nibabel.save(films, tmp_path / "a.nii")
        assert "8 x 8 x 8 x 2" in refused(tmp_path / "a.nii")

    @pytest.mark.parametrize("ending", [".mhd", ".mha"])
    @pytest.mark.parametrize(
        "line",
        [
            "ElementDataFile = ../x.raw", "ElementDataFile = {outside}/x.raw", "ElementDataFile: ../x.raw",
            "Comment = a\x85ElementDataFile = LOCAL\nElementDataFile = ../x.raw",
            "Comment = a\rElementDataFile = LOCAL\nElementDataFile = ../x.raw",
            "\n\nElementDataFile = ../x.raw",
            "{long}ElementDataFile = ../x.raw", "ElementDataFile = LIST\n../x.raw",
            "ElementDataFile = x%d.raw 1 6 1",
            "BinaryData = True ElementDataFile = ../x.raw", "ElementDataFile = a\0b",
            "ElementDataFile = {name}", "ElementDataFile = link.raw",
        ],
    )  # fmt: skip
    def test_voxels_of_metaimage_elsewhere(self, tmp_path, refused, ending, line):
        path = self.elsewhere(tmp_path, ending)
        head = path.read_bytes().split(b"ElementDataFile")[0]
        long = "".join(f"Comment = {'y' * 200}\n" for _ in range(400))
        line = line.format(outside=tmp_path, long=long, name="q" * 300)
        path.write_bytes(head + line.encode("latin-1") + b"\n")
        refused(path)

    @pytest.mark.parametrize(
        "line",
        [
            "data file: ../x.raw", "datafile: {outside}/x.raw", "Data File:../x.raw",
            "data file: LIST\n../x.raw",
            "data file: ../x%d.raw 1 6 1", "# a\x85data file: in.raw\ndata file: ../x.raw",
            "# {name}\ndata file: ../x.raw", "data file: a\0b", "data file: link.raw",
        ],
    )  # fmt: skip
    def test_voxels_of_nrrd_elsewhere(self, tmp_path, refused, line):
        path = self.elsewhere(tmp_path, ".nhdr")
        head = path.read_bytes().split(b"data file:")[0]
        line = line.format(outside=tmp_path, name="y" * 70_000)
        path.write_bytes(head + line.encode("latin-1") + b"\n\n")
        refused(path)

    @staticmethod
    def elsewhere(folder, ending):
        """A header in a folder of its own, whose voxels lie above it, and a link to them."""
        (folder / "ct").mkdir()
        path = written(folder / "ct" / "a.mhd" if ending != ".nhdr" else folder / "ct" / "a.nhdr")
        (folder / "ct" / "a.raw").rename(folder / "x.raw")
        shutil.copy(folder / "x.raw", folder / "ct" / "in.raw")
        (folder / "ct" / "link.raw").symlink_to(folder / "x.raw")
        return path.rename(path.with_suffix(ending))


def archive(path, entries):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        for name, content in entries.items():
            made.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return path


def declared(path, size=None, flags=None):
    """An archive whose headers say another size, or other flags, of each file."""
    content = bytearray(path.read_bytes())
    for signature, flags_at, size_at in ((b"PK\3\4", 6, 22), (b"PK\1\2", 8, 24)):
        at = content.find(signature)
        while at >= 0:
            if flags is not None:
                struct.pack_into("<H", content, at + flags_at, flags)
            if size is not None:
                struct.pack_into("<I", content, at + size_at, size)
            at = content.find(signature, at + 4)
    path.write_bytes(content)
    return path


# Its files, what its headers say of them, and the refusal.
BOMBS = {
    "huge entry": (lambda one: {"b.dcm": one}, dict(size=3 * 2**30), "extracts to 3 GiB"),
    # Zeros behind a slice: a thousandth of the room that they take.
    "packed entry": (lambda one: {"b.dcm": one + bytes(200 * MIB)}, {}, "one slice only"),
    "larger than declared": (lambda one: {"b.dcm": one + bytes(50 * MIB)}, dict(size=1000), "b.dcm"),
    "encrypted": (lambda one: {"b.dcm": one}, dict(flags=1), "encrypted"),
    "line in a name": (lambda one: {"b\nc.dcm": one}, dict(flags=1), ""),
}


class TestArchives:
    @pytest.fixture
    def slice_bytes(self, tmp_path):
        return dicom_bytes(Series(tmp_path).slice(0))

    @pytest.mark.parametrize(
        "name", ["../a.dcm", "a/../../a.dcm", "/etc/a.dcm", "C:\\a.dcm", "..\\a.dcm", "\\\\host\\a.dcm"]
    )
    def test_names_that_lead_outside(self, tmp_path, refused, slice_bytes, name):
        assert "with a path outside" in refused(
            archive(tmp_path / "a.zip", {"b.dcm": slice_bytes, name: slice_bytes})
        )

    @pytest.mark.parametrize("bomb", BOMBS)
    def test_bombs(self, tmp_path, refused, slice_bytes, bomb):
        entries, said, words = BOMBS[bomb]
        path = archive(tmp_path / "a.zip", entries(slice_bytes))
        assert words in refused(declared(path, **said) if said else path)

    def test_archive_in_an_archive(self, tmp_path, refused, slice_bytes):
        archive(tmp_path / "in.zip", {"b.dcm": slice_bytes})
        outer = archive(tmp_path / "a.zip", {"in.zip": (tmp_path / "in.zip").read_bytes()})
        assert "unknown kind of file" in refused(outer)

    def test_entry_without_a_name(self, tmp_path, refused, slice_bytes):
        path = archive(tmp_path / "a.zip", {"Zb.dcm": slice_bytes})
        path.write_bytes(path.read_bytes().replace(b"Zb.dcm", b"\0b.dcm"))
        refused(path)

    def test_many_entries(self, tmp_path, refused, monkeypatch):
        monkeypatch.setattr(dicom_files, "MOST_FILES", 20)
        assert "has 21 files" in refused(archive(tmp_path / "a.zip", {f"{n}": b"" for n in range(21)}))
        monkeypatch.setattr(dicom_files, "MOST_FILES", 5)
        assert "more than 5 files" in refused(Series(tmp_path / "ct").write())

    def test_many_large_entries(self, tmp_path, refused, monkeypatch, slice_bytes):
        monkeypatch.setattr(dicom_files, "MOST_ARCHIVE_BYTES", 2 * len(slice_bytes))
        many = archive(tmp_path / "a.zip", {f"{n}.dcm": slice_bytes for n in range(3)})
        assert "GiB of DICOM; expected at most" in refused(many)

    @pytest.mark.parametrize("share", [0.3, 0.7, 0.99])
    def test_cut_off(self, tmp_path, refused, share):
        Series(tmp_path / "ct").write()
        path = zipped(tmp_path / "ct", tmp_path / "a.zip")
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        assert "a damaged archive" in refused(path)

    @pytest.mark.parametrize(
        ("name", "words"),
        [
            (["..", "..", "x.dcm"], "is outside"), ("/etc/passwd", "is outside"), ("C:\\x.dcm", "is outside"),
            (["IM", "..", "..", "x"], "is outside"), ("link.dcm", "is outside"), (["IM", "1"], "is missing"),
            ("a\0b", ""), ("q" * 300, ""), ("a\nb", ""),
        ],
    )  # fmt: skip
    def test_medium_that_lists_other_files(self, tmp_path, refused, slice_bytes, name, words):
        (tmp_path / "x.dcm").write_bytes(slice_bytes)
        listed = listing_dicomdir(tmp_path / "cd", [name])
        (tmp_path / "cd" / "link.dcm").symlink_to(tmp_path / "x.dcm")
        assert words in refused(listed)

    def test_medium_without_images(self, tmp_path, refused):
        assert "lists no image" in refused(listing_dicomdir(tmp_path / "cd", []))
        (tmp_path / "DICOMDIR").write_text("text")
        assert "cannot be read as a DICOMDIR" in refused(tmp_path / "DICOMDIR")
