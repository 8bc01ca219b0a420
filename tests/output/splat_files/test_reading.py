"""Files of static Gaussians: what is written is read again, what others write too, and what is spoiled is refused."""

from __future__ import annotations

import gzip
import struct
import zlib

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.geometry.rotations import multiply_quats, normalize_quats, quats_to_rotations
from flowsplat.output.export.formats.ply import write_ply
from flowsplat.output.export.formats.splat import RECORD, write_splat
from flowsplat.output.export.formats.spz import MAGIC, write_spz
from flowsplat.output.export.still import FLIP_AXES, Still, rotate_harmonics
from flowsplat.output.splat_files import is_splat_file, read_splats
from flowsplat.output.splat_files.ply import MAX_HEADER_BYTES
from flowsplat.output.splat_files.splats import MAX_GAUSSIANS
from flowsplat.splatting.rules import C0


def make_still(count: int = 50, degree: int = 3) -> Still:
    g = torch.Generator().manual_seed(0)
    sh = 0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    return Still(
        torch.randn(count, 3, generator=g), normalize_quats(torch.randn(count, 4, generator=g)),
        torch.randn(count, 3, generator=g) - 3, torch.rand(count, generator=g) * 0.98 + 0.01, sh,
        torch.zeros(count, dtype=torch.uint8), None,
    )  # fmt: skip


def flipped(still: Still) -> Still:
    half = torch.tensor([0.0, 1, 0, 0]).expand(len(still.means), 4)
    return Still(
        still.means @ FLIP_AXES.T, multiply_quats(half, still.quats), still.log_scales, still.opacities,
        rotate_harmonics(still.sh, FLIP_AXES.double()), still.object_ids, still.seen,
    )  # fmt: skip


def turned_apart(a: np.ndarray, b: torch.Tensor) -> float:
    """Largest difference of the rotations: q and -q are the same."""
    return float((quats_to_rotations(torch.from_numpy(a)) - quats_to_rotations(b)).abs().max())


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_is_read_as_it_was_written(tmp_path, degree):
    still = make_still(degree=degree)
    write_ply(tmp_path / "a.ply", still, has_objects=True, comments=["end_headers are words"])
    found = read_splats(tmp_path / "a.ply")
    assert found.sh_degree == degree
    for name in ("means", "quats", "log_scales", "sh"):
        np.testing.assert_array_equal(getattr(found, name), getattr(still, name).numpy())
    np.testing.assert_allclose(found.logit_opacities, still.logit_opacities.numpy())


@pytest.mark.parametrize("degree", [0, 3])
def test_an_spz_is_read_as_it_was_written(tmp_path, degree):
    still = make_still(degree=degree)
    write_spz(tmp_path / "a.spz", flipped(still))
    found = read_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(found.means, still.means.numpy(), atol=1e-4)
    np.testing.assert_allclose(found.log_scales, still.log_scales.numpy(), atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found.logit_opacities)), still.opacities.numpy(), atol=1 / 500)
    np.testing.assert_allclose(found.sh[:, 0], still.sh[:, 0].numpy(), atol=0.015)
    np.testing.assert_allclose(found.sh[:, 1:], still.sh[:, 1:].numpy(), atol=0.02)
    assert turned_apart(found.quats, still.quats) < 0.01


def test_an_spz_of_version_2_is_read(tmp_path):
    """One Gaussian, byte by byte: at (1, -2, 0.5), turned by 90 degrees about x."""
    half = np.sqrt(0.5)
    positions = b"".join(int(value * 4096).to_bytes(3, "little", signed=True) for value in (1, -2, 0.5))
    rotation = bytes([round((value + 1) * 127.5) for value in (half, 0, 0)])
    body = positions + bytes([255, 128, 128, 128, 160, 112, 96]) + rotation
    (tmp_path / "a.spz").write_bytes(gzip.compress(struct.pack("<IIIBBBB", MAGIC, 2, 1, 0, 12, 0, 0) + body))
    found = read_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(found.means, [[1, 2, -0.5]])
    np.testing.assert_allclose(found.log_scales, [[0, -3, -4]])
    assert found.logit_opacities[0] == 16
    assert turned_apart(found.quats, torch.tensor([[-half, half, 0, 0]], dtype=torch.float32)) < 0.02


