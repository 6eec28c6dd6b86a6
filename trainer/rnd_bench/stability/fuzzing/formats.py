"""Random damage below the outer layer of binary formats: checksums and lengths stay right."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import pickletools
import struct
import zipfile
import zlib

import numpy as np

from .damage import Random, damage, damaged_json

_COMPRESSORS = (gzip.compress, bz2.compress, lzma.compress, zlib.compress)
_NUMBERS = (0, 1, -1, 2**31 - 1, -(2**31), 255)
_OPERATORS = ("If", "Loop", "Scan", "Expand", "Tile", "Range", "ConstantOfShape", "Pad", "Resize", "Gather", "Cast")
_OPCODES = (b"N", b"J\xff\xff\xff\x7f", b"K\x05", b"]", b"}", b"(", b"t", b"R", b"b", b"cos\nsystem\n")


def damaged_npz(honest: bytes, rng: Random) -> bytes:
    """An archive with valid checksums and one broken member."""
    members = _members(honest)
    name = rng.choice(sorted(members))
    kind = rng.choice(("bytes", "shape", "type", "gone", "rename", "random"))
    if kind == "bytes":
        members[name] = damage(rng, members[name], None)
    elif kind == "shape":
        array = np.load(io.BytesIO(members[name]), allow_pickle=False)
        rows = rng.randint(-2, 2 ** rng.choice((3, 31, 62)))
        head = f"{{'descr': '{array.dtype.str}', 'fortran_order': False, 'shape': ({rows}, 3), }}"
        members[name] = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode() + b"\0" * 64
    elif kind == "type":
        others = (np.array(["a"]), np.array(1j), np.zeros((0, 3)), np.array(np.nan), np.zeros((2, 2, 2, 2)))
        members[name] = _npy(rng.choice(others))
    elif kind == "gone":
        del members[name]
    elif kind == "rename":
        members[rng.choice(("../../x.npy", "/etc/x.npy", "betas.npy", "Rh.npy"))] = members.pop(name)
    else:
        array = np.load(io.BytesIO(members[name]), allow_pickle=False)
        if array.dtype.kind in "fiu" and array.size:
            array = array.copy()
            extreme = rng.choice((np.nan, np.inf, -1, 1e30, 2**31 - 1))
            with np.errstate(all="ignore"):
                array.flat[rng.randrange(array.size)] = np.array(extreme).astype(array.dtype)
            members[name] = _npy(array)
    return _archive(members)


def damaged_npy(honest: bytes, rng: Random) -> bytes:
    """An array with another shape, type, or number, as one of an archive."""
    return _members(damaged_npz(_archive({"a.npy": honest, "b.npy": honest}), rng)).get("a.npy", b"")


def damaged_glb(honest: bytes, rng: Random) -> bytes:
    """A glTF binary with a broken JSON chunk of the right length."""
    size = int.from_bytes(honest[12:16], "little")
    text = damaged_json(honest[20 : 20 + size], rng)
    text += b" " * (-len(text) % 4)
    rest = honest[20 + size :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def damaged_torch(honest: bytes, rng: Random) -> bytes:
    """torch's zip file with a damaged pickle or another damaged member."""
    members = _members(honest)
    pickled = next(name for name in members if name.endswith("data.pkl"))
    name = pickled if rng.random() < 0.7 else rng.choice(sorted(members))
    members[name] = (damaged_pickle if name == pickled else _bytes_of)(members[name], rng)
    return _archive(members)


def damaged_pickle(honest: bytes, rng: Random) -> bytes:
    """A pickle with opcodes lost, repeated, exchanged, or with other arguments."""
    starts = [at for _, _, at in pickletools.genops(honest) if at is not None]
    spans = [honest[a:b] for a, b in zip(starts, [*starts[1:], len(honest)])]
    for _ in range(rng.randint(1, 3)):
        k, other = rng.randrange(len(spans)), rng.choice(spans)
        kind = rng.randrange(5)
        if kind == 0:
            spans[k] = b""
        elif kind == 1:
            spans[k] *= rng.choice((2, 3, 1000))
        elif kind == 2:
            spans[k] = other
        elif kind == 3:
            spans[k] = spans[k][:1] + rng.randbytes(max(len(spans[k]) - 1, 0))
        else:
            spans[k] = rng.choice(_OPCODES)
    return b"".join(spans)


def damaged_below_compression(honest: bytes, rng: Random) -> bytes:
    """A damaged pickle in any of the compressed forms; ``honest`` is gzip's."""
    return rng.choice(_COMPRESSORS)(damaged_pickle(gzip.decompress(honest), rng))


