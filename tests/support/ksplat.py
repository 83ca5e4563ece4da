"""``.ksplat`` files as GaussianSplats3D writes them."""

import struct

import numpy as np

from support.formats import SH_C0

BLOCK, BUCKET_SIZE, RANGE, LOW, HIGH = 8.0, 7, 32767, -0.5, 0.5
DEGREE = {0: [], 1: range(3), 2: range(3, 8), 3: range(8, 15)}  # coefficients of each


def section(g, level, degree, num_full):
    """Two headers' numbers and the data of a section, number by number: full buckets first, then
    one with the others, each around the mean of its Gaussians."""
    num = len(g.means)
    full = min(num_full, num // BUCKET_SIZE) if level else 0
    groups = [range(k * BUCKET_SIZE, (k + 1) * BUCKET_SIZE) for k in range(full)]
    if level and (rest := range(full * BUCKET_SIZE, num)):
        groups.append(rest)
    partial = len(groups) - full
    centers = [g.means[list(group)].mean(axis=0) for group in groups]
    bucket = {i: center for group, center in zip(groups, centers, strict=True) for i in group}
    data = b"".join(struct.pack("<I", len(group)) for group in groups[full:])
    data += b"".join(struct.pack("<3f", *center) for center in centers)
    for i in range(num):
        quat = g.quats[i] / np.linalg.norm(g.quats[i])
        rgb = 0.5 + SH_C0 * g.sh0[i, 0]
        rgba = [round(float(v) * 255) for v in (*rgb, g.opacities[i])]
        sh = [g.shN[i, k, c] for d in range(degree + 1) for c in range(3) for k in DEGREE[d]]
        if level == 0:
            data += struct.pack("<10f4B", *g.means[i], *g.scales[i], *quat, *rgba)
            data += struct.pack(f"<{len(sh)}f", *sh)
            continue
        steps = [round(float(v) / (BLOCK / 2) * RANGE) + RANGE for v in g.means[i] - bucket[i]]
        data += struct.pack("<3H7e4B", *steps, *g.scales[i], *quat, *rgba)
        if level == 1:
            data += struct.pack(f"<{len(sh)}e", *sh)
        else:
            data += bytes(round(float(v - LOW) / (HIGH - LOW) * 255) for v in sh)
    header = struct.pack(
        "<IIIIfHHIIIIH",
        *(num, num, BUCKET_SIZE, len(groups), BLOCK, 12, 0, RANGE, len(data), full, partial),
        degree,
    )
    return header.ljust(1024, b"\0"), data


def content_of(parts, level):
    sections = [section(g, level, g.sh_degree, full) for g, full in parts]
    num = sum(len(g.means) for g, _ in parts)
    head = struct.pack("<BBHIIIIHH", 0, 1, 0, len(parts), len(parts), num, num, level, 0)
    head += struct.pack("<5f", 0, 0, 0, LOW, HIGH)
    return (
        head.ljust(4096, b"\0")
        + b"".join(h for h, _ in sections)
        + b"".join(d for _, d in sections)
    )