def test_a_splat_is_read_as_it_was_written(tmp_path):
    still = make_still(degree=0)
    write_splat(tmp_path / "a.splat", still)
    found = read_splats(tmp_path / "a.splat")
    order = [int(np.abs(still.means.numpy() - mean).sum(1).argmin()) for mean in found.means]
    assert sorted(order) == list(range(50))
    np.testing.assert_array_equal(found.means, still.means[order].numpy())
    np.testing.assert_allclose(found.log_scales, still.log_scales[order].numpy(), atol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-found.logit_opacities)), still.opacities[order].numpy(), atol=1 / 500)
    assert turned_apart(found.quats, still.quats[order]) < 0.03


def ply(*properties: str, count: object = 1, form: str = "binary_little_endian", body: bytes = b"", before: str = "") -> bytes:
    lines = ["ply", f"format {form} 1.0", *([before] if before else []), f"element vertex {count}", *properties, "end_header", ""]
    return "\n".join(lines).encode() + body


NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()  # noqa: SIM905
FLOATS = [f"property float {name}" for name in NAMES]
VALUES = [0.5, 1, 2, 0.1, 0.2, 0.3, 1.5, -3, -3, -4, 1, 0, 0, 0]


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_properties_may_come_in_any_order_and_type(tmp_path, form, order):
    names = ["red", *reversed(NAMES)]
    types = ["uchar", *(["double"] * 7), *(["float32"] * 7)]
    record = np.dtype(
        [(name, order + {"uchar": "u1", "double": "f8", "float32": "f4"}[kind]) for name, kind in zip(names, types, strict=True)]
    )
    vertex = np.array([(7, *reversed(VALUES))], record)
    properties = [f"property {kind} {name}" for kind, name in zip(types, names, strict=True)]
    (tmp_path / "a.PLY").write_bytes(ply(*properties, form=form, body=vertex.tobytes() + b"more"))
    found = read_splats(tmp_path / "a.PLY")
    np.testing.assert_allclose(found.means, [[0.5, 1, 2]])
    np.testing.assert_allclose(found.sh, [[[0.1, 0.2, 0.3]]])
    np.testing.assert_allclose(found.log_scales, [[-3, -3, -4]])


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_the_format_of_a_ply_may_stand_behind_its_properties(tmp_path, form, order):
    lines = ply(*FLOATS, form=form).decode().splitlines()
    lines.insert(-1, lines.pop(1))
    assert lines[-2].startswith("format")
    (tmp_path / "a.ply").write_bytes("\n".join([*lines, ""]).encode() + np.array(VALUES, f"{order}f4").tobytes())
    found = read_splats(tmp_path / "a.ply")
    np.testing.assert_allclose(found.means, [[0.5, 1, 2]])
    np.testing.assert_allclose(found.log_scales, [[-3, -3, -4]])


def test_a_ply_of_another_writer_is_read(tmp_path):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed")
    vertices = np.zeros(4, [(name, "f4") for name in (*NAMES, *(f"f_rest_{k}" for k in range(9)))])
    for k, name in enumerate(vertices.dtype.names):
        vertices[name] = np.arange(4) + 0.1 * k + 0.1
    element = plyfile.PlyElement.describe(vertices, "vertex")
    for order in "<>":
        plyfile.PlyData([element], byte_order=order, comments=["of another"]).write(tmp_path / "a.ply")
        found = read_splats(tmp_path / "a.ply")
        np.testing.assert_array_equal(found.means, np.stack([vertices[name] for name in "xyz"], 1))
        np.testing.assert_array_equal(found.quats, np.stack([vertices[f"rot_{k}"] for k in range(4)], 1))
        np.testing.assert_array_equal(found.sh[:, 2], np.stack([vertices[f"f_rest_{k}"] for k in (1, 4, 7)], 1))
    plyfile.PlyData([element], text=True).write(tmp_path / "a.ply")
    with pytest.raises(InputError, match="format ascii"):
        read_splats(tmp_path / "a.ply")


def test_harmonics_beyond_degree_3_are_left_out(tmp_path):
    rest = [f"property float f_rest_{k}" for k in range(72)]
    body = np.array([*VALUES, *range(72)], "<f4").tobytes()
    (tmp_path / "a.ply").write_bytes(ply(*FLOATS, *rest, body=body))
    found = read_splats(tmp_path / "a.ply")
    assert found.sh.shape == (1, 16, 3)
    assert found.sh[0, 1].tolist() == [0, 24, 48]
    assert found.sh[0, 15].tolist() == [14, 38, 62]


