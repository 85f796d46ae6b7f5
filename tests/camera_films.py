"""Photron and Phantom films written by hand, after the makers' descriptions and real headers, for the tests."""

from __future__ import annotations

import struct


def packed(values, bits, order="<"):
    """Bytes of the values; 10 and 12 bit by way of a string of ones and zeros, 16 bit in the byte order."""
    if bits in (8, 16):
        return values.astype(values.dtype.newbyteorder(order)).tobytes()
    ones = "".join(f"{v:0{bits}b}" for v in values.ravel())
    return int(ones, 2).to_bytes(len(ones) // 8, "big")


def write_photron(folder, values, bits, *, head="cih", order="<", depth=None, side="Lower", n=None, **more):
    n, h, w = n or len(values), *values.shape[1:]
    about = {
        "Record Rate(fps)": 10000.0,
        "Shutter Speed(s)": 119149.0,
        "Total Frame": n,
        "Start Frame": -3,
        "Image Width": w,
        "Image Height": h,
        "Color Type": "Mono",
        "Color Bit": bits,
        "File Format": "MRaw",
        "EffectiveBit Depth": depth or bits,
        "EffectiveBit Side": side,
    } | more
    (folder / "film.mraw").write_bytes(packed(values, bits, order))
    path = folder / f"film.{head}"
    path.write_text("#Camera Information Header\n" + "".join(f"{k} : {v}\n" for k, v in about.items() if v is not None))
    return path


def write_cine(folder, values, bits, *, upward=True, n=None, stamps=None, compression=0, packing=None, pad=b""):
    """A cine file laid out from the maker's description."""
    n, (h, w) = n or len(values), values.shape[1:]
    code = packing if packing is not None else {10: 256, 12: 1024}.get(bits, 0)
    body = [packed(v if code or not upward else v[::-1], bits) + pad for v in values]
    setup = bytearray(1600)
    setup[140:144] = b"ST" + struct.pack("<H", 1600)
    for at, value in ((768, 5000), (772, 20), (896, bits), (1568, 20500)):
        struct.pack_into("<I", setup, at, value)
    start = 1_600_000_000 << 32
    blocks = b""
    if stamps is not None:
        ticks = [start + round(s * 2**32) for s in stamps]
        blocks = struct.pack("<IHH", 8 + 8 * len(ticks), 1002, 0) + struct.pack(f"<{len(ticks)}Q", *ticks)
    offsets_at = 84 + len(setup) + len(blocks)
    size = len(body[0])
    at = [offsets_at + 8 * len(values) + i * (size + 8) for i in range(len(values))]
    data = struct.pack("<2sHHHiIiIIIIQ", b"CI", 44, compression, 1, -10, n, -10, n, 44, 84, offsets_at, start)
    height = h if upward else -h
    data += struct.pack("<IiiHHIIiiII", 40, w, height, 1, 8 if bits == 8 else 16, code, size, 0, 0, 0, 0)
    data += bytes(setup) + blocks + struct.pack(f"<{len(at)}Q", *at)
    path = folder / "film.cine"
    path.write_bytes(data + b"".join(struct.pack("<II", 8, size) + b for b in body))
    return path
