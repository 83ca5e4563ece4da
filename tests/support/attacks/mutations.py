"""Mutations of files, each by a generator of random numbers that the caller seeds."""

import copy
import json
import struct
import zlib

import yaml

STRANGE_VALUES = [
    None, True, 0, -1, 3.5, 10**9, 2**63, 10**400, 1e-320, 1e300, float("nan"), float("inf"),
    "", "x", "7", "\0", "\ud800", "a\nb", "~no-such-user", "x" * 5000, [], {}, [[]], [1, [2]],
    {"a": {"b": []}}, [[1.0] * 4] * 4, [[0] * 4] * 4, [[["x"]]],
]  # fmt: skip

STRANGE_BYTES = [b"\0", b"\xff\xfe", b"\n", b"[" * 400, b'"', b"{", b"*a", b"&a ", b"9" * 30, b"-"]


def mutate_bytes(rng, content):
    """Flip, replace, insert, cut out, cut off or repeat, one to three times."""
    content = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(content) + 1))
        length = int(rng.integers(1, 30))
        kind = rng.integers(7)
        if kind == 0 and at < len(content):
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[at : at + 1] = rng.bytes(1)
        elif kind == 2:
            content[at:at] = rng.bytes(length)
        elif kind == 3:
            content[at:at] = STRANGE_BYTES[rng.integers(len(STRANGE_BYTES))]
        elif kind == 4:
            del content[at : at + length]
        elif kind == 5:
            del content[at:]
        elif kind == 6:
            content[at:at] = content[at : at + 10 * length]
    return bytes(content)


def places(tree):
    """(container, key) of every value within nested lists and dictionaries."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield tree, key
        if isinstance(value, (dict, list)):
            yield from places(value)


def mutate_tree(rng, tree):
    """Drop, replace, repeat or rename values, one to three times."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.integers(1, 4)):
        found = list(places(tree))
        if not found:
            return tree
        container, key = found[rng.integers(len(found))]
        kind = rng.integers(4)
        if kind == 0:
            del container[key]
        elif kind == 1:
            container[key] = copy.deepcopy(STRANGE_VALUES[rng.integers(len(STRANGE_VALUES))])
        elif kind == 2 and isinstance(container, list):
            container.insert(key, copy.deepcopy(container[key]))
        elif kind == 2:
            container[f"{key}x"] = container.pop(key)
        else:
            other, other_key = found[rng.integers(len(found))]
            container[key] = copy.deepcopy(other[other_key])
    return tree


def mutate_json(rng, content):
    return json.dumps(mutate_tree(rng, json.loads(content))).encode()


def mutate_yaml(rng, content):
    text = yaml.safe_dump(mutate_tree(rng, yaml.safe_load(content)), sort_keys=False)
    return text.encode(errors="surrogatepass")


def mutate_header(rng, content):
    """Drop, repeat, swap or rewrite lines of a PLY header."""
    header, end, rows = content.partition(b"end_header\n")
    lines = header.split(b"\n")[:-1]
    for _ in range(rng.integers(1, 3)):
        at = int(rng.integers(1, len(lines)))
        kind = rng.integers(5)
        if kind == 0 and len(lines) > 2:
            del lines[at]
        elif kind == 1:
            lines.insert(at, lines[rng.integers(1, len(lines))])
        elif kind == 2:
            counts = [b"0", b"-1", b"2", b"4", b"1000", b"1000000000000", b"9" * 5000, b"x"]
            lines[at] = b"element vertex " + counts[rng.integers(len(counts))]
        elif kind == 3:
            types = [b"double", b"uchar", b"list uchar int", b"list uint double", b"int", b"half"]
            name = lines[at].split()[-1]
            lines[at] = b"property " + types[rng.integers(len(types))] + b" " + name
        else:
            lines[at] = lines[at].replace(b" ", b"  ", 1)[: int(rng.integers(1, 40))]
    return b"\n".join(lines) + b"\n" + end + rows


def mutate_chunks(rng, content):
    """Drop, repeat, swap or damage chunks of a PNG, with checksums that are right."""
    signature, rest = content[:8], content[8:]
    chunks = []
    while rest:
        (length,) = struct.unpack(">I", rest[:4])
        chunks.append((rest[4:8], rest[8 : 8 + length]))
        rest = rest[12 + length :]
    at = int(rng.integers(len(chunks)))
    kind, body = chunks[at]
    change = rng.integers(5)
    if change == 0:
        del chunks[at]
    elif change == 1:
        chunks.insert(int(rng.integers(len(chunks))), chunks[at])
    elif change == 2 and kind == b"IHDR":
        fields = list(struct.unpack(">IIBBBBB", body))
        sizes = [0, 1, 5, 7, 9000, 10**6, 2**31 - 1, 2**32 - 1]
        small = [0, 1, 2, 3, 4, 6, 8, 16, 255]
        i = int(rng.integers(7))
        fields[i] = (sizes if i < 2 else small)[rng.integers(8)]
        chunks[at] = (kind, struct.pack(">IIBBBBB", *fields))
    elif change == 3:
        kinds = [b"PLTE", b"tRNS", b"acTL", b"fcTL", b"eXIf", b"iCCP", b"zTXt", b"gAMA"]
        chunks.insert(1, (kinds[rng.integers(8)], rng.bytes(int(rng.integers(30)))))
    else:
        chunks[at] = (kind, mutate_bytes(rng, body or b"\0"))
    return signature + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