def test_an_spz_of_degree_4_is_read_up_to_degree_3(tmp_path):
    rest = np.arange(24 * 3, dtype=np.uint8) + 100
    packed = bytes(9) + bytes([255, 128, 128, 128, 160, 112, 96]) + bytes([0, 0, 0, 192])
    for name, degree, size in (("a.spz", 4, 72), ("b.spz", 3, 45)):
        header = struct.pack("<IIIBBBB", MAGIC, 3, 1, degree, 12, 0, 0)
        (tmp_path / name).write_bytes(gzip.compress(header + packed + rest.tobytes()[:size]))
    found = read_splats(tmp_path / "a.spz")
    assert found.sh.shape == (1, 16, 3)
    np.testing.assert_allclose(found.sh, read_splats(tmp_path / "b.spz").sh, atol=1e-6)


def test_what_cannot_be_drawn_is_left_out_and_counted(tmp_path, capsys):
    values = np.tile(np.array(VALUES, "<f4"), (6, 1))
    values[0, 0], values[1, 6], values[2, 7], values[3, 10], values[4, 6] = np.nan, np.nan, 1000, 0, np.inf
    (tmp_path / "a.ply").write_bytes(ply(*FLOATS, count=6, body=values.tobytes()))
    found = read_splats(tmp_path / "a.ply")
    assert found.logit_opacities.tolist() == [16, 1.5]
    assert "4 of 6 Gaussians are left out" in " ".join(capsys.readouterr().err.split())
    (tmp_path / "a.ply").write_bytes(ply(*FLOATS, count=1, body=values[:1].tobytes()))
    with pytest.raises(InputError, match="no Gaussian that can be drawn"):
        read_splats(tmp_path / "a.ply")


GOOD = np.array(VALUES, "<f4").tobytes()
HUGE = struct.pack("<IIIBBBB", MAGIC, 3, MAX_GAUSSIANS + 1, 0, 12, 0, 0)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.ply", b"", "does not begin with ply"),
        ("a.ply", b"plx", "does not begin with ply"),
        ("a.ply", b"ply\n" + b"comment x\n" * MAX_HEADER_BYTES, "header does not end"),
        ("a.ply", ply(*FLOATS, body=GOOD[:-1]), "truncated"),
        ("a.ply", ply(*FLOATS, count=10**9, body=GOOD), "at most 10,000,000"),
        ("a.ply", ply(*FLOATS, count=10**40, body=GOOD), "no number of vertices"),
        ("a.ply", ply(*FLOATS, count="-1", body=GOOD), "no number of vertices"),
        ("a.ply", ply(*FLOATS, count="1_0", body=GOOD), "no number of vertices"),
        ("a.ply", ply(*FLOATS, form="ascii", body=GOOD), "format ascii"),
        ("a.ply", ply(*FLOATS[1:], body=GOOD), "no x"),
        ("a.ply", ply(*FLOATS, FLOATS[0], body=GOOD), "twice"),
        ("a.ply", ply(*FLOATS, "property float f_rest_0", body=GOOD), "whole degrees"),
        ("a.ply", ply(*FLOATS, *(f"property float f_rest_{k}" for k in range(1, 10)), body=GOOD), "whole degrees"),
        ("a.ply", ply(*FLOATS, "property list uchar int more", body=GOOD), "no property of a vertex"),
        ("a.ply", ply(*FLOATS, "nonsense", body=GOOD), "no line of a PLY header"),
        ("a.ply", ply(*FLOATS, *(f"property double d{k}" for k in range(600)), body=GOOD * 99), "bytes a Gaussian"),
        ("a.ply", ply(*FLOATS, before="element chunk 5", body=GOOD), "compressed PLY"),
        ("a.splat", b"x" * 33, "no multiple of 32"),
        ("a.splat", b"", "no Gaussian that can be drawn"),
        ("a.spz", b"", "truncated"),
        ("a.spz", b"x" * 100, "cannot be unpacked"),
        ("a.spz", gzip.compress(b"x" * 100), "first four bytes"),
        ("a.spz", gzip.compress(HUGE), "at most 10,000,000"),
        ("a.spz", gzip.compress(struct.pack("<IIIBBBB", MAGIC, 1, 1, 0, 12, 0, 0)), "version 1"),
        ("a.spz", gzip.compress(struct.pack("<IIIBBBB", MAGIC, 3, 1, 5, 12, 0, 0)), "degree 5"),
        ("a.spz", gzip.compress(struct.pack("<IIIBBBB", MAGIC, 3, 1, 0, 99, 0, 0)), "99 bits"),
        ("a.spz", gzip.compress(struct.pack("<IIIBBBB", MAGIC, 3, 9, 0, 12, 0, 0) + b"x" * 50), "truncated"),
        ("a.txt", b"ply", "none of .ply, .splat, .spz"),
    ],
    ids=lambda value: value if isinstance(value, str) else "bytes",  # packed bytes hold the time of day
)  # fmt: skip
def test_what_cannot_be_read_is_refused(tmp_path, name, data, said):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=said):
        read_splats(tmp_path / name)