def damaged_safetensors(honest: bytes, rng: Random) -> bytes:
    """A safetensors file with a broken JSON header of the right length."""
    size = int.from_bytes(honest[:8], "little")
    head = damaged_json(honest[8 : 8 + size], rng)
    return len(head).to_bytes(8, "little") + head + honest[8 + size :]


def damaged_png(honest: bytes, rng: Random) -> bytes:
    """A PNG with a chunk lost, repeated or damaged under a right checksum."""
    chunks, at = [], 8
    while at < len(honest):
        size = int.from_bytes(honest[at : at + 4], "big")
        chunks.append((honest[at + 4 : at + 8], honest[at + 8 : at + 8 + size]))
        at += 12 + size
    k = rng.randrange(len(chunks))
    name, content = chunks[k]
    kind = rng.randrange(4)
    if kind == 0:
        del chunks[k]
    elif kind == 1:
        chunks.insert(rng.randrange(len(chunks)), chunks[k])
    elif kind == 2 and name == b"IDAT":  # compressed pixels
        chunks[k] = name, zlib.compress(damage(rng, zlib.decompressobj().decompress(content, 1 << 20), None))
    else:
        chunks[k] = name, damage(rng, content, None)
    whole = [struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks]
    return honest[:8] + b"".join(whole)


def damaged_exr(honest: bytes, rng: Random) -> bytes:
    """An EXR with one attribute of its header lost, or with another value, size or type."""
    attributes, at = [], 8
    while honest[at]:
        name_end = honest.index(b"\0", at)
        type_end = honest.index(b"\0", name_end + 1)
        size = int.from_bytes(honest[type_end + 1 : type_end + 5], "little")
        start = type_end + 5
        attributes.append([honest[at:name_end], honest[name_end + 1 : type_end], honest[start : start + size]])
        at = start + size
    k = rng.randrange(len(attributes))
    kind = rng.randrange(4)
    if kind == 0:
        del attributes[k]
    elif kind == 1:
        attributes[k][1] = rng.choice(attributes)[1]
    elif kind == 2 and len(attributes[k][2]) >= 4:
        value = bytearray(attributes[k][2])
        start = rng.randrange(0, len(value) - 3)
        value[start : start + 4] = struct.pack("<i", rng.choice(_NUMBERS))
        attributes[k][2] = bytes(value)
    else:
        attributes[k][2] = damage(rng, attributes[k][2], None)
    head = [n + b"\0" + t + b"\0" + struct.pack("<I", len(v)) + v for n, t, v in attributes]
    return honest[:8] + b"".join(head) + honest[at:]


def damaged_onnx(honest: bytes, rng: Random) -> bytes:
    """An ONNX model with another operator, input, attribute, shape, constant or metadata."""
    import onnx

    model = onnx.load_from_string(honest)
    graph = model.graph
    node, tensor = rng.choice(graph.node), rng.choice(graph.initializer)
    kind = rng.randrange(7)
    if kind == 0:
        node.op_type = rng.choice(_OPERATORS)
    elif kind == 1 and node.input:
        names = [*(constant.name for constant in graph.initializer), *node.output, ""]
        node.input[rng.randrange(len(node.input))] = rng.choice(names)
    elif kind == 2 and node.attribute:
        attribute = rng.choice(node.attribute)
        attribute.i = rng.choice((*_NUMBERS, 2**62))
        attribute.ints[:] = [rng.choice((*_NUMBERS, 2**62)) for _ in attribute.ints]
    elif kind == 3:
        tensor.dims[:] = [rng.choice((*tensor.dims, 0, -1, 2**31, 2**62)) for _ in tensor.dims]
    elif kind == 4:
        tensor.raw_data = damage(rng, tensor.raw_data, None)
    elif kind == 5 and model.metadata_props:
        entry = rng.choice(model.metadata_props)
        text = entry.value.encode()
        text = damaged_json(text, rng) if text[:1] in b"{[" else damage(rng, text, None)
        entry.value = text.decode("utf-8", "replace")
    else:
        del graph.node[rng.randrange(len(graph.node))]
    return model.SerializeToString()


def _bytes_of(content: bytes, rng: Random) -> bytes:
    return damage(rng, content, None)


def _members(honest: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(honest)) as source:
        return {name: source.read(name) for name in source.namelist()}


def _archive(members: dict[str, bytes]) -> bytes:
    result = io.BytesIO()
    with zipfile.ZipFile(result, "w") as target:
        for member, content in members.items():
            target.writestr(member, content)
    return result.getvalue()


def _npy(array: np.ndarray) -> bytes:
    made = io.BytesIO()
    np.save(made, array)
    return made.getvalue()