class CountingUnpacker:
    """What zlib unpacks with, and how many bytes have come out of it."""

    unpacked = 0

    def __init__(self, wbits):
        self._own = DECOMPRESSOR(wbits)

    def __getattr__(self, name):
        return getattr(self._own, name)

    def decompress(self, *arguments):
        data = self._own.decompress(*arguments)
        CountingUnpacker.unpacked += len(data)
        return data


DECOMPRESSOR = zlib.decompressobj


def test_a_bomb_is_not_unpacked(tmp_path, monkeypatch):
    """Millions of zeros behind a header that needs 20 bytes: no more than those are unpacked."""
    header = struct.pack("<IIIBBBB", MAGIC, 3, 1, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + bytes(2**24)))
    monkeypatch.setattr(CountingUnpacker, "unpacked", 0)
    monkeypatch.setattr(zlib, "decompressobj", CountingUnpacker)
    assert len(read_splats(tmp_path / "a.spz")) == 1
    assert CountingUnpacker.unpacked == len(header) + 20


@pytest.mark.parametrize(("count", "degree"), [(200_000, 3), (MAX_GAUSSIANS, 0)])
def test_a_small_file_cannot_name_many_gaussians(tmp_path, monkeypatch, count, degree):
    """Zeros are packed a thousandfold, and all that is named would be there; nothing of it is unpacked."""
    header = struct.pack("<IIIBBBB", MAGIC, 3, count, degree, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + bytes(2**22)))
    monkeypatch.setattr(CountingUnpacker, "unpacked", 0)
    monkeypatch.setattr(zlib, "decompressobj", CountingUnpacker)
    with pytest.raises(InputError, match=rf"damaged: it names {count:,} Gaussians, [\d,]+ bytes, and has [\d,]+ packed ones"):
        read_splats(tmp_path / "a.spz")
    assert CountingUnpacker.unpacked == len(header)


def test_missing_files_and_folders(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    assert not is_splat_file(tmp_path / "folder.ply")
    assert is_splat_file(tmp_path / "any.SPZ")
    for name, said in (("folder.ply", "is a folder"), ("none.spz", "does not exist"), ("none.splat", "does not exist")):
        with pytest.raises(InputError, match=said):
            read_splats(tmp_path / name)


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.spz"])
def test_a_file_that_the_disk_does_not_give_is_refused(tmp_path, monkeypatch, name):
    def fail(*_, **__):
        raise OSError(5, "Input/output error")

    (tmp_path / name).write_bytes(ply(*FLOATS, body=GOOD) if name == "a.ply" else bytes(32))
    if name == "a.spz":
        monkeypatch.setattr("builtins.open", fail)
    else:
        monkeypatch.setattr(np, "fromfile", fail)
    with pytest.raises(InputError, match=rf"{name} cannot be read: Input/output error\.$"):
        read_splats(tmp_path / name)


def test_a_splat_is_read_byte_by_byte(tmp_path):
    """One Gaussian as the format prescribes it, which is what our writer has, too."""
    data = struct.pack("<6f8B", 1, -2, 0.5, 1, np.exp(-3), np.exp(-4), 255, 0, 128, 128, 128, 0, 128, 192)
    assert RECORD.itemsize == len(data)
    (tmp_path / "a.splat").write_bytes(data)
    found = read_splats(tmp_path / "a.splat")
    np.testing.assert_allclose(found.means, [[1, -2, 0.5]])
    np.testing.assert_allclose(found.log_scales, [[0, -3, -4]], atol=1e-6)
    np.testing.assert_allclose(found.quats, [[0, -1, 0, 0.5]])
    np.testing.assert_allclose(0.5 + C0 * found.sh[0, 0], [1, 0, 128 / 255], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found.logit_opacities)), 128 / 255, atol=1e-6)
